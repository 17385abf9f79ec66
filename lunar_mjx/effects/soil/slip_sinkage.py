"""Wheels that slip sink deeper, along (slip-sinkage) and across (sinkage growing with the slip angle); port `soil`."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect

_FLAT = 1e-3
"""Slip below which the root of two squares is rounded off."""


def with_exponent(ctx, ground, change):
    """The soil with its sinkage exponent raised by `change`, pressure unaltered at a sinkage of one wheel radius.

    p (z/r)^change = k r^-change z^(n + change), so that the moduli carry the unit that belongs to the new exponent.
    """
    # Bekker's moduli change their unit with the exponent; normalised by the radius they keep their meaning.
    factor = ctx.geometry.radius**-change
    return dataclasses.replace(ground, k_c=ground.k_c * factor, k_phi=ground.k_phi * factor, n=ground.n + change)


_SOFTER = (0.0, 5.0)
"""Bounds of a growth of the sinkage exponent: slip does not firm soil; five times the nominal growth is a choice."""


@effect(
    "soil",
    driving=Parameter(
        1.0,
        0.0,
        _SOFTER,
        "1",
        "growth n_1 of the sinkage exponent with slip when driving",
        "choice: 3 to 7 times the static sinkage at a slip of 0.6 (Ding et al. 2010; Lyasko 2010)",
    ),
    skid=Parameter(
        0.5,
        0.0,
        _SOFTER,
        "1",
        "growth n_2 of the sinkage exponent with slip when skidding",
        "choice: half of that when driving",
    ),
)
def slip_sinkage(ctx, p, x, ground):
    """n = n_0 + n_1 s when driving, n_0 + n_2 |s| when skidding: the sheared soil is carried out from under the wheel.

    s is the slip as the soil remembers it: sheared soil is displaced over a contact length, and stays so under a wheel
    that stops. Ding et al. 2010 and the seed paper's n_0 + n_1 |s|, with the sinkage normalised by the
    wheel's radius, p = p_0 (z/r)^(n - n_0), so that the moduli keep their meaning whatever the exponent.
    """
    slip, slid = ctx.contact.soil_slip, ctx.contact.soil_slid
    # Two coefficients: a driven wheel throws soil out behind it, a braked one piles it up before itself. The slip is
    # all driving or all skidding but where rim and hub are opposed.
    return with_exponent(ctx, ground, 0.5 * (p.driving * (slid + slip) + p.skid * (slid - slip)))


def lateral_slip(contact):
    """Lateral speed over the larger of rim and travel speed, within [-1, 1]."""
    # The root keeps the quotient finite at rest and its derivative continuous.
    travel = jnp.sqrt(contact.v_x**2 + contact.v_y**2 + _STILL**2)
    return contact.v_y / jnp.maximum(jnp.abs(contact.rim_speed), travel)


_STILL: Annotated[float, "m/s"] = 2e-3
"""m/s; below it a wheel counts as standing, as for the slip ratio."""


@effect(
    "soil",
    lateral=Parameter(
        1.0,
        0.0,
        _SOFTER,
        "1",
        "growth of the sinkage exponent with lateral slip",
        "choice: sinkage threefold at 75 deg (CMU single-wheel test bed: 14 to 42 mm)",
    ),
)
def angle_sinkage(ctx, p, x, ground):
    """Soil sheared across the wheel is carried out from under it as is soil sheared along it.

    n = n_0 + n_y (sqrt(s_x^2 + s_y^2) - |s_x|), with s_x the slip ratio and s_y = v_y over the larger of rim and travel
    speed: slip-sinkage of the total sliding (Lyasko 2010 explains it by the shear displacement, which
    has no preferred direction), less the share along the wheel that `slip_sinkage` holds.
    """
    s_x, s_y = ctx.contact.soil_slid, lateral_slip(ctx.contact)
    # Rounded off, because |s_x| has no derivative where a wheel rolls freely.
    along = jnp.sqrt(s_x**2 + _FLAT**2)
    return with_exponent(ctx, ground, p.lateral * (jnp.sqrt(s_x**2 + s_y**2 + _FLAT**2) - along))
