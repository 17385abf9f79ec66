"""Reads a steady-state log: `kind = "steady_state"`, one row per run of a single-wheel test bed."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from lunar_mjx.errors import UserError, bad_input, require_name, require_within
from lunar_mjx.logs.findings import WARNING, Finding
from lunar_mjx.logs.log import Noise, SteadyLog
from lunar_mjx.logs.readers.table import cut_row, numbers, read_frame
from lunar_mjx.logs.schema import GREATEST_GRAVITY, SPLITS, STEADY_CHANNELS, conversion
from lunar_mjx.toml_fields import Fields
from lunar_mjx.wheel_bed.bed import SLIP_DEFINITIONS
from lunar_mjx.wheel_bed.table import QUANTITIES, SteadyStateTable

TOP = (
    "format",
    "kind",
    "file",
    "tables",
    "wheel",
    "slip_definition",
    "noise",
    "split",
    "gravity_m_s2",
    "source",
    "manoeuvre",
    "commitment",
)
REQUIRED = ("slip_ratio", "slip_angle_deg", "normal_load_N")


@dataclasses.dataclass(frozen=True)
class BedLimits:
    """Sizes that no wheel on a test bed exceeds."""

    largest_wheel: float = 5.0
    """m: the radius or width of no wheel on a test bed; what is larger is in another unit."""
    most_grousers: int = 1000
    """Grousers around a wheel; real ones have some dozens."""


BED_LIMITS = BedLimits()


WHEEL = ("radius_m", "width_m", "grouser_count", "grouser_height_m")
_SUFFIX = re.compile(r"_(ratio|deg|N|m_s|Nm|m)$")


def read_steady(folder: Path, top: Fields, read_noise: Callable[[Fields], dict[str, Noise]]) -> SteadyLog:
    """Reads a steady-state log.

    Raises:
      UserError: a file, key or column is missing or of the wrong kind; data that are merely wrong go to `problems`.
    """
    top.known(TOP)
    name = folder.resolve().name
    path = folder / require_name(top.path, "file", _file(top), "name the file of the table")
    wheel = top.table("wheel")
    wheel.known(WHEEL)
    size = {key: wheel.positive(key, most=BED_LIMITS.largest_wheel) for key in WHEEL[:2]}
    size |= {key: wheel.number(key, 0.0) for key in WHEEL[2:]}
    for key, high in (("grouser_count", BED_LIMITS.most_grousers), ("grouser_height_m", size["radius_m"])):
        require_within(top.path, wheel.field(key), size[key], 0.0, high)
    if size["grouser_count"] % 1.0:
        raise bad_input(
            top.path, wheel.field("grouser_count"), size["grouser_count"], "is no whole number", "count the grousers"
        )
    definition = top.choice("slip_definition", tuple(SLIP_DEFINITIONS))
    if definition is None:
        raise bad_input(top.path, "slip_definition", None, "is missing", f"use one of {', '.join(SLIP_DEFINITIONS)}")
    problems: list[Finding] = []
    columns, row_std = _columns(path, name, problems)
    count = len(next(iter(columns.values())))
    # Bad rows are left out and told; a table of hundreds of runs survives some.
    keep = _usable(name, path.stem, columns, problems)
    noise = read_noise(top.table("noise"))
    measured = {q: columns[c][keep] for q, (c, _, _) in QUANTITIES.items() if c in columns}
    source = {k: str(v) for k, v in top.table("source").values.items()}
    imposed = (*REQUIRED, "rim_speed_m_s", "travel_speed_m_s")
    table = SteadyStateTable(
        name=name,
        test={c: columns[c][keep] for c in imposed if c in columns},
        measured=measured,
        replicates=np.ones(int(keep.sum()), int),
        sigma={q: noise[QUANTITIES[q][0]].std for q in measured if QUANTITIES[q][0] in noise},
        radius=size["radius_m"],
        width=size["width_m"],
        slip_definition=definition,
        source=source,
    )
    return SteadyLog(
        folder=folder,
        name=name,
        table=table,
        wheel=size,
        noise=noise,
        split=top.choice("split", SPLITS),
        gravity_m_s2=top.positive("gravity_m_s2", 9.81, GREATEST_GRAVITY),
        source=source,
        row_std={c: v[keep] for c, v in row_std.items()},
        # Rows of the file, so that findings name lines which the user can find.
        rows=np.arange(count)[keep],
        trial=columns["trial"][keep] if "trial" in columns else None,
        problems=tuple(problems),
    )


def _file(top: Fields) -> str:
    """The file of the table: `file`, or the one table of `[tables]`."""
    tables = top.table("tables")
    if not tables.values:
        return top.text("file")
    if len(tables.values) > 1:
        raise bad_input(
            top.path, "tables", ", ".join(tables.values), "are several", "give one table per steady-state log"
        )
    entry = tables.table(next(iter(tables.values)))
    entry.known(("file",))
    return entry.text("file")


def _columns(path: Path, log: str, problems: list[Finding]) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Columns of the schema and their stated standard deviations, in the schema's units."""
    frame = read_frame(path, "the steady-state table")
    if cut := cut_row(path, frame):
        problems.append(Finding(log, path.stem, cut[0], "", "short", cut[1], WARNING))
        frame = frame.iloc[:-1]
    if frame.empty:
        raise UserError(f"{path}: holds no rows; give one row per run.")
    columns: dict[str, np.ndarray] = {}
    row_std: dict[str, np.ndarray] = {}
    bad_units = set()
    for column in map(str, frame.columns):
        found = _steady_column(column.strip(), str(path))
        if found is None:
            problems.append(
                Finding(
                    log,
                    path.stem,
                    None,
                    column,
                    "unknown",
                    "is no column of a steady-state table and is ignored",
                    WARNING,
                )
            )
            continue
        name, is_std, scale, offset, problem = found
        if problem:
            problems.append(Finding(log, path.stem, None, column, "unit", problem))
            bad_units.add(name)
            continue
        into = row_std if is_std else columns
        if name in into:
            raise bad_input(path, "column", column, f"is {name} once more", "keep one of them")
        values, wrong = numbers(frame, column)
        if wrong is not None:
            shown = str(frame[column].iloc[wrong])[:40]
            problems.append(
                Finding(
                    log,
                    path.stem,
                    wrong,
                    column,
                    "number",
                    f"holds {shown!r}, which is neither a number nor a gap; correct the cell",
                )
            )
        # A deviation scales, but has no offset and no sign.
        into[name] = np.abs(scale) * values if is_std else scale * values + offset
    for name in REQUIRED:
        if name not in columns and name not in bad_units:
            raise UserError(f"{path}: the column {name} is missing; the table needs {', '.join(REQUIRED)}.")
        columns.setdefault(name, np.full(len(frame), np.nan))
    if not any(c in columns or c in bad_units for c, _, _ in QUANTITIES.values()):
        wanted = ", ".join(c for c, _, _ in QUANTITIES.values())
        raise UserError(f"{path}: nothing measured is in the table; give at least one of {wanted}.")
    return columns, row_std


