"""What hypotheses need of drives around a refit: the design as Gram matrices, its priors and its bounds."""

from __future__ import annotations

import numpy as np

from lunar_mjx.diagnosis.drives.instruments import usual_kind
from lunar_mjx.diagnosis.drives.refitting.design import Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.weighed.form import amplitude_columns
from lunar_mjx.inference.evidence import Gram
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.weighing.hypotheses import Linear


class Linearised:
    """A form of drives, linear around any place."""

    def __init__(self, prior: Prior, errors: ErrorModel, design: Design, settings: DriveSettings):
        """Makes it.

        Args:
          prior: of what moves. errors: of the readings. design: derivatives. settings: sizes and priors.
        """
        self._prior, self._errors, self._design, self._settings = prior, errors, design, settings
        kinds = [usual_kind(c) for c in prior.places.coordinates]
        self._instruments = {k: np.flatnonzero([kind == k for kind in kinds]) for k in dict.fromkeys(kinds) if k}

    def around(
        self, u: np.ndarray, effects: frozenset[str], slopes: np.ndarray, without: frozenset[str] = frozenset()
    ) -> Linear:
        """Everything that hypotheses need around a place (coordinates,) with some effects.

        Args:
          u: the place. effects: those of the refit. slopes: (n, free) derivatives there.
          without: effects of which there is not even the little that is usual.
        """
        places, errors, settings = self._prior.places, self._errors, self._settings
        observations, count = errors.observations, len(places.coordinates)
        design = self._design.columns(u, places.free(effects), slopes, effects | without)
        columns, residual = observations.whiten(design.derivatives), observations.whiten(design.residual)
        width = len(design.prior.std)
        low, high = np.full(width, -np.inf), np.full(width, np.inf)
        # Where the step's error or a reading before its command would have to be more than all there is, the model is
        # not that much better: linear estimates had gone beyond (on a foreign campaign of a Husky clock_offset promised
        # 87 nats so, and its refit gained none).
        bounded = np.concatenate([places.baseline, places.amplitudes(places.candidates)]).astype(int)
        low[bounded], high[bounded] = np.array([places.coordinates[i].bounds() for i in bounded]).T - u[bounded]
        at = np.zeros(width)
        for own in places.candidates.values():
            at[own] = u[own]
        kinds, fit = len(errors.noises), errors.fit
        held, scale = {}, {}
        for name, rows in held_out_pieces(observations, settings.held_out_piece).items():
            held[name] = Gram.of(columns[rows], residual[rows], errors.group[rows], kinds)
            scale[name] = errors.log_scale(rows)
        return Linear(
            gram=Gram.of(columns[fit], residual[fit], errors.group[fit], kinds),
            held_out=held,
            amplitudes=design.prior,
            low=low,
            high=high,
            always=np.concatenate([places.free(), np.arange(count, width)]).astype(int),
            effects=places.candidates,
            at=at,
            calibration=self._instruments,
            following={},
            fields=self._prior.fields.priors(),
            noises=errors.noises,
            wide=settings.unlisted_discrepancy,
            far=1.0,
            amount=amplitude_columns(places.coordinates, width),
            freedom=settings.effect_freedom,
            log_scale=errors.log_scale(),
            held_out_scale=scale,
        )


def held_out_pieces(observations: Observations, seconds: float) -> dict[str, np.ndarray]:
    """Places of the observations of each piece of held-out drives, by a name such as "climb from 2 s".

    A campaign holds out one drive or two: too few to tell what a name gains there from chance.

    Args:
      observations: of drives. seconds: length of a piece.
    """
    found: dict[str, list[np.ndarray]] = {}
    for s in observations.series:
        assert s.time is not None
        rows = np.arange(s.start, s.stop)
        number = observations.unit[rows]
        since = s.time - s.time[0]
        # what is left over belongs to the last piece: a sample or two are no witness
        last = max(round(float(since[-1]) / seconds), 1) - 1
        piece = np.minimum(np.floor(since / seconds + DRIVE_REFIT.on_time), last)
        for unit, at in np.unique(np.stack([number, piece]), axis=1).T:
            if observations.unit_split[int(unit)] in ("select", "test"):
                name = f"{observations.unit_names[int(unit)]} from {at * seconds:g} s"
                found.setdefault(name, []).append(rows[(number == unit) & (piece == at)])
    return {name: np.concatenate(parts) for name, parts in found.items()}
