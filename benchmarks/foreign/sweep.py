"""Makes, asks and scores many tables at once, on as many cores as there are, until the time is up.

    python -m benchmarks.foreign sweep --set report --tables 640 --minutes 9 -o build/foreign/report
    python -m benchmarks.foreign sweep --set report --tables 160 --setting laws="closed form" ...   # an ablation

One process per core takes case after case: it draws the world, writes its logs, asks the tool by its own verbs, and
hands back one row. Rows lie in `rows.jsonl`, one a line, so that what a machine that is taken away had answered is
kept; a second call goes on. `score.json` and `score.txt` are written at the end, and every half minute before.
"""

from __future__ import annotations

import argparse
import concurrent.futures as futures
import json
import multiprocessing
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import bed, cases, told, work
from .score import figures, judge, said, text

ROWS, SCORE, TEXT = "rows.jsonl", "score.json", "score.txt"
SCORE_EVERY = 30.0
"""s between two writings of the score."""
KEPT = 12
"""Probabilities of a verdict that a row keeps."""
Job = tuple[str, int, int, str, tuple[str, ...], str, float]
"""Set, seed, number, group, what is hidden, word of the twin ("" for the case itself), factor on the stated noise."""


def prepare() -> None:
    """Sets this process up to compute on one core; before anything of the tool is imported."""
    os.environ["OMP_NUM_THREADS"] = "1"
    flags = os.environ.get("XLA_FLAGS", "")
    if "multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1".strip()


def ask(job: Job, settings: Mapping[str, str]) -> dict[str, Any] | None:
    """The row of one case; None for a twin whose replicates tell its noise, so that what is stated is not asked."""
    which, seed, number, group, hidden, word, factor = job
    case = cases.draw(which, seed, number, group, hidden)
    if word and case.replicates > 1:
        return None
    truth = cases.summary(case) | {"separable": told.separable(case), "twins": []}
    folder = Path(tempfile.mkdtemp(prefix="foreign-"))
    try:
        bed.write(case, folder / "logs", factor)
        extra = [w for k, v in settings.items() for w in ("--setting", f"{k}={v}")]
        answer = work.one(folder / "logs", folder, extra)
        path = folder / "run" / "verdict.json"
        verdict = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    what = said(answer, verdict)
    what["probabilities"] = dict(list(what["probabilities"].items())[:KEPT])
    what["inclusion"] = {k: round(p, 5) for k, p in what["inclusion"].items() if p >= 1e-5}
    return {
        "case": case.name + (f"-{word}" if word else ""),
        "twin_of": case.name if word else None,
        "truth": truth,
        **what,
        **judge(truth, what),
        "seconds": answer["seconds"].get("all"),
        "first": False,
        "place": verdict.get("details", {}).get("place"),
        "noise": verdict.get("details", {}).get("noise"),
        "forms": verdict.get("forms"),
        "error": answer.get("error"),
    }


_SETTINGS: dict[str, str] = {}


def _begin(settings: dict[str, str]) -> None:
    _SETTINGS.update(settings)
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _ask(job: Job) -> dict[str, Any] | None:
    return ask(job, _SETTINGS)


def _compile(law: str) -> None:
    """Compiles the program of one contact law into the cache that all processes share."""
    from lunar_mjx.commands.compiled import keep_compiled

    keep_compiled()
    job = ("tune", 1, 0, "null", (), "", 1.0)
    ask(job, {**_SETTINGS, "laws": law, "most_refits": "1"})


def jobs(which: str, seed: int, tables: int, every: int) -> list[Job]:
    """All cases in the order of the plan, each of every so many followed by its twins with other stated noise."""
    from .__main__ import TWINS

    found: list[Job] = []
    for n, (group, hidden) in enumerate(cases.plan(which, tables)):
        found.append((which, seed, n, group, hidden, "", 1.0))
        if every and n % every == 0:
            found += [(which, seed, n, group, hidden, word, factor) for word, factor in TWINS.items()]
    return found


def sweep(args: argparse.Namespace) -> None:
    """Asks about all cases that have no row yet, until the time is up."""
    until = time.monotonic() + 60.0 * args.minutes
    prepare()
    folder: Path = args.out
    folder.mkdir(parents=True, exist_ok=True)
    from .__main__ import campaign

    about = campaign(folder, args.set, args.seed)
    seed = int(about["seed"])
    settings = dict(s.split("=", 1) for s in args.setting)
    path = folder / ROWS
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    have = {r["case"] for r in rows}
    todo = [j for j in jobs(args.set, seed, args.tables, args.twins) if _name(j) not in have]
    head, dirty = work.commit()
    context = multiprocessing.get_context("spawn")
    begun = time.monotonic()
    pool = futures.ProcessPoolExecutor(args.processes, context, _begin, (settings,))
    written = time.monotonic()
    try:
        if not args.cold:
            laws = settings.get("laws") or "closed form,stress_integral,granular_resistance"
            list(pool.map(_compile, laws.split(","), timeout=max(until - time.monotonic(), 1.0)))
            print(f"compiled in {time.monotonic() - begun:.0f} s", flush=True)
        # Few jobs wait in the pool's own queue, so that it can be ended at once.
        waiting: set[futures.Future[dict[str, Any] | None]] = set()
        rest = iter(todo)
        while time.monotonic() < until:
            for job in rest:
                waiting.add(pool.submit(_ask, job))
                if len(waiting) >= 2 * args.processes:
                    break
            if not waiting:
                break
            done, waiting = futures.wait(waiting, max(until - time.monotonic(), 0.0), futures.FIRST_COMPLETED)
            with path.open("a", encoding="utf-8") as file:
                for future in done:
                    try:
                        answer = future.result()
                    except Exception as error:  # one case that cannot be made ends no sweep
                        print(f"a case failed: {error}", flush=True)
                        continue
                    if answer is None:
                        continue
                    row = answer | {"commit": head, "uncommitted_changes": dirty}
                    rows.append(row)
                    file.write(json.dumps(row) + "\n")
            if time.monotonic() - written > SCORE_EVERY:
                _score(folder, about, rows, settings)
                written = time.monotonic()
    except futures.TimeoutError:
        print("the time was up before all was compiled", flush=True)
    finally:
        for process in list((pool._processes or {}).values()):
            process.kill()
        pool.shutdown(wait=False, cancel_futures=True)
        _score(folder, about, rows, settings, show=True)
    print(f"{len(rows)} rows, {time.monotonic() - begun:.0f} s", flush=True)


def _name(job: Job) -> str:
    return f"{job[0]}-{job[2]:03d}" + (f"-{job[5]}" if job[5] else "")


def _score(
    folder: Path, about: Mapping[str, Any], rows: list[dict[str, Any]], settings: Mapping[str, str], show: bool = False
) -> None:
    if not rows:
        return
    commits = sorted({r["commit"] for r in rows})
    found = {
        "campaign": dict(about),
        "settings": dict(settings),
        "asked_at_commits": commits,
        "asked_with_uncommitted_changes": any(r["uncommitted_changes"] for r in rows),
        "cases_made": len(rows),
        "cases_answered": sum(r["twin_of"] is None for r in rows),
        **figures(rows),
    }
    (folder / SCORE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    (folder / TEXT).write_text(text(found) + "\n", encoding="utf-8")
    if show:
        print(text(found), flush=True)
