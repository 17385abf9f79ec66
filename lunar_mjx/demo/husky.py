"""A real Husky on sandy loam: its measured current against a model of hard floors, before and after soft ground."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lunar_mjx.criticism import add, compare
from lunar_mjx.logs.example import copy_example
from lunar_mjx.logs.readers.import_log import import_drives
from lunar_mjx.model.file import load_model
from lunar_mjx.model.hard_floor import hard_floor

MAP = "husky_borealtc"
SAND, FLOOR = "sand", "floor"
CURRENT = "motor_left_drive_current_A"


class HuskyCase(NamedTuple):
    """The left side's current on sandy loam.

    Attributes:
      time: (n,) s, NaN between windows. measured, before, after: (n,) A: as measured, by the model as it was fitted on
        the floor, and with soft ground added and refitted.
      error_before, error_refitted, error_after: root mean square in sigma of all channels, by split (fit, held_out): of
        the model as fitted on the floor, refitted to this drive, and with soft ground.
      source: who measured, licence and citation.
    """

    time: np.ndarray
    measured: np.ndarray
    before: np.ndarray
    after: np.ndarray
    error_before: dict[str, float]
    error_refitted: dict[str, float]
    error_after: dict[str, float]
    source: dict[str, str]

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return {k: v for k, v in self._asdict().items() if isinstance(v, dict)}


def husky_case(seed: int = 0, progress: Callable[[float], None] | None = None) -> HuskyCase:
    """Fits a hard floor to a recording that ships, and holds it against sandy loam without and with soft ground.

    Args:
      seed: of the choice of windows. progress: called with the share done.
    """
    tell = progress or (lambda done: None)
    with tempfile.TemporaryDirectory() as folder:
        log_folder = Path(folder)
        # By the steps that a user takes with an own recording, on a folder that is thrown away.
        import_drives(copy_example(log_folder / "recordings"), log_folder / "logs", MAP)
        floor = compare([log_folder / "logs" / FLOOR], hard_floor("husky"), log_folder / FLOOR, seed=seed)
        tell(0.5)
        # From what the floor taught of motors and gears, so that the ground alone is new.
        sand = compare(
            [log_folder / "logs" / SAND], load_model(floor.folder / "fitted.toml"), log_folder / SAND, seed=seed
        )
        tell(0.7)
        grown = add(sand.folder, "soft_ground", log_folder / "grown")
        tell(1.0)
        time, measured, before = _series(sand.folder / "series.npz", "as given")
        after = _series(grown.folder / "series.npz", "refitted")[2]
        # As fitted on the floor, refitted to the sand, and refitted with soft ground.
        first, last = (r.load("comparison.json") for r in (sand, grown))
        errors = (dict(first["as_given"]), dict(first["refitted"]), dict(last["refitted"]))
        return HuskyCase(time, measured, before, after, *errors, dict(sand.campaign()[0].source))


def _series(file: Path, label: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, measured values and those of a model of the left side's current; NaN between windows."""
    with np.load(file) as data:
        at = list(data["series_channel"]).index(CURRENT)
        stops = [*data["series_start"][1:], len(data["measured"])]
        part = slice(int(data["series_start"][at]), int(stops[at]))
        row = list(data["labels"]).index(label)
        values = data["time"][part], data["measured"][part], data["predicted"][row][part]
    # Not a number between windows: else a line would be drawn across what was not simulated.
    gaps = np.flatnonzero(np.diff(values[0]) > 0.5) + 1
    time, measured, predicted = (np.insert(v.astype(float), gaps, np.nan) for v in values)
    return time, measured, predicted
