"""The rotation of the slow proofs: every file comes first for some commit, none is lost, promises come first."""

from __future__ import annotations

import ast
import json
import math
from pathlib import Path

import pytest

from tests import proofs
from tests.proofs import Turn, in_turn, prove_all, recorded, table, turned

FILES = [f"tests/test_{c}.py" for c in "abcdefg"]
ENTRY = {"ok": True, "passed": 3, "skipped": 1, "seconds": 600, "date": "2026-01-01", "commit": "abc"}


def test_every_file_has_its_turn():
    orders = [turned(FILES, f"{n:010x}") for n in range(40)]
    assert {order[0] for order in orders} == set(FILES)
    assert all(sorted(order) == FILES for order in orders)
    assert turned(FILES, "12ab34cd56+") == turned(FILES, "12ab34cd56")


@pytest.mark.parametrize("known", [0, 3, 7])
def test_files_that_were_never_recorded_come_last(known):
    record = dict.fromkeys(FILES[:known], ENTRY)
    for n in range(20):
        order = in_turn(FILES, record, f"{n:010x}")
        assert sorted(order) == FILES and set(order[:known]) == set(FILES[:known])


def test_only_what_passed_once_can_break_unless_the_whole_is_asked_for():
    record = {FILES[0]: ENTRY}
    assert proofs.broken(FILES[:2], record, whole=False) == FILES[:1]
    assert proofs.broken(FILES[:2], record, whole=True) == FILES[:2]


def test_a_failure_beside_another_file_is_tried_alone_and_a_true_one_stays():
    found = {FILES[0]: {**ENTRY, "ok": False, "commit": "new"}, FILES[1]: {**ENTRY, "ok": False}}
    outcome = {FILES[0]: True, FILES[1]: False}
    assert proofs.again_alone(FILES[:2], found, lambda f: {"ok": outcome[f], "seconds": 5}) == FILES[:1]
    assert found[FILES[0]] == {**ENTRY, "ok": True, "seconds": 5, "commit": "new"}
    assert found[FILES[1]]["ok"] is False


class _Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def _spend(clock: _Clock, seconds: float, outcome: bool | None = True):
    def run(file: str, limit_s: float) -> dict:
        clock.now += min(seconds, limit_s)
        return {**ENTRY, "ok": outcome if seconds <= limit_s else None, "seconds": min(seconds, limit_s)}

    return run


@pytest.mark.parametrize("known", [True, False])
def test_the_time_is_spent_and_kept(tmp_path, monkeypatch, known):
    """Forty minutes: four files of ten minutes whose time is known; where it is not, one more may begin."""
    monkeypatch.setattr(proofs, "FOUND", tmp_path / "proofs.json")
    clock = _Clock()
    turn = Turn(FILES, dict.fromkeys(FILES, ENTRY) if known else {}, 2400.0, clock)
    found = prove_all(turn, 1, "abc", _spend(clock, 590.0))
    assert len(found) == (4 if known else 5) and clock.now <= 1.25 * 2400.0
    assert sorted([*found, *turn.left_out()]) == FILES


def test_what_never_ends_is_stopped_and_is_neither_passed_nor_failed(tmp_path, monkeypatch):
    monkeypatch.setattr(proofs, "FOUND", tmp_path / "proofs.json")
    clock = _Clock()
    found = prove_all(Turn(FILES, {}, 2400.0, clock), 1, "abc", _spend(clock, 1e9))
    assert clock.now == 3000.0 and [entry["ok"] for entry in found.values()] == [None]
    assert recorded({}, found, FILES) == {}


