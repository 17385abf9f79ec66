"""Loads a converted rover by name or path and checks that its files agree."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.errors import UserError, bad_input, one_line, require_file, require_name
from lunar_mjx.resources import find, shipped
from lunar_mjx.rover import description as toml
from lunar_mjx.rover.description import GROUPS, HEAVIEST, LARGEST, MODES, WINDINGS
from lunar_mjx.rover.fields import check_sizes, refuse_impossible_fields, refuse_unused_fields
from lunar_mjx.rover.rover import DriveGroup, JointGroup, Loop, Rover, Wheel

FORMAT = "lunar-mjx-rover/1"
MARKER = "rover.toml"


@dataclasses.dataclass(frozen=True)
class Agreement:
    """How closely the two files of a rover must agree: both are written with twelve digits or more."""

    mass: float = 1e-9
    """Relative difference of the total masses."""
    gravity: float = 1e-9
    """Difference of the gravities, m/s2: rounding in the two files."""


AGREEMENT = Agreement()


_CONVERT_AGAIN = "convert the URDF again"
_TOP = {
    "format",
    "name",
    "source",
    "mjcf",
    "mass",
    "standing_height",
    "chassis",
    "chassis_points",
    "notes",
    "wheels",
    "groups",
    "loops",
    "drive_groups",
    "gravity",
}
_MOTOR_KEYS = ("torque_constant", "resistance", "current_limit")
_GROUP_KEYS = set(JointGroup.__dataclass_fields__) - {"name"}


def list_rovers() -> tuple[str, ...]:
    """Names of the rovers that ship with the package."""
    return tuple(sorted(p.parent.name for p in shipped("models").glob(f"*/{MARKER}")))


def load_rover(name_or_path: str | Path) -> Rover:
    """The rover of a name or folder, checked.

    Args:
      name_or_path: name of a shipped rover, or the path of a folder that `convert` wrote.

    Returns:
      The rover.

    Raises:
      UserError: no such rover, or its `rover.toml` and MJCF are broken or disagree.
    """
    folder = find("models", name_or_path, MARKER)
    path = folder / MARKER
    data = toml.read_toml(path, "the rover file")
    toml.check_keys(path, "", data, _TOP, _TOP - {"source", "notes", "loops", "drive_groups", "gravity"})
    toml.one_of(path, "format", data["format"], (FORMAT,))
    file = toml.text(path, "mjcf", data["mjcf"])
    # A path would let a rover's folder name files elsewhere.
    if Path(file).name != file:
        raise bad_input(path, "mjcf", file, "is not the name of a file beside it", _CONVERT_AGAIN)
    mjcf = require_file(folder / file, "the rover's MJCF")
    try:
        mjcf.read_bytes().decode("utf-8")  # MuJoCo takes any bytes for names, and gives them back as text
    except UnicodeDecodeError:
        raise UserError(f"{mjcf}: is not a text file in UTF-8; {_CONVERT_AGAIN}.") from None
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # such as of inertia matrices that are next to singular
            model = mujoco.MjSpec.from_file(str(mjcf)).compile()
    except (ValueError, Warning) as error:
        reason = one_line(error)
        raise UserError(f"{mjcf}: MuJoCo cannot compile it ({reason}); {_CONVERT_AGAIN}.") from None
    # Before anything is read: a field that would be ignored makes another rover.
    refuse_unused_fields(mjcf, model)
    refuse_impossible_fields(mjcf, model)
    mass = toml.at_least(path, "mass", data["mass"], 0.0, strict=True)
    if mass > HEAVIEST:
        raise bad_input(path, "mass", mass, f"is above {HEAVIEST:g} kg", "correct the masses, which are in kg")
    total = float(model.body_mass.sum())
    if abs(total - mass) > AGREEMENT.mass * mass:
        raise bad_input(path, "mass", mass, f"is not the {total:.12g} kg of {mjcf.name}: mass was lost", _CONVERT_AGAIN)
    bodies = {model.body(i).name for i in range(1, model.nbody)}
    joints = {model.joint(i).name for i in range(model.njnt)}
    wheels = tuple(_wheel(path, f"wheels[{i}]", w, bodies, joints) for i, w in enumerate(_list(path, "wheels", data)))
    groups = _groups(path, data["groups"], model)
    _check_wheels_against_groups(path, wheels, groups)
    _check_wheels_against_tree(path, model, wheels, groups)
    points = [
        toml.numbers(path, f"chassis_points[{i}]", p, 3) for i, p in enumerate(_list(path, "chassis_points", data))
    ]
    for i, point in enumerate(points):
        if max(map(abs, point)) > LARGEST:
            problem = f"is more than {LARGEST:g} m from the chassis"
            raise bad_input(path, f"chassis_points[{i}]", list(point), problem, "give it in m")
    chassis = _known(path, "chassis", data["chassis"], bodies, "body")
    if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
        raise UserError(f"{mjcf}: its first joint is not free, so that the rover could not drive; {_CONVERT_AGAIN}.")
    if model.jnt_bodyid[0] != model.body(chassis).id:
        raise bad_input(path, "chassis", chassis, "is not the body of the free joint", _CONVERT_AGAIN)
    standing_height = toml.number(path, "standing_height", data["standing_height"])
    check_sizes(path, model, wheels, standing_height)
    gravity, notes = _gravity(path, data, model)
    return Rover(
        name=require_name(path, "name", data["name"], "give a text in quotes"),
        folder=folder,
        mjcf=mjcf,
        wheels=wheels,
        groups=groups,
        joint_limits=_limits(model),
        chassis=chassis,
        chassis_points=np.array(points),
        loops=tuple(_loop(path, f"loops[{i}]", x, bodies) for i, x in enumerate(toml.tables(path, "loops", data))),
        mass=mass,
        standing_height=standing_height,
        notes=(*toml.texts(path, "notes", data.get("notes", [])), *notes),
        drive_groups=_drive_groups(path, toml.tables(path, "drive_groups", data), model, {w.drive for w in wheels}),
        gravity=gravity,
        timestep=float(model.opt.timestep),
    )


def _gravity(path: Path, data: Mapping[str, Any], model: mujoco.MjModel) -> tuple[float | None, tuple[str, ...]]:
    """Gravity of the file, which must be the MJCF's, and what is to be said about it."""
    mjcf = model.opt.gravity
    if "gravity" not in data:
        return None, (f"the MJCF's gravity {np.linalg.norm(mjcf):g} m/s2 is not used: rover.toml states none",)
    gravity = toml.at_least(path, "gravity", data["gravity"], 0.0, strict=False)
    # MuJoCo's viewer would show another weight than the library simulates.
    if np.abs(mjcf - [0.0, 0.0, -gravity]).max() > AGREEMENT.gravity:
        shown = " ".join(f"{v:g}" for v in mjcf)
        raise bad_input(path, "gravity", gravity, f'is not the MJCF\'s gravity="{shown}"', _CONVERT_AGAIN)
    return gravity, ()


