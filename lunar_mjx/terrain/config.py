"""`terrain.toml`: what it may say, checked by name.

The tables are those of `terrain/README.md`. Every table is a frozen dataclass; its fields are the keys.
"""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from pathlib import Path
from typing import Any

from lunar_mjx.errors import UserError, bad_input, require_file, require_finite
from lunar_mjx.terrain.craters import Craters
from lunar_mjx.terrain.readers.options import Window
from lunar_mjx.terrain.rock_field import RockField
from lunar_mjx.terrain.roughness import Roughness
from lunar_mjx.toml_fields import read_toml


@dataclasses.dataclass(frozen=True)
class DemTable:
    """`[dem]`: a file of heights; see `read_dem`."""

    file: str | None = None
    cell: float | None = None
    height_scale: float | None = None
    band: int = 1
    dequantise: bool = True


@dataclasses.dataclass(frozen=True)
class SurfaceTable:
    """`[surface]`: a procedural surface, or the stand-in for the DEM; see `make_surface`."""

    width: float
    height: float
    cell: float
    x: float = 0.0
    y: float = 0.0
    roughness: Roughness | None = None
    craters: Craters | None = None


@dataclasses.dataclass(frozen=True)
class DetailTable:
    """`[detail]`: what is added below the resolution; see `add_detail`."""

    cell: float
    roughness: Roughness | None = None
    craters: Craters | None = None


@dataclasses.dataclass(frozen=True)
class PlaneTable:
    """`[plane]`: an exact plane; see `inclined`."""

    slope_deg: float = 0.0
    direction_deg: float = 0.0
    extent: float = 200.0
    cell: float = 1.0


@dataclasses.dataclass(frozen=True)
class GridsTable:
    """`[soil.grids]`: the soil's parameters as grids; see `read_grids`."""

    file: str
    layers: list | None = None
    cell: float | None = None
    x: float | None = None
    y: float | None = None


@dataclasses.dataclass(frozen=True)
class ClassesTable:
    """`[soil.classes]`: which soil lies where, as whole numbers; see `read_classes`."""

    file: str
    soils: dict
    cell: float | None = None
    x: float | None = None
    y: float | None = None


@dataclasses.dataclass(frozen=True)
class SoilTable:
    """`[soil]`: patches of hard rock (see `make_soil_patches`), and the soil's parameters by place."""

    rock_fraction: float | None = None
    patch: float = 5.0
    grids: GridsTable | None = None
    classes: ClassesTable | None = None


@dataclasses.dataclass(frozen=True)
class TerrainConfig:
    """A whole `terrain.toml`."""

    description: str = ""
    seed: int = 1
    plane: PlaneTable | None = None
    dem: DemTable | None = None
    surface: SurfaceTable | None = None
    crop: Window | None = None
    detail: DetailTable | None = None
    rocks: RockField | None = None
    soil: SoilTable | None = None


def read_config(path: Path) -> TerrainConfig:
    """Reads and checks a `terrain.toml`.

    Raises:
      UserError: the file is missing, is not TOML, or holds an unknown key, a wrong type or a value out of bounds.
    """
    return parse_config(read_toml(require_file(path, "the terrain's configuration")), str(path))


def parse_config(table: dict[str, Any], source: str) -> TerrainConfig:
    """Checks the tables of a configuration; `source` names them in messages."""
    config = _build(TerrainConfig, table, source, "")
    if config.plane is not None:
        for other in ("dem", "surface", "crop", "detail", "rocks", "soil"):
            if getattr(config, other) is not None:
                raise bad_input(source, other, "given", "does not go with [plane]", "remove one of the two")
    # An empty [soil] would pass in silence, and its writer take a default for what was meant.
    elif config.soil is not None and (config.soil.rock_fraction, config.soil.grids, config.soil.classes) == (None,) * 3:
        raise bad_input(source, "soil", "empty", "says nothing", "give rock_fraction, [soil.grids] or [soil.classes]")
    elif config.soil is not None and None not in (config.soil.grids, config.soil.classes):
        raise bad_input(source, "soil.classes", "given", "does not go with [soil.grids]", "remove one of the two")
    elif config.dem is None and config.surface is None:
        raise UserError(f"{source}: tables = none of [plane], [dem], [surface]; give one of them to make the ground.")
    return config


def _build(cls: type, table: Any, source: str, where: str) -> Any:
    """Makes the dataclass `cls` from a table, and those within it."""
    if not isinstance(table, dict):
        raise bad_input(source, where, table, "is not a table", f"write it as [{where}]")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}
    prefix = f"{where}." if where else ""
    for key, value in table.items():
        if key not in fields:
            raise bad_input(source, f"{prefix}{key}", value, "is not a known key", f"use one of {', '.join(fields)}")
    for name, field in fields.items():
        if name not in table and field.default is dataclasses.MISSING:
            raise bad_input(source, f"{prefix}{name}", None, "is missing", "add it")
    values = {key: _convert(hints[key], value, source, f"{prefix}{key}") for key, value in table.items()}
    try:
        return cls(**values)
    except UserError as error:
        # Checks of the dataclasses do not know the file; its name is put before them here.
        raise UserError(f"{source}: [{where}] {error}") from None


def _convert(hint: Any, value: Any, source: str, where: str) -> Any:
    if isinstance(hint, types.UnionType):
        # Optional fields are written by leaving them out, so a value is never None.
        hint = next(h for h in typing.get_args(hint) if h is not type(None))
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _build(hint, value, source, where)
    # TOML tells 1 from 1.0; nobody who writes a length does.
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = require_finite(source, where, value)
    kinds = {
        float: "a number",
        int: "a whole number",
        str: "a text in quotes",
        bool: "true or false",
        list: "a list",
        dict: "a table",
    }
    # The exact type: `true` is an int to isinstance, and no number to a reader.
    if type(value) is not hint:
        raise bad_input(source, where, value, f"is not {kinds[hint]}", f"give {kinds[hint]}")
    if hint is float and not math.isfinite(value):
        raise bad_input(source, where, value, "is not finite", "give a finite number")
    return value
