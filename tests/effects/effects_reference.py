"""Independent NumPy versions of the force and heat equations, written from the printed equations.

They share no code with the library. Equations are evaluated as printed, in extended precision (`numpy.longdouble`),
so that the differences of cosines need no half-angle form. Numbers are those of the seed paper; mended forms follow
Wong & Reece 1967, Janosi & Hanamoto 1961, Ding et al. 2011 and Ishigami et al. 2007.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

Array = Any
REAL = np.longdouble
STEFAN_BOLTZMANN = 5.670374419e-8
REFERENCE_KELVIN = 298.15


@dataclass
class WheelState:
    """One wheel per entry: how it stands in the ground, and the ground's parameters."""

    radius: Array
    width: Array
    sinkage: Array
    sinkage_rate: Array
    slip_x: Array
    slip_y: Array
    direction: Array
    k_c: Array
    k_phi: Array
    n: Array
    cohesion: Array
    tan_phi: Array
    shear_modulus_x: Array
    shear_modulus_y: Array

    def extended(self) -> WheelState:
        """The same in extended precision."""
        return WheelState(*(np.asarray(getattr(self, f.name), REAL) for f in fields(self)))


@dataclass
class Wrench:
    """Force and moment on the wheel in its frame (forward, left, normal), and the size of the largest term in each."""

    force: tuple[Array, Array, Array]
    moment: tuple[Array, Array, Array]
    load: Array
    scale: Array


def angles(state: WheelState) -> tuple[Array, Array]:
    """theta_1 = arccos((r - z)/r) and theta_m = theta_1/2, rad."""
    theta_1 = np.arccos((state.radius - state.sinkage) / state.radius)
    return theta_1, theta_1 / 2


def factors(theta_m: Array) -> tuple[Array, Array]:
    """A and B as printed below eq. 14; 0 at theta_m = 0."""
    safe = np.where(theta_m > 0, theta_m, 1)
    a = np.where(theta_m > 0, (2 * np.cos(safe) - np.cos(2 * safe) - 1) / safe, 0)
    b = np.where(theta_m > 0, (2 * np.sin(safe) - np.sin(2 * safe)) / safe, 0)
    return a, b


def stress(state: WheelState, cos_theta: Array, cos_theta_1: Array) -> Array:
    """(k_c/b + k_phi) [r (cos theta - cos theta_1)]^n, Pa."""
    depth = np.maximum(state.radius * (cos_theta - cos_theta_1), 0)
    return (state.k_c / state.width + state.k_phi) * depth**state.n


def mobilised(displacement: Array, modulus: Array) -> Array:
    """1 - exp(-j/K) for positive j, odd in j (Janosi & Hanamoto 1961)."""
    return np.sign(displacement) * (1 - np.exp(-np.abs(displacement) / modulus))


def damping(state: WheelState, coefficient: float, theta_1: Array) -> Array:
    """c' b r sin(theta_1) zdot: damping in proportion to the contact area, N."""
    return coefficient * state.width * state.radius * np.sin(theta_1) * state.sinkage_rate


def normal_force(load: Array, damping_force: Array) -> Array:
    """The ground pushes and never pulls."""
    return np.maximum(load + damping_force, 0)


def closed_form(state: WheelState, shear_radius: float = 1.0, coefficient: float = 0.0) -> Wrench:
    """Eqs. 10-14 in Ding's form for both directions of travel.

    The contact arc leans forward for direction 1 and backward for -1. Of the displacement at theta_m, the part
    (theta_1 - theta_m) - (sin theta_1 - sin theta_m) of a freely rolling wheel turns with the direction, and the
    part s (sin theta_1 - sin theta_m) with the slip.
    """
    s = state.extended()
    r, r_s, b, d = s.radius, shear_radius * s.radius, s.width, s.direction
    theta_1, theta_m = angles(s)
    a, bb = factors(theta_m)
    sigma = stress(s, np.cos(theta_m), np.cos(theta_1))
    strength = s.cohesion + sigma * s.tan_phi
    arc, chord = theta_1 - theta_m, np.sin(theta_1) - np.sin(theta_m)
    tau_x = strength * mobilised(d * (r_s * arc - r * chord) + r * s.slip_x * chord, s.shear_modulus_x)
    tau_y = strength * mobilised(r * theta_m * s.slip_y, s.shear_modulus_y)
    load = r * b * sigma * a
    push = normal_force(load, damping(s, coefficient, theta_1))
    f_x = r_s * b * tau_x * a - d * r * b * sigma * bb
    f_y = -r * b * tau_y * theta_m
    f_z = push + d * r_s * b * tau_x * bb
    moment = (r * f_y, -r_s * r_s * b * tau_x * theta_m, d * r * np.sin(theta_m) * f_y)
    return Wrench((f_x, f_y, f_z), moment, load, np.maximum(push, r * b * strength * theta_1))


