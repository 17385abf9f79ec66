"""Rocks: right numbers, kept apart, and always found by a wheel that would touch them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lunar_mjx.terrain import RockField, build_rocks, nearest_rock
from lunar_mjx.terrain.rock_field import place_rocks
from lunar_mjx.terrain.rocks import clearance, smallest_gap

BOUNDS = (-30.0, -20.0, 30.0, 20.0)


def scatter(seed, dtype=np.float32, **words):
    field = RockField(**({"abundance": 0.02, "clear": 0.0} | words))
    return place_rocks(field, BOUNDS, lambda x, y: 0.1 * x, np.random.default_rng(seed), dtype)


def live(rocks):
    radii = np.asarray(rocks.radii)
    return np.asarray(rocks.centers)[radii > 0], radii[radii > 0]


@settings(max_examples=8)
@given(st.integers(0, 10_000))
def test_a_wheel_near_a_rock_finds_it(seed):
    with jax.enable_x64(True):
        rocks = scatter(seed, np.float64)
        centers, radii = live(rocks)
        assert smallest_gap(centers, radii) >= 0.9
        rng = np.random.default_rng(seed)
        k = rng.integers(0, len(radii), 300)
        angle = rng.uniform(0, 2 * np.pi, 300)
        away = radii[k] + rng.uniform(-1, 1, 300) * clearance(0.9) * 0.999
        x = np.clip(centers[k, 0] + away * np.cos(angle), -30, 30)
        y = np.clip(centers[k, 1] + away * np.sin(angle), -20, 20)
        cx, cy, cz, radius = jax.jit(nearest_rock)(rocks, jnp.asarray(x), jnp.asarray(y))
        np.testing.assert_array_equal(radius, radii[k])
        np.testing.assert_allclose(np.stack([cx, cy, cz], -1), centers[k])


def test_a_lone_rock_is_found_within_the_reach_and_not_far_away():
    rocks = build_rocks(np.array([[1.0, 2.0, 0.1]]), np.array([0.3]), BOUNDS)
    x = jnp.array([1.0, 1.0 + 0.3 + 0.6, 1.0 + 0.3 + 0.6 + 0.5, 25.0])
    np.testing.assert_allclose(nearest_rock(rocks, x, jnp.full(4, 2.0))[3], [0.3, 0.3, 0.0, 0.0], rtol=1e-6)


def test_conflicts_at_random_points_are_rare():
    """Of all points within a wheel's reach of a rock, how many get another than the nearest."""
    rocks = scatter(3, abundance=0.03)
    centers, radii = live(rocks)
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-30, 30, 20_000), rng.uniform(-20, 20, 20_000)
    distance = np.hypot(x[:, None] - centers[:, 0], y[:, None] - centers[:, 1]) - radii
    touched = distance.min(axis=1) < 0.6
    found = np.asarray(nearest_rock(rocks, x, y)[3])
    wrong = touched & (np.abs(found - radii[distance.argmin(axis=1)]) > 1e-6)
    assert touched.sum() > 500 and wrong.sum() < 0.02 * touched.sum()


def test_numbers_follow_the_size_frequency_law():
    field = RockField(abundance=0.02, smallest=0.2, largest=2.0)
    diameters = field.draw_diameters(2e4, np.random.default_rng(0))
    assert len(diameters) == pytest.approx(float(field.number(0.2)) * 2e4, rel=0.1)
    q = 1.79 + 0.152 / 0.02
    covered = np.pi / 4 * (diameters**2).sum() / 2e4
    assert covered == pytest.approx(0.02 * np.exp(-q * 0.2), rel=0.15)
    assert (np.diff(diameters) <= 0).all() and diameters.min() >= 0.2


@pytest.mark.parametrize("burial", [0.2, 0.4, 0.5, 0.8])
def test_rocks_are_buried_by_the_share_and_show_their_diameter(burial):
    rocks = scatter(1, burial=burial)
    centers, radii = live(rocks)
    above = centers[:, 2] + radii - 0.1 * centers[:, 0]
    np.testing.assert_allclose(above / (2 * radii), 1 - burial, rtol=1e-5)


def test_the_start_stays_clear():
    centers, radii = live(scatter(1, clear=5.0, abundance=0.03))
    assert (np.hypot(centers[:, 0], centers[:, 1]) - radii).min() >= 5.0


def test_no_rocks_and_nan_positions():
    x = jnp.array([0.0, jnp.nan, 1e30])
    assert all((v == 0).all() for v in nearest_rock(None, x, x))
    empty = build_rocks(np.zeros((0, 3)), np.zeros(0), BOUNDS)
    assert (nearest_rock(empty, x, x)[3] == 0).all()
    nearest_rock(scatter(0), x, x)


def test_gather_and_elementwise_only():
    text = jax.jit(nearest_rock).lower(scatter(0), jnp.zeros(8), jnp.zeros(8)).as_text()
    for banned in ("dot_general", "scatter", "while"):
        assert banned not in text
