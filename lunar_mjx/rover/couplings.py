"""Joints that turn in a fixed ratio: the differential of a rocker-bogie, and the <mimic> of a URDF."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.rover.description import Description
from lunar_mjx.rover.tree import Body, world_poses
from lunar_mjx.rover.urdf import URDF_LIMITS, Urdf


@dataclass(frozen=True)
class Coupling:
    """Angle of the joint `follower` = `multiplier` times that of `leader` + `offset`, rad, in the signs of the MJCF."""

    follower: str
    leader: str
    multiplier: float
    offset: float


def place_couplings(urdf: Urdf, bodies: tuple[Body, ...], description: Description) -> tuple[Coupling, ...]:
    """The couplings of the URDF and of its description, for joints whose axes the roles may have reversed.

    Args:
      urdf: as read. bodies: with their axes as in the MJCF. description: what URDF cannot say.

    Raises:
      UserError: a joint that does not exist or does not move, pivots that are not parallel, or a chain of followers.
    """
    moving = {b.joint.name: b for b in bodies if b.joint is not None}
    written = {j.name: j for j in urdf.joints}
    couplings: list[Coupling] = []

    poses = world_poses(bodies)

    def made_axis(joint: str) -> np.ndarray:
        """Direction (3,) of a moving joint's axis at zero angles as the MJCF has it, in the root's frame."""
        body = moving[joint]
        assert body.joint is not None
        return poses[body.name].rotation @ body.joint.axis

    def sense(joint: str) -> float:
        """-1 where the conversion has reversed the joint's axis, which also turns frames; told by the limits' axis."""
        # In the root's frame at zero angles, where both descriptions can be compared.
        return 1.0 if _drawn_axis(urdf, joint) @ made_axis(joint) > 0.0 else -1.0

    for joint in urdf.joints:
        if joint.mimic is None:
            continue
        field = f"joint '{joint.name}' mimic joint"
        if joint.mimic.leader not in moving or joint.mimic.leader == joint.name:
            raise bad_input(urdf.path, field, joint.mimic.leader, "is no other moving joint", "correct the name")
        # A chain would need an order of constraints; naming the first leader says the same.
        if written[joint.mimic.leader].mimic is not None:
            raise bad_input(urdf.path, field, joint.mimic.leader, "follows a joint itself", "follow that joint")
        # The converter turns axes so that positive drives forward; a ratio written for the URDF's axes changes its sign
        # with each.
        own, other = sense(joint.name), sense(joint.mimic.leader)
        multiplier, offset = own * other * joint.mimic.multiplier, own * joint.mimic.offset
        couplings.append(Coupling(joint.name, joint.mimic.leader, multiplier, offset))
    path = description.path or urdf.path
    for i, pair in enumerate(description.differentials):
        for key in ("joint1", "joint2"):
            if getattr(pair, key) not in moving:
                raise bad_input(
                    path, f"differentials[{i}].{key}", getattr(pair, key), "is no moving joint", "correct the name"
                )
        cosine = float(made_axis(pair.joint1) @ made_axis(pair.joint2))
        if abs(cosine) < URDF_LIMITS.parallel:
            raise bad_input(
                path, f"differentials[{i}].joint2", pair.joint2, "is not parallel to joint1", "name the rockers' pivots"
            )
        # Opposite in space: where the axes themselves point opposite ways, equal angles are.
        couplings.append(Coupling(pair.joint2, pair.joint1, -1.0 if cosine > 0.0 else 1.0, 0.0))
    followers = [c.follower for c in couplings]
    for name in followers:
        # Two constraints on one joint would fight each other within the solver.
        if followers.count(name) > 1:
            raise bad_input(path, "joint", name, "follows two joints", "leave one of them out")
    return tuple(couplings)


def _drawn_axis(urdf: Urdf, joint: str) -> np.ndarray:
    """Direction (3,) of a joint's axis at zero angles as the URDF has it, in the root's frame."""
    by_child = {j.child: j for j in urdf.joints}
    wanted = next(j for j in urdf.joints if j.name == joint)
    turn, link = wanted.pose.rotation, wanted.parent
    while link in by_child:
        turn, link = by_child[link].pose.rotation @ turn, by_child[link].parent
    return turn @ wanted.axis
