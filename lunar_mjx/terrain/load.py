"""From a name, a path or a table to a terrain."""

from __future__ import annotations

import logging
import os
import re
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.resources import find
from lunar_mjx.terrain.config import ClassesTable, GridsTable, SoilTable, TerrainConfig, parse_config, read_config
from lunar_mjx.terrain.dem import Dem
from lunar_mjx.terrain.procedural import add_detail, make_soil_patches, make_surface, rock_stream
from lunar_mjx.terrain.readers.dispatch import SUFFIXES, read_dem
from lunar_mjx.terrain.rock_field import place_rocks
from lunar_mjx.terrain.soil.maps import SoilGrids, SoilMap
from lunar_mjx.terrain.soil.read import Place, read_classes, read_grids
from lunar_mjx.terrain.terrain import Terrain, inclined

CONFIG = "terrain.toml"
_LOG = logging.getLogger(__name__)
_SLOPE = re.compile(r"slope:\s*([-+]?[0-9.]+(?:[eE][-+]?[0-9]+)?)\s*deg")


def load_terrain(
    spec: str | Path | dict[str, Any],
    *,
    dem: str | Path | None = None,
    seed: int | None = None,
    dtype: np.dtype | type = np.float32,
) -> Terrain:
    """The terrain of a name, file, folder or table.

    Args:
      spec: a shipped name ("flat", "lunar_plain", "de_gerlache_rim"), "slope:10deg", a folder with a `terrain.toml`,
        such a file, a DEM file that says its own scale, or the tables of a `terrain.toml` as a dict.
      dem: a DEM file that takes the place of the configuration's. Without it, the environment variable
        `LUNAR_MJX_DEM_<NAME>` does (`LUNAR_MJX_DEM_DE_GERLACHE_RIM`).
      seed: takes the place of the configuration's.
      dtype: of the floating-point arrays.

    Returns:
      The terrain, its origin in the middle of the grid.

    Raises:
      UserError: the specification or a file that it names is wrong; the sentence says which, and the remedy.
    """
    if not isinstance(spec, str | Path | dict):
        raise bad_input("terrain", "spec", spec, "is no terrain", "give a name, a path or the tables of a terrain.toml")
    # First: "slope:10deg" could be the name of a folder as well.
    if isinstance(spec, str) and spec.startswith("slope"):
        return _slope(spec, dtype)
    if isinstance(spec, dict):
        return build_terrain(parse_config(spec, "terrain"), "terrain", Path(), dem=dem, seed=seed, dtype=dtype)
    path = Path(spec)
    if path.suffix.lower() in SUFFIXES:
        return terrain_from_dem(_told(read_dem(path), path.name), path.stem, dtype)
    if path.suffix and path.suffix != ".toml" and not path.is_dir():
        if path.is_file():
            read_dem(path)  # which says that this format is not read, and which ones are
        raise UserError(f"{path}: is not there; check the path or its spelling.")
    if path.suffix != ".toml":
        # A name stands for its folder, so that shipped and own terrains are loaded alike.
        path = find("terrain", spec, CONFIG) / CONFIG
    config = read_config(path)
    name = path.resolve().parent.name if path.name == CONFIG else path.stem
    return build_terrain(config, name, path.parent, dem=dem, seed=seed, dtype=dtype)


def _slope(spec: str, dtype: np.dtype | type) -> Terrain:
    match = _SLOPE.fullmatch(spec)
    try:
        angle = float(match.group(1)) if match else float("nan")
    except ValueError:
        angle = float("nan")
    # Written so that NaN fails, too.
    if not abs(angle) < 90:
        raise bad_input("terrain", "spec", spec, "is not a slope below 90 degrees", "write it as slope:10deg")
    return inclined(np.radians(angle), dtype=dtype, name=spec)


def load_dem(config: TerrainConfig, name: str, folder: Path, dem: str | Path | None = None, seed: int = 1) -> Dem:
    """The ground of a configuration on the host: DEM or procedural surface, cropped, with detail."""
    file = _dem_file(config, name, folder, dem)
    crop = config.crop
    if file is not None:
        table = config.dem
        options = (
            {}
            if table is None
            else {
                "cell": table.cell,
                "height_scale": table.height_scale,
                "band": table.band,
                "dequantise": table.dequantise,
            }
        )
        ground = _told(read_dem(file, crop=crop, **options), name)
    elif config.surface is not None:
        s = config.surface
        if config.dem is not None:
            _LOG.warning(
                "%s: no DEM is given, so the ground is a procedural stand-in; set %s to the DEM's path.",
                name,
                _variable(name),
            )
        ground = make_surface(
            s.width, s.height, s.cell, seed, roughness=s.roughness, craters=s.craters, center=(s.x, s.y)
        )
        if crop is not None:
            ground = ground.crop(crop.x, crop.y, crop.width, crop.height)
    else:
        raise bad_input(name, "dem.file", None, "leaves no ground", f"give dem, or set {_variable(name)}")
    if config.detail is not None:
        d = config.detail
        ground = add_detail(ground, d.cell, seed, roughness=d.roughness, craters=d.craters)
    return ground


