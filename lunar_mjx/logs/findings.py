"""What is wrong with a log: where, and why."""

from __future__ import annotations

import dataclasses
from typing import Any

BAD_DATA = "bad_data"
WARNING = "warning"


@dataclasses.dataclass(frozen=True)
class Finding:
    """One thing that is wrong with a log.

    Attributes:
      log: name of the log. table: name of the table, or "" for the whole log.
      row: row of the table counted from 0, or None where the whole column is meant.
      column: as the file calls it, or "".
      kind: such as "clock", "unit", "swap", "stuck", "noise".
      message: one sentence with the numbers that show it, and the remedy.
      severity: BAD_DATA makes the log unusable; WARNING does not.
    """

    log: str
    table: str
    row: int | None
    column: str
    kind: str
    message: str
    severity: str = BAD_DATA

    @property
    def line(self) -> int | None:
        """Line of a CSV file, whose header is line 1."""
        # Rows count from 0, lines from 1, and line 1 is the header.
        return None if self.row is None else self.row + 2

    @property
    def where(self) -> str:
        """Place of the finding in a few words: log, table, line and column."""
        place = self.log + (f"/{self.table}" if self.table else "")
        line = "" if self.row is None else f", line {self.line}"
        return place + line + (f", {self.column}" if self.column else "")

    def to_dict(self) -> dict[str, Any]:
        """Names and numbers, ready for JSON."""
        return {**dataclasses.asdict(self), "line": self.line}


def is_bad(findings: list[Finding]) -> bool:
    """Whether any finding makes its log unusable."""
    return any(f.severity == BAD_DATA for f in findings)
