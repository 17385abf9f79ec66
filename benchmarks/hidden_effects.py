"""How often the tool finds what is missing, and how often it is wrong: hidden effects in logs with sealed answers.

    python benchmarks/hidden_effects.py run --out build/hidden.jsonl --minutes 9      tables; again to go on
    python benchmarks/hidden_effects.py generate build/drives --count 20              drives: logs and sealed answers
    python benchmarks/hidden_effects.py score build/drives --out build/drives.jsonl   drives: here or on another machine
    python benchmarks/hidden_effects.py summary build/hidden.jsonl build/drives.jsonl --out build/hidden

Tables come from a test bed written in NumPy from the equations, drives from native MuJoCo with NumPy forces and hidden
hooks; neither shares the tool's physics. The seed of a campaign is drawn from the commit and the time when it begins.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ.setdefault("MUJOCO_GL", "disable")


def _counts(names: str, count: int | None, whole: dict[str, int]) -> dict[str, int]:
    chosen = list(whole) if names == "all" else names.split(",")
    unknown = [n for n in chosen if n not in whole]
    if unknown:
        raise SystemExit(f"--cases {unknown[0]}: there is no such group; use some of {','.join(whole)}.")
    return {n: whole[n] if count is None else count for n in chosen}


def run(args: argparse.Namespace) -> None:
    """Tables: draws, asks, judges."""
    from benchmarks.hidden import cases, runner, solve

    counts = _counts(args.cases, args.count, dict(cases.GROUPS))
    seed = int(runner.campaign(args.out, args.seed)["seed"])
    done = {row["case"] for row in runner.read_rows([args.out]) if row["seed"] == str(seed)}
    left = [job for job in runner.order(counts) if f"{job[0]}-{job[1]:03d}" not in done]
    print(f"seed {seed}: {len(left)} of {sum(counts.values())} cases are left")
    number = runner.work(
        solve.table_row,
        left,
        args.out,
        seed,
        args.minutes,
        args.workers,
        suggest=args.suggest,
        keep=str(args.keep) if args.keep else None,
    )
    print(f"{number} cases done, {len(left) - number} left")


def generate(args: argparse.Namespace) -> None:
    """Drives: logs and sealed answers on disk."""
    from benchmarks.hidden import drives, runner

    counts = _counts(args.cases, args.count, dict(drives.GROUPS))
    seed = int(runner.campaign(args.folder / "drives", args.seed)["seed"])
    left = [
        job for job in runner.order(counts) if not (args.folder / "answers" / f"{job[0]}-{job[1]:03d}.json").is_file()
    ]
    number = 0
    for row in runner.rows(drives.generate, left, seed, args.minutes, args.workers, out=args.folder):
        print(row, flush=True)
        number += 1
    print(f"{number} campaigns made, {len(left) - number} left")


def score(args: argparse.Namespace) -> None:
    """Drives: asks about the logs on disk, opens the seals, judges."""
    import json

    from benchmarks.hidden import drives, runner, solve

    drawn = json.loads((args.folder / "drives.seed.json").read_text(encoding="utf-8"))
    seed = int(drawn["seed"])
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.with_suffix(".seed.json").write_text(json.dumps(drawn, indent=1) + "\n", encoding="utf-8")
    done = {row["case"] for row in runner.read_rows([args.out]) if row["seed"] == str(seed)}
    first, last, of = args.share
    mine = [job for place, job in enumerate(drives.waiting(args.folder)) if first <= place % of <= last]
    left = [job for job in mine if f"{job[0]}-{job[1]:03d}" not in done]
    number = runner.work(
        solve.drive_row,
        left,
        args.out,
        seed,
        args.minutes,
        args.workers,
        folder=str(args.folder),
        keep=str(args.keep) if args.keep else None,
    )
    print(f"{number} campaigns done, {len(left) - number} left")


def summary(args: argparse.Namespace) -> None:
    """The table of all results, with intervals, as JSON and text; and a figure of the answers."""
    import json

    from benchmarks.hidden import runner
    from benchmarks.hidden import summary as tables

    seeds = [p.with_suffix(".seed.json") for p in args.results]
    drawn = [json.loads(p.read_text(encoding="utf-8")) for p in seeds if p.is_file()]
    print(tables.write(runner.read_rows(args.results), args.out, drawn))


def share(text: str) -> tuple[int, int, int]:
    """First and last share and their number."""
    shares, _, of = text.partition("/")
    first, _, last = shares.partition("-")
    found = int(first), int(last or first), int(of)
    if not 0 <= found[0] <= found[1] < found[2]:
        raise argparse.ArgumentTypeError(f"{text!r} is no share; give one such as 0/4 or 1-3/4")
    return found


def parser() -> argparse.ArgumentParser:
    """The command line."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = whole.add_subparsers(dest="verb", required=True)
    tables = verbs.add_parser("run", help="tables of a test bed")
    tables.add_argument("--out", type=Path, required=True, help="JSON lines, one row per case")
    tables.add_argument("--cases", default="all", help="groups, separated by commas")
    tables.add_argument("--count", type=int, help="cases of each group; the whole benchmark's if left out")
    tables.add_argument("--seed", type=int, help="drawn from the commit and the time if left out")
    tables.add_argument("--minutes", type=float, default=9.0, help="after which no new case is begun")
    tables.add_argument("--workers", type=int, default=1)
    tables.add_argument("--suggest", action="store_true", help="ask for formulas where the effect is not listed")
    tables.add_argument("--keep", type=Path, help="folder in which logs and runs stay")
    tables.set_defaults(do=run)
    made = verbs.add_parser("generate", help="logs of drives, with sealed answers")
    made.add_argument("folder", type=Path)
    made.add_argument("--cases", default="all", help="groups, separated by commas")
    made.add_argument("--count", type=int, help="campaigns of each group; the whole benchmark's if left out")
    made.add_argument("--seed", type=int, help="drawn from the commit and the time if left out")
    made.add_argument("--minutes", type=float, default=9.0)
    made.add_argument("--workers", type=int, default=1)
    made.set_defaults(do=generate)
    scored = verbs.add_parser("score", help="ask about drives on disk, and judge")
    scored.add_argument("folder", type=Path)
    scored.add_argument("--out", type=Path, required=True, help="JSON lines, one row per campaign")
    scored.add_argument("--minutes", type=float, default=9.0)
    scored.add_argument("--workers", type=int, default=1)
    scored.add_argument(
        "--share",
        type=share,
        default=(0, 0, 1),
        metavar="FIRST-LAST/NUMBER",
        help="of the campaigns, where several programs score one folder",
    )
    scored.add_argument("--keep", type=Path, help="folder in which runs stay")
    scored.set_defaults(do=score)
    table = verbs.add_parser("summary", help="numbers with intervals, and a figure of the answers")
    table.add_argument("results", type=Path, nargs="+", help="JSON lines")
    table.add_argument("--out", type=Path, required=True, help="without ending: .json and .png are written")
    table.set_defaults(do=summary)
    return whole


if __name__ == "__main__":
    arguments = parser().parse_args()
    arguments.do(arguments)
