"""From keys to targets of the motors: what the driver asks for, reached no faster than a rover would."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np

from lunar_mjx.errors import bad_input, require_finite
from lunar_mjx.model import Model

KEYS = ("forward", "back", "left", "right", "brake")
"""What can be held down."""


@dataclasses.dataclass(frozen=True)
class Handling:
    """How a rover answers to keys."""

    acceleration: float = 0.6
    """m/s2 of the rims; hard enough to feel, soft enough for the soil."""
    steer_time: float = 0.8
    """s from straight to the limit of the steering."""
    notch: float = 0.2
    """What one press adds in the window, which hears presses only: a share of the top speed or of the steering."""
    span: float = 0.5
    """Steering angle of a joint without limits, rad."""


HANDLING = Handling()


class Pilot:
    """What a driver asks of a rover, as targets of its motors.

    Drives are in the mode `velocity`, steering and suspension in `position`; see `drivable`. A rover without steered
    front wheels turns by driving its sides at different speeds.

    Args:
      model: of the rover.
      top_speed: of the rims, m/s.

    Attributes:
      throttle, wheel: asked for, in [-1, 1]; forward and left are positive.
      speed: of the rims at present, m/s. turn: of the steering at present, in [-1, 1].

    Raises:
      UserError: a speed that is not positive.
    """

    def __init__(self, model: Model, top_speed: float) -> None:
        if require_finite("view", "--speed", top_speed) <= 0:
            raise bad_input("view", "--speed", top_speed, "is not positive", "give m/s, such as 0.5")
        if top_speed > 10.0:  # as for the channels of a log: rovers drive below 5 m/s
            raise bad_input("view", "--speed", top_speed, "is no speed of a rover", "give m/s, such as 0.5")
        rover = model.rover
        self.top_speed = top_speed
        self._joints = len(rover.joints)
        self._drives = [
            (rover.joints.index(w.drive), w.radius, 1.0 if w.side == "left" else -1.0) for w in rover.wheels
        ]
        fronts = [w.steer for w in rover.wheels if w.steer and w.row == "front"]
        self._steers = [(rover.joints.index(name), _span(*rover.joint_limits[name])) for name in fronts]
        self.halt()

    def halt(self) -> None:
        """Stands still with straight wheels, at once."""
        self.throttle = self.wheel = self.speed = self.turn = 0.0
        self.braking = False

    def hold(self, keys: Iterable[str]) -> None:
        """Takes the keys that are held down; what is not held springs back."""
        held = set(keys)
        self.throttle = float("forward" in held) - float("back" in held)
        self.wheel = float("left" in held) - float("right" in held)
        self.braking = "brake" in held

    def press(self, key: str) -> None:
        """Takes one press that changes what is asked for by a notch, until it is changed again."""
        # In a window a press is all that is heard: a brake that had to be held could not be.
        if key == "brake":
            self.throttle, self.wheel = 0.0, 0.0
        elif key in ("forward", "back"):
            self.throttle = _notched(self.throttle, 1.0 if key == "forward" else -1.0)
        else:
            self.wheel = _notched(self.wheel, 1.0 if key == "left" else -1.0)

    def control(self, interval: float) -> np.ndarray:
        """Targets (joint,) of all motors after `interval` s more."""
        wanted = 0.0 if self.braking else self.throttle * self.top_speed
        # A brake that were no stronger than letting go would not feel like one.
        most = HANDLING.acceleration * interval * (3.0 if self.braking else 1.0)
        self.speed += float(np.clip(wanted - self.speed, -most, most))
        self.turn += float(
            np.clip(self.wheel - self.turn, -interval / HANDLING.steer_time, interval / HANDLING.steer_time)
        )
        targets = np.zeros(self._joints)
        for joint, radius, left in self._drives:
            # without steering, the inner side is slowed down; on the spot the sides run against each other
            aside = 0.0 if self._steers else -left * self.turn * 0.5 * self.top_speed
            targets[joint] = (self.speed + aside) / radius
        for joint, span in self._steers:
            targets[joint] = self.turn * span
        return targets


class Onlooker:
    """Takes the keys of somebody who does not drive."""

    def hold(self, keys: Iterable[str]) -> None:
        """Ignores the keys: nothing is steered."""


def drivable(model: Model) -> Model:
    """The model with motors that follow a driver: speeds for drives, angles for steering and suspension."""
    modes = {g.name: "velocity" if g.name == "drive" else "position" for g in model.rover.groups}
    return model if all(model.modes[k] == v for k, v in modes.items()) else model.replace(modes=modes)


def _notched(value: float, sign: float) -> float:
    return float(np.clip(round((value + sign * HANDLING.notch) / HANDLING.notch) * HANDLING.notch, -1.0, 1.0))


def _span(low: float, high: float) -> float:
    span = min(-low, high)
    # Short of the stop: a motor that pushes against it heats up and turns nothing.
    return 0.9 * span if 0.0 < span < math.inf else HANDLING.span
