"""MJX without its two lines on standard output about the missing optional package warp."""

from __future__ import annotations

import contextlib
import io
import sys
from collections.abc import Iterator

NOTICES = ("Failed to import warp:", "Failed to import mujoco_warp:")


@contextlib.contextmanager
def without_warp_notices() -> Iterator[None]:
    """Holds back standard output, and lets all but the two notices through at the end."""
    held = io.StringIO()
    try:
        with contextlib.redirect_stdout(held):
            yield
    finally:
        for line in held.getvalue().splitlines(keepends=True):
            if not line.startswith(NOTICES):
                sys.stdout.write(line)


with without_warp_notices():
    from mujoco import mjx as mjx
    from mujoco.mjx._src.smooth import solve_m as solve_m  # M^-1 x: not among MJX's public names
