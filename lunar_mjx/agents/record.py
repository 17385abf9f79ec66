"""What a training leaves behind: a CSV, TensorBoard events, and a line of progress."""

from __future__ import annotations

import csv
import math
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from lunar_mjx.files import appending, replacing


class Record:
    """Rows of numbers, one per epoch, kept in `progress.csv` and `events` in a folder.

    Args:
      folder: must exist.
      rows: rows of the training so far, when it is resumed: the files begin anew with them.
    """

    def __init__(self, folder: Path, rows: Sequence[dict[str, Any]] = ()):
        from tensorboardX import SummaryWriter

        self._path = folder / "progress.csv"
        self._names: list[str] = []
        self.rows: list[dict[str, Any]] = []
        # What was written after the checkpoint that a training goes on from would stand twice in the curves.
        purge = int(rows[-1]["steps"]) + 1 if rows else None
        self._events = SummaryWriter(str(folder / "events"), purge_step=purge, flush_secs=30)
        # Begun anew with the checkpoint's rows: the file may hold later ones, of a training that was killed.
        self._path.unlink(missing_ok=True)
        for row in rows:
            self._append(row)

    def add(self, row: dict[str, Any]) -> None:
        """Adds a row; `steps` in it is the axis of the curves."""
        self._append(row)
        for name, value in row.items():
            if isinstance(value, int | float) and math.isfinite(value):
                self._events.add_scalar(name, value, int(row["steps"]))

    def _append(self, row: dict[str, Any]) -> None:
        self.rows.append(row)
        # A row may bring a new number, such as the first score: then the file is written anew, with one more column.
        known = list(dict.fromkeys([*self._names, *row]))
        whole = known != self._names
        self._names = known
        with (
            replacing(self._path) if whole else appending(self._path) as part,
            part.open("w" if whole else "a", newline="", encoding="utf-8") as file,
        ):
            writer = csv.DictWriter(file, self._names, restval="")
            if whole:
                writer.writeheader()
            writer.writerows(self.rows if whole else [row])

    def close(self) -> None:
        """Writes out what the event file still holds."""
        self._events.close()


class Progress:
    """One line per epoch, at most one every few seconds."""

    def __init__(self, total: int, limit: float | None, quiet: bool = False, every: float = 2.0):
        self._console, self._quiet = Console(stderr=True, soft_wrap=True), quiet
        self._total, self._limit, self._every = total, limit, every
        self._begin, self._last = time.monotonic(), -math.inf

    def show(self, row: dict[str, Any], final: bool = False) -> None:
        """Prints steps, rate, time left, return and success of a row."""
        now = time.monotonic()
        # Epochs may take milliseconds; lines that fast cannot be read, and fill a log.
        if self._quiet or (now - self._last < self._every and not final):
            return
        self._last = now
        rate = row["steps_per_s"]
        left = (self._total - row["steps"]) / rate if rate > 0 else math.inf
        if self._limit is not None:
            left = min(left, self._limit - (now - self._begin))
        mean, success = row.get("episode_return", math.nan), row.get("success", math.nan)
        parts = [f"{row['steps']:,} steps", f"{rate:,.0f} steps/s", f"{max(left, 0.0):.0f} s left"]
        if math.isfinite(mean):
            parts += [f"return {mean:.1f}", f"success {100 * success:.0f} %"]
        self._console.print("  ".join(parts), highlight=False)
