"""Wheel and chassis on hard things: rock surfaces (penalty contact with friction) and boulders."""

from __future__ import annotations

import dataclasses
from typing import Any, NamedTuple

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, StateVariable, effect
from lunar_mjx.effects.wheel.closed_form import airborne, entrance_angle
from lunar_mjx.effects.wheel.ellipsoid_contact import contact_with_box, contact_with_wheel
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import form_at, nearest_rock, sample

_STIFFNESS = Parameter(2e5, None, (1e2, 1e8), "N/m", "contact stiffness k_N on rock", "paper's release: 5e4 to 1e6")
_DAMPING = Parameter(400.0, 0.0, (0.0, 1e6), "N s/m", "contact damping c_N on rock", "paper's release: 1e2 to 1e5")
_MU = Parameter(0.8, 0.0, (0.0, 2.0), "1", "friction coefficient on rock", "paper's release: 0.7 to 0.9")


def _rock_normal(ctx, p, x, normal):
    contact = ctx.contact
    rock = ctx.soil.rock > 0.5
    load = jnp.where(airborne(contact), 0.0, p.stiffness * contact.sinkage)
    damping = jnp.where(airborne(contact), 0.0, jnp.maximum(p.damping * contact.sinkage_rate, -load))
    theta_1 = entrance_angle(contact.sinkage, ctx.geometry.radius)
    zero = jnp.zeros_like(load)
    stress = normal.stress
    if stress is not None:
        stress = dataclasses.replace(stress, sigma=jnp.where(rock, 0.0, stress.sigma))
    return dataclasses.replace(
        normal,
        entrance=jnp.where(rock, theta_1, normal.entrance),
        theta_m=jnp.where(rock, 0.5 * theta_1, normal.theta_m),
        # Effects after this one that read the soil's stress find none on rock.
        sigma_m=jnp.where(rock, zero, normal.sigma_m),
        load=jnp.where(rock, load, normal.load),
        resistance=jnp.where(rock, zero, normal.resistance),
        damping=jnp.where(rock, damping, normal.damping),
        stress=stress,
    )


def _rock_shear(ctx, p, x, wheel):
    """Replaces the soil's shear by f = mu F_N (1 - exp(-|k| L/K)) k/|k|, with k the slip vector of the shear state."""
    rock = ctx.soil.rock > 0.5
    # Friction by the whole normal force, damping included: while a wheel lands, it presses harder.
    load = ctx.normal.load + ctx.normal.damping
    # The floor keeps the root's derivative finite for a wheel that has not slipped at all.
    slip = jnp.sqrt(wheel.slip_x**2 + wheel.slip_y**2 + 1e-12)
    friction = -p.mu * load * jnp.expm1(-slip / p.slip_scale) / slip
    along, side = friction * wheel.slip_x, -p.side * friction * wheel.slip_y
    radius = ctx.geometry.radius
    force = Vec3(along, side, load)
    moment = Vec3(radius * side, -radius * along, jnp.zeros_like(load))
    return dataclasses.replace(wheel, force=force.where(rock, wheel.force), moment=moment.where(rock, wheel.moment))


hard_ground = Effect(
    name="hard_ground",
    ports={"wheel_normal": _rock_normal, "wheel_shear": _rock_shear},
    parameters={
        "stiffness": _STIFFNESS,
        "damping": _DAMPING,
        "mu": _MU,
        "slip_scale": Parameter(
            0.01,
            None,
            (1e-4, 1.0),
            "1",
            "slip at which friction on rock is 63 % mobilised",
            "choice: order of a rigid wheel's",
        ),
        "side": Parameter(
            1.0,
            None,
            (0.0, 2.0),
            "1",
            "friction across the wheel over that along it",
            "1: a rigid wheel; lugged tyres 0.6",
        ),
    },
    order=10,
    doc="""Wheel on rock: F_N = k_N z + c_N zdot and friction mu F_N against the slip (seed paper III-C4), where the
    map says rock. Friction saturates in the slip that the shear state carries, hence holds a parked wheel. A tyre may
    hold less across than along (an ellipse of friction).""",
)


