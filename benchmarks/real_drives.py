"""Real drives through import, compare, why and add, beside a black box, another tool's refit and a constant.

    python -m benchmarks.real_drives DATA -o benchmarks/real_drives.json [--processes 15] [--minutes 9] [--seconds 90]

DATA holds the folders husky_borealtc (BorealTC, LaRocque et al. 2024, CC0 1.0), husky_drive (DRIVE, Baril et al. 2024,
BSD-3) and cuadriga_camis (CAMIS_python, University of Malaga, MIT) as their authors publish them. Needs
`pip install 'lunar-mjx[baselines]'`. On 15 cores about ten minutes; on two cores two hours. What is not begun when
the minutes are over is listed as not done; called again, the script goes on with what its runs folder lacks. What the
JSON holds of earlier runs stays, each row with its commit, until the same job is run again (`--only NAME` for some).

Sequences. A BorealTC sequence's number modulo 3 says what it is for: 1 to fit, 2 to report, 0 is kept for others and
not read here. Everything below is on sequences that were not fitted:
- names: the model fitted on hard floors (FLOORING, ASPHALT) is asked about every single sequence of at least 30 s of
  driving (hard floors: all); soft ground should be named on SNOW and SANDY_LOAM, nothing of it on hard floors; ICE is
  shown beside.
- faults: planted into the raw files of the hard floors' sequences: left current x 0.8, rim speeds x 1.03 (a radius 3 %
  off), currents 0.15 s late, accelerometer pitched by 2 degrees. Found is what is among at most three names. Each is
  asked of every single sequence, and of all sequences together of one floor and of both: a fault of a rover stays from
  one drive to the next. The same campaigns without a fault, and those of other grounds, are asked as well.
- loops: SNOW, SANDY_LOAM and ICE: refit and addition on sequences to fit, errors on sequences to report; so for DRIVE
  and Cuadriga, whose every third drive is reported.
- the black box (gradient-boosted trees on speeds and turn with lags, and slope) and the constant learn from all windows
  of the fitted sequences; mujoco.sysid refits the baseline's unknowns on the windows that our refit sees.
Intervals are of 2,000 draws of sequences (errors) or Clopper's (rates), 95 %.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import io
import json
import os
import queue
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "disable")
os.environ.setdefault("JAX_PLATFORMS", "cpu")

import numpy as np
import pandas as pd
from scipy import stats

HARD, SOFT, ICE = ("ASPHALT", "FLOORING"), ("SANDY_LOAM", "SNOW"), ("ICE",)
FIT, REPORT = 1, 2
GROUND = frozenset({"soft_ground", "rolling_resistance"})
"""The family of soft ground."""
TRUE_OF = {"ice": {"hard_ground.mu"}}
"""What beside soft ground may be named of a ground."""
LOOKED_AT = (
    *("ICE-02", "SANDY_LOAM-05", "SANDY_LOAM-08", "SNOW-11", "SNOW-14", "SNOW-20"),
    *("FLOORING-02", "FLOORING-05", "FLOORING-08", "ASPHALT-05"),
)
"""Sequences to report that had been looked at while the method was made."""
LONG_ENOUGH_S = 30.0
"""Driving of a soft ground's sequence that is asked about; hard floors have few sequences, so that all are."""
ALL, BOTH = "all", "HARD"
"""All sequences to report of a ground in one campaign; the name of both hard floors together."""
MOST_IN_CLASS = 3
NAMING = ("KNOWN", "KNOWN_CLASS", "MULTIPLE")
"""Verdicts that name something."""
FAULTS = {
    "current": "calibration.current_left",
    "radius": "wheel_radius_error",
    "clock": "calibration.current_clock",
    "pitch": "calibration.pitch",
}
"""Planted faults, and what should be named."""
CAMPAIGNS = {
    "husky_drive": ("husky_drive/husky.csv", "husky_drive"),
    "cuadriga": ("cuadriga_camis/20190624", "cuadriga_camis"),
}


# --- one job, in a process of its own ---------------------------------------------------------------------------------


def sequences(data: Path, ground: str, use: int) -> list[str]:
    """Numbers of a ground's sequences that are for `use`."""
    found = sorted(p.stem[4:] for p in (data / "husky_borealtc" / ground).glob("pro_*.csv"))
    return [n for n in found if int(n) % 3 == use]


