"""Runs slow proofs file by file, in an order that the commit turns, until the time is spent; keeps when each passed.

    python -m tests.proofs [--minutes 50] [--jobs 2] [--all] [--record] [--only FILE ...]

Files with a record come first: they are promises. Then come files that never passed yet; what of these fails is told,
and breaks no promise. A file whose recorded time exceeds what is left waits for another commit; what still runs a
quarter after the time is spent is stopped and counts neither as passed nor as failed.
Files run two at a time. A recorded proof that fails runs once more, alone: if it passes then, the machine was busy and
no promise is broken, but it is named, since no test should depend on that. It fails twice if the code is at fault.
`build/proofs.json` holds what this run found, `build/proofs/` what each file printed. `--record` also writes
`docs/proofs.json` and the table `docs/proofs.md`. The exit status is 1 if a recorded proof
failed (with --all or --only: any), or if none passed.
Each file is a process of its own, compiled as users compile.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import json
import math
import os
import re
import signal
import subprocess
import sys
import threading
import time
import xml.etree.ElementTree as ET
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOUND, RECORD, TABLE = ROOT / "build" / "proofs.json", ROOT / "docs" / "proofs.json", ROOT / "docs" / "proofs.md"
OVERRUN = 1.25
"""Times the minutes asked for, after which what still runs is stopped: recorded times are of another machine."""
HEAD = """# Proofs

Acceptance proofs that take longer than `make test` may: `make proofs` runs as many as fit into 50 minutes on two cores,
in an order that each commit turns, so that all have their turn. Those that were never recorded come last, and are no
promise yet: what of them fails is told and does not end the run with an error.
`make all-proofs` runs all and records them, `python -m tests.proofs --record --only FILE` one. Times are of a shared
machine: upper bounds.

| proofs | passed, skipped | took | last passed |
|---|---|---|---|
"""

Entry = Mapping[str, Any]


def slow_files() -> list[str]:
    """Files with tests that are marked slow."""
    line = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "slow", "-p", "no:cacheprovider"]
    out = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return sorted(set(re.findall(r"^(tests/\S+?\.py)::", out, re.MULTILINE)))


def commit() -> str:
    """The commit that is checked out, with a + where files other than the record differ from it."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    others = [":!" + str(p.relative_to(ROOT)) for p in (RECORD, TABLE)]
    line = [*git, "status", "--porcelain", "--", ".", *others]
    changed = subprocess.run(line, capture_output=True, text=True, check=True).stdout
    return head[:10] + ("+" if changed.strip() else "")


def turned(files: Sequence[str], at: str, record: Mapping[str, Entry] | None = None) -> list[str]:
    """The files, beginning with another one for another commit; the longer one takes, the more often with it.

    Were each as often the first, one that takes half of the time there is would hardly ever find so much left.
    """
    times = [max(1, round((record or {}).get(file, {}).get("seconds", 1.0))) for file in files]
    place, start = int(at.rstrip("+"), 16) % max(sum(times), 1), 0
    while files and place >= times[start]:
        place, start = place - times[start], start + 1
    return [*files[start:], *files[:start]]


def in_turn(files: Sequence[str], record: Mapping[str, Entry], at: str) -> list[str]:
    """The order of a commit: files with a record, then those that were never recorded, each turned by the commit."""
    known = [f for f in files if f in record]
    return [*turned(known, at, record), *turned([f for f in files if f not in record], at)]


def broken(failed: Sequence[str], record: Mapping[str, Entry], whole: bool) -> list[str]:
    """Files whose failure is an error: all where the whole was asked for, else those that passed once."""
    return [file for file in failed if whole or file in record]


class Turn:
    """Hands out files while there is time for them; used by several threads.

    Args:
      files: in order. record: what is known of them. seconds: to spend; infinite for all of them.
      clock: s, monotonic.
    """

    def __init__(
        self,
        files: Sequence[str],
        record: Mapping[str, Entry],
        seconds: float,
        clock: Callable[[], float] = time.monotonic,
    ):
        self._files, self._record, self._clock = list(files), record, clock
        self._lock, self._begin, self._seconds = threading.Lock(), clock(), seconds

    def next(self) -> str | None:
        """The next file that fits into the time left, an unknown one while any is left; None if there is none."""
        with self._lock:
            left = self._seconds - (self._clock() - self._begin)
            for i, file in enumerate(self._files):
                if self._record.get(file, {}).get("seconds", 0.0) < left:
                    return self._files.pop(i)
            return None

    def until_stop(self) -> float:
        """s from now after which what runs is to be stopped."""
        return max(0.0, OVERRUN * self._seconds - (self._clock() - self._begin))

    def left_out(self) -> list[str]:
        """Files that were not handed out."""
        return list(self._files)


def _place(file: str, ending: str) -> Path:
    """Where what a proof left behind lies, a file of its own for each."""
    return FOUND.with_suffix("") / f"{file.removeprefix('tests/').removesuffix('.py').replace('/', '.')}.{ending}"


