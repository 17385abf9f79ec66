"""Calls of several threads joined into one, and noise and intervals of simulated campaigns."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from lunar_mjx.diagnosis.audit import draw_noise, wilson
from lunar_mjx.inference.gather import Gather
from tests.inference.toy_problem import manoeuvres


def test_threads_share_calls_and_get_their_own_rows():
    calls = []

    def square(rows):
        calls.append(len(rows))
        return rows**2

    gather = Gather(square, 3)

    def work(k):
        try:
            return [gather(np.full((k, 2), float(k + i)))[0, 0] for i in range(k)]
        finally:
            gather.leave()

    with ThreadPoolExecutor(3) as pool:
        found = list(pool.map(work, (1, 2, 3)))
    assert found == [[1.0], [4.0, 9.0], [9.0, 16.0, 25.0]]
    assert calls == [6, 5, 3], "each call serves all threads that still take part"


def test_an_error_reaches_every_thread():
    def fail(rows):
        raise ValueError("no")

    gather = Gather(fail, 2)
    with ThreadPoolExecutor(2) as pool:
        for future in [pool.submit(gather, np.zeros((1, 1))) for _ in range(2)]:
            with pytest.raises(ValueError, match="no"):
                future.result(10.0)


def test_drawn_noise_is_of_the_stated_kind():
    observations = manoeuvres(4, 4000, white=0.5, coloured=2.0, correlation_time=1.0)
    noise = draw_noise(observations, np.random.default_rng(0))
    white = observations.whiten(noise)
    assert np.std(white) == pytest.approx(1.0, abs=0.02)
    assert abs(np.mean(white[1:] * white[:-1])) < 0.03
    assert np.std(noise) == pytest.approx(np.hypot(0.5, 2.0), rel=0.1)


def test_wilsons_interval():
    assert wilson(0, 0) == (0.0, 1.0)
    low, high = wilson(0, 10)
    assert (low, high) == (0.0, pytest.approx(0.2775, abs=1e-3))
    low, high = wilson(81, 263)
    assert (low, high) == (pytest.approx(0.2553, abs=1e-3), pytest.approx(0.3662, abs=1e-3))
