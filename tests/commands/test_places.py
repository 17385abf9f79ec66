"""Where commands write: what cannot be written, or holds something else, is refused before any work is done."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from lunar_mjx.commands import options
from lunar_mjx.files import only_writer
from tests.cli_harness import Run
from tests.commands.test_cli_mistakes import STEADY, assert_one_sentence

DRIVE = ("simulate", "--rover", "luvmi_x", "--terrain", "flat", "--duration", "0.1", "--out")
COMMANDS = {
    "simulate": DRIVE,
    "compare": ("compare", "FILES/bed", "--out"),
    "improve": ("improve", "FILES/bed", "--out"),
    "train": ("train", "point", "--steps", "10", "--out"),
    "figures": ("figures", "--only", "slope", "--out"),
}
"""Commands that work for long before they write; the folder follows."""


@pytest.fixture
def line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """The arguments of a command with a folder; none of them may get as far as its work."""
    monkeypatch.setattr("lunar_mjx.commands.diagnosis.keep_compiled", lambda: pytest.fail("it went to work"))
    monkeypatch.setattr("lunar_mjx.commands.app.keep_compiled", lambda: pytest.fail("it went to work"))
    for name, text in STEADY.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(str(text))
    return lambda command, out: (*(a.replace("FILES", str(tmp_path)) for a in COMMANDS[command]), out)


def _dangling(path: Path) -> str:
    path.symlink_to(path.parent / "nowhere")
    return "leads nowhere"


def _loop(path: Path) -> str:
    path.symlink_to(path)
    return "leads nowhere"


def _log(path: Path) -> str:
    path.mkdir()
    (path / "log.toml").write_text("mine")
    return "holds a log (log.toml); name another folder"


@pytest.mark.parametrize("make", [_dangling, _loop, _log])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_is_taken_or_leads_nowhere_is_refused(command, make, line, run: Run, tmp_path):
    out = tmp_path / "out"
    said = make(out)
    assert_one_sentence(run(*line(command, out)), ["--out", str(out), said])
    assert not out.is_dir() or [p.name for p in out.iterdir()] == ["log.toml"]


def test_a_drive_is_not_written_into_a_run(run: Run, tmp_path):
    (tmp_path / "run.json").write_text("mine")
    (tmp_path / "model.toml").write_text("mine")
    assert_one_sentence(run(*DRIVE, tmp_path), ["holds a run of compare (run.json)"])
    assert (tmp_path / "model.toml").read_text() == "mine"


@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_takes_no_file_is_refused(command, line, run: Run, tmp_path, monkeypatch):
    def refuse(dir):
        raise OSError(30, os.strerror(30), str(dir))

    arguments = line(command, tmp_path / "a" / "b")
    monkeypatch.setattr(options.tempfile, "TemporaryFile", refuse)
    assert_one_sentence(run(*arguments), ["--out", f"{tmp_path} takes no file (Read-only file system)"])


@pytest.mark.parametrize("verb", ["why", "next", "unknown"])
def test_a_run_folder_that_takes_no_file_is_refused(verb, line, run: Run, tmp_path, monkeypatch):
    def refuse(dir):
        raise OSError(30, os.strerror(30), str(dir))

    monkeypatch.setattr(options.tempfile, "TemporaryFile", refuse)
    assert_one_sentence(run(verb, tmp_path), [f"RUN = '{tmp_path}' cannot be written", "Read-only file system"])


@pytest.mark.parametrize("words", [("why",), ("next",), ("unknown",), ("compare", "FILES/bed", "--out")])
def test_a_second_command_in_one_run_folder_is_refused(words, run: Run, tmp_path):
    for name, text in STEADY.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(str(text))
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "run.json").write_text("mine")
    with only_writer(folder, ".writing", "command of lunar-mjx"):
        said = run(*(w.replace("FILES", str(tmp_path)) for w in words), folder)
    assert_one_sentence(said, [f"{folder}: another command of lunar-mjx writes there; wait for it, end it, or name"])
    assert (folder / "run.json").read_text() == "mine"


def test_a_folder_that_can_be_made_is_taken_and_nothing_stays_in_it(tmp_path):
    options.check_folder(tmp_path / "a" / "b")
    (tmp_path / "link").symlink_to(tmp_path, target_is_directory=True)
    options.check_folder(tmp_path / "link" / "c")
    (tmp_path / "log.toml").write_text("mine")
    options.check_folder(tmp_path, "log.toml")
    assert {p.name for p in tmp_path.iterdir()} == {"link", "log.toml"}
