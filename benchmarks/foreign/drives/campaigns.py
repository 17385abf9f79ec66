"""Makes, asks and scores campaigns of drives at once, on as many cores as there are, until the time is up.

    python -m benchmarks.foreign drives --set report --drives 24 --minutes 9 -o build/foreign/report_drives

One process per core, or several for each GPU, takes campaign after campaign: it draws the world, drives it in plain
MuJoCo, asks the tool by its own verbs, and hands back one row. Rows lie in `rows.jsonl` and whole verdicts in
`verdicts.jsonl`, one a line, so that what a machine that is taken away had answered is kept; a second call goes on.
Before, every process compiles a part of the programs of one rover into the cache that all share.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import multiprocessing
import os
import time
import traceback
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from .. import pool, work
from ..score import judge, said
from ..sets import campaign
from ..sweep import KEPT, ROWS, score_rows
from . import cases
from .rollout import simulate
from .rovers import ROVERS
from .told import make as make_told
from .told import separable, separable_blind

VERDICTS = "verdicts.jsonl"
LEAST_SECONDS = 300.0
"""s that must be left for a campaign to be begun: in less the tool has not refitted what it would name (a campaign of
LUVMI-X took 100 s of a core to compare and 250 s for signatures and the first two refits)."""
WRITING = 15.0
"""s before the end by which an answer is asked for."""
Job = tuple[str, int, int, str, tuple[str, ...], str]
"""Set, seed, number, group, what is hidden, rover."""


def jobs(which: str, seed: int, count: int) -> list[Job]:
    """All campaigns in the order of the plan."""
    plan = cases.plan(which, count, [r for r in ROVERS if (work.ROOT / "models" / r).is_dir()])
    return [(which, seed, n, group, hidden, rover) for n, (group, hidden, rover) in enumerate(plan)]


def make(job: Job, folder: Path) -> dict[str, Any] | None:
    """The sealed truth of a campaign that was drawn, driven and written to a folder; None where it is there already."""
    case = cases.draw(*job)
    sealed = folder / "truth" / f"{case.name}.json"
    if sealed.is_file():
        return None
    found, stands_out = make_told(case)
    cases.write(case, found, folder / "logs" / case.name)
    truth = cases.summary(case) | {"separable": stands_out, "twins": []}
    sealed.parent.mkdir(parents=True, exist_ok=True)
    sealed.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
    return truth


def make_all(args: argparse.Namespace) -> None:
    """Writes logs and sealed truths of all campaigns of a set; goes on where it was stopped."""
    args.out.mkdir(parents=True, exist_ok=True)
    seed = int(campaign(args.out, args.set, args.seed)["seed"])
    for job in jobs(args.set, seed, args.drives):
        if truth := make(job, args.out):
            sigma = ", ".join(f"{k} {v['sigma']:.0f} sigma" for k, v in truth["separable"].items())
            about = f"{job[3]:<8} {job[5]:<8} {truth['law']:<9}"
            print(f"{_name(job)}  {about} {sigma or 'nothing hidden'}", flush=True)


def tell(args: argparse.Namespace) -> None:
    """Writes how far what is hidden in campaigns stands out, `told.json` in a set's folder, a row as soon as known."""
    folder: Path = args.out
    folder.mkdir(parents=True, exist_ok=True)
    every = jobs(args.set, int(campaign(folder, args.set, args.seed)["seed"]), args.drives)
    only = args.only or range(len(every))
    if wrong := [n for n in only if not 0 <= n < len(every)]:
        raise SystemExit(f"--only {wrong[0]}: the set has campaigns 0 to {len(every) - 1}; give numbers of these.")
    path = folder / "told.json"
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else []
    for number in only:
        case = cases.draw(*every[number])
        if not case.hidden:
            continue
        truth = simulate(case.rover, case.world, case.setups, cases.SECONDS)
        blind = separable_blind(case, truth)
        row = {"case": case.name, "rover": case.rover.name, "law": case.world.law, "hidden": list(case.hidden)}
        row |= {"sigma": separable(case, truth), "sigma_blind": blind.pop(""), "sigma_if_known": blind}
        rows = [*(r for r in rows if r["case"] != case.name), row]
        path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
        print(f"{case.name}  {case.hidden[0]}: {row['sigma']:.0f} ({row['sigma_blind']:.0f}) sigma", flush=True)
    print(f"written to {path}" if rows else "Nothing is hidden in these campaigns.")


