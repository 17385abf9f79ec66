"""Standard errors of a mean and a step under white noise, and under noise that hides a slow disturbance."""

import numpy as np
import pytest

from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.slow_disturbance import density, inflated

TIME = np.arange(200) * 0.05
SLOW, FAST = np.ones_like(TIME), np.where(np.arange(200) % 2, 1.0, -1.0)


def _disturbance(rng, time):
    """(n,) a tenth of the noise, slow: some of it returns only after the log has ended."""
    waves = np.cos(time[:, None] * rng.normal(size=12) / 2.0 + rng.uniform(0.0, 2.0 * np.pi, 12))
    wave = waves @ rng.normal(size=12)
    return 0.1 * wave / np.sqrt(np.mean(wave**2))


def _observed(series):
    size = series[-1].stop
    return Observations(np.zeros(size), tuple(series), ("log",), ("fit",), np.zeros(size, int), ("fit",), ("log",))


def _errors(count, disturbed, seed, slopes=(SLOW, FAST), slow_channels=0):
    """Estimates of amounts of `slopes` in the first of `count` channels, and their covariance by plain and by what
    residuals show."""
    rng = np.random.default_rng(seed)
    times = [TIME] * count + [TIME[::20]] * slow_channels
    edges = np.cumsum([0, *(len(t) for t in times)])
    series = [
        Series(0, f"c{k}", a, b, t, 1.0) for k, (a, b, t) in enumerate(zip(edges, edges[1:], times, strict=False))
    ]
    noise = np.concatenate([rng.normal(size=len(t)) + disturbed * _disturbance(rng, t) for t in times])
    jacobian = np.zeros((len(noise), len(slopes)))
    for k, slope in enumerate(slopes):
        jacobian[: len(TIME), k] = slope
    plain = np.linalg.inv(jacobian.T @ jacobian)
    found = plain @ jacobian.T @ noise
    wider = inflated(_observed(series), np.ones(len(noise), bool), noise - jacobian @ found, jacobian, plain)
    return found, plain, wider


def test_white_noise_leaves_standard_errors_alone():
    ratio = np.mean([np.diag(w) / np.diag(p) for _, p, w in (_errors(100, 0.0, k) for k in range(40))], axis=0)
    assert ratio == pytest.approx([1.0, 1.0], abs=0.08)


def test_a_slow_disturbance_widens_what_it_moves_and_nothing_else():
    runs = [_errors(60, 1.0, k) for k in range(200)]
    found = np.array([f for f, _, _ in runs])
    plain, wider = (np.sqrt(np.mean([np.diag(r[k]) for r in runs], axis=0)) for k in (1, 2))
    assert found[:, 0].std() > 1.25 * plain[0]  # the mean of a channel is farther off than white noise allows
    assert wider[0] == pytest.approx(found[:, 0].std(), rel=0.12)
    assert wider[1] == pytest.approx(plain[1], rel=0.03)
    covered = np.mean([abs(f[0]) < 1.96 * np.sqrt(w[0, 0]) for f, _, w in runs])
    assert 0.90 < covered < 0.98


def test_channels_that_are_sampled_seldom_do_not_hide_it():
    """They hardly feel a disturbance: as many of them as of others must not halve what it is taken for."""
    alone, beside = (np.mean([_errors(100, 1.0, k, slow_channels=n)[2][0, 0] for k in range(40)]) for n in (0, 100))
    assert beside == pytest.approx(alone, rel=0.08)


def test_no_density_is_negative_and_few_modes_are_pooled():
    band = np.array([0] * 5 + [1] * 100)
    quiet = density(band, np.ones(105), np.full(105, 0.5), np.ones(105))
    assert np.array_equal(quiet, [0.0, 0.0])
    loud = density(band, np.ones(105), np.full(105, 3.0), np.ones(105))
    assert loud == pytest.approx([2.0, 2.0])


def test_points_of_a_table_have_no_frequencies():
    table, plain = _observed([Series(0, "drawbar", 0, 200, None, 1.0)]), np.eye(1)
    assert inflated(table, np.ones(200, bool), np.ones(200), SLOW[:, None], plain) is plain
