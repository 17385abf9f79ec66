"""Makes, asks and scores many tables at once, on as many cores as there are, until the time is up.

    python -m benchmarks.foreign sweep --set report --tables 640 --minutes 9 -o build/foreign/report
    python -m benchmarks.foreign sweep --set report --tables 160 --setting laws="closed form" ...   # an ablation

One process per core takes case after case: it draws the world, writes its logs, asks the tool by its own verbs, and
hands back one row. Rows lie in `rows.jsonl`, one a line, so that what a machine that is taken away had answered is
kept; a second call goes on. `score.json` and `score.txt` are written at the end, and every half minute before.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import bed, cases, pool, told, work
from .score import figures, judge, said, text
from .sets import TWINS, campaign

ROWS, SCORE, TEXT = "rows.jsonl", "score.json", "score.txt"
SCORE_EVERY = 30.0
"""s between two writings of the score."""
KEPT = 12
"""Probabilities of a verdict that a row keeps."""
Job = tuple[str, int, int, str, tuple[str, ...], str, float]
"""Set, seed, number, group, what is hidden, word of the twin ("" for the case itself), factor on the stated noise."""


def ask(job: Job, settings: Mapping[str, str], limit_s: float = 0.0) -> dict[str, Any] | None:
    """The row of one case; None for a twin whose replicates tell its noise, so that what is stated is not asked.

    A case that takes longer than its limit (s of wall time; 0: none) is a `TIME_OUT`.
    """
    which, seed, number, group, hidden, word, factor = job
    case = cases.draw(which, seed, number, group, hidden)
    if word and case.replicates > 1:
        return None
    truth = cases.summary(case) | {"separable": told.separable(case), "twins": []}
    folder = Path(tempfile.mkdtemp(prefix="foreign-"))
    cpu = time.process_time()
    try:
        bed.write(case, folder / "logs", factor)
        extra = [w for k, v in settings.items() for w in ("--setting", f"{k}={v}")]
        try:
            with pool.limit(limit_s):
                answer = work.one(folder / "logs", folder, extra)
        except pool.TooLong:
            answer = {"verdict": "TIME_OUT", "effects": [], "seconds": {"all": limit_s}}
            shutil.rmtree(folder / "run", ignore_errors=True)
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
        "cpu_seconds": time.process_time() - cpu,
        "first": False,
        "place": verdict.get("details", {}).get("place"),
        "noise": verdict.get("details", {}).get("noise"),
        "forms": verdict.get("forms"),
        "error": answer.get("error"),
    }


_SETTINGS: dict[str, str] = {}
_LIMIT: list[float] = []


def _begin(settings: dict[str, str], limit_s: float) -> None:
    _SETTINGS.update(settings)
    _LIMIT[:] = [limit_s]
    pool.silent()


def _ask(job: Job) -> dict[str, Any] | None:
    return ask(job, _SETTINGS, _LIMIT[0])


def compile_law(law: str) -> None:
    """Compiles the program of one contact law into the cache that all processes share."""
    from lunar_mjx.commands.compiled import keep_compiled

    keep_compiled()
    job = ("tune", 1, 0, "null", (), "", 1.0)
    ask(job, {**_SETTINGS, "laws": law, "most_refits": "1"})


LAWS = "closed form,stress_integral,granular_resistance"


def jobs(which: str, seed: int, tables: int, every: int, only: str = "") -> list[Job]:
    """All cases in the order of the plan, each of every so many followed by its twins with other stated noise."""
    found: list[Job] = []
    for n, (group, hidden) in enumerate(cases.plan(which, tables, only)):
        found.append((which, seed, n, group, hidden, "", 1.0))
        if every and n % every == 0:
            found += [(which, seed, n, group, hidden, word, factor) for word, factor in TWINS.items()]
    return found


def sweep(args: argparse.Namespace) -> None:
    """Asks about all cases that have no row yet, until the time is up."""
    until = time.monotonic() + 60.0 * args.minutes
    pool.prepare()
    folder: Path = args.out
    folder.mkdir(parents=True, exist_ok=True)
    about = campaign(folder, args.set, args.seed)
    seed = int(about["seed"])
    settings = dict(s.split("=", 1) for s in args.setting)
    path = folder / ROWS
    rows = [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []
    have = {r["case"] for r in rows}
    todo = [j for j in jobs(args.set, seed, args.tables, args.twins, args.group) if _name(j) not in have]
    head, dirty = work.commit()
    begun = written = time.monotonic()
    processes = pool.Pool(args.processes, _begin, settings, args.limit)
    try:
        if not args.cold:
            for law, error in processes.answers(compile_law, (settings.get("laws") or LAWS).split(","), until):
                print(f"{law}: {error or f'compiled after {time.monotonic() - begun:.0f} s'}", flush=True)
        for answer in pool.told(processes.answers(_ask, todo, until), _name):
            row = answer | {"commit": head, "uncommitted_changes": dirty}
            rows.append(row)
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
            if time.monotonic() - written > SCORE_EVERY:
                score_rows(folder, about, rows, settings)
                written = time.monotonic()
    finally:
        processes.end()
        score_rows(folder, about, rows, settings, show=True)
    print(f"{len(rows)} rows, {time.monotonic() - begun:.0f} s", flush=True)


def _name(job: Job) -> str:
    return f"{job[0]}-{job[2]:03d}" + (f"-{job[5]}" if job[5] else "")


def score_rows(
    folder: Path, about: Mapping[str, Any], rows: list[dict[str, Any]], settings: Mapping[str, str], show: bool = False
) -> None:
    """Writes the score of rows; prints it where it is to be shown."""
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
        **figures([r for r in rows if r["truth"]["kind"] == "table"]),
    }
    if driven := [r for r in rows if r["truth"]["kind"] == "drive"]:
        found["drives"] = figures(driven)
    (folder / SCORE).write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    (folder / TEXT).write_text(text(found) + "\n", encoding="utf-8")
    if show:
        print(text(found), flush=True)