def imported(data: Path, ground: str, numbers: Sequence[str], out: Path, fault: str = "") -> list[Path]:
    """Logs of some sequences, imported by the shipped map, with a fault planted into the files before."""
    from lunar_mjx.logs.readers.import_log import import_log

    logs = []
    for n in numbers:
        folder = out / ground.lower() / n
        folder.parent.mkdir(parents=True, exist_ok=True)
        # jobs of one sequence may begin at the same time
        with (folder.parent / f"{n}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / "log.toml").exists():
                files = [data / "husky_borealtc" / ground / f"{kind}_{n}.csv" for kind in ("pro", "imu")]
                files = [f for f in files if f.exists()]
                if fault:
                    files = [spoilt(f, fault, out / "raw" / fault / ground) for f in files]
                import_log(files, folder, "husky_borealtc", changes={"ground": ground.lower()})
        logs.append(folder)
    return logs


def spoilt(file: Path, fault: str, out: Path) -> Path:
    """A copy of a recorded file with a fault in it."""
    out.mkdir(parents=True, exist_ok=True)
    table = pd.read_csv(file)
    if file.name.startswith("pro"):
        if fault == "current":
            table["curL"] *= 0.8
        if fault == "radius":
            table[["velL", "velR"]] *= 1.03
        if fault == "clock":
            time_s = table["time"].to_numpy()
            for column in ("curL", "curR"):
                table[column] = np.interp(time_s - 0.15, time_s, table[column].to_numpy())
    elif fault == "pitch":
        x, z, turn = table["ax"].copy(), table["az"].copy(), np.radians(2.0)
        table["ax"], table["az"] = np.cos(turn) * x + np.sin(turn) * z, np.cos(turn) * z - np.sin(turn) * x
    table.to_csv(out / file.name, index=False)
    return out / file.name


def driving_s(folder: Path) -> float:
    """Seconds of a log in which a side turns."""
    from lunar_mjx.logs import read_campaign

    log = read_campaign([folder])[0]
    time_s, speed = log.channel("joint_left_drive_speed_rad_s")  # type: ignore[misc, union-attr]
    return float(np.median(np.diff(time_s)) * np.sum(np.abs(speed) > 0.1))


def answer_of(answer: Any) -> dict[str, Any]:
    """What a diagnosis says, shortly."""
    chance = answer.probabilities
    inclusion = sorted(answer.inclusion.items(), key=lambda item: -item[1])
    return {
        "verdict": answer.verdict.label,
        "named": list(answer.effects),
        "unlisted": answer.unlisted,
        "port": answer.port,
        "probability": {k: round(v, 4) for k, v in list(chance.items())[:6]},
        "inclusion": {k: round(v, 4) for k, v in inclusion[:6]},
        "ground_probability": round(sum(p for n, p in chance.items() if GROUND & set(n.split(" + "))), 4),
        "held_out": answer.details.get("held_out"),
        "discrepancy": {k: round(v["size"], 4) for k, v in answer.discrepancy.items()},
        "sentence": answer.sentence,
        "not_tried": len(answer.details.get("not_tried", [])),
    }


def hard(data: Path, runs: Path) -> dict[str, Any]:
    """The model fitted on hard floors."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.model.hard_floor import hard_floor

    logs = [f for g in HARD for f in imported(data, g, sequences(data, g, FIT), runs / "logs")]
    run = verbs.compare(logs, hard_floor("husky"), runs / "hard", splits={f.name: "fit" for f in logs})
    found = run.load("comparison.json")
    return {k: found[k] for k in ("as_given", "refitted", "parameters", "between_logs", "not_told", "certificate")}


def ask(data: Path, runs: Path, ground: str, number: str, fault: str, seconds: float) -> dict[str, Any]:
    """One sequence, or all of a ground in one campaign: comparison and verdict."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.model.file import load_model

    begin = time.monotonic()
    place = runs / "faults" / fault if fault else runs
    grounds = HARD if ground == BOTH else (ground,)
    logs = []
    for g in grounds:
        logs += imported(data, g, sequences(data, g, REPORT) if number == ALL else [number], place / "logs", fault)
    span = sum(map(driving_s, logs))
    out: dict[str, Any] = {"ground": ground, "sequence": number, "fault": fault, "driving_s": span}
    if span < LONG_ENOUGH_S and ground not in HARD:
        return {**out, "verdict": "too short"}
    run = verbs.compare(logs, load_model(runs / "hard" / "fitted.toml"), place / "asked" / ground / number)
    out |= answer_of(verbs.why(run, seconds=seconds))
    return {**out, "seconds": round(time.monotonic() - begin, 1)}


def loop(data: Path, runs: Path, name: str, seconds: float) -> dict[str, Any]:
    """Refit, why and addition on a campaign, with errors by sequence on what was not fitted."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.errors import UserError
    from lunar_mjx.logs.readers.import_log import import_drives
    from lunar_mjx.model.file import load_model
    from lunar_mjx.model.hard_floor import hard_floor

    begin = time.monotonic()
    splits: dict[str, str] = {}
    if name in CAMPAIGNS:
        file, mapping = CAMPAIGNS[name]
        folder = runs / "logs" / name
        logs = [folder] if folder.exists() else list(import_drives([data / file], folder, mapping).logs)
        model = hard_floor("husky" if name == "husky_drive" else "cuadriga")
    else:
        logs = []
        for use, split in ((FIT, "fit"), (REPORT, "test")):
            mine = imported(data, name, sequences(data, name, use), runs / "logs")
            logs += mine
            splits |= {f.name: split for f in mine}
        model = load_model(runs / "hard" / "fitted.toml")
    run = verbs.compare(logs, model, runs / "loops" / f"{name}_1", splits=splits)
    errors = {"as given": series_errors(run, "as given"), "refit": series_errors(run, "refitted")}
    errors |= beside(run)
    answer = verbs.why(run, seconds=seconds)
    out = {"campaign": name, **answer_of(answer), "errors": errors}
    effects = list(answer.effects) if answer.verdict.label in NAMING else []
    if name in SOFT and not GROUND & set(effects):
        effects = ["soft_ground", *effects]
    out["added"] = []
    for k, effect in enumerate(effects[:2]):
        try:
            child = verbs.add(run, effect, runs / "loops" / f"{name}_{k + 2}")
        except UserError as error:
            out["warnings"] = [str(error)]
            break
        compared = child.load("comparison.json")
        out["warnings"] = compared["certificate"]["problems"]
        # `add` says where an addition makes even the fitted windows worse, and nobody would go on from there
        if compared["refitted"]["fit"] > run.load("comparison.json")["refitted"]["fit"]:
            continue
        run = child
        errors["end of loop"] = series_errors(run, "refitted")
        out["added"].append(effect)
    return {**out, "seconds": round(time.monotonic() - begin, 1)}


def hour(data: Path, runs: Path, seconds: float) -> dict[str, Any]:
    """Time from recordings of about an hour to a verdict, on two cores."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.logs.readers.import_log import import_drives
    from lunar_mjx.model.file import load_model

    begin = time.monotonic()
    span = 0.0
    logs: list[Path] = []
    for ground in ("FLOORING", "ASPHALT", "SNOW", "SANDY_LOAM", "ICE"):
        if span > 3600.0:
            break
        found = import_drives([data / "husky_borealtc" / ground], runs / "hour" / ground, "husky_borealtc")
        span += sum(found.seconds)
        logs += found.logs
    read = time.monotonic() - begin
    run = verbs.compare(logs, load_model(runs / "hard" / "fitted.toml"), runs / "hour" / "run")
    compared = time.monotonic() - begin
    answer = verbs.why(run, seconds=max(1.0, seconds))
    return {
        "log_s": span,
        "import_s": round(read, 1),
        "compare_s": round(compared - read, 1),
        "why_s": round(time.monotonic() - begin - compared, 1),
        "seconds": round(time.monotonic() - begin, 1),
        "cores": len(os.sched_getaffinity(0)),
        **answer_of(answer),
    }


def series_errors(run: Any, label: str) -> dict[str, dict[str, list[float]]]:
    """Sums of squares and numbers of samples on held-out windows, by channel and log, of a run's stored series."""
    with np.load(run.folder / "series.npz") as file:
        data = {k: file[k] for k in file.files}
    row = list(data["labels"]).index(label)
    held = np.isin(data["split"][data["unit"]], ("test", "select"))
    stops = [*data["series_start"][1:], len(data["measured"])]
    out: dict[str, dict[str, list[float]]] = {}
    for start, stop, channel, log in zip(
        data["series_start"], stops, data["series_channel"], data["series_log"], strict=True
    ):
        mine = np.arange(start, stop)[held[start:stop]]
        if len(mine):
            off = data["measured"][mine] - data["predicted"][row][mine]
            out.setdefault(str(channel), {})[str(data["logs"][log])] = [float(np.sum(off**2)), len(mine)]
    return out


def features(found: Any) -> np.ndarray:
    """(window, sample, feature) speeds, turn and slope with two lags."""
    speed, up = np.asarray(found.imposed.speed), (found.imposed.up_x, found.imposed.up_y)
    left, right = speed[:, 1::2, 0], speed[:, 1::2, 1]
    columns = [np.asarray(u)[:, 1::2] for u in up]
    for series in (left, right, right - left, left + right):
        for lag in (0, 1, 2):
            padded = np.concatenate([np.repeat(series[:, :1], lag, axis=1), series[:, : series.shape[1] - lag]], axis=1)
            columns.append(padded)
        columns.append(np.gradient(series, axis=1))
    return np.stack(columns, axis=-1)


def beside(run: Any) -> dict[str, Any]:
    """The held-out errors of gradient-boosted trees, of a constant and of mujoco.sysid, as `series_errors`."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    from lunar_mjx.diagnosis.drives.windows.bench import Bench
    from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, cut
    from lunar_mjx.diagnosis.drives.windows.problem import corners

    logs = run.campaign()
    bench = Bench(run, logs)
    held = bench.held_out
    names = np.array(bench.names)
    seen = sorted(set(bench.cut.log[bench.fitted].tolist()))
    radius = float(np.mean([w.radius for w in run.model.rover.wheels]))
    everything = cut([logs[k] for k in seen], corners(run.model), radius, 10**6, run.seed)
    train, test = features(everything), features(bench.cut)

    def squares(value: np.ndarray, guess: np.ndarray, channel: str) -> dict[str, list[float]]:
        out = {}
        for k in sorted(set(bench.cut.log[held].tolist())):
            mine = (held & (bench.cut.log == k))[:, None] & np.isfinite(value)
            if mine.any():
                out[str(names[k])] = [float(np.sum((value[mine] - guess[mine]) ** 2)), int(mine.sum())]
        return out

    result: dict[str, Any] = {"black box": {}, "constant": {}, "mujoco.sysid": {}}
    for channel in CHANNELS:
        value, taught = bench.cut.measured[channel], everything.measured[channel]
        ok = np.isfinite(taught)
        if ok.sum() < 30 or not (np.isfinite(value) & held[:, None]).any():
            continue
        trees = HistGradientBoostingRegressor(max_iter=200, learning_rate=0.05, min_samples_leaf=20, random_state=0)
        trees.fit(train[ok], taught[ok])
        guess = trees.predict(test.reshape(-1, test.shape[-1])).reshape(value.shape)
        result["black box"][channel] = squares(value, guess, channel)
        result["constant"][channel] = squares(value, np.full(value.shape, taught[ok].mean()), channel)
    predicted = sysid_refit(bench)
    if predicted is not None:
        for c, channel in enumerate(CHANNELS):
            found = squares(bench.cut.measured[channel], predicted[c], channel)
            if found:
                result["mujoco.sysid"][channel] = found
    return result


def sysid_refit(bench: Any, most: int = 15) -> np.ndarray | None:
    """(channel, window, sample) predictions of the baseline refitted by mujoco.sysid, without priors, within bounds."""
    try:
        from mujoco import sysid
    except ImportError:
        return None
    if not hasattr(sysid, "optimize"):
        return None
    problem, noise = bench.problem(None), bench.noise()
    used = problem.there & bench.fitted[:, None]
    count = len(bench.base)

    def residual_fn(x: np.ndarray, params: Any) -> tuple[list[np.ndarray], None, None]:
        del params
        rows = np.atleast_2d(np.asarray(x, float).T if np.ndim(x) == 2 else np.asarray(x, float))
        predicted = problem.predict(bench.base, np.clip(rows, -3.0, 3.0))
        out = [problem.whitened(-problem.residual(p)[..., None], noise)[..., 0][used] for p in predicted]
        return [out[0] if np.ndim(x) == 1 else np.stack(out, axis=1)], None, None

    params = sysid.ParameterDict()
    for q in bench.base:
        params.add(sysid.Parameter(q.key, 0.0, -3.0, 3.0))
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(params, residual_fn, verbose=False, max_iters=most)
    u = np.clip(np.asarray(found.as_vector(), float).ravel(), -3.0, 3.0)
    assert len(u) == count
    return np.asarray(problem.predict(bench.base, u[None])[0])


# --- all jobs ---------------------------------------------------------------------------------------------------------


def jobs_of(data: Path) -> list[dict[str, Any]]:
    """Every job but the first, the most telling first."""
    out: list[dict[str, Any]] = [{"kind": "loop", "name": name} for name in (*SOFT, *ICE, *CAMPAIGNS)]
    out += [
        {"kind": "ask", "ground": g, "number": n, "fault": ""}
        for g in (*SOFT, *HARD, *ICE)
        for n in sequences(data, g, REPORT)
    ]
    out += [{"kind": "ask", "ground": g, "number": ALL, "fault": ""} for g in (*SOFT, *ICE, *HARD, BOTH)]
    out += [{"kind": "ask", "ground": g, "number": ALL, "fault": f} for g in (*HARD, BOTH) for f in FAULTS]
    out += [
        {"kind": "ask", "ground": g, "number": n, "fault": fault}
        for n in sorted({n for g in HARD for n in sequences(data, g, REPORT)})
        for g in HARD
        if n in sequences(data, g, REPORT)
        for fault in FAULTS
        if fault != "pitch" or (data / "husky_borealtc" / g / f"imu_{n}.csv").exists()
    ]
    return out


def job_name(job: Mapping[str, Any]) -> str:
    """A job's name, such as `ask-SNOW-05` or `ask-FLOORING-02-clock`."""
    return "-".join(str(job[k]) for k in ("kind", "name", "ground", "number", "fault") if job.get(k))


def do(job: Mapping[str, Any], data: Path, runs: Path, seconds: float) -> dict[str, Any]:
    """Does a job in this process."""
    from lunar_mjx.commands.compiled import keep_compiled

    keep_compiled()
    if job["kind"] == "hard":
        return hard(data, runs)
    if job["kind"] == "ask":
        return ask(data, runs, job["ground"], job["number"], job["fault"], seconds)
    if job["kind"] == "hour":
        return hour(data, runs, seconds)
    return loop(data, runs, job["name"], 2.0 * seconds)


def rate(good: int, of: int) -> dict[str, Any]:
    """A rate with Clopper's and Pearson's interval."""
    found = stats.binomtest(good, of).proportion_ci() if of else None
    return {"of": of, "count": good, "interval": [round(found.low, 3), round(found.high, 3)] if found else None}


CURRENTS = ("motor_left_drive_current_A", "motor_right_drive_current_A")


def relative(errors: Mapping[str, Any], channels: Iterable[str], first: str, second: str) -> dict[str, Any] | None:
    """Root mean square error of one model over another's on the same windows, with an interval over sequences."""
    rows = []
    for channel in channels:
        for log, (square, count) in errors.get(second, {}).get(channel, {}).items():
            mine = errors.get(first, {}).get(channel, {}).get(log)
            if mine is not None:
                rows.append((log, mine[0], square, count))
    logs = sorted({r[0] for r in rows})
    if not logs:
        return None
    table = np.array([[sum(r[k] for r in rows if r[0] == log) for k in (1, 2)] for log in logs])
    draws = np.random.default_rng(0).integers(0, len(logs), (2000, len(logs)))
    ratio = np.sqrt(table[draws, 0].sum(axis=1) / table[draws, 1].sum(axis=1))
    low, high = np.quantile(ratio, (0.025, 0.975))
    whole = float(np.sqrt(table[:, 0].sum() / table[:, 1].sum()))
    return {"ratio": round(whole, 3), "interval": [round(float(low), 3), round(float(high), 3)], "sequences": len(logs)}


def rms(errors: Mapping[str, Any], label: str, channels: Iterable[str]) -> float | None:
    """Root mean square error in the channels' unit."""
    found = [v for c in channels for v in errors.get(label, {}).get(c, {}).values()]
    return round(float(np.sqrt(sum(v[0] for v in found) / sum(v[1] for v in found))), 4) if found else None


def named_fault(row: Mapping[str, Any]) -> bool:
    """Whether a planted fault is among at most three names."""
    return row["verdict"] in NAMING and FAULTS[row["fault"]] in row["named"] and len(row["named"]) <= MOST_IN_CLASS


def summary(done: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """The figures of the issue's table."""
    asked = [r for r in done if r.get("kind") == "ask" and r.get("verdict") not in (None, "too short", "failed")]
    plain = [r for r in asked if not r["fault"] and r["number"] != ALL]
    together = [r for r in asked if r["number"] == ALL]
    out: dict[str, Any] = {}
    for label, grounds in (("soft", SOFT), ("hard", HARD), ("ice", ICE)):
        mine = [r for r in plain if r["ground"] in grounds]
        out[f"commits, {label}"] = sorted({r.get("commit", "") for r in mine})
        named = [r for r in mine if r["verdict"] in NAMING and GROUND & set(r["named"])]
        likely = [r for r in mine if r["ground_probability"] >= 0.95]
        out[f"ground named, {label}"] = rate(len(named), len(mine))
        fresh = [r for r in mine if f"{r['ground']}-{r['sequence']}" not in LOOKED_AT]
        out[f"ground named, {label}, never looked at"] = rate(sum(r in named for r in fresh), len(fresh))
        out[f"ground at 95 %, {label}"] = rate(len(likely), len(mine))
        wrong = [r for r in mine if r["verdict"] in NAMING and set(r["named"]) - GROUND - TRUE_OF.get(label, set())]
        out[f"something else named, {label}"] = rate(len(wrong), len(mine))
        verdicts = [r["verdict"] for r in mine]
        out[f"verdicts, {label}"] = {v: verdicts.count(v) for v in sorted(set(verdicts))}
    for label, rows in (("", [r for r in asked if r["number"] != ALL]), (", campaigns", together)):
        for fault in (*FAULTS, ""):
            mine = [r for r in rows if r["fault"] and fault in ("", r["fault"])]
            name = f"fault {fault}" if fault else "faults found"
            out[f"{name}{label}"] = rate(sum(map(named_fault, mine)), len(mine))
        mine = [r for r in rows if r["fault"]]
        wrong = [r for r in mine if r["verdict"] in NAMING and set(r["named"]) - {FAULTS[r["fault"]]}]
        out[f"wrong names beside faults{label}"] = rate(len(wrong), len(mine))
    out["campaigns"] = {
        r["ground"]: {"verdict": r["verdict"], "named": r["named"], "ground": r["ground_probability"]}
        for r in together
        if not r["fault"]
    }
    for r in done:
        if r.get("kind") != "loop" or "errors" not in r:
            continue
        errors, end = r["errors"], "end of loop" if "end of loop" in r["errors"] else "refit"
        parts = {
            "current A": CURRENTS,
            "yaw rate rad/s": ("gyro_z_rad_s",),
            "speed ahead m/s": ("body_velocity_x_m_s",),
        }
        out[f"loop {r['name']}"] = {
            unit: {
                **{label: rms(errors, label, channels) for label in errors},
                "loop over black box": relative(errors, channels, end, "black box"),
                "loop over refit": relative(errors, channels, end, "refit"),
            }
            for unit, channels in parts.items()
            if rms(errors, "refit", channels) is not None
        }
        current = out[f"loop {r['name']}"].get("current A")
        if current and current.get("black box") and current["refit"] > current["black box"]:
            gained = (current["refit"] - (current.get("end of loop") or current["refit"])) / (
                current["refit"] - current["black box"]
            )
            current["gain over the black box's gain"] = round(gained, 3)
    return out


BEGIN, END = "<!-- real drives: benchmarks/real_drives.py -->", "<!-- end real drives -->"


def page_table(result: Mapping[str, Any]) -> str:
    """The measured figures as Markdown."""
    found = result["summary"]
    kinds = {"ask": "names and faults", "loop": "errors", "hour": "the hour"}
    of = {k: sorted({r.get("commit", result["commit"]) for r in result["jobs"] if r.get("kind") == k}) for k in kinds}
    measured = "; ".join(f"{kinds[k]} at {', '.join(commits)}" for k, commits in of.items() if commits)
    lines = [
        f"Commits: {measured}. Sequences that were not fitted; 95 % intervals.",
        "",
        "| what | measured | interval | of |",
        "|---|---|---|---|",
    ]

    def share(label: str, key: str) -> None:
        r = found[key]
        if r["of"]:
            low, high = r["interval"]
            lines.append(
                f"| {label} | {100 * r['count'] / r['of']:.0f} % | {100 * low:.0f} to {100 * high:.0f} % | {r['of']} |"
            )

    share("soft ground named, SNOW and SANDY_LOAM", "ground named, soft")
    share("... hard floors", "ground named, hard")
    share("names other than soft ground, SNOW and SANDY_LOAM", "something else named, soft")
    share("... hard floors", "something else named, hard")
    share("soft ground named, ICE", "ground named, ice")
    for label, where in (("soft", "SNOW and SANDY_LOAM"), ("hard", "hard floors"), ("ice", "ICE")):
        verdicts = ", ".join(f"{k} {n}" for k, n in found[f"verdicts, {label}"].items())
        if verdicts:
            lines.append(f"| verdicts, {where} | {verdicts} | | {found[f'ground named, {label}']['of']} |")
    for label, where in (("", "one sequence"), (", campaigns", "a campaign of one floor or both")):
        share(f"planted faults among at most three names, {where}", f"faults found{label}")
        for fault, name in FAULTS.items():
            share(f"... {fault} (`{name}`)", f"fault {fault}{label}")
        share(f"... another name, {where}", f"wrong names beside faults{label}")
    for ground, said in found["campaigns"].items():
        names = ", ".join(said["named"]) or "-"
        lines.append(
            f"| all of {ground} together: {said['verdict']} | {names} | soft ground {said['ground']:.2f} | 1 |"
        )
    rows = [(k[5:], unit, v) for k, by in found.items() if k.startswith("loop ") for unit, v in by.items()]
    lines += [
        "",
        "Root mean square errors on held-out sequences, and the loop's error over that of the black box:",
        "",
        "| sequences | | constant | mujoco.sysid | refit | end of loop | black box | loop / black box |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, unit, v in rows:
        cells = [v.get(k) for k in ("constant", "mujoco.sysid", "refit", "end of loop", "black box")]
        ratio = v.get("loop over black box")
        shown = "-" if not ratio else f"{ratio['ratio']:.2f} ({ratio['interval'][0]:.2f} to {ratio['interval'][1]:.2f})"
        lines.append(
            f"| {name} | {unit} | " + " | ".join("-" if c is None else f"{c:.3g}" for c in cells) + f" | {shown} |"
        )
    hours = [j for j in result["jobs"] if j.get("kind") == "hour" and "log_s" in j]
    for h in hours:
        lines += [
            "",
            f"From recordings of {h['log_s']:.0f} s to a verdict on {h['cores']} cores: {h['seconds']:.0f} s (import "
            f"{h['import_s']:.0f}, compare {h['compare_s']:.0f}, why {h['why_s']:.0f}).",
        ]
    if result["not_done"]:
        lines += ["", f"{len(result['not_done'])} of the planned jobs are not done."]
    return "\n".join(lines)


def write_page(page: Path, result: Mapping[str, Any]) -> None:
    """Puts the figures between the page's marks."""
    text = page.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    after = rest.partition(END)[2]
    page.write_text(f"{before}{BEGIN}\n{page_table(result)}\n\n{END}{after}", encoding="utf-8")


DRAWN = Path(__file__).with_name("real_drives_drawn.npz")
"""What the pages' pictures of held-out windows show, since their runs are not kept."""
SHOWN = {
    "motor_left_drive_current_A": "current of the left motor, A",
    "motor_right_drive_current_A": "current of the right motor, A",
    "gyro_z_rad_s": "yaw rate, rad/s",
    "body_velocity_x_m_s": "speed ahead, m/s",
}


def joined(samples: np.ndarray, time: np.ndarray) -> list[np.ndarray]:
    """Samples of a drive, cut where more than two of its usual steps lie between two of them."""
    steps = np.diff(time[samples])
    return np.split(samples, np.flatnonzero(steps > 2.0 * np.median(steps)) + 1) if len(samples) > 1 else [samples]


def apart(values: np.ndarray, windows: Sequence[np.ndarray]) -> np.ndarray:
    """Values of windows one after another with a gap between them, since no time joins them."""
    return np.concatenate([np.append(values[window], np.nan) for window in windows if len(window)])


def lines_of(runs: Sequence[Path]) -> dict[str, np.ndarray]:
    """What a picture of held-out windows shows, by `CHANNEL/LABEL`: one value for each sample, NaN between windows.

    Args:
      runs: a folder of `compare`, and maybe one of `add` on it.
    """
    stored = []
    for run in runs[:2]:
        with np.load(run / "series.npz") as data:
            stored.append({k: data[k] for k in data.files})
    first = stored[0]
    held = np.isin(first["split"][first["unit"]], ("test", "select"))
    stops = [*first["series_start"][1:], len(first["measured"])]
    lines = {"as given": first["predicted"][0], "refitted": first["predicted"][1]}
    if len(stored) > 1:
        added = json.loads((runs[1] / "run.json").read_text(encoding="utf-8"))["added"]
        lines[f"with {', '.join(added)}"] = stored[1]["predicted"][1]
    lines["measured"] = first["measured"]
    out = {}
    for channel in (c for c in SHOWN if c in first["series_channel"]):
        parts = [
            part
            for a, b, c in zip(first["series_start"], stops, first["series_channel"], strict=True)
            if c == channel
            for part in joined(np.arange(a, b)[held[a:b]], first["time"])
        ]
        out |= {f"{channel}/{label}": apart(values, parts).astype(np.float32) for label, values in lines.items()}
    return out


def picture(lines: Mapping[str, np.ndarray], file: Path) -> None:
    """Draws held-out windows, one after another: measured, the model as given and refitted, and a later run's refit.

    Args:
      lines: see `lines_of`. file: light image to write; a dark one comes to lie beside it.
    """
    from matplotlib.figure import Figure

    from lunar_mjx.report.style import BLUE, INK, MUTED, ORANGE, save_light_and_dark, styled

    looks = {"as given": (MUTED, ":"), "refitted": (ORANGE, "--")}
    channels = list(dict.fromkeys(name.partition("/")[0] for name in lines))
    with styled():
        figure = Figure(figsize=(8.0, 2.0 * len(channels)), layout="constrained")
        every = figure.subplots(len(channels), squeeze=False)[:, 0]
        for axes, channel in zip(every, channels, strict=True):
            for name, values in lines.items():
                label = name.partition("/")[2]
                if not name.startswith(f"{channel}/"):
                    continue
                if label == "measured":
                    axes.plot(values, ".", color=INK, markersize=2.5, label=label)
                else:
                    colour, line = looks.get(label, (BLUE, "-"))
                    axes.plot(values, color=colour, linestyle=line, linewidth=1.2, label=label.replace("_", " "))
            axes.set_ylabel(SHOWN[channel], fontsize=8)
        # above the axes, where it hides no sample
        every[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False, ncols=4, fontsize=8)
        figure.supxlabel("samples of held-out windows, one after another, with a gap between them", fontsize=9)
        save_light_and_dark(figure, file, dpi=110)


def kept_lines(name: str) -> dict[str, np.ndarray]:
    """The lines of a picture of the pages, by its name without an ending."""
    with np.load(DRAWN) as kept:
        return {k.removeprefix(f"{name}/"): kept[k] for k in kept.files if k.startswith(f"{name}/")}


def keep_lines(name: str, lines: Mapping[str, np.ndarray]) -> None:
    """Keeps the lines of a picture of the pages, beside those of others: their runs would be too large."""
    others = {}
    if DRAWN.exists():
        with np.load(DRAWN) as kept:
            others = {k: kept[k] for k in kept.files if not k.startswith(f"{name}/")}
    np.savez_compressed(DRAWN, **others, **{f"{name}/{k}": v for k, v in lines.items()})


def run_all(args: argparse.Namespace) -> None:
    """Runs all jobs, each on a core of its own, and writes the JSON after each."""
    begin = time.monotonic()
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=False)
    now = args.commit or commit.stdout.strip()
    cores: queue.Queue[list[int]] = queue.Queue()
    available = sorted(os.sched_getaffinity(0))
    count = max(1, min(args.processes, len(available)))
    pair = [2] if args.hour else []
    spare = available[: 2 * len(pair)]
    for k in range(count - len(spare)) or [0]:
        cores.put([available[(len(spare) + k) % len(available)]])
    done: list[dict[str, Any]] = []
    wanted = [j for j in jobs_of(args.data) if not args.only or job_name(j) in args.only]
    before = json.loads(args.out.read_text()) if args.out.exists() else {"commit": "", "jobs": []}
    # what is not run again stays, with the commit that it was measured at
    earlier = [{"commit": before["commit"], **row} for row in before["jobs"] if row.get("verdict") != "failed"]

    def keep() -> None:
        tried = [job_name(r) for r in done]
        rows = [*done, *(r for r in earlier if job_name(r) not in tried)]
        known = [job_name(r) for r in rows]
        result = {
            "commit": now,
            "seconds_of_a_search": args.seconds,
            "summary": summary(rows),
            "not_done": [j for j in jobs_of(args.data) if job_name(j) not in known],
            "jobs": rows,
        }
        args.out.write_text(json.dumps(result, indent=1) + "\n")

    def one(job: dict[str, Any], own: list[int] | None = None) -> None:
        name = job_name(job)
        file = args.runs / "jobs" / f"{name}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        if not file.exists():
            mine = own or cores.get()
            try:
                if time.monotonic() - begin > 60.0 * args.minutes:
                    return
                command = [sys.executable, "-m", "benchmarks.real_drives", str(args.data), "-o", str(file)]
                command += ["--job", json.dumps(job), "--runs", str(args.runs), "--seconds", str(args.seconds)]
                limit = max(30.0, 60.0 * (args.minutes + args.grace) - (time.monotonic() - begin))
                with (args.runs / "jobs" / f"{name}.txt").open("w") as log:
                    subprocess.run(
                        command,
                        stdout=log,
                        stderr=log,
                        check=False,
                        timeout=limit,
                        preexec_fn=lambda: os.sched_setaffinity(0, mine),
                    )
            except subprocess.TimeoutExpired:
                pass
            finally:
                if own is None:
                    cores.put(mine)
        if file.exists():
            done.append({**job, "commit": now, **json.loads(file.read_text())})
        else:
            lines = (args.runs / "jobs" / f"{name}.txt").read_text().strip().splitlines()
            done.append({**job, "verdict": "failed", "error": lines[-1] if lines else "ran out of time"})
        print(f"{time.monotonic() - begin:.0f} s {name}: {done[-1].get('verdict', '')}", flush=True)
        keep()

    one({"kind": "hard"}, available)
    with ThreadPoolExecutor(count) as pool:
        tasks = [pool.submit(one, {"kind": "hour"}, spare)] if spare else []
        tasks += [pool.submit(one, job) for job in wanted]
        for task in tasks:
            task.result()
    keep()


def main() -> None:
    """Runs the benchmark, or one of its jobs."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--out", type=Path, default=Path("benchmarks/real_drives.json"))
    parser.add_argument("--runs", type=Path, default=Path("runs/real_drives"))
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=1e4, help="begin no job after these")
    parser.add_argument("--grace", type=float, default=0.5, help="minutes after which jobs under way are ended")
    parser.add_argument("--seconds", type=float, default=120.0, help="time of every search")
    parser.add_argument("--only", action="append", default=[], help="name of a job, such as ask-SNOW-05, to run alone")
    parser.add_argument("--hour", action="store_true", help="time an hour of log on two cores of its own")
    parser.add_argument("--commit", default="", help="where the checkout has no git")
    parser.add_argument("--job", default="", help="one job as JSON, as this script calls itself")
    parser.add_argument("--page", type=Path, help="write what OUT holds into this page, and run nothing")
    parser.add_argument("--picture", type=Path, help="draw the runs named in --of into this image, and run nothing")
    parser.add_argument("--of", type=Path, action="append", default=[], help="run folder to draw")
    parser.add_argument("--keep", action="store_true", help="keep its lines, from which benchmarks.figures draws")
    args = parser.parse_args()
    if args.picture:
        lines = lines_of(args.of)
        picture(lines, args.picture)
        if args.keep:
            keep_lines(args.picture.stem, lines)
        return
    if args.page:
        result = json.loads(args.out.read_text())
        write_page(args.page, {**result, "summary": summary(result["jobs"])})
        return
    if args.job:
        found = do(json.loads(args.job), args.data, args.runs, args.seconds)
        from lunar_mjx.diagnosis.runs import plain

        args.out.write_text(json.dumps(plain(found), indent=1) + "\n")
        return
    run_all(args)


if __name__ == "__main__":
    main()
