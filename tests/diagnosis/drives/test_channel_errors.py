"""How large the slow errors of a model's channels are, by what the drives themselves tell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.channel_errors import chosen_errors
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from tests.inference.toy_problem import manoeuvres

LOGS, SAMPLES, NOISE = 4, 300, 0.01
TIME = np.arange(SAMPLES) * 0.1
SIGNAL = np.tile(np.sin(0.7 * TIME) + 0.2 * TIME, LOGS)
SPREAD = float(np.sqrt(np.mean(SIGNAL**2)))
BASE, EFFECT = np.tile(TIME, LOGS), np.repeat([1.0, -1.0, 0.5, 2.0], SAMPLES) * np.tile(np.cos(0.9 * TIME), LOGS)


def _slow(rng, share):
    """(n,) errors of the channels: an Ornstein-Uhlenbeck process of a second, over what the channels do."""
    keep = np.exp(-0.1)
    out = np.zeros(LOGS * SAMPLES)
    for i in range(len(out)):
        before = out[i - 1] if i % SAMPLES else 0.0
        out[i] = keep * before + np.sqrt(1.0 - keep**2) * rng.standard_normal()
    return share * SPREAD * out


@pytest.mark.parametrize(
    ("share", "amount", "low", "high"),
    [(0.0, 0.0, 0.0, 0.0), (0.03, 0.0, 0.01, 0.1), (0.0, 0.2, 0.0, 0.0), (0.03, 0.2, 0.01, 0.1)],
)
def test_the_size_is_found_and_nothing_that_a_candidate_explains_is_put_down_to_it(share, amount, low, high):
    rng = np.random.default_rng(2)
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES, white=NOISE), value=SIGNAL)
    residual = amount * EFFECT + _slow(rng, share) + NOISE * rng.standard_normal(len(SIGNAL))
    whole = np.column_stack([BASE, EFFECT, residual])
    found, shares = chosen_errors(
        observations, whole, np.array([2.0, 1.0]), np.zeros(len(SIGNAL), int), 1, DriveSettings()
    )
    assert low <= shares["y"] <= high
    assert (found.series[0].coloured > 0.0) == (share > 0.0)


def test_a_wrong_candidate_explains_no_slow_error():
    """With white noise alone some amount of the effect would be sure; beside slow errors it is not."""
    rng = np.random.default_rng(3)
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES, white=NOISE), value=SIGNAL)
    residual = _slow(rng, 0.03) + NOISE * rng.standard_normal(len(SIGNAL))
    whole = np.column_stack([BASE, EFFECT, residual])
    found, _ = chosen_errors(observations, whole, np.ones(2), np.zeros(len(SIGNAL), int), 1, DriveSettings())
    sigma = {}
    for name, one in (("white", observations), ("slow", found)):
        column, left = one.whiten(EFFECT), one.whiten(residual)
        sigma[name] = abs(column @ left) / np.linalg.norm(column)
    assert sigma["white"] > 5.0 > 3.0 > sigma["slow"]
