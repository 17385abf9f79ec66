"""Refits the soil of every wheel model to the CMU smooth wheel and keeps the errors in `wheel_fits.json`.

    python benchmarks/wheel_fits.py

Fitted at slip angles 0, 30, 60 deg; judged at 15, 45 (inside) and 75 deg (beyond), in scatter of single runs.
"""

from __future__ import annotations

import json
from pathlib import Path

from lunar_mjx.criticism import WheelBed, fit, load_figures
from lunar_mjx.wheel_bed.comparison import compare
from lunar_mjx.wheel_bed.soil_fit import PAPER_CONTACT, SOIL, SOIL_FIT


def main() -> None:
    table = load_figures()
    consistent, paper = WheelBed.of_preset("consistent"), WheelBed.of_preset("paper")
    cases = (
        ("paper, soil", paper, SOIL),
        ("paper, soil and contact", paper, SOIL + PAPER_CONTACT),
        ("consistent, soil", consistent, SOIL),
        ("consistent with stress_integral, soil", consistent.with_effect("stress_integral"), SOIL),
    )
    results = []
    for name, bed, free in cases:
        before, found = compare(bed, table, name), fit(bed, table, free, name)
        nominal = {
            "fitted": before.score(SOIL_FIT.fit_angles),
            "held_out": before.score(SOIL_FIT.inside_angles + SOIL_FIT.beyond_angles),
            "inside": before.score(SOIL_FIT.inside_angles),
            "beyond": before.score(SOIL_FIT.beyond_angles),
            "all_angles_rms": before.rms,
        }
        results.append({"nominal": nominal, **found.to_dict()})
        judged = (
            f"(inside {found.inside:.1f}, beyond {found.beyond:.1f}); {found.agreeing} of {len(found.starts)} agree"
        )
        print(f"{name:40} held out {nominal['held_out']:.1f} -> {found.held_out:.1f}  {judged}")
    Path(__file__).with_suffix(".json").write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
