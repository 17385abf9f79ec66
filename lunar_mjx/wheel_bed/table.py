"""Steady-state tables of single-wheel test beds: reading, averaging replicates, and the scatter between them."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.errors import UserError, bad_input, one_line, require_file, require_finite
from lunar_mjx.wheel_bed.bed import SLIP_DEFINITIONS, SPEED, WheelTest, wheel_test

QUANTITIES: Mapping[str, tuple[str, str, str]] = {
    "drawbar_pull": ("drawbar_pull_N", "N", "drawbar pull"),
    "side_force": ("side_force_N", "N", "side force"),
    "driving_torque": ("driving_torque_Nm", "N m", "driving torque"),
    "sinkage": ("sinkage_m", "m", "sinkage"),
}
"""What a test bed measures: quantity -> column, unit, name."""

_REQUIRED = ("slip_ratio", "slip_angle_deg", "normal_load_N")
_SPEEDS = ("rim_speed_m_s", "travel_speed_m_s")
_COLUMNS = (*_REQUIRED, *_SPEEDS, *(column for column, _, _ in QUANTITIES.values()), "trial")


@dataclasses.dataclass(frozen=True, eq=False)
class SteadyStateTable:
    """A steady-state table: what was imposed and what was measured, one entry per point.

    Attributes:
      name: for messages and reports.
      test: slip ratio, slip angle deg, normal load N and, where given, speeds m/s, by column.
      measured: by quantity of `QUANTITIES`, in SI units; those that the table has.
      replicates: number of runs behind each point.
      sigma: scatter of one run about its point by quantity, pooled over the replicates; empty if there are none.
      radius, width: of the wheel, m.
      slip_definition: what the slip ratio compares the rim speed with.
      source: who measured it, licence and citation, as the table's description says.
    """

    name: str
    test: Mapping[str, np.ndarray]
    measured: Mapping[str, np.ndarray]
    replicates: np.ndarray
    sigma: Mapping[str, float]
    radius: float
    width: float
    slip_definition: str
    source: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.replicates)

    def select(self, keep: np.ndarray) -> SteadyStateTable:
        """The points where `keep` is true."""
        return dataclasses.replace(
            self,
            test={k: v[keep] for k, v in self.test.items()},
            measured={k: v[keep] for k, v in self.measured.items()},
            replicates=self.replicates[keep],
        )

    def at_angles(self, angles_deg: tuple[float, ...]) -> SteadyStateTable:
        """The points at these slip angles, deg."""
        return self.select(at_angles(self.test["slip_angle_deg"], angles_deg))

    def wheel_test(self) -> WheelTest:
        """What a `WheelBed` has to impose to repeat the table.

        Where both speeds are given they are used as they are, in proportion; slip then needs no definition.
        """
        columns = self.test
        angle, load = np.radians(columns["slip_angle_deg"]), columns["normal_load_N"]
        if not all(speed in columns for speed in _SPEEDS):
            return wheel_test(columns["slip_ratio"], angle, load, self.radius, self.width, self.slip_definition)
        rim, travel = columns["rim_speed_m_s"], columns["travel_speed_m_s"]
        # Scaled to the bed's speed in proportion: slow tests would meet the floors that regularise standstill.
        scale = SPEED / np.maximum(rim, travel)
        radius, width = np.full(len(self), self.radius), np.full(len(self), self.width)
        return WheelTest(scale * rim, scale * travel, angle, load, radius, width)


def at_angles(slip_angle_deg: np.ndarray, wanted_deg: tuple[float, ...]) -> np.ndarray:
    """Which points lie at one of the wanted slip angles, to 0.01 deg."""
    near = np.abs(slip_angle_deg[:, None] - np.asarray(wanted_deg)[None, :]) < 0.01
    return np.any(near, axis=1)


def read_table(
    path: str | Path,
    radius: float,
    width: float,
    slip_definition: str,
    name: str | None = None,
    source: Mapping[str, str] | None = None,
) -> SteadyStateTable:
    """Reads a steady-state table from a CSV file, every row a run.

    Args:
      path: CSV with the columns slip_ratio, slip_angle_deg, normal_load_N, optionally rim_speed_m_s and
        travel_speed_m_s, and at least one of drawbar_pull_N, side_force_N, driving_torque_Nm, sinkage_m.
      radius, width: of the wheel, m.
      slip_definition: "wheel_frame" (eq. 8, v_x = V cos beta) or "travel_speed" (V).
      name: for reports; the file's name if None.
      source: who measured it, licence, citation.

    Raises:
      UserError: the file or a column is missing, a column's unit is not the one of the schema, a cell is not a finite
        number, a load is not positive, a slip ratio is outside [-1, 1], or a row occurs twice.
    """
    file = require_file(path, "the steady-state table")
    for field, value in (("radius", radius), ("width", width)):
        if require_finite(file, field, value) <= 0.0:
            raise bad_input(file, field, value, "is not positive", "give the wheel's dimension in m")
    if slip_definition not in SLIP_DEFINITIONS:
        raise bad_input(
            file, "slip_definition", slip_definition, "does not exist", f"use one of {', '.join(SLIP_DEFINITIONS)}"
        )
    try:
        frame = pd.read_csv(file)
    except (ValueError, UnicodeDecodeError) as error:
        raise UserError(
            f"{file}: is not a CSV table ({one_line(error)}); give comma-separated values with a header."
        ) from error
    _check_columns(file, frame)
    numbers = _numbers(file, frame)
    _check_values(file, numbers, slip_definition)
    measured = {q: numbers[c] for q, (c, _, _) in QUANTITIES.items() if c in numbers}
    test = {c: numbers[c] for c in (*_REQUIRED, *_SPEEDS) if c in numbers}
    return SteadyStateTable(
        name=name or file.stem,
        test=test,
        measured=measured,
        replicates=np.ones(len(frame), int),
        sigma={},
        radius=float(radius),
        width=float(width),
        slip_definition=slip_definition,
        source=dict(source or {}),
    )


def _check_columns(file: Path, frame: pd.DataFrame) -> None:
    if frame.empty:
        raise UserError(f"{file}: holds no rows; give one row per run.")
    # Two columns of one name reach us as "name" and "name.1".
    twice = [c for c in frame if re.fullmatch(r"(.+)\.\d+", str(c)) and str(c).rsplit(".", 1)[0] in frame]
    if twice:
        raise bad_input(file, "column", str(twice[0]).rsplit(".", 1)[0], "occurs twice", "keep one of them")
    # Units stand in names: `sinkage_mm` is no unknown column to be passed over but a wrong unit to be told.
    stems = {re.sub(r"_(N|Nm|m|deg|m_s)$", "", column): column for column in _COLUMNS}
    for column in map(str, frame.columns):
        for stem, wanted in stems.items():
            suffix = column.removeprefix(stem + "_")
            if column not in _COLUMNS and (
                column == stem or (suffix != column and "std" not in suffix and "_" not in suffix)
            ):
                raise bad_input(
                    file, "column", column, "does not have the unit of the schema", f"convert it and call it {wanted}"
                )
    for column in _REQUIRED:
        if column not in frame:
            raise UserError(f"{file}: the column {column} is missing; the table needs {', '.join(_REQUIRED)}.")
    if not any(column in frame for column, _, _ in QUANTITIES.values()):
        wanted = ", ".join(column for column, _, _ in QUANTITIES.values())
        raise UserError(f"{file}: nothing measured is in the table; give at least one of {wanted}.")


def _numbers(file: Path, frame: pd.DataFrame) -> dict[str, np.ndarray]:
    """The known columns as finite numbers; errors name the line of the file."""
    numbers = {}
    for column in (c for c in _COLUMNS if c in frame):
        values = np.asarray(pd.to_numeric(frame[column], errors="coerce"), float)
        bad = ~np.isfinite(values)
        if bad.any():
            # The first: whoever mends a table goes from top to bottom.
            row = int(np.argmax(bad))
            raise bad_input(
                file,
                f"line {row + 2}, {column}",
                frame[column].to_list()[row],
                "is not a finite number",
                "correct the cell or leave the row out",
            )
        numbers[column] = values
    return numbers


def _check_values(file: Path, numbers: Mapping[str, np.ndarray], slip_definition: str) -> None:
    def refuse(bad: np.ndarray, column: str, problem: str, remedy: str) -> None:
        if bad.any():
            row = int(np.argmax(bad))
            raise bad_input(file, f"line {row + 2}, {column}", float(numbers[column][row]), problem, remedy)

    refuse(numbers["normal_load_N"] <= 0.0, "normal_load_N", "is not positive", "give the load on the wheel in N")
    refuse(np.abs(numbers["slip_ratio"]) > 1.0, "slip_ratio", "is outside [-1, 1]", "give slip as a ratio")
    refuse(np.abs(numbers["slip_angle_deg"]) > 90.0, "slip_angle_deg", "is beyond 90 deg", "give it in degrees")
    speeds = [c for c in _SPEEDS if c in numbers]
    for column in speeds:
        refuse(numbers[column] < 0.0, column, "is negative", "give the magnitude in m/s")
    # With one speed alone the other follows from the slip ratio, whose definition then counts.
    if len(speeds) == 2:
        still = np.maximum(numbers[speeds[0]], numbers[speeds[1]]) <= 0.0
        refuse(still, speeds[0], "is zero, and so is the travel speed", "drop the row")
    elif slip_definition == "wheel_frame":
        refuse(
            np.abs(numbers["slip_angle_deg"]) > 89.9,
            "slip_angle_deg",
            "has no slip in the wheel's frame",
            "give both speeds, or slip by travel speed",
        )
    rows = np.column_stack(list(numbers.values()))
    first = np.unique(rows, axis=0, return_index=True)[1]
    # To the last digit in every column: instruments do not repeat themselves, spreadsheets do.
    copied = ~np.isin(np.arange(len(rows)), first)
    refuse(copied, "slip_ratio", "begins a row that occurs twice", "remove the copy")


SAME_LOAD = 0.25
"""Loads of one point lie within this share of each other; the replicates of the measured wheel spread by a fifth."""


def replicate_groups(table: SteadyStateTable) -> np.ndarray:
    """Which point each run belongs to: same slip angle, same rim and travel speed (slip ratio to 0.01 where one of the
    speeds is not given), same load. Whatever was imposed and differs separates runs.

    Measured loads count as the same where no gap of more than 25 % lies between them, planned ones where equal.

    Returns:
      Group number of each row, counted by rising slip angle, then speeds or slip, then load.
    """
    # Rounded, since planned values have been through a spreadsheet's arithmetic.
    keys = [np.round(table.test["slip_angle_deg"], 2)]
    keys += [np.round(table.test[c], 4) for c in _SPEEDS if c in table.test]
    if not all(c in table.test for c in _SPEEDS):
        keys.append(np.round(table.test["slip_ratio"], 2))
    if _planned(table.test["normal_load_N"]):
        keys.append(table.test["normal_load_N"])
    first = np.unique(np.column_stack(keys), axis=0, return_inverse=True)[1].reshape(-1)
    level = np.zeros(len(first), int)
    load = table.test["normal_load_N"]
    for group in np.unique(first):
        rows = np.flatnonzero(first == group)
        # Gaps between sorted loads divide groups: readings of one load scatter without gaps.
        order = rows[np.argsort(load[rows], kind="stable")]
        level[order[1:]] = np.cumsum(np.diff(load[order]) > SAME_LOAD * load[order[:-1]])
    return np.unique(np.column_stack([first, level]), axis=0, return_inverse=True)[1].reshape(-1)


def _planned(values: np.ndarray) -> bool:
    """Whether values are settings of a plan, which repeat, and not readings, which hardly do."""
    # A plan repeats each setting at least three times or so; readings to many digits hardly repeat.
    return len(np.unique(values)) <= max(len(values) // 3, 1)


def average(table: SteadyStateTable) -> SteadyStateTable:
    """Averages replicates and pools their scatter.

    Args:
      table: one row per run.

    Returns:
      One row per point, sorted by slip angle and slip; `sigma` is the pooled standard deviation of single runs.
    """
    group = replicate_groups(table)
    count = np.bincount(group)

    def mean(values: np.ndarray) -> np.ndarray:
        return np.bincount(group, weights=values) / count

    measured = {q: mean(v) for q, v in table.measured.items()}
    # One mean is taken from each point.
    freedom = len(table) - len(count)
    sigma = {}
    # Points of one run each tell nothing of their scatter: no number is better than a made-up one.
    if freedom > 0:
        for q, values in table.measured.items():
            sigma[q] = float(np.sqrt(np.sum((values - measured[q][group]) ** 2) / freedom))
    test = {k: mean(v) for k, v in table.test.items()}
    runs = np.bincount(group, weights=table.replicates).astype(int)
    return dataclasses.replace(table, test=test, measured=measured, replicates=runs, sigma=sigma)
