"""A rover in particle sand: balance of forces, ruts of front and rear wheels beside those of the rut field, and speed.

    python benchmarks/rover_in_sand.py run OUT --voxel 0.025 --duration 8 --device cpu
    lunar-mjx compare OUT/log -o RUN
    lunar-mjx why RUN
    python benchmarks/rover_in_sand.py report OUT --compared RUN --coarse COARSE

`run` drives `benchmarks/particles/ten_metres.toml` by `lunar-mjx bed drive OUT`, to which the other options go
(`--rover`, `--seconds`, ...), and needs the extra `particles`. With the settings above it takes half an hour on one
core; the whole drive needs a GPU. `report` drives the same manoeuvre on the engine with the effect `ruts` and the same
soil, and writes benchmarks/rover_in_sand.json; it needs no extra. COARSE is the folder of a `run` with larger voxels.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from benchmarks.provenance import commit  # noqa: E402
from lunar_mjx.manoeuvres.manoeuvre import load_manoeuvre, wheel_places  # noqa: E402

PLAN = ROOT / "benchmarks" / "particles" / "ten_metres.toml"
RESULT = ROOT / "benchmarks" / "rover_in_sand.json"
PROVENANCE = "provenance.json"


def run(out: Path, options: list[str]) -> None:
    """Drives by the command, and keeps the commit beside its results."""
    command = [sys.executable, "-m", "lunar_mjx.cli", "bed", "drive", str(out), "--manoeuvre", str(PLAN), *options]
    made = {"commit": commit(), "options": options, "cores": os.cpu_count()}
    subprocess.run(command, check=True, cwd=ROOT)
    (out / PROVENANCE).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def rut_field(drive: dict[str, Any], options: list[str], folder: Path) -> dict[str, Any]:
    """What `wheels` tells of the engine in the model's soil with `ruts`, for as long as the particles' drive."""
    from lunar_mjx.logs import Recording, simulate_log

    whole = float(options[options.index("--duration") + 1]) if "--duration" in options else None

    log = simulate_log(
        folder / "ruts",
        drive["rover"],
        PLAN,
        ["rim_contact", "ruts"],
        terrain=drive["terrain"],
        recording=Recording(scale=0.0, forces=True),
        seconds=whole,
        seed=0,
    )
    return wheels(log, drive["driven_s"])


def wheels(log: Path, seconds: float) -> dict[str, Any]:
    """Way, and means of front and rear wheels over the second half of a log's first `seconds` and of each segment."""
    drive = pd.read_csv(log / "drive.csv")
    drive = drive[drive["time_s"] <= seconds]
    speed = np.hypot(drive["world_velocity_x_m_s"], drive["world_velocity_y_m_s"])
    last = drive.iloc[-1]
    durations = np.array([s.duration_s for s in load_manoeuvre(PLAN).segments])
    ends = np.cumsum(durations)
    return {
        "way_m": float(np.trapezoid(speed, drive["time_s"])),
        "end": {c: float(last[c]) for c in ("position_x_m", "position_y_m", "position_z_m", "yaw_deg")},
        **_sides(log, 0.5 * seconds, seconds),
        "segments": [_sides(log, e - 0.5 * d, e) for e, d in zip(ends, durations, strict=True) if e <= seconds],
    }


def _sides(log: Path, begin: float, end: float) -> dict[str, dict[str, float]]:
    """Means of front and rear wheels from `begin` to `end`; the load where the log has forces."""
    camera, drive = (pd.read_csv(log / name) for name in ("camera.csv", "drive.csv"))
    camera, drive = (t[(t["time_s"] > begin) & (t["time_s"] <= end)] for t in (camera, drive))
    return {
        side: {
            "sinkage_mm": 1e3 * float(np.mean([camera[f"wheel_{c}_sinkage_m"] for c in corners])),
            "slip": float(np.mean([camera[f"wheel_{c}_slip_ratio"] for c in corners])),
            "current_A": float(np.mean([drive[f"motor_{c}_drive_current_A"] for c in corners])),
            **(
                {"load_N": float(np.mean([drive[f"wheel_{c}_force_z_N"] for c in corners]))}
                if f"wheel_{corners[0]}_force_z_N" in drive
                else {}
            ),
        }
        for side, corners in (("front", ("lf", "rf")), ("rear", ("lr", "rr")))
    }


