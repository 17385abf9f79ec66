"""Friction of bearing and gear at the joints (port `motor_torque`).

Explicit forces of friction must not turn a joint around within a time step: the slope of every friction by speed
stays below J/dt, J being the joint's inertia with its rotor (the rotor's alone where the other is unknown). Dry
friction is then spread over more speed than its parameter says, and viscous friction is weaker; below these limits
(friction torque less than J omega_s/dt, damping less than J/dt: for a drive of VIPER 4 N m at 0.02 rad/s and 200 N m
s/rad at a time step of 2 ms, for one of LUVMI-X 0.6 N m and 30 N m s/rad) nothing is changed. The energy lost here
heats nothing unless gear_friction_heat is in the list.
"""

from __future__ import annotations

from typing import Annotated, Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE

_LEAST_INERTIA: Annotated[float, "kg m2"] = 1e-3
"""kg m2 at a joint that weighs nothing."""


def largest_damping(ctx) -> Any:
    """J/dt, N m s/rad: damping that an explicit step still takes without turning the joint around."""
    motor, inertia = ctx.parameters.get("motor"), 0.0
    if motor is not None:
        inertia = motor.rotor_inertia * motor.gear_ratio**2
    if ctx.rover.joint_inertia is not None:
        inertia = inertia + ctx.rover.joint_inertia
    return jnp.maximum(inertia, _LEAST_INERTIA) / ctx.dt


def speed_sign(ctx, level: Any, scale: Any) -> Any:
    """tanh(omega/omega_s), with omega_s as large as a friction torque of `level`, N m, needs for stability."""
    # A smoothing speed that grows with the torque keeps the slope within J/dt at any friction that a fit may try.
    return jnp.tanh(ctx.joint_speed / jnp.maximum(scale, level / largest_damping(ctx)))


_SPEED = Parameter(
    0.02,
    None,
    (1e-4, 1.0),
    "rad/s",
    "speed of the joint at which friction has nearly its full size",
    "choice: stable at 2 ms, 1/20 of a drive's speed",
    axis="joint",
)


@effect(
    "motor_torque",
    order=10,
    torque=Parameter(
        0.4,
        0.0,
        (0.0, 50.0),
        "N m",
        "Coulomb friction at the joint",
        "no-load current of the maxon ECX TORQUE 22 XL 48 V (0.052 A) through 243:1, with seals; choice",
        axis="joint",
    ),
    speed=_SPEED,
)
def coulomb_friction(ctx, p, x, torque):
    """tau_f = tau_c tanh(omega/omega_s) against the speed. It creeps at standstill: no break-away force is held.

    Source: MuJoCo's dcmotor note (Coulomb friction); regularised as usual in simulation (Olsson et al. 1998).
    """
    return torque - p.torque * speed_sign(ctx, p.torque, p.speed)


@effect(
    "motor_torque",
    order=11,
    torque=Parameter(
        0.3,
        0.0,
        (0.0, 50.0),
        "N m",
        "static friction beyond Coulomb's, at low speed",
        "choice: static friction 1.75 times the sliding one",
        axis="joint",
    ),
    stribeck_speed=Parameter(
        0.1,
        None,
        (1e-3, 10.0),
        "rad/s",
        "speed over which static friction fades",
        "choice: a tenth of the largest speed of a drive",
        axis="joint",
    ),
    speed=_SPEED,
)
def stribeck_friction(ctx, p, x, torque):
    """tau_f = (tau_s - tau_c) exp(-(omega/omega_st)^2) tanh(omega/omega_s), beside Coulomb's.

    Source: Armstrong-Helouvry et al. 1994.
    """
    # Smoothed by the same sign as Coulomb's, so that the sum of both stays odd in the speed and zero at rest.
    fade = jnp.exp(-((ctx.joint_speed / p.stribeck_speed) ** 2))
    return torque - p.torque * fade * speed_sign(ctx, p.torque, p.speed)


@effect(
    "motor_torque",
    order=12,
    damping=Parameter(
        0.3, 0.0, (0.0, 500.0), "N m s/rad", "viscous friction at the joint", "choice: 0.3 N m at 1 rad/s", axis="joint"
    ),
)
def viscous_friction(ctx, p, x, torque):
    """tau_f = b omega (MuJoCo's dcmotor note)."""
    # Beyond J/dt an explicit step would turn the joint around.
    return torque - jnp.minimum(p.damping, largest_damping(ctx)) * ctx.joint_speed


