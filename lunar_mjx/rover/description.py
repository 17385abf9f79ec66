"""The description beside a URDF (`<name>.rover.toml`): what URDF cannot say about a rover.

It names wheels and joint roles (otherwise inferred), closes kinematic loops, and gives motors, springs and controls.
Every key is optional; an unknown key is an error.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from lunar_mjx import toml_fields
from lunar_mjx.errors import bad_input, require_file, require_finite

HEAVIEST = 1e5
"""kg: no rover weighs as much as a train."""
LARGEST = 1e3
"""m: no rover is as long as that, and no wheel as wide."""
GROUPS = ("drive", "steer", "suspension")
MODES = ("position", "velocity", "torque", "current")
MOTOR_KEYS = ("torque_constant_Nm_A", "resistance_ohm", "current_limit_A")
WINDINGS = (12, 18, 24, 36, 48)  # nominal voltages of the maxon ECX TORQUE 22 XL

CORNER_WORDS = {
    "lf": "left front",
    "rf": "right front",
    "lm": "left middle",
    "rm": "right middle",
    "lr": "left rear",
    "rr": "right rear",
}
"""Corners of a rover in words."""


@dataclass(frozen=True)
class GroupDescription:
    """One joint group as described; None means that the converter chooses (see `statics.default_gains`).

    `torque_constant_Nm_A`, `resistance_ohm` and `current_limit_A` state a motor that is none of the windings; what they
    leave out is that of `winding`.

    `stiffness` N m/rad, `damping` N m s/rad and `spring_reference` rad describe a passive spring and damper on the
    joint; the reference "level" is computed such that the rover stands level at zero angles.
    """

    mode: str
    position_gain: float | None = None
    velocity_gain: float | None = None
    gear_ratio: float = 243.0
    gear_efficiency: float = 0.75
    rotor_inertia_kg_m2: float = 9e-7  # estimate for a brushless motor of 22 mm
    winding: int = 48
    torque_constant_Nm_A: float | None = None
    resistance_ohm: float | None = None
    current_limit_A: float | None = None
    stiffness: float = 0.0
    damping: float = 0.0
    spring_reference: float | str = 0.0


@dataclass(frozen=True)
class WheelDescription:
    """A wheel named by its link; None means inferred from the URDF's tree and geometry. Lengths in m."""

    link: str
    corner: str | None = None
    radius: float | None = None
    width: float | None = None
    steer: str | None = None
    suspension: str | None = None


@dataclass(frozen=True)
class DriveGroupDescription:
    """Wheels, by corner, that one motor drives through chains or belts, so that they turn at one speed."""

    name: str
    wheels: tuple[str, ...]


@dataclass(frozen=True)
class DifferentialDescription:
    """Two pivots, such as those of the rockers, that a differential on the chassis turns by opposite angles."""

    joint1: str
    joint2: str


@dataclass(frozen=True)
class LoopDescription:
    """Two points, each (3,) in m in its link's frame, that a pin holds together."""

    link1: str
    link2: str
    anchor1: tuple[float, float, float]
    anchor2: tuple[float, float, float]


def _default_groups() -> dict[str, GroupDescription]:
    return {
        "drive": GroupDescription("velocity"),
        # Steering and suspension turn slowly: a gear of more stages than a drive's, which loses more.
        "steer": GroupDescription("position", gear_ratio=1526.0, gear_efficiency=0.6),
        "suspension": GroupDescription("position", gear_ratio=1526.0, gear_efficiency=0.6),
    }


@dataclass(frozen=True)
class Description:
    """Everything the converter is told beyond the URDF; `stated` are the keys that it describes of each joint group."""

    path: Path | None = None
    name: str | None = None
    gravity: float = 1.625
    timestep: float = 0.002
    solref: tuple[float, ...] = (0.004, 1.0)
    solimp: tuple[float, ...] = (0.999, 0.999, 0.001, 0.5, 2.0)
    passive_damping: float = 0.0
    wheels: tuple[WheelDescription, ...] = ()
    loops: tuple[LoopDescription, ...] = ()
    drive_groups: tuple[DriveGroupDescription, ...] = ()
    differentials: tuple[DifferentialDescription, ...] = ()
    groups: dict[str, GroupDescription] = field(default_factory=_default_groups)
    stated: Mapping[str, frozenset[str]] = field(default_factory=dict)


