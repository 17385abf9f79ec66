"""Wheel on soft soil (eqs. 10-14 mended): pressure-sinkage, the memory of the sheared soil, closed form and integral.

Sources: Wong & Reece 1967, Janosi & Hanamoto 1961, Ding et al. 2011, Ishigami et al. 2007, Bernard & Clover 1995.
"""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.contact import faster, side_speed
from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.motor import largest_damping
from lunar_mjx.backends.physics.vectors import clamp


@dataclasses.dataclass(frozen=True)
class ClosedForm:
    """Numbers of the closed form, written again for the independent check."""

    # Sinkage over radius is followed within these bounds (up to an entrance angle of 120 deg).
    shallow: float = 1e-09
    deep: float = 1.5
    shortest: float = 0.05
    """Contact length, in radii, below which soil is too little touched to remember by how far it was sheared."""
    damped: float = 0.4
    """Share of J/dt that a wheel's damping by its sheared soil keeps below."""
    stiff: float = 0.8
    """Share of J/dt^2 that a wheel's stiffness by its sheared soil keeps below."""


CLOSED_FORM = ClosedForm()


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
"""The nodes of the JAX effect, so that engines agree to rounding; that effect has a test of their error."""


def uniform_soil(p: SimpleNamespace | None, like: np.ndarray) -> Values:
    """One soil under all wheels (effect `soil`); without that effect a soil that bears next to nothing."""
    # The laws use the tangent.
    given = {} if p is None else vars(p) | {"tan_phi": np.tan(p.friction_angle)}
    bare = {
        "k_c": 0.0,
        "k_phi": 1.0,
        "n": 1.0,
        "cohesion": 0.0,
        "tan_phi": 0.0,
        "shear_modulus_x": 1.0,
        "shear_modulus_y": 1.0,
        "rock": 0.0,
    }
    return {name: np.zeros_like(like) + given.get(name, value) for name, value in bare.items()}


def local_soil(c: Context, uniform: Values, names: tuple[str, ...]) -> Values:
    """The ground at each wheel: the uniform soil, then `surface_type`, `hard_surface` and `soil_gradient`."""
    soil, place = dict(uniform), c.wheel_position
    for name in names:
        p = c.numbers.effects[name]
        if name == "surface_type":
            if c.ground.layers:
                foot = place - c.geometry["radius"][..., None] * c.contact["normal"]
                soil |= {k: grid.value(foot[..., 0], foot[..., 1])[0] for k, grid in c.ground.layers.items()}
            if c.ground.hard is not None:
                soil["rock"] = (c.ground.hard.value(place[..., 0], place[..., 1])[0] > 0.5).astype(float)
        elif name == "hard_surface" and p.fraction > 0.5:
            soil["rock"] = np.ones_like(soil["rock"])
        elif name == "soil_gradient":
            # far from the origin an exponential leaves every range that soil can have
            growth = np.exp(np.clip(p.east * place[..., 0] + p.north * place[..., 1], -5.0, 5.0))
            soil["k_c"], soil["k_phi"] = soil["k_c"] * growth, soil["k_phi"] * growth
    return soil


def below_surface(c: Context) -> np.ndarray:
    """Depth below the surface that each wheel meets, which is the bottom of a rut where there is one; m."""
    sinkage = c.contact["sinkage"]
    return np.maximum(sinkage - c.soil["rut"], 0.0) if "rut" in c.soil else sinkage


