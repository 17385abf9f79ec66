"""Where the wheel meets and leaves the soil, and how the stress grows with the rate of sinking; port `wheel_normal`."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.context import Arc
from lunar_mjx.effects.wheel.closed_form import (
    contact_with_soil,
    cos_difference,
    geometry_factors,
    grounded,
    max_normal_stress,
    sin_difference,
)
from lunar_mjx.effects.wheel.stress_integral import integrate


def _arc(theta_1, theta_m, theta_2) -> Arc:
    """Integrals over the contact arc of a stress that rises linearly from theta_2 to theta_m and falls to theta_1."""
    # Divided by the lengths of the two flanks: their slopes make the stress 1 at theta_m and 0 at both ends.
    rear, front = theta_m - theta_2, theta_1 - theta_m
    return Arc(
        cos=cos_difference(theta_m, theta_2) / rear + cos_difference(theta_m, theta_1) / front,
        sin=sin_difference(theta_m, theta_2) / rear - sin_difference(theta_1, theta_m) / front,
        one=0.5 * (theta_1 - theta_2),
    )


_ANGLES = "Wong & Reece 1967, J. Terramechanics 4(1):81"


@effect(
    "wheel_normal",
    order=1,
    c1=Parameter(0.4, 0.5, (0.05, 0.95), "1", "theta_m/theta_1 without slip", "Ishigami et al. 2007: a_0 = 0.4"),
    c2=Parameter(0.15, 0.0, (-0.5, 0.5), "1", "its growth with slip", "Ishigami et al. 2007: a_1 = 0.15"),
    c3=Parameter(
        0.2, 0.0, (0.0, 0.9), "1", "-theta_2/theta_1 without slip", "choice: rear contact of dry sand, " + _ANGLES
    ),
    c4=Parameter(0.1, 0.0, (-0.9, 0.9), "1", "its growth with slip", "choice"),
)
def exit_angle(ctx, p, x, normal):
    """theta_m = (c_1 + c_2 s) theta_1 and theta_2 = -(c_3 + c_4 s) theta_1 (Wong & Reece 1967).

    Contact behind the lowest point takes a share of the load and pushes the wheel forward. Acts on the closed form and
    on the stress integral; theta_m stays within [0.05, 0.95] theta_1 and theta_2 within [-0.95, 0] theta_1.
    """
    contact, geometry = contact_with_soil(ctx), ctx.geometry
    slip, theta_1 = contact.soil_slip, normal.entrance
    # The shares of theta_1 beyond those of the model without this effect, so that nothing is rounded at their null.
    ahead = jnp.clip((p.c1 - 0.5) + p.c2 * slip, -0.45, 0.45)
    behind = p.c3 + p.c4 * slip
    # not jnp.maximum, which would halve the derivative at the null
    behind = jnp.minimum(jnp.where(behind < 0.0, 0.0, behind), 0.95)
    theta_m = 0.5 * theta_1 + ahead * theta_1
    # Negative: behind the lowest point. The bound of 0.95 leaves the rear arc shorter than the front one.
    theta_2 = -behind * theta_1
    sigma_m = grounded(contact, max_normal_stress(ctx.soil, geometry.width, geometry.radius, theta_m, theta_1))
    if normal.stress is not None:
        load, resistance, stress = integrate(ctx, contact, theta_1, theta_m, theta_2, normal.reversal)
        return dataclasses.replace(
            normal, exit=theta_2, theta_m=theta_m, sigma_m=sigma_m, load=load, resistance=resistance, stress=stress
        )
    area = geometry.radius * geometry.width
    new = _arc(theta_1, theta_m, theta_2)
    old = _arc(theta_1, 0.5 * theta_1, 0.0 * theta_1)
    # What changes is added to what the contact model gave: exact where nothing changes.
    cos, sin = geometry_factors(0.5 * theta_1)
    one = 0.5 * theta_1
    return dataclasses.replace(
        normal,
        exit=theta_2,
        theta_m=theta_m,
        sigma_m=sigma_m,
        load=normal.load + area * (sigma_m * new.cos - normal.sigma_m * old.cos),
        resistance=normal.resistance + area * (sigma_m * new.sin - normal.sigma_m * old.sin),
        arc=Arc(cos + (new.cos - old.cos), sin + (new.sin - old.sin), one + (new.one - old.one)),
    )


@effect(
    "wheel_normal",
    order=5,
    transient=True,
    rate=Parameter(
        2.0,
        0.0,
        (0.0, 100.0),
        "s/m",
        "growth of the pressure with the rate of sinking",
        "choice: 40 % at 0.2 m/s, as when a wheel drops off a stone",
    ),
)
def dynamic_sinkage(ctx, p, x, normal):
    """p = k z^n (1 + c dz/dt), never negative: the soil resists fast sinking with its whole pressure.

    Linear in the rate of sinking, after the rate-dependent pressure-sinkage relations of Grahn 1991 and of the dynamic
    wheel model of Irani et al. 2013; it comes beyond the contact's own damping per area.
    """
    # A wheel that leaves the soil fast is let go, not held back: soil does not pull.
    factor = jnp.maximum(1.0 + p.rate * ctx.contact.sinkage_rate, 0.0)
    stress = normal.stress
    if stress is not None:
        stress = dataclasses.replace(stress, sigma=stress.sigma * factor)
    return dataclasses.replace(
        normal,
        sigma_m=normal.sigma_m * factor,
        load=normal.load * factor,
        resistance=normal.resistance * factor,
        stress=stress,
    )
