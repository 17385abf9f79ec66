"""The ground's parameters at each wheel (port `soil`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, Refusal, effect
from lunar_mjx.terrain import rock_fraction

_SOURCEBOOK = "Heiken et al. 1991, Lunar Sourcebook, ch. 9"

SOILS: dict[str, dict[str, float]] = {
    "lunar_nominal": {
        "k_c": 1.4e3,
        "k_phi": 8.2e5,
        "n": 1.0,
        "cohesion": 170.0,
        "friction_angle": 0.6108652381980153,
        "shear_modulus_x": 0.0178,
        "shear_modulus_y": 0.0178,
    },
    "paper": {
        "k_c": 1e5,
        "k_phi": 1e3,
        "n": 1.1,
        "cohesion": 462.3,
        "friction_angle": 0.3889,
        "shear_modulus_x": 0.015,
        "shear_modulus_y": 0.015,
    },
    "ding_2011": {
        "k_c": 15.6e3,
        "k_phi": 2.4074e6,
        "n": 1.10,
        "cohesion": 250.0,
        "friction_angle": 0.5567600313861338,
        "shear_modulus_x": 0.0114,
        "shear_modulus_y": 0.0114,
    },
    "marssim": {
        "k_c": 13600.0,
        "k_phi": 2259100.0,
        "n": 0.92,
        "cohesion": 462.3,
        "friction_angle": 0.6108652381980153,
        "shear_modulus_x": 0.015,
        "shear_modulus_y": 0.015,
    },
    "lete_sand": {
        "k_c": 102e3,
        "k_phi": 5.301e6,
        "n": 0.793,
        "cohesion": 1300.0,
        "friction_angle": 0.5427973973702366,
        "shear_modulus_x": 0.012,
        "shear_modulus_y": 0.012,
    },
}
"""Soils by name, in SI units (angles in rad): Lunar Sourcebook; the seed paper's release (k_c and k_phi look swapped
there); Ding et al. 2011 (shear moduli 0.0097-0.0131 m, middle taken); MarsSim's parameter file; Wong (LETE sand)."""


def _positive_stiffness(values: Mapping[str, Any], wheel_widths: Sequence[float]) -> Refusal | None:
    """Refuses a soil that would pull a wheel down: k_c/b + k_phi must be positive for every width b of a wheel."""
    narrowest = min(wheel_widths)
    stiffness = values["k_c"] / narrowest + values["k_phi"]
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
    order=-100,
    validate=_positive_stiffness,
    k_c=Parameter(1.4e3, None, (-1e7, 1e7), "N/m^(n+1)", "cohesive modulus of sinkage", _SOURCEBOOK),
    k_phi=Parameter(8.2e5, None, (0.0, 1e9), "N/m^(n+2)", "frictional modulus of sinkage", _SOURCEBOOK),
    n=Parameter(1.0, None, (0.1, 3.0), "1", "sinkage exponent", _SOURCEBOOK),
    cohesion=Parameter(170.0, None, (0.0, 1e6), "Pa", "cohesion", _SOURCEBOOK),
    friction_angle=Parameter(
        0.6108652381980153, None, (0.0, 1.2), "rad", "angle of internal friction", _SOURCEBOOK + " (35 deg)"
    ),
    shear_modulus_x=Parameter(0.0178, None, (1e-5, 1.0), "m", "shear deformation modulus K_s", _SOURCEBOOK),
    shear_modulus_y=Parameter(
        0.0178, None, (1e-5, 1.0), "m", "lateral shear deformation modulus K_y", _SOURCEBOOK + "; K_y = K_s"
    ),
)
def soil(ctx, p, x, ground):
    """Sets the same soil everywhere; effects after it change it by place, slip or history."""
    one = jnp.ones_like(ground.rock)
    return dataclasses.replace(
        ground,
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
    """Soft soil or hard rock at each wheel, read from the terrain's map; all soft where the terrain has none."""
    if ctx.terrain.soil is None:
        return ground
    fraction = rock_fraction(ctx.terrain.soil, ctx.wheel_position.x, ctx.wheel_position.y)
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
    factor = jnp.exp(jnp.clip(p.east * ctx.wheel_position.x + p.north * ctx.wheel_position.y, -5.0, 5.0))
    return dataclasses.replace(ground, k_c=ground.k_c * factor, k_phi=ground.k_phi * factor)
