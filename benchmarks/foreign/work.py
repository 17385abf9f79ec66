"""Asks the tool about cases by its own verbs, in a process that keeps its compiled programs from case to case.

`ask` starts this module as a worker, hands it one case at a time, and ends it where a case takes too long. Only the
worker imports the tool.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import os
import select
import subprocess
import sys
import time
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.provenance import checkout as commit

ROOT = Path(__file__).resolve().parents[2]
RESULT = "result.json"
CASES_PER_WORKER = 40
"""A worker is replaced after so many cases, so that what it keeps in memory stays bounded."""


class _Worker:
    """A process that answers one case per line."""

    def __init__(self) -> None:
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
        environment["XLA_FLAGS"] = environment.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
        self._process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.foreign.work"],
            cwd=ROOT,
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.asked = 0

    def ask(self, job: dict[str, Any], limit_s: float) -> dict[str, Any] | None:
        """The answer, or None where the process ended or took longer than the limit; then it is gone."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self.asked += 1
        try:
            self._process.stdin.write(json.dumps(job) + "\n")
            self._process.stdin.flush()
        except BrokenPipeError:
            self.end()
            return None
        ready, _, _ = select.select([self._process.stdout], [], [], limit_s)
        line = self._process.stdout.readline() if ready else ""
        if not line:
            self.end()
            return None
        return json.loads(line)

    def end(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.wait()


def ask(folder: Path, names: Sequence[str], limit_s: float, minutes: float) -> int:
    """Asks about cases that have no answer yet.

    Args:
      folder: of the set. names: of the cases. limit_s: seconds for one case. minutes: after which none is begun.

    Returns:
      Number of cases asked.
    """
    until = time.monotonic() + 60.0 * minutes
    head, dirty = commit()
    worker: _Worker | None = None
    asked = 0
    for name in names:
        out = folder / "runs" / name
        if (out / RESULT).is_file():
            continue
        if time.monotonic() > until:
            break
        out.mkdir(parents=True, exist_ok=True)
        if worker is None or worker.asked >= CASES_PER_WORKER:
            if worker is not None:
                worker.end()
            worker = _Worker()
        begun = time.monotonic()
        answer = worker.ask({"logs": str(folder / "logs" / name), "out": str(out)}, limit_s)
        seconds = time.monotonic() - begun
        if answer is None:
            worker = None
            answer = {
                "verdict": "TIME_OUT" if seconds >= limit_s else "CRASH",
                "effects": [],
                "seconds": {"all": seconds},
            }
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        answer |= {
            "case": name,
            "commit": head,
            "uncommitted_changes": dirty,
            "asked": now,
            "limit_s": limit_s,
            "first_of_its_worker": worker is None or worker.asked == 1,
        }
        (out / RESULT).write_text(json.dumps(answer, indent=1) + "\n", encoding="utf-8")
        asked += 1
        print(f"{name:<26} {answer['verdict']:<12} {', '.join(answer['effects']):<40} {seconds:6.1f} s", flush=True)
    if worker is not None:
        worker.end()
    return asked


def _verb(main: Any, *words: str) -> int:
    """The exit status of a verb."""
    sys.argv = ["lunar-mjx", *words]
    try:
        main()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0


def one(logs: Path, out: Path, extra: Sequence[str] = ()) -> dict[str, Any]:
    """`log check`, `compare` (with more words) and `why` in this process; what the verbs print is dropped."""
    from lunar_mjx.cli import main

    with (
        open(os.devnull, "w", encoding="utf-8") as nothing,
        contextlib.redirect_stdout(nothing),
        contextlib.redirect_stderr(nothing),
    ):
        try:
            return _answer(main, str(logs), out, extra)
        except Exception:
            return {"verdict": "CRASH", "effects": [], "seconds": {}, "error": traceback.format_exc(limit=-6)}


def plans(run: Path) -> list[str]:
    """Names of the measurements that `next` ranks for a run, the best first; none where it cannot."""
    from lunar_mjx.cli import main

    with (
        open(os.devnull, "w", encoding="utf-8") as nothing,
        contextlib.redirect_stdout(nothing),
        contextlib.redirect_stderr(nothing),
    ):
        status = _verb(main, "next", str(run))
    path = run / "next.json"
    found = json.loads(path.read_text(encoding="utf-8")) if not status and path.is_file() else {}
    return [str(p["name"]) for p in found.get("plans", ())]


def _answer(main: Any, logs: str, out: Path, extra: Sequence[str] = ()) -> dict[str, Any]:
    """`log check`, `compare` and `why`, as a user calls them."""
    run, status, seconds = out / "run", {}, {}
    verbs = {
        "check": ["log", "check", logs],
        "compare": ["compare", logs, "-o", str(run), *extra],
        "why": ["why", str(run)],
    }
    verdict = ""
    for name, words in verbs.items():
        begun = time.monotonic()
        status[name] = _verb(main, *words)
        seconds[name] = time.monotonic() - begun
        if status[name] and name != "why":
            verdict = "BAD_DATA" if status[name] == 10 else "CRASH"
            break
    seconds["all"] = sum(seconds.values())
    path = run / "verdict.json"
    found: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {
        "verdict": str(found.get("verdict") or verdict or "CRASH"),
        "effects": list(found.get("effects") or []),
        "status": status,
        "seconds": seconds,
    }


def serve() -> None:
    """Reads jobs from stdin, a JSON line each, and answers on stdout; what the verbs print goes to `log.txt`."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    from lunar_mjx.cli import main

    for line in sys.stdin:
        job = json.loads(line)
        out = Path(job["out"])
        with (
            (out / "log.txt").open("w", encoding="utf-8") as text,
            contextlib.redirect_stdout(text),
            contextlib.redirect_stderr(text),
        ):
            try:
                answer = _answer(main, job["logs"], out)
            except Exception:
                answer = {"verdict": "CRASH", "effects": [], "seconds": {}, "error": traceback.format_exc(limit=-6)}
        print(json.dumps(answer), file=answers, flush=True)


if __name__ == "__main__":
    serve()
