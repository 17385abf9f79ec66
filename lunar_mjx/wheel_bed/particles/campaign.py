"""A table of particle runs: planned, computed in batches, kept line by line so that it goes on where it was left."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import appending
from lunar_mjx.wheel_bed.particles.results import VARIANTS, steady, variant_numerics
from lunar_mjx.wheel_bed.particles.sand_box import SandBoxes, open_device
from lunar_mjx.wheel_bed.particles.settings import BedRun, Numerics, ParticleWheel, Point, Sand, layout, work

RUNS_FILE = "runs.jsonl"
MOST_PARTICLES = {"cpu": 1, "cuda": 4_000_000}
"""Particles that are computed together: one box on a processor, where boxes gain nothing, and what a GPU of 80 GB holds
with room to spare (choice)."""

_ALIKE = 1.3
"""Largest ratio of the lengths of runs that are computed together: the shorter ones wait for the longest."""

Progress = Callable[[str, float], None]


def plan(
    wheel: ParticleWheel, sand: Sand, gravity: float, points: Sequence[Point], numerics: Numerics, controls: int = 4
) -> list[BedRun]:
    """All runs of a table: each point, and some of them again with each of `VARIANTS`.

    Args:
      controls: number of points that are varied, spread evenly over the list.

    Returns:
      The runs in the order in which they are to be computed: those that tell the error come after the table.
    """
    if not 0 <= controls <= len(points):
        raise bad_input("particles", "--controls", controls, "is out of range", f"give 0 to {len(points)}")
    table = [BedRun(wheel, sand, gravity, p, numerics) for p in points]
    layout(table)  # refuses voxels that do not show the wheel
    # Middles of equal parts of the list, so that neither its first nor its last point stands for all.
    chosen = np.unique(np.round((np.arange(controls) + 0.5) * len(points) / max(controls, 1) - 0.5).astype(int))
    varied = [
        dataclasses.replace(table[i], numerics=variant_numerics(numerics, v), variant=v)
        for v in VARIANTS
        for i in chosen
    ]
    return table + varied


def read_plan(data: Sequence[dict[str, Any]]) -> list[BedRun]:
    """Runs from plain data: `BedRun.inputs()` of each, and its `variant`."""
    return [
        BedRun(
            ParticleWheel(**d["wheel"]),
            Sand(**d["sand"]),
            d["gravity"],
            Point(**d["point"]),
            Numerics(**d["numerics"]),
            d["variant"],
        )
        for d in data
    ]


def missing(runs: Sequence[BedRun], folder: Path) -> list[BedRun]:
    """Runs whose results a folder does not hold."""
    # By key and not by line number: a plan may have grown since.
    have = {r["key"] for r in read_results(folder)}
    return [r for r in runs if r.key not in have]


def batches(runs: Sequence[BedRun], most_particles: int) -> list[list[BedRun]]:
    """Runs that are computed together: same setting, alike in length, `most_particles` at most where there are two."""
    out: list[list[BedRun]] = []
    groups: dict[Any, list[BedRun]] = {}
    for r in runs:
        groups.setdefault(_setting(r), []).append(r)
    for group in groups.values():
        # By length, so that neighbours in the list end together.
        for r in sorted(group, key=lambda r: r.steps):
            last = out[-1] if out else None
            alike = last and _setting(last[0]) == _setting(r) and r.steps <= _ALIKE * last[0].steps
            if last and alike and layout([*last, r]).particles * (len(last) + 1) <= most_particles:
                last.append(r)
            else:
                out.append([r])
    return out


def _setting(run: BedRun) -> tuple[Any, ...]:
    """What runs of one batch share."""
    return run.wheel, run.sand, run.gravity, run.numerics


def read_results(folder: Path) -> list[dict[str, Any]]:
    """Results kept in a folder; none where nothing is kept. A last line that is cut off is left out."""
    path = folder / RUNS_FILE
    if not path.exists():
        return []
    out = []
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines, 1):
        try:
            out.append(json.loads(line))
        except json.JSONDecodeError as error:
            # The process was killed while it wrote this line; the run is computed again.
            if number == len(lines):
                break
            raise bad_input(path, f"line {number}", line[:40], "is no result", "remove the line") from error
    return out


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a campaign has: results of the planned runs, how many are left, seconds spent, and why it ended early."""

    results: list[dict[str, Any]]
    left: int
    seconds: float
    stopped: str = ""


def compute(
    runs: Sequence[BedRun],
    folder: Path,
    device: str = "auto",
    seconds: float = float("inf"),
    most_particles: int | None = None,
    progress: Progress | None = None,
    each_batch: Callable[[list[dict[str, Any]]], None] | None = None,
) -> Outcome:
    """Computes the runs that a folder does not hold yet, and appends each batch's results to it.

    Args:
      runs: of `plan`.
      folder: must exist; holds `RUNS_FILE`.
      device: auto, cpu or cuda.
      seconds: no batch is begun that would not end by then, and one that does not is given up.
      most_particles: computed together; by the device if None.
      progress: called with what is done and its share of the whole.
      each_batch: called with all results after each batch.

    Raises:
      UserError: see `open_device`; a run became infinite.
    """
    begun = time.perf_counter()
    wanted = {r.key for r in runs}
    results = [r for r in read_results(folder) if r["key"] in wanted]
    new_runs = missing(runs, folder)
    name = open_device(device) if new_runs else "cpu"
    todo = batches(new_runs, most_particles or MOST_PARTICLES[name.split(":")[0]])
    # Planned work, not the number of batches: points of high slip take many times as long.
    share = np.array([work(batch) for batch in todo])
    share = share / share.sum() if len(share) else share
    rate = None  # seconds for the whole, as the last batch tells
    stopped = ""
    for number, batch in enumerate(todo):
        spent = time.perf_counter() - begun
        # Not begun rather than cut off: a batch that is cut off is lost whole.
        if spent >= seconds or (rate is not None and spent + rate * share[number] > seconds):
            stopped = "time limit"
            break
        start = time.perf_counter()
        what = f"batch {number + 1} of {len(todo)}: {len(batch)} runs"

        def going_on(done: float, what: str = what, number: int = number) -> bool:
            if progress is not None:
                progress(what, float(share[:number].sum() + done * share[number]))
            return time.perf_counter() - begun < seconds

        boxes = SandBoxes(batch, name)
        set_up = time.perf_counter() - start
        try:
            series = boxes.run(going_on)
        except FloatingPointError as error:
            raise UserError(
                f"particles: {error} (slip ratio {batch[0].point.slip_ratio:g}, load {batch[0].point.load:g} N); "
                "give a smaller --step-share or --voxel."
            ) from error
        if series is None:
            stopped = "time limit, within a batch that is lost"
            break
        took = time.perf_counter() - start
        # From the last batch alone: the first one also compiled.
        rate = took / share[number]
        new = [
            {
                "key": r.key,
                "variant": r.variant,
                **r.inputs(),
                **steady(r, s),
                "device": name,
                "seconds": took / len(batch),
                "set_up_seconds": set_up / len(batch),
                "wheel_seconds": s.time[-1],
                "together": len(batch),
            }
            for r, s in zip(batch, series, strict=True)
        ]
        # After each batch, since hours lie between them.
        with appending(folder / RUNS_FILE) as path, path.open("a", encoding="utf-8") as file:
            file.writelines(json.dumps(entry) + "\n" for entry in new)
        results += new
        if each_batch is not None:
            each_batch(results)
    left = len(wanted) - len({r["key"] for r in results})
    return Outcome(results, left, time.perf_counter() - begun, stopped)
