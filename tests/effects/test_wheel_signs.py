"""Directions of the wheel's forces: driving and braking, left and right, forward and backward, airborne, rock."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import numpy as np
import pytest

from tests.effects.effects_harness import random_wheels, wheel_forces
from tests.effects.effects_reference import WheelState

Array = Any
COUNT = 5000
CLOSED = ("pressure_sinkage", "closed_form_shear")
INTEGRAL = ("stress_integral",)
PRINTED = ("penalty_contact", "printed_shear")
MENDED = {"printed_shear": dict.fromkeys(("mend_j", "mend_slip", "mend_shear_radius", "mend_side"), 1.0)}
SOIL_LAWS = pytest.mark.parametrize(
    "names, values", [(CLOSED, {}), (INTEGRAL, {}), (PRINTED, MENDED)], ids=["closed", "integral", "printed, mended"]
)


def wheels(**changes: Any) -> tuple[WheelState, dict[str, Array]]:
    """Random wheels that do not sink or rise, with some fields set for all of them; the rim drives where slip > 0."""
    state, motion = random_wheels(COUNT, seed=3)
    changed = {"sinkage_rate": 0.0, **changes}
    state = dataclasses.replace(state, **{k: np.broadcast_to(v, (COUNT,)) * 1.0 for k, v in changed.items()})
    return state, motion


def forces(names: Any, values: Any, state: WheelState, motion: Any, rock: float = 0.0) -> tuple[Array, Array, Any]:
    """Force (3, wheels), moment (3, wheels) in float64, and the normal stress's share."""
    wheel, normal = wheel_forces(names, state, motion, values, np.float64, rock)
    return np.array(wheel.force), np.array(wheel.moment), normal


@SOIL_LAWS
@pytest.mark.parametrize("slip", [0.5, -0.5])
def test_driving_pushes_forward_and_braking_backward(names: Any, values: Any, slip: float) -> None:
    """Force forward at slip 0.5, backward at -0.5, and M_R against the driving torque.

    At sinkages to 0.02 r, where neither compaction resistance nor the displacement of free rolling outweighs the slip.
    """
    shallow = np.minimum(wheels()[0].sinkage, 0.02 * wheels()[0].radius)
    state, motion = wheels(slip_x=slip, direction=1.0, slip_y=0.0, sinkage=shallow)
    force, moment, _ = forces(names, values, state, motion)
    touching = shallow > 0
    assert (moment[1][touching] * slip < 0).all()
    assert np.mean(force[0][touching] * slip > 0) > (0.98 if slip > 0 else 0.999)


@SOIL_LAWS
def test_lateral_force_opposes_lateral_motion(names: Any, values: Any) -> None:
    """F_S and M_O oppose the lateral displacement, and are exactly odd in it."""
    state, motion = wheels()
    mirrored = dataclasses.replace(state, slip_y=-state.slip_y)
    turned = {**motion, "v_y": -motion["v_y"], "steering_angle": -motion["steering_angle"]}
    moving = (state.sinkage > 0) & (np.abs(state.slip_y) > 1e-6)
    force, moment, _ = forces(names, values, state, motion)
    other_force, other_moment, _ = forces(names, values, mirrored, turned)
    assert (force[1][moving] * state.slip_y[moving] < 0).all()
    assert (moment[0][moving] * state.slip_y[moving] < 0).all()
    odd = np.array([1.0, -1.0, 1.0])
    assert np.array_equal(force * odd[:, None], other_force)
    assert np.array_equal(moment * -odd[:, None], other_moment)


@SOIL_LAWS
def test_backing_up_mirrors_driving_forward(names: Any, values: Any) -> None:
    """Forward force and M_y are odd, vertical force and M_x even, M_z odd: front and rear of the wheel are alike."""
    ahead = np.where(random_wheels(COUNT, seed=3)[1]["v_x"] < 0, -1.0, 1.0)
    state, motion = wheels(direction=ahead)
    back = dataclasses.replace(state, slip_x=-state.slip_x, direction=-state.direction)
    reverse = {**motion, "v_x": -motion["v_x"], "rim_speed": -motion["rim_speed"]}
    force, moment, _ = forces(names, values, state, motion)
    other_force, other_moment, _ = forces(names, values, back, reverse)
    scale = np.max(np.abs(force), axis=0) + 1e-300
    assert np.max(np.abs(other_force - force * np.array([[-1.0], [1.0], [1.0]])) / scale) < 1e-13
    assert np.max(np.abs(other_moment - moment * np.array([[1.0], [-1.0], [-1.0]])) / scale) < 1e-13
    assert np.abs(force[0]).max() > 1.0 and np.abs(moment[2]).max() > 1e-3


def test_printed_slip_has_the_wrong_sign_when_backing_up() -> None:
    """Flaw 4: as printed, a wheel that drives backward at 50 % slip is told that its slip is negative."""
    state, motion = wheels(slip_x=-0.5, direction=-1.0, slip_y=0.0)
    back = {**motion, "v_x": np.full(COUNT, -0.1), "rim_speed": np.full(COUNT, -0.2), "v_y": np.zeros(COUNT)}
    printed = {"printed_shear": {"mend_j": 1.0}}
    mended = {"printed_shear": {"mend_j": 1.0, "mend_slip": 1.0}}
    deep = (state.sinkage > 1e-3) & (state.sinkage < 0.05)
    right = forces(PRINTED, mended, state, back)[1][1][deep]
    wrong = forces(PRINTED, printed, state, back)[1][1][deep]
    assert (right > 0).all()
    assert np.mean(np.abs(wrong - right) > 0.5 * np.abs(right)) > 0.9


