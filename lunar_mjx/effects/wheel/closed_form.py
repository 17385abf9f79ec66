"""Wheel on soft soil: the closed form of the stress integral, and the memory of the sheared soil.

Sources: Wong & Reece 1967 (normal stress under a rolling wheel), Janosi & Hanamoto 1961 (shear), Ding et al. 2011/2015
(closed form), Ishigami et al. 2007 (lateral force). Equation numbers are the seed paper's.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect
from lunar_mjx.effects.joint.friction import largest_damping
from lunar_mjx.spatial import Vec3


@dataclasses.dataclass(frozen=True)
class ContactLimits:
    """Between which depths the closed form is followed."""

    min_sinkage: float = 1e-9
    """Least sinkage over radius: a root has no finite derivative at zero."""
    tiny: float = 1e-24
    """Added below a root of two squares, far below the squared displacements over moduli that move soil."""
    max_sinkage_ratio: float = 1.5
    """The contact arc is followed up to an entrance angle of 120 deg; a wheel buried deeper keeps the force of that
    arc."""
    shortest: float = 0.05
    """Least contact length that remembers its shear, in radii; it is reached half a hundredth of a radius deep. Less of
    it would lean fully within the first step of a touchdown, and whether that step began a micrometre above the ground
    or below it would show in how a rover stands for seconds."""

    damped: float = 0.4
    """1; most damping of a wheel by its sheared soil, over what stops it within a time step. The speed loop of a drive
    takes up to 0.8, and with 2 in all an explicit step shakes. Less would cut shipped rovers as they come."""
    stiff: float = 0.8
    """1; most stiffness of a wheel by its sheared soil, over what turns it back within a time step: an explicit step
    shakes from 4 - 2 d on, d being the damping over what stops it within a step, up to 1.2 of soil and speed loop."""


CONTACT = ContactLimits()


STANDSTILL_SPEED: Annotated[float, "m/s"] = 1e-3
"""m/s; below it a wheel counts as standing, and eq. 11's factor for braking, a ratio of speeds, has no meaning."""


def entrance_angle(sinkage, radius):
    """theta_1 = arccos((r - z)/r), written as 2 arcsin sqrt(z/2r), which keeps its digits at small sinkage; rad."""
    # Clipped below, since the root has no finite derivative at zero, where every wheel touches down.
    ratio = jnp.clip(sinkage / radius, CONTACT.min_sinkage, CONTACT.max_sinkage_ratio)
    return 2.0 * jnp.arcsin(jnp.sqrt(0.5 * ratio))


def cos_difference(a, b):
    """cos a - cos b in half-angle form, exact to rounding where a and b are close."""
    return 2.0 * jnp.sin(0.5 * (a + b)) * jnp.sin(0.5 * (b - a))


def sin_difference(a, b):
    """sin a - sin b in half-angle form."""
    return 2.0 * jnp.cos(0.5 * (a + b)) * jnp.sin(0.5 * (a - b))


def half_angle(theta):
    """sin(theta/2) and cos(theta/2), of which sines, cosines and their differences are products that keep digits."""
    return jnp.sin(0.5 * theta), jnp.cos(0.5 * theta)


def first_axis(values, like):
    """Numbers along a new first axis, in front of those of `like`: node by node they would compile for minutes."""
    return jnp.reshape(jnp.asarray(values, jnp.result_type(like)), (-1,) + (1,) * jnp.ndim(like))


def max_normal_stress(soil, width, radius, theta_m, theta_1):
    """sigma_m = (k_c/b + k_phi) [r (cos theta_m - cos theta_1)]^n, Pa."""
    depth = jnp.maximum(radius * cos_difference(theta_m, theta_1), CONTACT.min_sinkage * radius)
    return (soil.k_c / width + soil.k_phi) * depth**soil.n


def janosi(displacement, modulus):
    """(1 - exp(-|j|/K)) sign(j): share of the shear strength that a displacement mobilises (Janosi & Hanamoto)."""
    ahead, q = displacement >= 0.0, displacement / modulus
    # not |q|, which has no derivative at 0, where a wheel at rest is
    short = jnp.expm1(jnp.where(ahead, -q, q))
    return jnp.where(ahead, -short, short)


