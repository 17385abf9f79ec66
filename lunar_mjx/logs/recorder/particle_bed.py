"""Writes what a particle bed found as a steady-state log: the points, and the numerical error as the stated noise."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lunar_mjx._version import __version__
from lunar_mjx.errors import UserError
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.write import write_steady_log
from lunar_mjx.wheel_bed.particles.results import numerical_error
from lunar_mjx.wheel_bed.table import QUANTITIES

LOG_FOLDER = "table"
"""Folder of the log within the folder of a particle bed's runs."""


def particle_frame(results: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """One row for each usable run of the table proper, with the columns of a steady-state table."""
    rows = []
    for r in results:
        if r["variant"] != "table" or not r["usable"]:
            continue
        point = r["point"]
        speed = (r["numerics"]["froude"] * r["gravity"] * r["wheel"]["radius"]) ** 0.5
        imposed = {
            "slip_ratio": point["slip_ratio"],
            "slip_angle_deg": point["slip_angle"],
            "normal_load_N": point["load"],
            "rim_speed_m_s": speed * point["rim"],
            "travel_speed_m_s": speed * point["travel"],
        }
        rows.append({**imposed, **{column: r["values"][q] for q, (column, _, _) in QUANTITIES.items()}})
    frame = pd.DataFrame(rows)
    return frame.sort_values(["normal_load_N", "slip_angle_deg", "slip_ratio"]) if len(frame) else frame


def write_particle_log(folder: str | Path, results: Sequence[Mapping[str, Any]], slip_definition: str) -> Path:
    """Writes the log `folder/table`, in place of the one that an earlier call has written there.

    Args:
      folder: of the runs; must exist.
      results: of one wheel, sand and gravity, as the campaign keeps them.
      slip_definition: "wheel_frame" or "travel_speed".

    Returns:
      Folder of the log.

    Raises:
      UserError: no run of the table is usable.
    """
    frame = particle_frame(results)
    if not len(frame):
        raise UserError(
            f"{folder}: none of {len(results)} runs is usable (load carried to 5 %, hub above the ground); give a "
            "smaller --voxel, less load or less slip."
        )
    first = next(r for r in results if r["variant"] == "table")
    error = numerical_error(results)
    # Numerical error as noise: to a fit it is what replicates' scatter is on a test bed.
    noise = {
        QUANTITIES[q][0]: Noise(parts["total"], "datasheet")
        for q, parts in error.items()
        if parts.get("total", 0.0) > 0
    }
    wheel = first["wheel"]
    source = {
        "who": f"lunar-mjx {__version__}, soil of particles",
        "citation": "simulated with Newton's implicit material point method (newton 1.8, warp-lang)",
        "sand": json.dumps(first["sand"]),
        "numerics": json.dumps(first["numerics"]),
        "numerical_error": json.dumps({q: {k: float(f"{v:.3g}") for k, v in p.items()} for q, p in error.items()}),
    }
    # Written beside and renamed: a reader never meets half a log.
    log, part = Path(folder) / LOG_FOLDER, Path(folder) / f".{LOG_FOLDER}.part"
    shutil.rmtree(part, ignore_errors=True)
    sizes = {
        "radius_m": wheel["radius"],
        "width_m": wheel["width"],
        "grouser_count": wheel["grouser_count"],
        "grouser_height_m": wheel["grouser_height"],
    }
    settings = {"wheel": sizes, "slip_definition": slip_definition, "gravity_m_s2": first["gravity"], "source": source}
    write_steady_log(part, frame, noise=noise, **settings)
    shutil.rmtree(log, ignore_errors=True)
    part.rename(log)
    return log
