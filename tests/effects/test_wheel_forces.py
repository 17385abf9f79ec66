"""Closed-form forces and the stress integral against independent NumPy versions on 1e5 random states."""

from __future__ import annotations

import dataclasses
from typing import Any

import effects_reference as ref
import numpy as np
import pytest
from scipy.optimize import brentq

from lunar_mjx.effects.context import WheelForce
from lunar_mjx.effects.wheel.stress_integral import NODES_PER_SIDE
from tests.effects.effects_harness import STATES, random_wheels, wheel_forces

FLOAT64, FLOAT32 = 1e-9, 1e-4
Array = Any


def worst(wheel: WheelForce, expected: ref.Wrench, radius: Array, name: str) -> float:
    """Largest error of any component, in units of the largest term (moments: times the radius); printed with -s."""
    error = 0.0
    scale = np.where(expected.scale > 0, expected.scale, 1)
    for mine, other, arm in (
        (wheel.force, expected.force, np.ones_like(radius)),
        (wheel.moment, expected.moment, radius),
    ):
        for got, want in zip(mine, other, strict=True):
            assert np.isfinite(got).all()
            error = max(error, float(np.max(np.abs(got - want) / (scale * arm))))
    print(f"{name}: {error:.2e}")
    return error


@pytest.fixture(scope="module")
def wheels() -> tuple[ref.WheelState, dict[str, Array], Array]:
    state, motion = random_wheels()
    shear_radius = np.float32(np.random.default_rng(1).uniform(0.8, 1.3, STATES)).astype(float)
    return state, motion, shear_radius


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, FLOAT64), (np.float32, FLOAT32)])
def test_closed_form_matches_the_printed_equations(wheels: Any, dtype: Any, tolerance: float) -> None:
    """`pressure_sinkage` and `closed_form_shear` against eqs. 10-14 in Ding's form, in extended precision."""
    state, motion, shear_radius = wheels
    values = {"closed_form_shear": {"shear_radius": shear_radius}, "pressure_sinkage": {"damping": 9e4}}
    wheel, normal = wheel_forces(("pressure_sinkage", "closed_form_shear"), state, motion, values, dtype)
    expected = ref.closed_form(state, shear_radius, 9e4)
    assert worst(wheel, expected, state.radius, f"closed form {dtype.__name__}") < tolerance
    assert np.max(np.abs(normal.load - expected.load) / np.maximum(expected.load, 1e-3)) < 10 * tolerance
    assert np.mean(expected.load > 1.0) > 0.5 and np.mean(state.sinkage == 0.0) > 0.03


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, FLOAT64), (np.float32, FLOAT32)])
def test_stress_integral_matches_an_independent_quadrature(wheels: Any, dtype: Any, tolerance: float) -> None:
    """`stress_integral` against the same number of nodes placed by an independent version."""
    state, motion, shear_radius = wheels
    values = {"stress_integral": {"shear_radius": shear_radius, "damping": 9e4}}
    wheel, _ = wheel_forces(("stress_integral",), state, motion, values, dtype)
    expected = ref.stress_integral(state, NODES_PER_SIDE, shear_radius=shear_radius, coefficient=9e4)
    assert worst(wheel, expected, state.radius, f"stress integral {dtype.__name__}") < tolerance


def subset(state: ref.WheelState, count: int) -> ref.WheelState:
    return ref.WheelState(*(getattr(state, f.name)[:count] for f in dataclasses.fields(state)))


def test_quadrature_error_of_the_shipped_nodes(wheels: Any) -> None:
    """6 + 6 nodes against the converged integral (3 pieces of 40 nodes a side), in units of the wheel's largest term.

    The error is largest across the wheel at slip angles near 90 deg, where the shear stress jumps at the entrance, and
    along it where the displacement changes sign within the arc (braking).
    """
    count = 4000
    state = subset(wheels[0], count)
    converged = ref.stress_integral(state, 40, pieces=3)
    scale = np.where(converged.scale > 0, converged.scale, 1)

    def errors(other: ref.Wrench) -> list[Array]:
        return [np.abs(a - b) / scale for a, b in zip(converged.force, other.force, strict=True)]

    assert max(e.max() for e in errors(ref.stress_integral(state, 40, pieces=2))) < 1e-5
    shipped = errors(ref.stress_integral(state, NODES_PER_SIDE))
    for name, error, largest in zip(("along", "across", "normal"), shipped, (2e-3, 5e-3, 1e-3), strict=True):
        print(f"quadrature error {name}: worst {error.max():.1e}, median {np.median(error):.1e}")
        assert error.max() < largest
        assert np.median(error) < 1e-4
    coarse = errors(ref.stress_integral(state, 2))
    assert all(c.max() > 5 * e.max() for c, e in zip(coarse, shipped, strict=True))