def geometry_factors(theta_m):
    """A and B of eq. 10 in half-angle form: A = 4 cos(t) sin^2(t/2)/t, B = 4 sin(t) sin^2(t/2)/t with t = theta_m."""
    half = 0.5 * theta_m
    # 4 sin^2(t/2)/t without the difference 1 - cos t, which loses its digits at a sinkage of micrometres.
    common = theta_m * (jnp.sin(half) / half) ** 2
    return jnp.cos(theta_m) * common, jnp.sin(theta_m) * common


def airborne(contact):
    """Whether each wheel touches no ground: it has not sunk below the surface."""
    return contact.sinkage <= 0.0


def contact_with_soil(ctx):
    """The contact with its sinkage below the surface that the wheel meets: the bottom of a rut where one is."""
    if ctx.soil.rut is None:
        return ctx.contact
    return dataclasses.replace(ctx.contact, sinkage=jnp.maximum(ctx.contact.sinkage - ctx.soil.rut, 0.0))


def grounded(contact, value):
    """`value` under a wheel that touches the ground, 0 under an airborne one."""
    return jnp.where(airborne(contact), 0.0, value)


def normal_damping_force(ctx, coefficient, theta_1):
    """c' b r sin(theta_1) zdot: damping in proportion to the area of contact, so that touching down has no jump; N."""
    geometry = ctx.geometry
    area = geometry.width * geometry.radius * jnp.sin(jnp.minimum(theta_1, 0.5 * jnp.pi))
    return coefficient * area * ctx.contact.sinkage_rate


_DAMPING = Parameter(
    9e4,
    None,
    (0.0, 1e7),
    "Pa s/m",
    "damping of the normal contact per area",
    "choice: about half critical for a 110 kg quarter rover",
)


@effect("wheel_normal", damping=_DAMPING)
def pressure_sinkage(ctx, p, x, normal):
    """Closed form of the vertical stress integral: W = r b sigma_m A; the wheel sinks to equilibrium by itself.

    Linearised Wong-Reece stress between theta_2 = 0, theta_m = theta_1/2 and theta_1 (Ding et al. 2011); mends flaw 2.
    """
    contact, geometry = contact_with_soil(ctx), ctx.geometry
    theta_1 = entrance_angle(contact.sinkage, geometry.radius)
    # Half of theta_1 lies within what Wong & Reece measured, 0.2 to 0.75, growing with slip; `exit_angle` lets it move.
    theta_m = 0.5 * theta_1
    sigma_m = max_normal_stress(ctx.soil, geometry.width, geometry.radius, theta_m, theta_1)
    a, b = geometry_factors(theta_m)
    area = geometry.radius * geometry.width
    load = area * sigma_m * a
    # no more than the load: soil does not pull a leaving wheel down
    damping = jnp.maximum(normal_damping_force(ctx, p.damping, theta_1), -load)
    return dataclasses.replace(
        normal,
        entrance=theta_1,
        theta_m=theta_m,
        sigma_m=grounded(contact, sigma_m),
        load=grounded(contact, load),
        resistance=grounded(contact, area * sigma_m * b),
        damping=grounded(contact, damping),
    )


def mean_decay(q):
    """(1 - exp(-q))/q, by its series where the quotient and its derivative would lose digits."""
    small = q < 1e-2
    # the branch that is not taken must be finite too: its derivative is multiplied by zero, not left out
    safe = jnp.where(small, 1.0, q)
    series = 1.0 - q / 2.0 * (1.0 - q / 3.0 * (1.0 - q / 4.0 * (1.0 - q / 5.0 * (1.0 - q / 6.0))))
    return jnp.where(small, series, -jnp.expm1(-safe) / safe)


def contact_length(ctx, normal):
    """Length of soil sheared between the entrance and the angle of maximum stress, m."""
    return ctx.geometry.radius * sin_difference(normal.entrance, normal.theta_m)