def prove(file: str, limit_s: float = math.inf) -> dict[str, Any]:
    """Runs the slow tests of a file; `ok` is None if it was stopped after `limit_s`, or skipped all its tests."""
    report, printed = _place(file, "xml"), _place(file, "log")
    report.parent.mkdir(parents=True, exist_ok=True)
    report.unlink(missing_ok=True)
    began = time.monotonic()
    line = [sys.executable, "-m", "pytest", "-q", "-m", "slow", "-p", "no:cacheprovider", f"--junit-xml={report}", file]
    with printed.open("w", encoding="utf-8") as log:
        process = subprocess.Popen(line, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)
        try:
            status: int | None = process.wait(None if math.isinf(limit_s) else limit_s)
        except subprocess.TimeoutExpired:
            status = None
        finally:
            # with all that its tests have started
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    counts = dict.fromkeys(("tests", "failures", "errors", "skipped"), 0)
    if report.is_file():
        suite = next(ET.parse(report).iter("testsuite"))
        counts = {k: int(suite.get(k, "0")) for k in counts}
    passed = counts["tests"] - counts["failures"] - counts["errors"] - counts["skipped"]
    return {
        "ok": None if status is None or (status == 0 and not passed) else status == 0,
        "passed": passed,
        "skipped": counts["skipped"],
        "seconds": round(time.monotonic() - began),
    }


def prove_all(
    turn: Turn,
    jobs: int,
    at: str,
    run: Callable[[str, float], dict[str, Any]] = prove,
    keep: Callable[[Mapping[str, Entry]], None] = lambda found: None,
) -> dict[str, dict[str, Any]]:
    """Runs the files of a turn, several at a time; `keep` gets what was found after each; returns what each came to."""
    found: dict[str, dict[str, Any]] = {}
    lock = threading.Lock()

    def work() -> None:
        while (file := turn.next()) is not None:
            print(f"proofs: {file} begins", flush=True)
            entry = run(file, turn.until_stop())
            word = {True: "passed", False: "FAILED", None: "proves nothing (skipped, or stopped for want of time)"}[
                entry["ok"]
            ]
            with lock:
                found[file] = {**entry, "date": datetime.date.today().isoformat(), "commit": at}
                FOUND.parent.mkdir(exist_ok=True)
                FOUND.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
                keep(found)
            print(f"proofs: {file} {word} after {entry['seconds']} s", flush=True)

    threads = [threading.Thread(target=work) for _ in range(jobs)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return found


def again_alone(
    failed: Sequence[str], found: dict[str, dict[str, Any]], run: Callable[[str], dict[str, Any]] = prove
) -> list[str]:
    """Runs failed files once more, one at a time; enters in `found` those that pass, and returns them."""
    passed = []
    for file in failed:
        print(f"proofs: {file} once more, alone", flush=True)
        entry = run(file)
        if entry["ok"]:
            found[file] = {**found[file], **entry}
            passed.append(file)
    return passed


def table(record: Mapping[str, Entry], files: Sequence[str]) -> str:
    """The page."""
    rows = []
    for file in files:
        entry = record.get(file)
        if entry is None:
            rows.append(f"| `{file}` | - | - | not yet recorded |")
            continue
        counts = f"{entry['passed']}, {entry['skipped']}"
        rows.append(f"| `{file}` | {counts} | {entry['seconds']} s | {entry['date']}, {entry['commit']} |")
    return HEAD + "\n".join(rows) + "\n"


def recorded(record: Mapping[str, Entry], found: Mapping[str, Entry], files: Sequence[str]) -> dict[str, Entry]:
    """The record with what passed now; files that no longer exist are gone."""
    both = {**record, **{file: entry for file, entry in found.items() if entry["ok"]}}
    return {file: both[file] for file in files if file in both}


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=50.0)
    parser.add_argument("--jobs", type=int, default=2, help="files at a time")
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--only", nargs="*", help="files to run instead")
    args = parser.parse_args()
    files, at = slow_files(), commit()
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.is_file() else {}
    whole = args.all or args.only
    turn = Turn(args.only or in_turn(files, record, at), record, math.inf if whole else 60.0 * args.minutes)

    def keep(found: Mapping[str, Entry]) -> None:
        new = recorded(record, found, files)
        RECORD.write_text(json.dumps(new, indent=1) + "\n", encoding="utf-8")
        TABLE.write_text(table(new, files), encoding="utf-8")

    found = prove_all(turn, 1 if args.only else args.jobs, at, keep=keep if args.record else lambda found: None)
    # with --only the failure is what one asks for: nothing ran beside it
    first = [file for file, entry in found.items() if entry["ok"] is False and file in record and not args.only]
    on_second = again_alone(first, found, lambda f: prove(f, max(turn.until_stop(), 2.0 * record[f]["seconds"])))
    if args.record:
        keep(found)
    print(table(recorded(record, found, files), files))
    if on_second:
        print(f"proofs: FAILED beside another file and passed alone, to be mended: {', '.join(on_second)}")
    for word, which in (
        ("left out, no time", turn.left_out()),
        ("skipped or stopped for want of time", [f for f, e in found.items() if e["ok"] is None]),
    ):
        print(f"proofs: {word}: {', '.join(which) or 'none'}")
    failed = [file for file, entry in found.items() if entry["ok"] is False]
    for file in failed:
        print(_place(file, "log").read_text(encoding="utf-8")[-6000:])
    passed = sum(bool(entry["ok"]) for entry in found.values())
    print(f"proofs: {passed} of {len(found)} files passed" + "".join(f"; FAILED {f}" for f in failed))
    never = [file for file in failed if file not in record]
    if never and not whole:
        print(f"proofs: never passed yet, and no promise: {', '.join(never)}")
    return int(bool(broken(failed, record, bool(whole))) or not passed)


if __name__ == "__main__":
    sys.exit(main())