@pytest.mark.parametrize(
    "names, drawbar", [(("pressure_sinkage", "closed_form_shear"), 0.270), (("stress_integral",), 0.254)]
)
def test_drawbar_pull_of_viper_in_lunar_soil(names: tuple[str, ...], drawbar: float) -> None:
    """Lunar nominal soil, 430 kg on four wheels, r 0.25 m, b 0.2 m: drawbar/weight at 40 % slip (physics notes, 3)."""
    count, load = 20_000, 430 * 1.625 / 4
    one = np.ones(count)
    sinkage = np.linspace(1e-4, 0.1, count)
    state = ref.WheelState(
        0.25 * one,
        0.2 * one,
        sinkage,
        0 * one,
        0.4 * one,
        0 * one,
        one,
        1.4e3 * one,
        8.2e5 * one,
        one,
        170 * one,
        np.tan(np.radians(35)) * one,
        0.0178 * one,
        0.0178 * one,
    )
    motion = {"v_x": 0.06 * one, "v_y": 0 * one, "rim_speed": 0.1 * one, "steering_angle": 0 * one}
    wheel, _ = wheel_forces(names, state, motion, {}, np.float64)
    depth = np.interp(load, wheel.force.z, sinkage)
    ratio = np.interp(depth, sinkage, wheel.force.x) / load
    print(f"{names}: sinkage {1e3 * depth:.2f} mm, drawbar/weight {ratio:.4f}")
    assert 0.008 < depth < 0.03
    assert ratio == pytest.approx(drawbar, abs=5e-4)

    def excess(z: float) -> float:
        reference = ref.closed_form if len(names) == 2 else lambda s: ref.stress_integral(s, 32, 2)
        return float(reference(dataclasses.replace(subset(state, 1), sinkage=np.array([z]))).force[2][0]) - load

    assert brentq(excess, 1e-4, 0.1) == pytest.approx(depth, rel=2e-3)


MENDS = ("mend_j", "mend_slip", "mend_shear_radius", "mend_side")


@pytest.mark.parametrize("dtype, tolerance", [(np.float64, FLOAT64), (np.float32, FLOAT32)])
@pytest.mark.parametrize("mended", [(), ("mend_j",), ("mend_slip",), ("mend_shear_radius",), ("mend_side",), MENDS])
def test_printed_equations(wheels: Any, mended: tuple[str, ...], dtype: Any, tolerance: float) -> None:
    """`penalty_contact` and `printed_shear` against eqs. 8-14 as printed, each flaw in turn mended, and all of them."""
    state, motion, shear_radius = wheels
    values = {
        "printed_shear": {"shear_radius": shear_radius, **dict.fromkeys(mended, 1.0)},
        "penalty_contact": {"stiffness": 5e4, "damping": 300.0},
    }
    wheel, _ = wheel_forces(("penalty_contact", "printed_shear"), state, motion, values, dtype)
    force, moment = ref.printed_applied(state, motion, shear_radius, **dict.fromkeys(mended, True))
    penalty = np.where(state.sinkage > 0, np.maximum(5e4 * state.sinkage + 300.0 * state.sinkage_rate, 0), 0)
    theta_1, theta_m = ref.angles(state.extended())
    sigma = ref.stress(state.extended(), np.cos(theta_m), np.cos(theta_1))
    # as printed, the exponent may reach 3: tau up to exp(3) - 1 = 19 times the strength
    strongest = 20 * (state.cohesion + sigma * state.tan_phi)
    scale = np.maximum(penalty, state.radius * state.width * strongest * theta_1)
    expected = ref.Wrench((*force, penalty), moment, penalty, scale)
    assert worst(wheel, expected, state.radius, f"printed {mended} {dtype.__name__}") < tolerance


def test_paper_soil_forces_are_decorative() -> None:
    """Flaw 2: with the paper's soil and contact, eqs. 10-14 with j mended give about 0.02 N under a 19 N wheel load."""
    one = np.ones(1)
    state = ref.WheelState(
        0.1 * one,
        0.08 * one,
        19 / 5e4 * one,
        0 * one,
        0.4 * one,
        0 * one,
        one,
        1e5 * one,
        1e3 * one,
        1.1 * one,
        462.3 * one,
        np.tan(0.3889) * one,
        0.015 * one,
        0.015 * one,
    )
    motion = {"v_x": 0.06 * one, "v_y": 0 * one, "rim_speed": 0.1 * one, "steering_angle": 0 * one}
    values = {"printed_shear": {"mend_j": 1.0}}
    wheel, normal = wheel_forces(("penalty_contact", "printed_shear"), state, motion, values, np.float64)
    assert normal.load == pytest.approx(19.0)
    print(f"paper: drawbar {wheel.force.x} N")
    assert 0.0 < wheel.force.x[0] < 0.1
