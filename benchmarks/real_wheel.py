"""The loop of criticism on a real wheel, by the product's own verb: `lunar-mjx improve` and nothing else.

    python benchmarks/real_wheel.py [--out build/real_wheel]

CMU's smooth wheel as it ships with the package: 63 points, each the mean of three runs. Slip angles 0, 30, 60 deg
are fitted; 15, 45 and 75 deg are held out and choose nothing; 90 deg is apart. This script writes the log, calls the
verb, and puts what the run folders hold into `real_wheel.json`. Errors are root mean squares in pooled standard
deviations of single runs, of the model's predictions alone, and `corrected`: with what the fitted points taught of the
discrepancy that remains.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from provenance import commit

ROOT = Path(__file__).resolve().parents[1]
RESULT, FIGURE = ROOT / "benchmarks" / "real_wheel.json", ROOT / "docs" / "figures" / "real_wheel.svg"
FIT, HELD = (0, 30, 60), (15, 45, 75)
PARTS = {"fitted": FIT, "inside": (15, 45), "extrapolated": (75,), "held_out": HELD}
NO_VERDICT = (1, 2)
"""Exit statuses of `improve` that are an error's and no verdict."""


def write_log(folder: Path) -> None:
    """The shipped figures as a log: the noise of a mean is the pooled scatter of single runs over root three."""
    from lunar_mjx.logs import Noise, write_steady_log
    from lunar_mjx.wheel_bed.data_files import load_figures
    from lunar_mjx.wheel_bed.table import QUANTITIES

    table = load_figures()
    runs = float(np.median(table.replicates))
    frame = pd.DataFrame({**table.test, **{QUANTITIES[q][0]: v for q, v in table.measured.items()}})
    noise = {QUANTITIES[q][0]: Noise(s / np.sqrt(runs), "replicate") for q, s in table.sigma.items()}
    write_steady_log(
        folder,
        frame,
        wheel={"radius_m": table.radius, "width_m": table.width},
        slip_definition=table.slip_definition,
        noise=noise,
        source=dict(table.source),
    )


def errors(series: Any, predicted: np.ndarray) -> dict[str, float]:
    """Root mean square error of predictions (n,) by part, in pooled standard deviations of single runs."""
    from lunar_mjx.wheel_bed.data_files import load_figures
    from lunar_mjx.wheel_bed.table import QUANTITIES

    scatter = {QUANTITIES[q][0]: s for q, s in load_figures().sigma.items()}
    ends = np.append(series["series_start"][1:], len(series["measured"]))
    sigma = np.concatenate(
        [
            np.full(end - start, scatter[str(channel)])
            for start, end, channel in zip(series["series_start"], ends, series["series_channel"], strict=True)
        ]
    )
    away = (series["measured"] - predicted) / sigma
    angle = np.round(series["place"][:, 1])
    return {part: float(np.sqrt(np.mean(away[np.isin(angle, wanted)] ** 2))) for part, wanted in PARTS.items()}


def rows_of(folder: Path) -> list[dict[str, Any]]:
    """Every model of the runs in a folder, with what the diagnosis of each run said."""
    rows = []
    runs = sorted(folder.glob("run*"), key=lambda p: int(p.name.removeprefix("run")))
    before: set[str] = set()
    for number, run in enumerate(runs):
        about = json.loads((run / "run.json").read_text(encoding="utf-8"))
        path = run / "verdict.json"
        verdict = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else None
        added = ", ".join(a for a in about["added"] if a not in before)
        before |= set(about["added"])
        with np.load(run / "series.npz") as series:
            labels = [str(label) for label in series["labels"]]
            for row, label in enumerate(labels):
                if label == "as given" and number > 0:
                    continue
                if label not in ("as given", "refitted") and number < len(runs) - 1:
                    continue
                name = f"+ {added}" if label == "refitted" and added else f"the model {label}"
                rows.append({"run": run.name, "model": name, **errors(series, series["predicted"][row])})
            rows[-1]["corrected"] = errors(series, series["corrected"]) if "corrected" in series.files else None
        if verdict is None:
            continue
        rows[-1]["verdict"] = verdict["verdict"]
        rows[-1]["sentence"] = verdict["sentence"]
        rows[-1]["probabilities"] = dict(list(verdict["probabilities"].items())[:4])
        rows[-1]["forms"] = verdict["forms"]
        rows[-1]["discrepancy"] = {k: d["text"] for k, d in verdict["discrepancy"].items()}
        rows[-1]["held_out_log_score"] = verdict["details"].get("held_out")
    return rows


