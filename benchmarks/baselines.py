"""What other tools say of the logs of the hidden-effect benchmark: a parameter refit with mujoco.sysid, and pySINDy.

    python benchmarks/baselines.py run --out build/baselines.jsonl --minutes 9          again to go on
    python benchmarks/baselines.py summary build/baselines.jsonl --out benchmarks/baselines

Needs `pip install 'lunar-mjx[baselines]'`. Every case is a wheel table with a sealed answer (`hidden/cases.py`), and
all tools see the same log. Neither tool knows a wheel in soil, so both are lent what they lack: our wheel bed, our
scales and bounds of the parameters, the noise of the averaged points, our split into fitted and held-out slip angles.
The rules below were set down before the seed of the scored cases was drawn.

Refit. `mujoco.sysid.optimize` fits the soil's six parameters, and again with every parameter of one catalogue effect
added, for each effect in turn (from both signs of its size, where both are allowed), on the fitted slip angles.
- "smallest": the model of the smallest held-out error is the answer: the soil alone means that nothing is missing, an
  effect is named otherwise. It cannot say that something unknown is missing.
- "careful": our test of whether a residual is at the noise is lent to it as well. Where the soil alone is at the noise,
  nothing is missing; otherwise the effect of the smallest held-out error is named if it is at the noise, and what is
  missing is unknown if it is not.
Both answers are judged as the tool's own (`hidden/judge.py`).

pySINDy. Sequentially thresholded least squares, polynomials up to degree 2 of slip ratio, slip angle, load and the
refit's sinkage, for the residual (in sigma) that the refit of the soil leaves in each channel, fitted on the fitted
slip angles. Threshold and ridge are those of the fewest terms within 2 % of the smallest held-out error, which favours
it.
- "at the noise": refit and formula together pass the lent noise test on the held-out points.
- "points": the channel where its formula is largest is one where the hidden effect truly shows (at least half as
  strong as in the strongest, noise-free, by the generator), and the term there whose removal costs most holds a
  quantity that the effect's own equation names (`QUANTITIES_OF`; the constant counts where the effect is a constant).
- "silent": no term survives; right where nothing is hidden.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import os
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))
os.environ["XLA_FLAGS"] = os.environ.get("XLA_FLAGS", "") + " --xla_cpu_multi_thread_eigen=false"
os.environ.setdefault("MUJOCO_GL", "disable")

import numpy as np  # noqa: E402

from benchmarks import baseline_tools as tools  # noqa: E402
from lunar_mjx.errors import UserError  # noqa: E402

COUNTS = {"singles": 300, "nulls": 400, "outside": 100, "singles_x5": 100}
QUANTITIES_OF: Mapping[str, frozenset[str]] = {
    k: frozenset(v.split())
    for k, v in {
        "slip_sinkage": "slip",
        "angle_sinkage": "angle",
        "exit_angle": "slip 1",
        "bulldozing": "sinkage",
        "grousers": "load 1",
        "friction_circle": "angle slip",
        "rolling_resistance": "load",
        "wheel_radius_error": "slip sinkage 1",
        "steering_toe": "angle 1",
        "speed_stiffness": "slip",
        "cable_drag": "angle 1",
        "side_offset": "1",
        "load_friction": "load",
        "strain_softening": "slip",
        "hard_layer": "sinkage",
        "seal_torque": "1",
        "side_bearing": "angle slip",
        "load_stiffness": "load",
        "angle_modulus": "angle",
        "deep_cohesion": "sinkage",
        "camber_thrust": "load slip",
    }.items()
}
"""Quantities that a hidden effect's equation names; "1" for a constant."""


# --- judging ----------------------------------------------------------------------------------------------------------


def quantities(term: str) -> set[str]:
    """Quantities of a term such as "slip^2" or "slip load"; "1" for the constant."""
    return {factor.partition("^")[0] for factor in term.split()}


def shows_in(truth: Any) -> set[str]:
    """Channels where the hidden effects show, noise-free and in sigma, at least half as strong as in the strongest."""
    with_it, without = truth.clean(), dataclasses.replace(truth, effects={}).clean()
    size = {c: float(np.sqrt(np.mean((with_it[c] - without[c]) ** 2))) / truth.sigma[c] for c in truth.channels}
    return {c for c, v in size.items() if v >= 0.5 * max(size.values())}


