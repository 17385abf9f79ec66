"""The shapes and types that annotations state are those of the values."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.slow
def test_values_are_what_the_annotations_say(tmp_path: Path) -> None:
    script = Path(__file__).with_name("annotated_run.py")
    run = subprocess.run([sys.executable, str(script), str(tmp_path)], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr[-3000:]
    assert run.stdout.endswith("checked\n")
