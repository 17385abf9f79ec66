"""What the verbs need of a model that is held against measurements, whatever these are."""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, TypeVar, get_args, get_type_hints

import numpy as np

from lunar_mjx.diagnosis.weighed.conclusion import LARGEST_CLASS
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.problem import NotTested
from lunar_mjx.inference.weighing.hypotheses import Form, Linear, Refit
from lunar_mjx.inference.weighing.search import LEAST_SIGNAL, UNLISTED_SHARE, Hypothesis

SettingsKind = TypeVar("SettingsKind", bound="SearchSettings")
"""The class itself or one that adds to it: annotations are checked method by method, where `Self` has no meaning."""
LARGEST_SETTING = 1e6
"""Of any size, odds or count: beyond it a prior is none, and its matrices cannot be solved in double precision."""


@dataclasses.dataclass(frozen=True)
class SearchSettings:
    """How rare things are, what a verdict needs, and how much a search may do."""

    usual_discrepancy: float = 0.05
    """1; scale of the half-normal prior of each port's discrepancy: no contact law is exact (terramechanics models
    predict drawbar pull and sinkage to some 5 to 10 per cent, Wong 2008)."""
    unlisted_discrepancy: float = 0.3
    """1; scale of the half-normal prior of a discrepancy where something unlisted acts at its port."""
    effect_size: float = 1.0
    """1; prior standard deviation of an effect's amplitude, over its nominal size."""
    effect_freedom: float = 1.0
    """1; degrees of freedom of Student's t prior of an effect's amplitudes, 1 for Cauchy's: a nominal size is a guess.
    0: Gaussian, which drives in windows always have."""
    effect_odds: float = 0.01
    """1; prior odds of each effect of the catalogue: of some fifteen, one is missing in every seventh table."""
    unlisted_odds: float = 0.005
    """1; prior odds of something unlisted in each field of discrepancy."""
    sure: float = 0.95
    """1; probability of a statement that is a verdict."""
    most_refits: int = 14
    """1; refits of a search."""
    most_terms: int = 7
    """1; terms of one hypothesis at most, as the real wheel needs."""
    window: float = 4.0
    """nat; hypotheses further below the best are not refitted: 2 per cent of its probability."""
    most_scored: int = 100
    """1; effects beside a set that are scored with sizes of their own, the likeliest at the set's sizes: of a table
    every one is."""
    least_signal: float = LEAST_SIGNAL
    """sigma; length of a signature at its prior size below which no data can speak for or against an effect."""
    unlisted_share: float = UNLISTED_SHARE
    """1; probability of something unlisted from which every effect is refitted from where it acts (28 foreign tables:
    Brier score 0.048 to 0.032)."""
    largest_class: int = LARGEST_CLASS
    """1; names of a class at most: "one of six" is no help to its reader."""
    held_out_sure: float = 0.0
    """1; probability that a name helps what was held out, below which it is taken back; 0: never."""

    @classmethod
    def of(cls: type[SettingsKind], changed: Mapping[str, Any]) -> SettingsKind:
        """The usual settings but for some, given by name as numbers, lists or text.

        Raises:
          UserError: no such setting, a value of another kind, below zero, a probability above one, or a list of
            another length where that is fixed.
        """
        usual, values = dataclasses.asdict(cls()), {}
        hints = get_type_hints(cls)
        for name, value in changed.items():
            if name not in usual:
                raise bad_input("settings", name, value, "is not known", f"use one of {', '.join(usual)}")
            try:
                values[name] = _like(usual[name], value)
            except (TypeError, ValueError):
                raise bad_input("settings", name, value, "has another kind", f"give it like {usual[name]}") from None
            # Levels that are tried are as many as one likes; shares of three shapes are three.
            of = get_args(hints[name]) if isinstance(usual[name], tuple) else ()
            if of and Ellipsis not in of and len(values[name]) != len(of):
                raise bad_input("settings", name, value, "has another length", f"give it like {usual[name]}")
            # Sizes, shares, probabilities, odds and counts: none is below zero. Of odds and of a discrepancy's size the
            # logarithm is taken, and a length is divided by.
            most = 1.0 if name.endswith(("sure", "_share")) else LARGEST_SETTING
            for number in values[name] if isinstance(values[name], tuple) else (values[name],):
                if not isinstance(number, str):
                    above = name.endswith(("_odds", "_length", "_discrepancy"))
                    require_within("settings", name, number, 0.0, most, above=above)
        return cls(**values)

    @property
    def effect_log_odds(self) -> float:
        """Log of `effect_odds`."""
        return math.log(self.effect_odds)

    @property
    def unlisted_log_odds(self) -> float:
        """Log of `unlisted_odds`."""
        return math.log(self.unlisted_odds)