_TOP = {
    "name",
    "gravity",
    "timestep",
    "solref",
    "solimp",
    "passive_damping",
    "wheels",
    "loops",
    "drive_groups",
    "differentials",
    "joints",
}


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Reads a TOML file, or raises `UserError`."""
    return toml_fields.read_toml(require_file(path, what))


def read_description(path: str | Path) -> Description:
    """Reads a `<name>.rover.toml`.

    Raises:
      UserError: the file is missing or not TOML, or a key is unknown or has a wrong type or value.
    """
    path = Path(path)
    data = read_toml(path, "the rover description")
    check_keys(path, "", data, _TOP)
    given: dict[str, Any] = {"path": path}
    if "name" in data:
        given["name"] = text(path, "name", data["name"])
    for key in ("gravity", "timestep", "passive_damping"):
        if key in data:
            given[key] = at_least(path, key, data[key], 0.0, strict=key == "timestep")
    for key, count in (("solref", 2), ("solimp", 5)):
        if key in data:
            given[key] = numbers(path, key, data[key], count)
    given["wheels"] = tuple(_wheel(path, f"wheels[{i}]", w) for i, w in enumerate(tables(path, "wheels", data)))
    given["loops"] = tuple(_loop(path, f"loops[{i}]", x) for i, x in enumerate(tables(path, "loops", data)))
    driven = tables(path, "drive_groups", data)
    given["drive_groups"] = tuple(_drive_group(path, f"drive_groups[{i}]", g) for i, g in enumerate(driven))
    given["differentials"] = tuple(
        _differential(path, f"differentials[{i}]", d) for i, d in enumerate(tables(path, "differentials", data))
    )
    joints = data.get("joints", {})
    check_keys(path, "joints", joints, set(GROUPS))
    groups = _default_groups()
    for name, table in joints.items():
        # What a table leaves out keeps the group's default, not the class's.
        groups[name] = _group(path, f"joints.{name}", table, groups[name])
    return Description(**given, groups=groups, stated={name: frozenset(table) for name, table in joints.items()})


def _wheel(path: Path, where: str, table: Mapping[str, Any]) -> WheelDescription:
    check_keys(path, where, table, {"link", "corner", "radius", "width", "steer", "suspension"}, {"link"})
    lengths: dict[str, Any] = {
        k: at_least(path, f"{where}.{k}", table[k], 0.0, strict=True) for k in ("radius", "width") if k in table
    }
    names: dict[str, Any] = {
        k: text(path, f"{where}.{k}", table[k]) for k in ("link", "corner", "steer", "suspension") if k in table
    }
    return WheelDescription(**names, **lengths)


def _drive_group(path: Path, where: str, table: Mapping[str, Any]) -> DriveGroupDescription:
    check_keys(path, where, table, {"name", "wheels"}, {"name", "wheels"})
    wheels = table["wheels"]
    if not isinstance(wheels, list) or len(wheels) < 2:
        raise bad_input(path, f"{where}.wheels", wheels, "are not two or more corners", 'write ["lf", "lr"]')
    corners = tuple(text(path, f"{where}.wheels", corner) for corner in wheels)
    return DriveGroupDescription(text(path, f"{where}.name", table["name"]), corners)


def _differential(path: Path, where: str, table: Mapping[str, Any]) -> DifferentialDescription:
    check_keys(path, where, table, {"joint1", "joint2"}, {"joint1", "joint2"})
    first, second = (text(path, f"{where}.{k}", table[k]) for k in ("joint1", "joint2"))
    if first == second:
        raise bad_input(path, f"{where}.joint2", second, "is joint1, too", "name the pivot of the other side")
    return DifferentialDescription(first, second)


def _loop(path: Path, where: str, table: Mapping[str, Any]) -> LoopDescription:
    keys = {"link1", "link2", "anchor1", "anchor2"}
    check_keys(path, where, table, keys, keys)
    first, second = (numbers(path, f"{where}.{k}", table[k], 3) for k in ("anchor1", "anchor2"))
    return LoopDescription(
        text(path, f"{where}.link1", table["link1"]),
        text(path, f"{where}.link2", table["link2"]),
        (first[0], first[1], first[2]),
        (second[0], second[1], second[2]),
    )


def _group(path: Path, where: str, table: Mapping[str, Any], default: GroupDescription) -> GroupDescription:
    check_keys(path, where, table, set(GroupDescription.__dataclass_fields__))
    given: dict[str, Any] = {}
    for key, value in table.items():
        field_name = f"{where}.{key}"
        if key == "mode":
            given[key] = one_of(path, field_name, value, MODES)
        elif key == "winding":
            given[key] = one_of(path, field_name, value, WINDINGS)
        elif key == "spring_reference":
            given[key] = "level" if value == "level" else number(path, field_name, value)
        else:
            strict = key in ("gear_ratio", "gear_efficiency", *MOTOR_KEYS)
            given[key] = at_least(path, field_name, value, 0.0, strict=strict)
    if given.get("gear_efficiency", 1.0) > 1:
        raise bad_input(path, f"{where}.gear_efficiency", given["gear_efficiency"], "is above 1", "give a fraction")
    group = GroupDescription(**{**default.__dict__, **given})
    # Level is where a spring bears the weight; without one there is nothing to set.
    if group.spring_reference == "level" and group.stiffness == 0:
        raise bad_input(path, f"{where}.spring_reference", "level", "needs a spring", "give a stiffness above zero")
    return group


def check_keys(
    path: Path, where: str, table: Any, known: set[str], required: set[str] | frozenset[str] = frozenset()
) -> None:
    """Raises `UserError` unless `table` is a mapping with only `known` and all `required` keys."""
    prefix = f"{where}." if where else ""
    if not isinstance(table, Mapping):
        raise bad_input(path, where, table, "is not a table", f"give the keys {', '.join(sorted(known))}")
    for key in table:
        if key not in known:
            raise bad_input(
                path, f"{prefix}{key}", table[key], "is an unknown key", f"known here: {', '.join(sorted(known))}"
            )
    for key in sorted(required):
        if key not in table:
            raise bad_input(path, f"{prefix}{key}", "", "is missing", "add it")


def tables(path: Path, key: str, data: Mapping[str, Any]) -> list[Any]:
    """The array of tables under `key`, empty if absent."""
    value = data.get(key, [])
    if not isinstance(value, list):
        raise bad_input(path, key, value, "is not an array of tables", f"write [[{key}]]")
    return value


def text(path: Path, where: str, value: Any) -> str:
    """Returns a non-empty string, or raises `UserError`."""
    if not isinstance(value, str) or not value:
        raise bad_input(path, where, value, "is not a name", "give a text in quotes")
    return value


def texts(path: Path, where: str, value: Any) -> tuple[str, ...]:
    """Returns a list of texts as a tuple, or raises `UserError`."""
    if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
        raise bad_input(path, where, value, "is no list of texts", 'write ["one", "another"]')
    return tuple(value)


def number(path: Path, where: str, value: Any) -> float:
    """Returns a finite float, or raises `UserError`; a text or a truth value is not a number here."""
    # bool is an int to Python.
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise bad_input(path, where, value, "is not a number", "give a finite number")
    return require_finite(path, where, value)


def at_least(path: Path, where: str, value: Any, bound: float, strict: bool) -> float:
    """Returns a finite float that is at least (or, if `strict`, above) `bound`."""
    result = number(path, where, value)
    if result < bound or (strict and result == bound) or math.isnan(result):
        relation = "above" if strict else "of at least"
        raise bad_input(path, where, value, "is out of range", f"give a number {relation} {bound:g}")
    return result


def numbers(path: Path, where: str, value: Any, count: int) -> tuple[float, ...]:
    """Returns `count` finite floats."""
    if not isinstance(value, list) or len(value) != count:
        raise bad_input(path, where, value, f"is not a list of {count} numbers", f"give {count} numbers in brackets")
    return tuple(number(path, where, v) for v in value)


def one_of(path: Path, where: str, value: Any, choices: tuple[Any, ...]) -> Any:
    """Returns `value` if it is one of `choices`."""
    # True == 1 to Python, and would pass as a choice of numbers.
    if value not in choices or isinstance(value, bool):
        raise bad_input(path, where, value, "is not known", f"choose from {', '.join(map(str, choices))}")
    return value
