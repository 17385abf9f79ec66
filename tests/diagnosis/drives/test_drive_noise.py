"""Noise of drive logs: its colour from segments at rest, and from residuals."""

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.noise import Colour, Noises, colours
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.logs.log import Noise

INTERVAL, REST, END = 0.05, 1.0, 10.0
SHARE, TAU = 0.64, 0.475
CHANNELS = {
    "position_x_m": 0.005,
    "roll_deg": 0.1,
    "joint_fl_drive_speed_rad_s": 0.005,
    "motor_fl_drive_current_A": 0.01,
}


@dataclasses.dataclass
class FakeLog:
    """What `Noises` asks of a log: two seconds of rest, then driving."""

    channels: dict[str, tuple[np.ndarray, np.ndarray]]
    noise: dict[str, Noise]

    @property
    def channel_names(self):
        return tuple(self.channels)

    def channel(self, name):
        return self.channels.get(name)


def coloured(rng: np.random.Generator, time: np.ndarray, share: float, tau: float) -> np.ndarray:
    """(n,) unit white noise plus an Ornstein-Uhlenbeck process."""
    decay = np.exp(-np.diff(time) / tau)
    slow = np.empty(len(time))
    slow[0] = rng.normal()
    for i, d in enumerate(decay):
        slow[i + 1] = d * slow[i] + np.sqrt(1.0 - d**2) * rng.normal()
    return np.sqrt(share) * slow + np.sqrt(1.0 - share) * rng.normal(size=len(time))


def campaign(rng, share=SHARE, tau=TAU, count=6, stated_tau=0.0, kinds=None) -> list[FakeLog]:
    """Logs whose channels ramp after a second of rest, with noise of the stated size."""
    time = np.arange(0.0, END, INTERVAL)
    logs = []
    for _ in range(count):
        channels = {"command_fl_drive_speed_rad_s": (time, np.where(time < REST, 0.0, 1.0))}
        for name, std in CHANNELS.items():
            s, t = (kinds or {}).get(name, (share, tau))
            ramp = 20.0 * std * np.clip(time - REST, 0.0, None)
            channels[name] = time, ramp + std * coloured(rng, time, s, t)
        logs.append(FakeLog(channels, {c: Noise(s, "datasheet", stated_tau) for c, s in CHANNELS.items()}))
    return logs


def test_white_rest_is_white() -> None:
    for seed in range(5):
        noises = Noises(campaign(np.random.default_rng(seed), share=0.0))
        assert noises.common == Colour()
        assert set(noises.colours.values()) == {Colour()}


def test_a_second_of_rest_in_six_logs_shows_the_colour() -> None:
    logs = campaign(np.random.default_rng(0))
    white, slow, tau = Noises(logs)(logs[0], "roll_deg")
    assert np.hypot(white, slow) == pytest.approx(0.1)
    assert slow**2 / 0.1**2 == pytest.approx(SHARE, abs=0.2)
    assert TAU / 2 < tau < 2 * TAU


def test_a_kind_that_differs_keeps_its_own_colour() -> None:
    logs = campaign(np.random.default_rng(1), kinds={"motor_fl_drive_current_A": (0.0, 1.0)}, count=12)
    noises = Noises(logs)
    assert noises(logs[0], "motor_fl_drive_current_A") == (0.01, 0.0, 0.0)
    assert noises(logs[0], "position_x_m")[1] > 0.0


def test_white_noise_of_another_size_is_no_colour() -> None:
    logs = campaign(np.random.default_rng(2), share=0.0)
    for log in logs:
        log.noise = {c: Noise(1.4 * s, "datasheet") for c, s in CHANNELS.items()}
    assert Noises(logs).common == Colour()


def test_a_quiet_encoder_tells_nothing() -> None:
    logs = campaign(np.random.default_rng(3))
    for log in logs:
        for c in CHANNELS:
            log.channels[c] = log.channels[c][0], np.round(log.channels[c][1], 12) * 0.0
    assert Noises(logs).common == Colour()


