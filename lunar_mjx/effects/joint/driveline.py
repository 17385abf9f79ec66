"""Between command and joint: delay of the command, wind-up and play of motor against joint (port `command`).

Wind-up and play are those of a motor without mass that is controlled by the encoder on its own shaft: a second, stiff
inertia is not added, and the rotor's inertia stays with the joint. That holds below the resonance of rotor and spring,
sqrt(k_s/(N^2 J)), 300 rad/s for the nominal drive. Joint angles in the context and in logs are those of the output.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect
from lunar_mjx.effects.joint.motor import POSITION, VELOCITY, asked_per_ampere

EVENTS = 8
"""Changes of the command that a delay remembers."""

_LONG_AGO = 1e3
"""s; age of a change that no delay reaches back to."""


def _delay_memory() -> dict[str, StateVariable]:
    values = {
        f"value_{i}": StateVariable(0.0, "1", f"command before the last {i} changes, in its unit", axis="joint")
        for i in range(EVENTS + 1)
    }
    ages = {
        f"age_{i}": StateVariable(_LONG_AGO, "s", f"time since the change before the last {i}", axis="rover")
        for i in range(EVENTS)
    }
    return values | ages


@effect(
    "command",
    order=-10,
    state=_delay_memory(),
    delay=Parameter(
        0.05,
        0.0,
        (0.0, 2.0),
        "s",
        "delay between command and action",
        "choice: a bus cycle and a control cycle of 20 Hz equipment",
    ),
)
def actuator_delay(ctx, p, x, command):
    """u(t - delta): the joints act on the command of delta ago; within the step in which it arrives, on its mean.

    The last 8 changes of the command (of any joint) are remembered with their times, so the delay is exact, not
    rounded to steps, and its derivative at delta = 0 is -(u_k - u_(k-1))/dt at every change. Limit: a delay of more
    than 8 changes acts as one of 8 (0.4 s at commands of 20 Hz that all differ; 16 ms for commands new at every step of
    2 ms). Before the first command all were zero. Source: mujoco.sysid has a delay as a parameter of measurement.
    """
    values = [getattr(x, f"value_{i}") for i in range(EVENTS + 1)]
    ages = [getattr(x, f"age_{i}") for i in range(EVENTS)]
    # Commands of all joints share one list of times: they come from one computer, in one message.
    changed = jnp.any(command.target != values[0])
    values = [jnp.where(changed, new, old) for new, old in zip([command.target, *values[:-1]], values, strict=True)]
    ages = [jnp.where(changed, new, old) for new, old in zip([0.0, *ages[:-1]], ages, strict=True)]
    target = command.target
    for i, age in enumerate(ages):
        # share of this step during which the change is still on its way
        # The share, and no whole step, makes the delay continuous: a fit has a derivative by it.
        share = jnp.where(p.delay >= age, jnp.minimum((p.delay - age) / ctx.dt, 1.0), 0.0)
        target = target + share * (values[i + 1] - values[i])
    memory = {f"value_{i}": v for i, v in enumerate(values)}
    # The age grows after use: a change made at this step is of age 0 within it.
    memory |= {f"age_{i}": age + ctx.dt for i, age in enumerate(ages)}
    return dataclasses.replace(command, target=target), memory


def _loop_gains(rover: Any) -> tuple[Any, Any, Any]:
    """Position gain, N m/rad, velocity gain, N m s/rad, and whether a loop on the motor's angle or speed is closed."""
    position = rover.mode == POSITION
    closed = position | (rover.mode == VELOCITY)
    return jnp.where(position, rover.position_gain, 0.0), jnp.where(closed, rover.velocity_gain, 0.0), closed


@effect(
    "command",
    order=51,
    state={"current": StateVariable(0.0, "A", "current that winds the driveline up", axis="joint")},
    compliance=Parameter(
        2e-4,
        0.0,
        (0.0, 0.1),
        "rad/(N m)",
        "wind-up of the driveline per torque, 1/k_s",
        "choice: 5000 N m/rad, gearhead and shaft of a drive",
        axis="joint",
    ),
)
def driveline_compliance(ctx, p, x, command):
    """theta_motor/N = theta + c tau: the controller holds the motor, and the joint lags behind by the wind-up.

    tau + c (k_p tau + k_d dtau/dt) = tau_0, the torque of the rigid driveline; one implicit Euler step of it. Torque
    and current control do not feel it. Energy stored in the spring is given back.
    """
    k_p, k_d, _ = _loop_gains(ctx.rover)
    rigid = command.current
    softening = k_p * ctx.dt * rigid + k_d * (rigid - x.current)
    # Implicit: an explicit spring as stiff as a gearhead's would need steps of microseconds.
    current = rigid - p.compliance * softening / (ctx.dt + p.compliance * (k_p * ctx.dt + k_d))
    return dataclasses.replace(command, current=current), {"current": current}


@effect(
    "command",
    requires=("motor",),
    order=52,
    state={"gap": StateVariable(0.0, "rad", "motor ahead of the joint within the play", axis="joint")},
    half_gap=Parameter(
        0.007,
        0.0,
        (0.0, 0.2),
        "rad",
        "half of the play between motor and joint, at the joint",
        "maxon planetary gearheads: about 1 deg of play at no load; choice 0.8 deg",
        axis="joint",
    ),
)
def backlash(ctx, p, x, command):
    """Play operator: theta_motor/N - theta = g within +-delta; torque and current pass only at either end.

    A free motor turns through the play at the speed that its controller asks for, k_d dg/dt + k_p g = tau_0, and the
    step in which it arrives passes its share of tau_0. Torque and current control jump across at once, and the jolt of
    the landing rotor is left out.
    """
    k_p, k_d, closed = _loop_gains(ctx.rover)
    per_ampere = asked_per_ampere(ctx.parameters)  # the speed of a free motor is what its controller asks for
    stiffness = k_d + k_p * ctx.dt
    acts = closed & (stiffness > 0.0)
    # Where no loop is closed the division below is computed all the same and dropped: it must stay finite for its
    # derivative.
    stiffness = jnp.where(acts, stiffness, 1.0)
    free = (k_d * x.gap + ctx.dt * per_ampere * command.current) / stiffness
    gap = jnp.where(free > p.half_gap, p.half_gap, jnp.where(free < -p.half_gap, -p.half_gap, free))
    # What the ends cut off of the free motion is the share of the step for which the torque passes.
    passed = command.current + (k_d * x.gap - stiffness * gap) / (ctx.dt * per_ampere)
    current = jnp.where(acts, passed, command.current)
    return dataclasses.replace(command, current=current), {"gap": jnp.where(acts, gap, x.gap)}
