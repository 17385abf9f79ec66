"""The design matrix of drives: derivatives by all that hypotheses hold, around a place of the model."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.fields import GROUND, USUAL_EFFECTS
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.unknown_inputs.port_fields import rotation
from lunar_mjx.inference.evidence import Amplitudes


@dataclasses.dataclass(frozen=True, eq=False)
class Columns:
    """Derivatives (n, k) by all that hypotheses hold, and residuals (n,), SI units, around a place.

    Attributes:
      derivatives, residual: these; first the columns of coordinates.
      prior: (k,) of their amounts, relative to the place, at size 1. field: (m,) of each of the last columns.
    """

    derivatives: np.ndarray
    residual: np.ndarray
    prior: Amplitudes
    field: np.ndarray


class Design:
    """Columns of drives' design matrix.

    Attributes:
      seen: (n, coordinates) derivatives at the base, in the channels' units; zero where nobody has looked yet.
    """

    def __init__(self, drives: DriveProblem, prior: Prior, errors: ErrorModel, settings: DriveSettings):
        """Makes it without derivatives.

        Args:
          drives: simulation. prior: of what moves. errors: of the readings. settings: least length of a column.
        """
        self._drives, self._prior, self._errors, self._settings = drives, prior, errors, settings
        self.seen = np.zeros((len(errors.observations), len(prior.places.coordinates)))

    def columns(
        self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, effects: frozenset[str] = frozenset()
    ) -> Columns:
        """Derivatives by all that hypotheses hold, and residuals, around a place (coordinates,).

        Args:
          u: the place. free: coordinates, discrepancy among them, whose derivatives (n, free) there are the `slopes`;
            others keep signatures. effects: of a refit.
        """
        prior, places, errors = self._prior, self._prior.places, self._errors
        seen = self.seen.copy()
        seen[:, free] = slopes
        residual = errors.observations.value - self._drives.predict(u[None])[0]
        # Of a mean over other logs a held-out one is expected to have a share alone.
        held_out, inputs, known = ~errors.fit, places.inputs(free, slopes), prior.share.known
        residual[held_out] += (1.0 - known) * inputs[held_out] @ u[places.discrepancy]
        seen[np.ix_(held_out, places.discrepancy)] *= known
        columns, field = self.fields(inputs, effects)
        ground = places.other_ground
        field = np.concatenate([field, np.full(len(ground), prior.fields.number.get(GROUND, -1))])
        std = np.concatenate([prior.std, np.ones(len(field))])
        # Amplitudes are counted from the place: the prior's centre lies at its distance from there.
        amplitudes = Amplitudes(std, np.concatenate([prior.field_of, field]), prior.mean(u, len(field)))
        return Columns(np.column_stack([seen, columns, self.seen[:, ground]]), residual, amplitudes, field)

    def fields(self, inputs: np.ndarray, but: frozenset[str] = frozenset()) -> tuple[np.ndarray, np.ndarray]:
        """Columns (n, m) of all fields at size 1, SI units, and the field (m,) of each: of every log for itself.

        They are turned so that few are left which the observations' noise does not hide. The mean over the fitted logs
        is a coordinate, which a refit moves: a linear estimate of it would hold for no more than a per cent or two.

        Args:
          inputs: (n, discrepancy) derivatives there.
          but: effects that are no part of what is usual: where an effect has its own refit, the difference of its
            derivatives here and there would be one more freedom, which no other hypothesis has.
        """
        observations, settings, prior = self._errors.observations, self._settings, self._prior
        places, share = prior.places, prior.share
        columns, field = [np.zeros((len(observations), 0))], [np.zeros(0, int)]
        # (n, amounts) what each log has of every amount beside the mean: rows of a log are alike
        apart = np.zeros((len(observations), share.apart.shape[1]))
        for part, own in zip(observations.of_log.values(), share.apart, strict=True):
            apart[part] = own
        for k in range(len(prior.fields.ports)):
            own = prior.field_of[places.discrepancy] == k
            mine = inputs[:, own] * prior.whole_size[own]
            whole = (apart[:, :, None] * mine[:, None, :]).reshape(len(mine), -1)
            turned = whole @ rotation(observations.whiten(whole), settings.least_length / settings.unlisted_discrepancy)
            columns.append(turned)
            field.append(np.full(turned.shape[1], k))
        small = places.amplitudes(e for e in places.candidates if e not in but)
        whole = self.seen[:, small] * prior.std[small]
        turned = whole @ rotation(observations.whiten(whole), settings.least_length / settings.usual_effect)
        columns.append(turned)
        field.append(np.full(turned.shape[1], prior.fields.number[USUAL_EFFECTS]))
        return np.column_stack(columns), np.concatenate(field)

    def of_the_model(self, columns: Columns, free: np.ndarray) -> tuple[np.ndarray, Amplitudes]:
        """Columns (n, k) of the model as it is and of what is usual, and the prior (k,) of their amounts.

        Args:
          columns: of all. free: coordinates of the model.
        """
        ground, (_, width) = len(self._prior.places.other_ground), columns.derivatives.shape
        # ground of held-out drives, whose columns are the last, does nothing to the fitted ones
        always = np.concatenate([free, np.arange(width - len(columns.field), width - ground)])
        return columns.derivatives[:, always], columns.prior.select(always)
