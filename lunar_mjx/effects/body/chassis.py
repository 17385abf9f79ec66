"""The rover as it is rather than as it was drawn (port `geometry`), and its parking brake."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, Refusal, StateVariable, effect
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Vec3

_HERE = "the user's measurement"
MOST_PAYLOAD = 5.0
"""Times the rover's mass that it may carry. A choice: twice what the Lunar Roving Vehicle did, 490 kg on 210 kg."""


def _place(axis: str) -> Parameter:
    return Parameter(0.0, None, (-10.0, 10.0), "m", f"{axis} of the payload in the chassis frame", _HERE)


def payload_refusal(values: Mapping[str, Any], rover: Rover) -> Refusal | None:
    """Why the payload `mass`, kg, is none that the rover carries, or None where it is."""
    if values["mass"] <= MOST_PAYLOAD * rover.mass:
        return None
    problem = f"is more than {MOST_PAYLOAD:g} times the {rover.mass:g} kg of the rover"
    return Refusal("mass", problem, f"give the mass in kg, {MOST_PAYLOAD * rover.mass:g} at most")


@effect(
    "geometry",
    validate=payload_refusal,
    mass=Parameter(0.0, 0.0, (0.0, 1e4), "kg", "payload mass", _HERE),
    x=_place("x"),
    y=_place("y"),
    z=_place("z"),
)
def payload(ctx, p, x, geometry):
    """A point mass fixed to the chassis: weight, inertia and centre of mass change with it."""
    return dataclasses.replace(geometry, payload_mass=p.mass, payload_position=Vec3(p.x, p.y, p.z))


def _shift(axis: str) -> Parameter:
    return Parameter(0.0, 0.0, (-1.0, 1.0), "m", f"shift of the chassis' centre of mass along {axis}", _HERE)


@effect("geometry", x=_shift("x"), y=_shift("y"), z=_shift("z"))
def com_offset(ctx, p, x, geometry):
    """The chassis' centre of mass lies elsewhere than drawn; its own inertia stays."""
    return dataclasses.replace(geometry, com_offset=Vec3(p.x, p.y, p.z))


@effect(
    # Added, not multiplied: caked soil and wear are lengths, whatever the radius.
    "geometry",
    offset=Parameter(0.0, 0.0, (-0.05, 0.05), "m", "wheel radius beyond the nominal one", _HERE, axis="wheel"),
)
def wheel_radius_error(ctx, p, x, geometry):
    """Wheels larger (caked soil) or smaller (wear) than drawn."""
    return dataclasses.replace(geometry, radius=geometry.radius + p.offset)


@effect(
    "geometry", angle=Parameter(0.0, 0.0, (-0.5, 0.5), "rad", "toe angle, positive to the left", _HERE, axis="wheel")
)
def steering_toe(ctx, p, x, geometry):
    """Each wheel's heading differs from its steering angle by a constant toe (misalignment)."""
    return dataclasses.replace(geometry, toe=geometry.toe + p.angle)


@effect(
    "geometry",
    transient=True,
    state={"distance": StateVariable(0.0, "m", "distance rolled by the rim since reset", rate=True)},
    wear=Parameter(
        1e-4,
        0.0,
        (-1e-2, 1e-2),
        "1",
        "radius lost per distance rolled; negative where soil cakes",
        "choice: caking and packing, 0.1 mm per m; abrasion alone is a thousand times slower",
    ),
)
def wheel_wear(ctx, p, x, geometry):
    """r(d) = r_0 - w d with d the distance rolled: wheels that wear, or grow as soil cakes on them (Archard 1953)."""
    # By the rim's own turning, slip included: a wheel that spins on the spot wears as well.
    rolled = geometry.radius * jnp.abs(ctx.wheel_angular_velocity.dot(ctx.wheel_axle))
    # Half the radius is far beyond any wear that is meant; it keeps a radius of a long drive from reaching zero.
    worn = jnp.maximum(geometry.radius - p.wear * x.distance, 0.5 * geometry.radius)
    return dataclasses.replace(geometry, radius=worn), {"distance": rolled}


@effect(
    "geometry",
    relative=Parameter(
        0.02,
        0.0,
        (-0.5, 0.5),
        "1",
        "gravity beyond the stated one, relative to it",
        "choice: order of an accelerometer's scale error",
    ),
)
def gravity_error(ctx, p, x, geometry):
    """g (1 + epsilon) on every body of the rover, and in the weight of the soil that it pushes.

    Stands for an error in the stated value, or of the slope's reference to first order (Newton's second law).
    """
    # Before gravity enters the context, so that contact, soil and the weight of pushed soil follow it.
    stated = ctx.gravity if geometry.gravity is None else geometry.gravity
    return dataclasses.replace(geometry, gravity=stated * (1.0 + p.relative))


@effect(
    "body_wrench",
    state={"angle": StateVariable(0.0, "rad", "angle at which the brake caught the wheel", axis="joint")},
    engaged=Parameter(1.0, 0.0, (0.0, 1.0), "1", "1: brake set; 0: released", "command"),
    stiffness=Parameter(
        2e3, None, (1.0, 1e7), "N m/rad", "stiffness of the braked wheel", "choice: stable at 2 ms for a 1 kg wheel"
    ),
    damping=Parameter(2.0, None, (0.0, 1e5), "N m s/rad", "damping of the braked wheel", "choice"),
)
def parking_brake(ctx, p, x, wrench):
    """Holds every drive joint at the angle where the brake caught it, as a stiff damped spring; blocks the wheels."""
    # Drives alone: a brake on the steering would fight the position controller.
    held = (ctx.rover.joint_group == 0) & (p.engaged > 0.5)
    # While released the state follows the joint, so that the brake catches the wheel where it is.
    angle = jnp.where(held, x.angle, ctx.joint_angle)
    holding_torque = p.stiffness * (angle - ctx.joint_angle) - p.damping * ctx.joint_speed
    torque = wrench.joint_torque + jnp.where(held, holding_torque, 0.0)
    return dataclasses.replace(wrench, joint_torque=torque), {"angle": angle}


def _hitch(axis: str) -> Parameter:
    return Parameter(0.0, None, (-10.0, 10.0), "m", f"{axis} of the hitch in the chassis frame", _HERE)


def _pull(axis: str, nominal: float) -> Parameter:
    return Parameter(
        nominal, 0.0, (-1e5, 1e5), "N", f"pull on the chassis along world {axis}", "choice: a drawbar test at a few kg"
    )


@effect(
    "body_wrench",
    force_x=_pull("x", -50.0),
    force_y=_pull("y", 0.0),
    force_z=_pull("z", 0.0),
    x=_hitch("x"),
    y=_hitch("y"),
    z=_hitch("z"),
)
def tether(ctx, p, x, wrench):
    """A constant force F at the hitch, moment r x F: a long tether for drawbar tests (d'Alembert's equivalence)."""
    # Parameters may be one number for a batch of rovers; the sum gives each rover its own.
    nil = jnp.zeros_like(ctx.position.x)
    force = Vec3(p.force_x + nil, p.force_y + nil, p.force_z + nil)
    # The hitch turns with the rover, the pull does not: a long tether keeps its direction in the world.
    arm = ctx.frame.to_world(Vec3(p.x, p.y, p.z))
    return dataclasses.replace(wrench, force=wrench.force + force, moment=wrench.moment + arm.cross(force))
