"""Wheel on soft soil by quadrature of the Wong-Reece stress over the contact arc: the higher-fidelity option."""

from __future__ import annotations

import dataclasses
import itertools

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Effect, Parameter
from lunar_mjx.effects.context import Stress
from lunar_mjx.effects.wheel.closed_form import (
    _DAMPING,
    contact_with_soil,
    entrance_angle,
    first_axis,
    grounded,
    half_angle,
    max_normal_stress,
    normal_damping_force,
    shear_along,
    shear_stress,
    shearing_radius,
)
from lunar_mjx.spatial import Vec3

NODES_PER_SIDE = 6
"""Gauss-Legendre nodes before and after the angle of maximum stress; tests state the error of this choice."""

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(NODES_PER_SIDE)


def integrate(ctx, contact, theta_1, theta_m, theta_2, reversal=None):
    """Load and resistance of the normal stress, N, and the stress at the nodes, for the angles given in rad.

    Where the shear turns about at an angle of reversal, the part of the arc that holds it is divided there.
    """
    r, b = ctx.geometry.radius, ctx.geometry.width
    modulus = ctx.soil.k_c / b + ctx.soil.k_phi
    share, half = first_axis(0.5 * (1.0 + _NODES), theta_1), first_axis(0.5 * _WEIGHTS, theta_1)
    edges = [theta_2, theta_m, theta_1]
    if reversal is not None:
        turn = jnp.clip(reversal, theta_2, theta_1)
        # Quadrature across a kink converges slowly, so the arc is divided where the shear turns about.
        edges = [theta_2, jnp.minimum(turn, theta_m), jnp.maximum(turn, theta_m), theta_1]
    parts = list(itertools.pairwise(edges))
    # The whole arc in one array: two loops over its parts would compile twice.
    theta = jnp.concatenate([low + (high - low) * share for low, high in parts])
    weight = jnp.concatenate([half * (high - low) for low, high in parts])
    # The rear stress at theta is the front stress at the angle that lies as far, in proportion, from theta_m.
    mirror = theta_1 - (theta - theta_2) / (theta_m - theta_2) * (theta_1 - theta_m)
    (sine_1, _), (sine, cosine) = half_angle(theta_1), half_angle(theta)
    front = jnp.where(theta < theta_m, half_angle(mirror)[0], sine)
    # cos(theta) - cos(theta_1); depth^n with n < 1 has an infinite derivative at 0, where the arc begins
    depth = jnp.maximum(2.0 * r * (sine_1 - front) * (sine_1 + front), 1e-12 * r)
    # depth^n by its logarithm: XLA's power also handles negative numbers, at twice the time
    sigma = grounded(contact, modulus * jnp.exp(ctx.soil.n * jnp.log(depth)))
    area = r * b
    # Weighted once here: load, resistance and shear all sum the same products.
    pressed = weight * sigma
    # cos = 1 - 2 sin^2(theta/2), from the half angles at hand; no further cosine per node.
    load = area * jnp.sum(pressed * (1.0 - 2.0 * sine * sine), axis=0)
    resistance = area * jnp.sum(2.0 * pressed * sine * cosine, axis=0)
    return load, resistance, Stress(theta=theta, weight=weight, sigma=sigma)


def _normal(ctx, p, x, normal):
    contact, geometry = contact_with_soil(ctx), ctx.geometry
    theta_1 = entrance_angle(contact.sinkage, geometry.radius)
    theta_m, theta_2 = 0.5 * theta_1, jnp.zeros_like(theta_1)
    load, resistance, stress = integrate(ctx, contact, theta_1, theta_m, theta_2, normal.reversal)
    damping = jnp.maximum(normal_damping_force(ctx, p.damping, theta_1), -load)
    sigma_m = max_normal_stress(ctx.soil, geometry.width, geometry.radius, theta_m, theta_1)
    return dataclasses.replace(
        normal,
        entrance=theta_1,
        exit=theta_2,
        theta_m=theta_m,
        sigma_m=grounded(contact, sigma_m),
        load=load,
        resistance=resistance,
        damping=grounded(contact, damping),
        stress=stress,
    )


def _shear(ctx, p, x, wheel):
    geometry, normal, soil = ctx.geometry, ctx.normal, ctx.soil
    r, b, r_s = geometry.radius, geometry.width, shearing_radius(p, geometry, wheel)
    theta_1, stress = normal.entrance, normal.stress
    theta = stress.theta
    # Strength at nodes before any sum: the law is linear in it, but the mobilisation differs from node to node.
    strength = grounded(ctx.contact, soil.cohesion + stress.sigma * soil.tan_phi)
    sine, cosine = half_angle(theta)
    j_x = shear_along(wheel, normal, theta, r_s, r, (sine, cosine))
    tau, tau_y = shear_stress(wheel, soil, stress.weight * strength, j_x, r * (theta_1 - theta) * wheel.slip_y)
    cos, sin = 1.0 - 2.0 * sine * sine, 2.0 * sine * cosine
    along, lift, turn = jnp.sum(tau * cos, axis=0), jnp.sum(tau * sin, axis=0), jnp.sum(tau, axis=0)
    across, roll, yaw = jnp.sum(tau_y, axis=0), jnp.sum(tau_y * cos, axis=0), jnp.sum(tau_y * sin, axis=0)
    area = r * b
    force = Vec3(
        r_s * b * along - wheel.direction * normal.resistance,
        -area * across,
        normal.load + normal.damping + wheel.direction * r_s * b * lift,
    )
    # The normal stress acts through the axle and gives no moment; only shear turns the wheel.
    moment = Vec3(-r * area * roll, -r_s * r_s * b * turn, -wheel.direction * r * area * yaw)
    return dataclasses.replace(wheel, force=wheel.force + force, moment=wheel.moment + moment)


stress_integral = Effect(
    name="stress_integral",
    ports={"wheel_normal": _normal, "wheel_shear": _shear},
    parameters={
        "damping": _DAMPING,
        "shear_radius": Parameter(1.0, None, (0.8, 1.3), "1", "shearing radius r_s over the radius r", "r_s = r"),
    },
    replaces=("pressure_sinkage", "closed_form_shear"),
    doc="""Normal and shear stress integrated over the contact arc by Gauss-Legendre quadrature.

    sigma(theta) = (k_c/b + k_phi)[r(cos theta - cos theta_1)]^n in front of theta_m = theta_1/2, mirrored in proportion
    behind it down to theta_2 = 0 (Wong & Reece 1967); tau(theta) = (c + sigma tan phi)(1 - exp(-j(theta)/K)) with
    j(theta) = r_s (theta_1 - theta) - r (1 - s)(sin theta_1 - sin theta) (Janosi & Hanamoto 1961) and across
    r (1 - s)(theta_1 - theta) tan(beta) (Ishigami et al. 2007).""",
)