def _like(usual: Any, value: Any) -> Any:
    """A value in the kind of the usual one; lists may be text with commas, and one that is empty holds names."""
    if isinstance(usual, tuple):
        texts = [v.strip() for v in value.split(",")] if isinstance(value, str) else list(value)
        return tuple(type(usual[0] if usual else "")(v) for v in texts if v != "")
    found = float(value)
    if not math.isfinite(found) or (isinstance(usual, int) and found != int(found)):
        raise ValueError(value)
    return type(usual)(found)


class MeasuredForm(Form):
    """A form of a model beside its measurements.

    Attributes:
      observations: what was measured.
      coordinates: everything that a refit may move. baseline: places of those of the model as it is.
      candidates: places by effect that may be missing.
      discrepancy: places of amounts of discrepancy that are simulated. ground: of those of ground that nobody mapped.
      words: fields of discrepancy, and what is "good to so many per cent" in the user's words.
      shares: what a field's size is "good to", over that size, where not 1.
      skipped: candidates that the time did not suffice to look at.
      writing: refits that take as long as what comes after a search, where that is more than a tenth of the time given.
    """

    observations: Observations
    coordinates: tuple[Coordinate, ...]
    baseline: np.ndarray
    candidates: Mapping[str, np.ndarray]
    words: Mapping[str, str]
    shares: Mapping[str, float] = MappingProxyType({})
    discrepancy: np.ndarray = np.zeros(0, int)
    ground: np.ndarray = np.zeros(0, int)
    skipped: tuple[str, ...] = ()
    writing: float = 0.0

    @abc.abstractmethod
    def predicted(self, u: np.ndarray) -> np.ndarray:
        """(n,) predictions in SI units at (coordinates,)."""

    def learnt(self, refit: Refit) -> dict[str, Any]:
        """What a form has learnt beside its parameters, for the record of a comparison; nothing by itself."""
        del refit
        return {}

    def under_errors_of(self, refit: Refit, other: Refit) -> Linear:
        """What hypotheses need around a refit with the errors of measurements that another has found, and without what
        that one names: all that is usual, such as a little of every effect, is without it, too.

        As it is where all refits have the same errors, and nothing usual holds an effect.
        """
        del other
        return refit.linear

    def limit(self, until: float) -> None:
        """Ends simulations by a time of the monotonic clock, where they last: refits then raise `TimeUp`."""
        del until

    def corrected(self, best: Hypothesis) -> tuple[np.ndarray, np.ndarray] | None:
        """Predictions (n,) and whitened residuals (n,) with what is learnt of discrepancy, where a form can tell."""
        del best
        return None

    def alone(self, refit: Refit) -> np.ndarray:
        """(coordinates,) where the model alone predicts the fitted measurements best.

        A refit leaves to discrepancy and instruments what these explain as well as the parameters do: so its parameters
        are unbiased, and its predictions without the two are not the best. Whoever uses a model without the two, and
        every error that is told of it, needs these (L2 calibration: Tuo & Wu 2015). A form that does not tell the
        two apart returns where the refit stands.
        """
        return refit.u

    def told(self, u: np.ndarray) -> np.ndarray:
        """(n,) residuals in sigma as errors are told, whatever they are weighed by: the whitened ones by themselves."""
        return self.residual(u)

    def signatures(self, refit: Refit) -> dict[str, np.ndarray]:
        """(fitted,) whitened signature of each effect at its prior size, where told."""
        del refit
        return {}

    def trial(self, u: np.ndarray, effect: str) -> np.ndarray:
        """See `Form`: amplitudes that a place has near their null at half their prior size."""
        out = u.copy()
        for i in self.candidates[effect]:
            c = self.coordinates[i]
            low, high = c.bounds()
            # At its null an effect's shape parameters change nothing: a refit that began there would have no slope
            # along them.
            if c.amplitude and abs(out[i]) < 0.5 * (size := self.effect_size(c)):
                out[i] = min(max(0.5 * size * (1.0 if high > 0.0 else -1.0), low), high)
        return out

    def effect_size(self, c: Coordinate) -> float:
        """Prior standard deviation of an effect's amplitude, in scales."""
        del c
        return 1.0

    def amounts(self, columns: int) -> np.ndarray:
        """(columns,) whether each is the amplitude of a coordinate, of which the first columns are."""
        return amplitude_columns(self.coordinates, columns)

    def effect_std(self, u: np.ndarray, std: np.ndarray, freedom: float) -> np.ndarray:
        """(coordinates,) prior standard deviations for a descent; see `students_std`."""
        return students_std(self.coordinates, self.candidates, u, std, freedom)

    def origin(self) -> np.ndarray:
        """(coordinates,) the model as given."""
        return np.zeros(len(self.coordinates))

    def bare(self, u: np.ndarray) -> np.ndarray:
        """A place (coordinates,) without its discrepancy: what the model itself predicts there."""
        out = u.copy()
        out[self.discrepancy] = 0.0
        return out

    def residual(self, u: np.ndarray) -> np.ndarray:
        """(n,) whitened residuals, measured less predicted."""
        return self.observations.whiten(self.observations.value - self.predicted(u))


