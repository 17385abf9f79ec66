"""Roughness, craters and detail have the statistics that they claim."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.terrain import Craters, Dem, Roughness, add_detail, make_surface
from lunar_mjx.terrain.craters import draw, profile
from lunar_mjx.terrain.procedural import MEANS_KEPT, cell_means
from lunar_mjx.terrain.roughness import deviogram, fractal, hurst_exponent


@pytest.mark.parametrize("hurst", [0.3, 0.5, 0.75, 0.95])
def test_measured_hurst_exponent_is_the_one_asked_for(hurst):
    heights = fractal(301, 301, 0.2, Roughness(hurst, 0.03, 1.0), np.random.default_rng(0))
    assert hurst_exponent(heights, 0.2) == pytest.approx(hurst, abs=0.06)
    assert deviogram(heights, 0.2, [1.0])[0] == pytest.approx(0.03, rel=0.1)


def test_same_seed_same_surface_and_features_are_independent():
    rough, holes = Roughness(), Craters(largest=4.0)
    a, b = (make_surface(20, 20, 0.2, 5, roughness=rough, craters=holes).heights for _ in range(2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, make_surface(20, 20, 0.2, 6, roughness=rough, craters=holes).heights)
    apart = make_surface(20, 20, 0.2, 5, roughness=rough).heights + make_surface(20, 20, 0.2, 5, craters=holes).heights
    np.testing.assert_allclose(a, apart, atol=1e-12)


def test_crater_numbers_follow_the_power_law():
    craters = Craters(smallest=1.0, largest=50.0, density=0.079)
    _, _, diameter, depth = draw(craters, (0, 0, 400, 400), np.random.default_rng(1))
    for d in (1.0, 2.0, 4.0):
        expected = craters.number(d) * 400 * 400
        # Craters centred outside but reaching in are drawn too; they are few among the small.
        assert (diameter > d).sum() == pytest.approx(expected, rel=0.15)
    slope = np.polyfit(np.log([1, 2, 4]), np.log([(diameter > d).sum() for d in (1, 2, 4)]), 1)[0]
    assert slope == pytest.approx(-2.0, abs=0.15)
    ratio = depth / diameter
    assert ratio.min() >= 0.02 and ratio.max() <= 0.15 and ratio.mean() == pytest.approx(0.061, abs=0.006)


def test_crater_profile_has_depth_rim_and_end():
    r = np.linspace(0, 4, 4001)
    z = profile(r, depth=2.0)
    assert z.max() - z.min() == pytest.approx(2.0, rel=0.06)
    assert r[z.argmax()] == pytest.approx(1.0, abs=0.05) and (z[r > 3] == 0).all()
    assert np.abs(np.diff(z)).max() < 0.01  # no cliff anywhere


@pytest.mark.parametrize("cell", [0.5, 1.0, 1.7])
def test_detail_leaves_the_means_of_the_dem(cell):
    dem = make_surface(150, 100, 5.0, 3, roughness=Roughness(0.95, 0.75, 5.0))
    fine = add_detail(dem, cell, 7, roughness=Roughness(), craters=Craters(smallest=2.0))
    plain = add_detail(dem, cell, 7)
    ratio = round(dem.cell / fine.cell)
    change = cell_means(fine.heights - plain.heights, ratio)
    assert np.abs(change).max() <= MEANS_KEPT.tolerance
    assert np.std(fine.heights - plain.heights) > 0.01  # there is detail
    np.testing.assert_allclose(plain.heights[::ratio, ::ratio], dem.heights, atol=1e-9)
    assert fine.bounds == pytest.approx(dem.bounds) and fine.cell <= cell + 1e-12


def test_cell_means_are_means():
    fine = np.random.default_rng(0).normal(size=(31, 41))
    # Odd: the plain mean of a block about the node.
    assert cell_means(fine, 5)[2, 3] == pytest.approx(fine[8:13, 13:18].mean())
    # Even: the nodes on the cell's border belong to it by half.
    weights = np.outer(*[[0.5, 1, 1, 1, 0.5]] * 2)
    assert cell_means(fine[:29, :41], 4)[2, 3] == pytest.approx((fine[6:11, 10:15] * weights).sum() / 16)


def test_detail_on_apollo_15(apollo15):
    from lunar_mjx.terrain import read_dem

    dem = read_dem(apollo15, cell=2.0, height_scale=49.0, crop=(100.0, 100.0, 60.0, 60.0))
    fine = add_detail(dem, 0.2, 1, roughness=Roughness(), craters=Craters(smallest=0.6, density=0.05))
    assert fine.heights.shape == (301, 301) and fine.cell == pytest.approx(0.2)
    assert (
        np.abs(cell_means(fine.heights, 10) - cell_means(add_detail(dem, 0.2, 1).heights, 10)).max()
        <= MEANS_KEPT.tolerance
    )


def test_flat_dem_keeps_flat_without_features():
    np.testing.assert_allclose(add_detail(Dem(np.full((4, 5), 7.0), 2.0), 0.5, 1).heights, 7.0)
