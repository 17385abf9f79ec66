"""Received files run no code unless the user trusts them, and say whose code it would be."""

from __future__ import annotations

import ast
import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx import trust
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.policy import load_policy, save_policy
from lunar_mjx.diagnosis.folder.stored import read_arrays
from lunar_mjx.diagnosis.report import write_report
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.runs import FORMAT, RUN_FILE, load_run
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.resources import shipped
from lunar_mjx.terrain import load_terrain

REFUSED = r"is Python code that would run on this machine; read .*mine\.py, and if you know whose it is add --trust"


@pytest.fixture(autouse=True)
def nothing_named_yet(monkeypatch):
    monkeypatch.setattr(trust, "_VOUCHED", set())


@pytest.fixture
def mine(tmp_path) -> Path:
    """An effect and an environment whose file leaves a mark when it runs."""
    path = tmp_path / "mine.py"
    path.write_text(
        f"open({str(tmp_path / 'it ran')!r}, 'w').close()\n"
        "from lunar_mjx.effects import effect\n"
        "@effect('motor_torque')\n"
        "def mine(ctx, p, x, torque):\n"
        '    """Nothing: for a test."""\n'
        "    return torque\n"
        "from lunar_mjx.envs import PointEnv as make_env\n"
    )
    return path


def _ran(mine: Path) -> bool:
    mark = mine.parent / "it ran"
    found = mark.exists()
    mark.unlink(missing_ok=True)
    return found


def _model(mine: Path) -> Path:
    path = save_model(make_model("luvmi_x", "flat"), mine.parent / "model.toml")
    text = path.read_text().replace("effect_list = [", 'effect_list = [\n    "mine.py:mine",')
    assert "mine.py" in text
    path.write_text(text)
    return path


def test_a_model_file(mine, run):
    path = _model(mine)
    with pytest.raises(UserError, match=r"model\.toml: effect_list = '.*mine\.py:mine' " + REFUSED):
        load_model(path)
    refused = run("simulate", "--model", path, "--out", mine.parent / "out")
    assert refused.status == 2 and "add --trust" in refused.err and not _ran(mine)
    with trust.trusting():
        assert "mine" in load_model(path).effect_names
    assert _ran(mine)


def test_the_option_is_taken_before_and_behind_the_command(mine, run, tmp_path):
    for line in (("--trust", "simulate", "--duration", -1), ("simulate", "--duration", -1, "--trust")):
        result = run(*line, "--model", _model(mine), "--out", tmp_path / "out")
        assert result.status == 2 and "duration" in result.err and _ran(mine)
    assert "--trust" in run("--help").out


def test_what_the_user_names_himself_runs(mine):
    path = _model(mine)
    catalogue.get(f"{mine}:mine")
    assert "mine" in load_model(path).effect_names and _ran(mine)


def _run_folder(mine: Path, candidates: list[str], model: Path) -> Path:
    folder = mine.parent / "run1"
    folder.mkdir(exist_ok=True)
    shutil.copy(model, folder / "model.toml")
    text = {
        "format": FORMAT,
        "logs": [],
        "hashes": {},
        "candidates": candidates,
        "splits": {},
        "added": [],
        "parent": None,
        "seed": 0,
        "version": "0.1.0",
        "discrepancy": {},
        "test_opened": [],
    }
    (folder / RUN_FILE).write_text(json.dumps(text))
    return folder


def test_a_run_folder(mine, run, tmp_path):
    plain = save_model(make_model("luvmi_x", "flat"), tmp_path / "plain.toml")
    by_candidate = _run_folder(mine, [f"{mine}:mine"], plain)
    with pytest.raises(UserError, match=r"run\.json: candidates = .*" + REFUSED):
        load_run(by_candidate)
    shutil.copy(mine, tmp_path / "run1" / "mine.py")
    by_model = _run_folder(mine, [], _model(mine))
    with pytest.raises(UserError, match=REFUSED):
        load_run(by_model)
    for verb in ("why", "next", "unknown"):
        result = run(verb, by_model)
        assert result.status == 2 and "add --trust" in result.err, verb
    write_report([by_model], tmp_path / "report.html")
    assert run("report", by_model, "--trust", "-o", tmp_path / "report.html").status == 0
    assert not _ran(mine), "a report runs nothing, trusted or not"
    with trust.trusting():
        # What of a page asks for the model depends on what was found; here nothing was.
        assert read_result(by_model).model is None and not _ran(mine)
        assert "mine" in load_run(by_model).model.effect_names


def test_a_policy(mine, run, tmp_path):
    policy = load_policy(shipped("models") / "luvmi_x" / "policy.npz")
    policy.environment.update(name=f"{mine}:make_env", options={})
    path = save_policy(policy, tmp_path / "policy.npz")
    with pytest.raises(UserError, match=r"policy\.npz: environment\.name = .*" + REFUSED):
        open_agent(str(path))
    for verb in ("evaluate", "play"):
        result = run(verb, path)
        assert result.status == 2 and "add --trust" in result.err, verb
    assert not _ran(mine)
    with trust.trusting(), pytest.raises(UserError, match="do not fit the environment's"):
        open_agent(str(path))
    assert _ran(mine)


class _Mark:
    """Leaves a file where it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


@pytest.mark.parametrize("name", ["record", "mean"])
def test_arrays_with_pickles_run_nothing(name, tmp_path):
    path, mark = tmp_path / "policy.npz", tmp_path / "it ran"
    whole = dict(np.load(shipped("models") / "luvmi_x" / "policy.npz"))
    np.savez(path, **{**whole, name: np.array([_Mark(mark)], dtype=object)})
    with pytest.raises(UserError, match="is no policy"):
        load_policy(path)
    assert not mark.exists()


READERS = {
    "arrays of a run": read_arrays,
    "a map of soils": lambda path: load_terrain({"surface": SURFACE, "soil": {"grids": {"file": str(path)}}}),
}
SURFACE = {"width": 4.0, "height": 4.0, "cell": 0.5}


@pytest.mark.parametrize("name", READERS)
def test_archives_with_pickles_run_nothing(name, tmp_path):
    path, mark = tmp_path / "received.npz", tmp_path / "it ran"
    np.savez(path, k_phi=np.array([[_Mark(mark)]], dtype=object), cell=np.array(1.0))
    with pytest.raises(UserError, match="pickle"):
        READERS[name](path)
    assert not mark.exists()


UNPICKLES = {"pickle", "cPickle", "cloudpickle", "dill", "joblib", "shelve", "marshal", "torch"}
"""Modules that run code of whoever wrote what they read."""


def test_no_reader_of_the_package_takes_pickles():
    """By the source, so that a reader that is added later is held to it, too."""
    package, found = Path(trust.__file__).parent, []
    for path in sorted(package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = {a.name for a in node.names} if isinstance(node, ast.Import) else set()
            names |= {node.module or ""} if isinstance(node, ast.ImportFrom) else set()
            taken = isinstance(node, ast.keyword) and node.arg == "allow_pickle"
            if (taken and ast.unparse(node.value) != "False") or {n.partition(".")[0] for n in names} & UNPICKLES:
                found.append(f"{path.relative_to(package)}: {ast.unparse(node)}")
    assert found == []
