"""Finds the wheels and what drives, steers and suspends each, and makes every joint's sign agree with the frames.

Signs: positive drive moves the rover forward (+x), positive steer turns the wheel to the left (about +z), positive
suspension raises the chassis (the wheel goes down relative to it).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.rover.description import Description, WheelDescription
from lunar_mjx.rover.tree import Body, flip_axis, locate, reframe, world_poses
from lunar_mjx.rover.urdf import Geometry, Pose, Urdf


@dataclass(frozen=True)
class RoleRules:
    """How wheels and the joints behind them are told from a tree."""

    fewest_wheels: int = 3
    """Wheels below which a rover cannot stand."""
    same_place: float = 1e-3
    """m; wheels closer than this along x are in one row, closer to y = 0 are in the middle."""
    row: float = 0.1
    """Share of the wheel base within which wheels are in one row: drawn wheels of one axle are not exactly in line."""
    along_axle: float = 0.98
    """Least |cosine| between a cylinder and the axle of a rim; a cylinder across it is a hub or a motor."""
    across: float = 0.9
    """Least |cosine| between an axle and y: 26 deg of camber and toe are more than any wheel of a rover has."""
    upright: float = 0.9
    """Least |cosine| between a steering axis and z."""
    level: float = 0.1
    """Largest |cosine| between a suspension's axis and z: level within 6 deg."""
    hanging: float = 0.5
    """Radii above the lowest wheel from which a round body is no wheel: suspensions differ by less, a reel on the deck
    does not come so low."""


ROLE_RULES = RoleRules()


_HINGES = ("revolute", "continuous")


@dataclass(frozen=True)
class WheelRole:
    """A wheel's body, corner and joints by name, its radius and width in m, and its centre (3,) in the base frame."""

    body: str
    corner: str
    radius: float
    width: float
    drive: str
    steer: str | None
    suspension: str | None
    center: np.ndarray


@dataclass(frozen=True)
class Roles:
    """Wheels in order (front to rear, left before right), the bodies with mended axes, and what was assumed."""

    wheels: tuple[WheelRole, ...]
    bodies: tuple[Body, ...]
    notes: tuple[str, ...]

    def group(self, name: str) -> tuple[str, ...]:
        """Joint names of the group 'drive', 'steer' or 'suspension', in wheel order, each once."""
        return tuple(dict.fromkeys(j for j in (getattr(w, name) for w in self.wheels) if j is not None))


def assign_roles(urdf: Urdf, bodies: tuple[Body, ...], description: Description) -> Roles:
    """Takes the wheels from the description, or infers them from the tree.

    Raises:
      UserError: fewer than three wheels, inferred ones of one side alone, or a description that names something that
        is not there.
    """
    poses = world_poses(bodies)
    if description.wheels:
        wheels = [_described(urdf, bodies, poses, description, w) for w in description.wheels]
    else:
        wheels = [_role(urdf, bodies, poses, b, WheelDescription(b.name)) for b in _candidates(bodies, poses)]
    wheel_names = ", ".join(w.body for w in wheels) or "none"
    remedy = (
        "give each wheel a continuous joint with an axis along y at zero angles and a cylinder, "
        "or name the wheels in the description beside the URDF ([[wheels]])"
    )
    if len(wheels) < ROLE_RULES.fewest_wheels:
        raise bad_input(urdf.path, "wheels", wheel_names, f"are fewer than {ROLE_RULES.fewest_wheels}", remedy)
    wheels = _name_corners(urdf, wheels, description)
    notes: list[str] = []
    if not description.wheels:
        # A wheel whose joint is drawn askew is found by the one on the other side: a rover without it would be another.
        corners = {w.corner for w in wheels}
        for wheel in wheels:
            other = {"l": "r", "r": "l"}.get(wheel.corner[0])
            if other is not None and other + wheel.corner[1:] not in corners:
                problem = f"have none on the other side of {wheel.body}"
                raise bad_input(urdf.path, "wheels", wheel_names, problem, remedy)
        # Only inferred roles: who names a rocker as a suspension means it.
        wheels, notes = _drop_shared(bodies, wheels)
    # Signs before frames: aligning a wheel reads the mended axis.
    bodies, flips = _mend_signs(bodies, poses, wheels)
    bodies = _align_wheels(bodies, poses, wheels)
    return Roles(tuple(wheels), bodies, tuple(notes + flips))


def without_followers(urdf: Urdf, roles: Roles) -> Roles:
    """The roles without motors on joints that mimic others, which the joint that they follow moves.

    Raises:
      UserError: a wheel's own joint mimics another.
    """
    followers = {j.name for j in urdf.joints if j.mimic is not None}
    wheels, notes = [], list(roles.notes)
    for wheel in roles.wheels:
        if wheel.drive in followers:
            raise bad_input(
                urdf.path,
                f"joint '{wheel.drive}' mimic",
                "a wheel's joint",
                "has a motor of its own here",
                "name wheels that share a motor in the description beside the URDF ([[drive_groups]])",
            )
        led = {role: None for role in ("steer", "suspension") if getattr(wheel, role) in followers}
        notes += [f"joint '{getattr(wheel, role)}' follows another joint and has no motor" for role in led]
        wheels.append(replace(wheel, **led))
    return replace(roles, wheels=tuple(wheels), notes=tuple(dict.fromkeys(notes)))


