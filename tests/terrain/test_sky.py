"""The Sun over a terrain: its disc behind the horizon, horizons of known ground, its place at a date."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from lunar_mjx.cameras import Sun as CameraSun
from lunar_mjx.errors import UserError
from lunar_mjx.model.ambient import Ambient
from lunar_mjx.model.sun import SunSettings, camera_sun, make_sun, read_sun
from lunar_mjx.terrain import Dem, flat
from lunar_mjx.terrain.sky import fixed_sun
from lunar_mjx.terrain.sky.horizon import HORIZON_GRID, compute_horizon, horizon_elevation
from lunar_mjx.terrain.sky.sun import SUN_RADIUS, share_above


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def ridge() -> Dem:
    """Level ground of 200 m with a wall 12 m high that runs east and west, 59 m north of the middle."""
    heights = np.zeros((201, 201))
    heights[160:168] = 12.0
    return Dem(heights, 1.0, -100.0, -100.0)


def test_the_disc_sets_by_the_area_of_its_segment():
    for height in np.linspace(-0.99, 0.99, 9):
        area, _ = integrate.quad(lambda v: 2.0 * math.sqrt(1.0 - v * v), -height, 1.0)
        assert float(share_above(height * SUN_RADIUS)) == pytest.approx(area / math.pi, abs=1e-9)
    assert [float(share_above(h)) for h in (-0.1, 0.0, 0.1)] == pytest.approx([0.0, 0.5, 1.0], abs=1e-12)
    slope = jax.vmap(jax.grad(share_above))(SUN_RADIUS * jnp.asarray([-2.0, -1.0, 0.0, 1.0, 2.0]))
    assert np.isfinite(slope).all() and float(slope[2]) == pytest.approx(2.0 / math.pi / SUN_RADIUS)


def test_a_wall_is_as_high_as_trigonometry_says():
    horizon = compute_horizon(ridge(), eye=0.5, dtype=np.float64)
    for y in (0.0, -50.0):
        seen = float(horizon_elevation(horizon, 0.0, y, 0.0, 1.0))
        # the foot of the wall lies 59 to 60 m ahead, and is met in steps of 2 %
        assert seen == pytest.approx(math.atan2(11.5, 59.5 - y), rel=0.03)
        oblique = float(horizon_elevation(horizon, 0.0, y, 1.0, 2.0))
        assert oblique == pytest.approx(math.atan2(11.5, (59.5 - y) * math.sqrt(1.25)), rel=0.03)
        assert float(horizon_elevation(horizon, 0.0, y, 0.0, -1.0)) == 0.0
    # turning on from the last of the directions to the first
    edge = [float(horizon_elevation(horizon, 0.0, 0.0, math.sin(a), math.cos(a))) for a in (-1e-6, 1e-6)]
    assert edge[0] == pytest.approx(edge[1], rel=1e-4)


def test_distant_ground_sinks_with_the_curvature_and_other_dems_count():
    level = Dem(np.zeros((3, 3)), 10.0, -10.0, -10.0)
    far = np.zeros((401, 401))
    far[:, 350:] = 800.0  # 15 km east
    around = Dem(far, 100.0, -20e3, -20e3)
    horizon = compute_horizon(level, [around], places=1, eye=0.0, dtype=np.float64)
    drop = 15e3**2 / (2.0 * HORIZON_GRID.moon_radius)
    seen = float(horizon_elevation(horizon, 0.0, 0.0, 1.0, 0.0))
    assert seen == pytest.approx(math.atan2(800.0 - drop, 15e3), rel=0.03)
    assert float(horizon_elevation(horizon, 0.0, 0.0, -1.0, 0.0)) == 0.0


def test_a_wall_shadows_what_lies_behind_it():
    horizon = compute_horizon(ridge(), dtype=np.float64)
    low, high = (fixed_sun(0.0, e, 1000.0, horizon, np.float64) for e in (5.0, 20.0))
    assert float(low.light(0.0, 0.0, 0.0).irradiance) == 0.0
    assert float(high.light(0.0, 0.0, 0.0).irradiance) == pytest.approx(1000.0)
    assert float(low.light(0.0, 0.0, 90.0).irradiance) == pytest.approx(1000.0)


def test_the_sun_of_a_model_is_that_of_cameras_and_ambient():
    settings = SunSettings(azimuth_deg=200.0, elevation_deg=4.0)
    sun = make_sun(settings, flat(20.0))
    assert sun is not None and make_sun(None, flat(20.0)) is None
    light = sun.light(100.0, 1.0, 2.0)
    np.testing.assert_allclose([float(v) for v in light.direction], camera_sun(settings).direction, atol=1e-12)
    assert float(light.irradiance) == pytest.approx(1361.0) and camera_sun(None) == CameraSun()
    ambient = Ambient(230.0, 90.0, 0.0, 1.0)
    assert float(ambient.under(sun.towards(5.0).z / sun.highest)) == pytest.approx(230.0)
    assert float(ambient.under(-0.1)) == 90.0


def test_a_sun_in_single_precision_warns_of_nothing():
    with jax.enable_x64(False):
        sun = make_sun(SunSettings(), flat(20.0))
        assert sun is not None and sun.horizon is not None and sun.direction.dtype == np.float32
        assert float(sun.light(0.0, 1.0, 1.0).irradiance) == pytest.approx(1361.0, rel=1e-6)


def test_the_sun_at_a_date():
    """Meeus, Astronomical Algorithms, example 53.a: at 1992 April 12.0 it is overhead at 67.90 E, 1.46 N."""
    pytest.importorskip("astropy")
    from lunar_mjx.terrain.sky.ephemeris import sun_over

    towards, distance = sun_over("1992-04-12T00:00:00", np.zeros(1), 1.46, 67.90)
    assert math.degrees(math.acos(towards[0, 2])) < 0.03
    assert 0.99 < distance[0] < 1.02
    hours = np.arange(710) * 3600.0
    noon, _ = sun_over("1992-04-12T00:00:00", hours, 0.0, 0.0)
    height = np.degrees(np.arcsin(noon[:, 2]))
    assert height.max() > 88.0 and height.min() < -88.0
    # from one noon to the next: a synodic month, within the hours of the samples and the ellipse of the Moon's orbit
    rising = np.flatnonzero((height[:-1] < 0.0) & (height[1:] >= 0.0))
    assert 1 <= len(rising) <= 2
    pole, _ = sun_over("1992-04-12T00:00:00", hours, -90.0, 0.0)
    assert np.abs(np.degrees(np.arcsin(pole[:, 2]))).max() < 1.6
    settings = SunSettings(date="1992-04-12T00:00:00", latitude_deg=1.46, longitude_deg=67.9, days=2.0, horizon=False)
    sun = make_sun(settings, flat(20.0))
    assert sun is not None and sun.direction.shape == (49, 3)
    middle, _ = sun_over("1992-04-12T00:00:00", np.array([1800.0]), 1.46, 67.9)
    np.testing.assert_allclose([float(v) for v in sun.towards(1800.0)], middle[0], atol=1e-5)
    east = _turned(settings, 90.0)
    # with its y axis to the east, what lies east is the terrain's north
    np.testing.assert_allclose(east[:2], [-middle[0, 1], middle[0, 0]], atol=1e-5)


def _turned(settings: SunSettings, north_deg: float) -> list[float]:
    sun = make_sun(dataclasses.replace(settings, north_deg=north_deg), flat(20.0))
    assert sun is not None
    return [float(v) for v in sun.towards(1800.0)]


@pytest.mark.parametrize(
    ("table", "parts"),
    [
        ({"height": 3.0}, ["sun.height = 3.0", "azimuth_deg"]),
        ({"elevation_deg": "high"}, ["sun.elevation_deg = 'high'", "not a number"]),
        ({"elevation_deg": 99.0}, ["elevation_deg = 99.0", "90"]),
        ({"date": 2027}, ["sun.date = 2027", "not a text"]),
        ({"date": "2027-01-01"}, ["latitude_deg = None", "missing beside a date"]),
        ({"latitude_deg": 3.0}, ["latitude_deg = 3.0", "without a date"]),
        ({"horizon": 1}, ["sun.horizon = 1", "not true or false"]),
        ({"days": 0.0}, ["days = 0.0"]),
        ({"azimuth_deg": 10**400}, ["sun.azimuth_deg = 1000", "too large"]),
        ({"azimuth_deg": 1e300}, ["azimuth_deg = 1e+300", "360 at most"]),
        ({"north_deg": 1e300}, ["north_deg = 1e+300", "360 at most"]),
        ({"horizon_dem": "a\0b"}, ["sun.horizon_dem = 'a\\x00b'", "no name of a file"]),
    ],
)
def test_bad_input_gets_one_sentence(tmp_path, table, parts):
    with pytest.raises(UserError) as caught:
        read_sun(tmp_path / "model.toml", table)
    text = str(caught.value)
    assert "\n" not in text and text.endswith(".") and text.startswith(str(tmp_path / "model.toml"))
    for part in parts:
        assert part in text, text


@pytest.mark.parametrize("date", ["1000-01-01", "2300-01-01"])
def test_a_date_beyond_the_ephemeris_is_refused(date):
    pytest.importorskip("astropy", reason="the extra lunar-mjx[sky] is not installed")
    from lunar_mjx.terrain.sky.ephemeris import sun_over

    with pytest.raises(UserError, match=rf"date = '{date}' is outside the years 1900 to 2100"):
        sun_over(date, np.zeros(1), -89.0, 0.0)
