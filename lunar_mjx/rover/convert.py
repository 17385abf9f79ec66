"""Converts a URDF into a rover folder: MJCF with a free base, motors and closed loops, and `rover.toml` beside it."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import tomli_w
from scipy.spatial import ConvexHull, QhullError

from lunar_mjx.errors import UserError, bad_input, one_line
from lunar_mjx.files import replacing
from lunar_mjx.rover.couplings import place_couplings
from lunar_mjx.rover.description import GROUPS, HEAVIEST, Description, GroupDescription, read_description
from lunar_mjx.rover.load import FORMAT, MARKER, load_rover
from lunar_mjx.rover.loops import PlacedLoop, place_loops
from lunar_mjx.rover.mjcf import build_spec, scene_of, ties, to_xml
from lunar_mjx.rover.roles import Roles, assign_roles, without_followers
from lunar_mjx.rover.rover import DriveGroup, Rover
from lunar_mjx.rover.statics import gains, level_springs
from lunar_mjx.rover.tree import Body, bodies_of, world_poses
from lunar_mjx.rover.urdf import Geometry, Urdf, read_urdf


@dataclasses.dataclass(frozen=True)
class Conversion:
    """What the converter takes from shapes."""

    most_chassis_points: int = 16
    """Points of the chassis that may touch the ground: each costs a height in every step."""
    farthest_m: float = 1e3
    """m between a link and the base: no rover is as long as that."""
    level: float = 1e-3
    """m; wheels whose lowest points differ by more do not stand level."""


CONVERSION = Conversion()


DESCRIPTION_SUFFIX = ".rover.toml"


def convert(urdf: str | Path, out: str | Path, description: str | Path | None = None, name: str | None = None) -> Rover:
    """Converts a URDF and writes `<name>.xml`, `scene.xml` and `rover.toml`.

    Args:
      urdf: the URDF. Forward is +x, up is +z, as REP 103 has it.
      out: folder to write; made if absent.
      description: what URDF cannot say (loops, motors, springs, controls, roles; see `description.py`). By default the
        file beside the URDF called `<stem>.rover.toml`, if there is one; without it, everything is inferred.
      name: name of the rover; by default the description's, or else the URDF's.

    Returns:
      The rover, loaded from `out`.

    Raises:
      UserError: a file is missing or broken, or the URDF lacks what a rover needs; nothing is written then.
    """
    source = read_urdf(urdf)
    # Roles first, then loops and couplings: these are told in the bodies' final axes, which roles may reverse.
    described = _describe(source, description)
    name = _file_name(source, name or described.name or source.name)
    bodies = bodies_of(source)
    _require_near(source, bodies)
    roles = without_followers(source, assign_roles(source, bodies, described))
    loops = place_loops(source, roles.bodies, described)
    driven = place_drive_groups(source, roles, described)
    couplings = place_couplings(source, roles.bodies, described)
    height, height_notes = _standing_height(roles)
    try:
        spec = build_spec(name, roles, loops, described, height, driven, couplings)
    except ValueError as error:
        raise _uncompilable(source, error) from None
    try:
        with warnings.catch_warnings():
            # MuJoCo warns of inertia that is next to singular; numbers computed from it would be noise
            warnings.simplefilter("error")
            model = _compile(source, spec)
            # Compiled twice: springs follow from weights that only the compiled model knows.
            level_springs(spec, model, roles, described)
            model = _compile(source, spec)
            xml = to_xml(spec)
            # What is compared with the URDF is the text as anyone will read it, not the model in memory.
            again = mujoco.MjModel.from_xml_string(xml)
            _assert_nothing_lost(source, roles, loops, ties(driven) + len(couplings), again)
            # From the compiled model: what the record says of masses and gains is what MuJoCo will simulate.
            record = _record(source, name, roles, loops, described, model, height, height_notes, driven)
    except Warning as error:
        raise _uncompilable(source, error) from None
    if record["mass"] > HEAVIEST:
        remedy = "correct the masses of the links, which are in kg"
        raise bad_input(source.path, "mass", record["mass"], f"is above {HEAVIEST:g} kg", remedy)
    # Before anything is written, since a rover that lies there is to stay whole.
    _require_numbers(source, "", record)
    out = Path(out)
    title = f"# Written by `lunar-mjx convert` from {source.path.name}; edit that and convert again.\n"
    try:
        out.mkdir(parents=True, exist_ok=True)
        # all or none: a description beside the MJCF of another rover would be a third one
        with (
            replacing(out / f"{name}.xml") as model_part,
            replacing(out / "scene.xml") as scene_part,
            replacing(out / MARKER) as record_part,
        ):
            model_part.write_text(xml, encoding="utf-8")
            scene_part.write_text(scene_of(name), encoding="utf-8")
            record_part.write_text(title + _compact(tomli_w.dumps(record)), encoding="utf-8")
    except OSError as error:
        raise UserError(f"{out}: cannot be written ({error.strerror}); give another output folder.") from None
    # Loaded as users will: what was just written must pass every check of a foreign file.
    return load_rover(out.resolve())


def _require_near(source: Urdf, bodies: tuple[Body, ...]) -> None:
    """Raises `UserError` for a link so far away that weights on levers overflow."""
    for link, pose in world_poses(bodies).items():
        if not np.abs(pose.position).max() <= CONVERSION.farthest_m:
            problem = f"is more than {CONVERSION.farthest_m:g} m from the base"
            shown = np.array2string(pose.position, precision=3)
            raise bad_input(source.path, f"link '{link}' position", shown, problem, "correct the origins, in m")


def _require_numbers(source: Urdf, field: str, value: Any) -> None:
    """Raises `UserError` for a number of the record that is not finite."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _require_numbers(source, f"{field}.{key}".lstrip("."), inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            _require_numbers(source, field, inner)
    elif isinstance(value, float) and not math.isfinite(value):
        remedy = "correct the sizes, masses and origins of the links, which are in m and kg"
        raise bad_input(source.path, field, value, "is what the rover would come out with", remedy)


