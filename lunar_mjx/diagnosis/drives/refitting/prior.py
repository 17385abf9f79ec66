"""Everything that may move in drives: what each coordinate belongs to, and how far it is expected from where."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping

import numpy as np

from lunar_mjx.diagnosis.drives.baseline import FROM_NOTHING
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.fields import GROUND, Fields, Share
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS
from lunar_mjx.diagnosis.unknown_inputs.port_fields import Usual
from lunar_mjx.inference.coordinates import Coordinate


@dataclasses.dataclass(frozen=True, eq=False)
class Places:
    """Places among all coordinates, by what they belong to.

    Attributes:
      coordinates: all of them. baseline: of the model as it is. candidates: by effect that may be missing.
      discrepancy: of the mean over the fitted logs. own_ground: of ground of fitted logs that nobody mapped, which
        refits move. other_ground: of that of held-out ones, which is mapped by their pose alone.
    """

    coordinates: tuple[Coordinate, ...]
    baseline: np.ndarray
    candidates: Mapping[str, np.ndarray]
    discrepancy: np.ndarray
    own_ground: np.ndarray
    other_ground: np.ndarray

    @classmethod
    def of(cls, drives: DriveProblem, fitted: Mapping[int, bool]) -> Places:
        """Those of drives, each of which is fitted or held out, by the number of its log."""
        discrepancy = np.concatenate([np.zeros(0, int), *drives.inputs.values()])
        own = np.array([fitted.get(drives.coordinates[i].log_index, False) for i in drives.ground], bool)
        return cls(
            drives.coordinates,
            drives.baseline,
            dict(drives.candidates),
            discrepancy,
            drives.ground[own],
            drives.ground[~own],
        )

    def free(self, effects: frozenset[str] = frozenset()) -> np.ndarray:
        """Places of all that a refit with some effects moves: of the model, of unmapped ground, of common discrepancy,
        and of the effects."""
        own = [places for name, places in self.candidates.items() if name in effects]
        return np.concatenate([self.baseline, self.own_ground, self.discrepancy, *own])

    def effects(self, free: np.ndarray) -> frozenset[str]:
        """Effects that a refit has that moves some coordinates."""
        return frozenset(e for e, own in self.candidates.items() if own[0] in free)

    def amplitudes(self, effects: Iterable[str]) -> np.ndarray:
        """Places of the amplitudes of some effects, without their shapes."""
        return np.array([i for e in effects for i in self.candidates[e] if self.coordinates[i].amplitude], int)

    def inputs(self, free: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(n, discrepancy) derivatives by discrepancy among those (n, free) of some coordinates."""
        return slopes[:, np.isin(free, self.discrepancy)]

    def centres(self, which: np.ndarray) -> np.ndarray:
        """(which,) centres of the priors of some coordinates."""
        return np.array([self.coordinates[i].centre for i in which])

    def origin(self) -> np.ndarray:
        """(coordinates,) the model as given."""
        return np.zeros(len(self.coordinates))

    def bare(self, u: np.ndarray) -> np.ndarray:
        """A place (coordinates,) without its discrepancy: what the model itself predicts there."""
        out = u.copy()
        out[self.discrepancy] = 0.0
        return out


@dataclasses.dataclass(frozen=True, eq=False)
class Prior:
    """The normal prior of everything that may move in drives.

    Attributes:
      places: of coordinates. fields: of discrepancy. share: how logs share it.
      std: (coordinates,) standard deviations, in scales; those of discrepancy and ground at size 1.
      field_of: (coordinates,) field that a coordinate belongs to, of discrepancy the common part, or -1.
      whole_size: (discrepancy,) standard deviations of a log's amounts at size 1: what logs share and what each has for
        itself.
    """

    places: Places
    fields: Fields
    share: Share
    std: np.ndarray
    field_of: np.ndarray
    whole_size: np.ndarray

    @classmethod
    def of(cls, places: Places, inputs: Mapping[str, np.ndarray], fields: Fields, share: Share, usual: Usual) -> Prior:
        """Of drives.

        Args:
          places: of coordinates. inputs: those of discrepancy by the label of their field.
          fields, share: see the class. usual: amounts on the rover.
        """
        coordinates, discrepancy = places.coordinates, places.discrepancy
        field_of = np.full(len(coordinates), -1)
        field_of[discrepancy] = np.repeat(np.arange(len(inputs)), [len(own) for own in inputs.values()])
        if fields.unmapped:
            field_of[places.own_ground] = fields.number[GROUND]
        # shapes of candidates keep their own
        std = np.array([c.prior for c in coordinates])
        for i in places.amplitudes(places.candidates):
            std[i] = effect_size(coordinates[i], usual, fields.settings)
        sizes = np.array([usual.size(label, q) for label in inputs for q in FOLLOWS[label]])
        whole_size = sizes / np.array([coordinates[i].scale for i in discrepancy])
        std[discrepancy] = math.sqrt(share.mean) * whole_size
        return cls(places, fields, share, std, field_of, whole_size)

    def sized(self, tau: np.ndarray) -> np.ndarray:
        """(coordinates,) prior standard deviations where discrepancy has sizes (fields,)."""
        return np.where(self.field_of < 0, self.std, self.std * tau[self.field_of])

    def mean(self, u: np.ndarray, count: int) -> np.ndarray:
        """(coordinates + m,) prior mean of all that a design has columns of, relative to a place.

        Args:
          u: the place. count: m; the last of these are of the ground of held-out drives, which has been moved to there.
        """
        fields, ground = np.zeros(count), self.places.other_ground
        fields[count - len(ground) :] = -u[ground]
        return np.concatenate([[c.centre for c in self.places.coordinates] - u, fields])

    def as_given(self) -> np.ndarray:
        """(coordinates,) where refits begin: the model as given, and parameters of `FROM_NOTHING` at half their prior.

        At zero such a parameter has next to no slope while the other constants of contact move first, and a descent
        that begins there may leave it there.
        """
        start = self.places.origin()
        for i in self.places.baseline:
            c = self.places.coordinates[i]
            if c.name in FROM_NOTHING.get(c.effect, {}) and c.start == 0.0:
                start[i] = DRIVE_REFIT.nothing_start * self.std[i]
        return start


def effect_size(c: Coordinate, usual: Usual, settings: DriveSettings) -> float:
    """Prior standard deviation of an effect's amplitude, in scales: nominal sizes are a small rover's; a larger one's
    forces and torques are larger."""
    return settings.effect_size * max(1.0, usual.amounts.get(c.unit, 0.0) / abs(c.scale))
