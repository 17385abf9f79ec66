"""Descents of drives: Levenberg-Marquardt within bounds, under the covariance of noise and discrepancy."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.nuisances import is_linear
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.derivatives import Derivatives
from lunar_mjx.diagnosis.drives.refitting.design import Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.fields import Sizes
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.refitting.steps import bounded_step, promise_left, promised
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.weighed.form import students_std
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.observations import Observations


@dataclasses.dataclass(frozen=True, eq=False)
class Cost:
    """Chi-square under the covariance of noise and discrepancy, and of the prior.

    Attributes:
      observations, fit: which of them count. weight: (fitted,).
      misfit: (fitted, m) whitened discrepancy at its sizes; factor: of the identity and its products.
      std, centre: (free,) of the prior.
    """

    observations: Observations
    fit: np.ndarray
    weight: np.ndarray
    misfit: np.ndarray
    factor: tuple[np.ndarray, bool]
    std: np.ndarray
    centre: np.ndarray

    def white(self, columns: np.ndarray) -> np.ndarray:
        """(fitted, ...) whitened columns or residual (n, ...)."""
        found = self.observations.whiten(columns)[self.fit]
        return found * (self.weight if found.ndim == 1 else self.weight[:, None])

    def inner(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Products of whitened columns under the covariance of noise and discrepancy."""
        # Woodbury's identity: the covariance of the data is as large as they are, and is never made. It is applied to
        # what is narrower, which saves most of the work where that is a residual.
        return a.T @ self.left(b)

    def left(self, residual: np.ndarray) -> np.ndarray:
        """What discrepancy of the most probable amounts leaves of a whitened residual (fitted, ...)."""
        return residual - self.misfit @ linalg.cho_solve(self.factor, self.misfit.T @ residual)

    def chi2(self, residual: np.ndarray, x: np.ndarray) -> float:
        """Of a whitened residual (fitted,) at a place (free,); infinite where the simulation diverged."""
        if not np.isfinite(residual).all():
            return np.inf
        return float(self.inner(residual, residual)) + float(np.sum(((x - self.centre) / self.std) ** 2))

    def normal(self, jacobian: np.ndarray) -> np.ndarray:
        """(free, free) matrix of the normal equations of whitened derivatives (fitted, free)."""
        return self.inner(jacobian, jacobian) + np.diag(self.std**-2)

    def downhill(self, jacobian: np.ndarray, residual: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(free,) half the negative gradient, by whitened derivatives and residual (fitted, ...) at a place (free,)."""
        return self.inner(jacobian, residual) - (x - self.centre) / self.std**2


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """Where steps with one Jacobian lead (coordinates,), what they have gained of a cost, and with which damping to go
    on."""

    u: np.ndarray
    gained: float
    damping: float


class Descent:
    """What a form of drives does to lower its cost."""

    def __init__(
        self,
        drives: DriveProblem,
        derivatives: Derivatives,
        design: Design,
        prior: Prior,
        errors: ErrorModel,
        settings: DriveSettings,
    ):
        """Makes it.

        Args:
          drives: simulation. derivatives: of its predictions. design: columns of discrepancy. prior: of what moves.
          errors: of the readings. settings: effort.
        """
        self._drives, self._derivatives, self._design = drives, derivatives, design
        self._prior, self._errors, self._settings = prior, errors, settings

    def cost(self, u: np.ndarray, free: np.ndarray, sizes: Sizes | None, inputs: np.ndarray | None = None) -> Cost:
        """What a descent from a place minimises.

        Args:
          u, free, sizes: as for `descend`.
          inputs: (n, discrepancy) derivatives; None where logs have no discrepancy of their own.
        """
        errors, places = self._errors, self._prior.places
        observations, fit = errors.observations, errors.fit
        noise = errors.stated_noise if sizes is None else sizes[1]
        weight = 1.0 / noise[errors.group[fit]]
        misfit = np.zeros((len(weight), 0))
        if sizes is not None and inputs is not None:
            columns, field = self._design.fields(inputs, places.effects(free))
            misfit = observations.whiten(columns)[fit] * sizes[0][field] * weight[:, None]
        std = self._prior.std if sizes is None else self._prior.sized(sizes[0])
        std = students_std(places.coordinates, places.candidates, u, std, self._settings.effect_freedom)
        factor = linalg.cho_factor(np.eye(misfit.shape[1]) + misfit.T @ misfit, lower=True)
        return Cost(observations, fit, weight, misfit, factor, std[free], places.centres(free))

    def descend(
        self,
        u: np.ndarray,
        free: np.ndarray,
        sizes: Sizes | None = None,
        inputs: np.ndarray | None = None,
        slopes: np.ndarray | None = None,
        guessed: bool = False,
        once: bool = False,
        whole: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The most probable coordinates at given sizes of discrepancy and noise, and the derivatives near them.

        Args:
          u: (coordinates,) where from. free: places of what moves.
          sizes: None for noise alone. inputs: (n, discrepancy) derivatives by which logs have discrepancy of their own.
          slopes: (n, free) derivatives, if known. guessed: whether these are to be taken anew before the end.
          once: whether no others than these are taken. whole: whether a descent that the time cuts short is none.

        Raises:
          EvidenceError: the simulation diverged at the start.
          TimeUp: before the descent had begun, or had ended where it has to be `whole`.
        """
        if slopes is None:
            slopes = self._derivatives.jacobian(u, free)[1]
        settings, damping = self._settings, DRIVE_REFIT.damping
        cost = self.cost(u, free, sizes, inputs)
        settled = settings.settled
        if once:
            settled = max(settled, DRIVE_REFIT.visible * cost.chi2(self._left(cost, u), u[free]))
        try:
            for _ in range(settings.most_jacobians):
                there = self.step(cost, u, free, slopes, damping, settled)
                # slopes that are new earn new trust
                u, damping = there.u, min(there.damping, DRIVE_REFIT.renewed_damping)
                if once or (not guessed and there.gained < settings.settled):
                    break
                slopes, guessed = self._renewed(u, free, slopes), False
        except TimeUp:
            if whole:
                raise
        return u, slopes

    def step(
        self, cost: Cost, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, damping: float, settled: float
    ) -> Step:
        """Steps with one Jacobian, as long as they gain and it promises more: Levenberg-Marquardt with bounds.

        Args:
          cost: what they lower. u, free, slopes: as for `descend`. damping: of the first one.
          settled: decrease of the cost that a step must promise.

        Raises:
          EvidenceError: the simulation diverged at the start.
        """
        low, high = self._drives.bounds(free)
        residual, tried = self._left(cost, u), np.array(DRIVE_REFIT.tried[: self._drives.together])
        if not np.isfinite(residual).all():
            raise EvidenceError("a rover's simulation diverged")
        first = present = cost.chi2(residual, u[free])
        jacobian = cost.white(slopes)
        normal = cost.normal(jacobian)
        while True:
            downhill = cost.downhill(jacobian, residual, u[free])
            dampings, shares = damping * tried[:, 0], tried[:, 1]
            near, far = within_box(self._prior, free, u[free], low, high, self._settings.longest_step)
            steps = [
                share * bounded_step(normal + np.diag(d * np.diag(normal)), downhill, u[free], near, far)
                for d, share in zip(dampings, shares, strict=True)
            ]
            # There is nothing left to gain where these slopes hold. (The least damped step need not promise most: in a
            # box it may even lead uphill, as what it holds at a wall is never let go.)
            if max(promised(s, normal, downhill) for s in steps) < settled:
                break
            rows = np.repeat(u[None], len(tried), axis=0)
            rows[:, free] = np.clip(u[free] + steps, low, high)
            residuals = self._lefts(cost, rows)
            reached = [cost.chi2(r, row[free]) for r, row in zip(residuals, rows, strict=True)]
            best = int(np.argmin(reached))
            gained = present - reached[best]
            if not gained > 0.0:
                damping *= DRIVE_REFIT.stiffer
                continue
            damping = max(DRIVE_REFIT.softer * dampings[best], DRIVE_REFIT.damping)
            u, residual, present = rows[best], residuals[best], reached[best]
            # What gains a tenth of what these slopes have gained so far gains more with new ones, which take as long as
            # five steps.
            if gained < max(settled, DRIVE_REFIT.tiring * (first - present)):
                break
        return Step(u, first - present, damping)

    def promise(self, cost: Cost, u: np.ndarray, free: np.ndarray, slopes: np.ndarray) -> float:
        """Decrease of a cost that slopes still promise at a place; as for `descend`."""
        jacobian = cost.white(slopes)
        downhill = cost.downhill(jacobian, self._left(cost, u), u[free])
        return promise_left(cost.normal(jacobian), downhill, u[free], *self._drives.bounds(free))

    def least(self, cost: Cost, rows: np.ndarray, free: np.ndarray) -> np.ndarray:
        """(coordinates,) of some places (m, coordinates) the one of least cost; see `cost`."""
        reached = [cost.chi2(r, row[free]) for r, row in zip(self._lefts(cost, rows), rows, strict=True)]
        return rows[int(np.argmin(reached))]

    def _renewed(self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(n, free) derivatives at a place, of which those by ground are the ones that are known.

        Ground is a third of what moves, and bends little: from one Jacobian of a campaign of LUVMI-X to the next its
        columns changed by 5 %, and those of inputs by 40 %.
        """
        new, moved = slopes.copy(), ~np.isin(free, self._prior.places.own_ground)
        new[:, moved] = self._derivatives.jacobian(u, free[moved])[1]
        return new

    def _left(self, cost: Cost, u: np.ndarray) -> np.ndarray:
        """(fitted,) whitened residual at a place (coordinates,)."""
        return self._lefts(cost, u[None])[0]

    def _lefts(self, cost: Cost, rows: np.ndarray) -> list[np.ndarray]:
        """Whitened residual (fitted,) at each of some places (m, coordinates)."""
        return [cost.white(self._errors.observations.value - v) for v in self._drives.predict(rows)]


def within_box(
    prior: Prior, free: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray, longest: float
) -> tuple[np.ndarray, np.ndarray]:
    """Bounds (free,), (free,) of a step by one Jacobian: those of the coordinates, and a box about the place.

    Slopes of instruments hold however far they move, and scales of inputs are another rover's. The others have a box:
    were the whole step shortened until the longest of them fits, one that does almost nothing, and so has far to go,
    would hold back all.

    Args:
      prior: of what moves. free: coordinates. x: (free,) the place. low, high: (free,) bounds of the coordinates.
      longest: half the box, in scales.
    """
    linear = np.array([is_linear(prior.places.coordinates[i]) for i in free], bool)
    scaled = (prior.field_of[free] < 0) & ~linear
    return np.where(scaled, np.maximum(low, x - longest), low), np.where(scaled, np.minimum(high, x + longest), high)
