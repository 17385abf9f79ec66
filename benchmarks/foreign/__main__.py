"""Foreign worlds: make logs with sealed truths, ask the tool about them, and score what it says.

    python -m benchmarks.foreign make --set tune --tables 60 --drives 12 -o build/foreign/tune
    python -m benchmarks.foreign run   build/foreign/tune
    python -m benchmarks.foreign score build/foreign/tune
    python -m benchmarks.foreign experiments --set tune --tables 60 -o build/foreign/experiments   # `next` in a loop
    python -m benchmarks.foreign sweep --set report --tables 640 -o build/foreign/report   # all of it, on all cores

`run` goes on where it was stopped. The report set's seed is drawn from the commit under test, so that nobody can have
seen its tables before.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from . import cases
from .sets import TWINS
from .sets import make as make_tables
from .work import ask


def make(args: argparse.Namespace) -> None:
    """Writes logs and sealed truths."""
    make_tables(args)
    if args.drives:
        from .drives.campaigns import make_all

        make_all(args)


def run(args: argparse.Namespace) -> None:
    """Asks the tool."""
    # Twins with other stated noise come last: a part of the set is then a small copy of its cases.
    found = [p.name for p in (args.folder / "logs").iterdir() if p.is_dir()]
    names = sorted(found, key=lambda n: (n.endswith(tuple(TWINS)), n))
    names = [n for n in names if any(part in n for part in args.only.split(","))][: args.first]
    first, _, of = args.share.partition("/")
    mine = names[int(first) :: int(of)]
    number = ask(args.folder, mine, args.limit, args.minutes)
    print(f"asked about {number} of {len(mine)}")


def score(args: argparse.Namespace) -> None:
    """Scores what was answered."""
    from .score import report, text

    found = report(args.folder)
    out = args.out or args.folder / "score.json"
    out.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    print(text(found))
    print(f"written to {out}")


def sweep(args: argparse.Namespace) -> None:
    """Makes, asks and scores tables on all cores."""
    from .sweep import sweep as run_sweep

    run_sweep(args)


def drives(args: argparse.Namespace) -> None:
    """Makes, asks and scores campaigns of drives on all cores."""
    from .drives.campaigns import drives as run_drives

    run_drives(args)


def told(args: argparse.Namespace) -> None:
    """Tells how well who knows the law of a world tells what is hidden in its drives."""
    from .drives.campaigns import tell

    tell(args)


def experiments(args: argparse.Namespace) -> None:
    """Follows open verdicts with further sweeps."""
    from .experiments import experiments as follow

    follow(args)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    whole = argparse.ArgumentParser(
        prog="benchmarks.foreign", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    verbs = whole.add_subparsers(dest="verb", required=True)
    made = verbs.add_parser("make", help="write logs and sealed truths")
    made.add_argument("--set", choices=("tune", "report"), required=True)
    made.add_argument("--tables", type=int, default=60)
    made.add_argument("--drives", type=int, default=0, help="campaigns of drives")
    made.add_argument("--seed", type=int, help="else fixed for tune, and drawn from the commit for report")
    made.add_argument("-o", "--out", type=Path, required=True)
    made.set_defaults(do=make)
    asked = verbs.add_parser("run", help="ask the tool by its own verbs")
    asked.add_argument("folder", type=Path)
    asked.add_argument("--limit", type=float, default=900.0, help="seconds for one case")
    asked.add_argument("--minutes", type=float, default=1e6, help="after which no case is begun")
    asked.add_argument("--only", default="", help="cases whose name has this, or one of these (A,B), in it")
    asked.add_argument("--first", type=int, help="so many cases only")
    asked.add_argument("--share", default="0/1", help="K/N: every Nth case from the Kth, for several processes")
    asked.set_defaults(do=run)
    swept = verbs.add_parser("sweep", help="make, ask and score tables on all cores until the time is up")
    swept.add_argument("--set", choices=("tune", "report"), required=True)
    swept.add_argument("--tables", type=int, default=640)
    swept.add_argument(
        "--twins", type=int, default=4, help="every so many tables twice more with other stated noise; 0: none"
    )
    groups = (*cases.GROUPS, cases.TWO_OUTSIDE)
    swept.add_argument(
        "--group", choices=groups, default="", help="tables of one group alone; two_outside: of none else"
    )
    swept.add_argument("--seed", type=int, help="as for make")
    swept.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    swept.add_argument("--minutes", type=float, default=9.0)
    swept.add_argument("--setting", action="append", default=[], help="NAME=VALUE for `compare`, to ablate a rule")
    swept.add_argument("--limit", type=float, default=150.0, help="s of wall time for one case, then it is a TIME_OUT")
    swept.add_argument("--cold", action="store_true", help="compile nothing beforehand")
    swept.add_argument("-o", "--out", type=Path, required=True)
    swept.set_defaults(do=sweep)
    driven = verbs.add_parser("drives", help="make, ask and score campaigns of drives on all cores")
    driven.add_argument("--set", choices=("tune", "report"), required=True)
    driven.add_argument("--drives", type=int, default=24)
    driven.add_argument("--seed", type=int, help="as for make")
    driven.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    driven.add_argument("--gpus", type=int, default=0, help="visible GPUs that the processes share; 0: cores alone")
    driven.add_argument("--minutes", type=float, default=60.0)
    driven.add_argument("--limit", type=float, default=0.0, help="seconds for one campaign, made and answered; 0: none")
    driven.add_argument("--setting", action="append", default=[], help="NAME=VALUE for `compare`, to ablate a rule")
    driven.add_argument("--cold", action="store_true", help="compile nothing beforehand")
    driven.add_argument("-o", "--out", type=Path, required=True)
    driven.set_defaults(do=drives)
    known = verbs.add_parser("told", help="how far what is hidden in drives stands out, to who knows the law")
    known.add_argument("--set", choices=("tune", "report"), required=True)
    known.add_argument("--drives", type=int, default=24, help="campaigns of the set")
    known.add_argument("--seed", type=int, help="as for make")
    known.add_argument("--only", type=int, nargs="*", help="numbers of campaigns, such as 4 23; all if left out")
    known.add_argument("-o", "--out", type=Path, required=True, help="folder of the set")
    known.set_defaults(do=told)
    followed = verbs.add_parser("experiments", help="measure what `next` asks for, and ask again")
    followed.add_argument("--set", choices=("tune", "report"), required=True)
    followed.add_argument("--tables", type=int, default=60)
    followed.add_argument("--seed", type=int, help="as for make")
    followed.add_argument("--minutes", type=float, default=60.0, help="after which no case is begun")
    followed.add_argument("--processes", type=int, default=len(os.sched_getaffinity(0)))
    followed.add_argument("--limit", type=float, default=400.0, help="s of wall time for one case and all its sweeps")
    followed.add_argument("--choice", action="append", choices=("next", "random", "d_optimal"), help="all if left out")
    followed.add_argument("-o", "--out", type=Path, required=True)
    followed.set_defaults(do=experiments)
    scored = verbs.add_parser("score", help="score the answers")
    scored.add_argument("folder", type=Path)
    scored.add_argument("-o", "--out", type=Path)
    scored.set_defaults(do=score)
    return whole


if __name__ == "__main__":
    arguments = parser().parse_args(sys.argv[1:])
    arguments.do(arguments)