def compile_part(job: Job, folder: Path, part: int, of: int) -> None:
    """Compiles one of so many parts of the programs that a diagnosis of a rover's drives needs, into the cache."""
    import numpy as np

    from lunar_mjx.commands.compiled import keep_compiled
    from lunar_mjx.diagnosis.drives.form import DriveForm
    from lunar_mjx.diagnosis.drives.loop import build_drives
    from lunar_mjx.diagnosis.runs import Run, log_folders
    from lunar_mjx.logs import Log
    from lunar_mjx.model import make_model

    keep_compiled()
    logs = log_folders([folder / "logs" / _name(job)])
    run = Run(folder / "programs" / f"{job[5]}-{part}", logs, make_model(job[5], terrain="flat", preset="consistent"))
    form = build_drives(run, [log for log in run.campaign() if isinstance(log, Log)]).own
    assert isinstance(form, DriveForm)
    drives = form.drives
    if part == 0:
        _ = drives.step_error  # the model as it is, also with half the time step: no row below moves nothing else
    given = form.discrepancy
    programs = [given, *(np.concatenate([given, *(form.candidates[e] for e in p)]) for p in form.parts)]
    # the first part has two programs already
    for which in programs[(part - 1) % of :: of]:
        row = drives.origin()[None]
        row[0, which] = 1e-6
        drives.predict(row)


