"""Draws the figures of the docs that stand on kept records, each for light and for dark pages.

`python -m benchmarks.figures` draws all of them, `python -m benchmarks.figures backends real_wheel` some. The seed
paper's figures come from `lunar-mjx figures --dark`, those of a drive from `lunar-mjx plot --dark`.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RECORDS, FIGURES = ROOT / "benchmarks", ROOT / "docs" / "figures"
sys.path.insert(0, str(RECORDS))  # scripts import what lies beside them

REAL_DRIVES = ("real_cuadriga", "real_poses", "real_snow")
LEARNING = ("large_luvmi_x", "rates", "realism", "brax", "paper")


def _read(name: str) -> Any:
    return json.loads((RECORDS / f"{name}.json").read_text(encoding="utf-8"))


def _backends() -> None:
    from benchmarks import backends

    backends.plot(_read("backends_h200")["rows"], FIGURES / "backends.png")


def _hidden_effects() -> None:
    from benchmarks.hidden import summary

    summary.plot(_read("hidden_effects")["answers"], FIGURES / "hidden_effects.png")


def _real_wheel() -> None:
    from benchmarks import real_wheel

    real_wheel.draw(_read("real_wheel")["rows"])


def _real_drive(name: str) -> Callable[[], Any]:
    from benchmarks import real_drives

    return lambda: real_drives.picture(real_drives.kept_lines(name), FIGURES / f"{name}.png")


def _learning(name: str) -> Callable[[], Any]:
    script = RECORDS / "rl" / "figures.py"  # which imports what lies beside it
    command = [sys.executable, str(script), str(RECORDS / "rl" / f"{name}.json"), "--out", str(FIGURES)]
    return lambda: subprocess.run(command, check=True, stdout=subprocess.DEVNULL)


DRAWN: Mapping[str, Callable[[], Any]] = {
    "backends": _backends,
    "hidden_effects": _hidden_effects,
    "real_wheel": _real_wheel,
    **{name: _real_drive(name) for name in REAL_DRIVES},
    **{f"rl_{name}": _learning(name) for name in LEARNING},
}


def main() -> None:
    """Draws the named figures, or all."""
    names = sys.argv[1:] or list(DRAWN)
    unknown = [name for name in names if name not in DRAWN]
    if unknown:
        sys.exit(f"figures: {unknown[0]} does not exist; use some of {', '.join(DRAWN)}")
    for name in names:
        DRAWN[name]()
        print(name, flush=True)


if __name__ == "__main__":
    main()