def _compact(text: str) -> str:
    """Puts arrays of numbers on one line, which the TOML writer spreads over several."""
    numbers = re.compile(r"\[\s+([-+.\de,\s]+?),\s+\]")
    return numbers.sub(lambda match: f"[{', '.join(match[1].replace(',', ' ').split())}]", text)


def _describe(urdf: Urdf, description: str | Path | None) -> Description:
    beside = urdf.path.with_name(urdf.path.stem + DESCRIPTION_SUFFIX)
    if description is not None:
        return read_description(description)
    return read_description(beside) if beside.is_file() else Description()


def _file_name(urdf: Urdf, name: str) -> str:
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name) or name == "scene":
        raise bad_input(urdf.path, "name", name, "cannot name a file", "use letters, digits, _ and - (and not 'scene')")
    return name


def _compile(urdf: Urdf, spec: mujoco.MjSpec) -> mujoco.MjModel:
    try:
        return spec.compile()
    except ValueError as error:
        raise _uncompilable(urdf, error) from None


def _uncompilable(urdf: Urdf, error: Exception) -> UserError:
    reason = one_line(error)
    return UserError(f"{urdf.path}: MuJoCo cannot compile the converted model ({reason}); mend the URDF.")


def _standing_height(roles: Roles) -> tuple[float, list[str]]:
    """Height of the base frame above the plane under the lowest wheel, in m."""
    bottoms = np.array([w.center[2] - w.radius for w in roles.wheels])
    notes = []
    if np.ptp(bottoms) > CONVERSION.level:
        notes.append(f"the wheels' lowest points differ by {1e3 * np.ptp(bottoms):.1f} mm at zero angles")
    # Rounded to a nanometre, so that a file does not differ between machines in its last digit.
    return round(float(-bottoms.min()), 9), notes


