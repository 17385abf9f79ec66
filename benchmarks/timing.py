"""What the benchmarks share: a lock under which one run at a time is timed, and a batch over several devices."""

from __future__ import annotations

import contextlib
import fcntl
import os
import platform
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

LOCK: list[Path] = []
"""File that is locked while a row is timed, if any."""


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Waits until no other run with the same lock times a row."""
    with contextlib.ExitStack() as stack:
        for path in LOCK:
            held = stack.enter_context(path.open("w"))
            fcntl.flock(held, fcntl.LOCK_EX)
        yield


def sharded(function: Callable[[Any], Any], state: Any, devices: list[Any]) -> tuple[Callable[[Any], Any], Any]:
    """`function` and its state with the batch split over devices."""
    if len(devices) == 1:
        return function, state
    automatic = (jax.sharding.AxisType.Auto,)
    mesh = jax.make_mesh((len(devices),), ("batch",), axis_types=automatic, devices=devices)
    split = jax.sharding.PartitionSpec("batch")
    state = jax.device_put(state, jax.sharding.NamedSharding(mesh, split))
    return jax.shard_map(function, mesh=mesh, in_specs=split, out_specs=split, check_vma=False), state


def commit() -> str:
    """Commit of the checkout, with "+" where files differ from it."""
    root = Path(__file__).parent
    head = subprocess.run(["git", "rev-parse", "--short", "HEAD"], cwd=root, capture_output=True, text=True, check=True)
    changed = subprocess.run(["git", "diff", "--quiet", "HEAD"], cwd=root).returncode
    return head.stdout.strip() + ("+" if changed else "")


def tree() -> str:
    """Git's hash of the package as it lies there: `git rev-parse COMMIT:lunar_mjx` gives it where nothing differs.

    A machine to which only files are copied may stand at another commit.
    """
    root = Path(__file__).parents[1]
    with tempfile.TemporaryDirectory() as folder:
        about = {
            "cwd": root,
            "env": {**os.environ, "GIT_INDEX_FILE": f"{folder}/index", "GIT_OBJECT_DIRECTORY": folder},
            "check": True,
        }
        subprocess.run(["git", "add", "lunar_mjx"], **about)
        return subprocess.run(
            ["git", "write-tree", "--prefix=lunar_mjx/"], **about, capture_output=True, text=True
        ).stdout.strip()


def cpu_name() -> str:
    """Model of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
