"""Heat that the motors receive beside the Joule loss: from their own motion, from the Sun and from the ground."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, effect
from lunar_mjx.effects.heat.paths import STEFAN_BOLTZMANN
from lunar_mjx.effects.joint.friction import largest_damping
from lunar_mjx.effects.joint.motor import constant_at
from lunar_mjx.spatial import Vec3


def _iron_damping(ctx, p):
    """N m s/rad at the joint."""
    motor = ctx.parameters["motor"]
    # Squared: once for the rotor's speed, once for its torque, both seen through the gear.
    return jnp.minimum(p.drag * p.coefficient * motor.gear_ratio**2, largest_damping(ctx))


def _iron_drag(ctx, p, x, torque):
    return torque - _iron_damping(ctx, p) * ctx.joint_speed


def _iron_heat(ctx, p, x, heat):
    speed = ctx.parameters["motor"].gear_ratio * ctx.joint_speed
    # Eddy currents arise in the iron that carries the winding, so the winding's node takes the heat.
    return dataclasses.replace(heat, winding=heat.winding + p.coefficient * speed**2)


iron_loss = Effect(
    name="iron_loss",
    ports={"motor_torque": _iron_drag, "heat": _iron_heat},
    parameters={
        "coefficient": Parameter(
            1e-6,
            0.0,
            (0.0, 1e-3),
            "W s2/rad2",
            "iron loss per square of the rotor's speed K_fe",
            "no-load current 0.052 A at 48 V and 670 rad/s, a fifth of the loss; choice",
            "joint",
        ),
        "drag": Parameter(
            1.0,
            None,
            (0.0, 1.0),
            "1",
            "share of the loss that brakes the rotor; 1 conserves energy",
            "conservation of energy",
        ),
    },
    order=15,
    doc="""Eddy currents: P += K_fe omega_m^2 with the rotor's speed omega_m = N omega, into the winding's node.

    The rotor is braked by what it heats: -N^2 K_fe omega at the joint (drag = 1); with drag = 0 the heat comes from
    nowhere, as where a log's model knows iron loss as heat alone. Source: MuJoCo's dcmotor note (thermal).""",
    requires=("motor",),
)


@effect(
    "heat",
    requires=("motor",),
    share=Parameter(
        1.0,
        0.0,
        (0.0, 1.0),
        "1",
        "share of the gear's and bearings' loss that heats the housing",
        "conservation of energy",
    ),
)
def gear_friction_heat(ctx, p, x, heat):
    """P_S += (N K I - tau) omega: what the rotor gives less what the joint gets: gear and friction.

    Without friction it is (1 - eta)/eta tau omega. It takes in every effect at the port motor_torque but the drag of
    iron_loss, which has its own node; cogging averages to zero. A gear driven back with the same efficiency both ways
    yields negative heat, the energy that such a gear makes from nothing: add directional_gear_efficiency. The engine's
    own joint damping is not among the losses.
    """
    motor = ctx.parameters["motor"]
    # Torque of the rotor without any loss; whatever does not arrive at the joint was lost between.
    rotor = motor.gear_ratio * constant_at(ctx.parameters, ctx.winding_temperature) * ctx.command.current
    # Iron drag acts at the same port but heats the winding, not the gear: left in, its power would be counted twice.
    iron = ctx.parameters.get("iron_loss")
    drag = 0.0 if iron is None else _iron_damping(ctx, iron) * ctx.joint_speed
    return dataclasses.replace(heat, housing=heat.housing + p.share * (rotor - ctx.torque - drag) * ctx.joint_speed)


@effect(
    "heat",
    absorptivity=Parameter(
        0.4, 0.0, (0.0, 1.0), "1", "solar absorptivity of the housing", "white paint aged by dust; choice"
    ),
    area=Parameter(
        0.0024,
        None,
        (1e-6, 1.0),
        "m2",
        "area of the housing seen from straight ahead of its normal",
        "22 mm x 110 mm motor with gearhead from the side",
        axis="joint",
    ),
    facing=Parameter(
        1.5707963267948966,
        None,
        (-6.3, 6.3),
        "rad",
        "heading of the housing's normal in the body, from forward to the left",
        "choice: left; give one per joint",
        axis="joint",
    ),
    sun_azimuth=Parameter(
        0.0, None, (-6.3, 6.3), "rad", "the Sun's azimuth from north (y) clockwise to east (x)", "the site and time"
    ),
    sun_elevation=Parameter(0.0873, None, (-1.6, 1.6), "rad", "the Sun's elevation", "5 deg, lunar south pole"),
    flux=Parameter(1361.0, None, (0.0, 1e4), "W/m2", "solar irradiance q_sun", "Kopp & Lean 2011, at 1 au"),
)
def solar_flux(ctx, p, x, heat):
    """P_S += alpha A q_sun max(0, cos theta), theta from the housing's normal, which turns with the rover, to the Sun.

    Where the model has a Sun of its own, direction and irradiance are its, behind the terrain's horizon, and the
    parameters sun_azimuth, sun_elevation and flux count for nothing; else there is no sunlight below a level horizon.
    The rover casts no shadow.
    """
    if ctx.sunlight is not None:
        return _warmed(ctx, p, heat, ctx.sunlight.direction, ctx.sunlight.irradiance)
    level = jnp.cos(p.sun_elevation)
    # Azimuth counts from north (y) clockwise: sine goes to east (x), the reverse of a mathematical angle.
    sun = Vec3(level * jnp.sin(p.sun_azimuth), level * jnp.cos(p.sun_azimuth), jnp.sin(p.sun_elevation))
    return _warmed(ctx, p, heat, sun, jnp.where(p.sun_elevation > 0.0, p.flux, 0.0))


def _warmed(ctx, p, heat, sun, lit):
    # Only the horizontal part of the Sun's direction counts, since the housings' normals lie in the body's plane.
    """The heat with what the housings absorb of sunlight of irradiance `lit`, W/m2, from the direction `sun`."""
    ahead, left = sun.dot(ctx.frame.forward), sun.dot(ctx.frame.left)
    cosine = jnp.maximum(ahead * jnp.cos(p.facing) + left * jnp.sin(p.facing), 0.0)
    return dataclasses.replace(heat, housing=heat.housing + p.absorptivity * p.area * lit * cosine)


@effect(
    "heat",
    area=Parameter(
        0.0064,
        0.0,
        (0.0, 1.0),
        "m2",
        "emissivity times area of the housing",
        "0.8 x 0.008 m2 of housing_radiation",
        axis="joint",
    ),
    view=Parameter(
        0.5,
        None,
        (0.0, 1.0),
        "1",
        "view factor F_g from the housing to the ground; the rest sees the sky",
        "a small body above a plane",
    ),
    ground_temperature=Parameter(
        220.0,
        None,
        (20.0, 450.0),
        "K",
        "temperature of the ground in sight",
        "sunlit regolith near the pole, 200 to 250 K; choice",
    ),
    sky_temperature=Parameter(3.0, None, (0.0, 400.0), "K", "temperature of the sky in sight", "deep space"),
)
def regolith_infrared(ctx, p, x, heat):
    """P_S += eps A sigma (F_g T_g^4 + (1 - F_g) T_sky^4 - T_A^4): ground and sky in place of the ambient temperature.

    Together with housing_radiation of the same eps A it is eps sigma A (F_g T_g^4 + F_s T_sky^4 - T_S^4).
    """
    # Less T_A^4, since housing_radiation has already let the housing see its surroundings at the ambient temperature.
    seen = p.view * p.ground_temperature**4 + (1.0 - p.view) * p.sky_temperature**4
    flow = STEFAN_BOLTZMANN * p.area * (seen - ctx.ambient_temperature**4)
    return dataclasses.replace(heat, housing=heat.housing + flow)
