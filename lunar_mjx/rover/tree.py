"""Turns a URDF's links into moving bodies: links fixed to one another become one body, and no mass is lost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.rover.urdf import Geometry, Joint, Pose, Urdf, check_inertia


@dataclass(frozen=True)
class Body:
    """One rigid body of the rover, with all links fused into it.

    Attributes:
      name: link that names it; the base carries the name of its first link with mass or shape.
      parent: parent body, or None for the base.
      pose: body frame in the parent body's frame at zero joint angles.
      joint: joint that moves it, or None for the base; its axis is in the body frame.
      mass: kg.
      com: centre of mass (3,) in the body frame, m.
      inertia: tensor (3, 3) about the centre of mass, in the body frame, kg m2.
      geometry: primitives, in the body frame.
      frames: pose in the body frame of every link fused into it.
    """

    name: str
    parent: str | None
    pose: Pose
    joint: Joint | None
    mass: float
    com: np.ndarray
    inertia: np.ndarray
    geometry: tuple[Geometry, ...]
    frames: dict[str, Pose]


def bodies_of(urdf: Urdf) -> tuple[Body, ...]:
    """Fuses fixed links and returns the bodies, parents before children, in the file's order.

    Raises:
      UserError: a body that moves has no mass or an impossible inertia.
    """
    root, joints = _free_root(urdf)
    bodies: list[Body] = []
    waiting: list[tuple[str, str | None, Pose, Joint | None]] = [(root, None, Pose(), None)]
    while waiting:
        link, parent, pose, joint = waiting.pop(0)
        frames = _fixed_frames(link, joints)
        if joint is None:
            # Many URDFs begin with an empty footprint link, whose frame says nothing of the rover.
            link, frames = _base_frame(urdf, link, frames)
        body = _fuse(urdf, link, parent, pose, joint, frames)
        bodies.append(body)
        # Children of any fused link hang from the fused body.
        children = [j for j in joints if j.parent in frames and j.kind != "fixed"]
        for child in reversed(children):  # depth first keeps each leg's bodies together
            waiting.insert(0, (child.child, body.name, frames[child.parent] @ child.pose, child))
    return tuple(bodies)


def world_poses(bodies: tuple[Body, ...]) -> dict[str, Pose]:
    """Pose of every body in the base frame at zero joint angles."""
    poses: dict[str, Pose] = {}
    for body in bodies:
        poses[body.name] = body.pose if body.parent is None else poses[body.parent] @ body.pose
    return poses


def locate(bodies: tuple[Body, ...], link: str) -> tuple[Body, Pose] | None:
    """Returns the body that holds `link` and the link's pose in it, or None if there is no such link."""
    for body in bodies:
        if link in body.frames:
            return body, body.frames[link]
    return None


def flip_axis(body: Body) -> Body:
    """A body with its joint's positive direction reversed."""
    assert body.joint is not None
    # Limits change sides with the sign: the motion that they allow stays.
    low, high = body.joint.limits
    return replace(body, joint=replace(body.joint, axis=0.0 - body.joint.axis, limits=(-high, -low)))


def reframe(body: Body, frame: Pose) -> Body:
    """The same body described in another frame, given in the present one; only for a body without children."""
    assert body.joint is not None
    # The inverse of a rotation is its transpose.
    inverse = Pose(-frame.rotation.T @ frame.position, frame.rotation.T)
    return replace(
        body,
        pose=body.pose @ frame,
        joint=replace(body.joint, axis=inverse.rotation @ body.joint.axis),
        com=inverse.apply(body.com),
        inertia=inverse.rotation @ body.inertia @ frame.rotation,
        geometry=tuple(replace(g, pose=inverse @ g.pose) for g in body.geometry),
        frames={link: inverse @ pose for link, pose in body.frames.items()},
    )


def _free_root(urdf: Urdf) -> tuple[str, tuple[Joint, ...]]:
    """Drops a massless 'world' link above a floating joint: the base is free in any case."""
    floating = [j for j in urdf.joints if j.kind == "floating"]
    if not floating:
        return urdf.root, urdf.joints
    top = floating[0]
    if len(floating) > 1 or top.parent != urdf.root or urdf.links[urdf.root].mass > 0:
        raise bad_input(
            urdf.path,
            f"joint '{floating[-1].name}' type",
            "floating",
            "is only possible once, between a massless world link and the rover",
            "use a revolute, continuous, prismatic or fixed joint",
        )
    siblings = [j for j in urdf.joints if j.parent == urdf.root and j is not top]
    if siblings:
        raise bad_input(
            urdf.path,
            f"joint '{siblings[0].name}' parent",
            urdf.root,
            "is the world above a floating base",
            "attach the link to the rover",
        )
    return top.child, tuple(j for j in urdf.joints if j is not top)


def _fixed_frames(link: str, joints: tuple[Joint, ...]) -> dict[str, Pose]:
    """Pose, in `link`'s frame, of every link that fixed joints hang from it."""
    frames = {link: Pose()}
    stack = [link]
    while stack:
        parent = stack.pop(0)
        for joint in joints:
            if joint.parent == parent and joint.kind == "fixed":
                frames[joint.child] = frames[parent] @ joint.pose
                stack.append(joint.child)
    return frames


def _base_frame(urdf: Urdf, root: str, frames: dict[str, Pose]) -> tuple[str, dict[str, Pose]]:
    """Names the base after its first link with mass or shape, and moves the frame there unless that would turn it."""
    name = next((x for x in frames if urdf.links[x].mass > 0 or urdf.links[x].geometry), root)
    offset = frames[name]
    if not np.array_equal(offset.rotation, np.eye(3)):
        return name, frames
    # Moved but not turned: the base's axes are the rover's forward, left and up.
    return name, {link: Pose(pose.position - offset.position, pose.rotation) for link, pose in frames.items()}


def _fuse(urdf: Urdf, name: str, parent: str | None, pose: Pose, joint: Joint | None, frames: dict[str, Pose]) -> Body:
    """Adds up masses, centres of mass and inertias (parallel-axis theorem) of the links in `frames`."""
    links = [(urdf.links[link], frame) for link, frame in frames.items()]
    mass = sum(link.mass for link, _ in links)
    if mass <= 0:
        moved = f"joint '{joint.name}' moves it" if joint is not None else "it is the rover's base"
        raise bad_input(
            urdf.path, f"link '{name}' mass", 0, f"and inertia are zero, but {moved}", "give the link an <inertial>"
        )
    for link, _ in links:
        # A point mass is meaningful where a body around it supplies the inertia.
        if link.mass > 0 and (len(links) == 1 or np.abs(link.inertia).max() > 0):
            check_inertia(urdf.path, link.name, link.inertia)
    com = sum((link.mass * frame.apply(link.com) for link, frame in links), np.zeros(3)) / mass
    # About the common centre of mass, by the parallel-axis theorem.
    inertia = np.zeros((3, 3))
    for link, frame in links:
        arm = frame.apply(link.com) - com
        inertia += frame.rotation @ link.inertia @ frame.rotation.T
        inertia += link.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    check_inertia(urdf.path, name, inertia)
    geometry = tuple(replace(g, pose=frame @ g.pose) for link, frame in links for g in link.geometry)
    # Symmetric to the last digit, as MuJoCo demands.
    return Body(name, parent, pose, joint, mass, com, (inertia + inertia.T) / 2, geometry, frames)
