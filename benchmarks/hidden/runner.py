"""Runs cases in pieces: what is on disk is done, the seed is drawn once, and a piece ends when its time is up."""

from __future__ import annotations

import concurrent.futures
import datetime
import hashlib
import json
import multiprocessing
import os
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from benchmarks.provenance import checkout

Job = tuple[str, int]
Solve = Callable[..., dict[str, Any]]


def campaign(out: Path, seed: int | None) -> dict[str, Any]:
    """The campaign's seed, drawn from the commit and the time unless it is given or drawn already."""
    path = out.with_suffix(".seed.json")
    head, dirty = checkout()
    if path.is_file():
        data = json.loads(path.read_text(encoding="utf-8"))
        if seed is not None and str(seed) != data["seed"]:
            raise SystemExit(f"{path}: seed {data['seed']} was drawn for these results; name another --out for {seed}.")
        return data
    now = datetime.datetime.now(datetime.UTC)
    drawn = int.from_bytes(hashlib.sha256(f"{head} {now.isoformat()} {time.time_ns()}".encode()).digest()[:7], "big")
    data = {
        "seed": str(drawn if seed is None else seed),
        "given": seed is not None,
        "commit": head,
        "uncommitted_changes": dirty,
        "drawn": now.isoformat(timespec="seconds"),
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    return data


def read_rows(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """Rows of results files, the last of each case; a line cut short by a stop is left out."""
    rows: dict[tuple[str, str, str], dict[str, Any]] = {}
    for path in paths:
        for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() else ():
            try:
                row = json.loads(line)
            except ValueError:
                continue
            rows[row["kind"], row["seed"], row["case"]] = row
    return list(rows.values())


def order(counts: Mapping[str, int]) -> list[Job]:
    """All cases, every group in proportion, so that a part of them is a small copy of the whole."""
    jobs = [
        ((n + 0.5) / count, place, group, n)
        for place, (group, count) in enumerate(counts.items())
        for n in range(count)
    ]
    return [(group, n) for _, _, group, n in sorted(jobs)]


def work(solve: Solve, jobs: Sequence[Job], out: Path, seed: int, minutes: float, workers: int, **options: Any) -> int:
    """Runs jobs until they are done or the time is up; appends a row per case.

    Args:
      solve: makes a row from (group, number, seed, **options). jobs: what is left to do.
      out: JSON lines. seed: of the campaign. minutes: after which nothing new is begun. workers: processes.
      **options: handed to `solve`.

    Returns:
      Number of cases done.
    """
    head, dirty = checkout()
    done = 0
    with out.open("a", encoding="utf-8") as file:
        for row in rows(solve, jobs, seed, minutes, workers, **options):
            row |= {"commit": head, "uncommitted_changes": dirty}
            file.write(json.dumps(_plain(row), allow_nan=False) + "\n")
            file.flush()
            done += 1
            print(
                f"{row['case']:<18} {row['verdict']:<12} {row.get('outcome', ''):<18} "
                f"{', '.join(row.get('named', []))} ({row.get('seconds', 0.0):.0f} s)",
                flush=True,
            )
    return done


def rows(
    solve: Solve, jobs: Sequence[Job], seed: int, minutes: float, workers: int, **options: Any
) -> Iterator[dict[str, Any]]:
    """Rows of jobs as they are done, as `work` writes them."""
    until = time.monotonic() + 60.0 * minutes
    if workers <= 1:
        for job in jobs:
            if time.monotonic() > until:
                return
            yield guarded(solve, *job, seed, options)
        return
    context = multiprocessing.get_context("spawn")
    left = iter(jobs)
    place = context.Value("i", 0)
    with concurrent.futures.ProcessPoolExecutor(workers, context, _pin, (place, workers)) as pool:
        running: set[concurrent.futures.Future[dict[str, Any]]] = set()
        while True:
            while len(running) < workers and time.monotonic() < until and (job := next(left, None)) is not None:
                running.add(pool.submit(guarded, solve, *job, seed, options))
            if not running:
                return
            finished, running = concurrent.futures.wait(running, return_when=concurrent.futures.FIRST_COMPLETED)
            for future in finished:
                yield future.result()


def _pin(place: Any, workers: int) -> None:
    """Gives each process its own share of the cores, so that none starts more threads than it can run."""
    if not hasattr(os, "sched_setaffinity"):
        return
    with place.get_lock():
        mine, place.value = place.value, place.value + 1
    cores = sorted(os.sched_getaffinity(0))
    share = max(1, len(cores) // workers)
    first = mine * share % max(1, len(cores) - share + 1)
    os.sched_setaffinity(0, cores[first : first + share])


def guarded(solve: Solve, group: str, number: int, seed: int, options: Mapping[str, Any]) -> dict[str, Any]:
    """A case's row; where something crashes, a row that counts as wrong and tells what."""
    try:
        return solve(group, number, seed, **options)
    except Exception:
        kind = "drives" if "drive" in solve.__name__ else "tables"
        return {
            "case": f"{group}-{number:03d}",
            "kind": kind,
            "group": group,
            "seed": str(seed),
            "verdict": "CRASH",
            "named": [],
            "truth": {"effects": {}},
            "right": False,
            "outcome": "crash",
            "wrong_name": False,
            "sentence": traceback.format_exc(limit=-4),
            "seconds": 0.0,
        }


def _plain(value: Any) -> Any:
    from lunar_mjx.diagnosis.runs import plain

    return plain(value)
