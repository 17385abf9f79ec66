"""Reads a URDF into plain records and refuses what cannot become a rigid-body model.

Only the mechanics are read: links, inertias, joints and primitive geometry. Tags that belong to other programs
(`<transmission>`, `<gazebo>`, `<sensor>`, ...) are ignored, and every ignored thing that could matter leaves a note.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from lunar_mjx.errors import UserError, bad_input, require_file, require_finite

JOINT_TYPES = ("fixed", "revolute", "continuous", "prismatic", "floating")


@dataclass(frozen=True)
class UrdfLimits:
    """What a URDF and its description may hold."""

    inertia_tolerance: float = 1e-6
    """Share by which a triangle inequality of moments of inertia may be missed, by rounding: URDFs are written by hand
    with a few digits."""
    longest_name: int = 200
    """Characters of a link's or joint's name, which becomes part of channel names."""
    open_loop: float = 1e-3
    """m; anchors of a loop farther apart than this at zero angles are a mistake, not rounding."""
    parallel: float = 0.999
    """Least |cosine| between the axes of a differential's pivots: 2.6 deg, more than roundings of a URDF's angles."""


URDF_LIMITS = UrdfLimits()


@dataclass(frozen=True)
class Pose:
    """Position (3,), in m, and rotation matrix (3, 3) of a child frame in its parent frame."""

    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))

    def __matmul__(self, other: Pose) -> Pose:
        return Pose(self.position + self.rotation @ other.position, self.rotation @ other.rotation)

    def apply(self, point: np.ndarray) -> np.ndarray:
        """Maps a point (3,) of the child frame to the parent frame."""
        return self.position + self.rotation @ np.asarray(point, dtype=float)


@dataclass(frozen=True)
class Geometry:
    """A primitive: kind 'box' (full sizes), 'cylinder' (radius, length along z) or 'sphere' (radius,), in m."""

    kind: str
    size: tuple[float, ...]
    pose: Pose
    rgba: tuple[float, float, float, float]


@dataclass(frozen=True)
class Link:
    """A rigid link: mass in kg, centre of mass (3,) and inertia (3, 3) about it, both in the link frame."""

    name: str
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    geometry: tuple[Geometry, ...]


@dataclass(frozen=True)
class Mimic:
    """A joint's angle = `multiplier` times the angle of the joint `leader` + `offset` (rad)."""

    leader: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """A joint; `axis` (3,) is a unit vector in the child frame, `limits` are rad (m if prismatic), infinite if none."""

    name: str
    kind: str
    parent: str
    child: str
    pose: Pose
    axis: np.ndarray
    limits: tuple[float, float]
    mimic: Mimic | None = None


@dataclass(frozen=True)
class Urdf:
    """A validated kinematic tree. `notes` says, in sentences, what was ignored."""

    path: Path
    name: str
    links: dict[str, Link]
    joints: tuple[Joint, ...]
    root: str
    notes: tuple[str, ...]