def rut_depths(out: Path, drive: dict[str, Any], voxel: float) -> dict[str, float]:
    """Depth, mm, of the ruts at the end: under fresh track of front wheels alone, and where rear wheels followed.

    Places are the middles of wheels on the way there; the surface is that of the column's highest particle, less that
    of columns far from all tracks.
    """
    from lunar_mjx.backends.in_sand import plane_of
    from lunar_mjx.rover import load_rover
    from lunar_mjx.terrain import load_terrain

    rover = load_rover(drive["rover"])
    start = load_manoeuvre(PLAN).start
    plane = plane_of(load_terrain(drive["terrain"]), start[0], start[1])
    log = pd.read_csv(out / "log" / "drive.csv")
    place = plane.into(log[[f"position_{a}_m" for a in "xyz"]].to_numpy() - plane.origin)[:, :2]
    yaw = np.radians(log["yaw_deg"].to_numpy())
    surface = pd.read_csv(out / "surface.csv").to_numpy()
    ahead, left = np.stack([np.cos(yaw), np.sin(yaw)], 1), np.stack([-np.sin(yaw), np.cos(yaw)], 1)
    tracks = {c: place + p[0] * ahead + p[1] * left for c, p in wheel_places(rover).items()}
    every = np.concatenate(list(tracks.values()))
    fresh = [np.hypot(*(every - s[:2]).T).min() > 0.16 for s in surface]
    level = float(np.median(surface[fresh, 2]))
    found: dict[str, list[float]] = {"front_alone": [], "both": []}
    for front, rear in (("lf", "lr"), ("rf", "rr")):
        # Apart from where wheels stand, and from where they stood.
        for point in tracks[front]:
            from_front = np.hypot(*(tracks[front][-1] - point))
            after = np.hypot(*(tracks[rear] - point).T)
            begun = np.hypot(*(tracks[front][0] - point))
            if from_front < 0.12 or begun < 0.12 or np.hypot(*(tracks[rear][-1] - point)) < 0.12:
                continue
            column = np.argmin(np.hypot(*(surface[:, :2] - point).T))
            kind = "both" if after.min() < 0.5 * voxel else "front_alone" if after.min() > 0.1 else None
            if kind:
                found[kind].append(1e3 * (level - float(surface[column, 2])))
    return {k: float(np.mean(v)) for k, v in found.items() if v}


def compared(folder: Path) -> dict[str, Any]:
    """Errors that `compare` has found, the soil and start of its refit, and what `why` said.

    Each channel has its error in sigma, as given and refitted, and its root mean square in its own unit.
    """
    found = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    rows = {r["channel"]: [r["as_given"], r["refitted"]] for r in found["by_channel"]}
    initial = found["parameters"]["initial"]
    with np.load(folder / "series.npz") as series:
        away = series["predicted"] - series["measured"]
        parts = np.split(away, series["series_start"][1:], axis=1)
        channels = [str(c) for c in series["series_channel"]]
    told: dict[str, Any] = {
        "as_given": found["as_given"],
        "refitted": found["refitted"],
        "by_channel": rows,
        "rms": {c: np.sqrt(np.mean(np.square(p), axis=1)).tolist() for c, p in zip(channels, parts, strict=True)},
        "soil": found["parameters"]["soil"],
        "start": {k: {c: initial[k][c] for c in ("x", "y", "yaw")} for k in ("value", "std", "given")},
    }
    path = folder / "verdict.json"
    if path.exists():
        verdict = json.loads(path.read_text(encoding="utf-8"))
        told["why"] = {k: verdict.get(k) for k in ("verdict", "sentence", "forms", "probabilities")}
    return told


def sand_of(out: Path) -> dict[str, Any]:
    """What the folder of a drive tells: how it was made, its facts, its wheels, its ruts, and its numerical error."""
    drive = json.loads((out / "drive.json").read_text(encoding="utf-8"))
    error = tomllib.loads((out / "log" / "log.toml").read_text(encoding="utf-8"))["source"]["numerical_error"]
    return {
        "drive": json.loads((out / PROVENANCE).read_text(encoding="utf-8")),
        "facts": drive,
        "particles": wheels(out / "log", drive["driven_s"]),
        "rut_depth_mm": rut_depths(out, drive, drive["numerics"]["voxel"]),
        "numerical_error": json.loads(error) if drive["control"] else None,
    }


def report(out: Path, run_folder: Path | None, coarse: Path | None) -> None:
    """Writes the record of a drive, of one with larger voxels, and of the run folder of `compare` on its log."""
    told = sand_of(out)
    with tempfile.TemporaryDirectory() as folder:
        field = rut_field(told["facts"], told["drive"]["options"], Path(folder))
    record = {
        "report": {"commit": commit()},
        **told,
        "rut_field": field,
        "coarse": None if coarse is None else sand_of(coarse),
        "compare": None if run_folder is None else compared(run_folder),
    }
    RESULT.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({k: record[k] for k in ("particles", "rut_field", "rut_depth_mm")}, indent=1))


def main() -> None:
    """Runs or reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "report"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--compared", type=Path, help="run folder of `compare`, and of `why`, on OUT/log")
    parser.add_argument("--coarse", type=Path, help="folder of a drive with larger voxels")
    options, rest = parser.parse_known_args()
    if options.what == "run":
        run(options.out, rest)
    else:
        report(options.out, options.compared, options.coarse)


if __name__ == "__main__":
    main()
