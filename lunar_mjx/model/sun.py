"""The Sun of a model: fixed, or over a place at a date; one for power, heat and cameras."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.errors import UserError, bad_input, require_finite, require_name, require_within
from lunar_mjx.model.ambient import SYNODIC_DAY
from lunar_mjx.terrain import Dem, Terrain, read_dem
from lunar_mjx.terrain.sky import Horizon, Sun, fixed_sun
from lunar_mjx.terrain.sky.ephemeris import sun_over
from lunar_mjx.terrain.sky.horizon import compute_horizon
from lunar_mjx.terrain.sky.sun import SOLAR_CONSTANT

if TYPE_CHECKING:
    from lunar_mjx import cameras

INTERVAL = 3600.0
"""Time between two directions of a moving Sun, s: it goes by half a degree."""
_PLACE = ("latitude_deg", "longitude_deg")


@dataclasses.dataclass(frozen=True)
class SunSettings:
    """Where the Sun stands over a model's terrain, or at which date and place it moves.

    Attributes:
      azimuth_deg: clockwise from the terrain's north (y). elevation_deg: above a level horizon. For a Sun at rest.
      irradiance_W_m2: of a Sun at rest.
      date: UTC at which a drive begins, such as "2027-11-23T06:00:00", for a Sun that moves.
      latitude_deg, longitude_deg: of the terrain's middle, selenographic, north and east positive.
      north_deg: azimuth of the terrain's y axis, clockwise from north; minus the longitude on south-polar maps with
        longitude 0 upwards.
      days: for which the Sun's way is kept.
      horizon: whether the terrain shadows the rover.
      horizon_dem: DEM of the surroundings in the terrain's map coordinates, or None.
    """

    azimuth_deg: float = 135.0
    elevation_deg: float = 15.0
    irradiance_W_m2: float = SOLAR_CONSTANT
    date: str | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    north_deg: float = 0.0
    days: float = 30.0
    horizon: bool = True
    horizon_dem: str | None = None

    def __post_init__(self) -> None:
        for field in ("azimuth_deg", "north_deg"):
            require_within("sun", field, getattr(self, field), -360.0, 360.0)
        require_within("sun", "elevation_deg", self.elevation_deg, -90.0, 90.0)
        require_within("sun", "irradiance_W_m2", self.irradiance_W_m2, 0.0, 1e5)
        require_within("sun", "days", self.days, 0.0, 4000.0, above=True)
        for field, limit in zip(_PLACE, (90.0, 360.0), strict=True):
            value = getattr(self, field)
            if (value is None) != (self.date is None):
                problem = "is missing beside a date" if value is None else "is given without a date"
                raise bad_input("sun", field, value, problem, f"give all of date, {', '.join(_PLACE)}, or none")
            if value is not None:
                require_within("sun", field, value, -limit, limit)


def read_sun(path: Path, table: Mapping[str, Any]) -> SunSettings:
    """Checks the table `[sun]` of a model file; a relative `horizon_dem` counts from the file's folder.

    Raises:
      UserError: an unknown key, a wrong type, or values that make no sense.
    """
    kinds = {"date": str, "horizon_dem": str, "horizon": bool}
    fields = [f.name for f in dataclasses.fields(SunSettings)]
    values: dict[str, Any] = {}
    for key, value in table.items():
        if key not in fields:
            raise bad_input(path, f"sun.{key}", value, "is an unknown key", f"use one of {', '.join(fields)}")
        kind = kinds.get(key, float)
        if kind is float and (isinstance(value, bool) or not isinstance(value, int | float)):
            raise bad_input(path, f"sun.{key}", value, "is not a number", "give a number")
        if kind is not float and not isinstance(value, kind):
            wanted = "a text in quotes" if kind is str else "true or false"
            raise bad_input(path, f"sun.{key}", value, f"is not {wanted}", f"give {wanted}")
        values[key] = require_finite(path, f"sun.{key}", value) if kind is float else value
    if "horizon_dem" in values:
        require_name(path, "sun.horizon_dem", values["horizon_dem"], "name a file of heights")
        # Paths count from the file that says them.
        values["horizon_dem"] = str(path.parent.resolve() / values["horizon_dem"])
    try:
        return SunSettings(**values)
    except UserError as error:  # of the settings alone, which do not know the file
        raise UserError(f"{path}: {error}") from None


def make_sun(settings: SunSettings | None, terrain: Terrain) -> Sun | None:
    """The Sun over a terrain, in the default float type; None without settings.

    Raises:
      UserError: astropy is missing for a Sun with a date, or a file cannot be read.
    """
    if settings is None:
        return None
    # Computed on the host once; a step then only looks it up.
    horizon = _horizon(terrain, settings.horizon_dem) if settings.horizon else None
    if settings.date is None:
        return fixed_sun(settings.azimuth_deg, settings.elevation_deg, settings.irradiance_W_m2, horizon, _float())
    towards, irradiance, highest = _track(settings)
    return Sun(jnp.asarray(towards), jnp.asarray(irradiance), jnp.asarray(INTERVAL), jnp.asarray(highest), horizon)


def _float() -> np.dtype:
    return jnp.result_type(float)


@functools.cache
def _track(settings: SunSettings) -> tuple[np.ndarray, np.ndarray, float]:
    """Directions in the terrain's frame, irradiances, and the sine of the highest elevation within a lunar day."""
    assert settings.date is not None and settings.latitude_deg is not None and settings.longitude_deg is not None
    kept = math.ceil(settings.days * 86400.0 / INTERVAL) + 1
    # A whole lunar day even where less is kept: the ambient temperature is scaled by the day's highest Sun.
    count = max(kept, math.ceil(SYNODIC_DAY / INTERVAL) + 1)
    seconds = np.arange(count) * INTERVAL
    local, distance = sun_over(settings.date, seconds, settings.latitude_deg, settings.longitude_deg)
    east, north, up = local.T
    cos, sin = math.cos(math.radians(settings.north_deg)), math.sin(math.radians(settings.north_deg))
    towards = np.stack([cos * east - sin * north, sin * east + cos * north, up], axis=-1)
    # The solar constant holds at 1 AU, in which the distance is given.
    # Where the Sun does not rise its highest is held above zero, since the ambient temperature divides by it.
    return towards[:kept], SOLAR_CONSTANT / distance[:kept] ** 2, max(float(up.max()), 1e-6)