def _world_axis(body: Body, poses: dict[str, Pose]) -> np.ndarray:
    assert body.joint is not None
    return poses[body.name].rotation @ body.joint.axis


def _rim(body: Body) -> tuple[Geometry, float, float] | None:
    """The body's largest round primitive about its joint axis, with radius and width."""
    assert body.joint is not None
    rims = []
    for shape in body.geometry:
        # A cylinder across the axle is a hub or a motor, not a rim.
        if shape.kind == "cylinder" and abs(shape.pose.rotation[:, 2] @ body.joint.axis) > ROLE_RULES.along_axle:
            rims.append((shape, shape.size[0], shape.size[1]))
        elif shape.kind == "sphere":
            rims.append((shape, shape.size[0], shape.size[0]))
    # The largest: hubs and spokes are drawn as smaller shapes.
    return max(rims, key=lambda f: f[1], default=None)


def _candidates(bodies: tuple[Body, ...], poses: dict[str, Pose]) -> list[Body]:
    """Bodies at the end of a chain that turn about y and carry a round shape, unless they hang above the others."""
    parents = {b.parent for b in bodies}
    candidates: list[tuple[Body, float, float]] = []
    for body in bodies:
        if body.joint is None or body.joint.kind not in _HINGES or body.name in parents:
            continue
        rim = _rim(body)
        if rim is None or abs(_world_axis(body, poses)[1]) < ROLE_RULES.across:
            continue
        shape, radius, _ = rim
        bottom = (poses[body.name] @ shape.pose).position[2] - radius
        candidates.append((body, bottom, radius))
    lowest = min((bottom for _, bottom, _ in candidates), default=0.0)
    return [body for body, bottom, radius in candidates if bottom - lowest < ROLE_RULES.hanging * radius]


def _described(
    urdf: Urdf, bodies: tuple[Body, ...], poses: dict[str, Pose], description: Description, wheel: WheelDescription
) -> WheelRole:
    place = locate(bodies, wheel.link)
    path = description.path or urdf.path
    if place is None:
        raise bad_input(path, "wheels link", wheel.link, f"is not a link of {urdf.path.name}", "correct the name")
    body = place[0]
    if body.joint is None or body.joint.kind not in _HINGES:
        raise bad_input(
            path, "wheels link", wheel.link, "does not turn on a joint", "name a link below a continuous joint"
        )
    names = {b.joint.name for b in bodies if b.joint is not None}
    for role in ("steer", "suspension"):
        joint = getattr(wheel, role)
        if joint is not None and joint not in names:
            raise bad_input(path, f"wheels {role}", joint, f"is not a joint of {urdf.path.name}", "correct the name")
    if abs(_world_axis(body, poses)[1]) < ROLE_RULES.across:
        raise bad_input(
            path, "wheels link", wheel.link, "does not turn about y at zero angles", "let the rover face along x"
        )
    return _role(urdf, bodies, poses, body, wheel)


def _role(
    urdf: Urdf, bodies: tuple[Body, ...], poses: dict[str, Pose], body: Body, given: WheelDescription
) -> WheelRole:
    """Fills in what `given` leaves open from the wheel's shape and its ancestors."""
    assert body.joint is not None
    rim = _rim(body)
    radius, width = given.radius, given.width
    center = poses[body.name].position
    if rim is not None:
        # What the description says wins over what is drawn.
        radius, width = radius or rim[1], width or rim[2]
        center = (poses[body.name] @ rim[0].pose).position
    if radius is None or width is None:
        raise bad_input(
            urdf.path,
            f"link '{body.name}' geometry",
            "no cylinder",
            "does not tell the wheel's radius and width",
            "give radius and width in the description beside the URDF ([[wheels]])",
        )
    by_name = {b.name: b for b in bodies}
    steer, suspension = given.steer, given.suspension
    parent = body.parent
    while parent is not None:
        ancestor = by_name[parent]
        if ancestor.joint is not None and ancestor.joint.kind in _HINGES:
            upright = abs(_world_axis(ancestor, poses)[2])
            # A steering joint lies below the suspension; a turning mast above it would be something else.
            if upright > ROLE_RULES.upright and steer is None and suspension is None:
                steer = ancestor.joint.name
            # The nearest such ancestor, since a bogie is closer to its wheel than its rocker.
            elif upright < ROLE_RULES.level and suspension is None:
                suspension = ancestor.joint.name
        parent = ancestor.parent
    return WheelRole(
        body.name, given.corner or "", float(radius), float(width), body.joint.name, steer, suspension, center
    )


