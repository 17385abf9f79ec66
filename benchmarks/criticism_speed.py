"""Seconds of one diagnosis of drive logs: certified fit, scores of many effects, refits, verdict.

    python benchmarks/hidden_effects.py generate build/drives --count 1
    python benchmarks/criticism_speed.py build/drives/logs/... --out build/criticism_speed.json

The first round compiles, the second finds its programs compiled: both are reported, and what was found.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path

import jax

from lunar_mjx.criticism import compare, read_campaign, why
from lunar_mjx.model import make_model

EFFECTS = (
    "coulomb_friction", "viscous_friction", "directional_gear_efficiency", "iron_loss", "gear_friction_heat", "cogging",
    "actuator_delay", "slip_sinkage", "exit_angle", "bulldozing", "friction_circle", "dynamic_sinkage", "soil_patches",
    "multipass", "rolling_resistance", "com_offset", "wheel_radius_error", "gravity_error", "clock_offset",
    "channel_scale",
)  # fmt: skip


def main() -> None:
    """Times two rounds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("logs", type=Path, nargs="+", help="folders of drive logs of one rover")
    parser.add_argument("--out", type=Path, default=Path("criticism_speed.json"))
    parser.add_argument("--rounds", type=int, default=2)
    args = parser.parse_args()
    logs = read_campaign(args.logs)
    steps = sum(log.span_s[1] - log.span_s[0] for log in logs)
    record = {
        "device": str(jax.devices()[0].device_kind), "platform": jax.default_backend(), "cores": os.cpu_count(),
        "load_average": list(os.getloadavg()), "jax": jax.__version__, "logs": len(logs), "seconds_of_driving": steps,
        "effects": len(EFFECTS), "rounds": [],
    }  # fmt: skip
    model = make_model(logs[0].rover, terrain="flat")
    for number in range(args.rounds):
        with tempfile.TemporaryDirectory() as folder:
            begun = time.perf_counter()
            run = compare(args.logs, model, Path(folder) / "run")
            fitted = time.perf_counter()
            diagnosis = why(run, EFFECTS)
            ended = time.perf_counter()
        row = {
            "round": number, "compare_s": fitted - begun, "why_s": ended - fitted, "total_s": ended - begun,
            "verdict": diagnosis.verdict.label, "effects": list(diagnosis.effects),
        }  # fmt: skip
        record["rounds"].append(row)
        print(json.dumps(row), flush=True)
        args.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
