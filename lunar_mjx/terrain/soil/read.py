"""Grids of soil parameters, and maps of soil classes, from files beside the DEM."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from lunar_mjx.errors import UserError, bad_input, plain_digits, require_file, require_finite
from lunar_mjx.terrain.dem import Dem, require_cell
from lunar_mjx.terrain.readers.dispatch import read_plain
from lunar_mjx.terrain.soil.maps import SoilGrids, SoilMap
from lunar_mjx.terrain.soil.named import BOUNDS, SOILS, UNITS

ROCK = "rock"
"""Layer of the share of hard rock, and class of hard rock."""
_ARCHIVE = ".npz"
_UNPLACED = (_ARCHIVE, ".npy")
"""Files that do not say where on the map they lie."""


@dataclasses.dataclass(frozen=True)
class Place:
    """Where a grid lies, where its file does not say so.

    Attributes:
      cell: spacing, m.
      x, y: map coordinates of its middle, m; that of the ground if None.
    """

    cell: float | None = None
    x: float | None = None
    y: float | None = None


@dataclasses.dataclass(frozen=True)
class SoilLayers:
    """Layers on one grid in map coordinates.

    Attributes:
      values: by name of the parameter (`friction_angle` in rad) or "rock"; row 0 in the south.
      cell: spacing, m.
      x0, y0: map coordinates of the south-western node, m.
      source: file that they came from.
    """

    values: Mapping[str, np.ndarray]
    cell: float
    x0: float
    y0: float
    source: str

    def on_ground(self, origin: np.ndarray, dtype: np.dtype | type) -> tuple[SoilMap | None, SoilGrids | None]:
        """The map of rock and the grids of parameters about the terrain's origin; None for what no layer tells."""
        at = [jnp.asarray(v, dtype) for v in (self.x0 - origin[0], self.y0 - origin[1], self.cell)]
        given = {k: v for k, v in self.values.items() if k != ROCK}
        if "friction_angle" in given:
            # The laws use the tangent; taken once here, not in each step.
            given["tan_phi"] = np.tan(given.pop("friction_angle"))
        rock = SoilMap(jnp.asarray(self.values[ROCK], dtype), *at) if ROCK in self.values else None
        return rock, SoilGrids(*at, **{k: jnp.asarray(v, dtype) for k, v in given.items()}) if given else None


def read_grids(path: Path, layers: Sequence[Any], place: Place, ground: Dem) -> SoilLayers:
    """Reads soil parameters by place.

    Args:
      path: an archive (.npz) of arrays named as the parameters, or a GeoTIFF, .npy or ESRI ASCII grid.
      layers: parameters that the bands of the latter hold, in their order.
      place: where it lies.
      ground: which it must overlap.

    Raises:
      UserError: a file, name or value that is not usable.
    """
    known = (*BOUNDS, ROCK)
    archive = path.suffix.lower() == _ARCHIVE
    if archive:
        if layers:
            raise bad_input(path, "soil.grids.layers", list(layers), "does not go with an archive", "leave it out")
        arrays, place = _archive(path, place)
        grids = {name: _array(path, name, values, place) for name, values in arrays.items()}
    else:
        if not layers:
            raise bad_input(
                path,
                "soil.grids.layers",
                "none",
                "leaves the numbers without a name",
                f"name some of {', '.join(known)}",
            )
        if len({str(n) for n in layers}) < len(layers):
            raise bad_input(path, "soil.grids.layers", list(layers), "names a parameter twice", "name each once")
        grids = {str(n): read_plain(path, cell=place.cell, band=k + 1) for k, n in enumerate(layers)}
    for name, grid in grids.items():
        if name not in known:
            raise bad_input(path, "layer", name, "is no parameter of a soil", f"use some of {', '.join(known)}")
        low, high = BOUNDS.get(name, (0.0, 1.0))
        # The worst node is named, so that the message shows how far off the grid is.
        worst = float(grid.heights.flat[np.argmax(np.maximum(low - grid.heights, grid.heights - high))])
        if not low <= worst <= high:
            raise bad_input(path, name, worst, f"is outside [{low:g}, {high:g}]{_unit(name)}", "correct the grid")
    return _placed({k: g.heights for k, g in grids.items()}, next(iter(grids.values())), path, place, ground)


def read_classes(path: Path, soils: Mapping[str, Any], place: Place, ground: Dem) -> SoilLayers:
    """Reads a map of soil classes, and gives every node the parameters of its soil.

    Args:
      path: GeoTIFF, .npy or ESRI ASCII grid of whole numbers.
      soils: by class number the name of a soil or "rock", or a table of parameters, which may begin from a `soil`.
      place: where it lies.
      ground: which it must overlap.

    Raises:
      UserError: a file, class or value that is not usable.
    """
    grid = read_plain(path, cell=place.cell, fill=False)
    table = {_number(path, key): _soil(path, key, value) for key, value in soils.items()}
    for class_number in np.unique(grid.heights):
        if class_number not in table:
            have = ", ".join(f"{k:g}" for k in table) or "none"
            raise bad_input(
                path, "class", f"{class_number:g}", f"is not in soil.classes.soils ({have})", "add its soil there"
            )
    rock = np.isin(grid.heights, [k for k, soil in table.items() if soil is None])
    number = grid.heights
    if rock.any() and not rock.all():
        # between rock and soil a wheel meets the soil beside the rock
        near: Any = ndimage.distance_transform_edt(rock, return_distances=False, return_indices=True)
        number = number[tuple(near)]
    layers = {name: np.zeros_like(number) for name in BOUNDS}
    for k, soil in table.items():
        for name, value in (soil or SOILS["lunar_nominal"]).items():
            layers[name][number == k] = value
    if rock.any():
        layers[ROCK] = rock.astype(float)
    return _placed(layers, grid, path, place, ground)


