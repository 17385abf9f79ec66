"""Cropping, resampling, filling holes, and removing the steps of grey levels."""

from __future__ import annotations

import time
import tracemalloc

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.terrain import Dem, Roughness, read_dem
from lunar_mjx.terrain.dem import fill_holes, undeclared_nodata
from lunar_mjx.terrain.dequantise import dequantise
from lunar_mjx.terrain.roughness import fractal


def ramp(rows=21, cols=31, cell=2.0):
    y, x = np.mgrid[:rows, :cols] * cell
    return Dem(0.1 * x - 0.05 * y, cell, x0=100.0, y0=-50.0)


def test_crop_keeps_map_coordinates():
    dem = ramp()
    part = dem.crop(x=130.0, y=-30.0, width=20.0, height=12.0)
    assert part.bounds == (120.0, -36.0, 140.0, -24.0)
    np.testing.assert_array_equal(part.heights, dem.heights[7:14, 10:21])


@pytest.mark.parametrize("rectangle", [(500, -30, 10, 10), (130, -30, 1000, 10), (130, -30, -5, 10), (130, -30, 1, 1)])
def test_crop_outside_is_refused(rectangle):
    with pytest.raises(UserError, match="crop"):
        ramp().crop(*rectangle)


@pytest.mark.parametrize("cell", [0.7, 1.0, 4.0, 5.0])
def test_resampling_keeps_a_plane(cell):
    new = ramp().resample(cell)
    rows, cols = new.heights.shape
    y, x = np.mgrid[:rows, :cols] * cell
    np.testing.assert_allclose(new.heights, 0.1 * x - 0.05 * y, atol=1e-9)


def test_coarse_resampling_does_not_alias():
    x = np.arange(400) * 0.1
    wave = np.tile(np.sin(2 * np.pi * x / 0.33), (400, 1))  # far below the new spacing
    assert np.abs(Dem(wave, 0.1).resample(1.0).heights[3:-3, 3:-3]).max() < 0.02


def test_holes_are_filled_and_counted():
    heights = ramp().heights.copy()
    expected = heights.copy()
    heights[5:8, 5:9] = np.nan
    heights[0, 0] = np.nan
    filled, notes = fill_holes(heights, "x.tif")
    np.testing.assert_allclose(filled[5:8, 5:9], expected[5:8, 5:9], atol=1e-9)
    assert np.isfinite(filled).all() and "13 of 651" in notes[0]


@pytest.mark.parametrize("hurst", [0.85, 0.95])
def test_dequantising_comes_nearer_to_the_truth(hurst):
    quantum = 0.2
    truth = fractal(128, 128, 2.0, Roughness(hurst, 0.24, 2.0), np.random.default_rng(1))
    data = np.round(truth / quantum) * quantum
    result = dequantise(data, quantum)
    assert np.abs(result - data).max() <= quantum / 2 + 1e-12

    def slope_error(z):
        return np.std(np.diff(z, axis=1) - np.diff(truth, axis=1))

    assert np.std(result - truth) < 0.9 * np.std(data - truth)
    assert slope_error(result) < 0.85 * slope_error(data)


def test_dequantising_a_gentle_ramp_removes_the_staircase():
    quantum = 0.2
    y, x = np.mgrid[:64, :64] * 2.0
    truth = 0.011 * x + 0.007 * y + 0.4 * np.sin(x / 25) * np.cos(y / 30)
    result = dequantise(np.round(truth / quantum) * quantum, quantum)
    assert np.std(result - truth) < 0.5 * quantum / np.sqrt(12)


def test_apollo_15(apollo15):
    raw = read_dem(apollo15, cell=2.0, height_scale=49.0, dequantise=False)
    dem = read_dem(apollo15, cell=2.0, height_scale=49.0)
    assert dem.heights.shape == (257, 257) and np.ptp(raw.heights) == pytest.approx(49.0)
    quantum = 49.0 / 255
    assert np.abs(dem.heights - raw.heights).max() <= quantum / 2 + 1e-9

    def level(z):
        return (np.abs(np.diff(z, axis=1)) < 1e-6).mean()

    assert level(raw.heights) > 0.4 and level(dem.heights) < 0.01  # plateaus were 44 % of the ground
    # Relief at 32 m is the data's own, to a part in a thousand.
    far = [np.sqrt(np.mean((z[:, 16:] - z[:, :-16]) ** 2)) for z in (raw.heights, dem.heights)]
    assert far[1] == pytest.approx(far[0], rel=2e-3)


