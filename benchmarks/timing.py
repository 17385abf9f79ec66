"""What the benchmarks share: a lock under which one run at a time is timed, and a batch over several devices."""

from __future__ import annotations

import contextlib
import fcntl
import platform
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


def cpu_name() -> str:
    """Model of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    return next((line.partition(":")[2].strip() for line in lines if line.startswith("model name")), platform.machine())