def _list(path: Path, key: str, data: Mapping[str, Any]) -> list[Any]:
    values = toml.tables(path, key, data)
    if not values:
        raise bad_input(path, key, values, "is empty", _CONVERT_AGAIN)
    return values


def _known(path: Path, where: str, value: Any, names: set[str], what: str) -> str:
    name = toml.text(path, where, value)
    if name not in names:
        raise bad_input(path, where, name, f"is not a {what} of the MJCF", f"correct the name or {_CONVERT_AGAIN}")
    return name


def _wheel(path: Path, where: str, table: Any, bodies: set[str], joints: set[str]) -> Wheel:
    known = set(Wheel.__dataclass_fields__)
    toml.check_keys(path, where, table, known, known - {"steer", "suspension"})
    roles = {k: _known(path, f"{where}.{k}", table[k], joints, "joint") for k in ("steer", "suspension") if k in table}
    width = toml.at_least(path, f"{where}.width", table["width"], 0.0, strict=True)
    if width > LARGEST:
        raise bad_input(path, f"{where}.width", width, f"is above {LARGEST:g} m", "give it in m")
    return Wheel(
        corner=require_name(path, f"{where}.corner", table["corner"], "call it lf, rf, lr or rr"),
        body=_known(path, f"{where}.body", table["body"], bodies, "body"),
        radius=toml.at_least(path, f"{where}.radius", table["radius"], 0.0, strict=True),
        width=width,
        drive=_known(path, f"{where}.drive", table["drive"], joints, "joint"),
        steer=roles.get("steer"),
        suspension=roles.get("suspension"),
    )


