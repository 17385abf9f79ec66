"""One joint of a leg and the bodies that turn with it, as numbers over the legs of a group."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import numpy as np

from lunar_mjx.dynamics.spatial_algebra import Body
from lunar_mjx.spatial import Frame, Vec3


class LinkNumbers(NamedTuple):
    """Numbers of one link over the legs of a group, each a float or an array of shape (leg,).

    Attributes:
      sign: +1 or -1: the joint's angle times this turns the link about its coordinate axis.
      origin: of the link's frame (on the joint's axis), in the frame of its parent, m.
      turn: of the link's frame in that of its parent at zero angle.
      body: mass, kg; centre of mass, m, and moments of inertia, kg m2, in the link's frame.
      damping: N m s/rad. stiffness: N m/rad. springref: rad. armature: kg m2.
    """

    sign: Any
    origin: Vec3
    turn: Frame
    body: Body
    damping: Any
    stiffness: Any
    springref: Any
    armature: Any


@dataclasses.dataclass(frozen=True, eq=False)
class Link:
    """One joint and the bodies that turn with it: parent link (-1: chassis), coordinate axis, addresses by leg."""

    parent: int
    axis: int
    numbers: LinkNumbers
    qpos: np.ndarray
    dof: np.ndarray
    actuated: np.ndarray | None
