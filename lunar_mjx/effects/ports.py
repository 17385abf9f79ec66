"""Calls the effects at their ports in the fixed order, and gathers the forces that they make."""

from __future__ import annotations

import dataclasses
import functools
from types import SimpleNamespace
from typing import Annotated, Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.context import (
    BodyWrench,
    Command,
    Contact,
    Context,
    Geometry,
    Heat,
    Normal,
    Power,
    RoverInfo,
    Soil,
    WheelForce,
)
from lunar_mjx.effects.marks import by_wheel
from lunar_mjx.effects.wheel.closed_form import lateral_slip_speed
from lunar_mjx.effects.wheel.rim_contact import fitted_plane
from lunar_mjx.pytree import pytree
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import inside, sample

# The same floor for slip, for direction and for the lateral slip, so that all three fade together at rest.
SLIP_SPEED_FLOOR: Annotated[float, "m/s"] = 2e-3
"""Smallest denominator of the instantaneous slip, m/s; below it slip fades to zero."""

EffectState = dict[str, dict[str, Any]]


@pytree
class Forces:
    """What the effects ask the engine to apply, in world coordinates.

    Attributes:
      joint_torque: at the actuated joints, N m.
      wheel_force, wheel_moment: on each wheel, at its centre, N, N m.
      chassis_force, chassis_moment: on the chassis, at the origin of its frame, N, N m.
      geometry: the rover as it is.
    """

    joint_torque: Any
    wheel_force: Vec3
    wheel_moment: Vec3
    chassis_force: Vec3
    chassis_moment: Vec3
    geometry: Geometry


class Pipeline:
    """The effects of a model, sorted by port."""

    def __init__(self, effects: tuple[Effect, ...]):
        self.effects = effects
        self._at = {}
        # Python's sort is stable: effects of one order keep their place in the model's list.
        for effect in sorted(effects, key=lambda e: e.order):
            for port in effect.ports:
                self._at.setdefault(port, []).append(effect)

    def __contains__(self, port: str) -> bool:
        return port in self._at

    def recall(self, contact: Contact, state: EffectState) -> Contact:
        """The contact as the soil remembers it, where an effect's state says so."""
        for effect in self.effects:
            if effect.recall is not None and effect.name in state:
                contact = effect.recall(SimpleNamespace(**state[effect.name]), contact)
        return contact

    def run(self, port: str, ctx: Context, state: EffectState, value: Any) -> tuple[Any, EffectState]:
        """Passes `value` through the effects at `port`; returns it with the effects' new state."""
        for effect in self._at.get(port, ()):
            own = state.get(effect.name, {})
            result = effect.ports[port](ctx, ctx.parameters[effect.name], SimpleNamespace(**own), value)
            # An effect without state returns its value alone; the choice is made while tracing and costs a step
            # nothing.
            if not effect.state:
                value = result
                continue
            value, update = result
            new = {}
            for name, old in own.items():
                value_now = update.get(name, old)
                if name in update and effect.state[name].rate:
                    # Euler's step, as the ports see one context per step; effects that need more (shear_state)
                    # integrate exactly themselves.
                    value_now = old + ctx.dt * update[name]
                # A weakly typed new state would compile the next call of the step anew.
                new[name] = jnp.asarray(value_now, old.dtype)
            state = {**state, effect.name: new}
        return value, state


def nominal_geometry(rover: RoverInfo) -> Geometry:
    """Wheels as the rover states them, without any offset."""
    zero = jnp.zeros_like(rover.wheel_radius)
    nil = jnp.zeros_like(rover.wheel_radius[..., 0])
    none = Vec3(nil, nil, nil)
    return Geometry(jnp.asarray(rover.wheel_radius), jnp.asarray(rover.wheel_width), zero, nil, none, none)


