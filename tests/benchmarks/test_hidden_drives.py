"""A fixed part of the hidden-effect benchmark: short drives, asked about three effects."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.hidden import drives
from lunar_mjx.criticism import Verdict, compare, read_campaign, why
from lunar_mjx.model import make_model

SEED = 20261
SHORT = drives.MANOEUVRES[:3]
ASKED = ("coulomb_friction", "iron_loss", "rolling_resistance")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "number", "verdict", "named"),
    [("nulls", 0, Verdict.NOISE_ONLY, ()), ("singles", 2, Verdict.KNOWN, ("iron_loss",))],
)
def test_short_drives_are_answered(
    tmp_path: Path, group: str, number: int, verdict: Verdict, named: tuple[str, ...]
) -> None:
    """Three drives of 10 s on the plain."""
    drives.generate(group, number, SEED, tmp_path, SHORT)
    logs = sorted((tmp_path / "logs" / f"{group}-{number:03d}").iterdir())
    model = make_model(read_campaign(logs)[0].rover, terrain="flat")
    found = why(compare(logs, model, tmp_path / "run"), ASKED)
    assert (found.verdict, found.effects) == (verdict, named)
