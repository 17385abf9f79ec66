"""The loop of criticism on CMU's wheel in particle sand, by the product's own verbs.

    python benchmarks/particle_loop.py [--out build/particle_loop]

The table is `benchmarks/particles/results/cmu_earth/table`: 18 usable points. Twice a part of it chooses nothing: slip
angles 15, 45, 75 deg, and the points at slips of -0.7, -0.2 and 0. This script writes the second split as two logs,
calls the verbs that stand in `CAMPAIGNS`, and puts what the run folders hold into `particle_loop.json`: errors in
sigma of the stated numerical error, and of each quantity in SI units. Folders that are there already are read and not
computed again.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
TABLE = ROOT / "benchmarks" / "particles" / "results" / "cmu_earth" / "table"
RESULT = ROOT / "benchmarks" / "particle_loop.json"
HELD_ANGLES, FITTED_ANGLES = (15, 45, 75), (0, 30, 60)
HELD_SLIPS = (-0.7, -0.2, 0.0)

BY_ANGLE = [
    word
    for angles, split in ((FITTED_ANGLES, "fit"), (HELD_ANGLES, "select"))
    for angle in angles
    for word in ("--split", f"slip_angle {angle} deg={split}")
]
CAMPAIGNS: dict[str, list[list[str]]] = {
    "angles": [["improve", "TABLE", *BY_ANGLE, "-o", "angles"]],
    "slips": [
        ["improve", "slips_fitted", "slips_held", "-o", "slips"],
        ["add", "slips/run2", "bulldozing", "-o", "slips/run3"],
    ],
    "field": [["compare", "TABLE", *BY_ANGLE, "--preset", "field", "-o", "field/run1"]],
}
"""Commands by campaign; each writes runs into the folder of its name."""


def write_slips(out: Path) -> None:
    """The table as two logs, of the slips that are fitted and of those that choose nothing."""
    about = (TABLE / "log.toml").read_text(encoding="utf-8")
    with (TABLE / "points.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for name, split, held in (("slips_fitted", "fit", False), ("slips_held", "select", True)):
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "log.toml").write_text(about.replace("\n[source]", f'\nsplit = "{split}"\n\n[source]', 1), "utf-8")
        with (folder / "points.csv").open("w", encoding="utf-8", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(r for r in rows if (round(float(r["slip_ratio"]), 1) in HELD_SLIPS) == held)


def errors(series: Any, model: int) -> dict[str, dict[str, float]]:
    """Of one model of a run, by split: `sigma` over all quantities, and by channel the root mean square in SI units."""
    split = series["split"][series["unit"]]
    ends = [*series["series_start"][1:], len(split)]
    channel = np.concatenate(
        [
            np.full(end - start, name)
            for start, end, name in zip(series["series_start"], ends, series["series_channel"], strict=True)
        ]
    )
    away = series["predicted"][model] - series["measured"]
    found = {}
    for part in ("fit", "select"):
        at = split == part
        found[part] = {"sigma": _rms(series["residual"][model][at])}
        found[part] |= {str(c): _rms(away[at & (channel == c)]) for c in dict.fromkeys(channel)}
    return found


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def told(run: Path) -> dict[str, Any]:
    """What a run folder says: errors of its models, its parameters, and its verdict where `why` was asked."""
    with np.load(run / "series.npz") as series:
        labels = [str(label) for label in series["labels"]]
        found: dict[str, Any] = {
            "added": json.loads((run / "run.json").read_text(encoding="utf-8"))["added"],
            "errors": {label: errors(series, k) for k, label in enumerate(labels)},
        }
    refitted = json.loads((run / "comparison.json").read_text(encoding="utf-8"))["parameters"]
    found["parameters"] = {
        f"{effect}.{name}": [value, entry["std"][name]]
        for effect, entry in refitted.items()
        for name, value in entry["value"].items()
        if effect in ("soil", "bulldozing", "granular_resistance")
    }
    path = run / "verdict.json"
    if path.is_file():
        verdict = json.loads(path.read_text(encoding="utf-8"))
        found |= {k: verdict[k] for k in ("verdict", "sentence", "forms")}
        found["probabilities"] = dict(list(verdict["probabilities"].items())[:4])
        found["discrepancy"] = {k: d["text"] for k, d in verdict["discrepancy"].items()}
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "particle_loop")
    out = parser.parse_args().out.resolve()
    write_slips(out)
    result: dict[str, Any] = {}
    for name, commands in CAMPAIGNS.items():
        for command in commands if not (out / name).exists() else ():
            words = [str(TABLE) if w == "TABLE" else w for w in command]
            subprocess.run([sys.executable, "-m", "lunar_mjx.cli", *words], cwd=out, check=False)
        shown = ["lunar-mjx " + " ".join(f'"{w}"' if " " in w else w for w in command) for command in commands]
        result[name] = {"commands": shown, "runs": {r.name: told(r) for r in sorted((out / name).glob("run*"))}}
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(RESULT)


if __name__ == "__main__":
    main()