def test_not_a_grid_is_refused():
    for heights in (np.zeros(5), np.zeros((1, 9)), np.full((3, 3), np.nan)):
        with pytest.raises(UserError, match="heights"):
            Dem(heights, 1.0)
    for cell in (0.0, -1.0, float("nan")):
        with pytest.raises(UserError, match="cell"):
            Dem(np.zeros((3, 3)), cell)


def test_planes_stay_planes_across_any_enclosed_holes():
    y, x = np.mgrid[:60, :80]
    plane = 3.0 + 0.2 * x - 0.1 * y
    hole = np.random.default_rng(0).random(plane.shape) < 0.3
    hole[:, [0, -1]] = hole[[0, -1]] = False
    filled, notes = fill_holes(np.where(hole, np.nan, plane), "x.tif")
    np.testing.assert_allclose(filled, plane, atol=1e-9)
    assert f"{int(hole.sum())} of 4800" in notes[0]


def test_a_million_heights_with_a_third_missing_are_filled_within_little_memory():
    """Triangles between the rims took 107 s and, for 3,000 x 3,000, more than 8 GB."""
    truth = fractal(1000, 1000, 1.0, Roughness(0.9, 1.0, 50.0), np.random.default_rng(2))
    hole = np.random.default_rng(3).random(truth.shape) < 0.3
    given = np.where(hole, np.nan, truth)
    tracemalloc.start()
    filled, _ = fill_holes(given, "x.tif")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 110 * truth.size, "1 GB for 3,000 x 3,000"
    assert np.sqrt(np.mean((filled - truth)[hole] ** 2)) < 0.1 * truth.std()


@pytest.mark.slow
def test_nine_million_heights_with_a_third_missing_are_filled_in_ten_seconds_and_a_gigabyte():
    """Seconds of the processor, which a busy machine does not stretch."""
    rng = np.random.default_rng(4)
    truth = np.cumsum(rng.normal(size=(3000, 3000)), axis=0)
    given = np.where(rng.random(truth.shape) < 0.3, np.nan, truth)
    began = time.process_time()
    fill_holes(given, "x.tif")
    assert time.process_time() - began < 10.0
    tracemalloc.start()
    fill_holes(given, "x.tif")
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1e9


@pytest.mark.parametrize("mark", [-9999.0, -99999.0, -32768.0, -32767.0, 32767.0, 9999.0, 99999.0])
def test_usual_marks_of_nodata_are_taken_out_where_they_stand_alone(mark, tmp_path):
    heights = ramp().heights.copy()
    heights[3:5, 4:6] = mark
    np.save(tmp_path / "a.npy", heights)
    dem = read_dem(tmp_path / "a.npy", cell=1.0)
    assert np.ptp(dem.heights) <= np.ptp(ramp().heights)
    assert f"4 cells of {mark:g} taken for nodata, which a.npy does not declare" in dem.notes
    heights = heights - mark + np.linspace(mark - 50.0, mark + 50.0, heights.shape[1])  # a range that holds the mark
    kept, notes = undeclared_nodata(np.where(np.abs(heights - mark) < 0.5, mark, heights), "x")
    assert np.isfinite(kept).all() and not notes


def test_undeclared_marks_of_nodata_are_refused():
    heights = ramp().heights.copy()
    heights[3, 4] = np.finfo(np.float32).min
    with pytest.raises(UserError, match=r"-3\.40282e\+38 m' is no height"):
        Dem(heights, 1.0)


def test_the_user_is_told_of_cells_that_are_taken_for_nodata(tmp_path, run, caplog):
    cells = "1 2 3\n4 -9999 6\n7 8 32767\n"
    head = "ncols 3\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\nNODATA_value -1\n"
    (tmp_path / "a.asc").write_text(head + cells)
    assert run("terrain", "info", tmp_path / "a.asc").status == 0
    assert "a.asc: 1 cells of -9999 taken for nodata" in caplog.text and "a.asc: 2 of 9 nodata cells" in caplog.text
