"""Run folders: written, read back, and refused where the logs have changed."""

from __future__ import annotations

import json

import numpy as np
import pytest

from lunar_mjx.diagnosis.runs import RUN_FILE, Run, load_run, log_folders, plain, save_json
from lunar_mjx.errors import UserError
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