def stress_integral(
    state: WheelState, nodes: int, pieces: int = 1, shear_radius: float = 1.0, coefficient: float = 0.0
) -> Wrench:
    """The Wong-Reece stress and Janosi shear integrated over 0..theta_m and theta_m..theta_1.

    Args:
      state: the wheels.
      nodes: Gauss-Legendre nodes on every piece.
      pieces: equal pieces of each of the two halves of the arc.
      shear_radius: r_s/r.
      coefficient: damping per area, Pa s/m.

    Returns:
      Force and moment on the wheels.
    """
    s = state.extended()
    r, r_s, b, d = s.radius, shear_radius * s.radius, s.width, s.direction
    theta_1, theta_m = angles(s)
    point, weight = np.polynomial.legendre.leggauss(nodes)
    total = [np.zeros_like(r) for _ in range(8)]
    for half in (0, 1):
        for piece in range(pieces):
            for x, w in zip(point, weight, strict=True):
                share = REAL(piece + (1 + x) / 2) / pieces
                theta = theta_m * (half + share)
                front = theta if half else theta_1 - theta  # the rear mirrors the front about theta_m
                sigma = stress(s, np.cos(front), np.cos(theta_1))
                strength = s.cohesion + sigma * s.tan_phi
                arc, chord = theta_1 - theta, np.sin(theta_1) - np.sin(theta)
                tau_x = strength * mobilised(d * (r_s * arc - r * chord) + r * s.slip_x * chord, s.shear_modulus_x)
                tau_y = strength * mobilised(r * arc * s.slip_y, s.shear_modulus_y)
                step = theta_m * REAL(w) / (2 * pieces)
                cos, sin = np.cos(theta), np.sin(theta)
                terms = (sigma * cos, sigma * sin, tau_x * cos, tau_x * sin, tau_x, tau_y, tau_y * cos, tau_y * sin)
                for accumulator, term in zip(total, terms, strict=True):
                    accumulator += term * step
    sig_c, sig_s, x_c, x_s, x_0, y_0, y_c, y_s = total
    load = r * b * sig_c
    push = normal_force(load, damping(s, coefficient, theta_1))
    force = (r_s * b * x_c - d * r * b * sig_s, -r * b * y_0, push + d * r_s * b * x_s)
    moment = (-r * r * b * y_c, -r_s * r_s * b * x_0, -d * r * r * b * y_s)
    strongest = s.cohesion + stress(s, np.cos(theta_m), np.cos(theta_1)) * s.tan_phi
    return Wrench(force, moment, load, np.maximum(push, r * b * strongest * theta_1))


def slip_ratio(rim_speed: Array, v_x: Array) -> Array:
    """Eq. 8 for a wheel that rolls forward."""
    return np.where(rim_speed > v_x, (rim_speed - v_x) / rim_speed, (rim_speed - v_x) / v_x)


def slip_angle(v_x: Array, v_y: Array) -> Array:
    """Eq. 9, rad."""
    return np.sign(v_y) * np.arccos(v_x / np.sqrt(v_x**2 + v_y**2))


def printed(
    state: WheelState,
    slip: Array,
    angle: Array,
    theta_s: Array,
    shear_radius: float = 1.0,
    mend_j: bool = False,
    mend_shear_radius: bool = False,
) -> dict[str, Array]:
    """Eqs. 10-14 exactly as printed (r_s = shear_radius * r), with flaws 3 and 5 mended where asked."""
    s = state.extended()
    slip, angle = np.asarray(slip, REAL), np.asarray(angle, REAL)
    r, r_s, b = s.radius, shear_radius * s.radius, s.width
    theta_1, theta_m = angles(s)
    a, bb = factors(theta_m)
    sigma = stress(s, np.cos(theta_m), np.cos(theta_1))
    second = (r_s if mend_j else 1) * (1 - slip) * (np.sin(theta_1) - np.sin(theta_m))
    j = r_s * (theta_1 - theta_m) - second
    strength = s.cohesion + sigma * s.tan_phi
    tau = strength * (1 - np.exp(-j / s.shear_modulus_x))
    first, other = (r_s, r) if mend_shear_radius else (r, r_s)
    f_dp = first * b * tau * a - other * b * sigma * bb
    exponent = -r * (1 - slip) * theta_m * np.tan(angle) / s.shear_modulus_y
    f_s = r_s * b * tau * theta_m * (1 - np.exp(exponent))
    return {
        "F_DP": f_dp,
        "F_S": f_s,
        "M_R": r_s * r_s * b * tau * theta_m,
        "M_O": f_s * r,
        "M_S": f_s * np.sin(theta_m) * r + f_dp * b * theta_s / (8 * np.pi),
        "j": j,
        "strength": strength,
        "exponent": exponent,
    }


