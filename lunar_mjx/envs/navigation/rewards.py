"""Rewards and ends of an episode of the navigation task: named functions of what a step did."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from lunar_mjx.pytree import pytree

_TINY = 1e-6
"""m; least distance to a goal that a direction is divided by, far below any goal radius."""


@pytree
class Transition:
    """What a control step did, for a batch; distances in m, angles in rad.

    Attributes:
      to_goal_before, to_goal: horizontal vector from rover to goal at the step's beginning and end.
      roll, pitch, yaw: at the end.
      vertical_acceleration: filtered, m/s2.
      action, last_action: of this step and the one before, in [-1, 1].
      power: electrical, of all motors, W. slip: mean size over the wheels. hottest: winding, K. struck: 1 where a
        boulder has come under the rover's outline. All None unless the task keeps a tally.
      nearer: decrease of the shortest way to the goal, m; None unless a term asks for it.
    """

    to_goal_before: Float[Array, "env 2"]
    to_goal: Float[Array, "env 2"]
    roll: Float[Array, "env"]
    pitch: Float[Array, "env"]
    yaw: Float[Array, "env"]
    vertical_acceleration: Float[Array, "env"]
    action: Float[Array, "env action"]
    last_action: Float[Array, "env action"]
    power: Any = None
    slip: Any = None
    hottest: Any = None
    struck: Any = None
    nearer: Any = None


def length(vector: Any) -> Any:
    """Euclidean length along the last axis."""
    return jnp.sqrt(jnp.sum(vector * vector, axis=-1))


def progress_paper(t: Transition) -> Any:
    """r_prog = |P_k,g - P_k-1,g| as printed: never negative, so driving away from the goal pays (flaw 7)."""
    return length(t.to_goal - t.to_goal_before)


def progress(t: Transition) -> Any:
    """Decrease of the distance to the goal, m; negative when driving away."""
    return length(t.to_goal_before) - length(t.to_goal)


def away(t: Transition) -> Any:
    """Increase of the distance from the place to get away from, m; negative when coming back. Not in the paper."""
    return -progress(t)


def way(t: Transition) -> Any:
    """Decrease of the shortest way to the goal over the ladder's map, m: a way out of a dead end pays. The map is told
    to the reward alone, and never to the rover. Not in the paper."""
    return t.nearer


def heading(t: Transition) -> Any:
    """r_head: cosine of the angle between heading and goal, as printed (the z component of the second vector is 0)."""
    along = t.to_goal[..., 0] * jnp.cos(t.yaw) + t.to_goal[..., 1] * jnp.sin(t.yaw)
    # At the goal itself there is no direction.
    return along / jnp.maximum(length(t.to_goal), _TINY)


def tilt(t: Transition) -> Any:
    """r_tilt = -|roll| - |pitch|, as printed, rad."""
    return -jnp.abs(t.roll) - jnp.abs(t.pitch)


def excite(t: Transition) -> Any:
    """r_excite = -|a_z| of the Kalman filter, as printed, m/s2."""
    return -jnp.abs(t.vertical_acceleration)


def time(t: Transition) -> Any:
    """-1 a step: being late costs. Not in the paper."""
    return -jnp.ones_like(t.roll)


def jerkiness(t: Transition) -> Any:
    """Minus the squared change of the action. Not in the paper."""
    return -jnp.sum((t.action - t.last_action) ** 2, axis=-1)


def energy(t: Transition) -> Any:
    """Minus the electrical power of all motors, W. Not in the paper."""
    return -t.power


def slip(t: Transition) -> Any:
    """Minus the mean slip of the wheels. Not in the paper."""
    return -t.slip


def heat(t: Transition) -> Any:
    """Minus what the hottest winding has above 80 degC, in units of 100 K. Not in the paper."""
    return -jnp.maximum(t.hottest - 353.15, 0.0) / 100.0


def collision(t: Transition) -> Any:
    """-1 when a boulder comes under the rover's outline. Not in the paper."""
    return -t.struck


Term = Callable[[Transition], Any]

TERMS: dict[str, Term] = {
    "progress_paper": progress_paper,
    "progress": progress,
    "away": away,
    "way": way,
    "heading": heading,
    "tilt": tilt,
    "excite": excite,
    "time": time,
    "jerkiness": jerkiness,
    "energy": energy,
    "slip": slip,
    "heat": heat,
    "collision": collision,
}
"""All reward terms by name."""

TOLD_BY_TALLY = ("energy", "slip", "heat", "collision")
"""Terms of what only a task with a tally knows."""

PAPER_WEIGHTS = {"progress_paper": 20.0, "heading": 0.1, "tilt": 0.05, "excite": 0.1}
"""The paper's sum as printed."""

CONSISTENT_WEIGHTS = {"progress": 20.0, "heading": 0.1, "tilt": 0.05, "excite": 0.1}
"""The paper's sum with signed progress."""


@dataclasses.dataclass(frozen=True)
class PaperEnds:
    """What the end of an episode pays in the paper."""

    success: float = 500.0
    """G: the goal is reached."""
    failure: float = -60.0
    """V: the episode ends in any other way but by time."""


PAPER_ENDS = PaperEnds()


def reached(to_goal: Float[Array, "env 2"], radius: Any) -> Any:
    """Success: the chassis frame's origin is within `radius` m of the goal in plan."""
    return length(to_goal) < radius


def rolled_over(up_z: Float[Array, "env"], most_tilt: Any) -> Any:
    """Flipped: the chassis' up axis leans more than `most_tilt` rad from the vertical."""
    # By the axis and not by roll and pitch, which mix on steep ground.
    return up_z < jnp.cos(most_tilt)


def stuck(waited: Float[Array, "env"], patience: Any) -> Any:
    """Stuck: for `patience` s the rover has stayed within a circle about the place where it last left one."""
    return waited >= patience
