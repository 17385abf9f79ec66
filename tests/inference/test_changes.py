"""Sequential detection of jumps: the promised rate of false alarms, the delay, outlying steps, and what is learnt."""

import numpy as np
import pytest

from lunar_mjx.inference.changes import Amounts, ChangeDetector, Undisturbed, learn, log_density

START, WALK, SCATTER, SIZE = (np.array(v) for v in ([1.0, 1.0], [0.02, 0.02], [0.1, 0.1], [3.0, 3.0]))
JUMPS = {"first": SIZE * [1, 0], "second": SIZE * [0, 1]}


def usual(rare=0.02):
    return Undisturbed(START, WALK, SCATTER, SIZE, rare, 1.0)


def series(count, rng, jump=None, at=0, rare=0.0, noise=1.0):
    """A series of `count` steps of five measurements by the law of `usual`, with a jump at a step."""
    x, out = rng.normal(0.0, START), []
    for t in range(count):
        columns = rng.normal(size=(5, 2))
        shift = np.zeros(2) if jump is None or t < at else np.asarray(jump)
        strange = rng.random() < rare
        s = rng.normal(0.0, SIZE if strange else SCATTER)
        out.append((columns, columns @ (x + shift + s) + (3.0 if strange else noise) * rng.normal(size=5)))
        x = x + rng.normal(0.0, WALK)
    return out


def alarms(detector, steps):
    return [found for columns, residual in steps if (found := detector.see(columns, residual)) is not None]


def test_false_alarms_are_no_more_frequent_than_promised():
    """Pollak's bound: at least so many steps from one false alarm to the next in the mean, outlying steps and all."""
    promised, count = 100.0, 1500
    raised = alarms(ChangeDetector(usual(), JUMPS, promised), series(count, np.random.default_rng(0), rare=0.02))
    assert len(raised) <= count / promised + 2.0 * np.sqrt(count / promised)


@pytest.mark.parametrize(("kind", "jump"), [("first", (3.0, 0.0)), ("second", (0.0, -3.0))])
def test_a_jump_is_found_soon_and_named(kind, jump):
    steps = series(140, np.random.default_rng(1), jump, at=100)
    found = alarms(ChangeDetector(usual(), JUMPS, 18000.0), steps)
    assert len(found) == 1
    change = found[0]
    assert 100 <= change.seen <= 106
    assert change.first <= 100 <= change.last
    assert next(iter(change.kinds)) == kind
    assert change.kinds[kind] > 0.95
    np.testing.assert_allclose(change.amount, jump, atol=1.5)


def test_one_outlying_step_is_no_change():
    steps = series(60, np.random.default_rng(2))
    columns, residual = steps[30]
    steps[30] = columns, residual + columns @ np.array([4.0, -4.0])
    assert not alarms(ChangeDetector(usual(), JUMPS, 18000.0), steps)


def test_after_an_alarm_the_new_amounts_are_usual():
    """A jump is told once, and the next one again."""
    rng = np.random.default_rng(3)
    steps = series(80, rng, (3.0, 0.0), at=40)
    detector = ChangeDetector(usual(), JUMPS, 18000.0)
    assert len(alarms(detector, steps)) == 1
    assert detector.count == 80


def test_a_step_may_hold_one_measurement():
    rng = np.random.default_rng(4)
    steps = [(c[:1], r[:1]) for c, r in series(50, rng)]
    assert np.isfinite(log_density(usual(), steps))
    assert not alarms(ChangeDetector(usual(), JUMPS, 18000.0), steps)


def test_what_is_undisturbed_is_learnt():
    rng = np.random.default_rng(5)
    amounts = Amounts(START, np.ones(2), SIZE, np.zeros(2, bool))
    found = learn([(amounts, series(50, rng, noise=1.5)) for _ in range(2)])
    assert found.noise == pytest.approx(1.5, rel=0.1)
    assert found.scatter < 0.3
    assert found.walk < 0.1
    assert found.rare < 0.05
