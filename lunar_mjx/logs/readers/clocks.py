"""Time columns as loggers write them: numbers in some unit, times of day, dates, or nothing but a rate."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import bad_input
from lunar_mjx.logs.readers.table import GAPS
from lunar_mjx.logs.schema import LATEST

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
FASTEST_HZ = 1e9
"""Times are kept to the nanosecond."""
DAY = 86400.0
"""Length of a day, s."""


@dataclasses.dataclass(frozen=True)
class TimeColumn:
    """Where a table's time comes from.

    Attributes:
      column: of the file; "" where there is none and `rate_hz` tells the time by the row's number.
      unit: of a column of numbers, a key of `UNITS`.
      clock: the column holds times of day ("14:31:06.15") or dates ("2020-11-03T11:41:07.57").
      rate_hz: of a table without time.
    """

    column: str = ""
    unit: str = "s"
    clock: bool = False
    rate_hz: float = 0.0


def seconds(frame: pd.DataFrame, time: TimeColumn, path: Path) -> np.ndarray:
    """(n,) time in s, NaN where a cell is empty; days past midnight go on counting.

    Raises:
      UserError: the column is missing, or a cell is no time.
    """
    if not time.column:
        if len(frame) > LATEST * time.rate_hz:
            remedy = "state the rate in samples a second"
            raise bad_input(path, "rate_hz", time.rate_hz, "makes it thousands of years", remedy)
        # Divided and not summed up, so that no rounding adds up over an hour.
        return np.arange(len(frame)) / time.rate_hz
    if time.column not in frame.columns:
        shown = ", ".join(map(str, frame.columns[:20]))
        raise bad_input(path, "time", time.column, "is no column", f"use one of {shown}")
    cells = pd.Series(frame[time.column])
    if time.clock:
        return _clock(cells, path)
    values = np.asarray(pd.to_numeric(cells, errors="coerce"), float)
    text = cells.isna().to_numpy() | np.isfinite(values)
    if not text.all():
        row = int(np.argmin(text))
        shown = str(cells.iloc[row])
        remedy = "write clock = true for times of day and dates" if ":" in shown else remedy_of_text(shown)
        remedy = remedy or "correct the cell"
        raise bad_input(path, f"{time.column}, row {row}", shown, "is no number", remedy)
    seconds = UNITS[time.unit] * values
    far = np.abs(seconds) > LATEST
    if far.any():
        row = int(np.argmax(far))
        raise bad_input(
            path, f"{time.column}, row {row}", values[row], "is thousands of years", "state the unit in the map's table"
        )
    return seconds


def remedy_of_text(cell: str) -> str:
    """What to state in a map so that a cell becomes a number; "" where nothing would."""
    return 'write decimal = "," in the table of the map' if re.fullmatch(r"[-+]?\d*,\d+([eE][-+]?\d+)?", cell) else ""


def _clock(cells: pd.Series, path: Path) -> np.ndarray:
    empty = cells.isna().to_numpy() | cells.astype(str).str.strip().str.lower().isin((*GAPS, "nat")).to_numpy(bool)
    if empty.all():
        return np.full(len(cells), np.nan)
    if empty.any():
        times = np.full(len(cells), np.nan)
        times[~empty] = _clock(pd.Series(cells[~empty]), path)
        return times
    text = cells.astype(str).str.strip()
    parts = text.str.fullmatch(r"([01]?\d|2[0-3]):[0-5]?\d(:([0-5]?\d|60)([.,]\d*)?)?")
    if parts.all():
        split = text.str.replace(",", ".").str.split(":", expand=True).astype(float).to_numpy()
        split = np.concatenate([split, np.zeros((len(split), 3 - split.shape[1]))], axis=1)
        day = split @ np.array([3600.0, 60.0, 1.0])
        # a clock that falls by half a day or more has passed midnight; less is a fault, which the gate judges
        return day + DAY * np.concatenate([[0.0], np.cumsum(np.diff(day) < -0.5 * DAY)])
    try:
        stamps = pd.to_datetime(text, errors="raise", utc=True, format="ISO8601")
        stamps = stamps.astype("datetime64[ns, UTC]")
    except (ValueError, TypeError):
        row = int(np.argmin(parts.to_numpy()))
        raise bad_input(
            path,
            f"{cells.name}, row {cells.index[row]}",
            str(cells.iloc[row]),
            "is neither a time of day nor a date",
            "write it as 14:31:06.15 or 2020-11-03T11:41:07.57",
        ) from None
    nanoseconds = stamps.astype("int64").to_numpy()
    return 1e-9 * (nanoseconds - nanoseconds[0]) + 1e-9 * float(nanoseconds[0])
