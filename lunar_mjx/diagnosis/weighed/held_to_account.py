"""Whether what a search names helps measurements that chose nothing: a name is held to account by what it never saw."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy import stats

from lunar_mjx.diagnosis.verdict import Verdict
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.inference.weighing.hypotheses import UNLISTED
from lunar_mjx.inference.weighing.search import ModelSearch

NAMING = (Verdict.KNOWN, Verdict.KNOWN_CLASS, Verdict.MULTIPLE)
"""Verdicts that name something, which may be taken back."""
FEWEST = 2
"""Held-out units from which their gains have a spread, and a name can be tested."""
_FLIPS = 9999
"""Sign flips that are drawn at most; those of up to 13 units are all counted."""


@dataclasses.dataclass(frozen=True)
class Account:
    """What an explanation gains on held-out units.

    Attributes:
      gain, se: sum of the units' gains of log density, nat, and its standard error. units: number of them.
      by_chance: probability of so large a sum if gains were as likely losses (sign flips: Fisher 1935). Gains of pieces
        are skewed, for some meet what is missing and others do not, and by Student's t all of eight may be gains
        without being enough.
    """

    gain: float
    se: float
    units: int
    by_chance: float

    def helps(self, sure: float) -> bool:
        """Whether the gain is positive with the probability `sure`; true of fewer than two units.

        Of few units each has to gain: no sum of four can be surer than 15 in 16.
        Units of one drive share what no law here has, such as the shape of friction's rise with slip; what fits some of
        them alone is no explanation.
        """
        return self.units < FEWEST or self.by_chance <= max(1.0 - sure, 0.5**self.units)

    def to_dict(self, unit: str) -> dict[str, float]:
        """Gain, standard error, probability by chance and number, which is told by the name of the unit."""
        return {"gain": self.gain, "se": self.se, "by_chance": self.by_chance, unit: self.units}


def account(gains: np.ndarray) -> Account:
    """The sum of (unit,) gains with its standard error and how probable it is by chance; NaN for fewer than two."""
    if len(gains) < FEWEST:
        return Account(float(np.sum(gains)), math.nan, len(gains), math.nan)
    # Of a sum, not of a mean: a name has to pay by what it gains on all that was held out.
    se = math.sqrt(len(gains)) * float(np.std(gains, ddof=1))
    flipped = stats.permutation_test(
        (gains, np.zeros_like(gains)),
        lambda gained, lost, axis: np.sum(gained - lost, axis=axis),
        permutation_type="samples",
        vectorized=True,
        n_resamples=_FLIPS,
        alternative="greater",
        rng=np.random.default_rng(0),
    )
    return Account(float(np.sum(gains)), se, len(gains), float(flipped.pvalue))


def gains_on_held_out(problem: Problem, found: ModelSearch) -> np.ndarray:
    """(unit,) gain of log predictive density of the best refitted explanation over nothing beyond the usual, nat.

    All is alike for both but what is named: errors of measurements, noise and sizes of discrepancy are those that the
    best has found. Each by its own would be told apart by how large they take errors to be: on a foreign campaign the
    hidden bias of an IMU lost 1,010 nats so, and gains on each of 8 pieces by the errors of either.
    """
    best = next(h for h in found.hypotheses if h.refitted)
    base, form = found.base(best.form), problem.form(best.form)
    plain = form.under_errors_of(base.refit, best.refit)
    unlisted = [f.name in {t.name for t in best.terms if t.kind == UNLISTED} for f in plain.fields]
    sizes = np.where(unlisted, [f.usual for f in plain.fields], best.evidence.tau)
    _, nothing, places = plain.evidence(base.terms, (sizes, best.evidence.noise))
    nothing = dataclasses.replace(nothing, tau=sizes, noise=best.evidence.noise)
    gains = [
        best.refit.linear.log_score(name, best.evidence, best.places) - plain.log_score(name, nothing, places)
        for name in best.refit.linear.held_out
    ]
    return np.array(gains)