def entrance(sinkage: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """theta_1, at which the rim enters the soil: cos theta_1 = 1 - z/r; rad."""
    # by the half angle: arccos(1 - z/r) loses half of the digits where z is small
    ratio = np.minimum(np.maximum(sinkage / radius, CLOSED_FORM.shallow), CLOSED_FORM.deep)
    # tan^2(theta_1/2) = z/(2 r - z): another formula than the JAX effect's, so that a slip in one shows.
    return 2.0 * np.arctan2(np.sqrt(ratio), np.sqrt(2.0 - ratio))


def peak_stress(soil: Values, width: np.ndarray, radius: np.ndarray, cos_m: np.ndarray, cos_1: np.ndarray):
    """sigma_m = (k_c/b + k_phi) [r (cos theta_m - cos theta_1)]^n, Pa."""
    depth = np.maximum(radius * (cos_m - cos_1), CLOSED_FORM.shallow * radius)
    return (soil["k_c"] / width + soil["k_phi"]) * depth ** soil["n"]


def arc_factors(theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A = 2 cos(t)(1 - cos t)/t and B = 2 sin(t)(1 - cos t)/t of eq. 10."""
    # 1 - cos(t) = 2 sin^2(t/2), which keeps its digits for shallow wheels
    half = np.sin(0.5 * theta)
    common = 4.0 * half * half / theta
    return np.cos(theta) * common, np.sin(theta) * common


def mobilised(displacement: np.ndarray, modulus: np.ndarray) -> np.ndarray:
    """Share of the shear strength that a displacement mobilises: sgn(j)(1 - exp(-|j|/K)) (Janosi & Hanamoto)."""
    return np.copysign(np.expm1(-np.abs(displacement) / modulus), displacement)


def shear_stress(c: Context, strength: np.ndarray, q_x: np.ndarray, q_y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shear stress along and across after displacements of q moduli, Pa; one strength for both in `friction_circle`."""
    alone = strength * mobilised(q_x, np.ones(1)), strength * mobilised(q_y, np.ones(1))
    circle = c.numbers.effects.get("friction_circle")
    if circle is None:
        return alone
    q = np.sqrt(q_x * q_x + q_y * q_y + 1e-24)
    common = strength * -np.expm1(-q) / q
    along, across = (t + circle.share * (common * x - t) for t, x in zip(alone, (q_x, q_y), strict=True))
    return along, across


def area_damping(c: Context, coefficient: float, theta_1: np.ndarray, load: np.ndarray) -> np.ndarray:
    """c' b r sin(theta_1) zdot, never pulling below zero the sum with the load; N."""
    # beyond a quarter turn the sine would fall again, and the area in the soil does not
    area = c.geometry["width"] * c.geometry["radius"] * np.sin(np.minimum(theta_1, 0.5 * np.pi))
    return np.maximum(coefficient * area * c.contact["sinkage_rate"], -load)


def pressure_sinkage(c: Context, p: SimpleNamespace) -> None:
    """W = r b sigma_m A between theta_2 = 0, theta_m = theta_1/2 and theta_1; resistance r b sigma_m B."""
    r, b = c.geometry["radius"], c.geometry["width"]
    sinkage = below_surface(c)
    touching = sinkage > 0.0
    theta_1 = entrance(sinkage, r)
    theta_m = 0.5 * theta_1
    sigma = peak_stress(c.soil, b, r, np.cos(theta_m), np.cos(theta_1)) * touching
    a_factor, b_factor = arc_factors(theta_m)
    per_stress = r * b * sigma
    load = per_stress * a_factor
    c.normal.update(
        entrance=theta_1,
        theta_m=theta_m,
        sigma_m=sigma,
        load=load,
        resistance=per_stress * b_factor,
        damping=area_damping(c, p.damping, theta_1, load) * touching,
    )


def shear_state(c: Context, p: SimpleNamespace, state: Values) -> Values:
    """L dk/dt = v_slip - V_r k, exact over a step.

    L is the contact length times `relaxation`, and V_r the largest of |r omega|, |v_x| and, on soil, `creep`. The force
    takes k plus `damping_time` times its mean rate, faded by exp(-V_r damping_time/L) when rolling. On soil L is
    lengthened and that time cut to what an explicit step takes without shaking a wheel at rest.
    """
    contact, r = c.contact, c.geometry["radius"]
    theta_1, theta_m = c.normal["entrance"], c.normal["theta_m"]
    # Plain differences: float64 has digits to spare, and the formula stays the source's.
    arc = np.maximum(r * (np.sin(theta_1) - np.sin(theta_m)), CLOSED_FORM.shortest * r)
    # rock has no arc in the ground over which shear could build up: bristles take the place of soil
    # soil that is stiffer than the drives' inertia takes in a step renews itself over a longer way
    area = c.geometry["width"] * r * theta_1
    stiffness = c.soil["cohesion"] * area + c.normal["load"] * c.soil["tan_phi"]
    stiffness = stiffness * arc / c.soil["shear_modulus_x"]
    most = np.min(largest_damping(c)[c.numbers.group == 0], initial=np.inf)
    shortest = stiffness * r**2 * c.dt / (CLOSED_FORM.stiff * most)
    length = np.where(c.soil["rock"] > 0.5, p.rock_length, np.maximum(p.relaxation * arc, shortest))
    roll = faster(contact["rim_speed"], contact["v_x"])
    speed = np.abs(roll)
    renewing = np.where(c.soil["rock"] > 0.5, speed, np.maximum(speed, p.creep))
    share = renewing / length
    touching = contact["sinkage"] > 0.0
    # the equation is linear while slip is held, so that its solution over a step holds at any ratio of speed and length
    # Divided by below; in float64 this is zero for all that matters.
    turned = np.maximum(share * c.dt, 1e-200)
    gain = -np.expm1(-turned) / turned / length
    # and damps for a shorter time
    longest = CLOSED_FORM.damped * most * length / np.maximum(stiffness * r**2, 1e-12)
    damping_time = np.where(c.soil["rock"] > 0.5, p.damping_time, np.minimum(p.damping_time, longest))
    damped = damping_time * np.exp(-share * damping_time)

    def advance(value: np.ndarray, source: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rate = gain * (source - renewing * value)
        new = value + c.dt * rate
        return new * touching, (new + damped * rate) * touching

    slip_x, pushed_x = advance(state["slip_x"], contact["rim_speed"] - contact["v_x"])
    slip_y, pushed_y = advance(state["slip_y"], side_speed(contact))
    # hub and rim together tell which way the contact leans, so that it turns over by degrees where they are opposed
    way = np.minimum(np.maximum(contact["rim_speed"] + contact["v_x"], -speed), speed)
    direction = np.minimum(np.maximum(advance(state["direction"], way)[0], -1.0), 1.0)
    c.slip.update(slip_x=pushed_x, slip_y=pushed_y, direction=direction)
    return {"slip_x": slip_x, "slip_y": slip_y, "direction": direction}


def shear_along(c: Context, theta: np.ndarray, r_s: np.ndarray) -> np.ndarray:
    """j = r_s (theta_1 - theta) - r (1 - s)(sin theta_1 - sin theta) at nodes (rover, wheel, node), m.

    Ahead of the angle of reversal s is that of the soil there.
    """
    r, slip, theta_1 = c.geometry["radius"][..., None], c.slip, c.normal["entrance"][..., None]
    way, s = slip["direction"][..., None], slip["slip_x"][..., None]
    chord = np.sin(theta_1) - np.sin(theta)
    j = way * (r_s[..., None] * (theta_1 - theta) - r * chord) + r * s * chord
    if "slip_ahead" in slip:
        turn = np.minimum(c.normal["reversal"][..., None], theta_1)
        j = j + r * (slip["slip_ahead"][..., None] - s) * (np.sin(theta_1) - np.sin(np.maximum(theta, turn)))
    return j


def closed_form_shear(c: Context, p: SimpleNamespace) -> None:
    """tau at theta_m from j = r_s (theta_1 - theta_m) - r (1 - s)(sin theta_1 - sin theta_m), applied over the arc.

    F_x = r_s b tau A - r b sigma_m B; F_y = -r b tau_y theta_m; F_z = load + damping + r_s b tau B; M_x = r F_y;
    M_y = -r_s^2 b tau theta_m; M_z = r sin(theta_m) F_y, with the arc leaning in the direction of rolling.
    """
    normal, soil, slip = c.normal, c.soil, c.slip
    r, b = c.geometry["radius"], c.geometry["width"]
    r_s = p.shear_radius * r
    theta_m, way = normal["theta_m"], slip["direction"]
    a_factor, b_factor = arc_factors(theta_m)
    sin_m = np.sin(theta_m)
    strength = (soil["cohesion"] + normal["sigma_m"] * soil["tan_phi"]) * (c.contact["sinkage"] > 0.0)
    j = shear_along(c, theta_m[..., None], r_s)[..., 0]
    tau, tau_y = shear_stress(
        c, strength, j / soil["shear_modulus_x"], r * theta_m * slip["slip_y"] / soil["shear_modulus_y"]
    )
    pull = r_s * b * tau
    side = -r * b * theta_m * tau_y
    force, moment = c.wheel["force"], c.wheel["moment"]
    force[..., 0] += pull * a_factor - way * normal["resistance"]
    force[..., 1] += side
    force[..., 2] += normal["load"] + normal["damping"] + way * pull * b_factor
    moment[..., 0] += r * side
    moment[..., 1] -= r_s * pull * theta_m
    moment[..., 2] += way * r * sin_m * side


def integral_normal(c: Context, p: SimpleNamespace) -> None:
    """Wong-Reece stress integrated over the arc: load and resistance; the stress at nodes stays in `stress`."""
    r, b, soil = c.geometry["radius"], c.geometry["width"], c.soil
    sinkage = below_surface(c)
    touching = sinkage > 0.0
    theta_1 = entrance(sinkage, r)
    theta_m = 0.5 * theta_1
    share = 0.5 * (1.0 + _NODES)
    ends = [np.zeros_like(theta_1), theta_m, theta_1]
    if "reversal" in c.normal:
        turn = clamp(c.normal["reversal"], ends[0], theta_1)
        ends = [ends[0], np.minimum(turn, theta_m), np.maximum(turn, theta_m), theta_1]
    # The arc is divided where stress or shear has a kink, across which Gauss' nodes converge slowly.
    parts = [(low[..., None], (high - low)[..., None]) for low, high in itertools.pairwise(ends)]
    theta = np.concatenate([low + long * share for low, long in parts], axis=-1)
    weight = np.concatenate([0.5 * long * _WEIGHTS for _, long in parts], axis=-1)
    # behind theta_m the stress mirrors the front in proportion: with theta_2 = 0 the mirror of t is theta_1 - t
    mirror = np.where(theta < theta_m[..., None], theta_1[..., None] - theta, theta)
    depth = np.maximum(r[..., None] * (np.cos(mirror) - np.cos(theta_1)[..., None]), 1e-12 * r[..., None])
    sigma = (soil["k_c"] / b + soil["k_phi"])[..., None] * depth ** soil["n"][..., None] * touching[..., None]
    load = r * b * np.sum(weight * sigma * np.cos(theta), axis=-1)
    c.normal.update(
        entrance=theta_1,
        theta_m=theta_m,
        sigma_m=peak_stress(soil, b, r, np.cos(theta_m), np.cos(theta_1)) * touching,
        load=load,
        resistance=r * b * np.sum(weight * sigma * np.sin(theta), axis=-1),
        damping=area_damping(c, p.damping, theta_1, load) * touching,
        stress=np.stack([theta, weight, sigma]),
    )


def integral_shear(c: Context, p: SimpleNamespace) -> None:
    """Shear stress tau(theta) = (c + sigma tan phi)(1 - exp(-j(theta)/K)) integrated over the arc."""
    normal, soil, slip = c.normal, c.soil, c.slip
    r, b = c.geometry["radius"], c.geometry["width"]
    r_s = p.shear_radius * r
    theta, weight, sigma = normal["stress"]
    theta_1, way = normal["entrance"][..., None], slip["direction"]
    touching = (c.contact["sinkage"] > 0.0)[..., None]
    strength = weight * (soil["cohesion"][..., None] + sigma * soil["tan_phi"][..., None]) * touching
    j = shear_along(c, theta, r_s)
    across = (r * slip["slip_y"])[..., None] * (theta_1 - theta)
    tau, tau_y = shear_stress(
        c, strength, j / soil["shear_modulus_x"][..., None], across / soil["shear_modulus_y"][..., None]
    )
    cos, sin = np.cos(theta), np.sin(theta)
    force, moment = c.wheel["force"], c.wheel["moment"]
    force[..., 0] += r_s * b * np.sum(tau * cos, -1) - way * normal["resistance"]
    force[..., 1] -= r * b * np.sum(tau_y, -1)
    force[..., 2] += normal["load"] + normal["damping"] + way * r_s * b * np.sum(tau * sin, -1)
    moment[..., 0] -= r * r * b * np.sum(tau_y * cos, -1)
    moment[..., 1] -= r_s * r_s * b * np.sum(tau, -1)
    moment[..., 2] -= way * r * r * b * np.sum(tau_y * sin, -1)
