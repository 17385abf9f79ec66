"""Soil that slides while it carries a wheel: softer where sheared, entering beside the rim, held by the flank."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Effect, Parameter, effect
from lunar_mjx.effects.wheel.bulldozing import BULK_DENSITY, STILL
from lunar_mjx.effects.wheel.closed_form import contact_with_soil, first_axis, grounded, mean_decay, sin_difference
from lunar_mjx.spatial import Vec3


@dataclasses.dataclass(frozen=True)
class SlidingLimits:
    """Where the laws of sliding are rounded off."""

    flat: float = 1e-3
    """Slip below which the root of two squares is rounded off."""
    longest: float = 0.9
    """Share of the true contact time of a braked wheel, which has no limit for a locked one."""
    shortest_turn: float = 0.01
    """Least 1 + s: beyond a skid of 99 % the displacement is 100 times that of eq. 9 and more, tens of moduli K."""
    shortest_arc: float = 0.05
    """Least mean cosine over the front of the arc: wheels sunk to the axle, where the front stands upright."""
    spread: float = 0.3
    """Spread of the speed of the soil along the flank, over the lateral speed: friction turns over it, not at a
    point."""


SLIDING = SlidingLimits()

_ACROSS, _ACROSS_WEIGHTS = (a.tolist() for a in np.polynomial.legendre.leggauss(3))
_ALONG, _ALONG_WEIGHTS = (a.tolist() for a in np.polynomial.legendre.leggauss(6))


def slip_angle_tangent(contact):
    """|v_y|/|v_x|, fading to 0 at standstill; 1000 at most."""
    # Bounded by a share of v_y itself: broadside, the quotient would be infinite.
    return jnp.abs(contact.v_y) / jnp.sqrt(contact.v_x**2 + (1e-3 * contact.v_y) ** 2 + STILL**2)


def scaled_stress(ctx, normal, factor):
    """The normal stress times `factor(theta)`: at every node where it is integrated, else at its maximum."""
    if normal.stress is None:
        f = factor(normal.theta_m)
        return dataclasses.replace(
            normal, sigma_m=normal.sigma_m * f, load=normal.load * f, resistance=normal.resistance * f
        )
    theta, weight, old = normal.stress.theta, normal.stress.weight, normal.stress.sigma
    # The integral is redone from the nodes: a factor that differs along the arc has no factor for the sum.
    f = factor(theta)
    change = ctx.geometry.radius * ctx.geometry.width * weight * old * (f - 1.0)
    # What changes is added, so that nothing is rounded where nothing changes.
    return dataclasses.replace(
        normal,
        sigma_m=normal.sigma_m * factor(normal.theta_m),
        load=normal.load + jnp.sum(change * jnp.cos(theta), axis=0),
        resistance=normal.resistance + jnp.sum(change * jnp.sin(theta), axis=0),
        stress=dataclasses.replace(normal.stress, sigma=old * f),
    )


@effect(
    "soil",
    order=5,
    softening=Parameter(
        0.7,
        0.0,
        (0.0, 20.0),
        "1",
        "loss of stiffness by sliding as fast as the wheel moves",
        "choice: stress of a plate that moves along itself, about half of one that moves into the "
        "ground (Li, Zhang & Goldman 2013)",
    ),
)
def slide_softening(ctx, p, x, ground):
    """k_c and k_phi over 1 + a S, S = |(r omega - v_x, v_y)|/max(r omega, V): soil slid over carries less.

    Granular resistive force theory (Li, Zhang & Goldman 2013, Science 339:1408) measures that the stress on a surface
    falls as its motion turns from into the ground to along it, whatever the direction; this is that fall for the wheel
    as a whole, slip, skid and slip angle in one.
    """
    c = ctx.contact
    fastest = jnp.maximum(jnp.abs(c.rim_speed), jnp.sqrt(c.v_x**2 + c.v_y**2 + STILL**2))
    # eq. 8 has the larger of rim and forward speed below
    along = c.soil_slid * jnp.maximum(jnp.abs(c.rim_speed), jnp.sqrt(c.v_x**2 + STILL**2)) / fastest
    across = c.v_y / fastest
    sliding = jnp.sqrt(along**2 + across**2 + SLIDING.flat**2) - SLIDING.flat
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
        depth_at = jnp.maximum(r * (jnp.cos(theta) - jnp.cos(theta_1)), 1e-9 * r)
        node, weight = first_axis(_ACROSS, place), first_axis(_ACROSS_WEIGHTS, place)
        enters = place + 0.5 * (1.0 + node) * reach
        beside = enters < entrance * (1.0 - 1e-6)
        height = jnp.sqrt(jnp.where(beside, r * r - jnp.where(beside, enters, 0.0) ** 2, r * r))
        depth = jnp.where(beside, jnp.maximum(height - r * jnp.cos(theta_1), 0.0), 0.0)
        left = 1.0 - (1.0 - p.kept) * depth / depth_at
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
    slip = contact.soil_slip
    slip_x = slip / (1.0 + SLIDING.longest * jnp.minimum(slip, 0.0))
    rim, travel = jnp.abs(contact.rim_speed), jnp.abs(contact.v_x)
    pace = rim + (1.0 - SLIDING.longest) * jnp.maximum(travel - rim, 0.0)
    slip_y = contact.v_y / jnp.sqrt(pace**2 + STILL**2)

    def factor(theta):
        arc = sin_difference(normal.entrance, theta)
        q_x = r * ((normal.entrance - theta) - arc + slip_x * arc) / soil.shear_modulus_x
        q_y = r * (normal.entrance - theta) * slip_y / soil.shear_modulus_y
        return 1.0 + p.loss * jnp.expm1(-jnp.sqrt(q_x**2 + q_y**2 + 1e-24))

    return scaled_stress(ctx, normal, factor)


@effect(
    "wheel_normal",
    order=4,
    lost=Parameter(
        1.0,
        0.0,
        (0.0, 1.0),
        "1",
        "share of the contact behind the axle lost by moving broadside",
        "1: the rim only rises away from soil that enters behind the axle",
    ),
)
def side_exit(ctx, p, x, normal):
    """Stress behind the axle times 1 - lambda |v_y|/max(r omega, V): broadside, a wheel loses its rear contact.

    Contact behind the lowest point (Wong & Reece 1967) is soil that the rim has pressed and carries up after it. A
    wheel that moves across its heading faster than it turns meets soil there that nothing has pressed, and rises away
    from it; one that spins still feeds its rear with what it carries under itself. Acts with `stress_integral` where
    `exit_angle` gives contact behind the axle. Reason stated here.
    """
    c = ctx.contact
    fastest = jnp.maximum(jnp.abs(c.rim_speed), jnp.sqrt(c.v_x**2 + c.v_y**2 + STILL**2))
    gone = p.lost * jnp.abs(c.v_y) / fastest
    return scaled_stress(ctx, normal, lambda theta: jnp.where(theta < 0.0, 1.0 - gone, 1.0))


def _angle_of_reversal(ctx, p, x, normal):
    skid = p.reversal * 0.5 * (ctx.contact.soil_slid - ctx.contact.soil_slip)
    break_out = 0.25 * jnp.pi - 0.5 * jnp.arctan(ctx.soil.tan_phi)
    turned = jnp.arccos((1.0 - skid) * jnp.cos(break_out)) - break_out
    return dataclasses.replace(normal, reversal=jnp.where(skid > 0.0, turned, 0.0))


def _own_turning(ctx, p, x, wheel):
    skid = jnp.clip(-wheel.direction * wheel.slip_x, 0.0, 1.0)
    stretch = 1.0 / jnp.maximum(1.0 - p.share * skid, SLIDING.shortest_turn)
    slip_x = wheel.slip_x * stretch
    theta_1 = ctx.normal.entrance
    theta_0 = jnp.minimum(ctx.normal.reversal, theta_1)
    # (theta_1 - theta_0)/(sin theta_1 - sin theta_0), by half angles
    half = 0.5 * (theta_1 - theta_0)
    upright = jnp.maximum(jnp.cos(0.5 * (theta_1 + theta_0)), SLIDING.shortest_arc)
    undone = 1.0 / (upright * jnp.sinc(half / jnp.pi))
    kept = jnp.maximum(1.0 - undone - wheel.direction * slip_x, 0.0)
    return dataclasses.replace(
        wheel,
        slip_x=slip_x,
        slip_y=wheel.slip_y * stretch / (1.0 + p.share * skid),
        slip_ahead=slip_x + p.reversal * wheel.direction * kept,
    )


skid_shear = Effect(
    name="skid_shear",
    ports={"wheel_normal": _angle_of_reversal, "wheel_shear": _own_turning},
    order=-8,
    parameters={
        "share": Parameter(
            0.9,
            0.0,
            (0.0, 1.0),
            "1",
            "0: contact time of eq. 9; 1: that of the wheel's own turning",
            "choice: a locked wheel's contact has no end; the preset field takes 1",
        ),
        "reversal": Parameter(
            0.9,
            0.0,
            (0.0, 1.0),
            "1",
            "0: sheared one way along the whole rim; 1: turned about in front of theta_0",
            "choice: as for share; the preset field takes 1",
        ),
    },
    doc="""Soil stays under a braked wheel for (theta_1 - theta)/omega, and in front of theta_0 it is shoved ahead.

    The slip of eq. 8, referred to v_x when braking, makes the displacement finite for a locked wheel, and much too
    small. With s = 1 - r omega/v_x and a share q: slip_x/(1 - q s) and slip_y/((1 - q s)(1 + q s)), which at q = 1 is
    the kinematics of Janosi & Hanamoto 1961, j_x = int (r omega - v_x cos) dt and j_y = int v_y dt. The stretch ends at
    100, where the soil of a locked wheel is fully mobilised.

    That holds where soil stays and the rim passes over it, and many models of wheels end there. Where the rim moves at
    more than X = 45 deg - phi/2 from its normal, cos(theta_0 + X) = (1 - s) cos X, the soil gives way ahead and up
    along that slip line instead: in front of theta_0 it is not dragged back, j_x(theta_0) >= 0, and behind it the shear
    begins anew (Wong & Reece 1967, part II: towed wheels, whose shear turns about there). A reversal q takes q s for s
    in theta_0, and a share q of what the slip in front changes by; forces between 0 and 1 need not lie between theirs.
    Driving, theta_0 = 0 and nothing changes.""",
)


def wall_bearing(tan_phi, tan_delta):
    """Coulomb's passive earth pressure coefficient of an upright wall that rubs the soil downward, 1.

    K = cos^2 phi/(cos delta (1 - sqrt(sin(phi + delta) sin phi/cos delta))^2): the friction of the wall weighs down the
    wedge that has to rise, and a negative delta lifts it. Straight slip lines exaggerate a rough wall in strong soil,
    so the root is held below 0.92, that of phi = delta = 41 deg.
    """
    phi, delta = jnp.arctan(tan_phi), jnp.arctan(tan_delta)
    square = jnp.sin(phi + delta) * jnp.sin(phi) / jnp.cos(delta)
    return (jnp.cos(phi) / (1.0 - jnp.sqrt(jnp.clip(square, 1e-12, 0.85)))) ** 2 / jnp.cos(delta)


@effect(
    "wheel_shear",
    order=-9,
    pressure=Parameter(
        1.4,
        0.0,
        (0.0, 10.0),
        "1",
        "factor of Coulomb's passive earth pressure on the flank",
        "1: a long wall; walls not much longer than deep have 1.3 to 2 (McKyes 1985), measured 1.4",
    ),
    friction=Parameter(
        0.6667, None, (0.0, 1.0), "1", "friction of the flank over the soil's own", "steel on sand, two thirds"
    ),
    build_up=Parameter(
        4.0,
        None,
        (0.1, 50.0),
        "1",
        "sideways way over K_y at which 63 % of the pressure have built up",
        "choice: a wedge needs more way than a shear band",
    ),
    density=BULK_DENSITY,
    speed_scale=Parameter(
        2e-3, None, (1e-5, 1.0), "m/s", "speed of full friction on the flank", "choice: well below driving speed"
    ),
)
def side_wall(ctx, p, x, wheel):
    """The leading flank pushes a wedge of soil aside, which rises along it: a blade that the wheel's turning rubs.

    Coulomb's passive pressure K gamma h^2/2 + 2 c sqrt(K) h over -r sin(theta_1) .. r sin(theta_1), with h of the
    circle at each place (6 Gauss points). It builds up with the sideways way (r sin(theta_1) - x) |tan beta| that the
    flank has made beside a piece of ground: soil beside a wheel passes at v_x, however fast the wheel turns. The wedge
    slides aside on a plane at X_c = 45 deg - phi/2 and so rises at |v_y| tan(X_c); the flank moves in it at (v_x -
    omega (r - z + 2h/3), -omega x - |v_y| tan X_c) at two thirds of h, and its friction acts against that. The downward
    part of what the flank does to the wedge enters K: a locked wheel is borne by the rising soil and pushes two to
    three times as hard as one that spins, whose turning has used up the friction (Coulomb 1776; McKyes 1985; reason for
    the direction of the friction stated here).
    """
    contact, geometry, normal, soil = contact_with_soil(ctx), ctx.geometry, ctx.normal, ctx.soil
    r, weight = geometry.radius, p.density * ctx.gravity
    soft = grounded(contact, jnp.where(soil.rock > 0.5, 0.0, 1.0))
    length = r * jnp.sin(jnp.minimum(normal.entrance, 0.5 * jnp.pi))
    axle = r * jnp.cos(normal.entrance)
    turning = contact.rim_speed / r
    along = length * first_axis(_ALONG, length)
    h = jnp.maximum(jnp.sqrt(jnp.maximum(r * r - along * along, 1e-12 * r * r)) - axle, 0.0)
    q = (length - along) * _tangent_of_travel(contact, wheel, p.speed_scale) / (p.build_up * soil.shear_modulus_y)
    arm, place = axle + 2.0 / 3.0 * h, wheel.direction * along
    rise = jnp.abs(contact.v_y) / (soil.tan_phi + jnp.sqrt(1.0 + soil.tan_phi**2))
    u_x, u_z = contact.v_x - turning * arm, -turning * place - rise
    speed = jnp.sqrt(u_x**2 + u_z**2 + (SLIDING.spread * contact.v_y) ** 2 + p.speed_scale**2)
    tan_delta = p.friction * soil.tan_phi
    bearing = wall_bearing(soil.tan_phi, -tan_delta * u_z / speed)
    wall = h * (0.5 * bearing * weight * h + 2.0 * soil.cohesion * jnp.sqrt(bearing))
    push = p.pressure * soft * first_axis(_ALONG_WEIGHTS, length) * length * wall * q * mean_decay(jnp.abs(q))
    drag = tan_delta * jnp.abs(push) / speed
    d_x, d_z = -drag * u_x, -drag * u_z
    force = Vec3(jnp.sum(d_x, axis=0), -jnp.sum(push, axis=0), jnp.sum(d_z, axis=0))
    moment = Vec3(
        -jnp.sum(arm * push, axis=0), -jnp.sum(arm * d_x + place * d_z, axis=0), -jnp.sum(place * push, axis=0)
    )
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


def _tangent_of_travel(contact, wheel, still):
    """v_y/|v_x| from the displacement across of eq. 11, which refers to the faster of rim and travel; kept at rest."""
    fastest = jnp.maximum(jnp.abs(contact.rim_speed), jnp.abs(contact.v_x))
    braking = jnp.clip(-wheel.direction * wheel.slip_x, 0.0, 1.0)
    return wheel.slip_y / (1.0 + braking) * jnp.sqrt((fastest**2 + still**2) / (contact.v_x**2 + still**2))