def rotation_from_rpy(rpy: np.ndarray) -> np.ndarray:
    """Rotation matrix of URDF's fixed-axis roll, pitch, yaw (3,), in rad."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rpy), np.sin(rpy)
    matrix = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    # Files write pi/2 with six digits; an axis that is off by 1e-7 because of it is meant to be exact.
    snapped = np.round(matrix)
    return snapped if np.abs(matrix - snapped).max() < 1e-5 else matrix


def read_urdf(path: str | Path) -> Urdf:
    """Reads and validates a URDF.

    Args:
      path: file to read.

    Returns:
      The kinematic tree.

    Raises:
      UserError: the file is missing, is not a URDF, or describes something that is not one tree of massive bodies.
    """
    path = require_file(path, "the URDF")
    try:
        # The standard library's parser: it resolves no external entities.
        robot = ET.parse(path).getroot()
    except (ET.ParseError, ValueError, LookupError, RecursionError) as error:  # LookupError: of the encoding
        raise UserError(f"{path}: the URDF is not well-formed XML ({error}); mend the file at that place.") from None
    if robot.tag != "robot":
        raise bad_input(path, "root element", robot.tag, "is not <robot>", "give a URDF (expand xacro files first)")
    for element in robot.iter():
        if isinstance(element.tag, str) and element.tag.startswith("{") and "xacro" in element.tag.split("}")[0]:
            tag = f"xacro:{element.tag.split('}')[1]}"
            raise bad_input(
                path,
                "element",
                tag,
                "was not expanded, and its parts would be lost",
                "expand the file first: xacro in.xacro > out.urdf",
            )
    reader = _Reader(path)
    # Colours may be defined once at the top and used by name.
    colours = {m.get("name", ""): reader.colour(m) for m in robot.findall("material") if m.find("color") is not None}
    links = [reader.link(element, colours) for element in robot.findall("link")]
    joints = [reader.joint(element) for element in robot.findall("joint")]
    # XML does not forbid two of a name, and the second would silently take the place of the first.
    for kind, names in (("link", [x.name for x in links]), ("joint", [x.name for x in joints])):
        for name in names:
            if names.count(name) > 1:
                raise bad_input(path, f"{kind} name", name, "appears more than once", f"give each {kind} its own name")
    by_name = {link.name: link for link in links}
    root = _check_tree(path, by_name, joints)
    return Urdf(path, robot.get("name", path.stem), by_name, tuple(joints), root, tuple(reader.notes))


class _Reader:
    """Reads elements of one file; holds the path for messages and collects the notes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.notes: list[str] = []

    def numbers(self, element: ET.Element | None, name: str, default: str, where: str, count: int = 3) -> np.ndarray:
        text = default if element is None else element.get(name, default)
        values = np.array([require_finite(self.path, f"{where} {name}", v) for v in text.split()])
        if len(values) != count:
            raise bad_input(self.path, f"{where} {name}", text, f"has {len(values)} numbers", f"give {count} numbers")
        return values

    def number(self, element: ET.Element | None, name: str, where: str) -> float:
        text = None if element is None else element.get(name)
        if text is None:
            raise bad_input(self.path, f"{where} {name}", "", "is missing", "give a number")
        return require_finite(self.path, f"{where} {name}", text)

    def name_of(self, element: ET.Element, what: str) -> str:
        name = element.get("name", "").strip()
        if not name:
            raise bad_input(self.path, f"{what} name", "", "is missing", f"name every {what}")
        # Names become channel names and stand in messages of one line.
        if not name.isprintable() or len(name) > URDF_LIMITS.longest_name:
            remedy = f"give at most {URDF_LIMITS.longest_name} characters of one line"
            raise bad_input(self.path, f"{what} name", name, "is no name", remedy)
        return name

    def pose(self, element: ET.Element, where: str) -> Pose:
        origin = element.find("origin")
        position = self.numbers(origin, "xyz", "0 0 0", where)
        return Pose(position, rotation_from_rpy(self.numbers(origin, "rpy", "0 0 0", where)))

    def colour(self, material: ET.Element) -> tuple[float, float, float, float]:
        rgba = self.numbers(material.find("color"), "rgba", "0.7 0.7 0.7 1", "material", 4)
        return (float(rgba[0]), float(rgba[1]), float(rgba[2]), float(rgba[3]))

    def link(self, element: ET.Element, colours: dict[str, tuple[float, float, float, float]]) -> Link:
        name = self.name_of(element, "link")
        field = f"link '{name}'"
        rgba = (0.7, 0.7, 0.7, 1.0)
        material = element.find("visual/material")
        if material is not None:
            known = colours.get(material.get("name", ""), rgba)
            rgba = self.colour(material) if material.find("color") is not None else known
        # A collision shape is the simpler and mechanically meaningful one; a visual shape stands in where no collision
        # is a primitive.
        geometry: tuple[Geometry, ...] = ()
        for tag in ("collision", "visual"):
            if not geometry:
                shapes = (self.geometry(s, field, rgba) for s in element.findall(tag))
                geometry = tuple(g for g in shapes if g is not None)
        inertial = element.find("inertial")
        if inertial is None:
            return Link(name, 0.0, np.zeros(3), np.zeros((3, 3)), geometry)
        mass = self.number(inertial.find("mass"), "value", f"{field} mass")
        if mass <= 0:
            raise bad_input(
                self.path,
                f"{field} mass",
                mass,
                "is not positive",
                "give the mass in kg, or leave out <inertial> of a link that is only a frame",
            )
        tensor = inertial.find("inertia")
        xx, xy, xz, yy, yz, zz = (
            self.number(tensor, key, f"{field} inertia") for key in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        )
        pose = self.pose(inertial, f"{field} inertial")
        # Inertia may be given in a turned frame; from here on it is the link's.
        inertia = pose.rotation @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ pose.rotation.T
        return Link(name, mass, pose.position, inertia, geometry)

    def geometry(self, element: ET.Element, where: str, rgba: tuple[float, float, float, float]) -> Geometry | None:
        shape = element.find("geometry")
        pose = self.pose(element, f"{where} {element.tag}")
        for kind, keys in (("box", ()), ("cylinder", ("radius", "length")), ("sphere", ("radius",))):
            shape_element = None if shape is None else shape.find(kind)
            if shape_element is None:
                continue
            size = [self.number(shape_element, k, f"{where} {kind}") for k in keys] or [
                float(v) for v in self.numbers(shape_element, "size", "", f"{where} box")
            ]
            if min(size) <= 0:
                raise bad_input(self.path, f"{where} {kind} size", size, "is not positive", "give the size in metres")
            return Geometry(kind, tuple(size), pose, rgba)
        what = "mesh" if shape is not None and shape.find("mesh") is not None else "shape"
        self.notes.append(f"{where}: its {element.tag} {what} was left out; mass and inertia are kept")
        return None

    def joint(self, element: ET.Element) -> Joint:
        name = self.name_of(element, "joint")
        field = f"joint '{name}'"
        kind = element.get("type", "")
        if kind not in JOINT_TYPES:
            raise bad_input(self.path, f"{field} type", kind, "is not supported", f"use {', '.join(JOINT_TYPES)}")
        ends = []
        for end in ("parent", "child"):
            tag = element.find(end)
            link = "" if tag is None else tag.get("link", "")
            if not link:
                raise bad_input(self.path, f"{field} {end}", "", "is missing", f"name the {end} link")
            ends.append(link)
        # x is URDF's default axis.
        axis = self.numbers(element.find("axis"), "xyz", "1 0 0", f"{field} axis")
        length = math.hypot(*axis)  # which squares nothing that would overflow
        if length < 1e-9 and kind not in ("fixed", "floating"):
            raise bad_input(self.path, f"{field} axis", axis, "has no length", "give a direction")
        limits = (-np.inf, np.inf)
        limit = element.find("limit")
        if kind in ("revolute", "prismatic"):
            # URDF demands limits of these joints; one without would be 'continuous'.
            if limit is None:
                raise bad_input(self.path, f"{field} limit", "", "is missing", "give it, or use 'continuous'")
            lower, upper = (float(self.numbers(limit, k, "0", f"{field} limit", 1)[0]) for k in ("lower", "upper"))
            if lower > upper:
                raise bad_input(self.path, f"{field} limit lower", lower, f"is above upper = {upper}", "swap the two")
            limits = (lower, upper)
        mimic = self.mimic(element.find("mimic"), field)
        return Joint(name, kind, ends[0], ends[1], self.pose(element, field), axis / max(length, 1e-9), limits, mimic)

    def mimic(self, element: ET.Element | None, where: str) -> Mimic | None:
        if element is None:
            return None
        leader = element.get("joint", "")
        if not leader:
            raise bad_input(self.path, f"{where} mimic joint", "", "is missing", "name the joint that it follows")
        multiplier = float(self.numbers(element, "multiplier", "1", f"{where} mimic", 1)[0])
        if multiplier == 0.0:
            raise bad_input(
                self.path, f"{where} mimic multiplier", 0.0, "holds the joint still", "make the joint fixed"
            )
        return Mimic(leader, multiplier, float(self.numbers(element, "offset", "0", f"{where} mimic", 1)[0]))


