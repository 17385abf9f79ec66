"""The script of the worked example keeps what is not its own: its record, and other files of its folder."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(FOLDER))
    spec = importlib.util.spec_from_file_location("real_wheel", FOLDER / "real_wheel.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_an_error_leaves_the_record_and_other_files_alone(
    script: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[list[str]] = []

    def fails(command: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        called.append(command)
        return subprocess.CompletedProcess(command, 1)

    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("kept")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["real_wheel.py", "--out", "mine"])
    monkeypatch.setattr(script.subprocess, "run", fails)
    monkeypatch.setattr(script, "RESULT", tmp_path / "record.json")
    monkeypatch.setattr(script, "FIGURE", tmp_path / "figure.svg")
    with pytest.raises(SystemExit) as ended:
        script.main()
    assert ended.value.code == 1 and not (tmp_path / "record.json").exists()
    assert (tmp_path / "mine" / "notes.txt").read_text() == "kept"
    log = Path(called[0][called[0].index("improve") + 1])
    assert log.is_absolute() and (log / "log.toml").is_file()
