"""Steady-state tables: the committed figures, averaging, comparison, refit, and what reading refuses."""

from __future__ import annotations

import dataclasses
import importlib.util
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.criticism import average, fit, load_figures, read_table, replicate_scatter
from lunar_mjx.errors import UserError
from lunar_mjx.wheel_bed.comparison import compare
from lunar_mjx.wheel_bed.soil_fit import Free
from tests.measured_data import measured_file

ROOT = Path(__file__).resolve().parents[2]
PUBLISHED = {"drawbar_pull": 0.80, "side_force": 0.76, "sinkage": 0.65e-3}


@pytest.fixture
def single_runs() -> Path:
    """The 189 runs that the shipped figures are means of."""
    return measured_file(
        "cmu_single_wheel/smooth_wheel_trials.csv",
        "the processed runs of C. Pavlov's 3d-terramechanics, Carnegie Mellon University, MIT",
    )


def test_the_figures_cover_the_campaign(figures):
    assert len(figures) == 63
    assert (figures.replicates == 3).all()
    assert set(figures.measured) == {"drawbar_pull", "side_force", "sinkage"}
    for quantity, sigma in PUBLISHED.items():
        assert figures.sigma[quantity] == pytest.approx(sigma, rel=0.01)
        pooled = np.sqrt(np.mean(replicate_scatter()[quantity] ** 2))
        assert pooled == pytest.approx(figures.sigma[quantity], rel=1e-5)
    assert figures.source["licence"] == "MIT"


def test_the_figures_are_those_of_the_runs(figures, single_runs):
    runs = read_table(single_runs, 0.0625, 0.05, "travel_speed")
    mean = average(runs)
    for quantity, sigma in mean.sigma.items():
        assert sigma == pytest.approx(figures.sigma[quantity], rel=1e-6)
        np.testing.assert_allclose(mean.measured[quantity], figures.measured[quantity], rtol=1e-6)
    for column, values in figures.test.items():
        np.testing.assert_allclose(mean.test[column], values, rtol=1e-6, atol=1e-9)


def test_the_script_writes_what_is_committed(single_runs):
    spec = importlib.util.spec_from_file_location("cmu_figures", ROOT / "benchmarks" / "cmu_figures.py")
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    frame, about = script.figures(single_runs)
    committed = pd.read_csv(script.FOLDER / "cmu_smooth_wheel.csv")
    pd.testing.assert_frame_equal(frame.reset_index(drop=True), committed, check_dtype=False, rtol=1e-5)
    assert about["sigma"]["drawbar_pull_N"] == pytest.approx(0.7991853)


def synthetic(bed, figures):
    """The table that a model would have produced itself."""
    result = bed.run(figures.wheel_test())
    return dataclasses.replace(figures, measured={q: np.asarray(getattr(result, q)) for q in figures.measured})


def test_a_model_agrees_with_its_own_table(consistent, figures):
    own = compare(consistent, synthetic(consistent, figures), "own")
    assert own.overall < 1e-9
    assert own.unreached == 0


def test_the_error_is_in_units_of_the_scatter(consistent, figures):
    table = synthetic(consistent, figures)
    shifted = {q: v.copy() for q, v in table.measured.items()}
    shifted["sinkage"][7] += 5.0 * figures.sigma["sinkage"]
    c = compare(consistent, dataclasses.replace(table, measured=shifted), "shifted")
    worst = c.worst["sinkage"]
    assert worst.residual == pytest.approx(-5.0)
    assert worst.slip_angle_deg == pytest.approx(figures.test["slip_angle_deg"][7])
    assert worst.slip_ratio == pytest.approx(figures.test["slip_ratio"][7])
    assert c.rms["sinkage"] == pytest.approx(5.0 / np.sqrt(63))
    assert c.overall == pytest.approx(5.0 / np.sqrt(3 * 63))
    assert c.rms["drawbar_pull"] < 1e-9


def test_a_fit_recovers_the_soil_that_made_the_table(consistent, figures):
    truth = {"soil": {"k_c": 0.0, "k_phi": 6e5, "n": 0.9, "friction_angle": 0.55}}
    table = synthetic(consistent.with_values(truth), figures)
    free = (
        Free("soil", "k_phi", 1e5, 1e7, log=True),
        Free("soil", "n", 0.5, 1.5),
        Free("soil", "friction_angle", 0.2, 0.8),
    )
    found = fit(consistent, table, free, starts=2)
    assert found.fitted < 1e-4 and found.held_out < 1e-4
    for name, value in found.values["soil"].items():
        assert value == pytest.approx(truth["soil"][name], rel=1e-5)
    assert found.agreeing == 2 and not found.at_bound


HEADER = "slip_ratio,slip_angle_deg,normal_load_N,drawbar_pull_N"
REFUSED = [
    ("", "is not a CSV table"),
    (f"{HEADER}\n", "holds no rows"),
    ("slip_ratio,slip_angle_deg,drawbar_pull_N\n0.1,0,1\n", "column normal_load_N is missing"),
    ("slip_ratio,slip_angle_deg,normal_load_N\n0.1,0,1\n", "nothing measured"),
    ("slip_ratio,slip_angle_deg,normal_load_N,sinkage_mm\n0.1,0,20,1\n", "sinkage_mm' does not have"),
    ("slip_ratio,slip_angle_rad,normal_load_N,sinkage_m\n0.1,0,20,1\n", "slip_angle_rad"),
    (f"{HEADER}\n0.1,0,20,1\n0.2,0,20,nan\n", "line 3, drawbar_pull_N = nan is not a finite number"),
    (f"{HEADER}\n0.1,0,20,inf\n", "line 2, drawbar_pull_N = inf"),
    (f"{HEADER}\n0.1,0,twenty,1\n", "line 2, normal_load_N = 'twenty'"),
    (f"{HEADER}\n0.1,0,-20,1\n", "line 2, normal_load_N = -20.0 is not positive"),
    (f"{HEADER}\n10,0,20,1\n", "slip_ratio = 10.0 is outside"),
    (f"{HEADER}\n0.1,120,20,1\n", "slip_angle_deg = 120.0 is beyond"),
    (f"{HEADER}\n0.1,90,20,1\n", "no slip in the wheel's frame"),
    (f"{HEADER}\n0.1,0,20,1\n0.1,0,20,1\n", "line 3, slip_ratio = 0.1 begins a row that occurs twice"),
    (f"{HEADER},drawbar_pull_N\n0.1,0,20,1,1\n", "occurs twice"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED)
def test_bad_tables_are_refused_by_name(tmp_path, text, message):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(UserError, match=message) as caught:
        read_table(path, 0.0625, 0.05, "wheel_frame")
    assert str(path) in str(caught.value)


def test_other_mistakes_are_told(tmp_path, consistent, figures):
    with pytest.raises(UserError, match="is not there"):
        read_table(tmp_path / "none.csv", 0.0625, 0.05, "wheel_frame")
    path = tmp_path / "table.csv"
    path.write_text(f"{HEADER}\n0.1,0,20,1\n")
    with pytest.raises(UserError, match="slip_definition = 'rim'"):
        read_table(path, 0.0625, 0.05, "rim")
    with pytest.raises(UserError, match=r"radius = -1"):
        read_table(path, -1.0, 0.05, "wheel_frame")
    table = average(read_table(path, 0.0625, 0.05, "wheel_frame"))
    with pytest.raises(UserError, match="no replicate scatter"):
        compare(consistent, table)
    with pytest.raises(UserError, match="does not ship"):
        load_figures("nowhere")
    with pytest.raises(UserError, match="none of the slip angles"):
        fit(consistent, figures.at_angles((15.0,)))