def _check_tree(path: Path, links: dict[str, Link], joints: list[Joint]) -> str:
    """Returns the root link's name, or raises `UserError` if links and joints are not one tree."""
    if not links:
        raise bad_input(path, "link", "", "is missing", "give the robot links with mass")
    for joint in joints:
        for end, link in (("parent", joint.parent), ("child", joint.child)):
            if link not in links:
                raise bad_input(
                    path, f"joint '{joint.name}' {end}", link, "is not a link of this file", "correct the name"
                )
    parent_of: dict[str, Joint] = {}
    for joint in joints:
        if joint.child in parent_of:
            first = parent_of[joint.child].name
            raise bad_input(
                path,
                f"joint '{joint.name}' child",
                joint.child,
                f"is already the child of joint '{first}'",
                "close loops in the description beside the URDF ([[loops]])",
            )
        parent_of[joint.child] = joint
    roots = [name for name in links if name not in parent_of]
    # Two roots would be two rovers.
    if len(roots) > 1:
        raise bad_input(
            path, "root links", ", ".join(roots), "are not connected by joints", "join all links into one tree"
        )
    # Each link has one parent, so what cannot be reached from the root runs in a circle.
    if not roots or len(_reachable(roots[0], joints)) < len(links):
        stray = sorted(set(links) - (_reachable(roots[0], joints) if roots else set()))
        raise bad_input(path, "links", ", ".join(stray), "form a cycle of joints", "break the cycle")
    return roots[0]


def _reachable(root: str, joints: list[Joint]) -> set[str]:
    """Names of the links that hang from `root`."""
    seen, stack = {root}, [root]
    while stack:
        link = stack.pop()
        new = [j.child for j in joints if j.parent == link and j.child not in seen]
        seen.update(new)
        stack.extend(new)
    return seen


def check_inertia(path: Path, name: str, inertia: np.ndarray) -> None:
    """Refuses an inertia tensor (3, 3), in kg m2, that no distribution of mass can have.

    Raises:
      UserError: the tensor is zero, not positive definite, or its principal moments break the triangle inequality.
    """
    moments = np.sort(np.linalg.eigvalsh(inertia))
    shown = np.array2string(moments, precision=6)
    field = f"link '{name}' principal moments of inertia"
    if np.abs(inertia).max() == 0:
        raise bad_input(path, field, shown, "are zero", "give the inertia in kg m2; a moving link needs it")
    if moments[0] <= 0:
        raise bad_input(path, field, shown, "are not all positive", "give a positive definite inertia in kg m2")
    # No body has a moment larger than the sum of the other two; tensors typed in by hand often do.
    if moments[0] + moments[1] < moments[2] * (1 - URDF_LIMITS.inertia_tolerance):
        raise bad_input(
            path, field, shown, "break the triangle inequality I1 + I2 >= I3", "compute the inertia from the geometry"
        )
