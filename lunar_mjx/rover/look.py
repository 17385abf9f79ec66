"""What the eye sees of a rover: parts of `look.toml` in its folder, in place of the plain shapes of its MJCF.

Physics never reads this file: masses, inertias, collision shapes and the points that ground can touch stay those of the
MJCF. A rover without the file is seen as its plain shapes.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.rover.description import LARGEST, at_least, check_keys, numbers, one_of, read_toml, tables, text
from lunar_mjx.rover.rover import Rover

FILE = "look.toml"


@dataclasses.dataclass(frozen=True)
class Look:
    """How a rover's parts are drawn."""

    hidden: int = 3
    """MuJoCo's convention: geoms of this group and above are not for the eye."""
    detail: int = 2
    """Group of parts too small for a picture of 64 x 48: drawn by OpenGL, and in JAX where detail is asked for."""
    most_parts: int = 2000
    """Geoms of a rover's look: beyond it, pictures take longer than the physics."""


LOOK = Look()

_KINDS = {
    "box": (mujoco.mjtGeom.mjGEOM_BOX, 3),
    "cylinder": (mujoco.mjtGeom.mjGEOM_CYLINDER, 2),
    "capsule": (mujoco.mjtGeom.mjGEOM_CAPSULE, 2),
    "ellipsoid": (mujoco.mjtGeom.mjGEOM_ELLIPSOID, 3),
}
"""MuJoCo's type, and how many lengths say its size: full sides or axes; or radius and length."""
_AXES = {"x": 0, "y": 1, "z": 2}


def seen_spec(rover: Rover) -> mujoco.MjSpec:
    """A fresh `MjSpec` of a rover as the eye sees it, free to be edited; its bodies and joints are those of `spec()`.

    Raises:
      UserError: its `look.toml` is broken, or names a body that the rover has not.
    """
    spec = rover.spec()
    path = rover.folder / FILE
    if not path.is_file():
        return spec
    data = read_toml(path, "the rover's look")
    check_keys(path, "", data, {"format", "colours", "plain", "parts"}, {"format", "parts"})
    one_of(path, "format", data["format"], ("lunar-mjx-look/1",))
    colours = _colours(path, data.get("colours", {}))
    bodies = {b.name: b for b in spec.bodies}
    for name in _names(path, "plain", data.get("plain", []), bodies):
        for geom in bodies[name].geoms:
            # Hidden and not deleted: the physics may use the plain shape, and the eye sees the parts in its place.
            geom.group = LOOK.hidden
    count = 0
    for i, part in enumerate(tables(path, "parts", data)):
        count += _add(path, f"parts[{i}]", part, bodies, colours)
        if count > LOOK.most_parts:
            raise bad_input(
                path, f"parts[{i}]", count, f"geoms are more than {LOOK.most_parts}", "leave small parts out"
            )
    return spec


def _add(path: Path, where: str, part: Any, bodies: dict[str, Any], colours: dict[str, tuple[float, ...]]) -> int:
    """Adds a part to each of its bodies, as often as it is repeated; returns how many geoms that are."""
    known = {"bodies", "kind", "size", "at", "axis", "tilt_deg", "colour", "detail", "ring", "about"}
    check_keys(path, where, part, known, {"bodies", "kind", "size", "colour"})
    kind, lengths = _KINDS[one_of(path, f"{where}.kind", part["kind"], tuple(_KINDS))]
    size = np.array([at_least(path, f"{where}.size", v, 0.0, strict=True) for v in _list(path, where, part, lengths)])
    # MuJoCo counts half sides and half lengths; the file has whole ones, as drawings do.
    half = 0.5 * size if lengths == 3 else np.array([size[0], 0.5 * size[1], 0.0])
    at = np.array(numbers(path, f"{where}.at", part.get("at", [0.0, 0.0, 0.0]), 3))
    tilt = np.radians(numbers(path, f"{where}.tilt_deg", part.get("tilt_deg", [0.0, 0.0, 0.0]), 3))
    axis = _AXES[one_of(path, f"{where}.axis", part.get("axis", "z"), tuple(_AXES))]
    about = _AXES[one_of(path, f"{where}.about", part.get("about", "y"), tuple(_AXES))]
    ring = part.get("ring", 1)
    if not isinstance(ring, int) or isinstance(ring, bool) or not 1 <= ring <= 200:
        raise bad_input(path, f"{where}.ring", ring, "is no number of copies", "give a whole number from 1 to 200")
    colour = one_of(path, f"{where}.colour", part["colour"], tuple(colours))
    detail = part.get("detail", False)
    if not isinstance(detail, bool):
        raise bad_input(path, f"{where}.detail", detail, "is neither true nor false", "write true for a small part")
    if max(size.max(), np.abs(at).max()) > LARGEST:
        raise bad_input(path, f"{where}.size, at", f"{size} at {at}", f"is beyond {LARGEST:g} m", "give lengths in m")
    turned = [[0.0, 0.5 * math.pi, 0.0], [-0.5 * math.pi, 0.0, 0.0], [0.0, 0.0, 0.0]][axis]
    own = _turn(tilt) @ _turn(np.array(turned))
    names = _names(path, f"{where}.bodies", part["bodies"], bodies)
    for name in names:
        for copy in range(ring):
            angle = np.zeros(3)
            angle[about] = 2.0 * math.pi * copy / ring
            turn = _turn(angle)
            quaternion = np.zeros(4)
            mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(turn @ own).reshape(9))
            bodies[name].add_geom(
                type=kind,
                size=half,
                pos=turn @ at,
                quat=quaternion,
                rgba=[*colours[colour], 1.0],
                group=LOOK.detail if detail else 1,
                # Paint: a part of the look changes neither inertia nor contact.
                mass=0.0,
                contype=0,
                conaffinity=0,
            )
    return ring * len(names)


def _list(path: Path, where: str, part: dict[str, Any], count: int) -> tuple[float, ...]:
    return tuple(numbers(path, f"{where}.size", part["size"], count))


def _names(path: Path, where: str, value: Any, bodies: dict[str, Any]) -> list[str]:
    if not isinstance(value, list):
        raise bad_input(path, where, value, "is no list of bodies", 'write ["chassis"]')
    return [one_of(path, where, text(path, where, name), tuple(bodies)) for name in value]


def _colours(path: Path, table: Any) -> dict[str, tuple[float, ...]]:
    """Colours as shown on a screen, 0 to 1, by name."""
    if not isinstance(table, dict):
        raise bad_input(path, "colours", table, "is not a table", "write grey = [0.5, 0.5, 0.5]")
    colours = {name: tuple(numbers(path, f"colours.{name}", value, 3)) for name, value in table.items()}
    for name, value in colours.items():
        if not all(0.0 <= v <= 1.0 for v in value):
            raise bad_input(path, f"colours.{name}", list(value), "is outside 0 to 1", "give red, green and blue")
    return colours


def _turn(angles: np.ndarray) -> np.ndarray:
    """Rotation (3, 3) by roll, pitch and yaw (3,) rad, roll first."""
    (cr, sr), (cp, sp), (cy, sy) = ((math.cos(a), math.sin(a)) for a in angles)
    roll = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    pitch = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    yaw = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return yaw @ pitch @ roll