def points_right(found: Mapping[str, Any], truth: Any) -> bool:
    """Whether the dearest term of the largest formula is one of the hidden effect's."""
    if found["silent"]:
        return False
    channel = max(found["strength"], key=lambda c: found["strength"][c])
    wanted = set().union(*(QUANTITIES_OF[n] for n in truth.effects))
    return channel in shows_in(truth) and bool(quantities(found["terms"][channel][0][0]) & wanted)


# --- cases ------------------------------------------------------------------------------------------------------------


def row(group: str, number: int, seed: int) -> dict[str, Any]:
    """Asks all tools about one case, opens the seal, and judges."""
    from benchmarks.hidden import cases, solve
    from benchmarks.hidden.judge import outcome
    from lunar_mjx.diagnosis.build_problem import candidate_effects, table_problem
    from lunar_mjx.diagnosis.runs import Run
    from lunar_mjx.logs import read_log

    ours = solve.table_row(group, number, seed, suggest=True)
    case = cases.make(group, number, seed)
    with tempfile.TemporaryDirectory(prefix="baselines-") as folder:
        case.write(Path(folder) / "log")
        log = read_log(Path(folder) / "log")
        run = Run(Path(folder) / "run", (Path(folder) / "log",), solve.nominal_model())
        problem = table_problem(run, [log], candidate_effects(run))
        began = time.monotonic()
        found = tools.refits(problem)
        between = time.monotonic()
        refit: dict[str, Any] = tools.answers(problem, found)
        formula = tools.sindy(problem, found[0])
        ended = time.monotonic()
    twins = functools.partial(solve._twins, case.truth)
    for rule in ("smallest", "careful"):
        asked = {"group": group, "truth": ours["truth"], **refit[rule]}
        refit[rule] |= outcome(asked, twins)
    refit |= {"evaluations": sum(f.evaluations for f in found), "seconds": round(between - began, 2)}
    formula |= {"points": points_right(formula, case.truth), "seconds": round(ended - between, 2)}
    return ours | {"refit": refit, "sindy": formula}