def _closest_point_to_sphere(center: Vec3, wheel_center: Vec3, axle: Vec3, radius, width) -> tuple[Vec3, Vec3, Any]:
    """Point of a wheel nearest to a sphere's centre, relative to the wheel's; unit vector to that; distance."""
    gap = center - wheel_center
    axial = gap.dot(axle)
    radial = gap - axle * axial
    # Clipped length by length: radial and axial parts of a cylinder's nearest point do not depend on each other.
    length = radial.norm(1e-9)
    closest = radial * (jnp.minimum(length, radius) / length) + axle * jnp.clip(axial, -0.5 * width, 0.5 * width)
    apart = gap - closest
    distance = apart.norm(1e-9)
    return closest, apart * (1.0 / distance), distance


def _penalty(depth, rate, stiffness, damping):
    """max(k depth + c rate, 0) where in contact, N."""
    # Never negative: a rock does not hold a wheel back when it leaves.
    return jnp.where(depth > 0.0, jnp.maximum(stiffness * depth + damping * rate, 0.0), 0.0)


def _sliding_friction(velocity: Vec3, normal: Vec3, mu, load, speed_scale) -> Vec3:
    """mu F_N against the tangential velocity, smoothed below `speed_scale`."""
    # Only the tangential part; the normal part is the penalty's own damping.
    tangential = velocity - normal * velocity.dot(normal)
    speed = tangential.norm(1e-6)
    return tangential * (-mu * load * jnp.tanh(speed / speed_scale) / speed)


_SPEED = Parameter(
    0.05, None, (1e-4, 1.0), "m/s", "sliding speed of full friction", "choice: stable with explicit forces at 2 ms"
)


class _Touch(NamedTuple):
    """One boulder against each wheel.

    Attributes:
      point: of the wheel nearest to the boulder's centre (of an ellipsoid in its scaled space), relative to the wheel's
        centre, world frame, m.
      toward: unit vector from there into the boulder. velocity: of the wheel at that point, m/s.
      load: normal force, N; 0 where the wheel does not touch.
    """

    point: Vec3
    toward: Vec3
    velocity: Vec3
    load: Any


def _touch_boulder(ctx, p) -> _Touch:
    geometry, place = ctx.geometry, ctx.wheel_position
    cx, cy, cz, rock_radius = nearest_rock(ctx.terrain.rocks, place.x, place.y)
    center, axle = Vec3(cx, cy, cz), ctx.wheel_axle
    if ctx.terrain.rocks.forms is None:
        closest, toward, distance = _closest_point_to_sphere(center, place, axle, geometry.radius, geometry.width)
        depth = rock_radius - distance
    else:
        form = form_at(ctx.terrain.rocks, place.x, place.y)
        closest, toward, depth = contact_with_wheel(form, center - place, axle, geometry.radius, geometry.width)
    velocity = ctx.wheel_velocity + ctx.wheel_angular_velocity.cross(closest)
    # Places without a boulder have radius zero: no contact there, whatever the geometry says.
    depth = jnp.where(rock_radius > 0.0, depth, -1.0)
    load = _penalty(depth, velocity.dot(toward), p.stiffness, p.damping)
    return _Touch(closest, toward, velocity, load)


def _push_wheel(ctx, wheel, touch: _Touch, friction: Vec3):
    """The wheel's force and moment with the boulder's normal force and friction added."""
    contact = ctx.contact
    force = touch.toward * -touch.load + friction
    frame = Frame(contact.forward, contact.left, contact.normal)
    return dataclasses.replace(
        wheel,
        force=wheel.force + frame.from_world(force),
        moment=wheel.moment + frame.from_world(touch.point.cross(force)),
    )


