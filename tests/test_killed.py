"""Commands that are killed at any file operation leave whole files, and go through when they are given again."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.diagnosis.test_verbs_table import FEW, write_table

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[1]


def _command(folder: Path, at: int | str, *arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "tests.killed_run", str(folder), str(at), *map(str, arguments)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run(line, cwd=folder, env=env, capture_output=True, text=True, check=False)


def _contents(folder: Path) -> dict[str, bytes]:
    """Files by name, without those that a killed process was still writing beside their place."""
    found = (p for p in folder.rglob("*") if p.is_file() and not p.name.startswith("."))
    return {str(p.relative_to(folder)): p.read_bytes() for p in found}


def _touches(done: subprocess.CompletedProcess[str]) -> int:
    return int(done.stdout.splitlines()[-1])


def _sizes(files: dict[str, bytes]) -> list[str]:
    """Sizes at which a kill tears a file, for `killed_run`: its first byte, its middle and its last byte."""
    return [f"{size}b" for size in sorted({s for data in files.values() for s in (0, len(data) // 2, len(data) - 1)})]


def _places(count: int, kills: int) -> list[int]:
    """Numbers of touches, from the first to the last one."""
    return sorted({round(n) for n in np.linspace(1, count, kills)})


SHORT = ("simulate", "--rover", "luvmi_x", "--terrain", "flat", "--duration", "0.1")
COMMANDS = {
    "simulate": ((*SHORT, "--drive", "0.4", "-o", "drive"), (*SHORT, "--drive", "0.2", "-o", "drive")),
    "terrain": (
        ("terrain", "export", "lunar_plain", "mesh.stl", "--seed", "1"),
        ("terrain", "export", "lunar_plain", "mesh.stl", "--seed", "2"),
    ),
}
"""What wrote the old files, and what is killed while it writes the new ones."""


@pytest.mark.parametrize("name", COMMANDS)
def test_a_killed_command_leaves_every_file_old_or_new(name, tmp_path):
    first, second = COMMANDS[name]
    old, new = tmp_path / "old", tmp_path / "new"
    old.mkdir()
    assert _command(old, 0, *first).returncode == 0
    shutil.copytree(old, new)
    done = _command(new, 0, *second)
    assert done.returncode == 0
    before, after = _contents(old), _contents(new)
    assert before.keys() == after.keys() and any(before[k] != after[k] for k in before)
    places = _places(_touches(done), 5)
    assert len(places) == min(5, _touches(done)) >= 3, "a mesh alone is opened, renamed and looked for"
    # Between two touches a file is written: a kill there tears what is written in place.
    largest = max(after.values(), key=len)
    for at in (*places, *_sizes({"largest": largest})):
        folder = tmp_path / f"killed{at}"
        shutil.copytree(old, folder)
        assert _command(folder, at, *second).returncode in (-signal.SIGKILL, -signal.SIGXFSZ)
        left = _contents(folder)
        assert left.keys() == before.keys()
        torn = [k for k in left if left[k] not in (before[k], after[k])]
        assert not torn, (at, torn)
        assert _command(folder, 0, *second).returncode == 0
        assert _contents(folder) == after


def _require_whole(folder: Path) -> None:
    """Every JSON file and archive is read as a whole."""
    for path in (p for p in folder.rglob("*") if not p.name.startswith(".")):
        if path.suffix == ".json":
            json.loads(path.read_bytes())
        elif path.suffix == ".npz":
            with np.load(path) as archive:
                assert all(archive[name] is not None for name in archive.files)


@pytest.fixture(scope="module")
def compared(tmp_path_factory) -> Path:
    """A folder with a small table in which an effect is hidden, and its comparison."""
    folder = tmp_path_factory.mktemp("why")
    write_table(folder / "log", 0.4)
    assert _command(folder, 0, "compare", folder / "log", "-o", "run").returncode == 0
    return folder


def test_why_that_is_killed_ten_times_ends_alike(compared, tmp_path):
    whole, broken = tmp_path / "whole", tmp_path / "broken"
    ask = ("why", "run", *(f"--only={name}" for name in FEW))
    shutil.copytree(compared, whole)
    done = _command(whole, 0, *ask)
    wanted = _contents(whole)
    verdict = json.loads(wanted["run/verdict.json"])
    assert done.returncode == verdict["exit_status"] == 20 and verdict["effects"] == ["slip_sinkage"]
    shutil.copytree(compared, broken)
    places = _places(_touches(done), 10)
    assert len(places) == 10
    for at in places:
        killed = _command(broken, at, *ask)
        if killed.returncode == verdict["exit_status"]:  # what was kept spared it the touch that it was to die at
            shutil.rmtree(broken)
            shutil.copytree(compared, broken)
            killed = _command(broken, at, *ask)
        assert killed.returncode == -signal.SIGKILL, killed.stderr[-2000:]
        _require_whole(broken)
    # In the midst of files, too, of which the verdict is written last.
    for at in _sizes({n: wanted[n] for n in ("run/verdict.json", "run/signatures.npz")}):
        shutil.rmtree(broken)
        shutil.copytree(compared, broken)
        assert _command(broken, at, *ask).returncode == -signal.SIGXFSZ, at
        _require_whole(broken)
    assert _command(broken, 0, *ask).returncode == verdict["exit_status"]
    assert json.loads(_contents(broken)["run/verdict.json"]) == verdict
