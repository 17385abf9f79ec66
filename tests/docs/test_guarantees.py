"""Every promise of docs/guarantees.md and SECURITY.md names tests that are there, and says which of them are slow."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
UNHELD = {"no test needs another before it", "the tests of `make test` end within thirteen minutes on two idle cores"}
"""Promises about the whole suite, which its own runs hold."""


def rows(page: str) -> list[list[str]]:
    """Cells of every row of the page's tables, without heads."""
    lines = (ROOT / page).read_text(encoding="utf-8").splitlines()
    cells = [[c.strip() for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines if line.startswith("|")]
    rule = [i for i, row in enumerate(cells) if set("".join(row)) <= set("- :")]
    return [row for i, row in enumerate(cells) if i not in rule and i + 1 not in rule]


ROWS = [(page, row) for page in ("docs/guarantees.md", "SECURITY.md") for row in rows(page)]


def named(cell: str) -> list[Path]:
    """Files and folders of a cell; a bare file name stands in the folder of the one before it."""
    found: list[Path] = []
    for name in re.findall(r"`([\w./]+?(?:\.py|/))`", cell):
        found.append(ROOT / name if "/" in name else found[-1].with_name(name))
    return found


@pytest.mark.parametrize(("page", "row"), ROWS, ids=[row[0][:60] for _, row in ROWS])
def test_a_promise_names_its_test(page: str, row: list[str]) -> None:
    files = named(row[-1])
    module = re.match(r"`python -m (tests\.\w+)", row[-1])
    if module:
        files.append(ROOT / (module[1].replace(".", "/") + ".py"))
    assert files or any(row[0].startswith(promise) for promise in UNHELD), f"{page}: {row[0]} names no test"
    for file in files:
        assert file.exists(), f"{page}: {row[0]}: {file} is not there"
    texts = [file.read_text(encoding="utf-8") for file in files if file.is_file()]
    if "(*slow*)" in row[-1]:
        assert all("mark.slow" in text for text in texts), f"{page}: {row[0]} is not slow"
    else:
        assert not any("pytestmark = pytest.mark.slow" in text for text in texts), f"{page}: {row[0]} is slow"


def test_rows_are_found() -> None:
    assert len(ROWS) > 50