def wheel_contact(ctx: Context) -> Contact:
    """How the wheels meet the ground: sinkage, slip (eq. 8), slip angle (eq. 9) and the wheel frames.

    The ground under a wheel is the plane that touches the bilinear surface below the wheel's centre, or the one fitted
    along its rim where an effect says so. Slip and slip angle are taken in the direction of travel, so that both keep
    their meaning when backing up.
    """
    geometry, place = ctx.geometry, ctx.wheel_position
    assert geometry is not None
    height, slope_x, slope_y = _ground_below(ctx, geometry)
    # A wheel is shorter than a terrain's cell is wide, so the plane below its centre stands for the ground that it
    # meets.
    normal = Vec3(-slope_x, -slope_y, jnp.ones_like(slope_x)).unit()
    tilt = ctx.wheel_axle.dot(normal)
    # A wheel that leans reaches less far down; the floor keeps the root's derivative finite for one that lies flat.
    lowest = geometry.radius * jnp.sqrt(jnp.maximum(1.0 - tilt * tilt, 1e-6))
    # Along the normal: on a slope the vertical distance overstates it.
    sinkage = jnp.maximum(lowest - (place.z - height) * normal.z, 0.0)
    # Heading in the ground plane; undefined for a wheel that lies on its side, where the floor gives a short vector and
    # hence no force.
    ahead = ctx.wheel_axle.cross(normal).unit(1e-6)
    across = normal.cross(ahead)
    cos, sin = jnp.cos(geometry.toe), jnp.sin(geometry.toe)
    # Toe turns the heading about the ground's normal and not about the steering axis: alike for small angles, and the
    # heading stays in the ground plane.
    forward, left = ahead * cos + across * sin, across * cos - ahead * sin
    v_x, v_y = ctx.wheel_velocity.dot(forward), ctx.wheel_velocity.dot(left)
    rim_speed = geometry.radius * ctx.wheel_angular_velocity.dot(ctx.wheel_axle)
    # The faster of rim and travel decides the direction: it is the one that is not zero for a spinning or a sliding
    # wheel.
    roll = jnp.where(jnp.abs(rim_speed) > jnp.abs(v_x), rim_speed, v_x)
    # Zero counts as forward: a sign of 0 would erase the slip's derivative at rest.
    heading = jnp.where(roll < 0.0, -1.0, 1.0)
    slip = heading * (rim_speed - v_x) / jnp.maximum(jnp.abs(roll), SLIP_SPEED_FLOOR)
    travel = jnp.maximum(jnp.abs(v_x), SLIP_SPEED_FLOOR)
    return Contact(
        sinkage=sinkage,
        sinkage_rate=-ctx.wheel_velocity.dot(normal),
        slip=slip,
        # The arc tangent needs no clipping and stays within 90 deg where a wheel slides broadside, as a quotient does
        # not.
        slip_angle=jnp.arctan2(v_y, travel),
        v_x=v_x,
        v_y=v_y,
        rim_speed=rim_speed,
        forward=forward,
        left=left,
        normal=normal,
        inside=inside(ctx.terrain.field, place.x, place.y),
        soil_slip=jnp.clip(slip, -1.0, 1.0),
        soil_slid=jnp.minimum(jnp.abs(slip), 1.0),
    )


def _ground_below(ctx: Context, geometry: Geometry) -> tuple[Any, Any, Any]:
    """Height of the plane that each wheel meets, below its centre, m, and the plane's slopes by x and y."""
    place = ctx.wheel_position
    # The tangent below the axle serves models whose effects fit no plane: they take no further sample of the terrain.
    tangent = sample(ctx.terrain.field, place.x, place.y)
    if geometry.rim_share is None:
        return tangent

    def height_at(x: Any, y: Any) -> Any:
        ground = sample(ctx.terrain.field, x, y)[0]
        return ground if geometry.relief is None else ground + geometry.relief.at(x, y)[0]

    # A mix of both planes keeps the share differentiable, so that a fit can tell how much of the rim counts.
    fitted = fitted_plane(height_at, place, ctx.wheel_axle, geometry.radius, geometry.width)
    height, slope_x, slope_y = (t + geometry.rim_share * (f - t) for t, f in zip(tangent, fitted, strict=True))
    return height, slope_x, slope_y


def initial_soil(like: Any) -> Soil:
    """Soil before any effect has set it: zeros, and ones where effects divide by the value."""
    zero, one = jnp.zeros_like(like), jnp.ones_like(like)
    # Ones where laws divide by a modulus or raise it to a power; strength is 0, so that no ground means no grip.
    return Soil(zero, one, one, zero, zero, one, one, zero)


def initial_normal(like: Any) -> Normal:
    """Normal forces of wheels in the air."""
    zero = jnp.zeros_like(like)
    # Angles of an airborne wheel: an empty arc, but not one of length zero, through which effects divide.
    tiny = zero + 1e-4
    return Normal(2.0 * tiny, zero, tiny, zero, zero, zero, zero)


def initial_wheel(contact: Contact) -> WheelForce:
    """Instantaneous slip as the value before any memory of the soil: what `shear_state` tends to while rolling."""
    roll = jnp.where(jnp.abs(contact.rim_speed) > jnp.abs(contact.v_x), contact.rim_speed, contact.v_x)
    speed = jnp.maximum(jnp.abs(roll), SLIP_SPEED_FLOOR)
    zero = Vec3.zero(contact.sinkage)
    return WheelForce(
        slip_x=(contact.rim_speed - contact.v_x) / speed,
        slip_y=lateral_slip_speed(contact) / speed,
        # Falls to 0 at rest instead of jumping by sign: a parked wheel has no direction in which its contact leans.
        direction=jnp.clip(contact.rim_speed + contact.v_x, -jnp.abs(roll), jnp.abs(roll)) / speed,
        force=zero,
        moment=zero,
    )


