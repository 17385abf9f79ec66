"""Writes the tables of docs/checked.md that benchmarks have measured.

python benchmarks/checked.py benchmarks/acceptance.json benchmarks/programs_gpu.json
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[1] / "docs" / "checked.md"

PROOFS = {
    "parked": "braked on 10° of soft soil, facing four ways: way from 10 s to 70 s",
    "energy": "dropped from 0.3 m: largest gain of energy with springs and soil, over the fall",
    "halving": "20 s with steering on a slope: the end moves, when the time step is halved, by this share of the way",
    "drives": "20 s in a hard and a soft crater, {engines}: largest error against native MuJoCo, in tolerances",
    "parity": "states ({states:,}) along drives on all grounds, structured engine and MJX: likewise",
}
"""What each proof of `benchmarks/acceptance.py` measures."""


def acceptance(record: Mapping[str, Any]) -> str:
    """The table of the acceptance proofs."""
    lines = [f"| `{record['about']['preset']}` | rover | measured | limit | at |", "|---|---|---|---|---|"]
    for row in record["rows"]:
        unit = {"1": "", "tolerances": ""}.get(row["unit"], f" {row['unit']}")
        value = "none found" if row["value"] is None else f"{row['value']:.3g}{unit}"
        limit = "-" if row["limit"] is None else f"{row['limit']:g}{unit}"
        missed = " (missed)" if row["passed"] is False else ""
        text = PROOFS[row["proof"]].format(**row | {"engines": " and ".join(row.get("engines", ()))})
        lines.append(f"| {text} | {row['rover']} | {value}{missed} | {limit} | {row['commit']} |")
    return "\n".join(lines)


def programs(record: Mapping[str, Any]) -> str:
    """The table of the rates: a row for each program, a column for each rover and number of rovers."""
    about, rows = record["about"], record["rows"]
    columns = sorted({(r["rover"], r["batch"]) for r in rows})
    head = [f"{about['device']}, at {about['commit']}", *(f"{rover}, {batch:,}" for rover, batch in columns)]
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for name in dict.fromkeys(r["program"] for r in rows):
        cells = []
        for rover, batch in columns:
            found = [r for r in rows if (r["rover"], r["batch"], r["program"]) == (rover, batch, name)]
            cells.append(_rate(found[0]) if found else "")
        lines.append("| " + " | ".join([name, *cells]) + " |")
    return "\n".join(lines)


def _rate(row: Mapping[str, Any]) -> str:
    """Million steps per second, and what the gate said."""
    gate = {
        True: "",
        False: f" (not counted: gap {row['parity_gap']:.1e})" if row["parity_gap"] else "",
        None: " (no gate)",
    }
    broken = "" if row["finite"] else " (not finite in the end)"
    return f"{row['steps_per_s'] / 1e6:.1f}{gate[row['parity']]}{broken}"


TABLES = {"acceptance": acceptance, "programs": programs}
"""Tables by the beginning of the names of their files."""


def placed(page: str, name: str, table: str) -> str:
    """The page with the table between its two marks, `<!-- NAME: ... -->` and `<!-- end NAME -->`."""
    start = page.index("\n", page.index(f"<!-- {name}: ")) + 1
    return page[:start] + table + "\n\n" + page[page.index(f"<!-- end {name} -->") :]


def main(files: Sequence[str]) -> None:
    """Puts the tables of the given records into the page."""
    page = PAGE.read_text(encoding="utf-8")
    for file in files:
        name = Path(file).stem.split("_")[0]
        page = placed(page, name, TABLES[name](json.loads(Path(file).read_text(encoding="utf-8"))))
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
