"""Fits: known optima, and what is refused a certificate."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from lunar_mjx.inference import fitting
from lunar_mjx.inference.descent import Rival, chase, descend
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import fit
from lunar_mjx.inference.objective import Objective
from tests.inference.toy_problem import Decay, Linear, TwoMinima, coordinate, manoeuvres

RNG = np.random.default_rng(0)
BASE = RNG.standard_normal((120, 3))
TIME = np.linspace(0.0, 4.0, 80)


def linear(value: np.ndarray, **limits) -> Linear:
    observations = dataclasses.replace(manoeuvres(3, 40), value=value)
    return Linear(BASE, {"extra": np.cos(np.arange(120))}, observations, **limits)


def decay(noise: float = 0.01, **limits) -> Decay:
    value = 2.0 * np.exp(-0.7 * TIME) + noise * np.random.default_rng(1).standard_normal(len(TIME))
    return Decay(TIME, value, **limits)


def test_a_linear_fit_is_least_squares_with_its_prior():
    value = BASE @ [1.0, -2.0, 3.0] + RNG.standard_normal(120)
    problem = linear(value, prior=2.0)
    found = fit(problem, problem.free())
    exact = np.linalg.solve(BASE.T @ BASE + np.eye(3) / 4.0, BASE.T @ value)
    np.testing.assert_allclose(found.u[:3], exact, rtol=1e-3)
    assert found.u[3] == 0.0
    assert found.problems == ()
    np.testing.assert_allclose(found.covariance(problem), np.linalg.inv(BASE.T @ BASE + np.eye(3) / 4.0), rtol=1e-6)


def test_every_start_finds_the_optimum_of_a_decay():
    problem = decay()
    found = fit(problem, problem.free(), np.array([1.0, 0.2]), starts=4)
    assert found.problems == ()
    assert found.u == pytest.approx([2.0, 0.7], rel=0.03)
    assert found.rms(found.fitted) == pytest.approx(1.0, abs=0.25)


def test_starts_that_disagree_are_refused():
    """A quartic with a second, worse minimum, and starts in both basins."""
    problem = TwoMinima()
    found = fit(problem, problem.free(), np.array([-0.2]), starts=4, spread=1.2)
    assert found.u == pytest.approx([1.0], abs=0.01)
    assert found.chi2 == pytest.approx(0.0, abs=0.1)
    assert any("of 4 starts agree" in p for p in found.problems)


def test_a_start_that_diverges_gets_no_certificate():
    problem = linear(np.zeros(120))
    problem.matrix = problem.matrix * np.inf
    with np.errstate(invalid="ignore"):
        assert fit(problem, problem.free()).problems == ("every start diverged",)


def test_resting_on_a_bound_is_refused_unless_it_is_physics():
    refused = decay(high=1.999)
    found = fit(refused, refused.free(), np.array([0.5, 0.5]))
    assert found.at_bound == ("base.a",)
    assert found.problems == ("base.a ended at a bound",)
    allowed = decay(high=1.999, physical=True)
    assert fit(allowed, allowed.free(), np.array([0.5, 0.5])).problems == ()


def test_held_out_observations_do_not_move_a_fit():
    observations = manoeuvres(6, 20)
    value = BASE @ [1.0, -2.0, 3.0]
    value[80:] += 100.0
    problem = Linear(BASE, {}, dataclasses.replace(observations, value=value))
    found = fit(problem, problem.free())
    np.testing.assert_allclose(found.u, [1.0, -2.0, 3.0], rtol=1e-3)
    assert found.rms(~found.fitted) > 50.0


def test_a_memory_gives_back_the_fit_it_kept():
    problem = decay()
    found = fit(problem, problem.free(), np.array([1.0, 0.2]))
    written = []
    memory = Memory(save=lambda entries: written.append(dict(entries)))
    memory.keep(problem, (), found)
    again = Memory(written[-1]).recall(problem, ())
    assert again is not None
    np.testing.assert_array_equal(again.u, found.u)
    assert again.chi2 == pytest.approx(found.chi2)
    assert again.problems == found.problems
    other = decay(noise=0.05)
    assert Memory(written[-1]).recall(other, ()) is None, "where chi-square is another, so is the physics"


def test_a_memory_of_other_coordinates_is_not_used():
    problem = decay()
    memory = Memory({"": {"u": {"base.a": 1.0}}})
    assert memory.recall(problem, ()) is None


def test_a_step_that_meets_a_bound_is_the_best_within_it():
    rng = np.random.default_rng(5)
    columns = rng.standard_normal((300, 3)) @ np.array([[1.0, 0.9, 0.0], [0.0, 0.3, 0.5], [0.0, 0.0, 1.0]])
    observations = dataclasses.replace(manoeuvres(3, 100), value=columns @ [3.0, -4.0, 0.5])
    problem = Linear(columns, {}, observations, low=-2.0, high=2.0)
    goal = Objective(problem, problem.free(), np.ones(300, bool))
    residual, _ = goal.residuals(problem.origin()[None])
    downhill, hessian = goal.quadratic(problem.origin(), residual[0], columns)
    step = goal.steps(problem.origin(), downhill, hessian, np.zeros(1))[0]
    best = lsq_linear(columns, observations.value, (-2.0, 2.0), tol=1e-14).x
    np.testing.assert_allclose(step, best, atol=1e-4)
    dropped = goal.residuals(problem.origin()[None])[1][0] - goal.residuals(step[None])[1][0]
    assert goal.promise(problem.origin(), downhill, hessian) == pytest.approx(dropped, rel=1e-6)


def test_starts_that_a_fixed_jacobian_leads_astray_descend_with_their_own(monkeypatch):
    problem = decay()
    problem.cheap_jacobian = False
    astray = lambda goal, best, starts: (starts, [best.chi2 + 1e3 + i for i in range(len(starts))])  # noqa: E731
    monkeypatch.setattr(fitting, "chase", astray)
    found = fit(problem, problem.free(), np.array([1.0, 0.2]), starts=4)
    assert found.problems == ()
    agreeing = [c for c in found.starts if c < found.chi2 + 1.0]
    assert (len(found.starts), len(agreeing)) == (4, 3)  # as many as a certificate needs, and no more


class Steps(TwoMinima):
    """Rows are dear, and the worse minimum, near which it starts, is no worse than noise may be."""

    cheap_jacobian = False

    def origin(self):
        return np.array([-1.05])

    def predict(self, u):
        return super().predict(u) * [1.0, 0.5]

    def jacobian(self, u, which):
        return super().jacobian(u, which) * [[1.0], [0.5]]


def test_starts_begin_again_about_a_lower_fit_that_one_of_them_found():
    problem = Steps()
    goal = Objective(problem, problem.free(), np.ones(2, bool))
    first = descend(goal, problem.origin())
    assert first.u[0] < 0.0
    others = problem.origin() + np.array([[0.3], [7.5], [7.0]])
    lowest, chi2s = fitting._lowest(goal, first, problem.origin(), others, fitting.silent)
    assert lowest.u[0] == pytest.approx(1.0, abs=0.01)
    assert lowest.chi2 < 1.0 < first.chi2
    assert sum(c < lowest.chi2 + 1.0 for c in chi2s) >= 3


class Valley(TwoMinima):
    """Rosenbrock's curved valley, with rows that are dear."""

    cheap_jacobian = False

    def __init__(self):
        super().__init__()
        self.coordinates, self.baseline = (coordinate("base", "u"), coordinate("base", "v")), np.arange(2)

    def predict(self, u):
        u = np.atleast_2d(u)
        return np.column_stack([1.0 - u[:, 0], 10.0 * (u[:, 1] - u[:, 0] ** 2)])

    def jacobian(self, u, which):
        return np.array([[-1.0, 0.0], [-20.0 * u[0], 10.0]])[:, which]


