"""The wheel against the test bed: the presets as they are, and with their soil refitted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from lunar_mjx.criticism import Comparison, SteadyStateTable, WheelBed, WheelFit, compare, fit, load_figures
from lunar_mjx.criticism.fit import APART_ANGLES, BEYOND_ANGLES, FIT_ANGLES, INSIDE_ANGLES, PAPER_CONTACT, SOIL


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
            "fitted angles": c.score(FIT_ANGLES),
            "held out, inside": c.score(INSIDE_ANGLES),
            "held out, beyond": c.score(BEYOND_ANGLES),
            "set apart": c.score(APART_ANGLES),
        }

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        fitted = None if self.fit is None else self.fit.to_dict()
        return {"name": self.name, "soil": self.soil, "scores_sigma": self.scores(), "fit": fitted,
                "comparison": self.comparison.to_dict()}  # fmt: skip


PAPER_SOIL = "nominal: the paper's release"
LUNAR_SOIL = "nominal: Lunar Sourcebook"
REFITTED = f"refitted at {', '.join(f'{a:g}' for a in FIT_ANGLES)} deg"


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
    for i, (name, free) in enumerate((("paper", SOIL + PAPER_CONTACT), ("consistent", SOIL))):
        found = fit(beds[name], table, free, f"{name}, refitted", starts, seed,
                    lambda done, i=i: tell(0.2 + 0.4 * (i + done / starts)))  # fmt: skip
        what = "soil and contact" if len(free) > len(SOIL) else "soil"
        cases.append(Case(found.name, f"{what} {REFITTED}", found.comparison, found))
    return cases


def dense_curve(bed: WheelBed, table: SteadyStateTable, angle_deg: float, points: int = 61) -> dict[str, np.ndarray]:
    """A model's curve over slip at one slip angle, at the mean load of the measurements there.

    Returns:
      slip_ratio by travel speed, drawbar_pull N, side_force N, sinkage m.
    """
    import jax

    from lunar_mjx.criticism.single_wheel import wheel_test

    here = table.at_angles((angle_deg,))
    slip = np.linspace(-1.0, 0.92, points)
    # The load differs from point to point; between points it is interpolated, so that the curve meets each.
    load = np.interp(slip, here.test["slip_ratio"], here.test["normal_load_N"])
    with jax.enable_x64(True):
        test = wheel_test(slip, np.radians(angle_deg), load, table.radius, table.width, "travel_speed")
        result = jax.jit(bed.__call__)(bed.parameters, test)
    return {"slip_ratio": slip, **{q: np.asarray(getattr(result, q)) for q in table.measured}}
