"""Run folders: written, read back, and refused where the logs have changed."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.criticism import audit, next_experiment, report
from lunar_mjx.diagnosis import verbs
from lunar_mjx.diagnosis.build_problem import known_logs
from lunar_mjx.diagnosis.formulas.discover import discover
from lunar_mjx.diagnosis.runs import (
    COMPARISON_FILE,
    FOUND,
    RUN_FILE,
    VERDICT_FILE,
    Run,
    load_run,
    log_folders,
    plain,
    save_json,
)
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Finding, Noise, write_steady_log
from lunar_mjx.model import make_model


@pytest.fixture
def run(tmp_path) -> Run:
    log = tmp_path / "log"
    log.mkdir()
    (log / "points.csv").write_text("a,b\n1,2\n")
    model = make_model("luvmi_x", terrain="flat").add("slip_sinkage", "test", driving=0.4)
    found = Run(
        tmp_path / "run",
        log_folders([log]),
        model,
        splits={"x": "test"},
        added=("slip_sinkage",),
        seed=7,
        discrepancy={"sinkage": 0.001},
    )
    found.write()
    return found


def test_a_run_comes_back_as_it_was_written(run):
    again = load_run(run.folder)
    assert again.logs == run.logs
    assert (again.splits, again.added, again.seed, again.discrepancy) == (
        run.splits,
        run.added,
        run.seed,
        run.discrepancy,
    )
    assert again.model.effect_names == run.model.effect_names
    assert again.model.parameters["slip_sinkage"]["driving"] == 0.4


def test_a_log_that_changed_is_refused(run):
    (run.logs[0] / "points.csv").write_text("a,b\n1,3\n")
    with pytest.raises(UserError, match="has changed since the comparison"):
        load_run(run.folder)


def test_a_log_that_went_is_refused(run):
    (run.logs[0] / "points.csv").unlink()
    run.logs[0].rmdir()
    with pytest.raises(UserError, match="is missing"):
        load_run(run.folder)


@pytest.mark.parametrize("text", ["{", "[]", '{"format": "other/1"}', '{"format": "lunar-mjx-run/1"}'])
def test_what_is_no_run_is_refused(run, text):
    (run.folder / RUN_FILE).write_text(text)
    with pytest.raises(UserError, match=RUN_FILE):
        load_run(run.folder)


def test_no_folder_is_a_sentence(tmp_path):
    with pytest.raises(UserError, match=r"run\.json"):
        load_run(tmp_path / "nowhere")
    with pytest.raises(UserError, match="does not exist"):
        log_folders([tmp_path / "nowhere"])
    with pytest.raises(UserError, match="no log is given"):
        log_folders([])


@pytest.fixture
def bed(tmp_path) -> Run:
    """A run of a wheel's table, as `compare` leaves it."""
    slip = np.arange(12) * 0.05
    frame = pd.DataFrame({"slip_ratio": slip, "slip_angle_deg": 0.0, "normal_load_N": 60.0})
    frame["drawbar_pull_N"] = 46.0 * slip - 5.0 + 0.7 * (np.arange(12) % 3)
    noise = {"drawbar_pull_N": Noise(1.0, "datasheet")}
    wheel = {"radius_m": 0.1, "width_m": 0.1}
    write_steady_log(tmp_path / "bed", frame, wheel=wheel, slip_definition="wheel_frame", noise=noise)
    model = make_model("luvmi_x", terrain="flat").add("slip_sinkage", "test", driving=0.4)
    found = Run(tmp_path / "run", log_folders([tmp_path / "bed"]), model, added=("slip_sinkage",))
    found.write()
    return found


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            {"splits": {"nowhere": "test"}},
            r"run\.json: splits = 'nowhere=test' names nothing of these logs; use one of",
        ),
        ({"discrepancy": {"lift": 1.0}}, r"run\.json: discrepancy: quantity = 'lift' was not measured; use one of"),
        ({"discrepancy": {"drawbar_pull": 1e12}}, r"run\.json: discrepancy: drawbar_pull = .* is out of range"),
        ({"added": ["warp"]}, r"run\.json: added = 'warp' is no effect; correct its name"),
    ],
)
def test_what_a_run_says_of_other_logs_is_refused_before_anything_is_fitted(bed, change, said, monkeypatch):
    monkeypatch.setattr(verbs, "_problem", lambda *_: pytest.fail("is fitted"))
    assert known_logs(load_run(bed.folder))
    bed.save(RUN_FILE, {**bed.load(RUN_FILE), **change})
    bed.save(VERDICT_FILE, {"verdict": "UNKNOWN", "sentence": "", "effects": [], "port": "wheel_shear"})
    for verb in (
        verbs.why,
        lambda f: verbs.add(f, "bulldozing", bed.folder / "next"),
        next_experiment,
        discover,
        lambda f: audit(f, 1.0),
    ):
        with pytest.raises(UserError, match=said):
            verb(bed.folder)


def test_looks_at_the_test_split_stay_on_record(run):
    run.opened_test("why", {"refitted": "abc"})
    run.write()
    run.opened_test("why", {"refitted": "def"})
    assert [o["fit"] for o in run.load(RUN_FILE)["test_opened"]] == ["abc", "def"]


def test_json_has_no_nan_and_is_whole_or_absent(tmp_path):
    path = tmp_path / "x.json"
    save_json(path, {"a": np.array([1.0, np.nan]), "b": float("inf"), "c": np.int64(3), "d": (1, {2})})
    assert json.loads(path.read_text()) == {"a": [1.0, None], "b": None, "c": 3, "d": [1, [2]]}
    before = path.read_text()
    with pytest.raises(TypeError):
        save_json(path, {"a": object()})
    assert path.read_text() == before
    assert plain({1: np.float32(0.5)}) == {"1": 0.5}


def test_a_new_comparison_leaves_nothing_of_the_one_before(run):
    """Not a verdict, a page or what `watch` has learnt; looks at the test split stay on record."""
    run.opened_test("compare", {"refitted": "0"})
    for name in FOUND:
        (run.folder / name).write_text("of the comparison before")
    (run.folder / "notes.txt").write_text("of the user")
    run.write()
    assert sorted(p.name for p in run.folder.iterdir()) == ["model.toml", "notes.txt", "run.json"]
    assert len(run.load(RUN_FILE)["test_opened"]) == 1


def test_what_was_found_stays_where_a_new_comparison_cannot_be_written(run, monkeypatch):
    (run.folder / COMPARISON_FILE).write_text("the comparison before")

    def full(path, content):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("lunar_mjx.diagnosis.runs.save_json", full)
    with pytest.raises(OSError, match="No space"):
        run.write()
    assert (run.folder / COMPARISON_FILE).read_text() == "the comparison before"


def test_refused_logs_leave_no_comparison_of_others(run, monkeypatch):
    finding = Finding("log", "drive", None, "time_s", "clock", "goes back")
    run.save(COMPARISON_FILE, {"of": "the logs before"})
    run.__dict__["checked"] = ([], [finding])
    with pytest.raises(verbs.BadData, match="goes back"):
        verbs._compare(run, lambda *_: None)
    assert run.load(VERDICT_FILE)["verdict"] == "BAD_DATA"
    assert run.load(COMPARISON_FILE) is None
    assert "goes back" in report([run.folder], run.folder / "page.html").read_text(encoding="utf-8")