def _assert_nothing_lost(
    urdf: Urdf, roles: Roles, loops: tuple[PlacedLoop, ...], ratios: int, model: mujoco.MjModel
) -> None:
    """Compares the MJCF, read back from its text, with the URDF.

    Raises:
      UserError: mass, joints, limits, inertia, motors or loops of the MJCF are not the URDF's.
    """
    expected = sum(link.mass for link in urdf.links.values())
    total = float(model.body_mass.sum())
    # The text keeps twelve digits; a lost link is grams.
    if abs(total - expected) > 1e-9 * expected:
        raise bad_input(
            urdf.path, "total mass", f"{expected:.12g} kg", f"became {total:.12g} kg in the MJCF", "report this"
        )
    joints = {b.joint.name: b.joint for b in roles.bodies if b.joint is not None}
    moving = {j.name for j in urdf.joints if j.kind not in ("fixed", "floating")}
    compiled_joints = {model.joint(i).name for i in range(model.njnt)} - {"free"}
    if compiled_joints != moving or set(joints) != moving:
        raise bad_input(urdf.path, "joints", sorted(moving ^ compiled_joints), "were lost or invented", "report this")
    for joint in joints.values():
        limits = joint.limits if np.isfinite(joint.limits).all() else (0.0, 0.0)
        if not np.allclose(model.joint(joint.name).range, limits, rtol=0, atol=1e-9):
            raise bad_input(urdf.path, f"joint '{joint.name}' limit", limits, "was lost in the MJCF", "report this")
    if model.body_mass[1:].min() <= 0 or model.body_inertia[1:].min() <= 0:
        raise bad_input(urdf.path, "inertia", model.body_inertia[1:].min(), "is not positive", "report this")
    motors = [model.actuator(i).name for i in range(model.nu)]
    if motors != [j for g in GROUPS for j in roles.group(g)] or model.neq != len(loops) + ratios:
        raise bad_input(urdf.path, "motors", ", ".join(motors), "are not one for each joint in a role", "report this")


def _record(
    urdf: Urdf,
    name: str,
    roles: Roles,
    loops: tuple[PlacedLoop, ...],
    description: Description,
    model: mujoco.MjModel,
    height: float,
    notes: list[str],
    driven: tuple[DriveGroup, ...],
) -> dict[str, Any]:
    """The contents of `rover.toml`."""
    base = roles.bodies[0]
    # Points, not meshes: contact costs a height each, and a hull's corners touch first.
    points, point_notes = _chassis_points(base, roles)
    wheels = []
    for w in roles.wheels:
        entry = {"corner": w.corner, "body": w.body, "radius": w.radius, "width": w.width, "drive": w.drive}
        entry.update({k: getattr(w, k) for k in ("steer", "suspension") if getattr(w, k) is not None})
        wheels.append(entry)
    groups = {}
    for group in GROUPS:
        if not roles.group(group):
            continue
        group_fields, gain = description.groups[group], gains(model, roles, description, group)
        groups[group] = {
            "joints": list(roles.group(group)),
            "mode": group_fields.mode,
            "position_gain": gain.position,
            "velocity_gain": gain.velocity,
            "gear_ratio": group_fields.gear_ratio,
            "gear_efficiency": group_fields.gear_efficiency,
            "rotor_inertia": group_fields.rotor_inertia_kg_m2,
            "winding": group_fields.winding,
        }
        motor = ("torque_constant", group_fields.torque_constant_Nm_A), ("resistance", group_fields.resistance_ohm)
        stated = {k: v for k, v in (*motor, ("current_limit", group_fields.current_limit_A)) if v is not None}
        groups[group].update(stated)
        notes += _assumed(group, group_fields, description.stated.get(group, frozenset()))
    return {
        "format": FORMAT,
        "name": name,
        "source": urdf.path.name,
        "mjcf": f"{name}.xml",
        "mass": float(f"{model.body_mass.sum():.12g}"),
        "standing_height": height,
        "gravity": description.gravity,
        "chassis": base.name,
        # Plus zero, since -0.0 would be written as such.
        "chassis_points": [[round(float(v), 6) + 0.0 for v in p] for p in points],
        "notes": [*urdf.notes, *roles.notes, *_passive_notes(roles, loops), *notes, *point_notes],
        "groups": groups,
        "wheels": wheels,
        **({"drive_groups": [{"name": g.name, "joints": list(g.joints)} for g in driven]} if driven else {}),
        "loops": [
            {
                "body1": x.body1,
                "body2": x.body2,
                "anchor1": [float(v) for v in x.anchor1],
                "anchor2": [float(v) for v in x.anchor2],
            }
            for x in loops
        ],
    }


def _assumed(group: str, fields: GroupDescription, stated: frozenset[str]) -> list[str]:
    """What of a joint group's torque for a current nobody stated: its motor, its gear, or both."""
    motor = stated.isdisjoint(("winding", "torque_constant_Nm_A"))
    gear = "gear_ratio" not in stated
    if not motor and not gear:
        return []
    named = f"the motor maxon ECX TORQUE 22 XL, {fields.winding} V"
    what = " behind ".join([named] * motor + [f"a gear of {fields.gear_ratio:g}"] * gear)
    keys = " and ".join(["torque_constant_Nm_A (or winding)"] * motor + ["gear_ratio"] * gear)
    return [f"{group}: assumed {what}; state {keys} in [joints.{group}] of the description"]


