"""A fixed part of the hidden-effect benchmark: every effect that a table can show."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from benchmarks.hidden.bed import effects as bed_effects
from benchmarks.hidden.solve import table_row

SEEDS = (20261, 20262, 20263)
"""One draws 16 parameters, whose median error may lie anywhere from half to twice that of many draws."""


@pytest.fixture(scope="module")
def singles() -> list[dict[str, Any]]:
    return [table_row("singles", n, seed) for seed in SEEDS for n in range(len(bed_effects.KNOWN))]


@pytest.mark.slow
def test_every_single_effect_is_named(singles: list[dict[str, Any]]) -> None:
    missed = [(r["seed"], f"{r['case']}: {r['outcome']}, {r['sentence']}") for r in singles if not r["right"]]
    assert {n for r in singles for n in r["truth"]["effects"]} == set(bed_effects.KNOWN)
    assert not any(r["wrong_name"] for r in singles), missed
    assert all(sum(s == str(seed) for s, _ in missed) <= 1 for seed in SEEDS), missed


@pytest.mark.slow
def test_it_is_fitted_nearly_as_well_as_by_who_was_told(singles: list[dict[str, Any]]) -> None:
    right = [r for r in singles if r["right"]]
    over = [r["over_floor"] for r in right]
    assert np.median(over) <= 1.01 and max(over) <= 1.05
    assert max(r["over_floor"] / r["told"]["over_floor"] for r in right) <= 1.02
    parameters = [p for r in right for p in r["parameters"]]
    assert np.median([p["error"] for p in parameters]) <= 0.05
    assert np.mean([p["covered"] for p in parameters]) >= 0.95
