"""Reads one table of a drive log from CSV or Parquet into channels of the schema."""

from __future__ import annotations

import importlib.util
import os
import re
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input, one_line, require_file, require_name, require_within
from lunar_mjx.logs.findings import WARNING, Finding
from lunar_mjx.logs.log import LogTable
from lunar_mjx.logs.schema import LATEST, limits, parse_column
from lunar_mjx.toml_fields import Fields

TIME = "time_s"
GAPS = ("", "nan", "na", "n/a", "null", "none", "-")
"""Texts that mean a gap, in small letters."""


def read_frame(path: Path, what: str) -> pd.DataFrame:
    """A CSV or Parquet file as a frame; cells of CSV files stay text where they are not numbers.

    Raises:
      UserError: the file is missing, is not a table, or is Parquet without the package that reads it.
    """
    require_file(path, what)
    if path.suffix.lower() in (".parquet", ".pq"):
        return read_parquet(path)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)  # rows longer than the header
            warnings.simplefilter("ignore", pd.errors.DtypeWarning)  # a text deep in a column of numbers is found below
            # Without index_col=False, pandas shifts the columns where rows end with a comma.
            frame = pd.read_csv(path, index_col=False, comment=None)
    except (ValueError, pd.errors.ParserWarning, UnicodeDecodeError) as error:
        raise UserError(
            f"{path}: is not a CSV table ({one_line(error)}); write time_s and one column per channel."
        ) from None
    # Two columns of one name reach us as "name" and "name.1".
    for column in map(str, frame.columns):
        stem = re.fullmatch(r"(.+)\.\d+", column)
        if stem and stem[1] in frame.columns:
            raise bad_input(path, "column", stem[1], "occurs twice", "keep one of them")
    return frame


def cut_row(path: Path, frame: pd.DataFrame) -> tuple[int, str] | None:
    """The last row of a text file that was not written to its end, and what says so; None where all rows are whole.

    A row that ends the file without a new line may lack cells, or digits of its last cell: nothing tells.
    """
    if path.suffix.lower() in (".parquet", ".pq", ".mat") or frame.empty:
        return None
    with path.open("rb") as file:
        file.seek(-1, os.SEEK_END)
        if file.read(1) in b"\r\n":
            return None
    return len(frame) - 1, "is not ended by a new line: it may be half written, and is left out"


def read_parquet(path: Path) -> pd.DataFrame:
    """The table of a Parquet file.

    Raises:
      UserError: pyarrow is not installed, or the file cannot be read.
    """
    if importlib.util.find_spec("pyarrow") is None:
        raise UserError(f"{path}: a Parquet file needs the package pyarrow; install lunar-mjx[parquet] or save as CSV.")
    try:
        return pd.read_parquet(path, engine="pyarrow")
    except Exception as error:  # Arrow raises a dozen kinds at damaged bytes
        told = one_line(error)[:200] or type(error).__name__
        raise UserError(f"{path}: is not a Parquet table ({told}); save it again, or as CSV.") from None


def numbers(frame: pd.DataFrame, column: str) -> tuple[np.ndarray, int | None]:
    """A column as float64 with NaN at gaps, and the first row that holds something else than a number or a gap."""
    series = frame[column]
    # Columns of plain numbers skip the way over text.
    if series.dtype.kind in "fiu":
        values = np.asarray(series, float)
        wrong = np.isinf(values)
    else:
        text = series.astype(str).str.strip()
        values = np.asarray(pd.to_numeric(text, errors="coerce"), float)
        wrong = (~np.isfinite(values)) & ~text.str.lower().isin(GAPS).to_numpy(bool)
    first = int(np.argmax(wrong)) if wrong.any() else None
    return np.where(np.isfinite(values), values, np.nan), first