class Free(Valley):
    """The same, where rows cost nothing; keeps what is asked for and foreseen."""

    eager = True

    def __init__(self):
        super().__init__()
        self.asked, self.foreseen = [], []

    def predict(self, u):
        self.asked.append(np.atleast_2d(u).copy())
        return super().predict(u)

    def foresee(self, rows, which=None):
        self.foreseen += list(rows)


def test_where_rows_are_free_other_starts_take_their_own_jacobian_first():
    at = np.array([1.0, 1.0])
    starts = np.array([[1.2, 1.3], [0.7, 0.6]])
    rounds = {}
    for kind in (Valley, Free):
        problem = kind()
        calls = []
        plain = problem.predict
        problem.predict = lambda u, plain=plain, calls=calls: (calls.append(len(u)), plain(u))[1]
        goal = Objective(problem, problem.free(), np.ones(2, bool))
        best = descend(goal, at)
        calls.clear()
        _, ends = chase(goal, best, starts)
        assert max(ends) < best.chi2 + 1.0
        rounds[kind] = len(calls)
    assert rounds[Free] <= rounds[Valley]


@pytest.mark.parametrize(("start", "beside"), [((1.0, 1.0), True), ((-1.2, 1.0), False)])
def test_starts_are_simulated_beside_a_first_fit_that_has_nothing_to_gain(start, beside):
    problem = Free()
    fit(problem, problem.free(), np.array(start), starts=4, spread=0.5)
    others = [row for rows in problem.asked if len(rows) == 3 for row in rows][:3]
    assert len(problem.foreseen) >= 3
    assert all(any(np.array_equal(o, f) for f in problem.foreseen) for o in others) is beside