def _archive(path: Path, place: Place) -> tuple[dict[str, np.ndarray], Place]:
    """Arrays of an archive by name, and its place, which may stand in it as cell, x and y."""
    require_file(path, "the archive of soil parameters")
    try:
        with np.load(path, allow_pickle=False) as archive:
            arrays = {name: archive[name] for name in archive.files}
    except Exception as error:  # NumPy parses headers as Python: anything from SyntaxError to BadZipFile
        raise UserError(
            f"{path}: the archive cannot be read ({' '.join(str(error).split())[:200]}); save it with numpy.savez."
        ) from None
    said = {}
    for field in ("cell", "x", "y"):
        value = arrays.pop(field, None)
        if value is not None and value.size != 1:
            raise bad_input(path, field, f"shape {value.shape}", "is not one number", "save a single number in m")
        own = getattr(place, field)
        said[field] = own if own is not None or value is None else require_finite(path, field, value.item())
    if not arrays:
        raise bad_input(path, "arrays", "none", "leave nothing to read", f"save some of {', '.join((*BOUNDS, ROCK))}")
    return arrays, Place(**said)


def _array(path: Path, name: str, values: np.ndarray, place: Place) -> Dem:
    if place.cell is None:
        raise bad_input(
            path, "cell", None, "leaves the arrays without a scale", "give it in the file or the table, in m"
        )
    if values.dtype.kind not in "iuf" or values.ndim != 2 or min(values.shape) < 2:
        shape_words = f"{values.dtype} of shape {values.shape}"
        raise bad_input(path, name, shape_words, "is no grid of at least 2 x 2 real numbers", "save rows x columns")
    if not np.isfinite(values).all():
        raise bad_input(path, name, f"{int((~np.isfinite(values)).sum())} nodes", "are not finite", "fill the holes")
    # as in all readers, the first row is the north
    return Dem(values[::-1], require_cell(str(path), "cell", place.cell), source=str(path), highest=np.inf)


def _placed(values: Mapping[str, np.ndarray], grid: Dem, path: Path, place: Place, ground: Dem) -> SoilLayers:
    shapes = {v.shape for v in values.values()}
    if len(shapes) > 1:
        raise bad_input(path, "layers", sorted(shapes), "differ in shape", "put them on one grid")
    rows, cols = grid.heights.shape
    west, south, east, north = ground.bounds
    corner = [grid.x0, grid.y0]
    unplaced = path.suffix.lower() in _UNPLACED
    for axis, (given, middle, count) in enumerate(
        ((place.x, 0.5 * (west + east), cols), (place.y, 0.5 * (south + north), rows))
    ):
        if given is not None or unplaced:
            corner[axis] = (middle if given is None else given) - 0.5 * (count - 1) * grid.cell
    x0, y0 = corner
    x1, y1 = x0 + (cols - 1) * grid.cell, y0 + (rows - 1) * grid.cell
    if x0 > east or x1 < west or y0 > north or y1 < south:
        raise bad_input(
            path,
            "place",
            f"x {x0:g} .. {x1:g}, y {y0:g} .. {y1:g} m",
            "lies beside the ground",
            f"give x and y of its middle within x {west:g} .. {east:g}, y {south:g} .. {north:g} m",
        )
    return SoilLayers(values, grid.cell, x0, y0, str(path))


def _number(path: Path, key: str) -> float:
    try:
        return float(int(plain_digits(key)))
    except (ValueError, OverflowError):
        raise bad_input(path, "soil.classes.soils", key, "is no whole number", "write CLASS = SOIL") from None


def _soil(path: Path, key: str, value: Any) -> Mapping[str, float] | None:
    """The seven parameters of a class; None for rock."""
    field = f"soil.classes.soils.{key}"
    if value == ROCK:
        return None
    changes = dict(value) if isinstance(value, dict) else {"soil": value}
    name = changes.pop("soil", None)
    if name is not None and (not isinstance(name, str) or name not in SOILS):
        raise bad_input(path, field, name, "is no soil that is known", f"use one of {', '.join(SOILS)}, {ROCK}")
    soil = dict(SOILS.get(name, {})) if name is not None else {}
    for parameter, given in changes.items():
        if parameter not in BOUNDS:
            raise bad_input(path, field, parameter, "is no parameter of a soil", f"use some of {', '.join(BOUNDS)}")
        number = require_finite(path, f"{field}.{parameter}", given)
        low, high = BOUNDS[parameter]
        if not low <= number <= high:
            outside = f"is outside [{low:g}, {high:g}]{_unit(parameter)}"
            raise bad_input(path, f"{field}.{parameter}", number, outside, "correct it")
        soil[parameter] = number
    missing = [p for p in BOUNDS if p not in soil]
    if missing:
        raise bad_input(path, field, value, f"lacks {', '.join(missing)}", 'give them, or begin from soil = "NAME"')
    return soil


def _unit(name: str) -> str:
    """Unit of a parameter behind a number, with a space before it; nothing for plain numbers."""
    unit = UNITS.get(name, "1")
    return "" if unit == "1" else f" {unit}"
