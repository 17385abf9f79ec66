"""Writes measurement logs: tables of channels and the `log.toml` that describes them."""

from __future__ import annotations

import importlib.util
import re
import shutil
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import tomli_w

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import replacing, write_text
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.readers.folder import LOG_FILE, TOP, read_log
from lunar_mjx.logs.schema import FORMAT, parse_column


def write_log(
    folder: str | Path,
    tables: Mapping[str, pd.DataFrame],
    *,
    rover: str,
    noise: Mapping[str, Noise] | None = None,
    rates_hz: Mapping[str, float] | None = None,
    clock_offsets_s: Mapping[str, tuple[float, float]] | None = None,
    on_change: Collection[str] = (),
    parquet: bool = False,
    **settings: Any,
) -> Path:
    """Writes a drive log that `read_log` reads back.

    Args:
      folder: must not exist, or be empty.
      tables: frames by name, `time_s` first and channels of the schema after it; NaN at gaps.
      rover: name, or path of a rover's folder.
      noise: by channel.
      rates_hz: by table; the median rate of its time if left out.
      clock_offsets_s: offset and its standard deviation, by table.
      on_change: tables whose rows were written when a reading was new.
      parquet: write Parquet instead of CSV (needs pyarrow).
      **settings: further keys of `log.toml`: manoeuvre, gravity_m_s2, terrain, terrain_origin_m, split, environment,
        rover_changes, initial, imu, source, commitment.

    Returns:
      The folder.

    Raises:
      UserError: the folder is not empty, a table has no `time_s`, a column is no channel, or a setting is unknown.
    """
    folder = Path(folder)
    for key in settings:
        if key not in TOP or key in ("format", "kind", "tables", "noise"):
            raise bad_input("write_log", key, settings[key], "is unknown", f"use one of {', '.join(TOP[2:])}")
    # All checks before the folder is made: a refused log leaves nothing behind.
    for name, frame in tables.items():
        _check_frame(name, frame)
    top: dict[str, Any] = {"format": FORMAT, "rover": rover}
    top |= {k: _plain(v) for k, v in settings.items() if v is not None}
    entries: dict[str, dict[str, Any]] = {}
    for name, frame in tables.items():
        rate = (rates_hz or {}).get(name) or _rate(frame)
        entries[name] = {
            "file": f"{name}.{'parquet' if parquet else 'csv'}",
            **({"rate_hz": round(rate, 6)} if rate else {}),
        }
        if name in on_change:
            entries[name]["on_change"] = True
        if clock_offsets_s is not None and name in clock_offsets_s:
            offset, std = clock_offsets_s[name]
            entries[name] |= {"clock_offset_s": float(offset), "clock_offset_std_s": float(std)}
    top["tables"] = entries
    top["noise"] = noise_tables(noise or {})
    with _whole(folder):
        for name, frame in tables.items():
            write_frame(frame, folder / entries[name]["file"])
        write_text(folder / LOG_FILE, tomli_w.dumps(top))
        # What was written must read back: settings are checked by the reader's rules, and not by a second set of them.
        read_log(folder)
    return folder


def write_steady_log(
    folder: str | Path,
    frame: pd.DataFrame,
    *,
    wheel: Mapping[str, float],
    slip_definition: str,
    noise: Mapping[str, Noise] | None = None,
    **settings: Any,
) -> Path:
    """Writes a steady-state log that `read_log` reads back.

    Args:
      folder: must not exist, or be empty.
      frame: one row per run, with the columns of a steady-state table.
      wheel: radius_m, width_m, grouser_count, grouser_height_m.
      slip_definition: "wheel_frame" or "travel_speed".
      noise: by column.
      **settings: split, gravity_m_s2, source, manoeuvre, commitment.

    Raises:
      UserError: the folder is not empty, or the result cannot be read back.
    """
    folder = Path(folder)
    top: dict[str, Any] = {"format": FORMAT, "kind": "steady_state", "file": "points.csv"}
    top |= {"slip_definition": slip_definition} | {k: _plain(v) for k, v in settings.items() if v is not None}
    top |= {"wheel": {k: _plain(v) for k, v in wheel.items()}, "noise": noise_tables(noise or {})}
    with _whole(folder):
        write_frame(frame, folder / "points.csv")
        write_text(folder / LOG_FILE, tomli_w.dumps(top))
        read_log(folder)
    return folder


@contextmanager
def _whole(folder: Path) -> Iterator[None]:
    """Makes a folder; takes it away where its files are refused or have no room, so that they can be written anew."""
    new_folder(folder)
    try:
        yield
    except UserError:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def noise_tables(noise: Mapping[str, Noise]) -> dict[str, dict[str, Any]]:
    """Noise as tables of `log.toml`."""
    tables = {}
    for name, entry in noise.items():
        tables[name] = {"std": float(entry.std), "source": entry.source}
        # White noise is what the field's absence means.
        if entry.correlation_time_s:
            tables[name]["correlation_time_s"] = float(entry.correlation_time_s)
            if entry.correlated_share < 1.0:
                tables[name]["correlated_share"] = float(entry.correlated_share)
    return tables


def refuse_used(folder: Path) -> None:
    """Refuses a folder that holds anything, so that nobody's measurements are overwritten."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise bad_input("lunar-mjx log", "folder", str(folder), "exists already", "name a new folder")


def new_folder(folder: Path) -> None:
    """Makes a folder that must not exist or be empty."""
    refuse_used(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise bad_input(
            "lunar-mjx log", "folder", str(folder), f"cannot be made ({error.strerror})", "name another folder"
        ) from error


def write_frame(frame: pd.DataFrame, path: Path) -> None:
    """Writes a table by the ending of its path; empty cells for NaN, 9 significant digits in CSV."""
    if path.suffix == ".parquet":
        if importlib.util.find_spec("pyarrow") is None:
            raise UserError(f"{path}: Parquet needs the package pyarrow; install lunar-mjx[parquet] or write CSV.")
        with replacing(path) as part:
            frame.to_parquet(part, index=False, engine="pyarrow")
        return
    with replacing(path) as part:
        # Nine digits bring every float32 back to the last bit.
        frame.to_csv(part, index=False, float_format="%.9g")


def _check_frame(name: str, frame: pd.DataFrame) -> None:
    # It becomes the name of a file in the log's folder, and of no other place.
    if not re.fullmatch(r"\w[\w .-]{0,99}", name):
        remedy = "use 100 letters, digits and underscores at most"
        raise bad_input("write_log", "name of a table", name, "is no name of a file", remedy)
    if "time_s" not in frame.columns:
        raise bad_input("write_log", f"tables.{name}", list(frame.columns)[:4], "lacks time_s", "add the time in s")
    for column in map(str, frame.columns):
        parsed = parse_column(column, "write_log") if column != "time_s" else None
        if parsed is not None and parsed.problem:
            raise bad_input("write_log", f"tables.{name}", column, parsed.problem, "rename the column")


def _rate(frame: pd.DataFrame) -> float:
    """Median rate of a table's time, Hz; 0 where time nowhere rises, which is for the gate to tell."""
    steps = np.diff(np.asarray(frame["time_s"], float))
    # Times that go back are the gate's to tell; here they would spoil the median.
    steps = steps[steps > 0.0]
    return float(1.0 / np.median(steps)) if steps.size else 0.0


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays as Python's, which TOML can hold."""
    if isinstance(value, Mapping):
        return {k: _plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain(v) for v in value]
    return str(value) if isinstance(value, Path) else value
