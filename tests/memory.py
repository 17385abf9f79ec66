"""Memory of a test process: JAX keeps every program that it has compiled, which over a suite come to gigabytes."""

from __future__ import annotations

import ctypes
import gc
import re
import sys
from pathlib import Path

import jax

MOST_HELD = 2.5e9
"""Bytes that a test process may hold when a file of tests has ended; beyond it gives its programs back."""


def held() -> int:
    """Bytes of this process in memory; 0 where no kernel tells."""
    status = Path("/proc/self/status")
    found = re.search(r"VmRSS:\s+(\d+) kB", status.read_text()) if status.is_file() else None
    return 1024 * int(found[1]) if found else 0


def give_back(beyond: float = MOST_HELD) -> None:
    """Forgets every program that JAX has compiled, if this process holds more than so many bytes.

    Functions stay what they are: who calls one again compiles it again.
    """
    if held() <= beyond:
        return
    jax.clear_caches()
    gc.collect()
    if sys.platform == "linux":
        # glibc keeps what is freed between blocks still in use.
        ctypes.CDLL(None).malloc_trim(0)
