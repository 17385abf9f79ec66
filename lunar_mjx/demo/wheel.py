"""The wheel against the test bed: the presets as they are, and with their soil refitted."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from lunar_mjx.criticism import Comparison, SteadyStateTable, WheelBed, WheelFit, fit, load_figures
from lunar_mjx.wheel_bed.bed import wheel_test
from lunar_mjx.wheel_bed.comparison import compare
from lunar_mjx.wheel_bed.soil_fit import PAPER_CONTACT, SOIL, SOIL_FIT


class Case(NamedTuple):
    """One line of the comparison: a wheel model, and the fit that made it, if any."""

    name: str
    soil: str
    comparison: Comparison
    fit: WheelFit | None

    def scores(self) -> dict[str, float]:
        """Root mean square error in sigma at the fitted, the held-out and the set-apart slip angles."""
        c = self.comparison
        return {
            "fitted angles": c.score(SOIL_FIT.fit_angles),
            "held out, inside": c.score(SOIL_FIT.inside_angles),
            "held out, beyond": c.score(SOIL_FIT.beyond_angles),
            "set apart": c.score(SOIL_FIT.apart_angles),
        }

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        fitted = None if self.fit is None else self.fit.to_dict()
        return {
            "name": self.name,
            "soil": self.soil,
            "scores_sigma": self.scores(),
            "fit": fitted,
            "comparison": self.comparison.to_dict(),
        }


_CURVE_POINTS = 61
"""Slips of a curve, from -1 to 0.92: 0.032 apart (a choice)."""

PAPER_SOIL = "nominal: the paper's release"
LUNAR_SOIL = "nominal: Lunar Sourcebook"
REFITTED = f"refitted at {', '.join(f'{a:g}' for a in SOIL_FIT.fit_angles)} deg"


def wheel_cases(starts: int = 8, seed: int = 0, progress: Callable[[float], None] | None = None) -> list[Case]:
    """Compares and refits both presets.

    Args:
      starts: of every fit. seed: of the fits.
      progress: called with the share done.

    Returns:
      paper, consistent, paper refitted with its contact, consistent refitted.
    """
    table = load_figures()
    beds = {name: WheelBed.of_preset(name) for name in ("paper", "consistent")}
    tell = progress or (lambda done: None)
    cases = []
    for i, (name, soil) in enumerate((("paper", PAPER_SOIL), ("consistent", LUNAR_SOIL))):
        cases.append(Case(name, soil, compare(beds[name], table, name), None))
        tell(0.1 * (i + 1))
    # The paper's wheel also stands on a spring of contact, which no parameter of its soil moves.
    for i, (name, free) in enumerate((("paper", SOIL + PAPER_CONTACT), ("consistent", SOIL))):
        fitted = fit(
            beds[name],
            table,
            free,
            f"{name}, refitted",
            starts,
            seed,
            lambda done, i=i: tell(0.2 + 0.4 * (i + done / starts)),
        )
        freed = "soil and contact" if len(free) > len(SOIL) else "soil"
        cases.append(Case(fitted.name, f"{freed} {REFITTED}", fitted.comparison, fitted))
    return cases


def dense_curves(bed: WheelBed, table: SteadyStateTable, angles_deg: Sequence[float]) -> dict[str, np.ndarray]:
    """A model's curves over slip, (angle, slip), at loads interpolated between the measured points of each angle.

    Returns:
      slip_ratio (slip,) by travel speed; drawbar_pull N, side_force N, sinkage m, each (angle, slip).
    """
    slip = np.linspace(-1.0, 0.92, _CURVE_POINTS)
    # Measured loads differ from point to point: a curve at one load would pass beside them.
    loads = []
    for angle in angles_deg:
        of_angle = table.at_angles((angle,)).test
        loads.append(np.interp(slip, of_angle["slip_ratio"], of_angle["normal_load_N"]))
    # As the fit itself ran: curves and scores then agree.
    with jax.enable_x64(True):
        angles = np.radians(np.asarray(angles_deg))[:, None]
        test = wheel_test(slip[None, :], angles, np.stack(loads), table.radius, table.width, "travel_speed")
    result = bed.run(test)
    return {"slip_ratio": slip, **{q: np.asarray(getattr(result, q)) for q in table.measured}}
