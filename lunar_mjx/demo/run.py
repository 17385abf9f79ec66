"""Runs the demonstration and writes its page and its numbers."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.demo.drive import Drive, drive
from lunar_mjx.demo.figures import ROVERS
from lunar_mjx.demo.husky import HuskyCase, husky_case
from lunar_mjx.demo.sections import (
    LEAD,
    driving_section,
    headline_section,
    husky_section,
    provenance_section,
    verdict,
    versions,
    wheel_section,
)
from lunar_mjx.demo.wheel import Case, wheel_cases
from lunar_mjx.errors import UserError
from lunar_mjx.files import write_text
from lunar_mjx.model import DEFAULT_TERRAIN
from lunar_mjx.report.page import write_page
from lunar_mjx.report.progress import Reporter, console_progress
from lunar_mjx.terrain import load_terrain

TITLE = "lunar-mjx demonstration"
_SHARES = {"viper": 0.45, "luvmi_x": 0.35}
"""Measured share of each rover's drive in the whole, compilation included; the wheel takes the rest."""


def run_demo(
    out: Path, progress: Reporter | None = None, rovers: int = 16, seconds: float = 30.0, seed: int = 1, starts: int = 8
) -> Path:
    """Drives a batch of VIPERs and LUVMI-Xs, compares the wheel with the CMU test bed, and writes what came of it.

    Args:
      out: folder for `demo.html` and `summary.json`; made if it is not there.
      progress: told what is being done and the share done; a display on standard error if None.
      rovers: of each kind.
      seconds: of driving.
      seed: of starts, commands and fits.
      starts: of every fit, a power of two.

    Returns:
      The page's path.

    Raises:
      UserError: the folder cannot be made or written.
    """
    out = Path(out)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{out}: the folder for the report cannot be made ({error.strerror}); give another.") from error
    begun = time.monotonic()
    with console_progress() if progress is None else nullcontext(progress) as report:
        report("making the terrain", 0.0)
        terrain = load_terrain(DEFAULT_TERRAIN)
        drives, done = [], 0.02
        for i, (name, share) in enumerate(_SHARES.items()):
            activity = f"driving {rovers} {ROVERS[name][0]}s"
            report(f"{activity} (compiling)", done)
            # Compiling takes most of the share and tells nothing of its progress.
            tell = _part(report, activity, done + 0.85 * share, 0.15 * share)
            # Half a spacing apart, so that the two kinds do not start on each other's places.
            drives.append(drive(name, rovers, seconds, seed, terrain, tell, shift=0.5 * i))
            done += share
        # The wheel and the real drive are taken to need as long as each other.
        share = 0.5 * (0.95 - done)
        cases = wheel_cases(starts, seed, _part(report, "wheel against test bed", done, share))
        husky = husky_case(seed, _part(report, "a real Husky's drive", done + share, share))
        report("writing the page", 0.95)
        page = _write(out, drives, cases, husky, terrain, seed, begun)
        report("done", 1.0)
    return page


def _part(report: Reporter, what: str, start: float, share: float) -> Any:
    return lambda done: report(what, start + share * done)


def _write(
    out: Path, drives: Sequence[Drive], cases: Sequence[Case], husky: HuskyCase, terrain: Any, seed: int, begun: float
) -> Path:
    sections = [
        husky_section(husky),
        driving_section(drives, terrain),
        wheel_section(cases),
        provenance_section(cases[0].comparison.table, terrain.name, seed),
    ]
    page = write_page(out / "demo.html", TITLE, verdict(drives, cases), [headline_section(cases), *sections], LEAD)
    numbers = {
        "verdict": verdict(drives, cases),
        "drives": [summary(d) for d in drives],
        "wheel": [case.to_dict() for case in cases],
        "husky": husky.to_dict(),
        "terrain": terrain.name,
        "seed": seed,
        "versions": versions(),
        "seconds_wall_clock": round(time.monotonic() - begun, 1),
    }
    # NaN is no JSON: numbers that do not exist have become null before.
    write_text(out / "summary.json", json.dumps(numbers, indent=1, allow_nan=False))
    return page


def summary(d: Drive) -> dict[str, Any]:
    """The numbers of a drive, one entry per rover, units in the names."""

    def numbers(values: np.ndarray) -> list[float | None]:
        # Six digits: below the micrometre float32 tells nothing of a drive.
        return [round(float(v), 6) if np.isfinite(v) else None for v in values]

    return {
        "rover": d.rover,
        "mass_kg": d.mass,
        "simulated_s": float(d.time[-1]),
        "command_rim_speed_m_s": numbers(d.command_speed),
        "distance_m": numbers(d.distance),
        "mean_slip": numbers(d.rover_slip),
        "mean_sinkage_m": numbers(d.sinkage.mean(axis=(0, 2))),
        "max_sinkage_m": numbers(d.sinkage.max(axis=(0, 2))),
        "max_winding_temperature_degC": numbers(d.winding_degC.max(axis=0)),
        "hottest_motor": list(d.hottest),
        "electrical_energy_J": numbers(d.energy),
        "max_roll_deg": numbers(np.degrees(np.abs(d.roll).max(axis=0))),
        "max_pitch_deg": numbers(np.degrees(np.abs(d.pitch).max(axis=0))),
    }
