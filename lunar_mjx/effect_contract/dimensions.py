"""The unit of everything that ports see and hand on, and the same in other base units (for homogeneity, `contract`)."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType, SimpleNamespace
from typing import Annotated, Any, get_args, get_origin, get_type_hints

import jax.numpy as jnp

from lunar_mjx.effects import context as c
from lunar_mjx.effects.base import Effect, Parameter, StateVariable
from lunar_mjx.effects.joint.motor import MODE_UNITS
from lunar_mjx.effects.sensor.channels import SensorContext, Signals
from lunar_mjx.effects.soil.ruts import Relief
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import SoilGrids, SoilMap, Terrain
from lunar_mjx.terrain.heightfield import HeightField
from lunar_mjx.terrain.rocks import Rocks
from lunar_mjx.terrain.sky import Sunlight
from lunar_mjx.units import si_dimensions

BASES = {
    "[length]": "length",
    "[mass]": "mass",
    "[time]": "time",
    "[temperature]": "temperature",
    "[current]": "current",
}

_OWN = "own"
"""The field holds a value with units of its own."""
_PLAIN = None
"""The field holds no quantity: whole numbers, names, truth values."""

_GRID = {"x0": "m", "y0": "m", "cell": "m"}
_SOIL = {
    "k_c": "N/m^(n+1)",
    "k_phi": "N/m^(n+2)",
    "n": "1",
    "cohesion": "Pa",
    "tan_phi": "1",
    "shear_modulus_x": "m",
    "shear_modulus_y": "m",
}
UNITS: Mapping[type, Mapping[str, str | None]] = {
    c.Command: {"target": "control", "current": "A"},
    c.Geometry: {
        "radius": "m",
        "width": "m",
        "toe": "rad",
        "payload_mass": "kg",
        "payload_position": "m",
        "com_offset": "m",
        "gravity": "m/s2",
        "rim_share": "1",
        "relief": _OWN,
    },
    Relief: {"moved": "m", "pressed": "m", "tile": _PLAIN, "cell": "m"},
    c.Contact: {
        "sinkage": "m",
        "sinkage_rate": "m/s",
        "slip": "1",
        "slip_angle": "rad",
        "v_x": "m/s",
        "v_y": "m/s",
        "rim_speed": "m/s",
        "soil_slip": "1",
        "soil_slid": "1",
        "forward": "1",
        "left": "1",
        "normal": "1",
        "inside": _PLAIN,
    },
    c.Soil: {**_SOIL, "rock": "1", "rut": "m"},
    c.Arc: {"cos": "1", "sin": "1", "one": "1"},
    c.Stress: {"theta": "rad", "weight": "1", "sigma": "Pa"},
    c.Normal: {
        "entrance": "rad",
        "exit": "rad",
        "theta_m": "rad",
        "sigma_m": "Pa",
        "load": "N",
        "resistance": "N",
        "damping": "N",
        "stress": _OWN,
        "arc": _OWN,
        "reversal": "rad",
    },
    c.WheelForce: {
        "slip_x": "1",
        "slip_y": "1",
        "direction": "1",
        "force": "N",
        "moment": "N m",
        "circle": "1",
        "lug": "m",
        "grip": "1",
        "slip_ahead": "1",
    },
    c.BodyWrench: {"force": "N", "moment": "N m", "joint_torque": "N m"},
    c.Power: {"load": "W", "solar": "W", "loss": "W", "current": "A", "voltage": "V"},
    Sunlight: {"direction": "1", "irradiance": "W/m2"},
    c.Heat: {"winding": "W", "housing": "W", "winding_capacity": "J/K", "housing_capacity": "J/K"},
    c.RoverInfo: {
        "wheel_radius": "m",
        "wheel_width": "m",
        "joint_group": _PLAIN,
        "joint_lower": "rad",
        "joint_upper": "rad",
        "mode": _PLAIN,
        "position_gain": "N m/rad",
        "velocity_gain": "N m s/rad",
        "chassis_points": "m",
        "joint_inertia": "kg m2",
        "box_center": "m",
        "box_half": "m",
        "name": _PLAIN,
    },
    c.Context: {
        "time": "s",
        "dt": "s",
        "gravity": "m/s2",
        "ambient_temperature": "K",
        "position": "m",
        "frame": "1",
        "velocity": "m/s",
        "angular_velocity": "rad/s",
        "joint_angle": "rad",
        "joint_speed": "rad/s",
        "winding_temperature": "K",
        "housing_temperature": "K",
        "steering_angle": "rad",
        "wheel_position": "m",
        "wheel_axle": "1",
        "wheel_velocity": "m/s",
        "wheel_angular_velocity": "rad/s",
        "terrain": _OWN,
        "rover": _OWN,
        "parameters": "parameters",
        "command": _OWN,
        "torque": "N m",
        "geometry": _OWN,
        "contact": _OWN,
        "soil": _OWN,
        "normal": _OWN,
        "wheel": _OWN,
        "power": _OWN,
        "sunlight": _OWN,
        "bus_voltage": "V",
    },
    Terrain: {"field": _OWN, "rocks": _OWN, "soil": _OWN, "origin": "m", "name": _PLAIN, "grids": _OWN},
    HeightField: {"heights": "m", **_GRID},
    Rocks: {"centers": "m", "radii": "m", "index": _PLAIN, "forms": "1/m2", **_GRID},
    SoilMap: {"rock": "1", **_GRID},
    SoilGrids: {**_GRID, **_SOIL},
    Signals: {"time": "s", "channels": "channels"},
    SensorContext: {
        "time": "s",
        "gravity": "m/s2",
        "ambient_temperature": "K",
        "rover": _OWN,
        "parameters": "parameters",
        "joints": _PLAIN,
        "wheels": _PLAIN,
    },
}
"""Unit of every field of what ports see and hand on; a test holds the list against the classes."""

_MODULUS = re.compile(r"(?P<unit>.+)/m\^\(n\+(?P<more>\d)\)")
_SUFFIX = {
    "_m": "m",
    "_m_s": "m/s",
    "_m_s2": "m/s2",
    "_rad": "rad",
    "_rad_s": "rad/s",
    # angles are pure numbers in every system of units, and the degree is the channel's own factor
    "_deg": "1",
    "_A": "A",
    "_W": "W",
    "_V": "V",
    "_Nm": "N m",
    "_N": "N",
    # differences alone are rescaled: the offset of degrees Celsius is a channel's convention
    "_degC": "K",
    "_ratio": "1",
}


def channel_unit(name: str) -> str:
    """SI unit of a log channel by the end of its name; temperatures count from the offset of degrees Celsius."""
    suffixes = [suffix for suffix in _SUFFIX if name.endswith(suffix)]
    return _SUFFIX[max(suffixes, key=len)] if suffixes else "1"


def check_unit(unit: str) -> None:
    """Refuses a unit that is not a coherent SI unit.

    Raises:
      ValueError: what is wrong with it.
    """
    match = _MODULUS.fullmatch(unit)
    si_dimensions(match["unit"] if match else unit)


def constants(modules: Sequence[ModuleType]) -> list[tuple[str, float, str]]:
    """Constants with a unit, `NAME: Annotated[float, "W/m2/K4"] = 5.67e-8`: name, value and unit of each.

    Raises:
      ValueError: what is wrong with a unit.
    """
    numbers = []
    for module in modules:
        for name, hint in get_type_hints(module, include_extras=True).items():
            if get_origin(hint) is Annotated and get_args(hint)[0] is float:
                unit = get_args(hint)[1]
                check_unit(unit)
                numbers.append((name, getattr(module, name), unit))
    return numbers


class Rescaling:
    """Other base units: by what factor the number of a quantity changes.

    Attributes:
      factors: of the numbers of length, mass, time, temperature and current.
      effects: whose parameters the context holds, by name.
    """

    def __init__(self, factors: Mapping[str, float], effects: Sequence[Effect]):
        self.factors = {**dict.fromkeys(BASES, 1.0), **factors}
        self.effects = {e.name: e for e in effects}
        own = {f.__module__ for e in effects for f in e.ports.values()}
        self._modules = [m for n, m in list(sys.modules.items()) if n in own or n.startswith("lunar_mjx.effects.")]
        self._constants = constants(self._modules)

    @contextlib.contextmanager
    def constants(self) -> Iterator[None]:
        """Gives constants with a unit, in every module of effects that holds them, their numbers in the other units."""
        # constants of a module are physics with a unit, too: a function that reads one must see it rescaled
        held = [
            (vars(module), name, value, value * self.of(unit))
            for module in self._modules
            for name, value, unit in self._constants
            # by identity: two modules may give one name to two constants, and import one from another
            if vars(module).get(name) is value
        ]
        try:
            for names, name, _, other in held:
                names[name] = other
            yield
        finally:
            for names, name, value, _ in held:
                names[name] = value

    def of(self, unit: str, n: Any = 1.0) -> Any:
        """Factor of a unit; `n` is the sinkage exponent where its power depends on it."""
        match = _MODULUS.fullmatch(unit)
        if match:
            return self.of(match["unit"]) * self.factors["[length]"] ** -(n + int(match["more"]))
        out = 1.0
        for name, power in si_dimensions(unit):
            out *= self.factors.get(name, 1.0) ** power
        return out

    def value(self, value: Any, unit: str | None = _OWN, n: Any = 1.0, mode: Any = None) -> Any:
        """A value of a port, or a part of one, in the other units."""
        if value is None or unit is _PLAIN:
            return value
        if unit == "parameters":
            return {k: self.parameters(self.effects[k], v) if k in self.effects else v for k, v in value.items()}
        if unit == "channels":
            return {k: v * self.of(channel_unit(k)) for k, v in value.items()}
        if unit == "control":
            by_mode = [self.of(u) for u in MODE_UNITS]
            # Each joint has the unit of its own mode: rad, rad/s, N m or A side by side in one array.
            return value * sum(jnp.where(mode == i, f, 0.0) for i, f in enumerate(by_mode))
        if dataclasses.is_dataclass(value):
            return self._fields(value, mode)
        if isinstance(value, Frame | Vec3):
            return type(value)(*(self.value(part, unit, n) for part in value))
        if isinstance(value, tuple):
            return tuple(self.value(part, unit, n) for part in value)
        return value * self.of("1" if unit == _OWN else str(unit), n)

    def _fields(self, value: Any, mode: Any) -> Any:
        units = UNITS[type(value)]
        if isinstance(value, c.Context | SensorContext):
            mode = value.rover.mode
        # k_c and k_phi are per m^n: their factor depends on the exponent of the same soil
        n = value.n if isinstance(value, c.Soil | SoilGrids) and value.n is not None else 1.0
        changed = {
            f.name: self.value(getattr(value, f.name), units[f.name], n, mode) for f in dataclasses.fields(value)
        }
        return dataclasses.replace(value, **changed)

    def parameters(self, effect: Effect, p: SimpleNamespace) -> SimpleNamespace:
        """An effect's parameters in the other units."""
        return self._named(effect.parameters, p)

    def state(self, effect: Effect, values: Mapping[str, Any], rates: bool = False) -> dict[str, Any]:
        """An effect's state in the other units, or (`rates`) what it returns for it."""
        # What a port returns for such a state is its derivative by time, and so has another unit than the state.
        per_second = {k: self.of("s") if rates and v.rate else 1.0 for k, v in effect.state.items()}
        scaled = vars(self._named(effect.state, SimpleNamespace(**values)))
        return {k: v / per_second.get(k, 1.0) for k, v in scaled.items()}

    def _named(self, known: Mapping[str, Parameter] | Mapping[str, StateVariable], p: Any) -> SimpleNamespace:
        n = getattr(p, "n", 1.0)
        return SimpleNamespace(**{k: v * self.of(known[k].unit, n) if k in known else v for k, v in vars(p).items()})
