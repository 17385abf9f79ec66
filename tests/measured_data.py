"""Where measured data lie that the package does not bring along."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

FOLDER = Path(os.environ.get("LUNAR_MJX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))


def measured_file(path: str, what: str) -> Path:
    """Path of a file of measured data; the test is skipped, saying how to get it, where it is not."""
    found = FOLDER / path
    if not found.is_file():
        pytest.skip(f"{path} is not in {FOLDER}: get it ({what}) and set LUNAR_MJX_DATA to the folder above it")
    return found