def _remembered_slip(x, contact):
    """The contact with the slip that the soil remembers.

    The slip of a wheel that creeps changes within a millimetre per second from none to full. Soil that answered to it
    at once would shake a parked rover for ever; it is displaced over a contact length instead.
    """
    slip = x.direction * x.slip_x
    # More than a whole slip is that of opposed rim and hub, whose lean is small. So is that of a wheel that never
    # rolled, which has displaced its soil and slid over none.
    slid = jnp.abs(slip) + jnp.maximum(jnp.abs(x.slip_x) - 1.0, 0.0)
    return dataclasses.replace(contact, soil_slip=jnp.clip(slip, -1.0, 1.0), soil_slid=jnp.minimum(slid, 1.0))


@effect(
    "wheel_shear",
    order=-10,
    transient=True,
    recall=_remembered_slip,
    state={
        "slip_x": StateVariable(0.0, "1", "shear displacement along the wheel over the contact length"),
        "slip_y": StateVariable(0.0, "1", "shear displacement across the wheel over the contact length"),
        "direction": StateVariable(0.0, "1", "where the contact arc leans: 1 forward, -1 backward, 0 upright"),
    },
    damping_time=Parameter(
        0.1,
        0.0,
        (0.0, 10.0),
        "s",
        "damping of the sheared soil while it is loaded",
        "choice: 0.2-0.4 of critical for a parked rover",
    ),
    rock_length=Parameter(
        0.2,
        None,
        (1e-3, 10.0),
        "m",
        "rolling distance over which contact on rock renews itself",
        "choice: order of the wheel's radius",
    ),
    relaxation=Parameter(
        1.0,
        None,
        (0.001, 10.0),
        "1",
        "rolling distance over which contact on soil renews itself, over the contact length",
        "choice: one contact length brings fresh soil",
    ),
    creep=Parameter(
        0.0,
        None,
        (0.0, 1.0),
        "m/s",
        "speed as that of which contact on soil renews itself at least: sheared soil gives way under a wheel at rest",
        "choice: none, a wheel at rest stays where it is",
    ),
)
def shear_state(ctx, p, x, wheel):
    """Shear displacement as a state: static friction at standstill, eqs. 8 and 9 when rolling (flaw 4).

    L dk/dt = v_slip - V_r k with V_r = max(|r omega|, |v_x|, creep) and L the contact length times `relaxation`
    (relaxation length model, Bernard & Clover 1995, SAE 950311): k tends to the slip of eq. 8 while rolling, and keeps
    the displacement of a wheel that stands. With `creep` it forgets that in the time L / creep, and what holds a wheel
    at rest is its slip speed over that speed: many simulators put such a floor under the slip's denominator. The same
    for (1 - s) tan(beta) of eq. 11, and for the direction in which the contact leans: that of rim and hub, their sum
    within V_r where they are opposed. Integrated exactly over a step, hence stable at any speed. The force takes k plus
    `damping_time` times its rate. On soil L is no shorter, and this time no longer, than keeps a wheel at rest from
    shaking in steps of this length.
    """
    contact = ctx.contact
    rock = ctx.soil.rock > 0.5
    arc = jnp.maximum(contact_length(ctx, ctx.normal), CONTACT.shortest * ctx.geometry.radius)
    length, longest = _still_at_rest(ctx, arc, p.relaxation * arc)
    length = jnp.where(rock, p.rock_length, length)
    damping_time = jnp.where(rock, p.damping_time, jnp.minimum(p.damping_time, longest))
    # eq. 8 divides by the faster of rim and hub
    roll = jnp.where(jnp.abs(contact.rim_speed) > jnp.abs(contact.v_x), contact.rim_speed, contact.v_x)
    renewing = jnp.maximum(jnp.abs(roll), jnp.where(rock, 0.0, p.creep))
    # share of the way to the steady value, over the time that it would take at the first rate
    gained = mean_decay(renewing * ctx.dt / length) / length
    held = jnp.exp(-renewing * damping_time / length)
    lifted = airborne(contact)

    def advance(value, speed):
        # (1 - exp(-V dt/L))/(V dt) in place of 1/L: the exact mean rate over the step, finite where V is 0
        rate = gained * (speed - renewing * value)
        new = value + ctx.dt * rate
        # damping acts on soil that is being loaded; it fades with rolling, which brings fresh soil
        return jnp.where(lifted, 0.0, new), jnp.where(lifted, 0.0, new + damping_time * rate * held)

    slip_x, loaded_x = advance(x.slip_x, contact.rim_speed - contact.v_x)
    slip_y, loaded_y = advance(x.slip_y, lateral_slip_speed(contact))
    # The contact leans the way that rim and hub move; where they are opposed, the faster one prevails by degrees. Were
    # it to prevail at once, the step in which a reversing wheel does so would jump, and with it all that follows.
    direction, _ = advance(x.direction, jnp.clip(contact.rim_speed + contact.v_x, -jnp.abs(roll), jnp.abs(roll)))
    direction = jnp.clip(direction, -1.0, 1.0)
    wheel = dataclasses.replace(wheel, slip_x=loaded_x, slip_y=loaded_y, direction=direction)
    return wheel, {"slip_x": slip_x, "slip_y": slip_y, "direction": direction}


