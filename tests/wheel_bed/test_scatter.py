"""Noise of replicates that grows with its reading."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.wheel_bed.scatter import grows, point_scatter


def _draw(seed: int, std: np.ndarray, runs: int) -> np.ndarray:
    values = std[:, None] * np.random.default_rng(seed).normal(size=(len(std), runs))
    return np.sum((values - values.mean(axis=1, keepdims=True)) ** 2, axis=1)


@pytest.mark.parametrize("share", [0.0, 0.05])
def test_scatter_follows_the_reading_as_far_as_replicates_show_it(share: float) -> None:
    reading = np.linspace(-5.0, 60.0, 40)
    std = np.hypot(0.5, share * reading)
    off = [np.log(point_scatter(_draw(seed, std, 3), np.full(40, 2), reading) / std) for seed in range(50)]
    assert abs(np.mean(off)) < 0.05 and np.sqrt(np.mean(np.square(off))) < 0.2


def test_without_growth_it_is_the_pooled_scatter() -> None:
    squares = _draw(1, np.full(30, 2.0), 2)
    found = point_scatter(squares, np.ones(30), np.random.default_rng(2).normal(size=30))
    np.testing.assert_allclose(found, np.sqrt(squares.sum() / 30), rtol=0.25)


@pytest.mark.parametrize(("constant", "share", "honest"), [(1.1, 0.05, True), (4.0, 0.0, False)])
def test_growth_is_told_from_a_wrong_statement(constant: float, share: float, honest: bool) -> None:
    reading = np.linspace(0.0, 100.0, 60)
    std = np.hypot(constant, share * reading)
    said = [grows(_draw(seed, std, 2), np.ones(60), reading, np.ones(60)) for seed in range(40)]
    assert np.mean([s == honest for s in said]) > 0.9
