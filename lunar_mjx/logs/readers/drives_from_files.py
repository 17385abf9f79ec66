"""Drives from plain files: which files belong together, and their columns as channels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.readers.clocks import remedy_of_text, seconds
from lunar_mjx.logs.readers.import_map import FOLDER, ImportMap, Source, TableMap, file_pattern
from lunar_mjx.logs.readers.recorded_drive import (
    LATITUDE,
    LONGITUDE,
    TIME,
    RecordedDrive,
    positions,
    without_copies,
    without_empty,
)
from lunar_mjx.logs.readers.table import cut_row
from lunar_mjx.logs.readers.table_files import SUFFIXES, read_table_file, without_units

GAPS = ("", "nan", "na", "n/a", "null", "none", "-", "inf", "-inf")
"""Texts that mean a gap, in small letters."""
Files = dict[str, Path]
"""File of every table by its name."""


def drives_of_files(paths: Sequence[Path], mapping: ImportMap) -> Iterator[RecordedDrive]:
    """Drives that some files, or folders of files, hold.

    Raises:
      UserError: nothing matches the map, or a file is not what the map says.
    """
    told: set[str] = set()
    for name, files in group_files(paths, mapping).items():
        for drive in _read(name, files, mapping):
            # what holds for every file of a kind is said once
            fresh = tuple(n for n in drive.notes if n not in told)
            told.update(n for n in fresh if "not mapped" in n or "under the header" in n)
            yield dataclasses.replace(drive, notes=fresh)


def group_files(paths: Sequence[Path], mapping: ImportMap) -> dict[str, Files]:
    """Files of each drive by the drive's name: the text that `{drive}` stands for, else the folder's name.

    Raises:
      UserError: a path is missing, no file matches, two files are the same table, or a given file matches nothing.
    """
    patterns = {name: file_pattern(t.file) for name, t in mapping.tables.items()}
    found: dict[tuple[Path, str], Files] = {}
    for path, given in _all_files(paths):
        matched = False
        for table, pattern in patterns.items():
            match = pattern.fullmatch(path.name)
            if match is None:
                continue
            matched = True
            key = match.groupdict().get("drive") or ""
            files = found.setdefault((path.parent, key), {})
            if table in files:
                raise bad_input(
                    mapping.path,
                    f"tables.{table}.file",
                    mapping.tables[table].file,
                    f"matches {files[table].name} and {path.name} of one drive",
                    "write {drive} where the names of drives differ",
                )
            files[table] = path
        if given and not matched:
            shown = ", ".join(t.file for t in mapping.tables.values())
            raise bad_input(
                mapping.path,
                "file",
                path.name,
                f"matches no table of the map ({shown})",
                "give another map, or rename the file",
            )
    if not found:
        shown = ", ".join(t.file for t in mapping.tables.values())
        raise UserError(f"{paths[0]}: holds no file that {mapping.path.name} reads ({shown}); name files or folders.")
    names = [key or parent.resolve().name for parent, key in found]
    # Folders of one day's drives often number them alike.
    if len(set(names)) < len(names):
        names = [f"{parent.resolve().name}_{name}" for (parent, _), name in zip(found, names, strict=True)]
    return dict(zip(names, found.values(), strict=True))


def _all_files(paths: Sequence[Path]) -> Iterator[tuple[Path, bool]]:
    """Files and whether they were named themselves; folders with all that is in and below them."""
    for path in paths:
        if path.is_dir():
            yield from ((p, False) for p in sorted(path.rglob("*")) if p.suffix.lower() in SUFFIXES and p.is_file())
        elif path.is_file():
            yield path, True
        else:
            raise UserError(f"{path}: the recording is not there; check the path or its spelling.")


def _read(name: str, files: Files, mapping: ImportMap) -> Iterator[RecordedDrive]:
    missing = [t for t in mapping.tables if t not in files]
    notes = [f"has no file for the table {t} ({mapping.tables[t].file})" for t in missing]
    parts: dict[str, tuple[str, pd.DataFrame]] = {}
    settings, copies = {}, []
    if mapping.settings.get("ground") == FOLDER:
        settings["ground"] = next(iter(files.values())).resolve().parent.name.lower()
    for t, path in files.items():
        table = mapping.tables[t]
        frame = _frame(path, table, f"{mapping.path}: tables.{t}", notes)
        # Copies are told by the file's own rows, before groups cut them.
        found = {"": frame}
        if table.held == "auto":
            found, left = without_copies(frame, _rising(frame))
            copies += left
        for key, part in found.items():
            if table.geodetic is not None and LATITUDE in part:
                found[key], origin = positions(part, table.geodetic, path)
                settings |= {"geodetic_origin": origin} if origin else {}
        parts |= {f"{t}_{k}" if k else t: (t, part) for k, part in found.items()}
    source = {"files": ", ".join(sorted({p.name for p in files.values()}))}
    for key, tables in _groups(parts):
        started = _from_zero(tables, {n: mapping.tables[t].own_start for n, (t, _) in parts.items()})
        drive = RecordedDrive(
            f"{name}_{key}" if key else name,
            started,
            source,
            settings,
            tuple(notes),
            tuple(copies),
            frozenset(n for n, (t, _) in parts.items() if n != t),
        )
        yield without_empty(drive)
        notes, copies = [], []


GROUP = "group"
"""Column that numbers the groups of a table's rows."""