def _told(dem: Dem, name: str) -> Dem:
    """The DEM, of which the user is told what reading has changed: cells taken for nodata, holes filled."""
    for note in dem.notes:
        _LOG.warning("%s: %s.", name, note)
    return dem


def build_terrain(
    config: TerrainConfig,
    name: str,
    folder: Path,
    *,
    dem: str | Path | None = None,
    seed: int | None = None,
    dtype: np.dtype | type = np.float32,
) -> Terrain:
    """Makes the terrain of a checked configuration; relative files are looked for in `folder`. See `load_terrain`."""
    # A seed of 0 counts: only None means the configuration's.
    seed = config.seed if seed is None else seed
    if config.plane is not None:
        p = config.plane
        if dem is not None:
            raise bad_input(name, "dem", dem, "does not go with a plane", "choose a terrain with a DEM")
        return inclined(
            np.radians(p.slope_deg), p.extent, np.radians(p.direction_deg), cell=p.cell, dtype=dtype, name=name
        )
    ground = load_dem(config, name, folder, dem, seed)
    field, origin = ground.to_heightfield(dtype)
    rocks = None
    if config.rocks is not None:
        west, south, east, north = ground.bounds
        bounds = (west - origin[0], south - origin[1], east - origin[0], north - origin[1])

        # Rocks are placed in float64 on the host, on the surface that the simulator samples: bilinear.
        # Order 1 and mode "nearest" are the simulator's rule between nodes and beyond the edge.
        def height(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            at = np.stack([(y - bounds[1]) / ground.cell, (x - bounds[0]) / ground.cell])
            return ndimage.map_coordinates(ground.heights - origin[2], at, order=1, mode="nearest")

        rocks = place_rocks(config.rocks, bounds, height, rock_stream(seed), dtype)
    soil, grids = _soil(config.soil, ground, origin, folder, seed, dtype)
    # Reports show the name: a stand-in shall not pass for the site.
    stand_in = config.dem is not None and _dem_file(config, name, folder, dem) is None
    return Terrain(field, rocks, soil, jnp.asarray(origin, dtype), f"{name} (stand-in)" if stand_in else name, grids)


def _soil(
    table: SoilTable | None, ground: Dem, origin: np.ndarray, folder: Path, seed: int, dtype: np.dtype | type
) -> tuple[SoilMap | None, SoilGrids | None]:
    """Where hard rock is, and the soil's parameters by place."""
    if table is None:
        return None, None
    patches = None
    if table.rock_fraction is not None:
        patches = make_soil_patches(ground, table.rock_fraction, table.patch, seed, dtype)
    if table.grids is not None:
        read = read_grids(folder / table.grids.file, table.grids.layers or (), _place(table.grids), ground)
    elif table.classes is not None:
        read = read_classes(folder / table.classes.file, table.classes.soils, _place(table.classes), ground)
    else:
        return patches, None
    mapped, grids = read.on_ground(origin, dtype)
    if mapped is not None and patches is not None:
        raise bad_input(
            read.source, "rock", "given", "does not go with soil.rock_fraction", "say in one of the two where rock is"
        )
    return patches if mapped is None else mapped, grids


def _place(table: GridsTable | ClassesTable) -> Place:
    return Place(table.cell, table.x, table.y)


def terrain_from_dem(dem: Dem, name: str = "dem", dtype: np.dtype | type = np.float32) -> Terrain:
    """A terrain of bare ground from a DEM."""
    field, origin = dem.to_heightfield(dtype)
    return Terrain(field, None, None, jnp.asarray(origin, dtype), name)


def _variable(name: str) -> str:
    return "LUNAR_MJX_DEM_" + re.sub(r"\W", "_", name).upper()


def _dem_file(config: TerrainConfig, name: str, folder: Path, dem: str | Path | None) -> Path | None:
    """The DEM to read: the argument, else the environment's, else the configuration's, else none."""
    # The nearer wins: a call's argument, then the shell's, then the file's.
    for source, given in (("dem", dem), (_variable(name), os.environ.get(_variable(name)))):
        if given:
            return require_file(given, f"the DEM given by {source}")
    if config.dem is not None and config.dem.file is not None:
        return folder / config.dem.file
    return None