def test_a_stated_correlation_time_stays() -> None:
    logs = campaign(np.random.default_rng(4), stated_tau=2.0)
    noises = Noises(logs)
    assert noises(logs[0], "roll_deg") == (pytest.approx(0.01), 0.1, 2.0)
    observations, residual = as_observations(logs, noises)
    assert noises.refined(observations, residual).series == observations.series


@pytest.mark.parametrize(
    ("white", "slow", "tau", "step", "count", "joined"),
    [
        (0.3, 0.0077, 47.0, 1.0, 50, 27.0),  # temperatures of a drive through particles
        (1e-3, 2.6e-5, 0.24, 0.05, 1000, 4.5),  # its steering angles
        (0.005, 0.13, 32.0, 0.05, 1000, 0.37),  # its positions
        (1.0, 1.0, 10.0, 0.05, 1000, 28.0),
    ],
)
def test_white_noise_beside_a_slow_error_reads_one_sigma(white, slow, tau, step, count, joined) -> None:
    """As one process of the whole size with the error's memory it reads `joined` in place of 1."""
    rng, time, std = np.random.default_rng(7), step * np.arange(count), float(np.hypot(white, slow))
    share = (slow / std) ** 2
    drawn = std * np.stack([coloured(rng, time, share, tau) for _ in range(300)], axis=1)
    read = {}
    for stated in (share, 1.0):
        log = FakeLog({"roll_deg": (time, drawn[:, 0])}, {"roll_deg": Noise(std, "datasheet", tau, stated)})
        series = (Series(0, "roll_deg", 0, count, time, *Noises([log])(log, "roll_deg")),)
        seen = Observations(drawn[:, 0], series, ("log",), ("fit",), np.zeros(count, int), ("fit",), ("log",))
        residual, offset = seen.whiten(drawn), seen.whiten(np.ones(count))
        read[stated] = float(np.mean(residual**2)), float(np.std(offset @ residual) / np.linalg.norm(offset))
    assert read[share][0] == pytest.approx(1.0, abs=0.05)
    # evidence of a constant offset that is not there
    assert read[share][1] == pytest.approx(1.0, abs=0.15)
    assert read[1.0][0] == pytest.approx(joined, rel=0.2)


def as_observations(logs, noises) -> tuple[Observations, np.ndarray]:
    """All channels as observations, and the residual of a model that ramps as they do but for a slow misfit."""
    series, parts, at = [], [], 0
    for number, log in enumerate(logs):
        for name, std in CHANNELS.items():
            time, values = log.channels[name]
            series.append(Series(number, name, at, at + len(time), time, *noises(log, name)))
            misfit = 0.5 * std * np.sin(time / 2.0)
            parts.append(values - 20.0 * std * np.clip(time - REST, 0.0, None) + misfit)
            at += len(time)
    residual = np.concatenate(parts)
    unit = np.zeros(at, int)
    return Observations(residual, tuple(series), ("log",), ("fit",), unit, ("fit",), ("log",)), residual


def test_a_residual_refines_the_colour_despite_a_slow_misfit() -> None:
    logs = campaign(np.random.default_rng(5))
    noises = Noises(logs)
    observations, residual = as_observations(logs, noises)
    refined = noises.refined(observations, residual)
    found = noises.common
    assert found.share == pytest.approx(SHARE, abs=0.07)
    assert found.correlation_time == pytest.approx(TAU, rel=0.25)
    assert np.mean(refined.whiten(residual) ** 2) == pytest.approx(1.0, abs=0.03)


def test_times_that_jitter_are_one_set() -> None:
    rng = np.random.default_rng(6)
    logs = campaign(rng)
    for log in logs:
        for c in CHANNELS:
            time, values = log.channels[c]
            log.channels[c] = time + rng.uniform(0.0, 0.01, len(time)), values
    found = Noises(logs).common
    assert found.share == pytest.approx(SHARE, abs=0.2)
    assert TAU / 2 < found.correlation_time < 2 * TAU


def test_colours_of_nothing() -> None:
    assert colours({}) == (Colour(), {})
