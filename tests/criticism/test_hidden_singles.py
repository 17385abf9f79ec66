"""A fixed part of the hidden-effect benchmark: every effect that a table can show, and short drives."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.hidden import bed_effects, drives
from benchmarks.hidden.solve import table_row
from lunar_mjx.criticism import Verdict, compare, read_campaign, why
from lunar_mjx.model import make_model

SEED = 20261
SHORT = drives.MANOEUVRES[:3]
ASKED = ("coulomb_friction", "iron_loss", "rolling_resistance")


@pytest.fixture(scope="module")
def singles() -> list[dict[str, Any]]:
    return [table_row("singles", n, SEED) for n in range(len(bed_effects.KNOWN))]


@pytest.mark.slow
def test_every_single_effect_is_named(singles: list[dict[str, Any]]) -> None:
    missed = [f"{r['case']}: {r['outcome']}, {r['sentence']}" for r in singles if not r["right"]]
    assert {n for r in singles for n in r["truth"]["effects"]} == set(bed_effects.KNOWN)
    assert not any(r["wrong_name"] for r in singles), missed
    assert len(missed) <= 1, missed


@pytest.mark.slow
def test_it_is_fitted_nearly_as_well_as_by_who_was_told(singles: list[dict[str, Any]]) -> None:
    right = [r for r in singles if r["right"]]
    over = [r["over_floor"] for r in right]
    assert np.median(over) <= 1.01 and max(over) <= 1.05
    assert max(r["over_floor"] / r["told"]["over_floor"] for r in right) <= 1.02
    assert np.median([p["error"] for r in right for p in r["parameters"]]) <= 0.05


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "number", "verdict", "named"),
    [("nulls", 0, Verdict.NOISE_ONLY, ()), ("singles", 2, Verdict.KNOWN, ("iron_loss",))],
)
def test_short_drives_are_answered(tmp_path: Path, group: str, number: int, verdict: Verdict, named: Any) -> None:
    """Three drives on the plain, asked about three effects."""
    drives.generate(group, number, SEED, tmp_path, SHORT)
    logs = sorted((tmp_path / "logs" / f"{group}-{number:03d}").iterdir())
    model = make_model(read_campaign(logs)[0].rover, terrain="flat")
    found = why(compare(logs, model, tmp_path / "run"), ASKED)
    assert (found.verdict, found.effects) == (verdict, named)