@pytest.mark.parametrize("names", [(*PRINTED, "engine_friction"), (*CLOSED, "hard_ground"), (*INTEGRAL, "hard_ground")])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_an_airborne_wheel_feels_exactly_nothing(names: Any, dtype: Any) -> None:
    """Over soil and rock alike, while it falls."""
    state, motion = wheels(sinkage=0.0, sinkage_rate=0.3)
    wheel, _ = wheel_forces(names, state, motion, {}, dtype, np.arange(COUNT) % 2)
    for component in (*wheel.force, *wheel.moment):
        assert (component == 0.0).all()


@pytest.mark.parametrize("names", [CLOSED, INTEGRAL, PRINTED])
def test_the_ground_never_pulls(names: Any) -> None:
    """A wheel that leaves the ground at 10 m/s feels no normal force, and none below zero."""
    state, motion = wheels(sinkage_rate=-10.0)
    _, _, normal = forces(names, {}, state, motion)
    assert (normal.load + normal.damping >= 0.0).all()
    assert np.mean((normal.load + normal.damping)[state.sinkage > 0] == 0.0) > 0.5


@pytest.mark.parametrize("base", [CLOSED, INTEGRAL, ("penalty_contact", "closed_form_shear")])
def test_friction_on_rock(base: Any) -> None:
    """f = mu F_N (1 - exp(-|k|/k_0)) against the slip, at the rim: never above mu F_N, near it at full slip."""
    state, motion = wheels()
    values = {"hard_ground": {"mu": 0.7, "stiffness": 1e5}}
    force, moment, normal = forces((*base, "hard_ground"), values, state, motion, rock=1.0)
    load = 1e5 * state.sinkage
    slip = np.sqrt(state.slip_x**2 + state.slip_y**2 + 1e-12)  # smooth below a slip of 1e-6
    expected = 0.7 * load * -np.expm1(-slip / 0.01) / slip
    assert force[2] == pytest.approx(load, rel=1e-12)
    assert force[0] == pytest.approx(expected * state.slip_x, rel=1e-9, abs=1e-9)
    assert force[1] == pytest.approx(-expected * state.slip_y, rel=1e-9, abs=1e-9)
    assert (np.hypot(force[0], force[1]) <= 0.7 * load * (1 + 1e-12)).all()
    assert moment[0] == pytest.approx(state.radius * force[1], rel=1e-12)
    assert moment[1] == pytest.approx(-state.radius * force[0], rel=1e-12)
    assert (normal.resistance == 0.0).all() and (normal.sigma_m == 0.0).all()


@pytest.mark.optimised  # it counts rounding, which fewer optimisations place elsewhere (29 ulp)
def test_soil_is_untouched_by_the_law_for_rock() -> None:
    """`hard_ground` leaves a wheel on soil alone, to 4 ulp of its largest component."""
    jax.clear_caches()  # other tests of this file have compiled the same programs with fewer optimisations
    state, motion = wheels()
    for names in (CLOSED, INTEGRAL):
        with_rock, without = (forces(n, {}, state, motion)[:2] for n in ((*names, "hard_ground"), names))
        for mine, other in zip(with_rock, without, strict=True):
            assert (np.abs(mine - other) <= 4 * np.spacing(np.abs(other).max(axis=0))).all()


def test_engine_friction_opposes_sliding() -> None:
    """mu F_N tanh(|v|/v_e) against the sliding of the rim, at the rim."""
    state, motion = wheels()
    values = {"engine_friction": {"mu": 0.8, "speed_scale": 0.05}, "penalty_contact": {"stiffness": 5e4}}
    force, moment, _ = forces(("penalty_contact", "engine_friction"), values, state, motion)
    slide_x, slide_y = motion["v_x"] - motion["rim_speed"], motion["v_y"]
    speed = np.hypot(slide_x, slide_y)
    limit = 0.8 * 5e4 * state.sinkage * np.tanh(speed / 0.05)
    assert force[0] == pytest.approx(-limit * slide_x / speed, rel=1e-6)
    assert force[1] == pytest.approx(-limit * slide_y / speed, rel=1e-6)
    assert moment[1] == pytest.approx(-state.radius * force[0], rel=1e-12)
    assert (force[0] * slide_x + force[1] * slide_y <= 0).all()


def test_small_sinkage_keeps_its_digits_in_float32() -> None:
    """Half-angle forms: at 1e-7 m the printed cosines would lose all digits of float32, the library keeps six.

    Load and compaction resistance are compared with their own size, not with the wheel's load.
    """
    sinkage = np.float32(np.geomspace(1e-7, 1e-3, COUNT)).astype(float)
    state, motion = wheels(sinkage=sinkage, slip_x=0.0, slip_y=0.0, radius=np.float32(0.25), n=1.0)
    for names in (CLOSED, INTEGRAL):
        _, coarse = wheel_forces(names, state, motion, {}, np.float32)
        _, fine = wheel_forces(names, state, motion, {}, np.float64)
        for mine, exact in ((coarse.load, fine.load), (coarse.resistance, fine.resistance)):
            assert (exact > 0).all()
            assert np.max(np.abs(mine / exact - 1.0)) < 5e-6
    radius, sinkage = np.float32(0.25), np.float32(sinkage[sinkage < 1e-6])
    theta_1 = np.arccos((radius - sinkage) / radius)
    naive = radius * (np.cos(np.float32(0.5) * theta_1) - np.cos(theta_1))
    assert np.max(np.abs(naive / (0.75 * sinkage) - 1.0)) > 0.05
