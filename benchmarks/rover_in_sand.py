"""A rover in particle sand: balance of forces, ruts of front and rear wheels beside those of the rut field, and speed.

    python benchmarks/rover_in_sand.py run OUT --voxel 0.025 --duration 8 --device cpu
    lunar-mjx compare OUT/log -o RUN
    python benchmarks/rover_in_sand.py report OUT --compared RUN

`run` drives `benchmarks/particles/ten_metres.toml` by `lunar-mjx bed drive OUT`, to which the other options go
(`--rover`, `--seconds`, ...), and needs the extra `particles`. With the settings above it takes half an hour on one
core; the whole drive needs a GPU. `report` drives the same manoeuvre on the engine with the effect `ruts` and the same
soil, and writes benchmarks/rover_in_sand.json; it needs no extra.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
from benchmarks.provenance import commit  # noqa: E402

PLAN = ROOT / "benchmarks" / "particles" / "ten_metres.toml"
RESULT = ROOT / "benchmarks" / "rover_in_sand.json"
PROVENANCE = "provenance.json"


def run(out: Path, options: list[str]) -> None:
    """Drives by the command, and keeps the commit beside its results."""
    command = [sys.executable, "-m", "lunar_mjx.cli", "bed", "drive", str(out), "--manoeuvre", str(PLAN), *options]
    made = {"commit": commit(), "options": options, "cores": os.cpu_count()}
    subprocess.run(command, check=True, cwd=ROOT)
    (out / PROVENANCE).write_text(json.dumps(made, indent=1) + "\n", encoding="utf-8")


def rut_field(drive: dict[str, Any], options: list[str], folder: Path) -> dict[str, dict[str, float]]:
    """Sinkage and slip by wheel on the engine in the model's soil with `ruts`, for as long as the particles' drive."""
    from lunar_mjx.logs import Recording, simulate_log

    whole = float(options[options.index("--duration") + 1]) if "--duration" in options else None

    log = simulate_log(
        folder / "ruts",
        drive["rover"],
        PLAN,
        ["rim_contact", "ruts"],
        terrain=drive["terrain"],
        recording=Recording(scale=0.0),
        seconds=whole,
        seed=0,
    )
    return wheels(log, drive["driven_s"])


def wheels(log: Path, seconds: float) -> dict[str, dict[str, float]]:
    """Mean sinkage, mm, and slip of front and rear wheels over the second half of a log's first `seconds`."""
    camera = pd.read_csv(log / "camera.csv")
    late = camera[(camera["time_s"] > 0.5 * seconds) & (camera["time_s"] <= seconds)]
    return {
        side: {
            "sinkage_mm": 1e3 * float(np.mean([late[f"wheel_{c}_sinkage_m"] for c in corners])),
            "slip": float(np.mean([late[f"wheel_{c}_slip_ratio"] for c in corners])),
        }
        for side, corners in (("front", ("lf", "rf")), ("rear", ("lr", "rr")))
    }


def rut_depths(out: Path, drive: dict[str, Any], voxel: float) -> dict[str, float]:
    """Depth, mm, of the ruts at the end: under fresh track of front wheels alone, and where rear wheels followed.

    Places are the middles of wheels on the way there; the surface is that of the column's highest particle, less that
    of columns far from all tracks.
    """
    from lunar_mjx.backends.in_sand import plane_of
    from lunar_mjx.manoeuvres.manoeuvre import load_manoeuvre, wheel_places
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
    """Errors in sigma that `compare` has found, in all and by channel, and the soil that its refit ended with."""
    found = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
    rows = {r["channel"]: [r["as_given"], r["refitted"]] for r in found["by_channel"]}
    return {
        "as_given": found["as_given"],
        "refitted": found["refitted"],
        "by_channel": rows,
        "soil": found["parameters"]["soil"],
    }


def report(out: Path, run_folder: Path | None) -> None:
    """Writes the record of a drive, and of the run folder of `compare` on its log."""
    drive = json.loads((out / "drive.json").read_text(encoding="utf-8"))
    made = json.loads((out / PROVENANCE).read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        field = rut_field(drive, made["options"], Path(folder))
    record = {
        "drive": made,
        "report": {"commit": commit()},
        "facts": drive,
        "particles": wheels(out / "log", drive["driven_s"]),
        "rut_field": field,
        "compare": None if run_folder is None else compared(run_folder),
        "rut_depth_mm": rut_depths(out, drive, drive["numerics"]["voxel"]),
    }
    RESULT.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(json.dumps({k: record[k] for k in ("particles", "rut_field", "rut_depth_mm")}, indent=1))


def main() -> None:
    """Runs or reports."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "report"))
    parser.add_argument("out", type=Path)
    parser.add_argument("--compared", type=Path, help="run folder of `compare` on OUT/log")
    options, rest = parser.parse_known_args()
    if options.what == "run":
        run(options.out, rest)
    else:
        report(options.out, options.compared)


if __name__ == "__main__":
    main()
