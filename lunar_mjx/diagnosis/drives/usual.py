"""What is usual on the rover of drives: loads, torques and currents that its effects and inputs are measured by."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.unknown_inputs.port_fields import DRAWBAR, Usual
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import parse_name


@dataclasses.dataclass(frozen=True)
class UsualDrive:
    """What of a drive tells what is usual."""

    moves: float = 1e-6
    """rad/s; speed of a command from which a wheel is to turn."""
    fast: float = 0.9
    """1; quantile of the speeds that are commanded which counts. Not the largest, which may be a single jerk."""
    heard: float = 2.0
    """1; median of a current, over that of its noise, above which it is one that acts."""


USUAL_DRIVE = UsualDrive()


def usual_of(drives: DriveProblem) -> Usual:
    """What is usual on the rover of drives: its wheels' load, and torque, current and speed of its drives."""
    model, rover = drives.model, drives.model.rover
    names = list(rover.joints)
    driven = [names.index(w.drive) for w in rover.wheels if w.drive in names]

    def own(name: str) -> float:
        return float(np.mean(np.broadcast_to(model.parameters["motor"][name], len(names))[driven]))

    weight = float(rover.mass) * float(model.gravity)
    load, radius = weight / len(rover.wheels), float(np.mean([w.radius for w in rover.wheels]))
    drawbar = DRAWBAR * load * radius
    per_current = own("gear_ratio") * own("gear_efficiency") * own("torque_constant")
    # A share of a torque is one of what acts: a skid-steer rover that turns needs several times a usual drawbar pull.
    current = acting_current(drives.observations, {g.name: len(g.joints) for g in rover.drive_groups})
    if not current:
        current = drawbar / per_current
    commands = np.concatenate([r.commands[:, driven].ravel() for r in drives.bench.runs])
    moving = np.abs(commands[np.abs(commands) > USUAL_DRIVE.moves])
    speed = float(np.quantile(moving, USUAL_DRIVE.fast)) if len(moving) else 1.0
    return Usual(load, radius, speed, per_current * current, drawbar, current, own("resistance"), weight, 2.0 * radius)


def acting_current(observations: Observations, shared: Mapping[str, int]) -> float:
    """Median of the absolute current of a drive as measured, A; 0 where none is measured or it is not twice its noise.

    Args:
      observations: of drives. shared: number of wheels that a motor drives, by the name of its side; else one.
    """
    found, noise = [], []
    for s in observations.series:
        name = parse_name(s.channel)
        if name is not None and name.quantity == "motor_current" and name.joint == "drive":
            wheels = shared.get(name.corner, 1)
            found.append(np.abs(observations.value[s.start : s.stop]) / wheels)
            noise.append(np.broadcast_to(np.hypot(s.white, s.coloured), s.stop - s.start) / wheels)
    if not found:
        return 0.0
    # Not the root mean square: where commands jump, rotors take tens of times what the ground does.
    middle = float(np.median(np.concatenate(found)))
    return middle if middle > USUAL_DRIVE.heard * float(np.median(np.concatenate(noise))) else 0.0
