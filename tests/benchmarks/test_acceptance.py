"""The acceptance proofs of the preset that drives run by default, and the page that tells their numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import checked
from benchmarks.acceptance import PROOFS, prove

FOLDER = Path(checked.__file__).parent


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
@pytest.mark.parametrize("proof", list(PROOFS))
def test_field_is_accepted(proof: str, rover: str) -> None:
    """Each proof within its limit."""
    found = prove((proof, rover))
    assert found["passed"], found


def test_the_page_tells_what_was_measured() -> None:
    """docs/checked.md holds the tables that the kept records give."""
    page = checked.PAGE.read_text(encoding="utf-8")
    for name, make in checked.TABLES.items():
        for file in FOLDER.glob(f"{name}*.json"):
            assert make(json.loads(file.read_text(encoding="utf-8"))) in page, file.name


def test_a_missed_limit_and_a_lacking_gate_are_told() -> None:
    """Rows that fail or have no reference say so."""
    about = {"preset": "field", "commit": "abc", "device": "a GPU"}
    row = {"proof": "parked", "rover": "viper", "value": 2e-3, "limit": 1e-3, "unit": "m", "passed": False}
    row["commit"] = "abc"
    assert "0.002 m (missed) | 0.001 m | abc |" in checked.acceptance({"about": about, "rows": [row]})
    base = {"rover": "viper", "batch": 8, "steps_per_s": 2e6, "finite": True}
    rows = [
        {**base, "program": str(p), "parity": p, "parity_gap": None if p is None else 0.1} for p in (True, False, None)
    ]
    table = checked.programs({"about": about, "rows": rows})
    assert "| True | 2.0 |" in table and "not counted: gap 1.0e-01" in table and "no gate" in table
    assert "not finite" not in table
    lost = checked.programs({"about": about, "rows": [{**rows[2], "finite": False}]})
    assert "2.0 (no gate) (not finite in the end)" in lost
