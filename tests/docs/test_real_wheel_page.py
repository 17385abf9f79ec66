"""What the README and the page say of the measured wheel is what the kept run says."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).parents[2]
KEPT = json.loads((ROOT / "benchmarks" / "real_wheel.json").read_text(encoding="utf-8"))


def _numbers(page: Path) -> list[list[str]]:
    """The numbers of every row of a page's tables, without the mark of bold ones."""
    rows = [
        line.strip("| ").split("|")[1:] for line in page.read_text(encoding="utf-8").splitlines() if line[:1] == "|"
    ]
    return [[c.strip(" *") for c in row] for row in rows]


def test_errors_are_those_of_the_run():
    rows = [*KEPT["rows"], KEPT["rows"][-1]["corrected"]]
    page, readme = _numbers(ROOT / "docs" / "real_wheel.md"), _numbers(ROOT / "README.md")
    for row in rows:
        told = [f"{row[k]:.1f}" for k in ("fitted", "inside", "extrapolated", "held_out")]
        assert told in page and told[1:] in readme, told
    for text in (ROOT / "docs" / "real_wheel.md", ROOT / "README.md"):
        assert f"ommit {KEPT['commit'][:7]}" in text.read_text(encoding="utf-8")


def test_probabilities_are_those_of_the_run():
    found = list(KEPT["rows"][1]["probabilities"].values())
    page = _numbers(ROOT / "docs" / "real_wheel.md")
    for value in (*found, 1.0 - sum(found)):
        assert [f"{value:.3f}"] in page, value
