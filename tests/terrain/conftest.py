"""Shared fixtures: where measured data lie, and small terrains."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def apollo15() -> Path:
    """The LROC NAC terrain model of the Apollo 15 site: 257 x 257 at 2 m, 8 bits for 49 m."""
    folder = Path(os.environ.get("LUNAR_MJX_DATA", ROOT.parent / "shared" / "data"))
    path = folder / "terrain_apollo15" / "NAC_DTM_APOLLO15_257x257.png"
    if not path.is_file():
        pytest.skip(f"{path.name} is not in {folder}; set LUNAR_MJX_DATA to the folder of measured data")
    return path