def ask(
    job: Job, folder: Path, until: float, settings: Mapping[str, str] = MappingProxyType({})
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The row of one campaign, and its verdict.

    Args:
      job: which campaign. folder: of the set. until: `time.monotonic` by which the answer is to be there.
      settings: of `compare`.
    """
    spent = time.process_time()
    make(job, folder)
    made, name = time.process_time(), _name(job)
    truth = json.loads((folder / "truth" / f"{name}.json").read_text(encoding="utf-8"))
    out = folder / "runs" / name
    out.mkdir(parents=True, exist_ok=True)
    answer = _answer(folder / "logs" / name, out, until, settings)
    path = out / "run" / "verdict.json"
    verdict = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    what = said(answer, verdict)
    what["probabilities"] = dict(list(what["probabilities"].items())[:KEPT])
    what["inclusion"] = {k: round(p, 5) for k, p in what["inclusion"].items() if p >= 1e-5}
    row = {
        "case": name,
        "twin_of": None,
        "truth": truth,
        **what,
        **judge(truth, what),
        "seconds": answer["seconds"].get("all"),
        "seconds_of": answer["seconds"],
        "seconds_given": answer.get("given"),
        "cpu_seconds": time.process_time() - made,
        "cpu_seconds_to_make": made - spent,
        "first": False,
        "search": verdict.get("details", {}).get("search"),
        "noise": verdict.get("details", {}).get("noise"),
        "sentence": verdict.get("sentence", ""),
        "error": answer.get("error"),
    }
    return row, {"case": name, **verdict}


def _answer(logs: Path, out: Path, until: float, settings: Mapping[str, str]) -> dict[str, Any]:
    """What the tool says about the logs of a folder by `compare` and `why`, until a `time.monotonic`."""
    from lunar_mjx.cli import main

    seconds: dict[str, float] = {}
    answer: dict[str, Any] = {"verdict": "CRASH", "effects": [], "seconds": seconds}
    run, began = out / "run", time.monotonic()
    with (
        (out / "log.txt").open("w", encoding="utf-8") as text,
        contextlib.redirect_stdout(text),
        contextlib.redirect_stderr(text),
    ):
        try:
            extra = [w for k, v in settings.items() for w in ("--setting", f"{k}={v}")]
            status = work._verb(main, "compare", str(logs), "-o", str(run), *extra)
            seconds["compare"] = time.monotonic() - began
            if status:
                answer["verdict"] = "BAD_DATA" if status == 10 else "CRASH"
            else:
                answer["given"] = max(until - time.monotonic(), 1.0)
                work._verb(main, "why", str(run), "--seconds", f"{answer['given']:.0f}")
                seconds["why"] = time.monotonic() - began - seconds["compare"]
                verdict = json.loads((run / "verdict.json").read_text(encoding="utf-8"))
                answer |= {"verdict": verdict["verdict"], "effects": verdict["effects"]}
        except Exception:
            answer["error"] = traceback.format_exc(limit=-6)
    seconds["all"] = time.monotonic() - began
    return answer


def drives(args: argparse.Namespace) -> None:
    """Asks about all campaigns that have no row yet, until the time is up."""
    begun = time.monotonic()
    until = begun + 60.0 * args.minutes
    pool.prepare()
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.3")
    folder: Path = args.out
    folder.mkdir(parents=True, exist_ok=True)
    about = campaign(folder, args.set, args.seed)
    path = folder / ROWS
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    have = {r["case"] for r in rows}
    todo = [j for j in jobs(args.set, int(about["seed"]), args.drives) if _name(j) not in have]
    head, dirty = work.commit()
    queue = multiprocessing.get_context("spawn").Queue()
    allowed = sorted(os.sched_getaffinity(0))
    for place in places(core_shares(allowed, args.processes), args.gpus, os.environ.get("CUDA_VISIBLE_DEVICES")):
        queue.put(place)
    settings = dict(s.split("=", 1) for s in args.setting)
    processes = pool.Pool(args.processes, _begin, queue, folder, until, args.limit, settings)
    try:
        first = {j[5]: j for j in reversed(todo)}  # of every rover
        if not args.cold:
            early = [*first.values(), *(j for j in todo if j not in first.values())][: args.processes]
            _report(processes.answers(_make, early, until), begun)
            of = max(1, args.processes // max(len(first), 1))
            parts = [(j, k, of) for k in range(of) for j in first.values()]
            _report(processes.answers(_compile, parts, until), begun)
            print(f"{time.monotonic() - begun:5.0f} s  compiled", flush=True)
        for answer in pool.told(processes.answers(_ask, todo, until), _name):
            row = answer[0] | {"commit": head, "uncommitted_changes": dirty}
            rows.append(row)
            for name, line in ((ROWS, row), (VERDICTS, answer[1])):
                with (folder / name).open("a", encoding="utf-8") as file:
                    file.write(json.dumps(line) + "\n")
            hidden = ", ".join(row["truth"]["hidden"]) or "nothing"
            about_it = f"{row['case']}  {row['truth']['rover']:<8} {hidden:<20} {row['verdict']:<12}"
            print(f"{time.monotonic() - begun:5.0f} s  {about_it} {', '.join(row['effects'])}", flush=True)
            score_rows(folder, about, rows, settings)
    finally:
        processes.end()
        score_rows(folder, about, rows, settings, show=True)
    print(f"{len(rows)} rows, {time.monotonic() - begun:.0f} s", flush=True)


def core_shares(cores: Sequence[int], processes: int) -> list[set[int]]:
    """Cores of each process: as many as there are for each, or one that several share."""
    each = max(1, len(cores) // processes)
    return [{cores[(k * each + i) % len(cores)] for i in range(each)} for k in range(processes)]


def places(shares: Sequence[set[int]], gpus: int, visible: str | None = None) -> list[tuple[set[int], str | None]]:
    """Cores and GPU of each process: GPUs in turn, or none where there are 0.

    Args:
      shares: cores of each process. gpus: how many are shared, the first of those that are visible.
      visible: their names as CUDA_VISIBLE_DEVICES lists them, numbers or UUIDs; None: all, by number.
    """
    names = [str(k) for k in range(gpus)] if visible is None else [n for n in visible.split(",") if n]
    if gpus > len(names):
        raise SystemExit(f"--gpus {gpus}: CUDA_VISIBLE_DEVICES={visible} lists {len(names)}; ask for as many.")
    return [(cores, names[k % gpus] if gpus else None) for k, cores in enumerate(shares)]


def _report(answers: Iterable[tuple[Any, Any]], begun: float) -> None:
    """Prints what failed of jobs that prepare others."""
    for job, answer in answers:
        if isinstance(answer, BaseException):
            print(f"{time.monotonic() - begun:5.0f} s  {job} failed: {type(answer).__name__}: {answer}", flush=True)


class _Process:
    """What a process of the pool works on: folder of the set, by when, and settings of `compare`."""

    folder, settings = Path(), {}
    until = limit_s = 0.0


def _begin(queue: Any, folder: Path, until: float, limit_s: float, settings: Mapping[str, str]) -> None:
    # Cores are counted by what a process may use: its own share, so that none makes threads for all.
    cores, gpu = place = queue.get()
    # Back to the end: where a process dies all are started anew, and take the places in turn again.
    queue.put(place)
    os.sched_setaffinity(0, cores)
    # before JAX is imported, which else takes the first GPU, and three quarters of its memory
    if gpu is None:
        os.environ["JAX_PLATFORMS"] = "cpu"
    else:
        os.environ |= {"CUDA_VISIBLE_DEVICES": gpu, "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    _Process.folder, _Process.until, _Process.limit_s, _Process.settings = folder, until, limit_s, settings


def _make(job: Job) -> None:
    make(job, _Process.folder)


def _compile(part: tuple[Job, int, int]) -> None:
    compile_part(part[0], _Process.folder, part[1], part[2])


def _ask(job: Job) -> tuple[dict[str, Any], dict[str, Any]] | None:
    """As `ask`; None where too little time is left."""
    now = time.monotonic()
    end = min(_Process.until - WRITING, now + (_Process.limit_s or math.inf))
    return ask(job, _Process.folder, end, _Process.settings) if end - now > LEAST_SECONDS else None


def _name(job: Job) -> str:
    return f"{job[0]}-drive-{job[2]:03d}"
