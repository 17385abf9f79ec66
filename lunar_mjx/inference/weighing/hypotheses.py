"""Hypotheses about what is missing: sets of terms beside one form of a model, and their evidence around a refit.

A term is one thing that may be the matter: an effect (parameters that leave their null), a discrepancy beyond the usual
size at a port ("unlisted"), or an instrument that errs more than usual ("calibration"). Discrepancy, calibration and
noise of usual size are part of every hypothesis. A form is a model in its own right, such as another contact law.
"""

from __future__ import annotations

import abc
import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np

from lunar_mjx.inference.evidence import (
    Amplitudes,
    Evidence,
    EvidenceError,
    Field,
    Gram,
    NoiseSize,
    infer,
    log_density,
    moved,
)

EFFECT, UNLISTED, CALIBRATION = "effect", "unlisted", "calibration"
_SIZES = (1.0, 3.0, 10.0)
"""Sizes of effects, over their nominal ones, at which a set is looked at before it is scored."""


@dataclasses.dataclass(frozen=True)
class Term:
    """One thing that may be the matter.

    Attributes:
      name: of the effect, of the port's field (with what it follows, after " with "), or of the instrument.
      kind: EFFECT, UNLISTED or CALIBRATION.
      log_prior: log of its prior odds.
    """

    name: str
    kind: str
    log_prior: float


