"""Small resisting torques at the joints (port `body_wrench`)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect

DRIVE, SUSPENSION = 0, 2
"""Entries of `RoverInfo.joint_group`."""


def _resist(ctx, wrench, group, torque, speed_scale):
    # tanh instead of a sign: an explicit force that jumped at zero would shake a joint at rest from step to step.
    against = torque * jnp.tanh(ctx.joint_speed / speed_scale)
    mine = jnp.where(ctx.rover.joint_group == group, against, 0.0)
    return dataclasses.replace(wrench, joint_torque=wrench.joint_torque - mine)


@effect(
    "body_wrench",
    torque=Parameter(
        5.0,
        0.0,
        (0.0, 1e4),
        "N m",
        "Coulomb friction of a suspension joint",
        "choice: some per cent of a corner's weight times its arm",
        axis="joint",
    ),
    speed_scale=Parameter(
        0.01,
        None,
        (1e-4, 10.0),
        "rad/s",
        "joint speed of full friction",
        "choice: stable with explicit torques at 2 ms",
    ),
)
def suspension_friction(ctx, p, x, wrench):
    """tau = -tau_c tanh(omega/omega_0) at the suspension joints: Coulomb friction, smoothed (Andersson et al. 2007).

    Pitch and roll lag behind the ground and the load on the wheels depends on how they got there (hysteresis).
    """
    return _resist(ctx, wrench, SUSPENSION, p.torque, p.speed_scale)


@effect(
    "body_wrench",
    torque=Parameter(
        1e-4,
        0.0,
        (0.0, 1e-3),
        "N m",
        "drag at a drive joint",
        "electrostatic adhesion of dust and pressure of sunlight: far below 1 mN m",
    ),
    speed_scale=Parameter(0.01, None, (1e-4, 10.0), "rad/s", "joint speed of full drag", "choice"),
)
def dust_charging(ctx, p, x, wrench):
    """tau = -tau_d tanh(omega/omega_0) at the drive joints, at most 1 mN m: charged dust, sunlight (Lunar Sourcebook).

    A negative control: five orders of magnitude below a drive's torque, no log of a rover can show it, and a tool that
    names it is wrong.
    """
    return _resist(ctx, wrench, DRIVE, p.torque, p.speed_scale)
