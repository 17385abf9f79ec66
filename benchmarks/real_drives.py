"""Real Husky drives through compare, why and add, beside a black box and a constant on the same windows.

    lunar-mjx log import BorealTC/FLOORING --map husky_borealtc -o LOGS/flooring --set ground=flooring   # and so on
    python -m benchmarks.real_drives LOGS -o benchmarks/real_drives.json [--sequences 2] [--seconds 120]

LOGS holds the campaigns asphalt, flooring, ice, sandy_loam and snow of BorealTC (LaRocque et al. 2024, CC0 1.0).
A model is fitted on two thirds of the hard floors; every sequence is then asked about alone; SNOW and SANDY_LOAM go
through refit and addition with every third sequence held out. The black box (gradient-boosted trees of scikit-learn,
needed by this script alone) sees speeds, turn and slope with two lags.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import time
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.commands.compiled import keep_compiled
from lunar_mjx.diagnosis import verbs
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, cut
from lunar_mjx.diagnosis.drives.windows.problem import corners
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.logs import read_campaign
from lunar_mjx.model import Model
from lunar_mjx.model.file import load_model
from lunar_mjx.resources import shipped

HARD, SOFT = ("asphalt", "flooring"), ("sandy_loam", "snow")
GROUND = frozenset({"soft_ground", "rolling_resistance"})
LONG_ENOUGH_S = 30.0


def tables(run: Run) -> dict[str, dict[str, float]]:
    """Root mean square errors in SI units by split and channel, of the model as given and refitted."""
    out: dict[str, dict[str, list[tuple[int, float]]]] = {}
    for row in run.load("comparison.json")["by_channel"]:
        for label in ("as_given", "refitted"):
            key = f"{label}, {row['split']}"
            out.setdefault(key, {}).setdefault(row["channel"], []).append((row["samples"], row[f"{label}_si"]))
    return {
        k: {c: float(np.sqrt(sum(n * e**2 for n, e in v) / sum(n for n, _ in v))) for c, v in by.items()}
        for k, by in out.items()
    }


def black_box(run: Run, model: Model) -> dict[str, dict[str, float]]:
    """Errors of gradient-boosted trees, of a constant, on the held-out windows of a run; SI units by channel."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    logs = read_campaign(run.logs)
    used = run.load("windows.json")["used"]
    found = cut(logs, corners(model), 0.165, len(used), run.seed)
    split = np.array([w["split"] for w in used])
    speed, up = np.asarray(found.imposed.speed), np.stack([found.imposed.up_x, found.imposed.up_y], -1)
    # samples stand between half bins: every second edge from the first
    left, right = speed[:, 1::2, 0], speed[:, 1::2, 1]
    columns = [up[:, 1::2, 0], up[:, 1::2, 1]]
    for series in (left, right, right - left, left + right):
        for lag in (0, 1, 2):
            columns.append(
                np.concatenate([np.repeat(series[:, :1], lag, axis=1), series[:, : series.shape[1] - lag]], 1)
            )
    features = np.stack(columns, axis=-1)
    out: dict[str, dict[str, float]] = {"black box": {}, "constant": {}}
    for channel in CHANNELS:
        value = found.measured[channel]
        ok = np.isfinite(value).all(axis=1)
        train, test = ok & (split == "fit"), ok & (split == "test")
        if train.sum() < 3 or test.sum() < 1:
            continue
        x, y = features[train].reshape(-1, features.shape[-1]), value[train].ravel()
        trees = HistGradientBoostingRegressor(max_iter=150, learning_rate=0.05, min_samples_leaf=10, random_state=0)
        guess = trees.fit(x, y).predict(features[test].reshape(-1, features.shape[-1]))
        truth = value[test].ravel()
        out["black box"][channel] = float(np.sqrt(np.mean((truth - guess) ** 2)))
        out["constant"][channel] = float(np.sqrt(np.mean((truth - y.mean()) ** 2)))
    return out