def wheel_ports(pipeline: Pipeline, ctx: Context, state: EffectState) -> tuple[Context, EffectState]:
    """The ports soil, wheel_normal and wheel_shear, for a context that already has its contact."""
    assert ctx.contact is not None
    contact = pipeline.recall(ctx.contact, state)
    ctx = dataclasses.replace(ctx, contact=contact)
    soil, state = pipeline.run("soil", ctx, state, initial_soil(contact.sinkage))
    ctx = dataclasses.replace(ctx, soil=soil)
    normal, state = pipeline.run("wheel_normal", ctx, state, initial_normal(contact.sinkage))
    ctx = dataclasses.replace(ctx, normal=normal)
    wheel, state = pipeline.run("wheel_shear", ctx, state, initial_wheel(contact))
    return dataclasses.replace(ctx, wheel=wheel), state


def _wheels(pipeline: Pipeline, ctx: Context, state: EffectState) -> tuple[Any, ...]:
    """What the ground does to the wheels.

    Returns:
      Contact, soil, normal and shear of every wheel, its force, N, and moment, N m, in world coordinates, and the
      effects' new state.
    """
    ctx, state = wheel_ports(pipeline, dataclasses.replace(ctx, contact=wheel_contact(ctx)), state)
    # Forces are found in the wheel's frame, where the laws are stated, and turned into the world once, for all laws.
    contact, wheel = ctx.contact, ctx.wheel
    assert contact is not None and wheel is not None
    frame = Frame(contact.forward, contact.left, contact.normal)
    return contact, ctx.soil, ctx.normal, wheel, frame.to_world(wheel.force), frame.to_world(wheel.moment), state


def apply_effects(
    pipeline: Pipeline, ctx: Context, control: Any, state: EffectState
) -> tuple[Forces, Context, EffectState]:
    """Runs every force port in order; returns the forces, the completed context and the effects' new state."""
    command, state = pipeline.run("command", ctx, state, Command(control, jnp.zeros_like(control)))
    ctx = dataclasses.replace(ctx, command=command)
    # Motors start from zero torque: `motor` adds what current gives, and each friction takes its share away, in order.
    torque, state = pipeline.run("motor_torque", ctx, state, jnp.zeros_like(ctx.joint_angle))
    ctx = dataclasses.replace(ctx, torque=torque)
    geometry, state = pipeline.run("geometry", ctx, state, nominal_geometry(ctx.rover))
    ctx = dataclasses.replace(ctx, geometry=geometry)
    # Only from here on: the motor's law does not know gravity, but contact, soil and bulldozing do.
    if geometry.gravity is not None:
        ctx = dataclasses.replace(ctx, gravity=geometry.gravity)
    met = functools.partial(_wheels, pipeline, ctx, state)
    contact, soil, normal, wheel, wheel_force, wheel_moment, state = by_wheel(met, len(ctx.steering_angle))
    ctx = dataclasses.replace(ctx, contact=contact, soil=soil, normal=normal, wheel=wheel)
    zero = jnp.zeros_like(ctx.position.x)
    none = Vec3(zero, zero, zero)
    wrench, state = pipeline.run("body_wrench", ctx, state, BodyWrench(none, none, jnp.zeros_like(ctx.joint_angle)))
    # Models without electric power carry no zeros for it through every step.
    if "power" in pipeline:
        power, state = pipeline.run("power", ctx, state, Power(zero, zero, zero))
        ctx = dataclasses.replace(ctx, power=power)
    forces = Forces(
        joint_torque=torque + wrench.joint_torque,
        wheel_force=wheel_force,
        wheel_moment=wheel_moment,
        chassis_force=wrench.force,
        chassis_moment=wrench.moment,
        geometry=geometry,
    )
    return forces, ctx, state


def heat_flow(pipeline: Pipeline, ctx: Context, state: EffectState) -> tuple[Heat, EffectState]:
    """The port heat: net heat into the two nodes of every motor, for the temperatures in the context."""
    # Capacities of 1: a model without `motor` has no heat capacity, and heat is divided by it.
    zero, one = jnp.zeros_like(ctx.joint_angle), jnp.ones_like(ctx.joint_angle)
    return pipeline.run("heat", ctx, state, Heat(zero, zero, one, one))
