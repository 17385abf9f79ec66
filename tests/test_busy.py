"""The suite beside busy processes: test processes are bound to their pair, and the summary tells what failed."""

from __future__ import annotations

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
    assert {good}

def test_skipped():
    pytest.skip("not here")
"""


def test_pairs_share_nothing_and_have_two_test_processes_each() -> None:
    pairs = busy.pairs_of([0, 1, 2, 5, 7])
    assert pairs == [(0, 1), (2, 5)]
    assert [busy.pair_of(f"gw{i}", pairs) for i in range(4)] == [(0, 1), (0, 1), (2, 5), (2, 5)]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux binds processes")
@pytest.mark.parametrize("good", [True, False])
def test_a_run_tells_what_passed_failed_and_was_skipped(good: bool, tmp_path: Path, monkeypatch) -> None:
    pairs = busy.pairs_of(sorted(os.sched_getaffinity(0)))[:1]
    if not pairs:
        pytest.skip("one processor only")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow: x\n")
    (tmp_path / "test_it.py").write_text(TESTS.format(set=set(pairs[0]), good=good))
    monkeypatch.setenv("PYTHONPATH", str(busy.ROOT) + os.pathsep + os.environ.get("PYTHONPATH", ""))
    monkeypatch.setattr(busy, "ROOT", tmp_path)
    found = busy.run_once(pairs, 1, 7, [])
    assert found["passed"] == 1 + good and found["status"] == int(not good)
    assert found["failed"] == ([] if good else ["test_it::test_bad"])
    assert list(found["skipped"]) == ["not here"] and found["seed"] == 7
    assert 0.0 < found["share_of_busy_processes"] <= 1.0