def _rising(frame: pd.DataFrame) -> np.ndarray:
    """Time that goes on from group to group."""
    time = frame[TIME].to_numpy(float)
    if GROUP not in frame:
        return time
    steps = np.diff(time, prepend=time[:1])
    usual = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 1.0
    return np.cumsum(np.where(np.diff(frame[GROUP].to_numpy(), prepend=1) != 0, usual, steps))


def _frame(path: Path, table: TableMap, where: str, notes: list[str]) -> pd.DataFrame:
    """Time, channels and what groups or places need, from one file."""
    raw = read_table_file(path, table.layout, table.columns)
    if table.layout.header:
        raw, units = without_units(raw, table.layout.decimal)
        if units:
            notes.append(f"{table.file}: the row under the header holds no number ({units[:60]}) and is left out")
    if cut := cut_row(path, raw):
        notes.append(f"{table.file}, row {cut[0]}: {cut[1]}")
        raw = raw.iloc[:-1]
    unknown = [c for c in table.columns if c not in raw.columns]
    if unknown:
        shown = ", ".join(list(raw.columns)[:20])
        hint = "" if table.layout.header else " (without a header columns are called 0, 1, ...)"
        raise bad_input(path, where, unknown[0], f"is no column{hint}", f"use one of {shown}")
    left = [c for c in raw.columns if c not in table.columns]
    if left:
        notes.append(f"{table.file}: columns not mapped and not read: {', '.join(left)}")
    for column in table.columns:
        if raw[column].dtype.kind == "f" and (count := int(np.isinf(raw[column]).sum())):
            notes.append(f"{table.file}: {column} reads inf in {count} rows, which are gaps")
    out = {TIME: seconds(raw, table.clock, path)}
    for channel, source in table.channels.items():
        out[channel] = _values(raw, source, table.missing, path)
    if table.geodetic is not None:
        g = table.geodetic
        for column, name in ((g.latitude, LATITUDE), (g.longitude, LONGITUDE)):
            out[name] = _numbers(pd.Series(raw[column]), (*table.missing, *g.missing), path, column)
    if table.group:
        out[GROUP] = (raw[table.group] != raw[table.group].shift()).cumsum().to_numpy()
    return pd.DataFrame(out)


def _values(raw: pd.DataFrame, source: Source, missing: tuple[float, ...], path: Path) -> np.ndarray:
    total = np.full(len(raw), source.offset)
    for term in source.terms:
        total = total + term.scale * _numbers(pd.Series(raw[term.field]), (*missing, *source.missing), path, term.field)
    return total


def _numbers(cells: pd.Series, missing: tuple[float, ...], path: Path, column: str) -> np.ndarray:
    if cells.dtype.kind in "fiub":
        values = np.asarray(cells, float)
        wrong = np.zeros(len(values), bool)
    else:  # whole numbers of hundreds of digits are objects, which only as text become infinite
        text = cells.astype(str).str.strip()
        values = np.asarray(pd.to_numeric(text, errors="coerce"), float)
        wrong = ~np.isfinite(values) & ~text.str.lower().isin(GAPS).to_numpy(bool)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise bad_input(
            path,
            f"{column}, row {row}",
            str(cells.iloc[row]),
            "is neither a number nor a gap",
            remedy_of_text(str(cells.iloc[row]))
            or "correct the cell, or state separator, decimal and skip_rows in the map",
        )
    values = np.where(np.isfinite(values), values, np.nan)
    return np.where(np.isin(values, missing), np.nan, values) if missing else values


def _groups(parts: Mapping[str, tuple[str, pd.DataFrame]]) -> Iterator[tuple[str, dict[str, pd.DataFrame]]]:
    """Tables by the number of their group; without groups all rows have the key ""."""
    frames = {name: frame for name, (_, frame) in parts.items()}
    if not any(GROUP in f for f in frames.values()):
        yield "", frames
        return
    count = max(int(np.max(f[GROUP])) for f in frames.values())
    for key in range(1, count + 1):
        part = {n: f.loc[f[GROUP] == key].drop(columns=GROUP).reset_index(drop=True) for n, f in frames.items()}
        yield f"{key:0{len(str(count))}d}", {n: f for n, f in part.items() if len(f)}


def _from_zero(tables: Mapping[str, pd.DataFrame], own: Mapping[str, bool]) -> dict[str, pd.DataFrame]:
    """Tables whose time counts from the first sample of the drive, or each from its own where `own` says so."""
    shared = [float(np.min(f[TIME])) for n, f in tables.items() if not own[n]]
    begin = min(shared) if shared else 0.0
    return {
        # Nanoseconds: what a difference of large times leaves behind is no time.
        n: f.assign(**{TIME: np.round(f[TIME] - (float(np.min(f[TIME])) if own[n] else begin), 9)})
        for n, f in tables.items()
    }
