"""Levenberg-Marquardt on whitened residuals with priors and bounds, from one start or chased from many.

Sources: Levenberg-Marquardt with geodesic acceleration (Transtrum & Sethna 2012); Broyden (1965).
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable

import numpy as np

from lunar_mjx.inference.objective import Objective

SAME_CHI2 = 1.0
"""Chi-squares that differ by less, or by less than a ten-thousandth, are the same fit."""
SMALL_GRADIENT = 0.5
"""Largest drop of chi-square that one more Gauss-Newton step may still promise: under a sigma in all directions."""
MISFIT_SHARE = 0.1
"""Tolerances on equal chi-square, gradient and half time step, as a share of the chi-square beyond the noise.
Bounds and starts that do not agree are then no faults either; both count in the fit of the model that is named, which
has to reach the noise. (Scores do not feel a fit that has not quite converged: what it lacks lies in the span of its
sensitivities, and that is projected out.)"""

_DAMPINGS = np.array([1e-4, 1e-2, 1e-1, 1.0, 1e2])
DAMPING_GROWTH = 1e2
"""Factor on the damping of Levenberg-Marquardt after a step of no damping helped."""
_ITERATIONS = 60
EDGE = 1e-6
_PATIENCE = 2
"""Steps in a row that may gain less than matters."""
_CREEPING = 12
"""Steps in a row that may gain less than matters at the noise, where the gradient promises too much to certify."""
_CREEP = 2.0
"""Drop of chi-square that does not matter where rows are dear: it takes 25 to name an effect."""
_JUMP = 1e5
"""Sensitivity, sigma per scale, that only a jump within a short step has: no logs know a coordinate to 1e-5 scales."""
_TRIED = 3
"""Steps that a descent may take before it is compared with a rival."""
_HOPE = 4.0
"""Drop of chi-square that is still hoped for, in terms of what a Gauss-Newton step promises."""


class Outdone(Exception):
    """A descent was left, since another model has reached what this one cannot."""


class Rival:
    """Chi-square that another model reaches; refits beside this one may lower it meanwhile.

    Args:
      chi2: what is reached so far.
    """

    def __init__(self, chi2: float = np.inf):
        self.chi2 = chi2
        self._lock = threading.Lock()

    def lower(self, chi2: float) -> None:
        """Another model has reached this."""
        with self._lock:
            self.chi2 = min(self.chi2, chi2)


@dataclasses.dataclass
class Descent:
    u: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    chi2: float
    promise: float


@dataclasses.dataclass
class _Walk:
    """Where a descent is, and how it got on lately.

    Attributes:
      u, r, j, chi2: place, whitened residual, Jacobian, chi-square. damping: of the last step taken.
      promise: drop of chi-square that a Gauss-Newton step promises. fresh: whether the Jacobian was taken here.
      wide: whether it was taken over wide steps, too.
      curved: whether steps are to be bent. slow: steps in a row that gained little. failed: rounds without a better
        step. taken: steps.
    """

    goal: Objective
    u: np.ndarray
    r: np.ndarray
    j: np.ndarray
    chi2: float
    damping: float = 1e-2
    promise: float = np.inf
    fresh: bool = True
    wide: bool = False
    curved: bool = False
    slow: int = 0
    failed: int = 0
    taken: int = 0

    @property
    def dear(self) -> bool:
        """Whether rows cost simulations."""
        return not self.goal.problem.cheap_jacobian

    @property
    def enough(self) -> float:
        """Drop of chi-square that does not matter where the model misfits."""
        return 0.2 * slack_of(self.chi2, int(self.goal.fitted.sum())) if self.dear else 0.0

    def end(self) -> Descent:
        """Where it is."""
        return Descent(self.u, self.r, self.j, self.chi2, self.promise)

    def refresh(self) -> None:
        """Takes the Jacobian where the descent is."""
        self.j, self.fresh, self.wide = self.goal.jacobian(self.u), True, False

    @property
    def at_a_jump(self) -> bool:
        """Whether it has slid to the edge of a jump, over which short steps lead: no step goes anywhere from there."""
        return float(np.max(np.sum(self.j[self.goal.fitted] ** 2, axis=0), initial=0.0)) > _JUMP**2

    def widen(self) -> None:
        """Takes the Jacobian over wide steps, too."""
        std = self.goal.standard_errors(self.u, self.j)
        self.j, self.wide = self.goal.without_jumps(self.j, self.goal.wide_jacobian(self.u, std)), True

    def hopeless(self, rival: float) -> bool:
        """Whether it creeps, or falls far short of a rival."""
        behind = self.taken >= _TRIED and self.fresh and self.dear and self.chi2 - _HOPE * self.promise > rival
        # at the noise a fit needs its certificate, and creeps on while its gradient stands in the way of that
        unsure = self.dear and self.enough == 0.0 and self.promise > 0.5 * SMALL_GRADIENT
        return behind or self.slow >= (_CREEPING if unsure else _PATIENCE)

    def step(self, downhill: np.ndarray, hessian: np.ndarray) -> bool:
        """Tries all dampings at once, and goes where chi-square is least; False where it is nowhere less."""
        goal, dampings = self.goal, self.damping * _DAMPINGS
        trials, probes = goal.steps(self.u, downhill, hessian, dampings), np.zeros((0, len(self.u)))
        ahead = np.zeros((0, len(self.r)))
        if self.curved:
            bent, probes, ahead = goal.bent(self.u, self.r, self.j, hessian, trials, dampings)
            trials = np.concatenate([trials, bent])
            if goal.eager and np.min(short := goal.chi2(probes, ahead)) < self.chi2:
                goal.problem.foresee(probes[[int(np.argmin(short))]], goal.free)
        jacobian, own = None, len(trials)
        if goal.eager:
            if not self.curved:
                self._foresee_bending(downhill, hessian)
            residuals, chi2, jacobian = goal.linearise(trials)
        else:
            residuals, chi2 = goal.residuals(trials)
        if len(probes):
            trials = np.concatenate([trials, probes])
            residuals, chi2 = np.concatenate([residuals, ahead]), np.concatenate([chi2, goal.chi2(probes, ahead)])
        k = int(np.argmin(chi2))
        if not chi2[k] < self.chi2:
            return False
        known = jacobian(k) if jacobian is not None and k < own else None
        self._take(trials[k], residuals[k], float(chi2[k]), known)
        self.damping = float(np.clip(dampings[k % len(dampings)], 1e-4, 1e6))
        return True

    def _take(self, u: np.ndarray, r: np.ndarray, chi2: float, jacobian: np.ndarray | None) -> None:
        # A model that misfits creeps along valleys that lead nowhere; what it gains there does not matter.
        creep = max(self.enough, _CREEP) if self.dear else 0.0
        self.slow = self.slow + 1 if self.chi2 - chi2 < creep else 0
        kept = self.chi2 - chi2 > 0.5 * self.promise
        self.curved, self.failed, self.taken = not kept, 0, self.taken + 1
        moved, before = u[self.goal.free] - self.u[self.goal.free], self.r
        self.u, self.r, self.chi2, self.wide = u, r, chi2, False
        if jacobian is not None:
            self.j = jacobian
        elif self.dear and not self.goal.eager and kept and np.isfinite(r).all():
            self.j, self.fresh = _broyden(self.j, moved, before - r), False
        else:
            self.refresh()

    def _foresee_bending(self, downhill: np.ndarray, hessian: np.ndarray) -> None:
        """What a step asks for first if the one before has failed."""
        trials = self.goal.steps(self.u, downhill, hessian, DAMPING_GROWTH * self.damping * _DAMPINGS)
        self.goal.problem.foresee(self.goal.probes(self.u, trials))

    def try_again(self) -> bool:
        """After a failed step: a Jacobian of this place, at a jump one over wide steps, then larger dampings.

        Returns:
          False where that is of no use.
        """
        if not self.fresh:
            self.refresh()
            return True
        if self.dear and not self.wide and self.at_a_jump:
            self.widen()
            return True
        self.failed += 1
        # where rows are dear, two rounds from Gauss-Newton to steepest descent are enough
        if self.damping > 1e8 or (self.failed > 1 and self.dear and self.damping >= 1.0):
            return False
        self.damping, self.curved = self.damping * DAMPING_GROWTH, True
        return True


def descend(
    goal: Objective,
    start: np.ndarray,
    iterations: int = _ITERATIONS,
    rival: Rival | float = np.inf,
    known: tuple[np.ndarray, np.ndarray] | None = None,
    outdone: Callable[[Descent], bool] | None = None,
) -> Descent:
    """Levenberg-Marquardt from one start, all dampings of an iteration in one batch.

    Where Jacobians are dear, Broyden's update stands in for them as long as steps keep their promise, and a descent
    that falls far short of a rival's chi-square is left.

    Args:
      goal: what is minimised. start: (coordinates,) where from. iterations: most steps. rival: what is to be caught.
      known: whitened residual (n,) and Jacobian (n, free) at the start, if they have been computed.
      outdone: whether to leave, asked before every step with where it is.

    Raises:
      Outdone: it was left.
    """
    walk = _begin(goal, start, known)
    for _ in range(iterations):
        if outdone is not None and outdone(walk.end()):
            raise Outdone
        if not np.isfinite(walk.chi2):
            break
        downhill, hessian = goal.quadratic(walk.u, walk.r, walk.j)
        walk.promise = goal.promise(walk.u, downhill, hessian)
        if walk.hopeless(rival.chi2 if isinstance(rival, Rival) else rival):
            break
        if walk.promise < max(0.2 * SMALL_GRADIENT, walk.enough):
            if walk.fresh:
                break
            walk.refresh()
        elif not walk.step(downhill, hessian) and not walk.try_again():
            break
    if not walk.fresh:
        walk.refresh()
    if np.isfinite(walk.chi2):
        walk.promise = goal.promise(walk.u, *goal.quadratic(walk.u, walk.r, walk.j))
    return walk.end()


def _begin(goal: Objective, start: np.ndarray, known: tuple[np.ndarray, np.ndarray] | None) -> _Walk:
    u = start.copy()
    u[goal.free] = np.clip(u[goal.free], goal.low, goal.high)
    if known is not None:
        return _Walk(goal, u, *known, float(goal.chi2(u[None], known[0][None])[0]))
    if goal.eager:
        residuals, chi2, jacobian = goal.linearise(u[None])
        return _Walk(goal, u, residuals[0], jacobian(0), float(chi2[0]))
    residuals, chi2 = goal.residuals(u[None])
    finite = np.isfinite(chi2[0])
    j = goal.jacobian(u) if finite else np.zeros((residuals.shape[1], len(goal.free)))
    return _Walk(goal, u, residuals[0], j, float(chi2[0]))


def _broyden(jacobian: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The Jacobian that predicts the last change and differs least from the one before (Broyden 1965)."""
    return jacobian + np.outer(change - jacobian @ step, step) / max(float(step @ step), 1e-30)