def _still_at_rest(ctx, arc, length):
    """Distance, m, over which a contact on soil renews itself, and longest damping time, s, that explicit steps take.

    With a shorter distance, a stiffer spring, or a longer time a wheel at rest would shake: stiffness and damping by
    its soil stay below a share of J/dt2 and J/dt, J being the least inertia of all drives (see `largest_damping`).

    Args:
      arc: length of the contact, m. length: that distance as it is given, m.
    """
    if ctx.rover.joint_inertia is None:
        return length, jnp.inf
    soil, normal, radius = ctx.soil, ctx.normal, ctx.geometry.radius
    strength = soil.cohesion * ctx.geometry.width * radius * normal.entrance + normal.load * soil.tan_phi
    # N m per rad, times the distance, at first: a whole slip displaces the soil of a contact by about its length
    stiffness = radius**2 * strength * arc / soil.shear_modulus_x
    most = jnp.min(jnp.where(ctx.rover.joint_group == 0, largest_damping(ctx), jnp.inf))
    length = jnp.maximum(length, stiffness * ctx.dt / (CONTACT.stiff * most))
    # not smaller: the derivative divides by the square, which float32 has to hold
    return length, CONTACT.damped * most * length / jnp.maximum(stiffness, 1e-12)


def lateral_slip_speed(contact):
    """Numerator of (1 - s) tan(beta) over V_r: v_y driving, v_y (2 - |r omega/v_x|) braking, m/s (eqs. 8-11)."""
    # By magnitudes, and fading below a millimetre per second: the ratio of a wheel that turns against its travel, and
    # of one that stops, would else jump, and with it the side force in the step in which a rover reverses.
    rim, travel = jnp.abs(contact.rim_speed), jnp.abs(contact.v_x)
    factor = 1.0 + jnp.maximum(travel - rim, 0.0) / jnp.maximum(travel, STANDSTILL_SPEED)
    return contact.v_y * factor


def shear_stress(wheel, soil, strength, j_x, j_y):
    """Shear stress along and across the wheel after the displacements j_x and j_y, Pa (Janosi & Hanamoto 1961).

    Each direction has the whole strength to itself, unless `wheel.circle` says that they share it.
    """
    if wheel.grip is not None:
        strength = strength * wheel.grip
    tau_x = strength * janosi(j_x, soil.shear_modulus_x)
    tau_y = strength * janosi(j_y, soil.shear_modulus_y)
    if wheel.circle is None:
        return tau_x, tau_y
    # Displacements in units of their moduli: an ellipse in metres becomes the circle of the law.
    q_x, q_y = j_x / soil.shear_modulus_x, j_y / soil.shear_modulus_y
    common = strength * mean_decay(jnp.sqrt(q_x * q_x + q_y * q_y + CONTACT.tiny))
    return tau_x + wheel.circle * (common * q_x - tau_x), tau_y + wheel.circle * (common * q_y - tau_y)


