"""How large the slow errors of a model's channels are, by what the drives themselves tell."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.channel_errors import ChannelErrors
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import Amplitudes, Evidence, NoiseSize, infer_levels
from tests.inference.toy_problem import manoeuvres

LOGS, SAMPLES, NOISE = 4, 300, 0.01
TIME = np.arange(SAMPLES) * 0.1
SIGNAL = np.tile(np.sin(0.7 * TIME) + 0.2 * TIME, LOGS)
SPREAD = float(np.sqrt(np.mean(SIGNAL**2)))
BASE, EFFECT = np.tile(TIME, LOGS), np.repeat([1.0, -1.0, 0.5, 2.0], SAMPLES) * np.tile(np.cos(0.9 * TIME), LOGS)


def _slow(rng, share, time_s=1.0):
    """(n,) errors of the channels: an Ornstein-Uhlenbeck process of a time, over what the channels do."""
    keep = np.exp(-0.1 / time_s)
    out = np.zeros(LOGS * SAMPLES)
    for i in range(len(out)):
        before = out[i - 1] if i % SAMPLES else 0.0
        out[i] = keep * before + np.sqrt(1.0 - keep**2) * rng.standard_normal()
    return share * SPREAD * out


def _found(residual: np.ndarray, columns: np.ndarray, std: np.ndarray) -> tuple[Evidence, float]:
    """What a hypothesis with some columns finds, and the share of what the channel does that its errors have."""
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES, white=NOISE), value=SIGNAL)
    errors = ChannelErrors(observations, np.zeros(len(SIGNAL), int), 1, DriveSettings())
    levels = errors.levels(columns, residual)
    found = infer_levels(levels, Amplitudes.of(std), (), [NoiseSize("y", 0.3)])
    assert found.levels is not None
    return found, errors.shares(found.levels)["y"]


@pytest.mark.parametrize(
    ("share", "amount", "low", "high"),
    [(0.0, 0.0, 0.0, 0.0), (0.03, 0.0, 0.01, 0.1), (0.0, 0.2, 0.0, 0.0), (0.03, 0.2, 0.01, 0.1)],
)
def test_who_has_the_right_effect_puts_nothing_that_it_explains_down_to_slow_errors(share, amount, low, high):
    rng = np.random.default_rng(2)
    residual = amount * EFFECT + _slow(rng, share) + NOISE * rng.standard_normal(len(SIGNAL))
    found, errs = _found(residual, np.column_stack([BASE, EFFECT]), np.array([2.0, 1.0]))
    assert low <= errs <= high
    assert found.mean[1] == pytest.approx(amount, abs=0.05)


def test_who_lacks_an_effect_has_larger_errors_and_is_less_probable():
    rng = np.random.default_rng(4)
    residual = 0.2 * EFFECT + NOISE * rng.standard_normal(len(SIGNAL))
    right, none = _found(residual, np.column_stack([BASE, EFFECT]), np.array([2.0, 1.0]))
    wrong, some = _found(residual, BASE[:, None], np.array([2.0]))
    assert (none, some > 0.03) == (0.0, True)
    assert right.log_evidence > wrong.log_evidence + 100.0


def test_a_wrong_candidate_gains_nothing_from_slow_errors():
    """With the size of a model that leaves no errors, it would be named; with the size that each finds, it is not."""
    rng = np.random.default_rng(3)
    residual = _slow(rng, 0.03) + NOISE * rng.standard_normal(len(SIGNAL))
    with_it, _ = _found(residual, np.column_stack([BASE, EFFECT]), np.ones(2))
    without, _ = _found(residual, BASE[:, None], np.ones(1))
    assert with_it.log_evidence - without.log_evidence < 1.0
    plain = dataclasses.replace(manoeuvres(LOGS, SAMPLES, white=NOISE), value=SIGNAL)
    column, left = plain.whiten(EFFECT), plain.whiten(residual)
    assert abs(column @ left) / np.linalg.norm(column) > 5.0, "white noise alone would make it sure"


@pytest.mark.parametrize("time_s", [1.0, 10.0])
def test_how_long_errors_last_is_told_by_them(time_s):
    """A drift of all of a drive is one witness for a slow effect, and not ten."""
    rng = np.random.default_rng(5)
    observations = dataclasses.replace(manoeuvres(LOGS, SAMPLES, white=NOISE), value=SIGNAL)
    residual = _slow(rng, 0.1, time_s) + NOISE * rng.standard_normal(len(SIGNAL))
    drift = np.column_stack([BASE, np.repeat([1.0, -1.0, 0.5, 2.0], SAMPLES) * np.tile(np.cos(0.3 * TIME), LOGS)])
    gains = {}
    for times in ((1.0,), (1.0, 10.0)):
        errors = ChannelErrors(observations, np.zeros(len(SIGNAL), int), 1, DriveSettings(error_times_s=times))
        levels = errors.levels(drift, residual)
        alone = errors.levels(drift[:, :1], residual)
        own, rest = (
            infer_levels(made, Amplitudes.of(np.ones(made.columns.shape[1])), (), [NoiseSize("y", 0.3)])
            for made in (levels, alone)
        )
        gains[times] = own.log_evidence - rest.log_evidence
    assert errors.times_s(rest.levels)["y"] == time_s  # of the last: both times
    assert gains[1.0, 10.0] < (1.0 if time_s == 1.0 else max(1.0, 0.7 * gains[(1.0,)]))
