"""The rotation of the slow proofs: every file comes first for some commit, none is lost."""

from __future__ import annotations

from tests.proofs import table, turned


def test_every_file_has_its_turn():
    files = [f"tests/test_{c}.py" for c in "abcdefg"]
    orders = [turned(files, f"{n:010x}") for n in range(40)]
    assert {order[0] for order in orders} == set(files)
    assert all(sorted(order) == files for order in orders)
    assert turned(files, "12ab34cd56+") == turned(files, "12ab34cd56")


def test_the_table_names_what_never_passed():
    record = {"a.py": {"ok": True, "passed": 3, "skipped": 1, "seconds": 12, "date": "2026-01-01", "commit": "abc"}}
    text = table(record, ["a.py", "b.py"])
    assert "| `a.py` | 3, 1 | 12 s | 2026-01-01, abc |" in text and "| `b.py` | - | - | not yet recorded |" in text
