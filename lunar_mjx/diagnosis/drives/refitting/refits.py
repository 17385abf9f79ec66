"""Refits of a form of drives with effects, all weighed with what the refit of the model as it is has found."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.descent import Descent
from lunar_mjx.diagnosis.drives.refitting.design import Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel, Errors
from lunar_mjx.diagnosis.drives.refitting.linear import Linearised
from lunar_mjx.diagnosis.drives.refitting.own import Base, OwnRefit
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.race import Race
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.weighing.hypotheses import EFFECT, Linear, Refit, Term


@dataclasses.dataclass(frozen=True, eq=False)
class _End:
    """Where a refit has ended.

    Attributes:
      free: coordinates that were moved. slopes: (n, free) derivatives by them.
      seen: (n, coordinates) those of `Design`.
      errors: of the readings, as it has found them.
    """

    free: np.ndarray
    slopes: np.ndarray
    seen: np.ndarray
    errors: Errors


@dataclasses.dataclass(eq=False)
class Refits:
    """Refits around that of the model as it is.

    Attributes:
      drives: simulation. design: derivatives. linearised: what hypotheses need. descent: within bounds.
      prior: of what moves. errors: of the readings. terms: everything that may be the matter. settings: effort.
      own: refit of the model as it is. acting: the place (coordinates,) of another with an effect of some size.
      base: the refit of the model as it is by itself; None before.
      ended: what is known of the end of each refit, by its effects and coordinates.
      raced: (coordinates,) where races have brought effects, by the effects beside which they ran, and their own.
    """

    drives: DriveProblem
    design: Design
    linearised: Linearised
    descent: Descent
    prior: Prior
    errors: ErrorModel
    terms: Sequence[Term]
    settings: DriveSettings
    own: OwnRefit
    acting: Callable[[np.ndarray, str], np.ndarray]
    base: Base | None = None
    ended: dict[tuple[frozenset[str], bytes], _End] = dataclasses.field(default_factory=dict)
    raced: dict[tuple[frozenset[str], frozenset[str]], np.ndarray] = dataclasses.field(default_factory=dict)

    def begin(self, base: Base) -> tuple[np.ndarray, Linear]:
        """Where (coordinates,) the model as it is ends from its own refit, and what hypotheses need there.

        Args:
          base: its own refit.

        Raises:
          EvidenceError: nothing can be told of that place.
        """
        self.base = base
        return base.u, self._weighed(base.u, frozenset(), base.free, base.slopes)

    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> tuple[np.ndarray, Linear]:
        """Where (coordinates,) the model with some effects ends, and what hypotheses need there.

        Each set has errors of its own: weighed by those of one hypothesis, all others would have to explain what that
        one has taken for errors. An effect that was raced beside the similar refit begins where the race has brought
        it, any other set at the similar refit.

        Args:
          effects, near: as for `Form.refit`. start: where there is no `near`; else it does not count.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before the refit had ended.
        """
        assert self.base is not None
        free = self.prior.places.free(effects)
        raced = None if near is None else self.raced.get((near.effects, effects - near.effects))
        self.drives.devote(effects)
        with self.own.apart(self.base):
            u, slopes = self.own.go_on(self._start(effects, near, start) if raced is None else raced, free)
            return u, self._weighed(u, effects, free, slopes)

    def race(self, refit: Refit) -> dict[str, float]:
        """What each effect that a refit is without gains beside it by a few steps, nats; see `Race`.

        Args:
          refit: of this form. Errors of the present are left as they are.

        Raises:
          EvidenceError: nothing can be told of where it stands. TimeUp: before all had run.
        """
        assert self.base is not None
        end = self.ended[refit.effects, refit.u.tobytes()]
        shows = refit.linear.shows()
        wanted = {e for e in shows if shows[e] >= self.settings.least_signal} - refit.effects
        with self.own.apart(self.base), self.own.under_large_errors():
            self.drives.about(refit.u)
            # By slopes of where the model stands, a little of every effect would stand in for what one does elsewhere:
            # on a foreign Husky the hidden slip-sinkage lost 5,587 nats beside it, and gains 1,294 without.
            self.design.seen[:, self.prior.places.amplitudes(self.prior.places.candidates)] = 0.0
            race = Race(self.own, self.descent, self.settings.longest_step, end.free, end.slopes, refit.u)
            groups = [[n for n in part if n in wanted] for part in self.own.signatures.parts]
            gains = race.run([names for names in groups if names], self.acting)
        self.raced |= {(refit.effects, frozenset({e})): u for e, u in race.ends.items()}
        return gains

    def under_errors_of(self, refit: Refit, other: Refit) -> Linear:
        """What hypotheses need around a refit, with the errors of readings that another one has found, and without even
        a little of what that one names.

        Args:
          refit, other: of this form. Errors of the present are left as they are.
        """
        assert self.base is not None
        end, found = (self.ended[r.effects, r.u.tobytes()] for r in (refit, other))
        with self.own.apart(self.base):
            self.errors.present, self.design.seen = found.errors, end.seen
            self.drives.about(refit.u)
            return self.linearised.around(refit.u, refit.effects, end.slopes, other.effects)

    def _weighed(self, u: np.ndarray, effects: frozenset[str], free: np.ndarray, slopes: np.ndarray) -> Linear:
        """What hypotheses need around the place (coordinates,) of a refit, by its own derivatives and errors."""
        self.drives.about(u)
        linear = self.linearised.around(u, effects, slopes)
        found = linear.evidence(self._listed(effects), self.base.sizes if self.base else None)[1]
        sizes = self.prior.fields.led_by((found.tau, found.noise))
        cost = self.descent.cost(u, free, sizes, self.prior.places.inputs(free, slopes))
        self.ended[effects, u.tobytes()] = _End(free, slopes, self.design.seen.copy(), self.errors.present)
        promise = self.descent.promise(cost, u, free, slopes)
        return dataclasses.replace(linear, unkept=0.5 * max(promise - self.settings.settled, 0.0))

    def _start(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> np.ndarray:
        """(coordinates,) where a similar refit has ended, or else the start; effects that it is without act there."""
        assert self.base is not None
        free = self.prior.places.free(effects)
        u = self.prior.places.origin()
        u[self.drives.ground] = self.base.u[self.drives.ground]
        begun = near.u if near is not None else self.base.u if start is None else start
        u[free] = begun[free]
        known = near.effects if near is not None else frozenset() if start is None else effects
        for effect in sorted(effects - known):
            u = self.acting(u, effect)
        low, high = self.drives.bounds(free)
        u[free] = np.clip(u[free], low + DRIVE_REFIT.inside, high - DRIVE_REFIT.inside)
        return u

    def alone(self, refit: Refit) -> np.ndarray:
        """(coordinates,) where the model alone predicts the fitted measurements best; from the refit's parameters and
        from those as given.

        A refit that leaves much to discrepancy may predict worse without it than the model as given does.
        """
        places, errors, std = self.prior.places, self.errors, self.prior.std
        free = self.ended[refit.effects, refit.u.tobytes()].free
        free = free[self.prior.field_of[free] < 0]
        fitted = places.bare(refit.u)
        given = fitted.copy()
        given[[i for i in places.baseline if not places.coordinates[i].nuisance]] = 0.0
        centre = places.centres(free)

        def cost(u: np.ndarray) -> float:
            left = errors.observations.whiten(errors.observations.value - self.drives.predict(u[None])[0])[errors.fit]
            # a simulation that diverged is no candidate
            return float(np.nan_to_num(left @ left, nan=np.inf) + np.sum(((u[free] - centre) / std[free]) ** 2))

        starts = [u for u in (fitted, given) if math.isfinite(cost(u))]
        whole = bool(refit.effects)
        return min((self.descent.descend(u, free, once=True, whole=whole)[0] for u in starts), key=cost)

    def _listed(self, effects: frozenset[str]) -> frozenset[Term]:
        """The terms of some effects."""
        return frozenset(t for t in self.terms if t.kind == EFFECT and t.name in effects)
