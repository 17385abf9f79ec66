"""The suite beside busy processes: test processes are bound to their pair, and the summary tells what failed."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from tests import busy

TESTS = """
import os
import pytest

def test_bound():
    assert os.sched_getaffinity(0) == {set!r}
    assert "PYTEST_PLUGINS" not in os.environ

@pytest.mark.slow
def test_slow():
    assert False

def test_bad():
    assert False

def test_skipped():
    pytest.skip("not here")
"""


def test_pairs_share_nothing_and_have_two_test_processes_each() -> None:
    pairs = busy.pairs_of([0, 1, 2, 5, 7])
    assert pairs == [(0, 1), (2, 5)]
    assert [busy.pair_of(f"gw{i}", pairs) for i in range(4)] == [(0, 1), (0, 1), (2, 5), (2, 5)]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux binds processes")
def test_a_run_tells_what_passed_failed_and_was_skipped(tmp_path: Path, monkeypatch) -> None:
    pairs = busy.pairs_of(sorted(os.sched_getaffinity(0)))[:1]
    if not pairs:
        pytest.skip("one processor only")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow: x\n")
    (tmp_path / "test_it.py").write_text(TESTS.format(set=set(pairs[0])))
    monkeypatch.setenv("PYTHONPATH", str(busy.ROOT) + os.pathsep + os.environ.get("PYTHONPATH", ""))
    monkeypatch.setattr(busy, "ROOT", tmp_path)
    # No plugins but those that a run needs: others take seconds to import in each of three processes.
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    found = busy.run_once(pairs, 1, 7, ["-p", "xdist", "-p", "randomly"])
    assert (found["passed"], found["failed"], found["status"]) == (1, ["test_it::test_bad"], 1)
    assert list(found["skipped"]) == ["not here"] and found["seed"] == 7
    assert 0.0 < found["share_of_busy_processes"] <= 1.0


@pytest.mark.parametrize(
    ("run", "status"),
    [
        ({"passed": 1, "failed": [], "status": 0}, 0),
        ({"passed": 1, "failed": ["test_it::test_bad"], "status": 1}, 1),
        ({"passed": 0, "failed": [], "status": 0}, 1),
        ({"passed": 1, "failed": [], "status": 3}, 1),
    ],
)
def test_only_a_run_that_passed_whole_ends_without_an_error(run, status, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(busy, "pairs_of", lambda processors: [(0, 1)])
    monkeypatch.setattr(busy, "run_once", lambda *_: run)
    out = tmp_path / "busy.json"
    monkeypatch.setattr(sys, "argv", ["busy", "--runs", "2", "--commit", "abc", "--out", str(out)])
    assert busy.main() == status
    assert json.loads(out.read_text())["runs"] == [run, run]
