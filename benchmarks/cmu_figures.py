"""Computes the committed figures of the CMU smooth wheel from the runs of its test bed.

    python benchmarks/cmu_figures.py path/to/smooth_wheel_trials.csv

writes `lunar_mjx/wheel_bed/data/cmu_smooth_wheel.csv` (mean and scatter over the replicates of every slip angle and rim
speed) and `cmu_smooth_wheel.toml` (what they are, and the scatter of single runs pooled over all points).
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import tomli_w

from lunar_mjx.wheel_bed.data_files import replicate_column
from lunar_mjx.wheel_bed.table import QUANTITIES, average, read_table, replicate_groups

RADIUS, WIDTH = 0.0625, 0.05
FOLDER = Path(__file__).resolve().parent.parent / "lunar_mjx" / "wheel_bed" / "data"
SOURCE = {
    "who": "C. Pavlov, Carnegie Mellon University",
    "citation": "Processed results of a single-wheel test bed published with the code of 3d-terramechanics "
    "(C. Pavlov, Carnegie Mellon University); averaged here over the replicates",
    "licence": "MIT",
}
NOTES = (
    "Smooth rigid wheel in dry sand, 9 rim speeds x 7 slip angles x 3 replicates at 10 mm/s travel. Mean over the "
    "replicates, and their standard deviation (n - 1). Publications of the group give the radius as 0.058 m and as "
    "0.0625 m; the larger is used. Drawbar pull and side force are in the wheel's frame; slip_ratio compares the rim "
    "speed with the travel speed, not with its component along the wheel's heading. There is no torque channel."
)


def figures(path: Path) -> tuple[pd.DataFrame, dict[str, object]]:
    """The averaged table and its description."""
    runs = read_table(path, RADIUS, WIDTH, "travel_speed", "CMU smooth wheel", SOURCE)
    mean = average(runs)
    frame = pd.DataFrame(mean.test)
    group = replicate_groups(runs)
    for quantity, values in mean.measured.items():
        frame[QUANTITIES[quantity][0]] = values
        frame[replicate_column(quantity)] = pd.Series(runs.measured[quantity]).groupby(group).std(ddof=1)
    frame["replicates"] = mean.replicates
    about = {
        "name": "CMU smooth wheel",
        "slip_definition": "travel_speed",
        "notes": NOTES,
        "wheel": {"radius_m": RADIUS, "radius_range_m": [0.058, 0.0625], "width_m": WIDTH, "grousers": 0},
        "sigma": {QUANTITIES[q][0]: float(np.format_float_scientific(s, 6)) for q, s in mean.sigma.items()},
        "source": SOURCE,
    }
    return frame, about


def main() -> None:
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    frame, about = figures(Path(sys.argv[1]))
    FOLDER.mkdir(parents=True, exist_ok=True)
    frame.to_csv(FOLDER / "cmu_smooth_wheel.csv", index=False, float_format="%.7g", lineterminator="\n")
    (FOLDER / "cmu_smooth_wheel.toml").write_text(tomli_w.dumps(about), encoding="utf-8")
    print(f"{len(frame)} points, pooled scatter {about['sigma']}")


if __name__ == "__main__":
    main()