def slack_of(chi2: float, observations: int) -> float:
    """Chi-square that does not matter in a fit that is beyond the noise; zero where it is not."""
    beyond = chi2 > 1.06 * observations + 5.0 * np.sqrt(2.0 * observations)
    return MISFIT_SHARE * (chi2 - observations) if beyond else 0.0


def same_chi2(chi2: float, observations: int) -> float:
    return max(SAME_CHI2, 1e-4 * chi2, slack_of(chi2, observations))


def chase(goal: Objective, best: Descent, starts: np.ndarray, rounds: int = 8) -> tuple[np.ndarray, list[float]]:
    """Places (k, coordinates) that other starts reach with the best start's Jacobian, and chi-square there, in one go.

    The fixed Jacobian (chord method) converges linearly to the same optimum where there is one. Where rows are free,
    the first step is taken with a Jacobian of the start's own.
    """
    u = starts.copy()
    same = same_chi2(best.chi2, int(goal.fitted.sum()))
    own = None
    if goal.eager:
        residual, chi2, own = goal.linearise(u)
    else:
        residual, chi2 = goal.residuals(u)
    share = np.ones(len(u))
    for _ in range(rounds):
        if np.all(chi2 < best.chi2 + 0.5 * same):
            break
        trial = u.copy()
        for i in range(len(u)):
            if np.isfinite(chi2[i]):
                downhill, hessian = goal.quadratic(u[i], residual[i], own(i) if own else best.jacobian)
                full = goal.steps(u[i], downhill, hessian, np.array([1e-6]))[0]
                trial[i] = u[i] + share[i] * (full - u[i])
            else:
                trial[i] = 0.5 * (u[i] + best.u)
        new_residual, new_chi2 = goal.residuals(trial)
        own = None
        better = new_chi2 < chi2
        share = np.where(better, np.minimum(1.0, 2.0 * share), 0.4 * share)
        u[better], residual[better], chi2 = trial[better], new_residual[better], np.minimum(chi2, new_chi2)
    return u, [float(c) for c in chi2]
