"""Means of readings: what is averaged with what, and the noise that is left in a mean."""

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.means import Means
from lunar_mjx.inference.observations import Observations, Series
from tests.diagnosis.drives.test_drive_noise import coloured

INTERVAL, COUNT, SPAN = 0.05, 400, 0.2


def readings(*series: tuple[str, float, float, float], values: np.ndarray | None = None) -> Observations:
    """Readings of one log, 20 a second from 3 s on; by channel: white and slow noise and how long that lasts."""
    time = 3.0 + INTERVAL * np.arange(COUNT)
    made = tuple(Series(0, c, k * COUNT, (k + 1) * COUNT, time, *noise) for k, (c, *noise) in enumerate(series))
    value = np.zeros(COUNT * len(series)) if values is None else values
    unit = np.zeros(len(value), int)
    return Observations(value, made, ("drive",), ("fit",), unit, ("fit",), ("drive",))


def test_a_mean_holds_the_readings_of_its_span_and_no_other():
    seen = readings(("gyro_x_rad_s", 1.0, 0.0, 0.0), ("gyro_y_rad_s", 1.0, 0.0, 0.0), values=np.arange(2.0 * COUNT))
    means = Means(seen, SPAN, [3.0])
    found = means.observations(seen)
    assert len(found) == 2 * COUNT // 4
    np.testing.assert_allclose(found.value, np.arange(2.0 * COUNT).reshape(-1, 4).mean(axis=1))
    np.testing.assert_allclose(found.series[1].time, (3.0 + INTERVAL * np.arange(COUNT)).reshape(-1, 4).mean(axis=1))
    np.testing.assert_allclose(means(np.stack([seen.value, 2.0 * seen.value])), [found.value, 2.0 * found.value])
    np.testing.assert_allclose(means.each(found.value)[:5], found.value[[0, 0, 0, 0, 1]])
    assert found.series[1].start == found.series[0].stop == COUNT // 4


def test_without_a_span_every_reading_stands_by_itself():
    seen = readings(("gyro_x_rad_s", 1.0, 0.5, 2.0))
    assert Means(seen, 0.0, [3.0]).observations(seen) is seen


def test_readings_that_are_rarer_than_spans_are_left_as_they_are():
    seen = readings(("gyro_x_rad_s", 1.0, 0.5, 2.0))
    (series,) = Means(seen, 0.5 * INTERVAL, [3.0]).observations(seen).series
    assert (series.white, series.coloured) == (1.0, 0.5)
    np.testing.assert_array_equal(series.time, seen.series[0].time)


def test_a_gap_is_not_bridged():
    seen = readings(("gyro_x_rad_s", 1.0, 0.0, 0.0), values=np.arange(1.0 * COUNT))
    time = np.where(np.arange(COUNT) < 6, 3.0 + INTERVAL * np.arange(COUNT), 5.0 + INTERVAL * np.arange(COUNT))
    (series,) = seen.series
    gapped = Observations(**{**vars(seen), "series": (Series(0, series.channel, 0, COUNT, time, 1.0),)})
    found = Means(gapped, SPAN, [3.0]).observations(gapped)
    np.testing.assert_allclose(found.value[:2], [1.5, 4.5])
    assert found.series[0].time[1] < 3.3 and found.series[0].time[2] > 5.2
    np.testing.assert_allclose(found.series[0].white[:2], [0.5, np.sqrt(0.5)])


@pytest.mark.parametrize(("share", "tau"), [(0.0, 0.0), (0.6, 2.0), (0.6, 0.1)])
def test_the_noise_of_a_mean_is_what_that_of_its_readings_leaves(share, tau):
    rng, time = np.random.default_rng(0), INTERVAL * np.arange(COUNT)
    seen = readings(("gyro_x_rad_s", np.sqrt(1.0 - share), np.sqrt(share), tau))
    found = Means(seen, SPAN, [3.0]).observations(seen)
    drawn = np.stack([coloured(rng, time, share, max(tau, 1e-9)) for _ in range(200)])
    means = drawn.reshape(len(drawn), -1, 4).mean(axis=2)
    # 200 courses of 100 means: their size is known to a per cent or two, as neighbours are alike
    assert means.std() == pytest.approx(found.sigma().mean(), rel=0.03)
    # means of slow noise are smoother than a process of its kind: what is new in each is less by a few per cent
    assert 0.94 < found.whiten(means.T).std() < 1.03


def test_an_angle_that_turns_past_180_degrees_has_the_mean_of_its_readings():
    turning = (170.0 + np.arange(COUNT)) % 360.0
    turning[turning > 180.0] -= 360.0
    seen = readings(("yaw_deg", 0.1, 0.0, 0.0), values=turning)
    found = Means(seen, SPAN, [3.0]).observations(seen)
    np.testing.assert_allclose(found.value[:5], [171.5, 175.5, 179.5, 183.5, 187.5])