@dataclasses.dataclass(frozen=True, eq=False)
class Linear:
    """A form, linear around a refit: everything that its hypotheses need, whatever the number of measurements.

    Attributes:
      gram: of fitted measurements, over all columns: parameters of the form, of every effect, calibration, fields.
      held_out: the same of measurements that choose nothing, by manoeuvre or piece of one.
      amplitudes: prior of all columns, relative to the refit. low, high: (k,) bounds relative to the refit; infinite
        where the prior is not truncated.
      always: columns of every hypothesis: the form's own parameters, calibration, and fields of usual size.
      effects: columns by effect; zero amplitude is where the refit stands.
      at: (k,) where the refit stands, relative to an effect's null; zero for other columns.
      calibration: columns by instrument, among `always`.
      following: columns of something unlisted that follows one quantity alone, by the name of its term.
      added: columns of a field of discrepancy that count only where something unlisted acts in it, by field.
      fields: discrepancies. noises: of the noise groups.
      wide: scale of tau's prior where something unlisted acts at a port. far: factor on the prior of an instrument that
        errs more than usual.
      judged: statistics of measurements that no fit sees and by whose prediction every hypothesis is weighed as well.
      amount: (k,) whether a column is the amplitude of an effect, whose size is known by its nominal one alone; none
        where None. freedom: of Student's t prior of an effect's amplitudes; they are Gaussian where it is 0.
      unkept: nats that the derivatives promise beyond the refit and that its descent could not reach: no hypothesis
        around it is credited with them.
      log_scale: added to the log evidence, as hypotheses with other errors of measurements are whitened otherwise: the
        log of what turns it into that of the measurements in their units. held_out_scale: the same by held-out piece.
      inexact: columns of what the laws of effects get wrong, by effect; those of `effects` belong to hypotheses with
        that effect, those of the model's own to all. inexactness: scale of the half-normal prior of their size.
    """

    gram: Gram
    held_out: Mapping[str, Gram]
    amplitudes: Amplitudes
    low: np.ndarray
    high: np.ndarray
    always: np.ndarray
    effects: Mapping[str, np.ndarray]
    at: np.ndarray
    calibration: Mapping[str, np.ndarray]
    following: Mapping[str, np.ndarray]
    fields: tuple[Field, ...]
    noises: tuple[NoiseSize, ...]
    wide: float
    far: float
    added: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    judged: Gram | None = None
    amount: np.ndarray | None = None
    freedom: float = 0.0
    unkept: float = 0.0
    log_scale: float = 0.0
    held_out_scale: Mapping[str, float] = dataclasses.field(default_factory=dict)
    inexact: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    inexactness: float = 0.0

    def evidence(
        self, terms: frozenset[Term], start: tuple[np.ndarray, np.ndarray] | None = None
    ) -> tuple[float, Evidence, np.ndarray]:
        """Log evidence of a set of terms, in linear approximation where its effects are not those of the refit.

        Args:
          terms: beside the form. start: sizes of discrepancy and noise to begin from.

        Returns:
          The log evidence with priors truncated to their bounds, and with it the log density of what is `judged` as
          the fitted measurements predict it (together the density of all, part by part: Dawid 1984); sizes and
          posterior; columns of the posterior.

        Raises:
          EvidenceError: the sizes did not settle.
        """
        gram, prior, fields, places, back = self._model(terms)
        given = len(self.fields)
        if start is not None:
            start = np.append(start[0], [f.usual for f in fields[given:]]), start[1]
        inferred = infer(gram, prior, fields, self.noises, start)
        if len(fields) > given:
            # Sizes of effects, and of what their laws get wrong, belong to this hypothesis alone: for whoever reads on
            # they are part of the prior.
            effect, std = prior.field >= given, prior.std.copy()
            std[effect] *= inferred.tau[prior.field[effect]]
            inferred = dataclasses.replace(
                inferred,
                tau=inferred.tau[:given],
                tau_log_std=inferred.tau_log_std[:given],
                amplitudes=Amplitudes(std, np.where(effect, -1, prior.field), prior.mean),
            )
        value = inferred.log_evidence + inferred.log_inside(self.low[places], self.high[places])
        value += self.log_scale - self.unkept
        if self.judged is not None:
            held = self.judged if back is None else shifted(self.judged, back)
            value += inferred.log_score(held.select(places))
        return value, inferred, places

    def log_score(self, name: str, found: Evidence, places: np.ndarray) -> float:
        """Log density of a held-out piece as a hypothesis predicts it, in units that all hypotheses share.

        Args:
          name: of the piece. found, places: what `evidence` gave for the hypothesis.
        """
        return found.log_score(self.held_out[name].select(places)) + self.held_out_scale.get(name, 0.0)

    def at_sizes(self, terms: frozenset[Term], sizes: tuple[np.ndarray, np.ndarray]) -> float:
        """Log density of the fitted measurements by a set of terms at given sizes of discrepancy and noise.

        Priors are not truncated, nor is anything `judged`: this tells which sets are worth an `evidence`, which takes
        ten times as long. Minus infinity where rounding spoils it.
        """
        gram, prior, fields, *_ = self._model(terms)
        usual = np.array([f.usual for f in fields[len(self.fields) :]])
        # of a few sizes of its effects the best: for a choice among sets that will do
        tried = [np.append(sizes[0], size * usual) for size in (_SIZES if len(usual) else _SIZES[:1])]
        try:
            return max(log_density(gram, prior, tau, sizes[1]) for tau in tried)
        except EvidenceError:
            return -math.inf

    def _model(
        self, terms: frozenset[Term]
    ) -> tuple[Gram, Amplitudes, tuple[Field, ...], np.ndarray, np.ndarray | None]:
        """Statistics, prior, fields and columns of a set of terms, and what moves the refit's other effects to null."""
        named = {t.name for t in terms if t.kind == EFFECT}
        own = [self.effects[name] for name in self.effects if name in named]
        unlisted = {t.name for t in terms if t.kind == UNLISTED}
        own += [part[name] for part in (self.added, self.following) for name in part if name in unlisted]
        rough = [p for name, p in self.inexact.items() if name in named or name not in self.effects]
        own += rough
        places = np.concatenate([self.always, *own]).astype(int)
        # An effect of the refit that is no term of this hypothesis goes back to its null.
        gone = [p for name, p in self.effects.items() if name not in named and np.any(self.at[p] != 0.0)]
        gram, back = self.gram, None
        if gone:
            back = np.zeros(self.gram.width)
            for p in gone:
                # From where the refit stands to zero amplitude, by the linear model.
                back[p] = -self.at[p]
            gram = shifted(gram, back)
        std = self.amplitudes.std.copy()
        for t in terms:
            if t.kind == CALIBRATION:
                std[self.calibration[t.name]] *= self.far
        # an instrument that errs more than usual has the columns of every hypothesis, with a wider prior
        prior = Amplitudes(std, self.amplitudes.field, self.amplitudes.mean).select(places)
        fields = [Field(f.name, self.wide) if f.name in unlisted else f for f in self.fields]
        if rough:
            field = prior.field.copy()
            field[np.isin(places, np.concatenate(rough))] = len(fields)
            prior = Amplitudes(prior.std, field, prior.mean)
            fields.append(Field("laws of effects", self.inexactness))
        if self.freedom > 0.0 and self.amount is not None:
            # What is nominal is a guess: an amplitude ten times as large is rare, and no miracle (Jeffreys 1961).
            by_column = np.full(self.gram.width, -1)
            for name in [n for n in self.effects if n in named and np.any(self.amount[self.effects[n]])]:
                own = self.effects[name]
                by_column[own[self.amount[own]]] = len(fields)
                fields.append(Field(name, 1.0, freedom=self.freedom))
            field = by_column[places]
            prior = Amplitudes(prior.std, np.where(field >= 0, field, prior.field), prior.mean)
        return gram.select(places), prior, tuple(fields), places, back

    def shows(self) -> dict[str, float]:
        """Length in sigma of each effect's signature at its prior size that the form's own parameters cannot absorb.

        Noise is of stated size; discrepancy and calibration are left out: this tells whether anything could be seen.
        """
        whole = self.gram.matrix.sum(axis=0)
        own = self.always[(self.amplitudes.field[self.always] < 0)]
        # Discrepancy and calibration could absorb anything: with them, this would tell of the priors and not of the
        # data.
        own = np.setdiff1d(own, np.concatenate([*self.calibration.values(), np.zeros(0)]).astype(int))
        scale = self.amplitudes.std
        inner = np.eye(len(own)) + scale[own, None] * whole[np.ix_(own, own)] * scale[own]
        shown_sigma = {}
        for name, places in self.effects.items():
            across = scale[own, None] * whole[np.ix_(own, places)] * scale[places]
            length = scale[places] ** 2 * np.diag(whole)[places]
            length = length - np.einsum("ij,ij->j", across, np.linalg.solve(inner, across))
            # Its strongest amplitude: one that shows is enough to tell of the effect.
            shown_sigma[name] = float(np.sqrt(max(length.max(), 0.0))) if len(places) else 0.0
        return shown_sigma

    def alike(self, found: Evidence, places: np.ndarray, unlisted: str) -> dict[str, float]:
        """Share of what something unlisted was found to do that each effect could do in its place, from 0 to 1.

        As it is, not beside what the form's parameters could do: of that the effect's own estimate tells.

        Args:
          found, places: what `evidence` gave for a set with that term. unlisted: its name.

        Returns:
          By effect; squares of lengths in the fitted measurements, at the noise found, count.
        """
        numbers = [k for k, f in enumerate(self.fields) if f.name == unlisted]
        more = [part[unlisted] for part in (self.added, self.following) if unlisted in part]
        own = np.isin(self.amplitudes.field[places], numbers) | np.isin(places, np.concatenate([np.zeros(0), *more]))
        # from nothing, not from the refit, which may have moved some of it
        amounts = np.zeros(self.gram.width)
        amounts[places[own]] = found.mean[own] - self.amplitudes.mean[places[own]]
        whole = np.einsum("g,gij->ij", found.noise**-2.0, self.gram.matrix)[:-1, :-1]
        seen = whole @ amounts
        length = float(amounts @ seen)
        shares = {}
        for name, p in self.effects.items():
            inner = whole[np.ix_(p, p)]
            x = np.clip(np.linalg.pinv(inner, hermitian=True) @ seen[p], self.low[p], self.high[p])
            shares[name] = max(float(2.0 * x @ seen[p] - x @ inner @ x), 0.0) / length if length > 0.0 else 0.0
        return shares

    def felt(self) -> dict[str, float]:
        """Length in sigma of each field's strongest direction at the size of something unlisted; 0 for none."""
        whole = np.diag(self.gram.matrix.sum(axis=0))[:-1]
        felt_sizes = {}
        for number, field in enumerate(self.fields):
            own = np.flatnonzero(self.amplitudes.field == number)
            length = self.wide * self.amplitudes.std[own] * np.sqrt(whole[own])
            felt_sizes[field.name] = float(length.max(initial=0.0))
        for name, places in self.following.items():
            felt_sizes[name] = float((self.amplitudes.std[places] * np.sqrt(whole[places])).max(initial=0.0))
        return felt_sizes


