"""Signatures: what each candidate does to the readings of drives, by its derivative or over a usual amount of it."""

from __future__ import annotations

import concurrent.futures
import math

import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.differences import STEP
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.derivatives import Derivatives
from lunar_mjx.diagnosis.drives.refitting.design import Columns, Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel
from lunar_mjx.diagnosis.drives.refitting.fields import Sizes
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.simulation.program import cores
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.fitting import Progress


class Signatures:
    """Derivatives at the base, taken into a design matrix.

    Attributes:
      secants: (n, coordinates) changes by a usual amount at the refit of the model as it is, over that amount.
      skipped: candidates for which the time did not suffice: they have no signature.
    """

    def __init__(
        self,
        drives: DriveProblem,
        derivatives: Derivatives,
        design: Design,
        prior: Prior,
        errors: ErrorModel,
        settings: DriveSettings,
        progress: Progress,
    ):
        """Makes them, as yet without any.

        Args:
          drives: simulation. derivatives: of its predictions. design: what they are taken into.
          prior: of what moves. errors: of the readings. settings: amount of a secant. progress: told of signatures.
        """
        self._drives, self._derivatives, self._design = drives, derivatives, design
        self._prior, self._errors, self._settings, self._progress = prior, errors, settings, progress
        self.secants = np.zeros_like(design.seen)
        self.skipped: tuple[str, ...] = ()

    @property
    def parts(self) -> list[list[str]]:
        """Candidates whose signatures are simulated by one program each."""
        names = list(self._prior.places.candidates)
        return [names[at : at + DRIVE_REFIT.together] for at in range(0, len(names), DRIVE_REFIT.together)]

    def look(self, u: np.ndarray, free: np.ndarray) -> np.ndarray:
        """(n, free) derivatives at a place (coordinates,), about which instruments' errors are linear from now on.

        They become signatures, with those of the ground of held-out drives.
        """
        self._drives.about(u)
        which = np.concatenate([free, self._prior.places.other_ground])
        slopes = self._derivatives.jacobian(u, which)[1]
        self._design.seen[:, which] = slopes
        return slopes[:, : len(free)]

    def see(self, u: np.ndarray) -> None:
        """Takes the signatures of all candidates at a refit of the model as it is, which has been looked at.

        Candidates for which the time does not suffice are `skipped`: they have no signature.
        """
        seen, secants = self._design.seen, np.zeros_like(self._design.seen)

        def take(part: list[str]) -> tuple[str, ...]:
            """Fills in the signatures of some candidates; those are returned for which there was no time."""
            amplitudes = self._prior.places.amplitudes(part)
            far = np.array([self._secant(i) for i in amplitudes])
            steps = np.concatenate([np.copysign(STEP, far), far])
            try:
                quotients = self._derivatives.changes(u, np.tile(amplitudes, 2), steps) / steps
            except TimeUp:
                return tuple(part)
            seen[:, amplitudes], secants[:, amplitudes] = self._tamed(amplitudes, *np.split(quotients, 2, axis=1))
            self._progress("signatures of all candidates", math.nan)
            return ()

        # one program is made while another runs: the first takes Python's lock, and the second a core
        with concurrent.futures.ThreadPoolExecutor(min(cores(), DRIVE_REFIT.most_at_once)) as pool:
            self.skipped = tuple(name for late in pool.map(take, self.parts) for name in late)
        self.secants = secants

    def _tamed(self, which: np.ndarray, slopes: np.ndarray, secants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, m) and secants (n, m) of candidates, where either tells nothing the other in its place.

        A jump of a hundredth of a sigma within a step is no slope (see `Derivatives.jacobian`), and an effect such as a
        delay does nothing within a time step.
        """
        reach = self._prior.std[which] / self._errors.observations.sigma()[:, None]
        jumps = (np.abs(slopes) * reach > DRIVE_REFIT.steep) & (np.abs(slopes) > np.abs(secants))
        slopes = np.where(jumps, secants, slopes)
        sizes = [np.linalg.norm(q * reach, axis=0) for q in (slopes, secants)]
        slopes = np.where(sizes[0] < DRIVE_REFIT.dead * sizes[1], secants, slopes)
        return slopes, np.where(sizes[1] > 0.0, secants, slopes)

    def choose(self, columns: Columns, sizes: Sizes) -> None:
        """Takes of each candidate's derivative and secant the one that explains more of what the model leaves.

        Where wheels stick and slip a usual amount may lead elsewhere than its beginning. On two foreign campaigns of a
        Husky slip-sinkage showed with 348 nats by its secant and not at all by its derivative, and a wheel that is too
        small with 3 and 24. A secant speaks of amounts as large as its own alone: beside the slope of a clock, which
        every model has, it would else stand for a curve that no clock bends (252 nats where nothing was hidden).

        Args:
          columns: of the design at the refit of the model as it is. sizes: of discrepancy and noise there.
        """
        prior, places, errors = self._prior, self._prior.places, self._errors
        tau, noise = sizes
        count = len(places.coordinates)
        scale = np.concatenate([prior.sized(tau), tau[columns.field]])
        whole = np.column_stack([columns.derivatives * scale, self.secants * prior.std, columns.residual])
        white = errors.observations.whiten(whole)[errors.fit] / noise[errors.group[errors.fit], None]
        always = np.concatenate([places.free(), np.arange(count, len(scale))]).astype(int)
        # What the rest takes up, the priors counted as observations.
        rest = white[:, always]
        seen = rest.T @ white
        # Amounts are counted from the refit: from the prior's mean rounding would hide the residual.
        seen[:, -1] += (columns.prior.mean / scale)[always]
        factor = linalg.cho_factor(np.eye(len(always)) + rest.T @ rest)
        left = white - rest @ linalg.cho_solve(factor, seen)

        def explained(which: np.ndarray) -> tuple[float, np.ndarray]:
            """Log evidence of columns of `white` at these sizes, and the amounts, over the prior's, with it."""
            matrix = np.eye(len(which)) + white[:, which].T @ left[:, which]
            seen = white[:, which].T @ left[:, -1]
            amounts = np.linalg.solve(matrix, seen)
            return float(0.5 * seen @ amounts - 0.5 * np.linalg.slogdet(matrix)[1]), amounts

        for own in places.candidates.values():
            far = np.array([self._secant(i) for i in own])
            amounts = explained(len(scale) + own)[1] * prior.std[own]
            speaks = amounts / far > DRIVE_REFIT.speaks
            mixed = np.where(speaks, len(scale), 0) + own
            if speaks.any() and explained(mixed)[0] > explained(own)[0]:
                self._design.seen[:, own[speaks]] = self.secants[:, own[speaks]]

    def _secant(self, i: int) -> float:
        """Amount of a candidate's amplitude over which its signature is taken."""
        low, high = self._prior.places.coordinates[i].bounds()
        step = self._settings.secant * self._prior.std[i] * (1.0 if high > 0.0 else -1.0)
        return float(np.clip(step, DRIVE_REFIT.secant_room * low, DRIVE_REFIT.secant_room * high))
