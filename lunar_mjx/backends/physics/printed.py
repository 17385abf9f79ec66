"""The seed paper's wheel as printed (eqs. 8-14), with its flaws, and the engine's friction that carries it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.soil import arc_factors, entrance, mobilised, peak_stress

FLOOR = 0.02
"""m/s; smallest denominator of eqs. 8 and 9 as printed."""


def penalty_contact(c: Context, p: SimpleNamespace) -> None:
    """F_N = k_N z + c_N zdot, never pulling, on soil and rock alike; theta_m = theta_1/2."""
    contact, r = c.contact, c.geometry["radius"]
    touching = contact["sinkage"] > 0.0
    theta_1 = entrance(contact["sinkage"], r)
    theta_m = 0.5 * theta_1
    sigma = peak_stress(c.soil, c.geometry["width"], r, np.cos(theta_m), np.cos(theta_1))
    load = p.stiffness * contact["sinkage"]
    c.normal.update(
        entrance=theta_1,
        theta_m=theta_m,
        sigma_m=sigma * touching,
        load=load * touching,
        damping=np.maximum(p.damping * contact["sinkage_rate"], -load) * touching,
    )


def _printed_slip(contact: Values) -> np.ndarray:
    """s = 1 - v_x/(r omega) driving, r omega/v_x - 1 braking (eq. 8); denominators at least `FLOOR`, |s| <= 1."""
    rim, v_x = contact["rim_speed"], contact["v_x"]
    # Each is divided by the faster of rim and travel; at rest both vanish, which the paper leaves open.
    below = np.where(rim > v_x, rim, v_x)
    below = np.where(np.abs(below) < FLOOR, np.where(below < 0.0, -FLOOR, FLOOR), below)
    return np.minimum(np.maximum((rim - v_x) / below, -1.0), 1.0)


def _printed_tangent(contact: Values) -> np.ndarray:
    """tan(beta) of eq. 9, zero below `FLOOR`, beta within 89 deg of the axes."""
    v_x, v_y = contact["v_x"], contact["v_y"]
    moving = (v_x * v_x + v_y * v_y > FLOOR * FLOOR) & (v_y != 0.0)
    beta = np.arctan2(v_y, v_x) * moving
    # tan(beta) changes sign through infinity at 90 deg, where a wheel slides aside.
    return np.tan(np.minimum(np.maximum(beta, -1.553), 1.553))


def printed_shear(c: Context, p: SimpleNamespace) -> None:
    """Eqs. 8-14 as printed; every `mend_*` of 1 mends one flaw. theta_s is the steering angle with its toe."""
    contact, normal, soil, slip = c.contact, c.normal, c.soil, c.slip
    r, b = c.geometry["radius"], c.geometry["width"]
    r_s = p.shear_radius * r
    theta_1, theta_m = normal["entrance"], normal["theta_m"]
    a_factor, b_factor = arc_factors(theta_m)
    sin_m = np.sin(theta_m)
    chord = np.sin(theta_1) - sin_m
    way, s = 1.0, _printed_slip(contact)
    if p.mend_slip > 0.5:
        way = 1.0 - 2.0 * (slip["direction"] < 0.0)
        s = way * slip["slip_x"]
    soft = soil["rock"] <= 0.5
    bearing = soft & (contact["sinkage"] > 0.0)
    j = r_s * (theta_1 - theta_m) - (p.mend_j * r_s + 1.0 - p.mend_j) * (1.0 - s) * chord
    strength = (soil["cohesion"] + normal["sigma_m"] * soil["tan_phi"]) * bearing
    sigma = normal["sigma_m"] * soft
    if p.mend_j > 0.5:
        tau = strength * mobilised(j, soil["shear_modulus_x"])
    else:
        # As printed j can be negative, where the exponential grows without bound.
        tau = strength * (1.0 - np.exp(np.minimum(-j / soil["shear_modulus_x"], 3.0)))
    # The print takes the shear stress at the rim and the normal stress at the tips of the grousers: the wrong way
    # about.
    swapped = 1.0 - p.mend_shear_radius
    drawbar = (b * tau * a_factor) * (p.mend_shear_radius * r_s + swapped * r)
    drawbar -= (b * sigma * b_factor) * (p.mend_shear_radius * r + swapped * r_s)
    if p.mend_side > 0.5:
        across = strength * mobilised(r * theta_m * slip["slip_y"], soil["shear_modulus_y"])
        theta_s = np.zeros_like(r)
    else:
        push = r * np.abs((1.0 - s) * _printed_tangent(contact)) * theta_m / soil["shear_modulus_y"]
        across = np.sign(contact["v_y"]) * np.abs(tau) * -np.expm1(-np.minimum(push, 50.0))
        theta_s = (1.0 - p.mend_side) * (c.steering_angle + c.geometry["toe"])
    side = -r_s * b * theta_m * across
    force, moment = c.wheel["force"], c.wheel["moment"]
    force[..., 0] += way * drawbar
    force[..., 1] += side
    force[..., 2] += normal["load"] + normal["damping"]
    moment[..., 0] += r * side
    moment[..., 1] -= way * r_s * r_s * b * tau * theta_m
    lean = way if p.mend_side > 0.5 else 1.0
    moment[..., 2] += lean * sin_m * r * side - drawbar * b * theta_s / (8.0 * np.pi)


def engine_friction(c: Context, p: SimpleNamespace) -> None:
    """mu F_N tanh(|v|/v_e) against the sliding of the rim, at the wheel's lowest point."""
    contact, r = c.contact, c.geometry["radius"]
    slide_x, slide_y = contact["v_x"] - contact["rim_speed"], contact["v_y"]
    # The square of a micrometre per second, lest a wheel at rest divides zero by zero.
    speed = np.sqrt(slide_x * slide_x + slide_y * slide_y + 1e-12)
    friction = p.mu * (c.normal["load"] + c.normal["damping"]) * np.tanh(speed / p.speed_scale) / speed
    along, side = -friction * slide_x, -friction * slide_y
    force, moment = c.wheel["force"], c.wheel["moment"]
    force[..., 0] += along
    force[..., 1] += side
    moment[..., 0] += r * side
    moment[..., 1] -= r * along
