"""Steady-state tables as a problem: derivatives, noise, splits, and which candidates can enter."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.criticism import WheelBed, load_figures
from lunar_mjx.diagnosis.tables.problem import TableProblem, default_splits, default_units, points
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import UserError
from lunar_mjx.logs import SteadyLog
from lunar_mjx.logs.log import Noise

CANDIDATES = ("slip_sinkage", "bulldozing", "friction_circle", "stress_integral", "cogging", "pressure_sinkage")
STATED = {"drawbar_pull_N": 0.5, "side_force_N": 0.5, "sinkage_m": 5e-4}


def log_of(table, noise=STATED) -> SteadyLog:
    wheel = {"radius_m": table.radius, "width_m": table.width}
    stated = {k: Noise(v, "datasheet") for k, v in noise.items()}
    return SteadyLog(Path("bench"), "bench", table, wheel, stated, None, 9.80665, {})


@pytest.fixture(scope="module")
def table():
    full = load_figures()
    return full.select(np.abs(full.test["slip_angle_deg"]) < 70.0)


@pytest.fixture(scope="module")
def problem(table) -> TableProblem:
    bed = WheelBed.of_preset("consistent")
    keep = np.arange(0, len(table), 5)
    return TableProblem([log_of(table.select(keep))], bed, {n: catalogue.get(n) for n in CANDIDATES})


def test_candidates_that_cannot_enter_are_named_with_a_reason(problem):
    assert set(problem.candidates) == {"slip_sinkage", "bulldozing", "friction_circle"}
    reasons = {n.effect: n.reason for n in problem.not_tested}
    assert "would replace" in reasons["stress_integral"]
    assert reasons["cogging"] == "does not act on a wheel in steady state"
    assert "pressure_sinkage" not in reasons  # in the model already


def test_the_origin_is_the_model_as_given(problem):
    o = problem.observations
    test, measured = problem.logs[0].table.wheel_test(), problem.logs[0].table.measured
    result = problem.bed.run(test)
    expected = np.concatenate([np.asarray(getattr(result, q)) for q in measured])
    np.testing.assert_allclose(problem.predict(problem.origin())[0], expected, rtol=1e-6, atol=1e-6)
    assert len(o) == len(expected)


def test_derivatives_agree_with_finite_differences(problem):
    u = problem.origin()
    u[problem.candidates["slip_sinkage"]] = 0.3
    which = problem.free(["slip_sinkage"])
    exact = problem.jacobian(u, which)
    for k, i in enumerate(which):
        step = np.zeros_like(u)
        step[i] = 1e-5
        up, down = problem.predict(np.array([u + step, u - step]))
        scale = np.abs(exact[:, k]).max()
        np.testing.assert_allclose(exact[:, k], (up - down) / 2e-5, atol=2e-4 * scale)


def test_replicates_shrink_the_noise_and_the_scatter_beats_what_is_stated(table):
    few = table.select(np.arange(3))
    assert np.allclose(points(log_of(few))[1]["drawbar_pull"], 0.5 / np.sqrt(few.replicates))
    twice = dataclasses.replace(
        few,
        test={k: np.tile(v, 2) for k, v in few.test.items()},
        replicates=np.ones(6, int),
        measured={q: np.concatenate([v - 1.0, v + 1.0]) for q, v in few.measured.items()},
    )
    mean, noise = points(log_of(twice))
    assert len(mean) == 3
    # deviations of +-1 about the mean of two: variance 2 with one degree of freedom a point
    # (that of the mean is 1, but for what three degrees of freedom leave open of noise that grows with its reading)
    np.testing.assert_allclose(noise["side_force"], np.sqrt(2.0) / np.sqrt(2.0), rtol=0.3)
    with pytest.raises(UserError, match="nothing tells the noise"):
        points(log_of(few, {}))


def test_slip_angles_are_left_out_together(table):
    group, names = default_units(table)
    assert names == [f"slip_angle {a} deg" for a in (0, 15, 30, 45, 60)]
    for a in np.unique(table.test["slip_angle_deg"]):
        assert len(np.unique(group[table.test["slip_angle_deg"] == a])) == 1
    straight = table.select(np.abs(table.test["slip_angle_deg"]) < 1.0)
    assert default_units(straight)[1][0].startswith(("normal_load", "slip"))


def test_every_fourth_group_is_held_out():
    assert default_splits(5, [False] * 5) == ["fit", "select", "fit", "fit", "fit"]
    assert default_splits(8, [False] * 8) == ["fit", "select", "fit", "fit", "fit", "test", "fit", "fit"]
    assert default_splits(2, [False] * 2) == ["fit", "fit"]
    assert default_splits(9, [False] * 8 + [True])[-1] == "apart"
    assert "test" in default_splits(9, [False] * 9)


def test_a_place_becomes_a_wheel_bed_with_the_effects_that_moved(problem):
    u = problem.origin()
    u[problem.candidates["bulldozing"]] = 0.5
    bed = problem.fitted_bed(u)
    names = [e.name for e in bed.effects]
    assert "bulldozing" in names
    assert "slip_sinkage" not in names
    assert bed.parameters["bulldozing"]["side"] == pytest.approx(0.5)
