"""Small residuals of drives: smooth unknown inputs are seen where no candidate does, and noise is left alone."""

import dataclasses
import types

import numpy as np
import pytest
from scipy import stats

from lunar_mjx.diagnosis.attribute import diagnose
from lunar_mjx.diagnosis.refit import Settings
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS, PROBES, SMOOTH, amplitude, smooth_inputs
from lunar_mjx.diagnosis.unknown_inputs.localise import localise
from lunar_mjx.diagnosis.unknown_inputs.patterns import find_pattern
from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.effects.base import PORTS
from lunar_mjx.inference.fitting import Fit, fit
from tests.inference.toy_problem import Linear, manoeuvres

LOGS, SAMPLES = 6, 200
TORQUE, CURRENT = "motor_torque", "command: motor current"
SETTINGS = Settings(draws=1000)


class Driven(Linear):
    """Two baseline parameters, one candidate, and inputs at two ports which follow smooth courses of every log."""

    cheap_jacobian = False

    def __init__(self, rng: np.random.Generator, labels=(TORQUE, CURRENT), **noise):
        count = LOGS * SAMPLES
        self.time = np.tile(np.arange(SAMPLES) * 0.1, LOGS)
        super().__init__(_smooth(rng, 2), {"listed": _smooth(rng, 1)[:, 0]}, manoeuvres(LOGS, SAMPLES, **noise))
        self.effects = {"listed": types.SimpleNamespace(ports={"soil": None})}
        self.inputs, at = {}, self.matrix.shape[1]
        for label in labels:
            self.inputs[label] = np.arange(at, at + len(FOLLOWS[label]))
            at += len(FOLLOWS[label])
        extra = _smooth(rng, at - self.matrix.shape[1])
        self.matrix = np.column_stack([self.matrix, extra])
        amount = self.coordinates[-1]
        self.coordinates += tuple(
            dataclasses.replace(amount, effect=SMOOTH, name=amplitude(label, q))
            for label in labels
            for q in FOLLOWS[label]
        )
        assert len(self.matrix) == count
        assert len(self.coordinates) == self.matrix.shape[1]


def _smooth(rng: np.random.Generator, number: int) -> np.ndarray:
    """(n, number) slow courses of all logs, of unit mean square."""
    time = np.arange(SAMPLES) * 0.1
    waves = [
        np.concatenate([np.sin(rng.uniform(0.2, 1.5) * time + rng.uniform(0.0, 6.0)) for _ in range(LOGS)])
        for _ in range(number)
    ]
    return np.sqrt(2.0) * np.column_stack(waves)


def _noise(rng: np.random.Generator, correlation_time: float = 0.0) -> np.ndarray:
    """White noise, or Ornstein-Uhlenbeck noise, of unit variance."""
    white = rng.normal(size=(LOGS, SAMPLES))
    if correlation_time > 0.0:
        keep = np.exp(-0.1 / correlation_time)
        for k in range(1, SAMPLES):
            white[:, k] = keep * white[:, k - 1] + np.sqrt(1.0 - keep**2) * white[:, k]
    return white.reshape(-1)


def _fitted(problem: Driven, rng: np.random.Generator, correlation_time: float = 0.0, **amounts: float) -> Fit:
    truth = sum((a * problem.matrix[:, problem.inputs[label][0]] for label, a in amounts.items()), np.zeros(1))
    problem.observations.value[:] = truth + _noise(rng, correlation_time)
    return fit(problem, problem.free(), starts=1, certify=False)


def _columns(problem: Driven) -> dict[str, np.ndarray]:
    return {k: problem.observations.whiten(problem.matrix[:, places]) for k, places in problem.inputs.items()}


@pytest.mark.parametrize(
    ("correlation_time", "noise"), [(0.0, {}), (0.5, {"white": 0.0, "coloured": 1.0, "correlation_time": 0.5})]
)
def test_noise_passes_for_a_pattern_as_rarely_as_stated(correlation_time, noise) -> None:
    rng = np.random.default_rng(5)
    problem, alpha, trials = Driven(rng, **noise), 0.05, 100
    columns, hits = _columns(problem), 0
    for _ in range(trials):
        hits += find_pattern(problem, _fitted(problem, rng, correlation_time), columns, 200).p <= alpha
    assert hits <= stats.binom.ppf(0.999, trials, alpha)