def read_log_table(
    folder: Path, log: str, name: str, entry: Fields, extra: Mapping[str, str], problems: list[Finding]
) -> LogTable:
    """Reads the table that `[tables.NAME]` describes.

    Args:
      folder: of the log. log: its name. name: of the table.
      entry: the table of `log.toml`.
      extra: key of the environment -> column that holds it.
      problems: receives what makes data unusable.

    Raises:
      UserError: the file is missing or is no table, or has no column `time_s`.
    """
    path = folder / require_name(entry.path, entry.field("file"), entry.text("file"), "name a file of measurements")
    frame = read_frame(path, f"the table {name}")
    frame.columns = [str(c).strip() for c in frame.columns]
    if cut := cut_row(path, frame):
        problems.append(Finding(log, name, cut[0], "", "short", cut[1], WARNING))
        frame = frame.iloc[:-1]
    if TIME not in frame.columns:
        shown = ", ".join(list(frame.columns)[:5])
        raise bad_input(path, "columns", shown, f"lack {TIME}", "add the time in seconds as the first column")
    time, wrong = numbers(frame, TIME)
    if wrong is not None:
        problems.append(_no_number(log, name, wrong, TIME, frame))
    wanted = {column: key for key, column in extra.items()}
    channels: dict[str, np.ndarray] = {}
    columns: dict[str, str] = {}
    for column in frame.columns:
        if column == TIME:
            continue
        # A column that log.toml names for the environment need not have a channel's name.
        if column in wanted:
            channel, scale, offset = wanted[column], 1.0, 0.0
        else:
            found = parse_column(column, str(path))
            if found is None:
                problems.append(
                    Finding(
                        log,
                        name,
                        None,
                        column,
                        "unknown",
                        "is no channel of the schema and is ignored; correct its name if it should be one",
                        WARNING,
                    )
                )
                continue
            if found.problem:
                problems.append(Finding(log, name, None, column, "unit", found.problem))
                continue
            channel, scale, offset = found.name, found.scale, found.offset
        if channel in channels:
            raise bad_input(path, "column", column, f"is the same channel as {columns[channel]}", "keep one of them")
        values, wrong = numbers(frame, column)
        if wrong is not None:
            problems.append(_no_number(log, name, wrong, column, frame))
        # In the schema's unit, in which the ranges are stated.
        channels[channel] = _without_spikes(scale * values + offset, channel, (log, name, column), problems)
        columns[channel] = column
    return LogTable(
        name=name,
        file=path,
        time_s=time,
        channels=channels,
        rate_hz=entry.positive("rate_hz", _rate(time)),
        clock_offset_s=require_within(
            entry.path, entry.field("clock_offset_s"), entry.number("clock_offset_s", 0.0), -LATEST, LATEST
        ),
        clock_offset_std_s=require_within(
            entry.path, entry.field("clock_offset_std_s"), entry.number("clock_offset_std_s", 0.0), 0.0
        ),
        columns=columns,
        on_change=_flag(entry, "on_change"),
    )


SPIKES = 1e-3
"""Share of samples beyond the physical range up to which they are single faults of a receiver or a bus, and become
gaps; more of them are another unit or a broken sensor, which the gate refuses."""


def _without_spikes(
    values: np.ndarray, channel: str, where: tuple[str, str, str], problems: list[Finding]
) -> np.ndarray:
    """The values with gaps in place of single ones that no rover can show, which a warning names."""
    low, high, why = limits(channel)
    beyond = np.isfinite(values) & ((values < low) | (values > high))
    count = int(beyond.sum())
    if not 0 < count <= SPIKES * len(values):
        return values
    row = int(np.argmax(beyond))
    text = (
        f"is {values[row]:.6g}, outside [{low:g}, {high:g}] ({why}), in {count} of {len(values)} rows, which are gaps"
    )
    problems.append(Finding(*where[:2], row, where[2], "range", text, WARNING))
    return np.where(beyond, np.nan, values)


def _flag(entry: Fields, key: str) -> bool:
    value = entry.values.get(key, False)
    if not isinstance(value, bool):
        raise bad_input(entry.path, entry.field(key), value, "is neither true nor false", f"write {key} = true")
    return value


def _no_number(log: str, table: str, row: int, column: str, frame: pd.DataFrame) -> Finding:
    value = str(frame[column].iloc[row])
    return Finding(
        log,
        table,
        row,
        column,
        "number",
        f"holds {value[:40]!r}, which is neither a number nor a gap; leave the cell empty or correct it",
    )


def _rate(time: np.ndarray) -> float:
    steps = np.diff(time[np.isfinite(time)])
    steps = steps[steps > 0.0]
    # The gate refuses a time that never rises; until then any rate will do.
    return float(1.0 / np.median(steps)) if steps.size else 1.0