def _groups(path: Path, data: Any, model: mujoco.MjModel) -> tuple[JointGroup, ...]:
    """Reads the groups and checks that their joints, in order, are the MJCF's actuators."""
    toml.check_keys(path, "groups", data, set(GROUPS), {"drive"})
    actuators = [model.actuator(i).name for i in range(model.nu)]
    groups = []
    for name in (g for g in GROUPS if g in data):
        table, field = data[name], f"groups.{name}"
        toml.check_keys(path, field, table, _GROUP_KEYS, _GROUP_KEYS - set(_MOTOR_KEYS))
        efficiency = toml.at_least(path, f"{field}.gear_efficiency", table["gear_efficiency"], 0.0, strict=True)
        if efficiency > 1.0:
            raise bad_input(path, f"{field}.gear_efficiency", efficiency, "is above 1", "give a fraction")
        motor = {k: toml.at_least(path, f"{field}.{k}", table[k], 0.0, strict=True) for k in _MOTOR_KEYS if k in table}
        groups.append(
            JointGroup(
                name=name,
                joints=tuple(
                    _known(path, f"{field}.joints", j, set(actuators), "motor") for j in _list(path, "joints", table)
                ),
                mode=toml.one_of(path, f"{field}.mode", table["mode"], MODES),
                position_gain=toml.at_least(path, f"{field}.position_gain", table["position_gain"], 0.0, strict=False),
                velocity_gain=toml.at_least(path, f"{field}.velocity_gain", table["velocity_gain"], 0.0, strict=False),
                gear_ratio=toml.at_least(path, f"{field}.gear_ratio", table["gear_ratio"], 0.0, strict=True),
                gear_efficiency=efficiency,
                rotor_inertia=toml.at_least(path, f"{field}.rotor_inertia", table["rotor_inertia"], 0.0, strict=False),
                winding=toml.one_of(path, f"{field}.winding", table["winding"], WINDINGS),
                **motor,
            )
        )
    listed = [joint for group in groups for joint in group.joints]
    # In order, since controls are arrays without names.
    if listed != actuators:
        motors = ", ".join(actuators)
        raise bad_input(path, "groups joints", ", ".join(listed), f"are not the motors {motors}", _CONVERT_AGAIN)
    return tuple(groups)


def _check_wheels_against_groups(path: Path, wheels: tuple[Wheel, ...], groups: tuple[JointGroup, ...]) -> None:
    driven = next(g.joints for g in groups if g.name == "drive")
    if tuple(w.drive for w in wheels) != driven:
        raise bad_input(path, "groups.drive.joints", ", ".join(driven), "are not the wheels' joints", _CONVERT_AGAIN)