def test_every_recorded_proof_has_its_turn_in_at_least_a_quarter_of_the_runs():
    """With the times that are recorded, two files at a time, whatever file the commit begins with."""
    record = json.loads(proofs.RECORD.read_text(encoding="utf-8"))
    files, runs = sorted(record), dict.fromkeys(record, 0)
    starts = range(0, round(sum(entry["seconds"] for entry in record.values())), 30)
    for start in starts:
        clock = _Clock()
        turn, ends = Turn(turned(files, f"{start:010x}", record), record, 60.0 * 50.0, clock), [0.0, 0.0]
        while (file := turn.next()) is not None:
            runs[file] += 1
            ends.remove(clock.now)
            ends.append(clock.now + record[file]["seconds"])
            clock.now = min(ends)
    assert min(runs.values()) >= len(starts) / 4, min(runs, key=lambda f: runs[f])


def _marks_slow(file: Path) -> bool:
    """Whether code of a file, not a text in it, marks a test slow."""
    text = file.read_text(encoding="utf-8")
    if "mark.slow" not in text:
        return False
    return any(isinstance(n, ast.Attribute) and ast.unparse(n) == "pytest.mark.slow" for n in ast.walk(ast.parse(text)))


NOT_PASSED: set[str] = set()
"""Proofs that fail, each told in docs/guarantees.md; who mends one records it and takes it out here."""


def test_every_file_of_slow_tests_has_passed_once_or_is_told_to_fail():
    """One without a record comes last in every run, which may end before; nobody would miss it."""
    files = {str(p.relative_to(proofs.ROOT)) for p in (proofs.ROOT / "tests").rglob("test_*.py") if _marks_slow(p)}
    record = json.loads(proofs.RECORD.read_text(encoding="utf-8"))
    assert files - set(record) == NOT_PASSED, "python -m tests.proofs --record --only FILE"
    assert set(record) <= files
    unheld = (proofs.ROOT / "docs" / "guarantees.md").read_text(encoding="utf-8").partition("## Not yet held")[2]
    assert all(f"`{file}`" in unheld for file in NOT_PASSED)


def test_all_have_no_limit():
    turn = Turn(FILES, {}, math.inf, _Clock())
    assert [turn.next() for _ in FILES] == FILES and turn.next() is None and math.isinf(turn.until_stop())


@pytest.mark.slow
def test_a_file_is_run_as_a_process_and_stopped_with_its_children(tmp_path, monkeypatch):
    monkeypatch.setattr(proofs, "FOUND", tmp_path / "proofs.json")
    monkeypatch.setattr(proofs, "ROOT", tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = slow: x\n")
    text = "import pytest\n@pytest.mark.slow\ndef test_it():\n    {}\ndef test_fast():\n    assert False\n"
    bodies = {"good": "pass", "bad": "assert False", "hangs": "import threading; threading.Event().wait()"}
    bodies["skips"] = "pytest.skip('not here')"
    for name, body in bodies.items():
        (tmp_path / f"test_{name}.py").write_text(text.format(body))
    assert proofs.slow_files() == []  # not below tests/
    places = {proofs._place(file, "xml") for file in ("tests/a/test_x.py", "tests/a/test_y.py", "tests/b/test_x.py")}
    assert len(places) == 3
    good, bad = (proofs.prove(f"test_{name}.py") for name in ("good", "bad"))
    assert (good["ok"], good["passed"], bad["ok"], bad["passed"]) == (True, 1, False, 0)
    assert proofs.prove("test_hangs.py", limit_s=0.0)["ok"] is None
    skipped = proofs.prove("test_skips.py")
    assert (skipped["ok"], skipped["passed"], skipped["skipped"]) == (None, 0, 1)


def test_what_failed_keeps_the_day_it_last_passed_and_what_is_gone_is_forgotten():
    record = {"a.py": ENTRY, "gone.py": ENTRY}
    new = {**ENTRY, "commit": "new"}
    found = {"a.py": {**new, "ok": False}, "b.py": new}
    assert recorded(record, found, ["a.py", "b.py"]) == {"a.py": ENTRY, "b.py": new}


def test_the_table_names_what_never_passed():
    text = table({"a.py": ENTRY}, ["a.py", "b.py"])
    assert "| `a.py` | 3, 1 | 600 s | 2026-01-01, abc |" in text and "| `b.py` | - | - | not yet recorded |" in text
