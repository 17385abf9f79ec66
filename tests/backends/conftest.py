"""Recordings shared by these tests, and one JAX compilation for all of them."""

from __future__ import annotations

import pytest
from backends_recorded import Recorded

from lunar_mjx.backends.parity import compare as parity


@pytest.fixture(scope="session")
def luvmi() -> Recorded:
    return Recorded("luvmi_x", "consistent", grounds=("flat, soft", "slope, hard", "crater, soft"))


@pytest.fixture(scope="session")
def structured(luvmi: Recorded) -> parity.JaxRunner:
    return parity.JaxRunner("structured", luvmi.model)
