from __future__ import annotations

from pathlib import Path

import pytest

from lunar_mjx.resources import shipped
from lunar_mjx.rover import Rover, load_rover

NAMES = ("viper", "luvmi_x")


@pytest.fixture(scope="session", params=NAMES)
def rover(request: pytest.FixtureRequest) -> Rover:
    """Each rover that ships with the package."""
    return load_rover(request.param)


@pytest.fixture(scope="session")
def models() -> Path:
    """The folder of shipped rovers."""
    return shipped("models")


@pytest.fixture
def data() -> Path:
    """URDFs written for these tests."""
    return Path(__file__).parent / "data"
