"""`lunar-mjx log`: exit statuses, templates that can be filled, seals that open."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.commands.log import _effect
from lunar_mjx.logs import check, new_log, read_log
from lunar_mjx.logs.recorder import simulate as module
from lunar_mjx.resources import shipped
from tests.cli_harness import Run
from tests.logs.log_files import make_log


def test_check_says_fit_or_bad(run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "campaign" / "good")
    result = run("log", "check", tmp_path / "campaign")
    assert result.status == 0 and "good" in result.out and "fit to be used" in result.out

    def spoil(tables: dict[str, pd.DataFrame]) -> None:
        tables["drive"].loc[9, "time_s"] = 0.0

    make_log(tmp_path / "campaign" / "bad", spoil)
    result = run("log", "check", tmp_path / "campaign")
    assert result.status == 10
    for word in ("BAD_DATA", "drive", "11", "time_s", "clock", "goes back"):
        assert word in result.out
    result = run("log", "check", "--json", tmp_path / "campaign")
    found = json.loads(result.out)
    assert result.status == 10 and found["bad_data"] and found["logs"] == ["bad", "good"]
    assert [(f["log"], f["line"], f["kind"]) for f in found["findings"]] == [("bad", 11, "clock")]


def test_check_tells_many_good_logs_in_one_line(run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "campaign" / "log00")
    for k in range(1, 14):
        shutil.copytree(tmp_path / "campaign" / "log00", tmp_path / "campaign" / f"log{k:02d}")
    result = run("log", "check", tmp_path / "campaign")
    assert result.status == 0 and "14 of 14 logs (all): nothing found" in result.out and "log07" not in result.out

    def spoil(tables: dict[str, pd.DataFrame]) -> None:
        tables["drive"].loc[9, "time_s"] = 0.0

    make_log(tmp_path / "campaign" / "bad", spoil)
    result = run("log", "check", tmp_path / "campaign")
    assert result.status == 10 and "goes back" in result.out
    assert "14 of 15 logs (the others): nothing found" in result.out


def test_check_asks_for_length(run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    assert run("log", "check", tmp_path / "a", "--slowest", "housing_radiation=600").status == 10
    assert run("log", "check", tmp_path / "a", "--slowest", "housing_radiation=6").status == 0


ROVER = 'rover = "luvmi_x"'


@pytest.mark.parametrize(
    ("top", "table", "said"),
    [
        ('rover = "moonbuggy"', "", ["rover = 'moonbuggy' is not there", "name a shipped one"]),
        ('rover = "../gone"', "", ["rover = '../gone' is not there", "rover.toml"]),
        ('rover = "luvmi_x"\nterrain = "sea"', "", ["terrain = 'sea' is not there", "terrain.toml"]),
        ('rover = "luvmi_x"\nterrain = "gone.tif"', "", ["terrain = 'gone.tif' is not there"]),
        ('rover = "luvmi_x"\nterrain = "slope:95deg"', "", ["'slope:95deg'", "below 90"]),
        (ROVER, "[rover_changes]\npayload_kg = 1e9", ["rover_changes.payload_kg = 1000000000.0", "10000 at"]),
        (ROVER, "[rover_changes]\npayload_kg = 251", ["payload_kg = 251.0 is more than 5 times the 50 kg", "250 at"]),
        (ROVER, "[rover_changes]\ncom_offset_m = [0, 9, 0]", ["rover_changes.com_offset_m = 9.0", "1 at most"]),
        (ROVER, "[rover_changes]\nwheel_radius_offset_m = -3", ["wheel_radius_offset_m = -3.0", "-0.05 or"]),
    ],
)
def test_check_refuses_what_is_not_there_and_no_rover_carries(top, table, said, run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    path = tmp_path / "a" / "log.toml"
    text = path.read_text()
    assert run("log", "check", tmp_path / "a").status == 0
    path.write_text(text.replace(ROVER, top) + f"\n{table}\n")
    result = run("log", "check", tmp_path / "a")
    assert result.status == 2 and result.err.count("\n") == 1
    for word in said:
        assert word in result.err, result.err


def test_a_log_may_bring_its_rover_and_ground(run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    shutil.copytree(shipped("models") / "luvmi_x", tmp_path / "a" / "mine")
    (tmp_path / "a" / "ground.toml").write_text("[plane]\n")
    path = tmp_path / "a" / "log.toml"
    path.write_text(path.read_text().replace(ROVER, 'rover = "mine"\nterrain = "ground.toml"'))
    assert run("log", "check", tmp_path / "a", "--slowest", "my_effects.py:heat=6").status == 0


def test_a_template_that_is_filled_is_a_good_log(run: Run, tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    assert run("log", "new", folder, "--rover", "luvmi_x", "--manoeuvre", "stall_heat_soak").status == 0
    assert "command_lf_drive_current_A" in pd.read_csv(folder / "drive.csv").columns
    assert run("log", "check", folder).status == 10, "empty tables are no log"
    rng = np.random.default_rng(0)
    for file, rate in (("drive", 20.0), ("imu", 50.0), ("thermal", 1.0), ("camera", 5.0)):
        header = list(pd.read_csv(folder / f"{file}.csv").columns)
        time = np.arange(0.0, 30.0, 1.0 / rate)
        frame = pd.DataFrame({c: np.zeros(len(time)) for c in header})
        frame["time_s"] = time
        noise = read_log(folder).noise
        for c in header[1:]:
            level = {"accelerometer_z_m_s2": 1.625}.get(c, -20.0 if c.endswith("degC") else 0.0)
            frame[c] = level + (noise[c].std if c in noise else 0.0) * rng.standard_normal(len(time))
        frame.to_csv(folder / f"{file}.csv", index=False)
    assert check(read_log(folder)) == []
    assert run("log", "check", folder).status == 0


def test_a_template_for_every_rover_and_test_bed(run: Run, tmp_path: Path) -> None:
    assert run("log", "new", tmp_path / "steady", "--steady").status == 0
    text = (tmp_path / "steady" / "log.toml").read_text().replace("_m = 0.0", "_m = 0.06", 2)
    (tmp_path / "steady" / "log.toml").write_text(text)
    with (tmp_path / "steady" / "points.csv").open("a") as file:
        file.write("0.1,0,20,0.01,3.0,0.1,0.4,0.012,1\n0.3,0,20,0.01,6.0,0.2,0.6,0.016,1\n")
    assert run("log", "check", tmp_path / "steady").status == 0
    new_log(tmp_path / "viper", "viper", "slope")
    assert 'terrain = "slope:10deg"' in (tmp_path / "viper" / "log.toml").read_text()
    assert read_log(tmp_path / "viper").terrain == "slope:10deg"


MISTAKES = [
    (["log", "check", "nowhere"], ["nowhere", "log.toml"]),
    (["log", "check", "nowhere", "--slowest", "radiation"], ["nowhere"]),
    (["log", "new", ".", "--rover", "no_such_rover"], ["no_such_rover"]),
    (["log", "simulate", "x", "--manoeuvre", "moonwalk"], ["moonwalk"]),
    (["log", "simulate", "x", "--rover", "luvmi_x", "--effect", "no_such"], ["no_such"]),
    (["log", "simulate", "x", "--rover", "luvmi_x", "--effect", "com_offset:x"], ["--effect", "name=number"]),
    (["log", "simulate", "x", "--noise", "loud"], ["--noise", "loud"]),
    (["log", "simulate", "x", "--dropouts", "0.9"], ["dropouts"]),
    (["log", "unseal", "gone.toml", "x"], ["gone.toml", "not there"]),
]


@pytest.mark.parametrize(("arguments", "words"), MISTAKES)
def test_mistakes(arguments: list[str], words: list[str], run: Run, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = run(*arguments)
    assert result.status == 2 and result.err.count("\n") == 1, result
    for word in words:
        assert word in result.err, result.err
    assert not list(tmp_path.iterdir()), "nothing is left behind"


def test_nothing_is_overwritten(run: Run, tmp_path: Path) -> None:
    make_log(tmp_path / "a")
    before = (tmp_path / "a" / "log.toml").read_text()
    result = run("log", "new", tmp_path / "a", "--rover", "luvmi_x")
    assert result.status == 2 and "exists already" in result.err
    assert (tmp_path / "a" / "log.toml").read_text() == before


def test_seal_and_unseal(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    time = np.arange(0.0, 12.0, 0.01)
    names = ("position_x_m", "gyro_z_rad_s", "winding_lf_drive_temperature_degC", "wheel_lf_sinkage_m")
    monkeypatch.setattr(module, "_drive", lambda *_: (time, {n: np.sin(time) for n in names}))
    log = tmp_path / "sealed"
    hidden = ("--effect", "com_offset:x=0.05,y=0.01", "--seal", "--seconds", 12, "--rover", "luvmi_x")
    assert run("log", "simulate", log, *hidden).status == 0
    (tmp_path / "verdict.json").write_text('{"verdict": "KNOWN", "effects": ["com_offset"]}')
    answer = tmp_path / "sealed.answer.toml"
    result = run("log", "unseal", answer, log, "--verdict", tmp_path / "verdict.json")
    assert result.status == 0 and "hidden: com_offset (x = 0.05, y = 0.01" in result.out
    assert "score: right" in result.out
    found = json.loads(run("log", "unseal", answer, log, "--json").out)
    assert found["hidden"] == ["com_offset"]
    (log / "log.toml").write_text((log / "log.toml").read_text().replace("sha256:", "sha256:0"))
    assert run("log", "unseal", answer, log).status == 2


def test_the_list_of_manoeuvres(run: Run) -> None:
    result = run("log", "manoeuvres")
    assert result.status == 0 and "speed_staircase" in result.out and "crab_and_plough" in result.out


@pytest.mark.parametrize(
    ("text", "name", "values"),
    [
        ("iron_loss", "iron_loss", {}),
        ("iron_loss:coefficient=1e-6", "iron_loss", {"coefficient": 1e-6}),
        ("mine.py:churn", "mine.py:churn", {}),
        ("a folder/mine.py:churn:amount=8,speed=0.5", "a folder/mine.py:churn", {"amount": 8.0, "speed": 0.5}),
    ],
)
def test_a_hidden_effect_may_be_a_users_own_with_values(text: str, name: str, values: dict[str, float]) -> None:
    assert _effect(text) == (name, values)
