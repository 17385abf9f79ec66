"""Soil that slides while it carries a wheel: softer where sheared, entering beside the rim, held by the flank."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.bulldozing import passive_pressure
from lunar_mjx.effects.slip_sinkage import clipped_slip
from lunar_mjx.effects.wheel import contact_with_soil, grounded, mean_decay, sin_difference
from lunar_mjx.spatial import Vec3

_STILL = 2e-3
"""m/s; below it a wheel counts as standing, as for the slip ratio."""
_FLAT = 1e-3
"""Slip below which the root of two squares is rounded off."""
_LONGEST = 0.9
"""Share of the true contact time of a braked wheel, which has no limit for a locked one."""
_ACROSS, _ACROSS_WEIGHTS = (a.tolist() for a in np.polynomial.legendre.leggauss(3))
_ALONG, _ALONG_WEIGHTS = (a.tolist() for a in np.polynomial.legendre.leggauss(6))


def _first_axis(values, like):
    """Numbers along a new first axis, in front of those of `like`."""
    return jnp.reshape(jnp.asarray(values, jnp.result_type(like)), (-1,) + (1,) * jnp.ndim(like))


def slip_angle_tangent(contact):
    """|v_y|/|v_x|, fading to 0 at standstill; 1000 at most."""
    return jnp.abs(contact.v_y) / jnp.sqrt(contact.v_x**2 + (1e-3 * contact.v_y) ** 2 + _STILL**2)


def scaled_stress(ctx, normal, factor):
    """The normal stress times `factor(theta)`: at every node where it is integrated, else at its maximum."""
    if normal.stress is None:
        f = factor(normal.theta_m)
        return dataclasses.replace(normal, sigma_m=normal.sigma_m * f, load=normal.load * f,
                                   resistance=normal.resistance * f)  # fmt: skip
    # Nodes along a first axis: written out one by one they take minutes to compile.
    theta, weight, old = (jnp.stack([v + 0.0 * normal.load for v in values])
                          for values in (normal.stress.theta, normal.stress.weight, normal.stress.sigma))  # fmt: skip
    f = factor(theta)
    change = ctx.geometry.radius * ctx.geometry.width * weight * old * (f - 1.0)
    # What changes is added, so that nothing is rounded where nothing changes.
    return dataclasses.replace(
        normal, sigma_m=normal.sigma_m * factor(normal.theta_m),
        load=normal.load + jnp.sum(change * jnp.cos(theta), axis=0),
        resistance=normal.resistance + jnp.sum(change * jnp.sin(theta), axis=0),
        stress=dataclasses.replace(normal.stress, sigma=tuple(old * f)),
    )  # fmt: skip


@effect(
    "soil",
    order=5,
    softening=Parameter(0.7, 0.0, (0.0, 20.0), "1", "loss of stiffness by sliding as fast as the wheel moves",
                        "choice: stress of a plate that moves along itself, about half of one that moves into the "
                        "ground (Li, Zhang & Goldman 2013)"),
)  # fmt: skip
def slide_softening(ctx, p, x, ground):
    """k_c and k_phi over 1 + a S, S = |(r omega - v_x, v_y)|/max(r omega, V): soil slid over carries less.

    Granular resistive force theory (Li, Zhang & Goldman 2013, Science 339:1408) measures that the stress on a surface
    falls as its motion turns from into the ground to along it, whatever the direction; this is that fall for the wheel
    as a whole, slip, skid and slip angle in one.
    """
    c = ctx.contact
    fastest = jnp.maximum(jnp.abs(c.rim_speed), jnp.sqrt(c.v_x**2 + c.v_y**2 + _STILL**2))
    along, across = (c.rim_speed - c.v_x) / fastest, c.v_y / fastest
    sliding = jnp.sqrt(along**2 + across**2 + _FLAT**2) - _FLAT
    factor = 1.0 / (1.0 + p.softening * sliding)
    return dataclasses.replace(ground, k_c=ground.k_c * factor, k_phi=ground.k_phi * factor)


@effect(
    "wheel_normal",
    order=2,
    kept=Parameter(
        0.4,
        1.0,
        (0.0, 1.0),
        "1",
        "share of its depth's pressure that soil entering from the side has",
        "choice: between none and all",
    ),
)
def side_entry(ctx, p, x, normal):
    """Soil that comes under the wheel from its side has been pressed only since: p = k (d - (1 - kappa) d_e)^n.

    Bekker's pressure belongs to a column of soil that the rim has pressed from the surface down to d. At a slip
    angle soil also enters across the leading edge, below the surface, at a depth d_e; a column at y from that edge
    entered at x_e = x + y/tan(beta), or in front if that is beyond the entrance. The factor ((d - (1 - kappa)
    d_e)/d)^n is averaged over the width (3 Gauss points). Geometry alone gives its course with the slip angle: it does
    not depend on how fast the wheel turns. Reason stated here; measured: sinkage grows with the slip angle at all
    slips, spinning wheels included (CMU single-wheel test bed).
    """
    contact, geometry, soil = contact_with_soil(ctx), ctx.geometry, ctx.soil
    r, theta_1 = geometry.radius, normal.entrance
    entrance = r * jnp.sin(jnp.minimum(theta_1, 0.5 * jnp.pi))
    reach = geometry.width / jnp.maximum(slip_angle_tangent(contact), 1e-6)

    def factor(theta):
        place = r * jnp.sin(theta)
        pressed = jnp.maximum(r * (jnp.cos(jnp.maximum(theta, 0.0)) - jnp.cos(theta_1)), 1e-9 * r)
        node, weight = _first_axis(_ACROSS, place), _first_axis(_ACROSS_WEIGHTS, place)
        enters = place + 0.5 * (1.0 + node) * reach
        beside = enters < entrance * (1.0 - 1e-6)
        height = jnp.sqrt(jnp.where(beside, r * r - jnp.where(beside, enters, 0.0) ** 2, r * r))
        depth = jnp.where(beside, jnp.maximum(height - r * jnp.cos(theta_1), 0.0), 0.0)
        left = 1.0 - (1.0 - p.kept) * jnp.minimum(depth / pressed, 1.0)
        return 1.0 + jnp.sum(0.5 * weight * (jnp.maximum(left, 1e-9) ** soil.n - 1.0), axis=0)

    return scaled_stress(ctx, normal, factor)


@effect(
    "wheel_normal",
    order=3,
    loss=Parameter(
        0.6,
        0.0,
        (0.0, 0.98),
        "1",
        "share of the pressure lost where the shear is fully mobilised",
        "choice: sinkage about twofold at full slip",
    ),
)
def shear_softening(ctx, p, x, normal):
    """sigma = p (1 - lambda (1 - exp(-j))): soil that has been sheared under the wheel carries less.

    Slip-sinkage by the shear displacement itself, along and across together (Lyasko 2010 explains it so; bearing
    capacity falls with the inclination of the load, Meyerhof 1963). j^2 = (j_x/K_x)^2 + (j_y/K_y)^2 at each place of
    the arc, with the displacements of Janosi & Hanamoto 1961 for the time that soil is under the wheel.
    """
    contact, soil, r = contact_with_soil(ctx), ctx.soil, ctx.geometry.radius
    slip = clipped_slip(contact)
    slip_x = slip / (1.0 + _LONGEST * jnp.minimum(slip, 0.0))
    rim, travel = jnp.abs(contact.rim_speed), jnp.abs(contact.v_x)
    pace = rim + (1.0 - _LONGEST) * jnp.maximum(travel - rim, 0.0)
    slip_y = contact.v_y / jnp.sqrt(pace**2 + _STILL**2)

    def factor(theta):
        arc = sin_difference(normal.entrance, theta)
        q_x = r * ((normal.entrance - theta) - arc + slip_x * arc) / soil.shear_modulus_x
        q_y = r * (normal.entrance - theta) * slip_y / soil.shear_modulus_y
        return 1.0 + p.loss * jnp.expm1(-jnp.sqrt(q_x**2 + q_y**2 + 1e-24))

    return scaled_stress(ctx, normal, factor)


@effect(
    "wheel_shear",
    order=-8,
    share=Parameter(
        0.9,
        0.0,
        (0.0, 0.99),
        "1",
        "0: contact time of eq. 9; 1: that of the wheel's own turning",
        "choice: a locked wheel's contact has no end",
    ),
)
def skid_shear(ctx, p, x, wheel):
    """Soil stays under a braked wheel for (theta_1 - theta)/omega: j grows by v_x/(r omega) over what eq. 9 says.

    The slip of eq. 8, referred to v_x when braking, makes the displacement finite for a locked wheel, and much too
    small. With s = 1 - r omega/v_x: slip_x/(1 - q s) and slip_y/((1 - q s)(1 + q s)), which at q = 1 is the
    kinematics of Janosi & Hanamoto 1961, j_x = int (v_x - r omega cos) dt and j_y = int v_y dt.
    """
    skid = jnp.clip(-jnp.sign(wheel.direction) * wheel.slip_x, 0.0, 1.0)
    stretch = 1.0 / (1.0 - p.share * skid)
    return dataclasses.replace(
        wheel, slip_x=wheel.slip_x * stretch, slip_y=wheel.slip_y * stretch / (1.0 + p.share * skid)
    )


@effect(
    "wheel_shear",
    order=6,
    pressure=Parameter(1.0, 0.0, (0.0, 10.0), "1", "share of the passive earth pressure on the flank",
                       "1: a long wall (Hegedus); short walls have more"),
    friction=Parameter(1.0, None, (0.0, 2.0), "1", "friction of the flank over the soil's own", "rough wall"),
    density=Parameter(1600.0, None, (500.0, 5000.0), "kg/m3", "bulk density of the soil",
                      "Lunar Sourcebook: 1500 to 1700 near the surface"),
)  # fmt: skip
def side_wall(ctx, p, x, wheel):
    """The wheel's leading flank pushes soil aside along its whole buried length, and drags in it.

    Passive pressure D_1 (c h + D_2 rho g h^2/2) (Hegedus; Ishigami et al. 2007) over -r sin(theta_1) .. r sin(theta_1),
    with h of the circle at each place (6 Gauss points), mobilised by the displacement slip_y (r sin(theta_1) - x) since
    the soil met the flank. Coulomb friction of that pressure acts against the flank's own velocity at two thirds of h,
    (v_x - omega (r - z + 2h/3), -omega x): it brakes a skidding wheel, and drives a spinning one.
    """
    contact, geometry, normal, soil = contact_with_soil(ctx), ctx.geometry, ctx.normal, ctx.soil
    r, weight = geometry.radius, p.density * ctx.gravity
    soft = grounded(contact, jnp.where(soil.rock > 0.5, 0.0, 1.0))
    length = r * jnp.sin(jnp.minimum(normal.entrance, 0.5 * jnp.pi))
    axle = r * jnp.cos(normal.entrance)
    turning = contact.rim_speed / r
    ahead = jnp.where(wheel.direction < 0.0, -1.0, 1.0)
    along = length * _first_axis(_ALONG, length)
    h = jnp.maximum(jnp.sqrt(jnp.maximum(r * r - along * along, 1e-12 * r * r)) - axle, 0.0)
    q = (length - along) * wheel.slip_y / soil.shear_modulus_y
    wall = _first_axis(_ALONG_WEIGHTS, length) * length * passive_pressure(soil, weight, h, h * h)
    push = p.pressure * soft * wall * q * mean_decay(jnp.abs(q))
    arm, place = axle + 2.0 / 3.0 * h, ahead * along
    u_x, u_z = contact.v_x - turning * arm, -turning * place
    speed = jnp.sqrt(u_x**2 + u_z**2 + (_YIELD * contact.v_y) ** 2 + _STILL**2)
    drag = p.friction * soil.tan_phi * jnp.abs(push) / speed
    d_x, d_z = -drag * u_x, -drag * u_z
    force = Vec3(jnp.sum(d_x, axis=0), -jnp.sum(push, axis=0), jnp.sum(d_z, axis=0))
    moment = Vec3(-jnp.sum(arm * push, axis=0), -jnp.sum(arm * d_x + place * d_z, axis=0),
                  -jnp.sum(place * push, axis=0))  # fmt: skip
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


_YIELD = 0.3
"""Speed of the soil along the flank as it is pushed aside, over the lateral speed: it takes its share of friction."""