def _name_corners(urdf: Urdf, wheels: list[WheelRole], description: Description) -> list[WheelRole]:
    """Sorts front to rear and left before right, and names corners lf, rf, lr, rr (lm, rm between; c in the middle)."""
    rows: list[list[WheelRole]] = []
    spread = max(w.center[0] for w in wheels) - min(w.center[0] for w in wheels)
    for wheel in sorted(wheels, key=lambda w: -w.center[0]):
        if rows and rows[-1][0].center[0] - wheel.center[0] < max(ROLE_RULES.same_place, ROLE_RULES.row * spread):
            rows[-1].append(wheel)
        else:
            rows.append([wheel])
    middle = ["m"] if len(rows) == 3 else [f"m{i}" for i in range(1, len(rows) - 1)]
    letters = ["f", *middle, "r"] if len(rows) > 1 else ["m"]
    named = []
    for letter, row in zip(letters, rows, strict=True):
        for wheel in sorted(row, key=lambda w: -w.center[1]):
            y = wheel.center[1]
            # A wheel in the middle plane belongs to neither side.
            side = "c" if abs(y) < ROLE_RULES.same_place else "l" if y > 0 else "r"
            named.append(replace(wheel, corner=wheel.corner or side + letter))
    corners = [w.corner for w in named]
    for corner in corners:
        if corners.count(corner) > 1:
            raise bad_input(
                description.path or urdf.path,
                "wheels corner",
                corner,
                "is given to two wheels",
                "name the wheels and their corners in the description beside the URDF ([[wheels]])",
            )
    return named


def _drop_shared(bodies: tuple[Body, ...], wheels: list[WheelRole]) -> tuple[list[WheelRole], list[str]]:
    """Leaves a pivot that carries several wheels (a rocker, a bogie) passive."""
    by_name = {b.name: b for b in bodies}
    carried: dict[str, int] = {}
    for wheel in wheels:
        name: str | None = wheel.body
        while name is not None:
            joint = by_name[name].joint
            if joint is not None:
                carried[joint.name] = carried.get(joint.name, 0) + 1
            name = by_name[name].parent
    shared = {w.suspension for w in wheels if w.suspension is not None and carried[w.suspension] > 1}
    notes = [f"joint '{p}' carries several wheels and was left passive" for p in sorted(shared)]
    return [replace(w, suspension=None) if w.suspension in shared else w for w in wheels], notes


def _mend_signs(
    bodies: tuple[Body, ...], poses: dict[str, Pose], wheels: list[WheelRole]
) -> tuple[tuple[Body, ...], list[str]]:
    """Reverses the axes whose positive direction is not the stated one."""
    by_joint = {b.joint.name: b for b in bodies if b.joint is not None}
    reverse: dict[str, str] = {}
    for wheel in wheels:
        # A wheel that turns about +y (left) by the right hand rolls forward, its top moving ahead.
        if _world_axis(by_joint[wheel.drive], poses)[1] < 0:
            reverse[wheel.drive] = "drives forward"
        if wheel.steer is not None and _world_axis(by_joint[wheel.steer], poses)[2] < 0:
            reverse[wheel.steer] = "steers to the left"
        if wheel.suspension is not None:
            body = by_joint[wheel.suspension]
            # How the wheel's height changes when the joint turns: the sign tells the axis's sense, zero that it is no
            # suspension.
            lift = np.cross(_world_axis(body, poses), wheel.center - poses[body.name].position)[2]
            if abs(lift) < 1e-9:
                raise UserError(
                    f"joint '{wheel.suspension}': turning it does not move the wheel '{wheel.body}' up or down; "
                    "name another suspension joint in the description beside the URDF ([[wheels]])."
                )
            # Positive shall raise the chassis, and so push the wheel down relative to it.
            if lift > 0:
                reverse[wheel.suspension] = "raises the chassis"
    mended = tuple(flip_axis(b) if b.joint is not None and b.joint.name in reverse else b for b in bodies)
    return mended, [f"joint '{j}': axis reversed so that positive {why}" for j, why in reverse.items()]


def _align_wheels(bodies: tuple[Body, ...], poses: dict[str, Pose], wheels: list[WheelRole]) -> tuple[Body, ...]:
    """Gives every wheel body a frame at the rim's centre: y along the axle to the left, x forward, z up."""
    centers = {w.body: w.center for w in wheels}
    parents = {b.parent for b in bodies}
    aligned = []
    for body in bodies:
        if body.name in centers and body.name not in parents:
            pose = poses[body.name]
            axle = _world_axis(body, poses)
            forward = np.cross(axle, [0.0, 0.0, 1.0])
            # Level, whatever the camber: the wheel frame's x is where it rolls to.
            forward /= np.linalg.norm(forward)
            turn = pose.rotation.T @ np.column_stack([forward, axle, np.cross(forward, axle)])
            # Only along the axle: the joint's axis must go through the body's origin.
            offset = pose.rotation.T @ (centers[body.name] - pose.position)
            assert body.joint is not None
            frame = Pose(body.joint.axis * (body.joint.axis @ offset), turn)
            if np.abs(frame.position).max() > 1e-9 or np.abs(turn - np.eye(3)).max() > 1e-9:
                body = reframe(body, frame)
        aligned.append(body)
    return tuple(aligned)