def figures(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Counts, shares and Wilson intervals by group and tool. A case in which a tool crashed counts as wrong."""
    from benchmarks.hidden.summary import share

    def refit(r: Mapping[str, Any], rule: str, key: str) -> bool:
        return bool(r.get("refit", {}).get(rule, {}).get(key))

    def formula(r: Mapping[str, Any], key: str) -> bool:
        return bool(r.get("sindy", {}).get(key))

    out: dict[str, Any] = {}
    for group in COUNTS:
        mine = [r for r in rows if r["group"] == group]
        if not mine:
            continue
        table = {
            "lunar_mjx.criticism, right": share(mine, lambda r: r["right"]),
            "lunar_mjx.criticism, wrong name": share(mine, lambda r: r["wrong_name"]),
        }
        for rule in ("careful", "smallest"):
            table[f"mujoco.sysid {rule}, right"] = share(mine, lambda r, rule=rule: refit(r, rule, "right"))
            table[f"mujoco.sysid {rule}, wrong name"] = share(mine, lambda r, rule=rule: refit(r, rule, "wrong_name"))
        if group == "nulls":
            table["pySINDy, silent"] = share(mine, lambda r: formula(r, "silent"))
        else:
            table["pySINDy, points at channel and quantity"] = share(mine, lambda r: formula(r, "points"))
            table["pySINDy, at the noise on held-out points"] = share(mine, lambda r: formula(r, "at_noise"))
        if group == "outside":
            table["lunar_mjx.criticism, right port"] = share(
                mine, lambda r: r["verdict"] == "UNKNOWN" and r.get("port") in r.get("true_ports", ())
            )
            table["lunar_mjx.criticism, one of three formulas at the noise"] = share(
                mine, lambda r: any(s.get("at_noise") for s in r.get("suggestions", ()))
            )
        out[group] = table
    for tool, seconds in (
        ("lunar_mjx.criticism", lambda r: r.get("seconds")),
        ("mujoco.sysid", lambda r: r.get("refit", {}).get("seconds")),
        ("pySINDy", lambda r: r.get("sindy", {}).get("seconds")),
    ):
        known = [s for r in rows if (s := seconds(r)) is not None]
        out.setdefault("median seconds a case", {})[tool] = float(np.median(known)) if known else None
    return out


def run(args: argparse.Namespace) -> None:
    """Draws, asks, judges."""
    tools.require()
    from benchmarks.hidden import runner

    chosen = args.cases.split(",")
    unknown = [c for c in chosen if c not in COUNTS]
    if unknown:
        raise UserError(f"--cases {unknown[0]}: there is no such group here; use some of {','.join(COUNTS)}.")
    counts = {c: COUNTS[c] if args.count is None else args.count for c in chosen}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    seed = int(runner.campaign(args.out, args.seed)["seed"])
    done = {r["case"] for r in runner.read_rows([args.out]) if r["seed"] == str(seed)}
    left = [job for job in runner.order(counts) if f"{job[0]}-{job[1]:03d}" not in done]
    print(f"seed {seed}: {len(left)} of {sum(counts.values())} cases are left")
    number = runner.work(row, left, args.out, seed, args.minutes, args.workers)
    print(f"{number} cases done, {len(left) - number} left")


def _rounded(value: Any) -> Any:
    """A record with four digits of every number."""
    if isinstance(value, float):
        return float(f"{value:.4g}")
    if isinstance(value, Mapping):
        return {k: _rounded(v) for k, v in value.items()}
    return [_rounded(v) for v in value] if isinstance(value, list | tuple) else value


def summary(args: argparse.Namespace) -> None:
    """Writes `OUT.json` and prints the figures."""
    from benchmarks.hidden import runner

    rows = runner.read_rows(args.results)
    if not rows:
        raise UserError(f"{args.results[0]}: holds no results; run the cases first.")
    found = figures(rows)
    seeds = [p.with_suffix(".seed.json") for p in args.results]
    shown = (
        "case",
        "seed",
        "commit",
        "uncommitted_changes",
        "verdict",
        "named",
        "outcome",
        "port",
        "true_ports",
        "suggestions",
        "refit",
        "sindy",
    )
    cases = [{k: r.get(k) for k in shown} | {"hidden": r["truth"]["effects"]} for r in rows]
    for case in cases:
        if case["sindy"]:  # the dearest terms are those that count
            case["sindy"] = case["sindy"] | {"terms": {c: t[:2] for c, t in case["sindy"]["terms"].items()}}
    campaigns = [json.loads(p.read_text(encoding="utf-8")) for p in seeds if p.is_file()]
    # one case a line, four digits: the page's tables need no more
    lines = ",\n".join(json.dumps(_rounded(case)) for case in cases)
    head = json.dumps({"figures": found, "campaigns": campaigns}, indent=1).removesuffix("\n}")
    text = f'{head},\n "cases": [\n{lines}\n]}}\n'
    args.out.with_suffix(".json").write_text(text, encoding="utf-8")
    for group, table in found.items():
        print(group)
        for name, f in table.items():
            text = (
                f
                if not isinstance(f, dict)
                else (f"{f['hits']}/{f['of']} ({100 * f['low']:.0f} to {100 * f['high']:.0f} %)")
            )
            print(f"  {name:<58} {text}")


def main() -> int:
    """The command line; exit status 2 for a mistake of the user's."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = whole.add_subparsers(dest="verb", required=True)
    asked = verbs.add_parser("run", help="ask all tools about cases")
    asked.add_argument("--out", type=Path, required=True, help="JSON lines, one row per case")
    asked.add_argument("--cases", default=",".join(COUNTS), help="groups, separated by commas")
    asked.add_argument("--count", type=int, help="cases of each group; the whole benchmark's if left out")
    asked.add_argument("--seed", type=int, help="drawn from the commit and the time if left out")
    asked.add_argument("--minutes", type=float, default=9.0, help="after which no new case is begun")
    asked.add_argument("--workers", type=int, default=1)
    asked.set_defaults(do=run)
    table = verbs.add_parser("summary", help="figures with intervals")
    table.add_argument("results", type=Path, nargs="+", help="JSON lines")
    table.add_argument("--out", type=Path, required=True, help="without ending: .json is written")
    table.set_defaults(do=summary)
    args = whole.parse_args()
    try:
        args.do(args)
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
