"""The gate on steady-state tables: good ones pass, the measured wheel too; spoilt ones are told by row and column."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.criticism import load_figures
from lunar_mjx.logs import Noise, SteadyLog, check, read_log, write_steady_log
from lunar_mjx.logs.findings import is_bad

STD = {"drawbar_pull_N": 0.8, "side_force_N": 0.8, "sinkage_m": 6e-4}


def points(seed: int = 0) -> pd.DataFrame:
    """Three replicates of seven slips at two slip angles, with the scatter that `STD` states."""
    rng = np.random.default_rng(seed)
    rows = []
    for angle in (0.0, 30.0):
        for slip in np.linspace(-0.3, 0.6, 7):
            for trial in range(3):
                rows.append(
                    {
                        "slip_ratio": slip,
                        "slip_angle_deg": angle,
                        "normal_load_N": 20.0 + 0.1 * rng.random(),
                        "drawbar_pull_N": 12.0 * np.tanh(3.0 * slip) - 2.0,
                        "side_force_N": 0.2 * angle,
                        "sinkage_m": 0.01 + 0.02 * abs(slip),
                        "trial": trial + 1,
                    }
                )
    frame = pd.DataFrame(rows)
    for column, std in STD.items():
        frame[column] += std * rng.standard_normal(len(frame))
    return frame


def make(folder: Path, frame: pd.DataFrame, scale: float = 1.0) -> SteadyLog:
    noise = {c: Noise(scale * s, "replicate") for c, s in STD.items() if c in frame}
    write_steady_log(
        folder, frame, wheel={"radius_m": 0.0625, "width_m": 0.05}, slip_definition="travel_speed", noise=noise
    )
    log = read_log(folder)
    assert isinstance(log, SteadyLog)
    return log


@pytest.mark.parametrize("seed", range(10))
def test_good_tables_pass(seed: int, tmp_path: Path) -> None:
    assert check(make(tmp_path / "a", points(seed))) == []


def test_replicates_that_agree_in_few_digits_are_no_copies(tmp_path: Path) -> None:
    agreeing = 0
    for seed in range(5):
        frame = points(seed)
        for column, std in STD.items():
            frame[column] = 1.5 * std * np.round(frame[column] / (1.5 * std))
        agreeing += int(frame.duplicated(list(STD)).sum())
        assert not is_bad(check(make(tmp_path / str(seed), frame)))
    assert agreeing > 0


def test_two_replicates_of_a_short_table_may_agree_where_no_others_do(tmp_path: Path) -> None:
    agreeing = 0
    for seed in range(40):
        frame = points(seed)[lambda f: f["slip_angle_deg"] == 0.0].iloc[:9]
        for column, std in STD.items():
            frame[column] = std * np.round(frame[column] / std)
        copies = int(frame.duplicated(list(STD)).sum())
        if copies == 1:
            agreeing += 1
            assert not [f for f in check(make(tmp_path / str(seed), frame)) if f.kind == "copy"]
    assert agreeing > 0


def test_a_quantity_whose_noise_nobody_knows_is_told(tmp_path: Path) -> None:
    once = points(0)[lambda f: f["trial"] == 1].drop(columns="trial")
    frame = once.assign(driving_torque_Nm=0.1 + 0.2 * once["slip_ratio"])
    (finding,) = check(make(tmp_path / "once", frame))
    assert finding.column == "driving_torque_Nm" and "[noise.driving_torque_Nm]" in finding.message
    assert is_bad([finding])


def test_the_measured_wheel_passes(tmp_path: Path) -> None:
    figures = load_figures()
    frame = pd.DataFrame(
        {
            **figures.test,
            "drawbar_pull_N": figures.measured["drawbar_pull"],
            "side_force_N": figures.measured["side_force"],
            "sinkage_m": figures.measured["sinkage"],
        }
    )
    assert not is_bad(check(make(tmp_path / "a", frame)))


def cell(column: str, row: int, value: float) -> Callable[[pd.DataFrame], pd.DataFrame]:
    def change(frame: pd.DataFrame) -> pd.DataFrame:
        frame = frame.copy()
        frame.loc[row, column] = value
        return frame

    return change


CASES: dict[str, tuple[Callable[[pd.DataFrame], pd.DataFrame], str, str, int | None]] = {
    "load not positive": (cell("normal_load_N", 4, 0.0), "range", "normal_load_N", 6),
    "slip in percent": (lambda f: f.assign(slip_ratio=100.0 * f.slip_ratio), "range", "slip_ratio", 2),
    "copied row": (lambda f: pd.concat([f, f.iloc[[5]]], ignore_index=True), "copy", "", 44),
    "drawbar's sign": (lambda f: f.assign(drawbar_pull_N=-f.drawbar_pull_N), "frame", "drawbar_pull_N", None),
    "sinkage's sign": (lambda f: f.assign(sinkage_m=-f.sinkage_m), "frame", "sinkage_m", None),
    "sinkage in mm": (lambda f: f.assign(sinkage_m=1000.0 * f.sinkage_m), "range", "sinkage_m", 2),
    "forces in mN": (lambda f: f.assign(drawbar_pull_N=1000.0 * f.drawbar_pull_N), "unit", "drawbar_pull_N", None),
    "forces swapped": (
        lambda f: f.assign(drawbar_pull_N=0.0 * f.drawbar_pull_N + f.side_force_N, side_force_N=f.drawbar_pull_N),
        "frame",
        "side_force_N",
        None,
    ),
    "pull cut off": (
        lambda f: f.assign(drawbar_pull_N=f.drawbar_pull_N.clip(upper=5.0)),
        "saturation",
        "drawbar_pull_N",
        None,
    ),
    "unit": (lambda f: f.rename(columns={"sinkage_m": "sinkage_degC"}), "unit", "sinkage_degC", None),
    "text": (lambda f: f.astype(object).pipe(cell("drawbar_pull_N", 3, "strong")), "number", "drawbar_pull_N", 5),
    "gap in what was imposed": (cell("slip_angle_deg", 7, float("nan")), "gap", "slip_angle_deg", 9),
}


@pytest.mark.parametrize("case", CASES)
def test_a_spoilt_table_is_told(case: str, tmp_path: Path) -> None:
    change, kind, column, line = CASES[case]
    found = check(make(tmp_path / "a", change(points())))
    matching = [f for f in found if f.severity == "bad_data" and f.column == column and f.kind == kind]
    assert matching, [(f.where, f.kind, f.message) for f in found]
    assert line is None or matching[0].line == line, matching[0]


@pytest.mark.parametrize("scale", [0.3, 4.0])
def test_replicates_contradict_the_stated_noise(scale: float, tmp_path: Path) -> None:
    found = check(make(tmp_path / "a", points(), scale))
    assert {f.column for f in found} == set(STD) and all(f.kind == "noise" for f in found)
    ratio = float(found[0].message.split("scatter ")[1].split()[0])
    assert ratio * scale == pytest.approx(1.0, rel=0.4)


def test_noise_that_grows_with_its_quantity_is_rarely_a_wrong_statement(tmp_path: Path) -> None:
    refused = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        frame = points(seed)
        size = np.geomspace(0.02, 10.0, 14)[frame.groupby(["slip_angle_deg", "slip_ratio"]).ngroup()]
        frame["drawbar_pull_N"] += STD["drawbar_pull_N"] * size * rng.standard_normal(len(frame))
        refused += is_bad(check(make(tmp_path / str(seed), frame)))
    # Fourteen points tell their median scatter to a fifth: one table in fifty is refused by chance (20,000 draws).
    assert refused <= 2


def test_a_gap_in_what_was_measured_is_left_out(tmp_path: Path) -> None:
    log = make(tmp_path / "a", cell("sinkage_m", 7, float("nan"))(points()))
    assert len(log.table) == 41 and 7 not in log.rows
    found = check(log)
    assert [f.severity for f in found] == ["warning"] and not is_bad(found)


def test_a_table_without_a_usable_row(tmp_path: Path) -> None:
    found = check(make(tmp_path / "a", points().assign(normal_load_N=-1.0)))
    assert is_bad(found) and {"range", "dropout"} == {f.kind for f in found}
