"""What an episode costs: way, energy, slip and collisions, counted where the task asks for it."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import System
from lunar_mjx.envs.navigation.view import View
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain import Terrain, form_at, nearest_rock, sample

METRICS = ("travelled", "shortest", "energy", "slip", "collisions")
"""Numbers of an episode: length of its way and of the shortest one, m; energy drawn, J; mean slip; boulders hit."""


@pytree
class Tally:
    """Sums over the steps of an episode, each (env,).

    Attributes:
      travelled: m in plan. energy: J. slip: sum of the wheels' mean size of slip. collisions: how many.
      touching: whether a boulder is under the rover's outline now.
      power, struck: of the last step: W, and 1 where a collision began.
    """

    travelled: Any
    energy: Any
    slip: Any
    collisions: Any
    touching: Any
    power: Any
    struck: Any


def start(count: int, dtype: Any) -> Tally:
    """The tally of an episode before its first step."""
    zero = jnp.zeros(count, dtype)
    return Tally(zero, zero, zero, zero, jnp.zeros(count, bool), zero, zero)


def update(tally: Tally, moved: Any, power: Any, slip: Any, touching: Any, interval: float) -> Tally:
    """The tally with one more control step.

    Args:
      moved: way of the step in plan, m. power: (env, joint) electrical, W; none flows back.
      slip: (env, wheel). touching: see `Outline.touches`. interval: of control, s.
    """
    # Braking power is lost in a resistor, as in the effect `motor_power`.
    drawn = jnp.maximum(power, 0.0).sum(-1)
    # Where contact begins: a rover that leans on a boulder has hit it once.
    struck = (touching & ~tally.touching).astype(moved.dtype)
    return Tally(
        tally.travelled + moved,
        tally.energy + drawn * interval,
        tally.slip + jnp.abs(jnp.clip(slip, -1.0, 1.0)).mean(-1),
        tally.collisions + struck,
        touching,
        drawn,
        struck,
    )


def metrics(tally: Tally, shortest: Any, steps: Any) -> dict[str, Any]:
    """The metrics of `METRICS`."""
    mean_slip = tally.slip / jnp.maximum(steps, 1).astype(tally.slip.dtype)
    return dict(zip(METRICS, (tally.travelled, shortest, tally.energy, mean_slip, tally.collisions), strict=True))


class Outline:
    """The rectangle around a rover's wheels in plan, and the height of its belly."""

    def __init__(self, system: System):
        rover, feet = system.model.rover, np.abs(np.asarray(system.engine.wheel_feet))
        reach = max(w.radius for w in rover.wheels), 0.5 * max(w.width for w in rover.wheels)
        self.half = float(feet[:, 0].max() + reach[0]), float(feet[:, 1].max() + reach[1])
        info = system.info
        low = (
            0.0
            if info.box_center is None or info.box_half is None
            else float(np.min(info.box_center.z - info.box_half.z))
        )
        self.belly = float(rover.standing_height + low)

    def touches(self, terrain: Terrain, view: View) -> Any:
        """Whether a boulder that stands higher than the belly is under the outline, (env,).

        Smaller stones are driven over; those between the six places at which boulders are looked for are told by the
        nearest place. An ellipsoid takes the place of the sphere around it, but not its height.
        """
        count = view.yaw.shape[0]
        if terrain.rocks is None:
            return jnp.zeros(count, bool)
        fore, side = (np.ravel(a) for a in np.meshgrid([-0.8, 0.0, 0.8], [-0.5, 0.5]))
        cos, sin = jnp.cos(view.yaw)[:, None], jnp.sin(view.yaw)[:, None]
        x0, y0 = view.position[:, 0, None], view.position[:, 1, None]
        fore, side = fore * self.half[0], side * self.half[1]
        probe = x0 + cos * fore - sin * side, y0 + sin * fore + cos * side
        cx, cy, cz, radius = nearest_rock(terrain.rocks, *probe)
        high = radius if terrain.rocks.forms is None else form_at(terrain.rocks, *probe).apex().z
        # What the belly clears is no collision.
        tall = cz + high - sample(terrain.field, cx, cy)[0] > self.belly
        ahead, aside = cos * (cx - x0) + sin * (cy - y0), cos * (cy - y0) - sin * (cx - x0)
        # Distance from the boulder's centre to a rectangle.
        gap = jnp.hypot(
            jnp.maximum(jnp.abs(ahead) - self.half[0], 0.0), jnp.maximum(jnp.abs(aside) - self.half[1], 0.0)
        )
        return ((radius > 0.0) & tall & (gap < radius)).any(-1)
