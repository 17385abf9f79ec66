"""Sets of foreign cases: seed, twins with other stated noise, and how logs and sealed truths are written."""

from __future__ import annotations

import argparse
import datetime
import hashlib
import json
from pathlib import Path
from typing import Any

from . import bed, cases, told
from .work import commit

TUNE_SEED = 20261123
TWIN_EVERY = 5
"""One table of so many is also written with stated noise 30 % too large and 30 % too small."""
TWINS = {"loud": 1.3, "quiet": 1.0 / 1.3}


def make(args: argparse.Namespace) -> None:
    """Writes logs and sealed truths of tables; goes on where it was stopped."""
    folder: Path = args.out
    folder.mkdir(parents=True, exist_ok=True)
    seed = int(campaign(folder, args.set, args.seed)["seed"])
    jobs = cases.plan(args.set, args.tables) if args.tables else []
    for number, (group, hidden) in enumerate(jobs):
        name = f"{args.set}-{number:03d}"
        sealed = folder / "truth" / f"{name}.json"
        if sealed.is_file():
            continue
        case = cases.draw(args.set, seed, number, group, hidden)
        truth = cases.summary(case) | {"separable": told.separable(case)}
        bed.write(case, folder / "logs" / name)
        twins = []
        if number % TWIN_EVERY == 0 and case.replicates == 1:
            for word, factor in TWINS.items():
                bed.write(case, folder / "logs" / f"{name}-{word}", factor)
                twins.append(f"{name}-{word}")
        truth["twins"] = twins
        sealed.parent.mkdir(exist_ok=True)
        sealed.write_text(json.dumps(truth, indent=1) + "\n", encoding="utf-8")
        said = ", ".join(f"{k} {v['sigma']:.0f} ({v['sigma_blind']:.0f}) sigma" for k, v in truth["separable"].items())
        print(f"{name}  {group:<8} {case.world.law:<9} {said or 'nothing hidden'}", flush=True)


def campaign(folder: Path, which: str, seed: int | None) -> dict[str, Any]:
    """What a folder's set is: its seed, and the commit that it was drawn from; written where it is new."""
    path = folder / "campaign.json"
    if path.is_file():
        about = json.loads(path.read_text(encoding="utf-8"))
        if about["set"] != which or (seed is not None and int(about["seed"]) != seed):
            raise SystemExit(f"{path}: holds set {about['set']} of seed {about['seed']}; name another folder.")
        return about
    head, dirty = commit()
    if which == "report" and seed is None and not head:
        raise SystemExit("The report set is drawn from the commit, and git tells none: set LUNAR_MJX_COMMIT to it.")
    drawn = TUNE_SEED if which == "tune" else int.from_bytes(hashlib.sha256(head.encode()).digest()[:6], "big")
    about = {
        "set": which,
        "seed": str(drawn if seed is None else seed),
        "seed_given": seed is not None,
        "commit": head,
        "uncommitted_changes": dirty,
        "made": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    path.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return about