def test_noise_of_a_colour_that_nobody_stated_passes_no_more_often_than_ten_times_that() -> None:
    rng = np.random.default_rng(6)
    problem, trials = Driven(rng), 100
    columns = _columns(problem)
    hits = sum(find_pattern(problem, _fitted(problem, rng, 0.15), columns, 200).p <= 0.01 for _ in range(trials))
    assert hits <= 10


def test_an_input_below_the_noise_is_found_at_its_port() -> None:
    rng = np.random.default_rng(7)
    problem = Driven(rng)
    at = _fitted(problem, rng, **{CURRENT: 0.25})
    assert at.rms(at.fitted) < 1.05
    found = find_pattern(problem, at, _columns(problem))
    assert found.p <= SETTINGS.pattern_p
    assert found.port == "command"
    label, quantity, chi2 = found.elsewhere(frozenset({"motor_torque"}))
    assert (label, quantity) == (CURRENT, FOLLOWS[CURRENT][0])
    assert 0.4 * found.chi2 < chi2 < found.chi2  # that of the fitted logs, four of six
    assert found.elsewhere(frozenset(PORTS)) == ("", "", 0.0)


def test_what_a_refit_takes_in_is_no_pattern() -> None:
    rng = np.random.default_rng(8)
    problem = Driven(rng)
    problem.matrix[:, problem.inputs[CURRENT]] = problem.matrix[:, [0]]
    found = find_pattern(problem, _fitted(problem, rng, **{CURRENT: 3.0}), _columns(problem))
    assert CURRENT not in found.z
    assert found.p > 0.01


@pytest.mark.parametrize(("hidden", "verdict"), [({}, Verdict.NOISE_ONLY), ({CURRENT: 0.25}, Verdict.UNKNOWN)])
def test_the_verdict_on_a_baseline_at_the_noise(hidden, verdict) -> None:
    rng = np.random.default_rng(9)
    problem = Driven(rng)
    _fitted(problem, rng, **hidden)
    diagnosis, found = diagnose(problem, SETTINGS)
    assert found.base.noise.passes
    assert diagnosis.verdict is verdict, diagnosis.sentence
    assert not diagnosis.effects
    place = localise(problem, found.base, found.chosen)
    assert place.port == ("command" if hidden else None)


def test_a_name_is_not_confirmed_where_a_pattern_is_left() -> None:
    rng = np.random.default_rng(10)
    problem = Driven(rng)
    _fitted(problem, rng, **{CURRENT: 0.25})
    problem.observations.value[:] += 0.3 * problem.matrix[:, problem.candidates["listed"][0]]
    diagnosis, found = diagnose(problem, SETTINGS)
    assert found.chosen.effects == ("listed",)
    assert found.chosen.noise.passes
    assert diagnosis.verdict is Verdict.UNKNOWN, diagnosis.sentence
    assert localise(problem, found.base, found.chosen).port == "command"


@pytest.mark.parametrize(
    ("listed", "hidden", "verdict"), [(0.0, 0.35, Verdict.KNOWN_CLASS), (0.35, 0.0, Verdict.KNOWN)]
)
def test_an_effect_counts_as_known_only_if_no_unlisted_input_explains_more(listed, hidden, verdict) -> None:
    rng = np.random.default_rng(11)
    problem = Driven(rng)
    place, twin = problem.candidates["listed"][0], problem.inputs[CURRENT][1]
    problem.matrix[:, place] = 0.97 * problem.matrix[:, twin] + 0.24 * problem.matrix[:, place]
    noise = _noise(rng)
    problem.observations.value[:] = noise + listed * problem.matrix[:, place] + hidden * problem.matrix[:, twin]
    diagnosis, found = diagnose(problem, SETTINGS)
    assert diagnosis.verdict is verdict, diagnosis.sentence
    assert diagnosis.effects == ("listed",)
    assert found.unlisted is not None
    assert (found.unlisted.label, found.unlisted.quantity) == (CURRENT, "current")
    assert "unlisted at the port command (motor current in proportion to current)" in diagnosis.sentence


def test_every_input_has_a_size_and_follows_something() -> None:
    assert set(FOLLOWS) == set(PROBES)
    effect = smooth_inputs(frozenset(PORTS))
    assert set(effect.parameters) == {amplitude(label, q) for label in FOLLOWS for q in FOLLOWS[label]}
    assert set(smooth_inputs(frozenset({"soil"})).ports) == {"soil", "geometry", "body_wrench"}
