"""Fields of discrepancy of drives: how large each is by its prior, and how it hangs together between logs."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import Field

USUAL_EFFECTS = "effects of usual size"
"""The field of all effects that no hypothesis names: every rover has a little of each."""
GROUND = "height of the ground"
"""The field of ground that nobody mapped, in wheel radii."""

Sizes = tuple[np.ndarray, np.ndarray]
"""Sizes of discrepancy (fields,) and of noise (groups,)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Fields:
    """What is usual: discrepancy at every port, a little of every effect, and ground that nobody mapped.

    Attributes:
      ports: fields of discrepancy at ports, by label. unmapped: whether drives lead over ground that nobody mapped.
      settings: usual sizes.
    """

    ports: tuple[str, ...]
    unmapped: bool
    settings: DriveSettings

    def priors(self, bounded: bool = False) -> tuple[Field, ...]:
        """Every field with the prior of its size.

        Args:
          bounded: whether sizes are the usual ones at most, but for that of ground.
        """
        ports = [Field(label, self.settings.usual_discrepancy, bounded=bounded) for label in self.ports]
        ground = [Field(GROUND, self.settings.usual_ground)] if self.unmapped else []
        return *ports, Field(USUAL_EFFECTS, self.settings.usual_effect, bounded=bounded), *ground

    @functools.cached_property
    def number(self) -> Mapping[str, int]:
        """Place of each field among all, by name."""
        return {f.name: k for k, f in enumerate(self.priors())}

    @property
    def usual(self) -> np.ndarray:
        """(fields,) usual sizes."""
        return np.array([f.usual for f in self.priors()])

    def led_by(self, sizes: Sizes) -> Sizes:
        """Sizes of discrepancy (fields,) and of noise (groups,) with which a descent is led, of those that were found.

        Those of discrepancy are no larger than usual: found where a descent stands, they are as large as what it has
        not reached yet, and from then on nothing speaks against that. Ground alone is as rough as it is.
        """
        tau = np.minimum(sizes[0], self.usual)
        if self.unmapped:
            tau[self.number[GROUND]] = sizes[0][self.number[GROUND]]
        return tau, sizes[1]


@dataclasses.dataclass(frozen=True, eq=False)
class Share:
    """How the amounts of discrepancy in several logs hang together, in variances over those of a log's amount.

    A log's amount is one that all logs share and one of its own. The mean over the fitted logs is what a refit moves:
    were it the shared amount alone, equal own amounts would stand for part of a mean, and to first order.

    Attributes:
      mean: variance of the mean over the fitted logs. known: what a held-out log is expected to have, over that mean.
      apart: (logs, amounts) what independent amounts of unit variance give to each log beside that.
    """

    mean: float
    known: float
    apart: np.ndarray

    @classmethod
    def of(cls, own: float, fitted: Sequence[bool]) -> Share:
        """Of logs that are fitted or held out, where a share of the variance is each log's own."""
        fit, held_out = np.flatnonzero(fitted), np.flatnonzero(~np.array(fitted))
        mean = 1.0 - own + own / len(fit)
        known = (1.0 - own) / mean
        apart = np.zeros((len(fitted), len(fit) - 1 + len(held_out) + 1))
        # contrasts of the fitted logs: an orthonormal basis of what has no mean
        apart[fit, : len(fit) - 1] = math.sqrt(own) * linalg.helmert(len(fit)).T
        apart[held_out, len(fit) - 1 + np.arange(len(held_out))] = math.sqrt(own)
        # what these logs share and the mean does not tell
        apart[held_out, -1] = math.sqrt((1.0 - own) * (1.0 - known))
        return cls(mean, known, apart)
