"""Tables as loggers write them: CSV and TXT with any separator, with or without a header; Parquet and MATLAB files."""

from __future__ import annotations

import csv
import dataclasses
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input, one_line, require_file
from lunar_mjx.logs.readers.table import read_parquet

SEPARATORS: Mapping[str, str] = {"comma": ",", "semicolon": ";", "tab": "\t", "blank": r"\s+", ",": ",", ";": ";"}
"""Names of separators in a map, and what pandas calls them; `blank` is any run of blanks and tabs."""
SUFFIXES = (".csv", ".txt", ".dat", ".tsv", ".log", ".parquet", ".pq", ".mat")


@dataclasses.dataclass(frozen=True)
class Sniffing:
    """How a separator is guessed."""

    most_rows: float = 0.6
    """Share of rows that a separator must split into the same number of cells."""
    bytes_read: int = 65536
    """Enough for a header and hundreds of rows, from which the separator is guessed."""


SNIFFING = Sniffing()


@dataclasses.dataclass(frozen=True)
class Layout:
    """How a plain file is laid out.

    Attributes:
      header: whether the first row names the columns; without one, columns are called by their place, "0", "1", ...
      separator: a key of `SEPARATORS`, or "" to guess it. decimal: "." or ",".
      skip_rows: rows before the header or the first row. comment: a sign after which the rest of a line is ignored.
    """

    header: bool = True
    separator: str = ""
    decimal: str = "."
    skip_rows: int = 0
    comment: str = ""


def read_table_file(path: Path, layout: Layout, wanted: Sequence[str] = ()) -> pd.DataFrame:
    """A file as a frame whose columns are called by text; cells that are not numbers stay text.

    Args:
      path: of the file. layout: of a text file.
      wanted: columns that will be used; they choose among the variables of a MATLAB file, which differ in length.

    Raises:
      UserError: the file is missing, of an unknown kind, not a table, or needs a package that is missing.
    """
    require_file(path, "the recording")
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq"):
        frame = read_parquet(path)
    elif suffix == ".mat":
        frame = _matlab(path, wanted)
    else:
        frame = _text(path, layout, wanted)
    frame.columns = [str(c).strip() for c in frame.columns]
    twice = frame.columns[frame.columns.duplicated()]
    if len(twice):
        raise bad_input(path, "column", twice[0], "occurs twice", "rename one of them, or read the file without header")
    return frame


def _text(path: Path, layout: Layout, wanted: Sequence[str]) -> pd.DataFrame:
    try:
        # Spreadsheets write a byte order mark, which would become part of the first name.
        with path.open(encoding="utf-8-sig", newline="") as stream:
            start = stream.read(SNIFFING.bytes_read)
    except (UnicodeDecodeError, OSError) as error:
        raise UserError(f"{path}: is not a text table ({error}); give CSV, TXT, Parquet or MATLAB files.") from None
    if not start.strip():
        raise UserError(f"{path}: is empty; record it again or leave it out.")
    separator = SEPARATORS[layout.separator] if layout.separator else guess_separator(start, layout.decimal)
    try:
        with warnings.catch_warnings():
            # rows longer than the header: pandas would drop what no name stands above
            warnings.simplefilter("error", pd.errors.ParserWarning)
            options: dict[str, Any] = {
                "sep": separator,
                "decimal": layout.decimal,
                "skiprows": layout.skip_rows,
                "comment": layout.comment or None,
                "index_col": False,
                "skipinitialspace": True,
                "encoding": "utf-8-sig",
                "low_memory": False,
            }
            frame = pd.read_csv(path, header=0 if layout.header else None, **options)
            if any(str(c).endswith(".1") for c in frame.columns) and layout.header:
                _refuse_one_name(path, pd.read_csv(path, header=None, nrows=1, dtype=str, **options), wanted)
            return frame
    except pd.errors.ParserWarning:
        lines = [line for line in start.splitlines()[layout.skip_rows :] if line.strip()]
        raise bad_input(
            path,
            "header",
            lines[0][:60],
            "has fewer names than the rows below it have cells",
            'state skip_rows = 1 (rows before the header), comment = "#" or header = false in the map\'s table',
        ) from None
    except UserError:
        raise
    except (ValueError, pd.errors.ParserError) as error:
        shown = str(error).strip().split("\n")[0]
        raise UserError(f"{path}: is not a table of even rows ({shown}); state its separator and skip_rows.") from None


def _refuse_one_name(path: Path, header: pd.DataFrame, wanted: Sequence[str]) -> None:
    """Refuses a wanted column whose name occurs twice, by the header as it stands: pandas calls the second "name.1"."""
    names = [str(name).strip() for name in header.iloc[0]]
    for name in wanted:
        if names.count(name) > 1 or (name not in names and names.count(name.rpartition(".")[0]) > 1):
            remedy = "rename one of them, or read the file without header"
            raise bad_input(path, "column", name, "occurs twice", remedy)


