"""Trainings over several devices and processes: they learn alike, and stop, save and fail together."""

from __future__ import annotations

import json
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.agents.train import LOCK
from lunar_mjx.files import only_writer
from tests.agents.point_process import command, free_port, results_of_two, run, run_both, run_two
from tests.cli_harness import MAIN

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def spread() -> dict:
    """Outcome of one process that trains over two virtual devices, to compare two processes with."""
    return run("-", devices=2)


def test_two_devices_learn_like_one(spread):
    one = run("-")
    assert (one["devices"], spread["devices"]) == (1, 2)
    assert spread["digest"] != one["digest"], "other random numbers, so only alike"
    for curve in (one["curve"], spread["curve"]):
        assert np.mean([row[2] for row in curve[-6:]]) > 0.85
        assert np.mean([row[1] for row in curve[-6:]]) > 5.0 + np.mean([row[1] for row in curve[1:3]])
    late = [np.mean([row[1] for row in r["curve"][-8:]]) for r in (one, spread)]
    assert max(late) - min(late) < 0.15 * max(late), "the same learning curve within noise"


def test_two_processes_on_loopback_are_two_devices(spread):
    two, other = results_of_two("-", "--steps", 1600)
    assert two["devices"] == 2
    assert two["digest"] == other["digest"], "both processes hold the same parameters"
    np.testing.assert_allclose(two["curve"], spread["curve"][:2], rtol=0.02)


def test_processes_whose_starts_and_clocks_differ_stop_and_save_together(tmp_path):
    """One that is slower would else go on to the next step, and wait there for the other for ever."""
    first, second = results_of_two(tmp_path, "--skew")
    assert first["digest"] == second["digest"] and first["curve"] == second["curve"]
    assert 2 < len(first["curve"]) < 20, "stopped by the limit of the first process's clock"
    assert _checkpoints(tmp_path)[-1] == len(first["curve"])
    resumed, other = results_of_two(tmp_path, "--skew")
    assert resumed["digest"] == other["digest"] != first["digest"]
    assert resumed["curve"][: len(first["curve"])] == first["curve"]
    assert len(resumed["curve"]) > len(first["curve"])


def test_rovers_in_two_processes_stop_and_save_together(tmp_path):
    first, second = results_of_two(tmp_path, "--skew", "--rover")
    assert first["digest"] == second["digest"]
    assert [row[0] for row in first["curve"]] == [row[0] for row in second["curve"]]
    assert 2 < len(first["curve"]) < 20
    assert _checkpoints(tmp_path)[-1] == len(first["curve"])


def _checkpoints(folder: Path) -> list[int]:
    return sorted(int(p.name) for p in (folder / "checkpoints").glob("*") if p.name.isdigit())


def test_the_command_trains_in_two_processes(tmp_path):
    """The first one writes and prints, and its word ends both when the wanted success is reached."""
    ask = "train point --steps 64000 --set epoch_steps=50 --eval-every 0 --eval-episodes 64 --target 0.5 --quiet"
    both = f"--coordinator 127.0.0.1:{free_port()} --processes 2 -o {tmp_path}"
    lines = [[sys.executable, "-c", MAIN, *f"{ask} {both} --process {i}".split()] for i in (0, 1)]
    first, second = run_both(lines, command()[1], "")
    assert (first.returncode, second.returncode) == (0, 0), first.stderr[-2000:] + second.stderr[-2000:]
    assert "success on unseen ground" in first.stdout
    assert "success" not in second.stdout
    record = json.loads((tmp_path / "curve.json").read_text())
    assert record["device"].startswith("2 x ") and record["finished"]
    assert record["rows"][-1]["unseen_success"] >= 0.5 and record["rows"][-1]["steps"] < 64000


def test_an_error_in_one_process_ends_the_other_with_a_sentence(tmp_path):
    first, second = run_two(tmp_path, "--fail", "callback")
    assert second.returncode == 1 and "RuntimeError: planted" in second.stderr
    assert first.returncode == 1
    assert "process 1 of 2 ended with an error while looking at epoch 3" in first.stderr


def test_a_folder_that_is_taken_ends_both(tmp_path):
    with only_writer(tmp_path, LOCK, "training"):
        first, second = run_two(tmp_path)
    assert first.returncode == second.returncode == 1
    assert "another training writes there" in first.stderr
    assert "process 0 of 2 ended with an error while opening its folder" in second.stderr


def test_a_value_that_is_not_finite_ends_both_and_is_kept(tmp_path):
    first, second = run_two(tmp_path, "--poison", 7)
    for process in (first, second):
        assert process.returncode == 1 and "not_finite.npz" in process.stderr, process.stderr[-2000:]
    assert (tmp_path / "not_finite.npz").is_file()


def test_a_process_that_is_killed_ends_the_other(tmp_path):
    """Nothing can be exchanged with it: JAX ends the others when its heartbeats stay out."""
    first, second = run_two(tmp_path, "--fail", "kill")
    assert second.returncode == -signal.SIGKILL
    assert first.returncode != 0