def amplitude_columns(coordinates: Sequence[Coordinate], columns: int) -> np.ndarray:
    """(columns,) whether each is the amplitude of a coordinate, of which the first columns are."""
    out = np.zeros(columns, bool)
    out[: len(coordinates)] = [c.amplitude for c in coordinates]
    return out


def students_std(
    coordinates: Sequence[Coordinate],
    candidates: Mapping[str, np.ndarray],
    u: np.ndarray,
    std: np.ndarray,
    freedom: float,
) -> np.ndarray:
    """(coordinates,) prior standard deviations for a descent from (coordinates,), where effects have Student's t.

    A Gaussian that is as wide as the amplitudes there are far draws them like the t distribution (EM: Lange et al.
    1989). It is never narrower than the nominal one: a descent that begins at an effect's null says nothing of its
    size.

    Args:
      coordinates: all of them. candidates: places by effect.
      u: the place. std: (coordinates,) nominal ones. freedom: of the distribution; 0 for a Gaussian.
    """
    out = std.copy()
    for places in candidates.values() if freedom > 0.0 else ():
        own = [i for i in places if coordinates[i].amplitude]
        square = float(np.sum((u[own] / std[own]) ** 2))
        out[own] *= max(1.0, math.sqrt((freedom + square) / (freedom + len(own))))
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Problem:
    """Measurements of a run and everything that they are held against.

    Attributes:
      forms: rival forms of the model, its own first. effects: candidates by name.
      not_tested: candidates that these measurements cannot show.
      settings: how rare things are, what a verdict needs, effort.
      unused: what the logs hold and nothing reads, as one sentence; empty if all is read.
    """

    forms: Sequence[MeasuredForm]
    effects: Mapping[str, Effect]
    not_tested: tuple[NotTested, ...]
    settings: SearchSettings
    unused: str = ""

    @property
    def own(self) -> MeasuredForm:
        """The form of the model as given."""
        return self.forms[0]

    def form(self, name: str) -> MeasuredForm:
        """The form of a name."""
        return next(f for f in self.forms if f.name == name)
