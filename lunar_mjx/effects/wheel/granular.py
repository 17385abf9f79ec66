"""Wheel on dry grains by three-dimensional resistive force theory: the stress follows the motion of each face."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Effect, Parameter
from lunar_mjx.effects.context import Stress
from lunar_mjx.effects.wheel.closed_form import (
    _DAMPING,
    contact_with_soil,
    cos_difference,
    entrance_angle,
    first_axis,
    grounded,
    max_normal_stress,
    normal_damping_force,
    shearing_radius,
)
from lunar_mjx.spatial import Vec3

NODES = 12
"""Gauss-Legendre nodes over the contact arc."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(NODES)
_TINY = 1e-12
"""m2/s2; added below roots of squared speeds, whose derivative at rest would not be finite: a micrometre per second."""

_POWERS = (
    (0, 0, 0),
    (1, 0, 0),
    (0, 1, 0),
    (0, 0, 1),
    (2, 0, 0),
    (0, 2, 0),
    (0, 0, 2),
    (1, 1, 0),
    (0, 1, 1),
    (1, 0, 1),
    (3, 0, 0),
    (0, 3, 0),
    (0, 0, 3),
    (1, 2, 0),
    (2, 1, 0),
    (0, 1, 2),
    (0, 2, 1),
    (2, 0, 1),
    (1, 0, 2),
    (1, 1, 1),
)
"""Powers of x_1, x_2, x_3 in the polynomials of Agarwal, Goldman & Kamrin 2023 (PNAS 120:e2214017120, SI)."""

# Their coefficients of f_1, f_2, f_3, power by power.
_F1 = "0.00212 -0.02320 -0.20890 -0.43083 -0.00259 0.48872 -0.00415 0.07204 -0.02750 -0.08772 "
_F1 += "0.01992 -0.45961 0.40799 -0.10107 -0.06576 0.05664 -0.09269 0.01892 0.01033 0.15120"
_F2 = "-0.06796 -0.10941 0.04725 -0.06914 -0.05835 -0.65880 -0.11985 -0.25739 -0.26834 0.02692 "
_F2 += "-0.00736 0.63758 0.08997 0.21069 0.04748 0.20406 0.18589 0.04934 0.13527 -0.33207"
_F3 = "-0.02634 -0.03436 0.45256 0.00835 0.02553 -1.31290 -0.05532 0.06790 -0.16404 0.02287 "
_F3 += "0.02927 0.95406 -0.00131 -0.11028 0.01487 -0.02730 0.10911 -0.04097 0.07881 -0.27519"
_FACTORS = np.array([[float(c) for c in f.split()] for f in (_F1, _F2, _F3)])
FLAT = -float(_FACTORS.sum())
"""Stress per depth and stiffness on a flat plate that is pushed straight down (x_1 = x_2 = x_3 = 1)."""


def traction(theta, along, across, rim):
    """Stress of the grains on the rim's faces, over that on a flat plate pushed down as deep.

    Args:
      theta: (nodes, ...) angle of the faces from the vertical, rad, forward positive.
      along, across, rim: speeds of the hub along its travel and across it, and of the rim, m/s.

    Returns:
      Pressure; stress along the rim, forward positive; and across it: (nodes, ...) each, before friction bounds them.
    """
    sin, cos = jnp.sin(theta), jnp.cos(theta)
    speed = jnp.sqrt((along - rim * cos) ** 2 + across**2 + (rim * sin) ** 2 + _TINY)
    x1, x2, x3 = rim * sin / speed, cos, along * sin / speed
    terms = [x1**a * x2**b * x3**c for a, b, c in _POWERS]
    # Over FLAT, so that Bekker's moduli keep their meaning: a flat plate pushed down has the stress k z^n.
    f1, f2, f3 = (sum(c * t for c, t in zip(row, terms, strict=True)) / FLAT for row in _FACTORS)
    # stress = f1 normal + f2 motion + f3 down
    return -(f1 + f2 * x3 + f3 * x2), f2 * (along * cos - rim) / speed - f3 * sin, f2 * across / speed


def _travel(contact):
    """Direction of travel along the wheel, 1 or -1, and the speeds in the frame that looks that way."""
    # The polynomials hold for motion ahead; backing up is the same seen from behind.
    way = jnp.where(contact.v_x < 0.0, -1.0, 1.0)
    return way, (way * contact.v_x, contact.v_y, way * contact.rim_speed)