@effect(
    "motor_torque",
    order=13,
    damping=Parameter(
        0.1,
        0.0,
        (0.0, 100.0),
        "N m s/rad",
        "viscous friction of the grease at 25 degC",
        "choice: a third of all viscous friction",
        axis="joint",
    ),
    rate=Parameter(
        0.025,
        None,
        (0.0, 0.1),
        "1/K",
        "growth of the grease's viscosity with cold",
        "choice: tenfold from 25 to -67 degC, a low-temperature space grease",
    ),
)
def cold_grease(ctx, p, x, torque):
    """tau_f = b_0 exp(-kappa (T_S - T_0)) omega with the housing's temperature and T_0 = 25 degC.

    The exponent stays within +-12 (a factor of 1.6e5). The power of a planetary gear rises towards -190 degC in
    Sci. Rep. 12:21815; that one runs dry on MoS2, so kappa is a choice and is meant to be fitted.
    """
    # The housing's temperature: the grease is in the gear, whose metal follows the housing and not the winding.
    exponent = jnp.clip(-p.rate * (ctx.housing_temperature - REFERENCE_TEMPERATURE), -12.0, 12.0)
    return torque - jnp.minimum(p.damping * jnp.exp(exponent), largest_damping(ctx)) * ctx.joint_speed


@effect(
    "motor_torque",
    requires=("motor",),
    order=5,
    asymmetry=Parameter(
        1.0,
        0.0,
        (0.0, 1.5),
        "1",
        "0: eta both ways; 1: eta driving, 1/eta when driven back",
        "MuJoCo's dcmotor note: tau_o = N tau eta^sgn(tau omega)",
        axis="joint",
    ),
    speed=Parameter(
        0.05,
        None,
        (1e-4, 1.0),
        "rad/s",
        "speed of the joint at which the direction is decided",
        "choice: stable at 2 ms",
        axis="joint",
    ),
)
def directional_gear_efficiency(ctx, p, x, torque):
    """tau_o = N tau eta^sgn(tau omega), with tanh(omega/omega_s) for sgn(omega).

    The motor's N eta K I is multiplied by 1 + a (eta^(s - 1) - 1), s = sgn(tau) tanh(omega/omega_s): 1 driving, eta^-2
    driven back, and a gear at rest holds without loss. Without this effect a motor that is driven back returns more
    power than it takes up.
    """
    eta = ctx.parameters["motor"].gear_efficiency
    # The loss acts as a friction that grows with the torque: half of the difference between driving and being driven.
    level = 0.5 * p.asymmetry * (eta**-2 - 1.0) * jnp.abs(torque)
    way = jnp.sign(torque) * speed_sign(ctx, level, p.speed)
    # expm1, because while driving (way = 1) the change must be exactly zero.
    return torque + p.asymmetry * jnp.expm1((way - 1.0) * jnp.log(eta)) * torque


def _ripple(part: str) -> Parameter:
    return Parameter(
        0.2,
        0.0,
        (-20.0, 20.0),
        "N m",
        f"{part} part of the ripple's amplitude at the joint",
        "choice: 1 % of a drive's largest torque",
        axis="joint",
    )


@effect(
    "motor_torque",
    order=14,
    sine=_ripple("sine"),
    cosine=_ripple("cosine"),
    cycles=Parameter(
        17.0,
        None,
        (1.0, 1e5),
        "1",
        "ripples per revolution of the joint",
        "choice: teeth of the last sun wheel; gear ratio times slots for the motor's own cogging",
    ),
)
def cogging(ctx, p, x, torque):
    """tau = A sin(N_p theta) + B cos(N_p theta) with the joint's angle, linear in both parts.

    It makes no energy over a revolution. Source: MuJoCo's dcmotor note (cogging).
    """
    # By the joint's angle and not by time: teeth and magnets stand still on the joint.
    phase = p.cycles * ctx.joint_angle
    return torque + p.sine * jnp.sin(phase) + p.cosine * jnp.cos(phase)
