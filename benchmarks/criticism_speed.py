"""Seconds of one diagnosis of drive logs: certified fit, scores of many effects, refits, verdict.

    python benchmarks/criticism_speed.py --out build/criticism_speed.json
    python benchmarks/criticism_speed.py my_logs/* --out build/criticism_speed.json

Without logs, eight drives of 10 s are recorded from native MuJoCo with Coulomb friction in the drives. The first round
compiles, the second finds its programs compiled: both are reported, and what was found.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

import jax

from benchmarks.hidden.drives import MANOEUVRES, Manoeuvre, generate
from lunar_mjx.criticism import compare, read_campaign, why
from lunar_mjx.diagnosis.drives.problem import SIMULATED
from lunar_mjx.diagnosis.drives.simulation.program import cores
from lunar_mjx.model import make_model

EFFECTS = (
    "coulomb_friction",
    "viscous_friction",
    "directional_gear_efficiency",
    "iron_loss",
    "gear_friction_heat",
    "cogging",
    "actuator_delay",
    "slip_sinkage",
    "exit_angle",
    "bulldozing",
    "friction_circle",
    "dynamic_sinkage",
    "soil_patches",
    "multipass",
    "rolling_resistance",
    "com_offset",
    "wheel_radius_error",
    "gravity_error",
    "clock_offset",
    "channel_scale",
)

MORE = (
    Manoeuvre(
        "slalom",
        "flat",
        False,
        "fit",
        ((0, 0), (1, 0), (1.5, 2.5), (9, 2.5), (9.5, 0)),
        ((0, 0), (2, 0.1), (3.5, -0.1), (5, 0.1), (6.5, -0.1), (8, 0.1), (9, 0)),
    ),
    Manoeuvre(
        "crawl_and_sprint", "flat", False, "select", ((0, 0), (1, 0), (1.5, 0.6), (5, 0.6), (6, 5), (9, 5), (9.5, 0))
    ),
)
"""Beside the six manoeuvres of the hidden benchmark."""


def record_drives(folder: Path) -> list[Path]:
    """Eight drives with Coulomb friction hidden in them; the folders of their logs."""
    generate("singles", 0, 1, folder, (*MANOEUVRES, *MORE))
    return sorted(p for p in (folder / "logs" / "singles-000").iterdir() if p.is_dir())


def main() -> None:
    """Times two rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="*", help="folders of drive logs of one rover")
    parser.add_argument("--out", type=Path, default=Path("criticism_speed.json"))
    parser.add_argument("--all", action="store_true", help="all effects of the catalogue, not twenty")
    parser.add_argument("--rounds", type=int, default=2)
    args = parser.parse_args()
    args.logs = args.logs or record_drives(Path(tempfile.mkdtemp(prefix="drives-")))
    logs = read_campaign(args.logs)
    steps = sum(log.span_s[1] - log.span_s[0] for log in logs)
    record = {
        "device": str(jax.devices()[0].device_kind),
        "platform": jax.default_backend(),
        "cores": cores(),
        "load_average": list(os.getloadavg()),
        "jax": jax.__version__,
        "logs": len(logs),
        "seconds_of_driving": steps,
        "effects": len(EFFECTS),
        "rounds": [],
    }
    model = make_model(logs[0].rover, terrain="flat")
    for number in range(args.rounds):
        SIMULATED.clear()  # else a round would find what the one before has simulated
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            run = compare(args.logs, model, Path(folder) / "run")
            fitted = time.perf_counter()
            diagnosis = why(run, None if args.all else EFFECTS)
            ended = time.perf_counter()
        row = {
            "round": number,
            "compare_s": fitted - begun,
            "why_s": ended - fitted,
            "total_s": ended - begun,
            "verdict": diagnosis.verdict.label,
            "effects": list(diagnosis.effects),
        }
        record["rounds"].append(row)
        print(json.dumps(row), flush=True)
        args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
