"""Errors of single readings are those of Student's noise, found by EM."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import stats

from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.single_errors import single_errors

COUNT, SIGMA = 400, 0.3
FREEDOMS = (2.0, 4.0, 8.0, 16.0, np.inf)


def observations(value: np.ndarray, slow: float = 0.0) -> Observations:
    """One channel with white noise of size SIGMA, and slow noise of a size that lasts 2 s."""
    unit, split = np.zeros(len(value), int), ("fit",)
    series = Series(0, "y", 0, len(value), 0.05 * np.arange(len(value)), SIGMA, slow, 2.0)
    return Observations(value, (series,), ("drive",), split, unit, split, ("drive",))


def settled(plain: Observations, freedoms=FREEDOMS, steps: int = 30):
    """Errors where EM has settled, and the measurements with them."""
    present, one, all_of_them = plain, np.zeros(len(plain), int), np.ones(len(plain), bool)
    for _ in range(steps):
        found = single_errors(plain, present, present.whiten(plain.value) ** 2, one, all_of_them, freedoms)
        white = np.hypot(SIGMA, found.std)
        present = dataclasses.replace(plain, series=(dataclasses.replace(plain.series[0], white=white),))
    return found, present


@pytest.mark.parametrize("freedom", [2.0, 4.0, np.inf])
def test_evidence_is_that_of_student_s_noise(freedom: float):
    """Where noise is white, the density of all readings is Student's to the last digit."""
    law = stats.t(freedom, scale=SIGMA) if np.isfinite(freedom) else stats.norm(scale=SIGMA)
    plain = observations(law.rvs(COUNT, random_state=1))
    found, present = settled(plain, (freedom,))
    log_density = stats.norm.logpdf(present.whiten(plain.value)) - present.log_widths() + found.log_ratio
    np.testing.assert_allclose(log_density, law.logpdf(plain.value), atol=1e-9)


@pytest.mark.parametrize("freedom", [2.0, np.inf])
def test_readings_tell_the_tails_of_their_noise(freedom: float):
    law = stats.t(freedom) if np.isfinite(freedom) else stats.norm()
    found, _ = settled(observations(SIGMA * law.rvs(4000, random_state=3)))
    assert found.freedom[0] == freedom
    assert np.all(found.std == 0.0) == np.isinf(freedom)


def test_one_reading_far_off_has_its_error_and_its_neighbours_have_none():
    """A filter that follows slow errors is led astray by an outlier; once it is known, it is not."""
    rng = np.random.default_rng(2)
    decay = np.exp(-0.05 / 2.0)
    slow = np.zeros(COUNT)
    for k in range(1, COUNT):
        slow[k] = decay * slow[k - 1] + 2.0 * np.sqrt(1.0 - decay**2) * rng.standard_normal()
    value = slow + SIGMA * rng.standard_normal(COUNT)
    without, _ = settled(observations(value, 2.0), (4.0,))
    value[100] += 20.0
    found, _ = settled(observations(value, 2.0), (4.0,))
    # (4 + z^2) / 5 times the variance: of a reading far off, its error over the root of five
    assert found.std[100] == pytest.approx(20.0 / np.sqrt(5.0), rel=0.2)
    np.testing.assert_allclose(np.delete(found.std, 100), np.delete(without.std, 100), atol=2.0 * SIGMA)


def test_a_simulation_that_diverged_leaves_no_number_undefined():
    left = np.zeros(COUNT)
    left[3:5] = np.inf, np.nan
    plain = observations(np.zeros(COUNT))
    found = single_errors(plain, plain, left**2, np.zeros(COUNT, int), np.ones(COUNT, bool), (4.0,))
    assert np.isfinite(found.std).all() and np.isfinite(found.log_ratio).all()
    assert np.min(found.std[3:5]) > 1e4


def test_errors_far_beyond_the_noise_settle():
    """Beside an error of 1e12 sigma what is usual of a reading is lost to rounding, if it is told by a difference."""
    value = 1e-3 * SIGMA * np.random.default_rng(5).standard_normal(COUNT)
    value[200:210] += 1e12 * SIGMA * np.array([1.0, -1.0] * 5)
    found, present = settled(observations(value, 1e-3), (4.0,))
    assert np.isfinite(found.std).all() and np.isfinite(present.whiten(value)).all()
    assert np.min(found.std[200:210]) > 1e4 > 2.0 * SIGMA > np.max(found.std[:200])