def place_drive_groups(urdf: Urdf, roles: Roles, description: Description) -> tuple[DriveGroup, ...]:
    """The drive joints of every group of wheels that share a motor.

    Raises:
      UserError: a corner that no wheel has, or that is in two groups.
    """
    joints = {w.corner: w.drive for w in roles.wheels}
    placed: list[str] = []
    groups = []
    for i, group in enumerate(description.drive_groups):
        for corner in group.wheels:
            if corner not in joints or corner in placed:
                reason = "is in two groups" if corner in placed else "is no wheel of the rover"
                raise bad_input(
                    description.path or urdf.path,
                    f"drive_groups[{i}].wheels",
                    corner,
                    reason,
                    f"use {', '.join(joints)}, each once",
                )
            placed.append(corner)
        groups.append(DriveGroup(group.name, tuple(joints[c] for c in group.wheels)))
    return tuple(groups)


def _passive_notes(roles: Roles, loops: tuple[PlacedLoop, ...]) -> list[str]:
    """A sentence for each joint that nothing moves or stops, but for those of closed loops and those noted already."""
    parents = {b.name: b.parent for b in roles.bodies}
    guided: set[str | None] = {body for loop in loops for body in (loop.body1, loop.body2)}
    for name in list(guided):
        # A loop guides every link of the chain that it closes, up to the base.
        while name is not None:
            guided.add(name)
            name = parents[name]
    moved = {joint for group in GROUPS for joint in roles.group(group)}
    notes = " ".join(roles.notes)
    free = [b.joint.name for b in roles.bodies if b.joint is not None and b.name not in guided]
    return [
        f"joint '{joint}' drives, steers or suspends no wheel: it has no motor and moves freely beyond its limits"
        for joint in free
        if joint not in moved and f"'{joint}'" not in notes
    ]


def _chassis_points(base: Body, roles: Roles) -> tuple[np.ndarray, list[str]]:
    """At most 16 points (k, 3) of the base's convex hull, so that it neither sinks into ground nor rolls through it."""
    corners = np.array([c for shape in base.geometry for c in _box_corners(shape)])
    notes = []
    if not len(corners):
        centers = np.array([w.center for w in roles.wheels])
        low, high = centers.min(axis=0), centers.max(axis=0)
        # Wheel centres are all at one height; a wheel's diameter gives the box some.
        high[2] = low[2] + max(w.radius for w in roles.wheels) * 2
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        notes.append("the chassis has no primitive shape: its contact points are the box between the wheel centres")
    # Shapes share corners; equal ones would spend the few points that are kept.
    corners = np.unique(np.round(corners, 6), axis=0)
    # A flat chassis has no hull of volume; all its corners are on the outside then.
    with contextlib.suppress(QhullError):
        corners = corners[np.sort(ConvexHull(corners).vertices)]
    if len(corners) > CONVERSION.most_chassis_points:
        corners = _farthest(corners, CONVERSION.most_chassis_points)
    return corners, notes


def _box_corners(shape: Geometry) -> list[np.ndarray]:
    """The eight corners (3,) of the shape's bounding box, in the body frame."""
    if shape.kind == "box":
        half = np.array(shape.size) / 2
    elif shape.kind == "cylinder":
        half = np.array([shape.size[0], shape.size[0], shape.size[1] / 2])
    else:
        # A sphere's box; its corners lie outside it, which errs on the side of touching early.
        half = np.full(3, shape.size[0])
    return [shape.pose.apply(half * [x, y, z]) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]


def _farthest(points: np.ndarray, count: int) -> np.ndarray:
    """`count` of the points, each the farthest from those taken before, in the order given."""
    # Rounded: distances that are equal by symmetry would be ordered by the machine's last digit.
    distance = np.round(np.linalg.norm(points - points.mean(axis=0), axis=1), 9)
    chosen: list[int] = []
    for _ in range(count):
        chosen.append(int(np.argmax(distance)))
        step = np.round(np.linalg.norm(points - points[chosen[-1]], axis=1), 9)
        distance = step if len(chosen) == 1 else np.minimum(distance, step)
    # In the order given, so that files do not depend on the order of choice.
    return points[np.sort(chosen)]
