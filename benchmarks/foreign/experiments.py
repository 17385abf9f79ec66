"""Experiments in a loop: does the measurement that `next` asks for resolve what a table leaves open?

    python -m benchmarks.foreign experiments --set tune --tables 60 --minutes 60 -o build/foreign/experiments

A table with something hidden is asked about. Where the verdict leaves a class, or nothing sure, `next` is asked what to
measure; that sweep is measured in the same world, on the same bed with the same errors, and `compare` and `why` are
asked about both tables. Up to two further sweeps are measured: chosen by `next`, at random among what `next` ranked,
and by D-optimality, the sweep that tells most about all constants of the world's own law. `experiments.jsonl` has a row
for each case and choice; rows that are there are not measured again.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import shutil
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from . import bed, cases, pool, sweep, told, work
from .cases import Case, generator
from .score import judge, said
from .sets import campaign
from .wheel import Rows

ROWS = "experiments.jsonl"
CHOICES = ("next", "random", "d_optimal")
FURTHER = 2
"""Sweeps beyond the first table at most."""
OPEN = ("KNOWN_CLASS", "UNDECIDABLE")
"""Verdicts that leave something open which another measurement may tell."""
SLIPS = np.linspace(-0.3, 0.8, 12)
RUNS = 3
"""What `next` says that a planned sweep is: twelve slip ratios, three runs each."""
PLAN = re.compile(r"slip sweep at (?P<angle>[-\d.]+) deg slip angle, (?P<load>[\d.e+-]+) N(?P<more>, measuring .*)?$")
WORDS = {"drawbar pull": "drawbar_pull", "side force": "side_force", "torque": "driving_torque", "sinkage": "sinkage"}


def sweep_of(case: Case, name: str, number: int) -> Case:
    """The case with the sweep that a plan's name describes in place of its table.

    Raises:
      ValueError: the name describes no sweep.
    """
    found = PLAN.match(name)
    if found is None:
        raise ValueError(f"{name}: describes no sweep of slips.")
    first, count = case.rows[0], len(SLIPS)
    more = tuple(q for words, q in WORDS.items() if words in (found["more"] or ""))
    rows = Rows(
        SLIPS,
        np.full(count, np.radians(float(found["angle"]))),
        np.full(count, float(found["load"])),
        np.full(count, float(np.median(first.travel))),
        np.full(count, first.gravity[0]),
    )
    measured = tuple(dict.fromkeys([*case.measured, *more]))
    return dataclasses.replace(case, name=f"{case.name}-{number}", rows=(rows,), replicates=RUNS, measured=measured)


def informative(case: Case, done: Sequence[Case], names: Sequence[str]) -> str:
    """Of some plans, the one after which the determinant of the information about the law's constants is largest."""
    constants, std = told._start(case.world)

    def slopes(one: Case) -> np.ndarray:
        parts = []
        for rows in one.rows:
            ways = [
                bed.readings(told._moved(case.world, constants, sign * 0.02 * step), rows, case.errors)
                for step in np.diag(std)
                for sign in (1.0, -1.0)
            ]
            for q in one.measured:
                by = np.stack([(ways[2 * k][q] - ways[2 * k + 1][q]) / 0.04 for k in range(len(std))], axis=1)
                parts.append(np.sqrt(one.replicates) * by / case.errors.std[q])
        return np.concatenate(parts)

    def information(one: Case) -> np.ndarray:
        by = slopes(one)
        return by.T @ by

    known = np.eye(len(std)) + sum(information(c) for c in done)
    gain = {n: float(np.linalg.slogdet(known + information(sweep_of(case, n, 0)))[1]) for n in names}
    return max(gain, key=lambda n: gain[n])


def chosen(choice: str, case: Case, done: Sequence[Case], names: Sequence[str]) -> str:
    """The plan that a choice takes of those that `next` has ranked, the best first."""
    if choice == "next":
        return names[0]
    if choice == "random":
        return str(generator(case.seed, case.name, "experiment", len(done)).choice(list(names)))
    return informative(case, done, names)


def ask(case: Case, folder: Path) -> tuple[dict[str, Any], list[str]]:
    """What is said of the tables so far, and the plans for another, by `check`, `compare`, `why` and `next`."""
    shutil.rmtree(folder / "run", ignore_errors=True)
    answer = work.one(folder / "logs", folder)
    path = folder / "run" / "verdict.json"
    verdict = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    what = said(answer, verdict)
    plans = work.plans(folder / "run") if what["verdict"] in OPEN else []
    return {**what, **judge(cases.summary(case), what)}, [p for p in plans if PLAN.match(p)]