_known: dict[tuple[int, str | None], tuple[Terrain, Horizon]] = {}


def _horizon(terrain: Terrain, around: str | None) -> Horizon:
    """The horizon of a terrain, kept while it is asked for again: it takes seconds."""
    key = (id(terrain), around)
    # The terrain is kept beside its horizon, for an id may be given to another once its owner is gone.
    if key not in _known or _known[key][0] is not terrain:
        field = terrain.field
        own = Dem(np.asarray(field.heights), float(field.cell), float(field.x0), float(field.y0), terrain.name)
        outer = []
        if around is not None:
            dem, origin = read_dem(around), np.asarray(terrain.origin, float)
            outer = [
                dataclasses.replace(dem, heights=dem.heights - origin[2], x0=dem.x0 - origin[0], y0=dem.y0 - origin[1])
            ]
        _known.clear()
        _known[key] = (terrain, compute_horizon(own, outer, dtype=_float()))
    return _known[key][1]


def camera_sun(settings: SunSettings | None, time: float = 0.0) -> cameras.Sun:
    """The model's Sun at `time`, s, as cameras take it; their own default without settings.

    Raises:
      UserError: the Sun is below a level horizon.
    """
    from lunar_mjx import cameras  # which a model without a picture does not wait for

    if settings is None:
        return cameras.Sun()
    if settings.date is None:
        return cameras.Sun(settings.azimuth_deg, settings.elevation_deg)
    towards = _track(settings)[0]
    at = np.clip(time / INTERVAL, 0.0, len(towards) - 1.0)
    x, y, z = (float(np.interp(at, np.arange(len(towards)), towards[:, k])) for k in range(3))
    # A compass counts from north and clockwise: east comes first.
    return cameras.Sun(math.degrees(math.atan2(x, y)) % 360.0, math.degrees(math.atan2(z, math.hypot(x, y))))
