from __future__ import annotations

import pytest

from lunar_mjx.criticism import SteadyStateTable, WheelBed, load_figures


@pytest.fixture(scope="session")
def figures() -> SteadyStateTable:
    """The measured figures that ship with the package."""
    return load_figures()


@pytest.fixture(scope="session", params=("consistent", "paper"))
def bed(request: pytest.FixtureRequest) -> WheelBed:
    """The wheel of each preset; compiled functions are shared within the session."""
    return WheelBed.of_preset(request.param)


@pytest.fixture(scope="session")
def consistent() -> WheelBed:
    return WheelBed.of_preset("consistent")