@effect("wheel_shear", order=20, stiffness=_STIFFNESS, damping=_DAMPING, mu=_MU, speed_scale=_SPEED)
def boulders(ctx, p, x, wheel):
    """Boulders are spheres or ellipsoids that a wheel (a cylinder) runs against: penalty force along their normal."""
    if ctx.terrain.rocks is None:
        return wheel
    touch = _touch_boulder(ctx, p)
    return _push_wheel(
        ctx, wheel, touch, _sliding_friction(touch.velocity, touch.toward, p.mu, touch.load, p.speed_scale)
    )


def _bristle(axis: str) -> StateVariable:
    return StateVariable(0.0, "m", f"{axis}, world frame, of the tangential deflection where a wheel touches a boulder")


@effect(
    "wheel_shear",
    order=20,
    transient=True,
    replaces=("boulders",),
    state={"bristle_x": _bristle("x"), "bristle_y": _bristle("y"), "bristle_z": _bristle("z")},
    stiffness=_STIFFNESS,
    damping=_DAMPING,
    mu=_MU,
    tangential_stiffness=Parameter(
        1e5,
        None,
        (1e2, 1e8),
        "N/m",
        "tangential stiffness k_t of the contact",
        "half of k_N; 0.5 to 1 for rough bodies (Johnson 1985, ch. 7.2)",
    ),
    tangential_damping=Parameter(
        200.0, 0.0, (0.0, 1e6), "N s/m", "tangential damping c_t while it sticks", "choice: half of c_N"
    ),
)
def static_boulders(ctx, p, x, wheel):
    """Boulders as in `boulders`, with friction that holds: a rover that leans on one does not creep.

    The contact deflects by xi, d xi/dt = v_t while it sticks, and F = -k_t xi - c_t v_t within |F| <= mu F_N; where
    k_t |xi| would pass mu F_N it slides, xi keeping the length mu F_N/k_t (Cundall & Strack 1979). xi turns with the
    plane of contact and is forgotten when the wheel lifts off.
    """
    if ctx.terrain.rocks is None:
        return wheel, {}
    touch = _touch_boulder(ctx, p)
    sliding = touch.velocity - touch.toward * touch.velocity.dot(touch.toward)
    moved = Vec3(x.bristle_x, x.bristle_y, x.bristle_z) + sliding * ctx.dt
    # The plane of contact has turned with the wheel's place on the boulder; what now points into it is no deflection.
    moved = moved - touch.toward * moved.dot(touch.toward)
    most = p.mu * touch.load
    # Beyond mu F_N the bristle slides along: its length is cut to what friction can hold.
    moved = moved * jnp.minimum(most / (p.tangential_stiffness * moved.norm(1e-9)), 1.0)
    # Damping while it sticks: a spring alone would let a leaning rover swing for ever.
    pull = moved * -p.tangential_stiffness - sliding * p.tangential_damping
    friction = pull * jnp.minimum(most / pull.norm(1e-9), 1.0)
    bristles = {"bristle_x": moved.x, "bristle_y": moved.y, "bristle_z": moved.z}
    return _push_wheel(ctx, wheel, touch, friction), bristles


_QUADRANTS = ((-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5))
"""Where each box of the chassis looks for boulders, in half lengths from its centre."""


