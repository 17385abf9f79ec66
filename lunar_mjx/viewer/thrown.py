"""The dust of a drive that goes on: its last seconds are kept, and grains stay the same from picture to picture."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np

from lunar_mjx.cameras.dust.grains import Grains, WheelMotion
from lunar_mjx.cameras.dust.recorded import Dust, none, wheel_motion
from lunar_mjx.model import Model


@dataclasses.dataclass(frozen=True)
class LiveDustSettings:
    """How much of a drive's dust is kept and shown."""

    kept: float = 3.0
    """What is older has come down, s: a grain that leaves at 2 m/s straight up, faster than rovers drive, flies 2.5 s
    on the Moon."""
    dropped: float = 0.5
    """What is older is dropped as often as so much of it has come together, s."""
    most: int = 80
    """Grains of each wheel in a picture, which is sent 25 times a second."""


LIVE_DUST = LiveDustSettings()


class LiveDust:
    """Dust of the rover that somebody looks at.

    Args:
      model: what drives where.
    """

    def __init__(self, model: Model) -> None:
        self._rover, self._gravity = model.rover, model.gravity
        self._terrain = jax.device_get(model.terrain)
        self._hard = "hard_surface" in model.effect_names
        self._compiled = model.rover.compile()
        self.begin()

    def begin(self) -> None:
        """Forgets what was thrown: the rover was put somewhere else."""
        self._time: list[float] = []
        self._motion: list[WheelMotion] = []  # the first of all rows but the newest, which are one by one
        self._before: np.ndarray | float = 0.0

    def add(self, time: float, qpos: np.ndarray) -> None:
        """Takes the coordinates of the rover's MJCF, (nq,), at a time later than those before, s."""
        self._time.append(time)
        self._motion.append(wheel_motion(self._rover, np.asarray(qpos)[None], self._compiled))

    def at(self, time: float) -> Grains:
        """The grains in flight at a time, s."""
        if len(self._time) < 2:
            return none()
        motion = WheelMotion(*(np.concatenate(part) for part in zip(*self._motion, strict=True)))
        self._motion = [motion]
        dust = Dust(self._rover, self._terrain, self._time, motion, self._gravity, self._hard, before=self._before)
        if self._time[0] < time - LIVE_DUST.kept - LIVE_DUST.dropped:
            first = int(np.searchsorted(self._time, time - LIVE_DUST.kept))
            # Grains are numbered by the way that their wheel has slipped, which goes on.
            self._before = dust.way[first]
            self._time, self._motion = self._time[first:], [WheelMotion(*(part[first:] for part in motion))]
        return dust.at(time, LIVE_DUST.most)
