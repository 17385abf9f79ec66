"""Soil that varies with gravity, slope and place (port `soil`)."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, effect

_EXPONENT = (-2.0, 2.0)
"""Bounds of an exponent of gravity: twice the largest that is proposed, and either sign (a choice)."""


@effect(
    "soil",
    order=-55,
    stiffness=Parameter(
        1.0,
        0.0,
        _EXPONENT,
        "1",
        "exponent of gravity in k_phi",
        "Reece 1965: gamma b k_phi; sinkage of one mass is the same at any g (Kobayashi et al. 2010)",
    ),
    cohesion=Parameter(
        0.5,
        0.0,
        _EXPONENT,
        "1",
        "exponent of gravity in cohesion and k_c",
        "choice; soil that settled in less gravity is looser",
    ),
    reference=Parameter(
        9.80665,
        None,
        (0.1, 100.0),
        "m/s2",
        "gravity in which the soil's parameters were measured",
        "standard gravity of the Earth",
    ),
)
def gravity_soil(ctx, p, x, ground):
    """k_phi (g/g_ref)^a, and k_c and c times (g/g_ref)^b: gravity changes the soil, not only the weight upon it.

    The frictional modulus of dry soil stands for gamma k'_phi with gamma = rho g (Reece 1965), whence a = 1: the same
    mass sinks as deep in any gravity, and slips more in low gravity (Kobayashi et al. 2010; Wong & Kobayashi 2012).
    """
    # A power of zero gravity would have no finite derivative by its exponent.
    ratio = jnp.maximum(ctx.gravity / p.reference, 1e-6)
    firm, sticky = ratio**p.stiffness, ratio**p.cohesion
    return dataclasses.replace(
        ground, k_phi=ground.k_phi * firm, k_c=ground.k_c * sticky, cohesion=ground.cohesion * sticky
    )


@effect(
    "soil",
    order=-60,
    stiffness=Parameter(
        0.5,
        0.0,
        (-5.0, 5.0),
        "1",
        "loss of stiffness at the angle of repose, as a logarithm",
        "choice: 40 % less at repose",
    ),
    friction=Parameter(
        0.1,
        0.0,
        (-5.0, 5.0),
        "1",
        "loss of friction at the angle of repose, as a logarithm",
        "choice: 10 % less at repose",
    ),
)
def slope_stiffness(ctx, p, x, ground):
    """k exp(-a m) and tan phi exp(-b m) with m = (tan alpha/tan phi)^2, the share of strength that the slope takes.

    Soil near its angle of repose (alpha = phi, m = 1) has no shear strength left to bear a wheel, so that stiffness and
    effective friction fall with the slope; even in the slope, hence smooth on flat ground. The form is a choice: the
    literature gives bearing capacity factors on slopes (Meyerhof 1957), which fall likewise.
    """
    up = ctx.contact.normal
    # tan^2 of the slope from the normal, without an angle: smooth on level ground.
    grade = (up.x * up.x + up.y * up.y) / (up.z * up.z)
    # The floor of 0.05 (3 deg): for soil without friction the share of its strength would be infinite.
    strength_used = grade / jnp.maximum(ground.tan_phi, 0.05) ** 2
    # Beyond twice its strength no slope stands; there the soil grows no softer.
    soft = jnp.exp(-p.stiffness * jnp.minimum(strength_used, 2.0))
    return dataclasses.replace(
        ground,
        k_c=ground.k_c * soft,
        k_phi=ground.k_phi * soft,
        tan_phi=ground.tan_phi * jnp.exp(-p.friction * jnp.minimum(strength_used, 2.0)),
    )


PATCHES = 8
"""Number of places at which `soil_patches` lets the soil differ."""


def _patch_parameters() -> dict[str, Parameter]:
    parameters = {}
    for i in range(PATCHES):
        # Nominal: one soft patch 3 m ahead of the origin.
        parameters[f"amplitude_{i}"] = Parameter(
            -0.7 if i == 2 else 0.0,
            0.0,
            (-4.0, 4.0),
            "1",
            f"logarithm of the soil's stiffness factor at place {i}",
            "choice: half as stiff at place 2",
        )
    for i in range(PATCHES):
        patch_words = f"of place {i}; put it on the track of the log"
        parameters[f"x_{i}"] = Parameter(
            1.5 * i, None, (-1e6, 1e6), "m", "x " + patch_words, "choice: every 1.5 m along x"
        )
        parameters[f"y_{i}"] = Parameter(0.0, None, (-1e6, 1e6), "m", "y " + patch_words, "choice: along x")
    parameters["width"] = Parameter(1.0, None, (0.01, 1e4), "m", "standard deviation of a patch", "choice")
    parameters["cohesive"] = Parameter(
        0.5, None, (-2.0, 2.0), "1", "exponent by which cohesion follows the stiffness", "choice"
    )
    return parameters


def _soil_patches(ctx, p: SimpleNamespace, x, ground):
    place, values = ctx.wheel_position, vars(p)
    total = jnp.zeros_like(ground.k_phi)
    for i in range(PATCHES):
        squared = (place.x - values[f"x_{i}"]) ** 2 + (place.y - values[f"y_{i}"]) ** 2
        total = total + values[f"amplitude_{i}"] * jnp.exp(-0.5 * squared / p.width**2)
    # Patches overlap and may add up; within e^5 the moduli stay within what soils have, and the exponential finite.
    total = jnp.clip(total, -5.0, 5.0)
    firm = jnp.exp(total)
    return dataclasses.replace(
        ground, k_c=ground.k_c * firm, k_phi=ground.k_phi * firm, cohesion=ground.cohesion * jnp.exp(p.cohesive * total)
    )


soil_patches = Effect(
    name="soil_patches",
    ports={"soil": _soil_patches},
    parameters=_patch_parameters(),
    order=-65,
    transient=True,
    doc="""k exp(f) and c exp(q f) with f(x, y) = sum of a_i exp(-|x - x_i|^2/(2 w^2)): a smooth field of soil patches.

    Radial basis functions at eight fixed places (a Gaussian random field of length w, seen at the places; Rasmussen &
    Williams 2006, ch. 2); they can be told along the track of a log alone.""",
)