def driving_s(folder: Path) -> float:
    """Seconds of a log in which a side turns."""
    log = read_campaign([folder])[0]
    time_s, speed = log.channel("joint_left_drive_speed_rad_s")  # type: ignore[misc, union-attr]
    return float(np.median(np.diff(time_s)) * np.sum(np.abs(speed) > 0.1))


def ask(folder: Path, model: Model, out: Path, seconds: float) -> dict[str, Any]:
    """One sequence: comparison and verdict."""
    begin = time.monotonic()
    run = verbs.compare([folder], model, out)
    answer = verbs.why(run, seconds=seconds)
    chance = answer.details.get("probability", {})
    ground = sum(p for name, p in chance.items() if GROUND & set(name.split(" + ")))
    return {
        "sequence": f"{folder.parent.name}/{folder.name}",
        "driving_s": driving_s(folder),
        "verdict": answer.verdict.label,
        "named": list(answer.effects),
        "probability": {k: round(v, 4) for k, v in list(chance.items())[:6]},
        "ground_probability": ground,
        "error_sigma": {"the model": answer.error_before, "best": answer.error_after},
        "seconds": round(time.monotonic() - begin, 1),
    }


def loop(name: str, logs: Path, model: Model, out: Path, seconds: float) -> dict[str, Any]:
    """Refit, why, and addition of soft ground on a campaign with every third sequence held out."""
    begin = time.monotonic()
    run = verbs.compare([logs / name], model, out / f"{name}_1")
    answer = verbs.why(run, seconds=seconds)
    run = verbs.compare([logs / name], model, out / f"{name}_1b")
    effect = next((e for e in answer.effects if e in GROUND), "soft_ground")
    grown = verbs.add(run, effect, out / f"{name}_2")
    return {
        "verdict": answer.verdict.label,
        "named": list(answer.effects),
        "probability": {k: round(v, 4) for k, v in list(answer.details.get("probability", {}).items())[:6]},
        "added": effect,
        "errors_before": tables(run),
        "errors_after": tables(grown),
        "warnings": grown.load("comparison.json")["certificate"]["problems"],
        **black_box(run, model),
        "seconds": round(time.monotonic() - begin, 1),
    }


def main() -> None:
    """Runs the benchmark and writes its JSON after every step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("logs", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("benchmarks/real_drives.json"))
    parser.add_argument("--runs", type=Path, default=Path("runs/real_drives"))
    parser.add_argument("--sequences", type=int, default=99, help="sequences of every ground at most")
    parser.add_argument("--seconds", type=float, default=240.0, help="time of every search")
    args = parser.parse_args()
    keep_compiled()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    result: dict[str, Any] = {"commit": commit.stdout.strip(), "sequences": [], "campaigns": {}}

    def keep() -> None:
        args.out.write_text(json.dumps(result, indent=1) + "\n")

    base = load_model(shipped("models") / "husky" / "hard_floor.toml")
    hard = verbs.compare([args.logs / g for g in HARD], base, args.runs / "hard")
    result["hard_floors"] = {
        "errors": tables(hard),
        "parameters": hard.load("comparison.json")["parameters"],
        **black_box(hard, base),
    }
    keep()
    model = load_model(args.runs / "hard" / "fitted.toml")
    for name in SOFT:
        result["campaigns"][name] = loop(name, args.logs, model, args.runs, args.seconds)
        keep()
    held = {w["log"] for w in hard.load("windows.json")["used"] if w["split"] == "test"}
    for ground in (*SOFT, "ice", *HARD):
        folders = [f for f in sorted((args.logs / ground).iterdir()) if driving_s(f) >= LONG_ENOUGH_S]
        if ground in HARD:
            folders = [f for f in folders if f"{ground}/{f.name}" in held]
        for folder in folders[: args.sequences]:
            result["sequences"].append(ask(folder, model, args.runs / ground / folder.name, args.seconds))
            keep()


if __name__ == "__main__":
    main()