def guess_separator(start: str, decimal: str = ".") -> str:
    """The separator of a text table, as pandas calls it: the one that splits most rows into equally many cells.

    One that splits the first line into as many goes first: a decimal comma splits the numbers, and no names.

    Args:
      start: the first rows. decimal: sign in numbers, which is then no separator.
    """
    # Without the first line: a header or title may have another number of cells.
    lines = [line for line in start.splitlines()[1:200] if line.strip()] or start.splitlines()
    first = next((line for line in start.splitlines() if line.strip()), "")
    best, most = r"\s+", (False, 1)
    for sign in (",", ";", "\t"):
        if sign == decimal:
            continue
        # By csv, since quoted cells may hold the sign.
        counts = [len(next(csv.reader([line], delimiter=sign))) for line in lines]
        typical = int(np.median(counts))
        if typical < 2 or np.mean(np.array(counts) == typical) <= SNIFFING.most_rows:
            continue
        rank = len(next(csv.reader([first], delimiter=sign))) == typical, typical
        if rank > most:
            best, most = sign, rank
    return best


def without_units(frame: pd.DataFrame, decimal: str) -> tuple[pd.DataFrame, str]:
    """A table without a row of units under its header, and that row as text, "" where there is none.

    Such a row holds no number while the row below it does.

    Args:
      frame: as `read_table_file` gives it. decimal: sign in numbers, which a column with such a row holds as text.
    """

    def number(cells: pd.Series, sign: str = decimal) -> pd.Series:
        text = cells.astype(str).str.strip().str.replace(sign, ".", regex=False)
        return pd.Series(pd.to_numeric(text, errors="coerce"))

    if len(frame) < 2 or any(c.dtype.kind not in "OUTS" and c.notna().any() for _, c in frame.items()):
        return frame, ""
    top = frame.iloc[0].map(lambda cell: "" if pd.isna(cell) else str(cell).strip())
    # A comma in the numbers may be a decimal one that the map does not state yet.
    if number(top, ",").notna().any() or not number(frame.iloc[1], ",").notna().any():
        return frame, ""
    # A unit is a word; a clock and dashes for what is missing are a row of data.
    if not any(re.search(r"[^\W\d_]|[%°]", text) for text in top):
        return frame, ""
    rest = frame.iloc[1:].reset_index(drop=True)
    for column in rest.columns:
        values = number(rest[column])
        # What holds text below it as well stays text, for a sentence that names the cell.
        if (values.notna() | rest[column].isna()).all():
            rest[column] = values
    return rest, ", ".join(text for text in top if text)


def _matlab(path: Path, wanted: Sequence[str]) -> pd.DataFrame:
    """Variables of a MATLAB file (up to version 7) as columns: `gyro[0]` of a matrix, `imu.gyro[0]` of one in a struct.

    Those as long as the wanted ones, else of the most frequent length, are the columns of one table.
    """
    from scipy.io import loadmat

    try:
        loaded = loadmat(path, squeeze_me=True, struct_as_record=False)
    except NotImplementedError:
        raise UserError(
            f"{path}: is a MATLAB file of version 7.3; save it with save(file, '-v7'), or as CSV."
        ) from None
    except Exception as error:  # headers, compression and types raise a dozen kinds at damaged bytes
        told = one_line(error)[:200] or type(error).__name__
        raise UserError(f"{path}: is not a MATLAB file ({told}); save it again, or as CSV.") from None
    columns: dict[str, np.ndarray] = {}
    for name, value in loaded.items():
        if not name.startswith("__"):
            _flatten(name, value, columns)
    if not columns:
        raise UserError(f"{path}: holds no series of numbers; save vectors or matrices with one row per sample.")
    mine = {name: len(columns[name]) for name in wanted if name in columns}
    if len(set(mine.values())) > 1:
        shown = ", ".join(f"{name} {count}" for name, count in mine.items())
        raise bad_input(path, "rows", shown, "differ", "put variables of different length into tables of their own")
    lengths = list(mine.values()) or [len(v) for v in columns.values()]
    # The most frequent length, of equals the longest: MATLAB files mix series and settings.
    rows = max(set(lengths), key=lambda n: (lengths.count(n), n))
    return pd.DataFrame({k: v for k, v in columns.items() if len(v) == rows})


def _flatten(name: str, value: Any, columns: dict[str, np.ndarray]) -> None:
    fields: Sequence[str] | None = getattr(value, "_fieldnames", None)
    if fields is not None:
        for field in fields:
            _flatten(f"{name}.{field}", getattr(value, field), columns)
        return
    array = np.asarray(value)
    if array.dtype.kind not in "fiubU" or array.ndim not in (1, 2) or max(array.shape) < 2:
        return
    if array.ndim == 1:
        columns[name] = array
        return
    # MATLAB keeps samples in either direction; there are more samples than signals
    array = array if array.shape[0] >= array.shape[1] else array.T
    for k in range(array.shape[1]):
        columns[f"{name}[{k}]"] = array[:, k]
