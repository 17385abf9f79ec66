"""Measured figures that ship with the package."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError
from lunar_mjx.wheel_bed.table import QUANTITIES, SteadyStateTable

_FOLDER = Path(__file__).resolve().parent / "data"


def replicate_column(quantity: str) -> str:
    """Column of the standard deviation between replicates: `drawbar_pull_replicate_std_N`."""
    column, unit, _ = QUANTITIES[quantity]
    suffix = unit.replace(" ", "")
    return f"{column.removesuffix('_' + suffix)}_replicate_std_{suffix}"


def load_figures(name: str = "cmu_smooth_wheel") -> SteadyStateTable:
    """The averaged figures of a test bed that ship with the package.

    Args:
      name: "cmu_smooth_wheel".

    Returns:
      One row per slip angle and rim speed, with the scatter of single runs pooled over all of them.

    Raises:
      UserError: no figures of that name.
    """
    csv, toml = _FOLDER / f"{name}.csv", _FOLDER / f"{name}.toml"
    if not csv.is_file() or not toml.is_file():
        known = ", ".join(sorted(p.stem for p in _FOLDER.glob("*.csv")))
        raise UserError(f"load_figures: name = {name!r} does not ship with lunar-mjx; use one of {known}.")
    about: dict[str, Any] = tomllib.loads(toml.read_text(encoding="utf-8"))
    frame = pd.read_csv(csv)
    measured = {q: np.asarray(frame[c], float) for q, (c, _, _) in QUANTITIES.items() if c in frame}
    imposed = ["slip_ratio", "slip_angle_deg", "normal_load_N", "rim_speed_m_s", "travel_speed_m_s"]
    return SteadyStateTable(
        name=about["name"],
        test={c: np.asarray(frame[c], float) for c in imposed},
        measured=measured,
        replicates=np.asarray(frame["replicates"], int),
        # Pooled over all points; the CSV's own column is per point, from few runs each.
        sigma={q: about["sigma"][QUANTITIES[q][0]] for q in measured},
        radius=about["wheel"]["radius_m"],
        width=about["wheel"]["width_m"],
        slip_definition=about["slip_definition"],
        source=about["source"],
    )


def replicate_scatter(name: str = "cmu_smooth_wheel") -> dict[str, np.ndarray]:
    """Standard deviation between the replicates of every point of `load_figures(name)`, by quantity, SI units."""
    frame = pd.read_csv(_FOLDER / f"{name}.csv")
    columns = {q: replicate_column(q) for q in QUANTITIES}
    return {q: np.asarray(frame[c], float) for q, c in columns.items() if c in frame}
