"""Whether what a search names helps measurements that chose nothing: a name is held to account by what it never saw."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import stats

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.inference.weighing.search import ModelSearch

NAMING = (Verdict.KNOWN, Verdict.KNOWN_CLASS, Verdict.MULTIPLE)
"""Verdicts that name something, which may be taken back."""
FEWEST = 2
"""Held-out units from which their gains have a spread, and a name can be tested."""


@dataclasses.dataclass(frozen=True)
class Account:
    """What an explanation gains on held-out units.

    Attributes:
      gain, se: sum of the units' gains of log density, nat, and its standard error. units: number of them.
    """

    gain: float
    se: float
    units: int

    def helps(self, sure: float) -> bool:
        """Whether the gain is positive with the probability `sure`, by Student's t; true of fewer than two units.

        Units of one drive share what no law here has, such as the shape of friction's rise with slip; what fits some of
        them alone is no explanation.
        """
        return self.units < FEWEST or self.gain > float(stats.t.ppf(sure, self.units - 1.0)) * self.se

    def to_dict(self, unit: str) -> dict[str, float]:
        """Gain, standard error and number, which is told by the name of the unit."""
        return {"gain": self.gain, "se": self.se, unit: self.units}


def account(gains: np.ndarray) -> Account:
    """The sum of (unit,) gains with its standard error; NaN for fewer than two."""
    # Of a sum, not of a mean: a name has to pay by what it gains on all that was held out.
    se = math.sqrt(len(gains)) * float(np.std(gains, ddof=1)) if len(gains) >= FEWEST else math.nan
    return Account(float(np.sum(gains)), se, len(gains))


def gains_on_held_out(found: ModelSearch) -> np.ndarray:
    """(unit,) gain of log predictive density of the best refitted explanation over nothing beyond the usual, nat.

    The model as it is has discrepancies of usual size here: those that the fitted measurements asked for may hold the
    very thing that is to be named.
    """
    best = next(h for h in found.hypotheses if h.refitted)
    base = found.base(best.form)
    usual = np.array([f.usual for f in base.refit.linear.fields])
    plain = dataclasses.replace(base.evidence, tau=usual)
    gains = [
        best.refit.linear.log_score(name, best.evidence, best.places)
        - base.refit.linear.log_score(name, plain, base.places)
        for name in best.refit.linear.held_out
    ]
    return np.array(gains)
