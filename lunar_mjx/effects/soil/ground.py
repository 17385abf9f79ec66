"""The ground's parameters at each wheel (port `soil`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Parameter, Refusal, effect
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import rock_fraction, soil_parameters
from lunar_mjx.terrain.soil.named import BOUNDS

_SOURCEBOOK = "Heiken et al. 1991, Lunar Sourcebook, ch. 9"


def _positive_stiffness(values: Mapping[str, Any], rover: Rover) -> Refusal | None:
    """Refuses a soil, or a map of soils, that would pull a wheel of width b down: k_c/b + k_phi must be positive."""
    # The narrowest wheel decides: k_c/b counts most under it, and only a negative k_c can make the sum negative.
    narrowest = min(wheel.width for wheel in rover.wheels)
    stiffness = float(np.min(np.asarray(values["k_c"], float) / narrowest + np.asarray(values["k_phi"], float)))
    if stiffness > 0.0:
        return None
    return Refusal(
        "k_c",
        f"makes the soil's stiffness k_c/b + k_phi = {stiffness:g} under a wheel {narrowest:g} m wide, which is not "
        "positive",
        "give a larger k_c or k_phi, or a rover with wider wheels",
    )


@effect(
    "soil",
    # First of all effects on soil: those after it scale what it sets, and would be overwritten if it came later.
    order=-100,
    validate=_positive_stiffness,
    # A map's tan_phi is no parameter of this name: it takes the place of the friction angle.
    mapped=("k_c", "k_phi", "n", "cohesion", "shear_modulus_x", "shear_modulus_y"),
    k_c=Parameter(1.4e3, None, BOUNDS["k_c"], "N/m^(n+1)", "cohesive modulus of sinkage", _SOURCEBOOK),
    k_phi=Parameter(8.2e5, None, BOUNDS["k_phi"], "N/m^(n+2)", "frictional modulus of sinkage", _SOURCEBOOK),
    n=Parameter(1.0, None, BOUNDS["n"], "1", "sinkage exponent", _SOURCEBOOK),
    cohesion=Parameter(170.0, None, BOUNDS["cohesion"], "Pa", "cohesion", _SOURCEBOOK),
    friction_angle=Parameter(
        0.6108652381980153,
        None,
        BOUNDS["friction_angle"],
        "rad",
        "angle of internal friction",
        _SOURCEBOOK + " (35 deg)",
    ),
    shear_modulus_x=Parameter(
        0.0178, None, BOUNDS["shear_modulus_x"], "m", "shear deformation modulus K_s", _SOURCEBOOK
    ),
    shear_modulus_y=Parameter(
        0.0178,
        None,
        BOUNDS["shear_modulus_y"],
        "m",
        "lateral shear deformation modulus K_y",
        _SOURCEBOOK + "; K_y = K_s",
    ),
)
def soil(ctx, p, x, ground):
    """Sets one soil for the whole ground; effects after it change it by place, slip or history."""
    one = jnp.ones_like(ground.rock)
    return dataclasses.replace(
        ground,
        # Times ones: a parameter is one number, while effects and engines expect an entry per wheel.
        k_c=p.k_c * one,
        k_phi=p.k_phi * one,
        n=p.n * one,
        cohesion=p.cohesion * one,
        tan_phi=jnp.tan(p.friction_angle) * one,
        shear_modulus_x=p.shear_modulus_x * one,
        shear_modulus_y=p.shear_modulus_y * one,
    )


@effect("soil", order=-90)
def surface_type(ctx, p, x, ground):
    """What the terrain's maps say at each wheel: soft soil or hard rock, and parameters of the soil.

    A parameter that no map holds stays as the effect `soil` has it; without maps all is soft and the same everywhere.
    The wheel's foot counts, one radius below its centre along the normal of the ground (for rock, its centre).
    """
    terrain, wheel_at = ctx.terrain, ctx.wheel_position
    if terrain.grids is not None:
        # Along the ground's normal and not straight down: on a slope the wheel touches uphill of the point below its
        # axle.
        foot = wheel_at - ctx.contact.normal * ctx.geometry.radius
        ground = dataclasses.replace(ground, **soil_parameters(terrain.grids, foot.x, foot.y))
    if terrain.soil is None:
        return ground
    fraction = rock_fraction(terrain.soil, wheel_at.x, wheel_at.y)
    # Half and half counts as soil: laws of rock and soil do not mix under one wheel.
    return dataclasses.replace(ground, rock=jnp.where(fraction > 0.5, 1.0, 0.0) * jnp.ones_like(ground.rock))


@effect(
    "soil",
    order=-80,
    fraction=Parameter(
        1.0, 0.0, (0.0, 1.0), "1", "1: rock everywhere; 0: as the map says", "for experiments on hard ground"
    ),
)
def hard_surface(ctx, p, x, ground):
    """Turns the whole terrain into hard rock, whatever the map says."""
    # The larger of both, so that rock on the map stays rock; a step at a half, as for the map.
    return dataclasses.replace(ground, rock=jnp.maximum(ground.rock, jnp.where(p.fraction > 0.5, 1.0, 0.0)))


@effect(
    "soil",
    order=-79,
    replaces=("hard_surface",),
    stiffness=Parameter(
        5e5, None, (1e3, 1e9), "N/m^(n+2)", "frictional modulus of sinkage k_phi", "choice: between snow and sandy loam"
    ),
    n=Parameter(1.0, None, (0.1, 3.0), "1", "sinkage exponent", "choice: as the Lunar Sourcebook has it"),
    cohesion=Parameter(1500.0, None, (0.0, 1e5), "Pa", "cohesion", "Wong 2008: sandy loam 1700 Pa, snow 1000 Pa"),
    friction_angle=Parameter(
        0.5, None, (0.05, 1.0), "rad", "angle of internal friction", "Wong 2008: sandy loam 29 deg, snow 20 to 30 deg"
    ),
    shear_modulus=Parameter(0.025, None, (1e-3, 0.2), "m", "shear deformation modulus", "Wong 2008: 0.01 to 0.05 m"),
)
def soft_ground(ctx, p, x, ground):
    """Ground that gives way under the wheels, in place of a hard surface, with moduli of its own.

    The wheels sink by Bekker's law and pay for it by compaction, and grip by the shear strength of the ground instead
    of by friction on it (Wong 2008, ch. 2); the laws are those of the effects at the ports after this one.
    """
    one = jnp.ones_like(ground.rock)
    return dataclasses.replace(
        ground,
        k_c=0.0 * one,
        # The modulus per width is left out: with one wheel's width only the sum k_c/b + k_phi can be told by a log.
        k_phi=p.stiffness * one,
        n=p.n * one,
        cohesion=p.cohesion * one,
        tan_phi=jnp.tan(p.friction_angle) * one,
        shear_modulus_x=p.shear_modulus * one,
        shear_modulus_y=p.shear_modulus * one,
        rock=0.0 * one,
    )


def _slope(direction: str) -> Parameter:
    return Parameter(0.0, 0.0, (-10.0, 10.0), "1/m", f"relative growth of the moduli toward {direction}", "site survey")


@effect("soil", order=-70, east=_slope("the east"), north=_slope("the north"))
def soil_gradient(ctx, p, x, ground):
    """Soil that grows stiffer in one direction: k_c and k_phi times exp(g_x x + g_y y)."""
    # An exponential stays positive wherever the rover drives; within e^5 the moduli stay within what soils have.
    factor = jnp.exp(jnp.clip(p.east * ctx.wheel_position.x + p.north * ctx.wheel_position.y, -5.0, 5.0))
    return dataclasses.replace(ground, k_c=ground.k_c * factor, k_phi=ground.k_phi * factor)
