"""Runs slow proofs file by file, in an order that the commit turns, until the time is spent; keeps when each passed.

    python -m tests.proofs [--minutes 40] [--all] [--record]

`build/proofs.json` holds what this run found. `--record` also writes `docs/proofs.json` and the table `docs/proofs.md`.
The exit status is 1 if a proof failed. Each file is a process of its own, compiled as users compile.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
FOUND, RECORD, TABLE = ROOT / "build" / "proofs.json", ROOT / "docs" / "proofs.json", ROOT / "docs" / "proofs.md"
HEAD = """# Proofs

Acceptance proofs that take longer than `make test` may: `make proofs` runs as many as fit into 40 minutes, in an order
that each commit turns, so that all have their turn. A file that has never been recorded has no known time and waits for
`make all-proofs`, which runs all and records them, or for `python -m tests.proofs --record --only FILE`.

| proofs | passed, skipped | took | last passed |
|---|---|---|---|
"""


def slow_files() -> list[str]:
    """Files with tests that are marked slow."""
    line = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", "slow", "-p", "no:cacheprovider"]
    out = subprocess.run(line, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return sorted(set(re.findall(r"^(tests/\S+?\.py)::", out, re.MULTILINE)))


def commit() -> str:
    """The commit that is checked out, with a + where files differ from it."""
    git = ["git", "-C", str(ROOT)]
    head = subprocess.run([*git, "rev-parse", "HEAD"], capture_output=True, text=True, check=True).stdout.strip()
    changed = subprocess.run([*git, "status", "--porcelain"], capture_output=True, text=True, check=True).stdout
    return head[:10] + ("+" if changed.strip() else "")


def turned(files: Sequence[str], at: str) -> list[str]:
    """The files, beginning with another one for another commit."""
    start = int(at.rstrip("+"), 16) % len(files)
    return [*files[start:], *files[:start]]


def prove(file: str) -> dict[str, Any]:
    """Runs the slow tests of a file."""
    report = FOUND.with_name("proof.xml")
    report.unlink(missing_ok=True)
    began = time.monotonic()
    line = [sys.executable, "-m", "pytest", "-q", "-m", "slow", "-p", "no:cacheprovider", f"--junit-xml={report}", file]
    status = subprocess.run(line, cwd=ROOT, env={**os.environ}, check=False).returncode
    counts = dict.fromkeys(("tests", "failures", "errors", "skipped"), 0)
    if report.is_file():
        suite = next(ET.parse(report).iter("testsuite"))
        counts = {k: int(suite.get(k, "0")) for k in counts}
    passed = counts["tests"] - counts["failures"] - counts["errors"] - counts["skipped"]
    return {
        "ok": status == 0,
        "passed": passed,
        "skipped": counts["skipped"],
        "seconds": round(time.monotonic() - began),
    }


def table(record: Mapping[str, Mapping[str, Any]], files: Sequence[str]) -> str:
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


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--all", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--only", nargs="*", help="files to run instead")
    args = parser.parse_args()
    files, at = slow_files(), commit()
    record = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.is_file() else {}
    FOUND.parent.mkdir(exist_ok=True)
    found: dict[str, Any] = {}
    began = time.monotonic()
    for file in args.only or turned(files, at):
        left = 60.0 * args.minutes - (time.monotonic() - began)
        takes = record.get(file, {}).get("seconds")
        # the time limit can only be kept with files whose time is known
        if not args.all and not args.only and (takes is None or takes > left):
            why = "never timed: run make all-proofs" if takes is None else "no time left for it"
            print(f"proofs: {file} left out, {why}", flush=True)
            continue
        print(f"proofs: {file}", flush=True)
        entry = prove(file)
        found[file] = {**entry, "date": datetime.date.today().isoformat(), "commit": at}
        FOUND.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    record |= {file: entry for file, entry in found.items() if entry["ok"]}
    print(table(record, files))
    if args.record:
        RECORD.write_text(json.dumps(record, indent=1, sort_keys=True) + "\n", encoding="utf-8")
        TABLE.write_text(table(record, files), encoding="utf-8")
    failed = [file for file, entry in found.items() if not entry["ok"]]
    print(f"proofs: {len(found) - len(failed)} of {len(found)} files passed" + "".join(f"; FAILED {f}" for f in failed))
    return int(bool(failed))


if __name__ == "__main__":
    sys.exit(main())
