"""Whitening against dense Gaussians."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from lunar_mjx.diagnosis.tables.noise import scatter, sweeps
from lunar_mjx.inference.observations import Chain, Observations, Series
from lunar_mjx.wheel_bed.table import SteadyStateTable
from tests.inference.toy_problem import manoeuvres

WHITE, COLOURED, TAU = 0.7, 1.3, 0.8


def irregular(n: int = 60) -> tuple[Observations, np.ndarray]:
    """One series at irregular times, and the dense covariance of its noise."""
    time = np.cumsum(np.random.default_rng(1).uniform(0.05, 0.6, n))
    series = (Series(0, "y", 0, n, time, WHITE, COLOURED, TAU),)
    o = Observations(np.zeros(n), series, ("a",), ("fit",), np.zeros(n, int), ("fit",), ("a",))
    covariance = COLOURED**2 * np.exp(-np.abs(time[:, None] - time) / TAU) + WHITE**2 * np.eye(n)
    return o, covariance


def test_whitening_divides_out_the_dense_covariance():
    o, covariance = irregular()
    w = o.whiten(np.eye(len(o)))
    np.testing.assert_allclose(w @ covariance @ w.T, np.eye(len(o)), atol=1e-12)
    # the Gaussian's density: the determinant too
    assert -2.0 * np.log(np.abs(np.diag(w))).sum() == pytest.approx(np.linalg.slogdet(covariance)[1])


def test_whitened_noise_has_unit_variance_and_no_memory():
    o, covariance = irregular(200)
    draws = np.linalg.cholesky(covariance) @ np.random.default_rng(0).standard_normal((200, 500))
    white = o.whiten(draws)
    assert white.var() == pytest.approx(1.0, abs=0.02)
    assert np.mean(white[1:] * white[:-1]) == pytest.approx(0.0, abs=0.02)


def test_series_of_equal_times_are_whitened_as_if_alone():
    both = manoeuvres(2, 40, coloured=COLOURED, correlation_time=TAU)
    one = manoeuvres(1, 40, coloured=COLOURED, correlation_time=TAU)
    data = np.random.default_rng(2).standard_normal((80, 3))
    np.testing.assert_allclose(both.whiten(data)[40:], one.whiten(data[40:]), rtol=1e-12)


def test_nothing_is_whitened_to_nothing():
    """LAPACK's wrapper would write beyond an array without columns."""
    o = manoeuvres(2, 40, coloured=COLOURED, correlation_time=TAU)
    assert o.whiten(np.zeros((80, 0))).shape == (80, 0)


def test_points_of_a_table_have_noise_of_their_own():
    o = manoeuvres(1, 4)
    std = np.array([1.0, 2.0, 4.0, 8.0])
    o = dataclasses.replace(o, series=(Series(0, "y", 0, 4, None, std),))
    np.testing.assert_allclose(o.whiten(std), 1.0)
    np.testing.assert_allclose(o.sigma(), std)


def test_splits_choose_observations():
    o = manoeuvres(6, 3)
    assert o.in_split("fit").sum() == 12
    assert o.in_split("select").sum() == 6
    assert o.in_split("fit", "select").all()
    assert not o.in_split("test").any()


def ar1_table(correlation: float, sweeps_: int = 6, slips: int = 12, trials: int = 3, seed: int = 0):
    """A table whose only content is noise, correlated along each sweep of each trial, rows in any order."""
    rng = np.random.default_rng(seed)
    rows = []
    for trial in range(trials):
        for angle in range(sweeps_):
            noise = [rng.normal()]
            for _ in range(slips - 1):
                noise.append(correlation * noise[-1] + np.sqrt(1.0 - correlation**2) * rng.normal())
            rows += [(trial, 5.0 * angle, 0.05 * k, e) for k, e in enumerate(noise)]
    trial, angle, slip, value = np.array(rows)[rng.permutation(len(rows))].T
    test = {"slip_ratio": slip, "slip_angle_deg": angle, "normal_load_N": np.full(len(slip), 100.0)}
    return trial, test, value


def test_a_chain_divides_out_the_covariance_of_its_sweeps():
    slips, correlation = 9, 0.8
    order = np.random.default_rng(0).permutation(2 * slips)
    follows = np.tile(np.arange(slips) > 0, 2)
    chain = Chain(order, follows, correlation, float(np.sqrt(1.0 - correlation**2)))
    series = (Series(0, "y", 0, 2 * slips, None, WHITE, chain=chain),)
    o = Observations(np.zeros(2 * slips), series, ("a",), ("fit",), np.zeros(2 * slips, int), ("fit",), ("a",))
    place = np.argsort(order)  # of every point along the sweeps
    apart = np.abs(place[:, None] - place)
    covariance = WHITE**2 * np.where(place[:, None] // slips == place // slips, correlation**apart, 0.0)
    w = o.whiten(np.eye(2 * slips))
    np.testing.assert_allclose(w @ covariance @ w.T, np.eye(2 * slips), atol=1e-12)


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_replicates_tell_the_correlation_of_neighbours(correlation):
    trial, test, value = ar1_table(correlation)
    table = SteadyStateTable(
        name="bed",
        test=test,
        measured={"drawbar_pull": value},
        replicates=np.ones(len(value)),
        sigma={},
        radius=0.1,
        width=0.1,
        slip_definition="wheel_frame",
    )
    log = SimpleNamespace(table=table, trial=trial)
    found = scatter(log)["drawbar_pull"]
    assert found.correlation == pytest.approx(correlation, abs=0.12)
    assert found.innovation == pytest.approx(np.sqrt(1.0 - correlation**2), rel=0.15)
    order, follows = sweeps(table, trial)
    assert follows.sum() == 3 * 6 * 11
    slip = test["slip_ratio"][order]
    np.testing.assert_allclose(np.diff(slip)[follows[1:]], 0.05)


def test_what_whitening_divides_by_is_the_determinant():
    o, covariance = irregular()
    assert np.sum(o.log_widths()) == pytest.approx(0.5 * np.linalg.slogdet(covariance)[1])
