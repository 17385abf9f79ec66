"""Soil that a wheel pushes before it and beside it, and what rolling costs beyond compaction (port `wheel_shear`)."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.wheel.closed_form import contact_with_soil, grounded, janosi
from lunar_mjx.spatial import Vec3

STILL: Annotated[float, "m/s"] = 2e-3
"""m/s; below it a wheel counts as standing, as for the slip ratio."""


def passive_pressure(soil, weight, depth, depth_squared):
    """Force of soil pushed aside per width of the wall that pushes, N/m: D_1 (c h + D_2 gamma h^2/2) (Hegedus).

    D_1 = cot X_c + tan(X_c + phi), D_2 = cot X_c + cot^2 X_c tan phi, with the destruction angle X_c = 45 deg - phi/2.

    Args:
      soil: cohesion and friction.
      weight: gamma = rho g, N/m3.
      depth, depth_squared: means of h and h^2 over the wall, m, m2.
    """
    # cot(45 deg - phi/2) = tan phi + 1/cos phi, so that no angle has to be taken.
    cotangent = soil.tan_phi + jnp.sqrt(1.0 + soil.tan_phi**2)
    d_1 = 2.0 * cotangent
    d_2 = cotangent * (1.0 + cotangent * soil.tan_phi)
    return d_1 * (soil.cohesion * depth + 0.5 * d_2 * weight * depth_squared)


BULK_DENSITY = Parameter(
    1600.0,
    None,
    (500.0, 5000.0),
    "kg/m3",
    "bulk density of the soil",
    "Lunar Sourcebook: 1500 to 1700 near the surface",
)


@effect(
    "wheel_shear",
    order=5,
    front=Parameter(
        1.0, 0.0, (0.0, 10.0), "1", "share of the bulldozing resistance in front of the wheel", "Wong 2008: 1"
    ),
    side=Parameter(
        1.0, 0.0, (0.0, 10.0), "1", "share of the bulldozing resistance beside the wheel", "Ishigami et al. 2007: 1"
    ),
    build_up=Parameter(
        1.0,
        None,
        (0.01, 50.0),
        "1",
        "sideways way over K_y at which 63 % of the pressure beside the wheel have built up",
        "choice: as the shear; Ishigami et al. 2007 have all of it at once (0)",
    ),
    density=BULK_DENSITY,
)
def bulldozing(ctx, p, x, wheel):
    """Passive earth pressure on the front and on the side wall: R = D_1 (c h + D_2 rho g h^2/2) per width (Hegedus).

    D_1 = cot X_c + tan(X_c + phi), D_2 = cot X_c + cot^2 X_c tan phi, X_c = 45 deg - phi/2 (Ishigami et al. 2007; Wong
    2008 for the front). In front h is the sinkage, over the wheel's width, in proportion to the travel per rolling; a
    wheel that spins on the spot pushes none. On the side h follows the circle from the sinkage to zero over l = r sin
    theta_1 (means of h and h^2: 2/3 z, 8/15 z^2). Its pressure builds up with the way that the flank has made aside at
    its centroid, 5/8 l v_y/v_x: soil beside a wheel passes at v_x, however fast the wheel turns.
    """
    contact, geometry, normal, soil = contact_with_soil(ctx), ctx.geometry, ctx.normal, ctx.soil
    z, r = contact.sinkage, geometry.radius
    weight = p.density * ctx.gravity
    soft = grounded(contact, jnp.where(soil.rock > 0.5, 0.0, 1.0))
    # Travel over the faster of rim and travel, 1 - s: a wheel that spins on the spot pushes no wall of soil before it.
    # The lean less the slip is that where both go one way, and twice that where they are opposed.
    opposed = jnp.abs(wheel.slip_x) > 1.0
    ahead = jnp.clip(jnp.where(opposed, 0.5, 1.0) * (wheel.direction - wheel.slip_x), -1.0, 1.0)
    front = -p.front * soft * geometry.width * passive_pressure(soil, weight, z, z * z) * ahead
    length = r * jnp.sin(jnp.minimum(normal.entrance, 0.5 * jnp.pi))
    # A wall that has not moved yet meets no passive pressure (Janosi's curve stands for the way).
    # The displacement of the shear refers to the faster of rim and travel, and is kept at rest, where v_y/v_x is lost.
    fastest = jnp.maximum(jnp.abs(contact.rim_speed), jnp.abs(contact.v_x))
    passed = jnp.sqrt((fastest**2 + STILL**2) / (contact.v_x**2 + STILL**2))
    moved = janosi(0.625 * length * passed * wheel.slip_y, p.build_up * soil.shear_modulus_y)
    wall = passive_pressure(soil, weight, 2.0 / 3.0 * z, 8.0 / 15.0 * z * z)
    side = -p.side * soft * length * wall * moved
    # the side force acts at the rim's depth, and at the centroid of the buried side, 3/8 of its length ahead
    # The front's force has no arm here: it is taken at the wheel's centre, as the compaction resistance is.
    force = Vec3(front, side, jnp.zeros_like(side))
    moment = Vec3(r * side, jnp.zeros_like(side), 0.375 * length * wheel.direction * side)
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


@effect(
    "wheel_shear",
    order=15,
    coefficient=Parameter(
        0.05,
        0.0,
        (0.0, 1.0),
        "1",
        "lever of the rolling resistance over the wheel's radius",
        "choice: flexible metal wheel on firm ground; rigid wheels have about 0.01",
    ),
    speed_scale=Parameter(
        0.01, None, (1e-5, 1.0), "m/s", "rim speed of full resistance", "choice: well below driving speed"
    ),
)
def rolling_resistance(ctx, p, x, wheel):
    """M_y = -f r W tanh(r omega/v_0): the wheel's own deformation puts the load ahead of the axle by f r (Wong 2008).

    A couple that the motor feels; on the rover it slows through the slip that it takes to overcome.
    """
    # A wheel that is pulled down (negative load) has no rolling resistance; tanh takes the jump at rest.
    load = jnp.maximum(wheel.force.z, 0.0)
    couple = p.coefficient * ctx.geometry.radius * load * jnp.tanh(ctx.contact.rim_speed / p.speed_scale)
    return dataclasses.replace(wheel, moment=wheel.moment._replace(y=wheel.moment.y - couple))