def test_a_fit_at_the_noise_goes_on_while_its_gradient_promises_more():
    problem = Valley()
    found = fit(problem, problem.free(), np.array([-1.2, 1.0]), starts=1)
    assert found.gradient < 0.5
    assert found.problems == ()


def test_a_descent_that_falls_far_short_is_left_once_a_rival_has_arrived():
    """An optimum at chi-square 9, reached slowly; a rival arrives at 1 while the descent is under way."""

    class Late(Valley):
        calls = 0

        def predict(self, u):
            Late.calls += 1
            if Late.calls == arrives:
                rival.lower(1.0)
            return np.column_stack([super().predict(u), np.full(len(np.atleast_2d(u)), 3.0)])

        def jacobian(self, u, which):
            return np.vstack([super().jacobian(u, np.arange(2)), np.zeros(2)])[:, which]

    def steps(when: int) -> tuple[int, float]:
        nonlocal rival, arrives
        rival, arrives, Late.calls = Rival(), when, 0
        problem = Late()
        seen = dataclasses.replace(
            problem.observations,
            value=np.zeros(3),
            unit=np.zeros(3, int),
            series=(dataclasses.replace(problem.observations.series[0], stop=3, time=np.arange(3.0)),),
        )
        problem.observations = seen
        goal = Objective(problem, problem.free(), seen.in_split("fit"))
        found = descend(goal, np.array([-1.2, 1.0]), rival=rival)
        return Late.calls, found.chi2

    rival, arrives = Rival(), 0
    alone, chi2 = steps(10**6)
    assert chi2 < 9.3
    beaten, left_at = steps(8)
    assert 8 <= beaten < 12 < alone and left_at > chi2 + 1.0


class Edge(Linear):
    """Its minimum lies at the edge of a jump, where the first derivative is steep over a short step alone."""

    cheap_jacobian = False

    def jacobian(self, u, which):
        return self.matrix[:, which] * np.array([20.0, 1.0, 1.0])[which]

    def wide_jacobian(self, u, which, std):
        return self.matrix[:, which]


def test_intervals_are_those_of_wide_steps():
    truth = np.array([0.3, -0.2, 0.1])
    observations = dataclasses.replace(manoeuvres(3, 40), value=BASE @ truth)
    stds = {}
    for kind in (Linear, Edge):
        problem = kind(BASE, {}, observations)
        found = fit(problem, problem.free(), truth, starts=1)
        stds[kind] = np.sqrt(np.diag(found.covariance(problem)))
    np.testing.assert_allclose(stds[Edge], stds[Linear], rtol=1e-9)
    problem = Edge(BASE, {}, observations)
    rough = fit(problem, problem.free(), truth, starts=1, certify=False)
    assert np.sqrt(np.diag(rough.covariance(problem)))[0] < 0.1 * stds[Linear][0]


class Jumpy(Edge):
    """One with a jump that shows in derivatives over steps that are not far wider than it, and one over wide steps."""

    def wide_jacobian(self, u, which, std):
        return self.matrix[:, which] * (1.0 + np.array([0.02, 0.0, 0.0])[which] / np.maximum(std, 0.01)) * [1, 1, 5]


class Failing(Edge):
    """One that a wide step of its second parameter takes to where nothing is finite."""

    def wide_jacobian(self, u, which, std):
        return np.where(which == 1, np.nan, self.matrix[:, which])


def test_a_wide_step_that_fails_leaves_the_short_one():
    truth = np.array([0.3, -0.2, 0.1])
    observations = dataclasses.replace(manoeuvres(3, 40), value=BASE @ truth)
    failing, edge = Failing(BASE, {}, observations), Edge(BASE, {}, observations)
    found, expected = (fit(p, p.free(), truth, starts=1) for p in (failing, edge))
    np.testing.assert_allclose(found.covariance(failing), expected.covariance(edge), rtol=1e-9)


def test_steps_for_intervals_widen_while_a_jump_shows_in_them():
    truth = np.array([0.3, -0.2, 0.1])
    observations = dataclasses.replace(manoeuvres(3, 40), value=BASE @ truth)
    problem, smooth = Jumpy(BASE, {}, observations), Edge(BASE, {}, observations)
    found, expected = (fit(p, p.free(), truth, starts=1) for p in (problem, smooth))
    std, real = (np.sqrt(np.diag(f.covariance(smooth))) for f in (found, expected))
    at_first = real[0] / 20.0
    assert at_first < 0.01, "the first step is the least"
    assert std[0] > 0.6 * real[0] > 1.5 * real[0] / (1.0 + 0.02 / 0.01), "by that step alone it would be a third"
    np.testing.assert_allclose(std[1:], real[1:], rtol=1e-6)