def _check_wheels_against_tree(
    path: Path, model: mujoco.MjModel, wheels: tuple[Wheel, ...], groups: tuple[JointGroup, ...]
) -> None:
    """Holds names of corners apart, and each wheel's joints against the MJCF and the groups."""
    motors = {group.name: group.joints for group in groups}
    for i, wheel in enumerate(wheels):
        where = f"wheels[{i}]"
        if [w.corner for w in wheels].count(wheel.corner) > 1:
            raise bad_input(path, f"{where}.corner", wheel.corner, "is the corner of two wheels", "give each its own")
        if model.jnt_bodyid[model.joint(wheel.drive).id] != model.body(wheel.body).id:
            raise bad_input(path, f"{where}.body", wheel.body, f"is not what {wheel.drive} turns", _CONVERT_AGAIN)
        for role, joint in (("steer", wheel.steer), ("suspension", wheel.suspension)):
            if joint is not None and joint not in motors.get(role, ()):
                problem = f"is no joint of groups.{role}"
                raise bad_input(path, f"{where}.{role}", joint, problem, f"correct the name or {_CONVERT_AGAIN}")
            # Where loops are closed, a linkage may turn a wheel from a branch of its own.
            if joint is not None and not model.neq and not _carries(model, joint, wheel.body):
                raise bad_input(path, f"{where}.{role}", joint, f"does not carry {wheel.body}", _CONVERT_AGAIN)


def _carries(model: mujoco.MjModel, joint: str, body: str) -> bool:
    """Whether a body hangs on a joint in the MJCF's tree."""
    carrier, at = int(model.jnt_bodyid[model.joint(joint).id]), int(model.body(body).id)
    while at not in (0, carrier):
        at = int(model.body_parentid[at])
    return at == carrier


def _drive_groups(path: Path, entries: list[Any], model: mujoco.MjModel, driven: set[str]) -> tuple[DriveGroup, ...]:
    """Reads wheels that share a motor: the MJCF must tie them, and no wheel has two motors."""
    equalities = np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT)
    tied = {
        frozenset(model.joint(int(k)).name for k in (model.eq_obj1id[e], model.eq_obj2id[e]) if k >= 0)
        for e in equalities
    }
    groups: list[DriveGroup] = []
    for i, table in enumerate(entries):
        where = f"drive_groups[{i}]"
        toml.check_keys(path, where, table, {"name", "joints"}, {"name", "joints"})
        joints = tuple(_known(path, f"{where}.joints", j, driven, "drive joint") for j in _list(path, "joints", table))
        shown = ", ".join(joints)
        if len(set(joints)) < len(joints) or any(set(joints) & set(g.joints) for g in groups):
            raise bad_input(path, f"{where}.joints", shown, "name a joint twice", "name each wheel's joint once")
        # A motor's inertia and current are shared between wheels that turn together; without a tie they do not.
        if any(frozenset((joints[0], joint)) not in tied for joint in joints[1:]):
            raise bad_input(path, f"{where}.joints", shown, "are not tied in the MJCF", _CONVERT_AGAIN)
        groups.append(DriveGroup(toml.text(path, f"{where}.name", table["name"]), joints))
    return tuple(groups)


def _loop(path: Path, where: str, table: Any, bodies: set[str]) -> Loop:
    known = set(Loop.__dataclass_fields__)
    toml.check_keys(path, where, table, known, known)
    first, second = (toml.numbers(path, f"{where}.{k}", table[k], 3) for k in ("anchor1", "anchor2"))
    return Loop(
        _known(path, f"{where}.body1", table["body1"], bodies, "body"),
        _known(path, f"{where}.body2", table["body2"], bodies, "body"),
        (first[0], first[1], first[2]),
        (second[0], second[1], second[2]),
    )


def _limits(model: mujoco.MjModel) -> dict[str, tuple[float, float]]:
    """Limits of every joint but the free one; MuJoCo keeps an unlimited joint's range as 0 0."""
    limits = {}
    for i in range(model.njnt):
        if model.jnt_type[i] == mujoco.mjtJoint.mjJNT_FREE:
            continue
        low, high = (float(v) for v in model.jnt_range[i])
        limits[model.joint(i).name] = (low, high) if (low, high) != (0.0, 0.0) else (-np.inf, np.inf)
    return limits
