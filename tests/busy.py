"""Runs the fast suite in a machine without idle time: pairs of processors, each shared with eight busy processes.

    python -m tests.busy [--runs 3] [--busy 8] [--workers 2] [--pairs N] [--seed 0] [--out build/busy.json]
                         [-- PYTEST ARGUMENTS]

Two test processes are bound to each pair of processors, as `make test` has two on a machine of two. The busy ones are
bound to the same pair, so that each test process gets about a fifth of a processor. More pairs share the files, and
make it faster, not easier. With more `--workers` each gets less, and the whole is sooner done.
Each run has a random order of its own, from `--seed` on. `--out` gets the runs: what passed, failed and was skipped
with the reasons, seconds, and the share of the processors that the busy processes took.
The exit status is 1 if a test failed or none passed. Linux alone binds processes.
"""

from __future__ import annotations

import argparse
import collections
import importlib.metadata
import json
import os
import platform
import resource
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tests import proofs

ROOT = proofs.ROOT
WORKERS = 2
"""Test processes per pair of processors, if not told otherwise: as `make test` has."""
PAIRS, PER_PAIR = "LUNAR_MJX_BUSY_PAIRS", "LUNAR_MJX_BUSY_WORKERS"
"""Environment variables that tell test processes their pairs (0,1;2,3;...), and how many share one."""
SPIN = "while True: pass"
FAST_COMPILE = {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
"""As the Makefile sets for `make test`."""


def pairs_of(processors: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of processors that share nothing; an odd one is left out."""
    return list(zip(processors[::2], processors[1::2], strict=False))


def pair_of(worker: str, pairs: Sequence[tuple[int, int]], workers: int = WORKERS) -> tuple[int, int]:
    """The pair of a test process named gw0, gw1, ...: as many on each."""
    return pairs[int(worker.removeprefix("gw")) // workers % len(pairs)]


def pytest_configure(config: Any) -> None:
    """Binds a test process to its pair; this module is a plugin of pytest too."""
    if hasattr(config, "workerinput"):
        os.environ.pop("PYTEST_PLUGINS", None)  # no concern of the processes that tests start
        pairs = [tuple(map(int, pair.split(","))) for pair in os.environ[PAIRS].split(";")]
        os.sched_setaffinity(0, pair_of(config.workerinput["workerid"], pairs, int(os.environ[PER_PAIR])))


def outcome(report: Path) -> dict[str, Any]:
    """What a JUnit report tells: counts, names of what failed, reasons of what was skipped, the slowest files."""
    cases = list(ET.parse(report).iter("testcase"))
    failed, skipped, files = [], collections.Counter(), collections.Counter()
    for case in cases:
        files[str(case.get("classname")).split(".Test")[0]] += float(case.get("time", "0"))
        if case.find("failure") is not None or case.find("error") is not None:
            failed.append(f"{case.get('classname')}::{case.get('name')}")
        elif (skip := case.find("skipped")) is not None:
            skipped[str(skip.get("message"))] += 1
    return {
        "passed": len(cases) - len(failed) - sum(skipped.values()),
        "failed": sorted(failed),
        "skipped": dict(sorted(skipped.items())),
        "slowest_files_s": {name: round(seconds) for name, seconds in files.most_common(10)},
    }


def run_once(
    pairs: Sequence[tuple[int, int]], busy: int, seed: int, more: Sequence[str], workers: int = WORKERS
) -> dict[str, Any]:
    """Runs the suite once, `workers` test processes beside `busy` busy ones on each pair; returns what it came to."""
    report = ROOT / "build" / f"busy-{seed}.xml"
    report.parent.mkdir(exist_ok=True)
    report.unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    began = time.monotonic()
    spinning = []
    for pair in pairs:
        for _ in range(busy):
            spinning.append(subprocess.Popen([sys.executable, "-S", "-c", SPIN]))
            os.sched_setaffinity(spinning[-1].pid, pair)
    line = [sys.executable, "-m", "pytest", "-q", "-n", str(workers * len(pairs)), "--dist", "loadfile"]
    line += ["-m", "not slow", "-p", "no:cacheprovider"]
    line += [f"--randomly-seed={seed}", f"--junit-xml={report}", *more]
    environment = {
        **os.environ,
        **FAST_COMPILE,
        "PYTEST_PLUGINS": "tests.busy",
        PAIRS: ";".join(f"{a},{b}" for a, b in pairs),
        PER_PAIR: str(workers),
    }
    try:
        status = subprocess.run(line, cwd=ROOT, env=environment, check=False).returncode
    finally:
        seconds = time.monotonic() - began
        middle = resource.getrusage(resource.RUSAGE_CHILDREN)
        for process in spinning:
            process.kill()
        for process in spinning:
            process.wait()
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    taken = after.ru_utime + after.ru_stime - middle.ru_utime - middle.ru_stime
    tests = middle.ru_utime + middle.ru_stime - before.ru_utime - before.ru_stime
    return {
        "seed": seed,
        "status": status,
        **(outcome(report) if report.is_file() else {"passed": 0, "failed": ["no report"], "skipped": {}}),
        "seconds": round(seconds),
        "processor_s_of_tests": round(tests),
        "share_of_busy_processes": round(taken / (2 * len(pairs) * seconds), 3),
    }


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--busy", type=int, default=8, help="busy processes on each pair of processors")
    parser.add_argument("--workers", type=int, default=WORKERS, help="test processes on each pair of processors")
    parser.add_argument("--pairs", type=int, help="pairs of processors; all that there are if left out")
    parser.add_argument("--seed", type=int, default=0, help="of the first order; each run has the next one")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "busy.json")
    parser.add_argument("--commit", help="where git is not at hand")
    parser.add_argument("more", nargs="*", help="further arguments of pytest")
    args = parser.parse_args()
    pairs = pairs_of(sorted(os.sched_getaffinity(0)))[: args.pairs]
    if not pairs:
        parser.error("two processors are needed")
    found = {
        "commit": args.commit or proofs.commit(),
        "python": platform.python_version(),
        "jax": importlib.metadata.version("jax"),
        "pairs_of_processors": len(pairs),
        "busy_processes_on_each_pair": args.busy,
        "test_processes_on_each_pair": args.workers,
        "runs": [],
    }
    for seed in range(args.seed, args.seed + args.runs):
        found["runs"].append(run_once(pairs, args.busy, seed, args.more, args.workers))
        args.out.parent.mkdir(parents=True, exist_ok=True)
        args.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(found, indent=1))
    return int(any(run["status"] or run["failed"] or not run["passed"] for run in found["runs"]))


if __name__ == "__main__":
    sys.exit(main())