def resolved(row: dict[str, Any]) -> bool:
    """Whether what is hidden is named, it alone and surely."""
    return bool(row["found"]) and row["verdict"] in ("KNOWN", "MULTIPLE")


def follow(case: Case, choices: Sequence[str]) -> list[dict[str, Any]]:
    """One case: its first answer, and where that leaves something open a row for each choice of further sweeps."""
    folder = Path(tempfile.mkdtemp(prefix="experiments-"))
    try:
        bed.write(case, folder / "logs" / "0")
        first, plans = ask(case, folder)
        about = {"case": case.name, "hidden": list(case.hidden), "law": case.world.law, "first": _short(first)}
        if first["verdict"] not in OPEN or not plans:
            return [{**about, "choice": None, "steps": []}]
        rows = []
        for choice in choices:
            steps, done, names = [], [case], plans
            while names and len(steps) < FURTHER:
                name = chosen(choice, case, done, names)
                done.append(sweep_of(case, name, len(done)))
                bed.write(done[-1], folder / "logs" / str(len(done) - 1))
                answer, names = ask(case, folder)
                steps.append({"sweep": name, **_short(answer)})
            for k in range(1, len(done)):
                shutil.rmtree(folder / "logs" / str(k))
            rows.append({**about, "choice": choice, "steps": steps})
        return rows
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _short(row: dict[str, Any]) -> dict[str, Any]:
    kept = {k: row[k] for k in ("verdict", "effects", "unlisted", "ports", "found", "wrong_name")}
    return {**kept, "resolved": resolved(row)}


def text(rows: Sequence[dict[str, Any]]) -> str:
    """Counts by choice."""
    followed = [r for r in rows if r["choice"]]
    lines = [f"{len({r['case'] for r in rows})} tables, {len({r['case'] for r in followed})} left something open"]
    for choice in CHOICES:
        mine = [r for r in followed if r["choice"] == choice]
        within = [sum(any(s["resolved"] for s in r["steps"][:k]) for r in mine) for k in range(1, FURTHER + 1)]
        wrong = sum(any(s["wrong_name"] for s in r["steps"]) for r in mine)
        of = f"of {len(mine)} resolved within one sweep {within[0]}, within two {within[1]}; a wrong name in {wrong}"
        lines.append(f"{choice:<10} {of}")
    return "\n".join(lines)


_HOW: list[Any] = []


def _begin(choices: tuple[str, ...], limit_s: float) -> None:
    _HOW[:] = [choices, limit_s]
    pool.silent()


def _follow(job: tuple[str, int, int, str, tuple[str, ...]]) -> list[dict[str, Any]]:
    choices, limit_s = _HOW
    try:
        with pool.limit(limit_s):
            return follow(cases.draw(*job), choices)
    except pool.TooLong:
        raise TimeoutError(f"longer than {limit_s:.0f} s") from None


def experiments(args: argparse.Namespace) -> None:
    """Follows cases with something hidden until the time is up."""
    until = time.monotonic() + 60.0 * args.minutes
    args.out.mkdir(parents=True, exist_ok=True)
    seed = int(campaign(args.out, args.set, args.seed)["seed"])
    path = args.out / ROWS
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    have = {r["case"] for r in rows}
    todo = [
        (args.set, seed, number, group, hidden)
        for number, (group, hidden) in enumerate(cases.plan(args.set, args.tables))
        if group in ("single", "pair") and f"{args.set}-{number:03d}" not in have
    ]
    pool.prepare()
    processes = pool.Pool(args.processes, _begin, tuple(args.choice or CHOICES), args.limit)
    try:
        for _, error in processes.answers(sweep.compile_law, sweep.LAWS.split(","), until):
            if error:
                print(f"not compiled: {error}", flush=True)
        for job, found in processes.answers(_follow, todo, until):
            name = f"{job[0]}-{job[2]:03d} {', '.join(job[4])}"
            if isinstance(found, BaseException):
                print(f"{name}: {type(found).__name__} {found}", flush=True)
                continue
            rows += found
            with path.open("a", encoding="utf-8") as file:
                file.writelines(json.dumps(r) + "\n" for r in found)
            print(f"{name}: {found[0]['first']['verdict']}", flush=True)
    finally:
        processes.end()
    print(text(rows))
