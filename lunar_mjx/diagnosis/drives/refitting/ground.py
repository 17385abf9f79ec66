"""Ground of held-out drives: mapped by their pose, for it is none of what is fitted."""

from __future__ import annotations

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.design import Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.fields import GROUND, Sizes
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import POSE


class HeldOutGround:
    """Ground of held-out drives, by a linear model of their pose."""

    def __init__(self, drives: DriveProblem, design: Design, prior: Prior, errors: ErrorModel):
        """Makes it.

        Args:
          drives: simulation. design: derivatives by that ground. prior: of what moves. errors: of the readings.
        """
        self._drives, self._design, self._prior, self._errors = drives, design, prior, errors

    def mapped(
        self, u: np.ndarray, there: np.ndarray, slopes: np.ndarray, free: np.ndarray, sizes: Sizes
    ) -> np.ndarray:
        """A place (coordinates,) with the most probable ground of held-out drives by a linear model of their pose.

        Their ground is mapped, not fitted: nothing counts but pose, and nothing else that drives share moves by it.

        Args:
          u: the place. there: (coordinates,) where the derivatives are from. slopes: (n, free) these, by the
            coordinates `free`. sizes: of discrepancy and noise there.
        """
        places, observations = self._prior.places, self._errors.observations
        coordinates, ground = places.coordinates, places.other_ground
        if not len(ground):
            return u
        pose = np.zeros(len(observations), bool)
        for s in observations.series:
            pose[s.start : s.stop] = s.channel in POSE
        rows = pose & ~self._errors.fit
        logs = {coordinates[i].log_index for i in ground}
        # where such a drive began is uncertain, too
        own = np.flatnonzero([coordinates[i].log_index in logs for i in free])
        own = own[self._prior.field_of[free[own]] < 0]
        residual = observations.whiten(observations.value - self._drives.predict(there[None])[0])
        columns = observations.whiten(np.column_stack([slopes[:, own], self._design.seen[:, ground]]))
        # a held-out drive whose simulation diverges there tells nothing of its ground
        rows &= np.isfinite(residual)
        which = np.concatenate([free[own], ground])
        tau, noise = sizes
        roughness = np.full(len(ground), tau[self._prior.fields.number[GROUND]])
        std = np.concatenate([self._prior.std[free[own]], roughness])
        weight = 1.0 / noise[self._errors.group[rows]]
        columns, residual = columns[rows] * weight[:, None], residual[rows] * weight
        centre = places.centres(which) - there[which]
        normal = columns.T @ columns + np.diag(std**-2)
        step = np.linalg.solve(normal, columns.T @ residual + centre / std**2)
        low, high = self._drives.bounds(ground)
        out = u.copy()
        out[ground] = np.clip(there[ground] + step[len(own) :], low, high)
        return out
