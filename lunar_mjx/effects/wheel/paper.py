"""The seed paper's wheel, as printed, flaws included; singular points are regularised and listed.

Every flaw is a parameter that goes from 0 (as printed) to 1 (mended), or an effect that a mended one replaces.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.wheel.closed_form import (
    entrance_angle,
    geometry_factors,
    grounded,
    janosi,
    max_normal_stress,
    sin_difference,
)
from lunar_mjx.spatial import Vec3

SPEED_FLOOR: Annotated[float, "m/s"] = 0.02
"""Smallest denominator of eqs. 8 and 9 in the printed form, m/s."""

REGULARISATIONS = {
    "eq. 8, slip ratio": f"denominators r omega and v_x kept at least {SPEED_FLOOR} m/s from zero; s within [-1, 1]",
    "eq. 9, slip angle": "0 where the wheel stands still; |beta| at most 89 deg, so that tan(beta) stays finite",
    "tau_m": "exponent -j/K_s at most 3, because j as printed can be negative, where exp(-j/K_s) grows without bound; "
    "odd in j where mend_j = 1",
    "eq. 11, F_S": "opposes the lateral velocity, with |tau_m|; the paper gives no sign",
    "friction at standstill": "mu F_N tanh(|v|/v_e): the printed mu F_N has no direction at rest",
    "A and B at theta_m = 0": "half-angle form with sinkage of at least 1e-9 r",
    "F_N": "never pulls: k_N z + c_N zdot at least zero",
}
"""What the printed equations leave undefined, and what is done there."""


def _away_from_zero(value, floor):
    return jnp.where(jnp.abs(value) < floor, jnp.where(value < 0.0, -floor, floor), value)


def printed_slip(contact):
    """Eq. 8 as printed, which has the wrong sign when backing up; clipped to [-1, 1]."""
    rim, v_x = contact.rim_speed, contact.v_x
    driving = rim > v_x
    slip = (rim - v_x) / _away_from_zero(jnp.where(driving, rim, v_x), SPEED_FLOOR)
    return jnp.clip(slip, -1.0, 1.0)


def printed_slip_angle(contact):
    """Eq. 9 as printed, within 89 deg of the axes where tan(beta) is finite; rad."""
    moving = contact.v_x**2 + contact.v_y**2 > SPEED_FLOOR**2
    # arccos(v_x/|v|) sign(v_y) is the arc tangent, whose derivative is finite where v_y = 0
    angle = jnp.arctan2(contact.v_y, jnp.where(moving, contact.v_x, 1.0))
    return jnp.where(moving & (contact.v_y != 0.0), angle, 0.0)


@effect(
    "wheel_normal",
    replaces=("pressure_sinkage",),
    stiffness=Parameter(
        5e4, None, (1e2, 1e8), "N/m", "contact stiffness k_N", "paper's release: 5e4 to 1e6; lower end chosen"
    ),
    damping=Parameter(
        300.0,
        0.0,
        (0.0, 1e6),
        "N s/m",
        "contact damping c_N",
        "paper's release: 1e2 to 1e5; chosen stable for a 1 kg wheel at 2 ms",
    ),
)
def penalty_contact(ctx, p, x, normal):
    """F_N = k_N z + c_N zdot on every ground (flaw 2): 0.02 to 0.4 mm deep, where the soil carries next to nothing."""
    contact, geometry = ctx.contact, ctx.geometry
    theta_1 = entrance_angle(contact.sinkage, geometry.radius)
    load = p.stiffness * contact.sinkage
    sigma_m = max_normal_stress(ctx.soil, geometry.width, geometry.radius, 0.5 * theta_1, theta_1)
    return dataclasses.replace(
        normal,
        entrance=theta_1,
        theta_m=0.5 * theta_1,
        sigma_m=grounded(contact, sigma_m),
        load=grounded(contact, load),
        damping=grounded(contact, jnp.maximum(p.damping * contact.sinkage_rate, -load)),
    )


def _mend(number, what):
    return Parameter(0.0, None, (0.0, 1.0), "1", f"0: as printed; 1: {what}", f"flaw {number} of the paper")


@effect(
    "wheel_shear",
    replaces=("closed_form_shear", "stress_integral"),
    mend_j=_mend(3, "radius in both terms of j"),
    mend_slip=_mend(4, "slip defined for both directions of travel"),
    mend_shear_radius=_mend(5, "r_s with the shear, r with the normal stress"),
    mend_side=_mend(6, "lateral force with its own shear displacement, and M_S without theta_s"),
    shear_radius=Parameter(1.0, None, (0.8, 1.3), "1", "shearing radius r_s over the radius r", "seed paper: r_s = r"),
)
def printed_shear(ctx, p, x, wheel):
    """Eqs. 8-14 as printed. theta_s of eq. 14, which the paper does not define, is read as the steering angle.

    F_DP, F_S, M_R, M_O and M_S are applied at the wheel's centre; F_N comes from the port `wheel_normal` and holds no
    share of the shear stress. Rock carries no soil force.
    """
    contact, geometry, normal, soil = ctx.contact, ctx.geometry, ctx.normal, ctx.soil
    r, b, r_s = geometry.radius, geometry.width, p.shear_radius * geometry.radius
    theta_1, theta_m = normal.entrance, normal.theta_m
    a_factor, b_factor = geometry_factors(theta_m)
    arc = sin_difference(theta_1, theta_m)
    heading = jnp.where(p.mend_slip > 0.5, jnp.where(wheel.direction < 0.0, -1.0, 1.0), 1.0)
    slip = jnp.where(p.mend_slip > 0.5, heading * wheel.slip_x, printed_slip(contact))
    # As printed, the second term of j has no radius: a length is subtracted from a pure number.
    lever = p.mend_j * r_s + (1.0 - p.mend_j)
    j = r_s * (theta_1 - theta_m) - lever * (1.0 - slip) * arc
    strength = jnp.where(soil.rock > 0.5, 0.0, grounded(contact, soil.cohesion + normal.sigma_m * soil.tan_phi))
    sigma_m = jnp.where(soil.rock > 0.5, 0.0, normal.sigma_m)
    # As printed j can be negative, where the exponential grows without bound (see REGULARISATIONS).
    printed_share = -jnp.expm1(jnp.minimum(-j / soil.shear_modulus_x, 3.0))
    tau = strength * jnp.where(p.mend_j > 0.5, janosi(j, soil.shear_modulus_x), printed_share)
    normal_radius = p.mend_shear_radius * r + (1.0 - p.mend_shear_radius) * r_s
    shear_radius = p.mend_shear_radius * r_s + (1.0 - p.mend_shear_radius) * r
    drawbar = shear_radius * b * tau * a_factor - normal_radius * b * sigma_m * b_factor
    # 1.553 rad are 89 deg.
    tangent = jnp.tan(jnp.clip(printed_slip_angle(contact), -1.553, 1.553))
    mended_side = p.mend_side > 0.5
    # |tan(beta)| inside and the sign outside: opposing, also where eq. 9 puts beta beyond 90 deg
    lateral = r * jnp.abs((1.0 - slip) * tangent) * theta_m / soil.shear_modulus_y
    printed_side = jnp.sign(contact.v_y) * jnp.abs(tau) * -jnp.expm1(-jnp.minimum(lateral, 50.0))
    # mended, the sign is that of the displacement, so that a wheel that stands holds against the slope
    own_side = strength * janosi(r * theta_m * wheel.slip_y, soil.shear_modulus_y)
    side = -r_s * b * theta_m * jnp.where(mended_side, own_side, printed_side)
    theta_s = (1.0 - p.mend_side) * (ctx.steering_angle + geometry.toe)
    force = Vec3(heading * drawbar, side, normal.load + normal.damping)
    moment = Vec3(
        r * side,
        -heading * r_s * r_s * b * tau * theta_m,
        # The second term is that of eq. 14 as printed; it vanishes for wheels that point straight ahead.
        jnp.where(mended_side, heading, 1.0) * jnp.sin(theta_m) * r * side - drawbar * b * theta_s / (8.0 * jnp.pi),
    )
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


@effect(
    "wheel_shear",
    order=10,
    mu=Parameter(0.8, 0.0, (0.0, 2.0), "1", "friction coefficient of the ground", "paper's release: 0.7 to 0.9"),
    speed_scale=Parameter(
        0.05,
        None,
        (1e-4, 1.0),
        "m/s",
        "sliding speed v_e of full friction",
        "choice: stable with explicit forces at 2 ms",
    ),
)
def engine_friction(ctx, p, x, wheel):
    """f = mu F_N against the sliding of the rim, on rock and soil alike: the physics engine's own contact friction.

    The paper's engine keeps it on under the soil forces, and it alone carries the rover there, because the soil forces
    are of the order of 0.02 N (flaw 2). No static friction: a parked rover creeps (flaw 4).
    """
    contact, radius = ctx.contact, ctx.geometry.radius
    slide_x, slide_y = contact.v_x - contact.rim_speed, contact.v_y
    # The root's floor, a micrometre per second, gives a derivative at rest.
    speed = jnp.sqrt(slide_x**2 + slide_y**2 + 1e-12)
    load = ctx.normal.load + ctx.normal.damping
    friction = p.mu * load * jnp.tanh(speed / p.speed_scale) / speed
    force = Vec3(-friction * slide_x, -friction * slide_y, jnp.zeros_like(load))
    return dataclasses.replace(
        wheel,
        force=wheel.force + force,
        moment=wheel.moment + Vec3(radius * force.y, -radius * force.x, jnp.zeros_like(load)),
    )
