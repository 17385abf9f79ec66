"""Shared fixtures: measured terrain."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.measured_data import measured_file


@pytest.fixture
def apollo15() -> Path:
    """The LROC NAC terrain model of the Apollo 15 site: 257 x 257 at 2 m, 8 bits for 49 m."""
    return measured_file(
        "terrain_apollo15/NAC_DTM_APOLLO15_257x257.png",
        "the LROC NAC terrain model of the Apollo 15 site in github.com/osrf/gazebo_models, CC BY 3.0",
    )