def _normal(ctx, p, x, normal):
    contact, geometry, soil = contact_with_soil(ctx), ctx.geometry, ctx.soil
    r, b = geometry.radius, geometry.width
    theta_1 = entrance_angle(contact.sinkage, r)
    theta = theta_1 * first_axis(0.5 * (1.0 + _NODES), theta_1)
    weight = theta_1 * first_axis(0.5 * _WEIGHTS, theta_1)
    pressure, _, _ = traction(theta, *_travel(contact)[1])
    # depth^n with n < 1 has an infinite derivative at 0, where the arc begins.
    depth = jnp.maximum(r * cos_difference(theta, theta_1), 1e-12 * r)
    sigma = grounded(contact, (soil.k_c / b + soil.k_phi) * depth**soil.n * jnp.maximum(pressure, 0.0))
    load = r * b * jnp.sum(weight * sigma * jnp.cos(theta), axis=0)
    resistance = r * b * jnp.sum(weight * sigma * jnp.sin(theta), axis=0)
    damping = jnp.maximum(normal_damping_force(ctx, p.damping, theta_1), -load)
    # The angle of maximum stress of the closed form, for effects that ask for it; the integral does not use it.
    theta_m = 0.5 * theta_1
    return dataclasses.replace(
        normal,
        entrance=theta_1,
        exit=jnp.zeros_like(theta_1),
        theta_m=theta_m,
        sigma_m=grounded(contact, max_normal_stress(soil, b, r, theta_m, theta_1)),
        load=load,
        resistance=resistance,
        damping=grounded(contact, damping),
        stress=Stress(theta=theta, weight=weight, sigma=sigma),
    )


def _shear(ctx, p, x, wheel):
    geometry, normal, soil = ctx.geometry, ctx.normal, ctx.soil
    r, b, r_s = geometry.radius, geometry.width, shearing_radius(p, geometry, wheel)
    theta, weight, sigma = normal.stress.theta, normal.stress.weight, normal.stress.sigma
    way, (along, across, rim) = _travel(ctx.contact)
    pressure, forward, aside = traction(theta, along, across, rim * r_s / r)
    size = jnp.sqrt(forward**2 + aside**2 + _TINY)
    # The theory gives any ratio of shear to pressure; grains slide at tan(phi).
    ratio = size / jnp.maximum(pressure, 1e-6)
    share = weight * sigma * jnp.minimum(ratio, soil.tan_phi) / size
    if wheel.grip is not None:
        share = share * wheel.grip
    tau, tau_y = share * forward, share * aside
    cos, sin = jnp.cos(theta), jnp.sin(theta)
    thrust, lift, turn = jnp.sum(tau * cos, axis=0), jnp.sum(tau * sin, axis=0), jnp.sum(tau, axis=0)
    side, roll, yaw = jnp.sum(tau_y, axis=0), jnp.sum(tau_y * cos, axis=0), jnp.sum(tau_y * sin, axis=0)
    force = Vec3(
        way * (r_s * b * thrust - normal.resistance), r * b * side, normal.load + normal.damping + r_s * b * lift
    )
    moment = Vec3(r * r * b * roll, -way * r_s * r_s * b * turn, way * r * r * b * yaw)
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


granular_resistance = Effect(
    name="granular_resistance",
    ports={"wheel_normal": _normal, "wheel_shear": _shear},
    parameters={
        "damping": _DAMPING,
        "shear_radius": Parameter(1.0, None, (0.8, 1.3), "1", "shearing radius r_s over the radius r", "r_s = r"),
    },
    replaces=("pressure_sinkage", "closed_form_shear", "stress_integral"),
    doc="""Dry grains by three-dimensional resistive force theory, integrated over the contact arc.

    On a face with normal n that moves along v: (k_c/b + k_phi) z^n (f_1 n + f_2 v + f_3 g)/f, with polynomials f_i of
    v.g, n.g and n.v and f their value for a flat plate pushed down (Agarwal, Goldman & Kamrin 2023); tan(phi) bounds
    the ratio of shear stress to pressure (Agarwal et al. 2021). The theory's own n is 1. A wheel that stands still in
    slip has thrust at once: grains have no shear modulus.""",
)
