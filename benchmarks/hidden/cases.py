"""Draws the cases on a test bed: what is hidden, how the log is spoilt, and how the log is sabotaged."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from .bed import effects as bed_effects
from .bed import logs as bed_logs
from .bed.logs import QUANTITIES, Truth
from .noise import NOISES, Recipe
from .separable import SEPARABLE, left_over, nearest

GROUPS: Mapping[str, int] = {
    "nulls": 400,
    "singles": 300,
    "singles_x5": 100,
    "pairs": 100,
    "triples": 30,
    "outside": 100,
    "undecidable": 50,
    "sabotaged": 20,
    "dirt": 60,
}
"""Groups of cases, nulls first, with their number in the whole benchmark."""
ABSORBED = 2.5
"""Length in sigma below which what a refit leaves of an effect cannot be told from noise."""
DIRT = (0.0, 0.1, 0.3, 1.0, 3.0, 10.0)
"""Sizes of the unmodelled disturbance in its sweep, in sigma of one sample."""
_TRIES = 60
_NARROW = (
    ((0.0,), 3, QUANTITIES),
    ((0.0,), 1, ("drawbar_pull_N", "sinkage_m")),
    ((0.0, 15.0, 30.0), 1, ("drawbar_pull_N", "side_force_N", "sinkage_m")),
    ((0.0, 15.0, 30.0), 1, ("drawbar_pull_N", "side_force_N", "driving_torque_Nm")),
)
"""Poor test plans: slip angles deg, loads, channels."""

Rng = np.random.Generator


@dataclasses.dataclass(frozen=True, eq=False)
class Case:
    """A case and its answer.

    Attributes:
      group, number: which. truth: bed and hidden effects. recipe: of the noise. frame: the table as written.
      sabotage: what was done to the log, or "". separable: sigma that a refit of the soil leaves of what is hidden.
      nonce: 256 random bits in hexadecimal.
    """

    group: str
    number: int
    truth: Truth
    recipe: Recipe
    frame: pd.DataFrame
    sabotage: str
    separable: float
    nonce: str

    @property
    def name(self) -> str:
        """Group and number."""
        return f"{self.group}-{self.number:03d}"

    def answer(self) -> dict[str, Any]:
        """What is hidden, as plain data."""
        return {
            "case": self.name,
            "nonce": self.nonce,
            "effects": self.truth.effects,
            "sabotage": self.sabotage,
            "soil": dataclasses.asdict(self.truth.soil),
            "law": self.truth.law,
            "recipe": dataclasses.asdict(self.recipe),
        }

    def commitment(self) -> str:
        """SHA-256 of the answer, which the log carries."""
        text = json.dumps(self.answer(), sort_keys=True, separators=(",", ":"))
        return "sha256:" + hashlib.sha256(text.encode()).hexdigest()

    def write(self, folder: Path) -> None:
        """Writes the log folder, without the answer."""
        bed_logs.write(folder, self.frame, self.truth, self.recipe, self.commitment())
        if self.sabotage:
            sabotaged = SABOTAGE[self.sabotage]
            path = folder / "points.csv"
            sabotaged(pd.read_csv(path), self.truth, folder).to_csv(path, index=False, float_format="%.9g")


def make(group: str, number: int, seed: int) -> Case:
    """One case, the same for the same campaign seed."""
    rng = np.random.default_rng([seed % 2**63, list(GROUPS).index(group), number])
    truth, recipe, separable, sabotage = _DRAW[group](rng, number)
    frame = bed_logs.record(truth, recipe, rng)
    return Case(group, number, truth, recipe, frame, sabotage, separable, rng.bytes(32).hex())


def _noise(number: int, **changes: float) -> Recipe:
    return Recipe(NOISES[number % len(NOISES)], **changes)


def _hiding(rng: Rng, names: tuple[str, ...]) -> tuple[Truth, float]:
    """A truth whose hidden effects all leave a separable signal, each given the others."""
    for _ in range(_TRIES):
        truth = bed_logs.draw(rng, names, bed_logs.grid(rng))
        left = min(left_over(truth, [m for m in names if m != n]) for n in names)
        if left >= SEPARABLE:
            return truth, left
    raise RuntimeError(f"no draw of {', '.join(names)} can be separated by a table")


def _null(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
    return bed_logs.draw(rng, (), bed_logs.grid(rng)), _noise(number), 0.0, ""


def _single(rng: Rng, number: int, scale: float = 1.0) -> tuple[Truth, Recipe, float, str]:
    kinds = list(bed_effects.KNOWN)
    truth, left = _hiding(rng, (kinds[number % len(kinds)],))
    return truth, _noise(number // len(kinds), scale=scale), left, ""


def _several(many: int) -> Callable[[Rng, int], tuple[Truth, Recipe, float, str]]:
    def draw(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
        kinds = list(bed_effects.KNOWN)
        for _ in range(_TRIES):
            names = tuple(sorted(str(n) for n in rng.choice(kinds, many, replace=False)))
            try:
                truth, left = _hiding(rng, names)
            except RuntimeError:
                continue  # no soil carries the wheel with these, or they are twins
            return truth, _noise(number), left, ""
        raise RuntimeError(f"no {many} effects can be separated by a table")

    return draw


def _outside(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
    """An effect that neither a refit of the soil nor any one effect of the catalogue imitates."""
    kinds = list(bed_effects.OUTSIDE)
    for k in range(len(kinds)):
        for _ in range(6):
            truth = bed_logs.draw(rng, (kinds[(number + k) % len(kinds)],), bed_logs.grid(rng))
            left = left_over(truth, [])
            left = min(left, nearest(truth)[1]) if left >= SEPARABLE else left
            if left >= SEPARABLE:
                return truth, _noise(number), left, ""
        # a refit of the soil, or an effect of the catalogue, imitates this kind
    raise RuntimeError("no effect outside the catalogue can be separated by a table")


def _undecidable(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
    """A poor plan on which a refit of the soil absorbs the hidden effect."""
    angles, loads, channels = _NARROW[number % len(_NARROW)]
    for _ in range(20 * _TRIES):
        name = str(rng.choice(list(bed_effects.KNOWN)))
        points = bed_logs.grid(rng, angles, loads)
        try:
            truth = bed_logs.draw(rng, (name,), points, channels=channels)
        except RuntimeError:
            continue
        left = left_over(truth, [])
        if left <= ABSORBED:
            return truth, _noise(number), left, ""
    raise RuntimeError("every effect can be separated by these plans")


def _sabotaged(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
    kinds = list(SABOTAGE)
    hidden = () if number % 2 else (str(rng.choice(list(bed_effects.KNOWN))),)
    truth = bed_logs.draw(rng, hidden, bed_logs.grid(rng))
    return truth, Recipe(), 0.0, kinds[number % len(kinds)]


def _dirty(rng: Rng, number: int) -> tuple[Truth, Recipe, float, str]:
    """Nulls and singles by turns, at every size of the disturbance."""
    size = DIRT[(number // 2) % len(DIRT)]
    if number % 2 == 0:
        return bed_logs.draw(rng, (), bed_logs.grid(rng)), Recipe(dirt=size), 0.0, ""
    kinds = list(bed_effects.KNOWN)
    truth, left = _hiding(rng, (kinds[(number // 2 // len(DIRT)) % len(kinds)],))
    return truth, Recipe(dirt=size), left, ""


_DRAW: Mapping[str, Callable[[Rng, int], tuple[Truth, Recipe, float, str]]] = {
    "nulls": _null,
    "singles": _single,
    "singles_x5": lambda g, n: _single(g, n, 5.0),
    "pairs": _several(2),
    "triples": _several(3),
    "outside": _outside,
    "undecidable": _undecidable,
    "sabotaged": _sabotaged,
    "dirt": _dirty,
}


# --- sabotage: what goes wrong between a bed and a file -------------------------------------------------------------

Change = Callable[[pd.DataFrame, Truth, Path], pd.DataFrame]


def _times(**factors: float) -> Change:
    return lambda frame, truth, folder: frame.assign(**{k: frame[k] * v for k, v in factors.items()})


def _swapped(a: str, b: str) -> Change:
    return lambda frame, truth, folder: frame.assign(**{a: frame[b], b: frame[a]})


def _stated(factor: float) -> Change:
    """The noise that `log.toml` states, a factor off."""

    def change(frame: pd.DataFrame, truth: Truth, folder: Path) -> pd.DataFrame:
        path = folder / "log.toml"
        lines = []
        for line in path.read_text(encoding="utf-8").splitlines():
            key, _, value = line.partition("=")
            lines.append(f"std = {float(value) * factor!r}" if key.strip() == "std" else line)
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return frame

    return change


def _copied(frame: pd.DataFrame, truth: Truth, folder: Path) -> pd.DataFrame:
    frame = frame.copy()
    frame.loc[frame.index[-20:], list(truth.channels)] = frame[list(truth.channels)].to_numpy()[:20]
    return frame


def _stuck(frame: pd.DataFrame, truth: Truth, folder: Path) -> pd.DataFrame:
    frame = frame.copy()
    half = len(frame) // 2
    frame.loc[frame.index[half:], "sinkage_m"] = frame["sinkage_m"].iloc[half]
    return frame


def _clipped(frame: pd.DataFrame, truth: Truth, folder: Path) -> pd.DataFrame:
    limit = float(np.quantile(frame["driving_torque_Nm"], 0.7))
    return frame.assign(driving_torque_Nm=frame["driving_torque_Nm"].clip(upper=limit))


SABOTAGE: Mapping[str, Change] = {
    "sinkage in mm": _times(sinkage_m=1e3),
    "drawbar and side force swapped": _swapped("drawbar_pull_N", "side_force_N"),
    "noise understated five times": _stated(0.2),
    "rows copied": _copied,
    "sign of slip": _times(slip_ratio=-1.0),
    "sinkage sensor stuck": _stuck,
    "torque clipped": _clipped,
    "drawbar pull in mN": _times(drawbar_pull_N=1e3),
    "noise overstated five times": _stated(5.0),
    "sinkage counts upwards": _times(sinkage_m=-1.0),
}
"""What was done to a log -> how."""