def _steady_column(column: str, source: str) -> tuple[str, bool, float, float, str] | None:
    """Name, whether it is a standard deviation, scale, offset and problem of a column."""
    for name in sorted(STEADY_CHANNELS, key=len, reverse=True):  # slip_angle before slip
        unit = STEADY_CHANNELS[name][0]
        stem = _SUFFIX.sub("", name)
        suffix = name.removeprefix(stem).removeprefix("_")
        match = re.fullmatch(rf"{stem}(?P<std>(?:_[a-z]+)*_std)?(?:_(?P<unit>\w+))?", column)
        if match is None:
            continue
        given = match["unit"] or ""
        if given == suffix or (suffix == "ratio" and match["std"] and not given):
            return name, bool(match["std"]), 1.0, 0.0, ""
        if not given:
            return name, bool(match["std"]), 1.0, 0.0, f"does not say its unit; call it {name} if it is in {unit}"
        scale, offset, problem = conversion(given, unit, source, column)
        return name, bool(match["std"]), scale, offset, problem and f"{problem}; give {name}"
    return None


def _usable(log: str, table: str, columns: Mapping[str, np.ndarray], problems: list[Finding]) -> np.ndarray:
    """Rows that a wheel test can repeat; the first of each kind that cannot becomes a problem."""
    load, slip, angle = (columns[c] for c in ("normal_load_N", "slip_ratio", "slip_angle_deg"))
    rules = [
        ("normal_load_N", load <= 0.0, "range", "is not positive; give the load on the wheel, upward on it, in N"),
        ("slip_ratio", np.abs(slip) > 1.0 + 1e-6, "range", "is outside [-1, 1]; give slip as a ratio, not in percent"),
        ("slip_angle_deg", np.abs(angle) > 90.0, "range", "is beyond 90 deg; give the slip angle in degrees"),
    ]
    rules += [
        (
            c,
            ~np.isfinite(columns[c]),
            "gap",
            "is empty, but a run cannot be repeated without it; leave the row out or fill it in",
        )
        for c in REQUIRED
        if np.isfinite(columns[c]).any()
    ]
    for c in ("rim_speed_m_s", "travel_speed_m_s"):
        if c in columns:
            rules.append((c, columns[c] < 0.0, "range", "is negative; give the magnitude in m/s"))
    keep = np.ones(len(load), bool)
    for column, bad, kind, text in rules:
        if bad.any():
            row = int(np.argmax(bad))
            shown = "" if kind == "gap" else f"{columns[column][row]:g} "
            problems.append(Finding(log, table, row, column, kind, shown + text))
        keep &= ~bad
    for column in REQUIRED:
        keep &= np.isfinite(columns[column])
    for column in (c for c, _, _ in QUANTITIES.values() if c in columns):
        gaps = keep & ~np.isfinite(columns[column])
        if gaps.any():
            problems.append(
                Finding(
                    log,
                    table,
                    int(np.argmax(gaps)),
                    column,
                    "gap",
                    f"is empty in {int(gaps.sum())} rows, which are left out",
                    WARNING,
                )
            )
            keep &= ~gaps
    return keep
