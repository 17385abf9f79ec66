"""Shear strength shared between the directions of sliding (port `wheel_shear`)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect


@effect(
    "wheel_shear",
    order=-5,
    share=Parameter(
        1.0,
        0.0,
        (0.0, 1.0),
        "1",
        "0: each direction has the whole shear strength; 1: they share it",
        "friction acts against the sliding, whatever its direction",
    ),
)
def friction_circle(ctx, p, x, wheel):
    """(tau_x, tau_y) = (c + sigma tan phi)(1 - exp(-q)) (q_x, q_y)/q with q_i = j_i/K_i and q^2 = q_x^2 + q_y^2.

    One strength for the resultant, along the displacement that the soil has been sheared by, instead of one for each
    direction (the splitting of CMU's three-dimensional wheel model, by displacement instead of velocity, so that a
    wheel at rest holds). `share` mixes the two laws; works with the closed form and with the stress integral.
    """
    return dataclasses.replace(wheel, circle=p.share * jnp.ones_like(wheel.slip_x))
