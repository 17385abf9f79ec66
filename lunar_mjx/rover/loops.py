"""Places the loop closures of the description in body frames and checks that they close."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lunar_mjx.errors import bad_input
from lunar_mjx.rover.description import Description
from lunar_mjx.rover.tree import Body, locate, world_poses
from lunar_mjx.rover.urdf import URDF_LIMITS, Urdf


@dataclass(frozen=True)
class PlacedLoop:
    """A pin between two bodies: anchors (3,) in m, in each body's frame."""

    body1: str
    body2: str
    anchor1: np.ndarray
    anchor2: np.ndarray


def place_loops(urdf: Urdf, bodies: tuple[Body, ...], description: Description) -> tuple[PlacedLoop, ...]:
    """Returns the loops with anchors in body frames.

    Raises:
      UserError: a loop names a link that is not there or ties a body to itself, or its anchors lie apart.
    """
    path = description.path or urdf.path
    poses = world_poses(bodies)
    placed = []
    for i, loop in enumerate(description.loops):
        loops: list[tuple[str, np.ndarray]] = []
        for key, link, anchor in (("link1", loop.link1, loop.anchor1), ("link2", loop.link2, loop.anchor2)):
            place = locate(bodies, link)
            if place is None:
                raise bad_input(
                    path, f"loops[{i}].{key}", link, f"is not a link of {urdf.path.name}", "correct the name"
                )
            loops.append((place[0].name, place[1].apply(np.array(anchor))))
        (body1, anchor1), (body2, anchor2) = loops
        if body1 == body2:
            raise bad_input(
                path, f"loops[{i}].link2", loop.link2, "belongs to the body of link1", "tie two bodies that move"
            )
        # At zero angles both anchors must be one point: a solver would close a wrong gap by bending the rover.
        gap = float(np.linalg.norm(poses[body1].apply(anchor1) - poses[body2].apply(anchor2)))
        if gap > URDF_LIMITS.open_loop:
            raise bad_input(
                path,
                f"loops[{i}] anchors",
                f"{1e3 * gap:.3g} mm",
                "apart at zero joint angles",
                "correct anchor1 or anchor2 so that both are one point",
            )
        placed.append(PlacedLoop(body1, body2, anchor1, anchor2))
    return tuple(placed)