def printed_applied(
    state: WheelState,
    motion: dict[str, Array],
    shear_radius: Array = 1.0,
    mend_j: bool = False,
    mend_slip: bool = False,
    mend_shear_radius: bool = False,
    mend_side: bool = False,
) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
    """Eqs. 8-14 in the wheel frame, with the regularisations that the library states for its preset `paper`.

    Slip within [-1, 1]; |beta| at most 89 deg (1.553 rad) and exponent -j/K_s at most 3; F_S opposes the lateral
    velocity, or with flaw 6 mended the lateral displacement, which then also carries its own share of the strength.
    M_S resists: its term in F_DP turns against the drawbar pull of a wheel steered to the left.

    Returns:
      Forward and left force, and the three moments.
    """
    v_x, v_y, rim = (np.asarray(motion[k], REAL) for k in ("v_x", "v_y", "rim_speed"))
    heading = np.where(state.direction < 0, -1.0, 1.0) if mend_slip else np.ones_like(v_x)
    slip = heading * state.slip_x if mend_slip else np.clip(slip_ratio(rim, v_x), -1, 1)
    angle = np.clip(np.abs(slip_angle(v_x, v_y)), 0, 1.553)
    theta_s = motion["steering_angle"]
    p = printed(state, slip, angle, theta_s, shear_radius, mend_j, mend_shear_radius)
    s = state.extended()
    radius, width, r_s = s.radius, s.width, shear_radius * s.radius
    theta_1, theta_m = angles(s)
    a, bb = factors(theta_m)
    if mend_j:
        tau = p["strength"] * mobilised(p["j"], s.shear_modulus_x)
    else:
        tau = p["strength"] * (1 - np.exp(np.minimum(-p["j"] / s.shear_modulus_x, 3)))
    sigma = stress(s, np.cos(theta_m), np.cos(theta_1))
    first, other = (r_s, radius) if mend_shear_radius else (radius, r_s)
    drawbar = first * width * tau * a - other * width * sigma * bb
    if mend_side:
        share = mobilised(radius * theta_m * s.slip_y, s.shear_modulus_y)
        side = -r_s * width * theta_m * p["strength"] * share
    else:
        side = -np.sign(v_y) * r_s * width * theta_m * np.abs(tau) * (1 - np.exp(p["exponent"]))
    lever = 0 if mend_side else drawbar * width * theta_s / (8 * np.pi)
    along = heading if mend_side else 1
    moment = (radius * side, -heading * r_s**2 * width * tau * theta_m, along * radius * np.sin(theta_m) * side - lever)
    return (heading * drawbar, side), moment


def winding_response(power: Array, time: Array, c_r: float, c_s: float, r_1: float, r_2: float) -> tuple[Array, Array]:
    """Rise of winding and housing above ambient, K, after a step of power into the winding.

    C_R dR = P - (R - S)/R_1; C_S dS = (R - S)/R_1 - S/R_2; the matrix exponential by its two eigenvalues.

    Args:
      power: (k,) W. time: (t,) s.
      c_r, c_s: heat capacities, J/K. r_1, r_2: thermal resistances, K/W.

    Returns:
      Two arrays (t, k).
    """
    matrix = np.array([[-1 / (c_r * r_1), 1 / (c_r * r_1)], [1 / (c_s * r_1), -1 / (c_s * r_1) - 1 / (c_s * r_2)]])
    values, vectors = np.linalg.eig(matrix)
    source = np.linalg.solve(vectors, np.array([1 / c_r, 0.0]))
    growth = np.expm1(np.multiply.outer(np.asarray(time, float), values)) / values * source
    response = growth @ vectors.T
    return response[:, :1] * power, response[:, 1:] * power


def torque_constant(k_0: float, beta: float, temperature: Array) -> Array:
    """Eq. 7, temperature in K."""
    return k_0 * (1 + beta * (temperature - REFERENCE_KELVIN))


def resistance(r_0: float, alpha: float, temperature: Array) -> Array:
    """Eq. 6, temperature in K."""
    return r_0 * (1 + alpha * (temperature - REFERENCE_KELVIN))


def rolling_state(
    start: Array, slip_speed: Array, rolling_speed: Array, length: Array, time: float, steps: int
) -> Array:
    """L dk/dt = v_slip - V_r k by classical Runge-Kutta in small steps."""
    k, h = np.asarray(start, float), time / steps

    def rate(k: Array) -> Array:
        return (slip_speed - rolling_speed * k) / length

    for _ in range(steps):
        a = rate(k)
        b = rate(k + 0.5 * h * a)
        c = rate(k + 0.5 * h * b)
        d = rate(k + h * c)
        k = k + h / 6 * (a + 2 * b + 2 * c + d)
    return k
