"""A rover's model held against drives, with all effects that may be missing and what may be wrong at its ports."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.derivatives import Derivatives
from lunar_mjx.diagnosis.drives.refitting.descent import Descent
from lunar_mjx.diagnosis.drives.refitting.design import Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel, Errors
from lunar_mjx.diagnosis.drives.refitting.fields import Fields, Share
from lunar_mjx.diagnosis.drives.refitting.linear import Linearised
from lunar_mjx.diagnosis.drives.refitting.own import Beside, OwnRefit
from lunar_mjx.diagnosis.drives.refitting.prior import Places, Prior, effect_size
from lunar_mjx.diagnosis.drives.refitting.refits import Refits
from lunar_mjx.diagnosis.drives.refitting.signatures import Signatures
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.usual import usual_of
from lunar_mjx.diagnosis.unknown_inputs.port_fields import SHARES, WORDS
from lunar_mjx.diagnosis.weighed.form import MeasuredForm
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Linear, Refit, Term

OWN_FORM = "the model"
LEARNT = frozenset({"channel_errors", "error_times_s"})
"""What `DriveForm.learnt` tells of the errors with which all hypotheses are weighed."""


class DriveForm(MeasuredForm):
    """A rover's model against drives.

    Derivatives are difference quotients between rovers of one batch. Those that lead a descent are taken where it
    stands. Hypotheses are weighed with those at one place, where the descent of the model as it is has learnt its
    errors, but for those of a refit's own effects.

    Attributes:
      drives: simulation. settings: sizes and priors.
      start: (coordinates,) where the first refit begins.
      kept: what `learnt` told of that place; then it has been refitted already.
    """

    def __init__(
        self,
        drives: DriveProblem,
        settings: DriveSettings,
        progress: Progress = silent,
        name: str = OWN_FORM,
        beside: DriveForm | None = None,
    ):
        """Makes the form.

        Args:
          drives: simulation of the logs with all candidates and unknown inputs. settings: sizes and priors.
          progress: told of refits. name: of the form.
          beside: the model's own form where this is a rival of it, weighed against measurements with the same errors.
        """
        self.drives, self.settings = drives, settings
        self.name, self.log_prior, self.late = name, 0.0, beside is not None
        self._rival_of, self._usual = beside, usual_of(drives)
        errors = ErrorModel(drives.observations, settings)
        fitted = {log: bool(errors.fit[part.start]) for log, part in drives.observations.of_log.items()}
        places, labels = Places.of(drives, fitted), tuple(drives.inputs)
        self.coordinates, self.baseline, self.candidates = places.coordinates, places.baseline, places.candidates
        self.discrepancy, self.ground = places.discrepancy, drives.ground
        self.words, self.shares = {label: WORDS[label] for label in labels}, SHARES
        self.terms = (
            *(Term(e, EFFECT, settings.effect_log_odds) for e in self.candidates),
            *(Term(label, UNLISTED, settings.unlisted_log_odds) for label in labels),
        )
        fields = Fields(labels, len(drives.ground) > 0, settings)
        share = Share.of(settings.own_share, list(fitted.values()))
        prior = Prior.of(places, drives.inputs, fields, share, self._usual)
        self.start: np.ndarray = prior.as_given()
        self.kept: Mapping[str, Any] = {}
        self._errors, self.observations = errors, errors.observations
        self._derivatives = derivatives = Derivatives(drives, prior, errors)
        design = Design(drives, prior, errors, settings)
        descent = Descent(drives, derivatives, design, prior, errors, settings)
        self._signatures = Signatures(drives, derivatives, design, prior, errors, settings, progress)
        self._own = OwnRefit(drives, derivatives, design, self._signatures, descent, prior, errors, settings, progress)
        linearised = Linearised(prior, errors, design, settings)
        self._refits = Refits(
            drives, design, linearised, descent, prior, errors, self.terms, settings, self._own, self.trial
        )

    @property
    def parts(self) -> list[list[str]]:
        """Candidates whose signatures are simulated by one program each."""
        return self._signatures.parts

    @property
    def errors(self) -> Errors:
        """Errors of measurements with which all hypotheses are weighed."""
        return self._errors.present

    def predicted(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`."""
        return self.drives.predict(u[None])[0]

    def told(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`: a reading that is far off is told so, whatever error of its own it is weighed with."""
        plain = self.errors.plain
        return plain.whiten(plain.value - self.predicted(u))

    def jacobian(self, u: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) at (coordinates,) and their derivatives (n, free); see `Derivatives.jacobian`."""
        return self._derivatives.jacobian(u, free)

    def effect_size(self, c: Coordinate) -> float:
        """See `MeasuredForm`: nominal sizes are a small rover's; a larger one's forces and torques are larger."""
        return effect_size(c, self._usual, self.settings)

    def measuring(self, value: np.ndarray, start: np.ndarray) -> DriveForm:
        """A form of this model against other measurements.

        Args:
          value: (n,) what is measured instead, in SI units. start: (coordinates,) where its refits begin.
        """
        drives = copy.copy(self.drives)
        drives.observations = dataclasses.replace(drives.observations, value=value)
        drives.noise_unlearnt = False
        other = DriveForm(drives, self.settings)
        other.start = start
        return other

    def learnt(self, refit: Refit) -> dict[str, Any]:
        """Log evidence of a refit, and the errors beside the noise that it was found with.

        The evidence is that of the fitted measurements in their units, so that runs with other settings compare.

        Args:
          refit: of this form.

        Returns:
          `log_evidence`; `channel_errors`, shares of what a channel does, and `error_times_s`, how long these last, by
          channel.
        """
        value = refit.linear.evidence(self.listed(refit.effects))[0]
        return {
            "log_evidence": value,
            "channel_errors": dict(self.errors.by_channel),
            "error_times_s": dict(self.errors.times_s),
        }

    def limit(self, until: float) -> None:
        """See `MeasuredForm`."""
        self.drives.bench.deadline.until = until

    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> Refit:
        """See `Form`; Levenberg-Marquardt under the covariance of noise and discrepancy.

        It begins at `near`, with the effects that this is without where they act, or where a race has brought them; at
        the start only where there is no such refit, since a linear estimate may be absurd from afar.

        Raises:
          TimeUp: before the refit had ended; that of the model as it is counts from wherever it has come.
        """
        if self._refits.base is not None:
            u, linear = self._refits.refit(effects, near, start)
        elif effects:
            raise EvidenceError("the model as it is has not been refitted")
        else:
            u, linear = self._first_refit()
        return Refit(self.name, effects, u, linear)

    def promising(self, refit: Refit) -> Mapping[str, float]:
        """See `Form`: by a race of all that may be missing beside a refit."""
        return self._refits.race(refit)

    def under_errors_of(self, refit: Refit, other: Refit) -> Linear:
        """See `MeasuredForm`: each set of effects has found errors of its own."""
        return self._refits.under_errors_of(refit, other)

    def _first_refit(self) -> tuple[np.ndarray, Linear]:
        """Where (coordinates,) the model as it is ends, and what hypotheses need there; its errors are learnt."""
        beside = None if self._rival_of is None else self._rival_of.for_rival()
        try:
            base = self._own.refit(self.start, self.kept, beside)
        finally:
            # what was learnt before the time was up holds, too
            self.observations, self.skipped = self._errors.observations, self._signatures.skipped
            self.kept = self.kept if self._errors.channels_held else {}
        return self._refits.begin(base)

    def for_rival(self) -> Beside:
        """Where the model as it is has been refitted, for a rival that is weighed with the same errors."""
        base = self._refits.base
        u, sizes = (self.origin(), None) if base is None else (base.u, base.sizes)
        return Beside(self.drives, u, sizes, self.errors)

    def alone(self, refit: Refit) -> np.ndarray:
        """See `MeasuredForm`; from the refit's parameters and from those as given."""
        return self._refits.alone(refit)