def draw(rows: list[dict[str, Any]]) -> None:
    """The error from step to step, downwards; last with what the fitted angles taught of the model's own error."""
    import textwrap

    import matplotlib

    matplotlib.use("svg")
    import matplotlib.pyplot as plt

    from lunar_mjx.report.style import LINES, MUTED, save_light_and_dark, styled

    steps = [*rows, {"model": "the same, with the discrepancy as learnt", **rows[-1].get("corrected", rows[-1])}]
    with styled():
        fig, ax = plt.subplots(figsize=(8.0, 1.4 + 0.55 * len(steps)), layout="constrained")
        parts = (("fitted", "o"), ("inside", "s"), ("extrapolated", "^"))
        for (part, mark), (colour, line) in zip(parts, LINES, strict=False):
            angles = ", ".join(str(a) for a in PARTS[part])
            errors = [s[part] for s in steps]
            ax.plot(errors, range(len(steps)), mark, color=colour, linestyle=line, label=f"{part}: {angles} deg")
        for level, label in ((2.5, "target inside"), (5.0, "target extrapolated"), (1.0, "replicates")):
            ax.axvline(level, color=MUTED, linewidth=0.8, linestyle=":")
            ax.annotate(label, (level, -0.6), fontsize=7, color=MUTED, ha="center", va="bottom")
        ax.set_xscale("log")
        ax.set_xticks([0.5, 1, 2, 5, 10, 20], ["0.5", "1", "2", "5", "10", "20"])
        ax.minorticks_off()
        ax.set_xlabel("error, sigma of single runs")
        ax.set_yticks(range(len(steps)), [textwrap.fill(s["model"], 42) for s in steps])
        ax.set_ylim(len(steps) - 0.6, -0.6)
        fig.legend(loc="outside upper right", ncols=3)
        save_light_and_dark(fig, FIGURE, metadata={"Date": None})
        plt.close(fig)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "real_wheel")
    out = parser.parse_args().out.resolve()  # since the verb is called from the checkout
    for made in ("cmu_smooth_wheel", "runs"):  # and nothing else that lies there
        shutil.rmtree(out / made, ignore_errors=True)
    write_log(out / "cmu_smooth_wheel")
    splits = {**dict.fromkeys(FIT, "fit"), **dict.fromkeys(HELD, "select")}
    words = [w for angle, split in splits.items() for w in ("--split", f"slip_angle {angle} deg={split}")]
    command = ["improve", str(out / "cmu_smooth_wheel"), "-o", str(out / "runs"), *words]
    begun = time.perf_counter()
    ended = subprocess.run([sys.executable, "-m", "lunar_mjx.cli", *command], cwd=ROOT, check=False)
    seconds = time.perf_counter() - begun
    if ended.returncode in NO_VERDICT:
        sys.exit(ended.returncode)  # it has told why; the kept record stays
    rows = rows_of(out / "runs")
    shown = ["lunar-mjx improve cmu_smooth_wheel", *(f'--split "{w}"' for w in words if w != "--split")]
    result = {
        "unit": "pooled standard deviation of single runs",
        "command": " ".join(shown),
        "commit": commit(),
        "exit_status": ended.returncode,
        "seconds": round(seconds, 1),
        "rows": rows,
    }
    RESULT.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    for r in rows:
        print(f"{r['model']:<40} {r['fitted']:6.2f} {r['inside']:6.2f} {r['extrapolated']:6.2f} {r['held_out']:6.2f}")
    draw(rows)


if __name__ == "__main__":
    main()