def _boulders_under_chassis(ctx, p) -> list[tuple[Vec3, Vec3]]:
    """Force on the chassis, N, and its arm from the chassis frame, m, per quadrant of a box; world frame."""
    center, half = ctx.rover.box_center, ctx.rover.box_half
    rocks = []
    # Four probes, since the grid of boulders returns one boulder per place and a chassis covers several cells.
    for fore, side in _QUADRANTS:
        probe = ctx.frame.to_world(Vec3(center.x + fore * half.x, center.y + side * half.y, center.z)) + ctx.position
        form = None if ctx.terrain.rocks.forms is None else form_at(ctx.terrain.rocks, probe.x, probe.y)
        rocks.append((*nearest_rock(ctx.terrain.rocks, probe.x, probe.y), form))
    out = []
    for x, y, z, radius, form in rocks:
        # quadrants that found the same boulder share its push
        share = 1.0 / sum(jnp.where((x == other[0]) & (y == other[1]), 1.0, 0.0) for other in rocks)
        gap = ctx.frame.from_world(Vec3(x, y, z) - ctx.position) - center
        if form is None:
            nearest = Vec3(*(jnp.clip(g, -h, h) for g, h in zip(gap, half, strict=True)))
            apart = gap - nearest
            distance = apart.norm(1e-9)
            inside = distance < 1e-6
            # A centre within the box has no direction outward: the box is pushed up, where it came from.
            down = Vec3(jnp.zeros_like(distance), jnp.zeros_like(distance), -jnp.ones_like(distance))
            toward = ctx.frame.to_world(down.where(inside, apart * (1.0 / distance)))
            reached = radius - jnp.where(inside, 0.0, distance)
        else:
            nearest, toward, reached = contact_with_box(form, gap, ctx.frame, half)
        arm = ctx.frame.to_world(nearest + center)
        velocity = ctx.velocity + ctx.angular_velocity.cross(arm)
        # As for wheels: no boulder, no contact.
        depth = jnp.where(radius > 0.0, reached, -1.0)
        load = share * _penalty(depth, velocity.dot(toward), p.stiffness, p.damping)
        out.append((toward * -load + _sliding_friction(velocity, toward, p.mu, load, p.speed_scale), arm))
    return out


@effect(
    "body_wrench",
    stiffness=Parameter(5e4, None, (1e2, 1e8), "N/m", "contact stiffness of the chassis", "choice"),
    damping=Parameter(1e3, 0.0, (0.0, 1e6), "N s/m", "contact damping of the chassis", "choice"),
    mu=Parameter(0.6, 0.0, (0.0, 2.0), "1", "friction coefficient of the chassis on the ground", "choice"),
    speed_scale=_SPEED,
)
def chassis_contact(ctx, p, x, wrench):
    """Points of the chassis that touch the ground and boulders that touch its boxes push it out."""
    arm = ctx.frame.to_world(ctx.rover.chassis_points)
    point = arm + ctx.position
    velocity = ctx.velocity + ctx.angular_velocity.cross(arm)
    height, slope_x, slope_y = sample(ctx.terrain.field, point.x, point.y)
    normal = Vec3(-slope_x, -slope_y, jnp.ones_like(slope_x)).unit()
    load = _penalty((height - point.z) * normal.z, -velocity.dot(normal), p.stiffness, p.damping)
    force = normal * load + _sliding_friction(velocity, normal, p.mu, load, p.speed_scale)
    total, moment = force.sum(), arm.cross(force).sum()
    if ctx.terrain.rocks is not None and ctx.rover.box_center is not None:
        for push, touching_at in _boulders_under_chassis(ctx, p):
            total, moment = total + push.sum(), moment + touching_at.cross(push).sum()
    return dataclasses.replace(wrench, force=wrench.force + total, moment=wrench.moment + moment)


@effect(
    "body_wrench",
    stiffness=Parameter(5e3, 0.0, (0.0, 1e8), "N m/rad", "stiffness of the joint stops", "choice"),
    damping=Parameter(50.0, 0.0, (0.0, 1e6), "N m s/rad", "damping of the joint stops", "choice"),
)
def joint_limits(ctx, p, x, wrench):
    """Joint stops as passive springs with damping, so that the solver sees equality constraints only."""
    below = jnp.maximum(ctx.rover.joint_lower - ctx.joint_angle, 0.0)
    above = jnp.maximum(ctx.joint_angle - ctx.rover.joint_upper, 0.0)
    # Damping only against the stop: a joint that leaves it is not held back.
    upward = jnp.where(below > 0.0, jnp.maximum(p.stiffness * below - p.damping * ctx.joint_speed, 0.0), 0.0)
    downward = jnp.where(above > 0.0, jnp.maximum(p.stiffness * above + p.damping * ctx.joint_speed, 0.0), 0.0)
    return dataclasses.replace(wrench, joint_torque=wrench.joint_torque + upward - downward)