def shifted(gram: Gram, amounts: np.ndarray) -> Gram:
    """Statistics after the model's amplitudes have been moved by (k,) amounts: residual less columns times amounts."""
    return Gram(gram.count, moved(gram.matrix, amounts))


@dataclasses.dataclass(frozen=True, eq=False)
class Refit:
    """A form refitted with a set of effects under the covariance of noise, calibration and discrepancy.

    Attributes:
      form: its name. effects: names. u: coordinates. linear: around them.
      failed: why the solver failed, or "".
    """

    form: str
    effects: frozenset[str]
    u: np.ndarray
    linear: Linear
    failed: str = ""


class Form(abc.ABC):
    """A model in its own right, with the effects that may be missing beside it.

    Attributes:
      name: of the form. log_prior: log of its prior probability among the forms.
      terms: everything that may be the matter beside it.
      exchanged: effects that take the place of a part of the model and have no small amounts: as no linear estimate
        holds for them, a search refits each of them alone.
      late: whether it is refitted only where something would else be said to be missing beside another.
    """

    name: str
    log_prior: float
    terms: Sequence[Term]
    exchanged: Sequence[str] = ()
    late: bool = False

    def listed(self, effects: frozenset[str]) -> frozenset[Term]:
        """The terms of some effects."""
        return frozenset(t for t in self.terms if t.kind == EFFECT and t.name in effects)

    @abc.abstractmethod
    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> Refit:
        """Refits the form's parameters and those of some effects.

        Args:
          effects: names.
          near: refit of a similar set to begin at; the model as given if None.
          start: (coordinates,) to begin at, in place of that of `near`.
        """

    def trial(self, u: np.ndarray, effect: str) -> np.ndarray:
        """(coordinates,) a place at which an effect acts, for one whose slope at its null says little."""
        del effect
        return u

    def promising(self, refit: Refit) -> Mapping[str, float]:
        """Nats that each effect has been seen to gain beside a refit, where linear estimates do not tell.

        Args:
          refit: of this form.

        Returns:
          By effect; empty where linear estimates are to be believed.

        Raises:
          EvidenceError: nothing can be told of where it stands. TimeUp: before all had been looked at.
        """
        del refit
        return {}