def shear_along(wheel, normal, theta, r_s, r, half=None):
    """Displacement of the rim over its soil at theta, m: r_s (theta_1 - theta) - r (1 - s)(sin theta_1 - sin theta).

    In front of the angle of reversal, where there is one, with the slip that the soil has there. `half` is the sine and
    cosine of theta/2 where they are known.
    """
    theta_1 = normal.entrance
    first, here = half_angle(theta_1), half_angle(theta) if half is None else half

    def arc_to(sine, cosine):
        # sin theta_1 - sin theta = 2 cos((theta_1 + theta)/2) sin((theta_1 - theta)/2), both expanded
        return 2.0 * (first[1] * cosine - first[0] * sine) * (first[0] * cosine - first[1] * sine)

    arc = arc_to(*here)
    j = wheel.direction * (r_s * (theta_1 - theta) - r * arc) + r * wheel.slip_x * arc
    if wheel.slip_ahead is None:
        return j
    turn = jnp.minimum(normal.reversal, theta_1)
    ahead = jnp.where(theta > turn, arc, arc_to(*half_angle(turn)))
    return j + r * (wheel.slip_ahead - wheel.slip_x) * ahead


def shearing_radius(p, geometry, wheel):
    """r_s, m: the radius, its factor, and what grousers add."""
    radius = p.shear_radius * geometry.radius
    return radius if wheel.lug is None else radius + wheel.lug


@effect(
    "wheel_shear",
    shear_radius=Parameter(1.0, None, (0.8, 1.3), "1", "shearing radius r_s over the radius r", "seed paper: r_s = r"),
)
def closed_form_shear(ctx, p, x, wheel):
    """Eqs. 10-14 mended: j with the radius in both terms (flaw 3), Ding's place of r_s (flaw 5), signs for both ways.

    j = r_s (theta_1 - theta_m) - r (1 - s)(sin theta_1 - sin theta_m), as the slip s is that of the rim;
    tau = (c + sigma_m tan phi)(1 - exp(-j/K_s));
    F_x = r_s b tau A - r b sigma_m B; F_z = r b sigma_m A + r_s b tau B; F_y = -r b tau_y theta_m with its own
    displacement r (1-s) theta_m tan(beta), so that a wheel that does not slip along still holds across; M_y = -r_s^2 b
    tau theta_m. Lateral force acts at theta_m below the axle: M_x = r F_y (eq. 13), M_z = r sin(theta_m) F_y (eq. 14,
    whose second term needs an undefined theta_s and is left out: flaw 6).
    """
    geometry, normal, soil = ctx.geometry, ctx.normal, ctx.soil
    r, b, r_s = geometry.radius, geometry.width, shearing_radius(p, geometry, wheel)
    theta_1, theta_m = normal.entrance, normal.theta_m
    if normal.arc is None:
        (a_factor, b_factor), whole, front = geometry_factors(theta_m), theta_m, theta_m
    else:
        a_factor, b_factor, whole, front = normal.arc.cos, normal.arc.sin, normal.arc.one, theta_1 - theta_m
    strength = grounded(ctx.contact, soil.cohesion + normal.sigma_m * soil.tan_phi)
    j_x = shear_along(wheel, normal, theta_m, r_s, r)
    tau, tau_y = shear_stress(wheel, soil, strength, j_x, r * front * wheel.slip_y)
    side = -r * b * whole * tau_y
    force = Vec3(
        r_s * b * tau * a_factor - wheel.direction * normal.resistance,
        side,
        normal.load + normal.damping + wheel.direction * r_s * b * tau * b_factor,
    )
    moment = Vec3(r * side, -r_s * r_s * b * whole * tau, wheel.direction * r * jnp.sin(theta_m) * side)
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)
