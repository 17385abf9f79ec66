"""Fits that earn a certificate: Levenberg-Marquardt from many starts on whitened residuals, with priors and bounds.

A fit that has not converged leaves structure in the residual, which then looks like missing physics; so nothing is
said about physics without a certificate (small gradient, starts that agree, no bound that is not physics).
"""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import qmc

from lunar_mjx.criticism.problem import Problem

AGREEING = 3
"""Starts that must end at the same chi-square."""
SAME_CHI2 = 1.0
"""Chi-squares that differ by less, or by less than a ten-thousandth, are the same fit."""
SMALL_GRADIENT = 0.5
"""Largest drop of chi-square that one more Gauss-Newton step may still promise: under a sigma in all directions."""
HALF_STEP = 25.0
"""Largest change of chi-square by halving the time step: below what would name an effect."""

MISFIT_SHARE = 0.1
"""Where a model misfits, all three may be this share of chi-square beyond the noise: a better fit would misfit, too.
Bounds and starts that do not agree are then no faults either; both count in the fit of the model that is named, which
has to reach the noise. (Scores do not feel a fit that has not quite converged: what it lacks lies in the span of its
sensitivities, and that is projected out.)"""

_DAMPINGS = np.array([1e-4, 1e-2, 1.0, 1e2])
_ITERATIONS = 60
_EDGE = 1e-6
_PROBE = 0.1

Progress = Callable[[str, float], None]
"""Called with what is being done and the share that is done, 0 to 1."""


def silent(what: str, share: float) -> None:
    """A `Progress` that shows nothing."""
    del what, share


@dataclasses.dataclass(frozen=True, eq=False)
class Fit:
    """A fitted model.

    Attributes:
      u: (coordinates,) where every coordinate stands. free: places of those that moved.
      chi2: over the fitted observations and the priors.
      residual: (n,) whitened residual of all observations (measured less predicted), in sigma.
      jacobian: (n, free) whitened sensitivities.
      fitted: (n,) which observations were fitted.
      gradient: drop of chi-square that one more step promises. starts: chi-square that each start ended with.
      at_bound: names of parameters at a bound that is not physics. extra: other figures of the certificate.
      problems: why there is no certificate; empty where there is.
    """

    u: np.ndarray
    free: np.ndarray
    chi2: float
    residual: np.ndarray
    jacobian: np.ndarray
    fitted: np.ndarray
    gradient: float
    starts: tuple[float, ...] = ()
    at_bound: tuple[str, ...] = ()
    extra: Mapping[str, float] = dataclasses.field(default_factory=dict)
    problems: tuple[str, ...] = ()

    def covariance(self, problem: Problem) -> np.ndarray:
        """(free, free) covariance of the free coordinates, by the Gauss-Newton Hessian with the priors."""
        j = self.jacobian[self.fitted]
        _, scale = problem.prior_rows(self.u, self.free)
        return np.linalg.pinv(j.T @ j + np.diag(scale**2), hermitian=True)

    def rms(self, keep: np.ndarray) -> float:
        """Root mean square residual of some observations, in sigma."""
        return float(np.sqrt(np.mean(self.residual[keep] ** 2))) if keep.any() else float("nan")


def whitened_residuals(problem: Problem, u: np.ndarray) -> np.ndarray:
    """(k, n) measured less predicted, whitened, at (k, coordinates); not finite where a prediction is not."""
    difference = problem.observations.value[None] - problem.predict(u)
    return problem.observations.whiten(difference.T).T


class Memory:
    """Finished fits by the names of their effects, so that a diagnosis that was stopped goes on where it was.

    Args:
      entries: as `entries` of an earlier memory; plain data.
      save: called with all entries after every fit.
    """

    def __init__(
        self, entries: Mapping[str, Any] | None = None, save: Callable[[Mapping[str, Any]], None] | None = None
    ):
        self.entries = dict(entries or {})
        self._lock = threading.Lock()
        self._save = save

    def recall(self, problem: Problem, effects: Sequence[str]) -> Fit | None:
        """The fit with these effects at its old place, its residual and Jacobian computed anew; None if unknown."""
        entry = self.entries.get("+".join(effects))
        free = problem.free(effects)
        if entry is None or set(entry["u"]) != {problem.coordinates[i].key for i in free}:
            return None
        u = problem.origin()
        for i in free:
            u[i] = entry["u"][problem.coordinates[i].key]
        goal = _Objective(problem, free, problem.observations.in_split("fit"))
        residual, chi2 = goal.residuals(u[None])
        if not np.isfinite(chi2[0]):
            return None
        return Fit(
            u=u, free=free, chi2=float(chi2[0]), residual=residual[0], jacobian=goal.jacobian(u), fitted=goal.fitted,
            gradient=entry["gradient"], starts=tuple(entry["starts"]), at_bound=tuple(entry["at_bound"]),
            extra=entry["extra"], problems=tuple(entry["problems"]),
        )  # fmt: skip

    def keep(self, problem: Problem, effects: Sequence[str], found: Fit) -> None:
        """Remembers a fit."""
        entry = {
            "u": {problem.coordinates[i].key: float(found.u[i]) for i in found.free}, "gradient": found.gradient,
            "starts": list(found.starts), "at_bound": list(found.at_bound), "extra": dict(found.extra),
            "problems": list(found.problems), "chi2": found.chi2,
        }  # fmt: skip
        with self._lock:
            self.entries["+".join(effects)] = entry
            if self._save is not None:
                self._save(dict(self.entries))


class _Objective:
    """Chi-square of the fitted observations with the priors, and its quadratic model, over the free coordinates."""

    def __init__(self, problem: Problem, free: np.ndarray, fitted: np.ndarray):
        self.problem, self.free, self.fitted = problem, free, fitted
        self.low, self.high = problem.bounds(free)

    def residuals(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whitened residuals (k, n), and chi-square (k,), infinite where a prediction is not finite."""
        r = whitened_residuals(self.problem, u)
        return r, self._chi2(u, r)

    def _chi2(self, u: np.ndarray, r: np.ndarray) -> np.ndarray:
        prior = np.array([np.sum(self.problem.prior_rows(row, self.free)[0] ** 2) for row in u])
        with np.errstate(over="ignore", invalid="ignore"):
            chi2 = np.sum(r[:, self.fitted] ** 2, axis=1) + prior
        return np.where(np.isfinite(chi2), chi2, np.inf)

    def jacobian(self, u: np.ndarray) -> np.ndarray:
        j = self.problem.observations.whiten(self.problem.jacobian(u, self.free))
        return np.where(np.isfinite(j), j, 0.0)

    def linearise(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Whitened residuals (k, n), chi-square (k,) and Jacobians (k, n, free) in one batch."""
        observations = self.problem.observations
        predicted, jacobian = self.problem.linearise(u, self.free)
        r = observations.whiten((observations.value[None] - predicted).T).T
        j = np.stack([observations.whiten(a) for a in jacobian])
        return r, self._chi2(u, r), np.where(np.isfinite(j), j, 0.0)

    def quadratic(self, u: np.ndarray, r: np.ndarray, j: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Half the downhill gradient and the Gauss-Newton Hessian."""
        prior, scale = self.problem.prior_rows(u, self.free)
        j = j[self.fitted]
        return j.T @ r[self.fitted] - scale * prior, j.T @ j + np.diag(scale**2)

    def held(self, at: np.ndarray, downhill: np.ndarray) -> np.ndarray:
        """Coordinates at a bound that the gradient pushes against."""
        return ((at <= self.low + _EDGE) & (downhill < 0.0)) | ((at >= self.high - _EDGE) & (downhill > 0.0))

    def steps(self, u: np.ndarray, downhill: np.ndarray, hessian: np.ndarray, dampings: np.ndarray) -> np.ndarray:
        """(dampings, coordinates) damped Gauss-Newton steps, cut at the bounds."""
        at = u[self.free]
        move = ~self.held(at, downhill)
        out = np.repeat(u[None], len(dampings), axis=0)
        if not move.any():
            return out
        inner = hessian[np.ix_(move, move)]
        for i, damping in enumerate(dampings):
            step = np.linalg.lstsq(inner + damping * np.diag(np.diag(inner) + 1e-12), downhill[move], rcond=None)[0]
            new = at.copy()
            new[move] = at[move] + step
            out[i, self.free] = np.clip(new, self.low, self.high)
        return out

    def bent(
        self, u: np.ndarray, r: np.ndarray, j: np.ndarray, hessian: np.ndarray, trials: np.ndarray, dampings: np.ndarray
    ) -> np.ndarray:
        """Steps bent along a curved valley by the second derivative in their direction (Transtrum and Sethna 2012)."""
        steps = (trials - u)[:, self.free]
        probes = np.repeat(u[None], len(steps), axis=0)
        probes[:, self.free] += _PROBE * steps
        ahead, _ = self.residuals(probes)
        out = trials.copy()
        for i, (step, damping) in enumerate(zip(steps, dampings, strict=True)):
            if not np.isfinite(ahead[i]).all() or not np.any(step):
                continue
            second = -2.0 / _PROBE * ((ahead[i] - r) / _PROBE + j @ step)
            inner = hessian + damping * np.diag(np.diag(hessian) + 1e-12)
            bend = -0.5 * np.linalg.lstsq(inner, j[self.fitted].T @ second[self.fitted], rcond=None)[0]
            # beyond this the quadratic path is not to be trusted either
            bend *= min(1.0, 0.75 * np.linalg.norm(step) / max(2.0 * float(np.linalg.norm(bend)), 1e-30))
            out[i, self.free] = np.clip(u[self.free] + step + bend, self.low, self.high)
        return out

    def promise(self, u: np.ndarray, downhill: np.ndarray, hessian: np.ndarray) -> float:
        """Drop of chi-square that a full Gauss-Newton step over the unheld coordinates promises."""
        move = ~self.held(u[self.free], downhill)
        if not move.any():
            return 0.0
        inner = hessian[np.ix_(move, move)]
        return float(downhill[move] @ np.linalg.lstsq(inner, downhill[move], rcond=None)[0])


@dataclasses.dataclass
class _Descent:
    u: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    chi2: float
    promise: float


def _descend(goal: _Objective, start: np.ndarray, iterations: int = _ITERATIONS) -> _Descent:
    """Levenberg-Marquardt from one start, all dampings of an iteration in one batch.

    Where Jacobians are dear, Broyden's update stands in for them as long as steps keep their promise.
    """
    u = start.copy()
    u[goal.free] = np.clip(u[goal.free], goal.low, goal.high)
    lazy = not goal.problem.cheap_jacobian and not goal.problem.eager
    if goal.problem.eager:
        residuals, chi2, jacobians = goal.linearise(u[None])
        r, best, j = residuals[0], float(chi2[0]), jacobians[0]
    else:
        residuals, chi2 = goal.residuals(u[None])
        r, best = residuals[0], float(chi2[0])
        j = goal.jacobian(u) if np.isfinite(best) else np.zeros((len(r), len(goal.free)))
    damping, promise, fresh, curved = 1e-2, np.inf, True, False
    for _ in range(iterations):
        if not np.isfinite(best):
            break
        downhill, hessian = goal.quadratic(u, r, j)
        promise = goal.promise(u, downhill, hessian)
        enough = 0.0 if goal.problem.cheap_jacobian else 0.2 * _slack(best, int(goal.fitted.sum()))
        if promise < max(0.2 * SMALL_GRADIENT, enough):
            if fresh:
                break
            j, fresh = goal.jacobian(u), True
            continue
        dampings = damping * _DAMPINGS
        trials = goal.steps(u, downhill, hessian, dampings)
        if curved:
            trials = np.concatenate([trials, goal.bent(u, r, j, hessian, trials, dampings)])
        if goal.problem.eager:
            residuals, chi2, jacobians = goal.linearise(trials)
        else:
            residuals, chi2 = goal.residuals(trials)
        k = int(np.argmin(chi2))
        if not chi2[k] < best:
            if not fresh:
                j, fresh = goal.jacobian(u), True
                continue
            if damping > 1e8:
                break
            damping, curved = damping * 1e2, True
            continue
        kept = best - float(chi2[k]) > 0.5 * promise
        curved = not kept
        step, before = trials[k][goal.free] - u[goal.free], r
        u, r, best = trials[k], residuals[k], float(chi2[k])
        damping = float(np.clip(dampings[k % len(dampings)], 1e-9, 1e6))
        if goal.problem.eager:
            j = jacobians[k]
        elif lazy and kept and np.isfinite(r).all():
            j, fresh = _broyden(j, step, before - r), False
        else:
            j, fresh = goal.jacobian(u), True
    if not fresh:
        j = goal.jacobian(u)
    if np.isfinite(best):
        promise = goal.promise(u, *goal.quadratic(u, r, j))
    return _Descent(u, r, j, best, promise)


def _broyden(jacobian: np.ndarray, step: np.ndarray, change: np.ndarray) -> np.ndarray:
    """The Jacobian that predicts the last change and differs least from the one before (Broyden 1965)."""
    return jacobian + np.outer(change - jacobian @ step, step) / max(float(step @ step), 1e-30)


def _slack(chi2: float, observations: int) -> float:
    """Chi-square that does not matter in a fit that is beyond the noise; zero where it is not."""
    return MISFIT_SHARE * max(0.0, chi2 - 1.06 * observations - 5.0 * np.sqrt(2.0 * observations))


def _same(chi2: float, observations: int) -> float:
    return max(SAME_CHI2, 1e-4 * chi2, _slack(chi2, observations))


def _with_own_nuisances(goal: _Objective, best: _Descent) -> _Descent:
    """Fits the starts of logs that are held out to these logs themselves; what all logs share stays where it is."""
    problem = goal.problem
    held = {n for n, split in enumerate(problem.observations.split) if split != "fit"}
    own = np.array([problem.coordinates[i].log_index in held for i in goal.free])
    if not own.any() or not np.isfinite(best.chi2):
        return best
    rows = ~goal.fitted
    prior, scale = problem.prior_rows(best.u, goal.free)
    j = best.jacobian[rows][:, own]
    r = best.residual[rows]
    if not np.isfinite(r).all():
        return best
    u = best.u.copy()
    at = goal.free[own]
    step = np.linalg.lstsq(j.T @ j + np.diag(scale[own] ** 2), j.T @ r - scale[own] * prior[own], rcond=None)[0]
    u[at] = np.clip(u[at] + step, goal.low[own], goal.high[own])
    residual = goal.residuals(u[None])[0][0]
    return dataclasses.replace(best, u=u, residual=residual) if np.isfinite(residual).all() else best


def _chase(goal: _Objective, best: _Descent, starts: np.ndarray, rounds: int = 8) -> list[float]:
    """Chi-square that other starts reach with the best start's Jacobian, all starts in one batch.

    The fixed Jacobian (chord method) converges linearly to the same optimum where there is one.
    """
    u = starts.copy()
    same = _same(best.chi2, int(goal.fitted.sum()))
    residual, chi2 = goal.residuals(u)
    share = np.ones(len(u))
    for _ in range(rounds):
        if np.all(chi2 < best.chi2 + 0.5 * same):
            break
        trial = u.copy()
        for i in range(len(u)):
            if np.isfinite(chi2[i]):
                downhill, hessian = goal.quadratic(u[i], residual[i], best.jacobian)
                full = goal.steps(u[i], downhill, hessian, np.array([1e-6]))[0]
                trial[i] = u[i] + share[i] * (full - u[i])
            else:
                trial[i] = 0.5 * (u[i] + best.u)
        new_residual, new_chi2 = goal.residuals(trial)
        better = new_chi2 < chi2
        share = np.where(better, np.minimum(1.0, 2.0 * share), 0.4 * share)
        u[better], residual[better], chi2 = trial[better], new_residual[better], np.minimum(chi2, new_chi2)
    return [float(c) for c in chi2]


def fit(
    problem: Problem,
    free: np.ndarray,
    start: np.ndarray | None = None,
    starts: int = 4,
    seed: int = 0,
    spread: float = 1.5,
    splits: Sequence[str] = ("fit",),
    certify: bool = True,
    progress: Progress = silent,
) -> Fit:
    """Fits coordinates to the observations of some splits.

    Args:
      problem: model and measurements.
      free: places of the coordinates that move.
      start: (coordinates,) first start; the model as given if None.
      starts: number of starts in all.
      seed: of the Sobol sequence of the other starts.
      spread: half width of the starts' box, in scales (or in the prior's standard deviations, where smaller).
      splits: which observations are fitted.
      certify: whether to ask the problem for its own part of the certificate, too.
      progress: told of every start.

    Returns:
      The best fit, with its certificate.
    """
    fitted = problem.observations.in_split(*splits)
    goal = _Objective(problem, free, fitted)
    origin = problem.origin() if start is None else np.asarray(start, float)
    progress("fitting", 0.0)
    found = [_descend(goal, origin)]
    others = _other_starts(problem, free, origin, starts - 1, seed, spread, goal)
    ends: list[float] = []
    if problem.cheap_jacobian:
        for i, other in enumerate(others):
            progress("fitting", (i + 1) / max(starts, 1))
            found.append(_descend(goal, other))
    elif len(others) and not _slack(found[0].chi2, int(fitted.sum())):
        near = found[0].u[None] + 0.3 * (others - origin[None])
        near[:, free] = np.clip(near[:, free], goal.low, goal.high)
        ends = _chase(goal, found[0], near)
    found.sort(key=lambda d: d.chi2)
    best = _with_own_nuisances(goal, found[0])
    chi2s = tuple(sorted([d.chi2 for d in found] + ends))
    edge = _at_bound(problem, goal, best)
    extra = dict(problem.certificate(best.u, free)) if certify and np.isfinite(best.chi2) else {}
    count = int(fitted.sum())
    agreeing = sum(c <= best.chi2 + _same(best.chi2, count) for c in chi2s)
    problems = _faults(best, _slack(best.chi2, count), agreeing, starts, edge, extra)
    return Fit(
        u=best.u, free=np.asarray(free), chi2=best.chi2, residual=best.residual, jacobian=best.jacobian,
        fitted=fitted, gradient=best.promise, starts=chi2s, at_bound=edge, extra=extra, problems=problems,
    )  # fmt: skip


def _faults(
    best: _Descent, slack: float, agreeing: int, starts: int, edge: Sequence[str], extra: Mapping[str, float]
) -> tuple[str, ...]:
    problems = []
    if not np.isfinite(best.chi2):
        return ("every start diverged",)
    if best.promise > max(SMALL_GRADIENT, slack):
        problems.append(f"the gradient still promises a drop of chi-square of {best.promise:.2g}")
    if starts >= AGREEING and agreeing < AGREEING and not slack:
        problems.append(f"only {agreeing} of {starts} starts agree")
    # A model that misfits presses its parameters against bounds; they count once it is at the noise.
    if edge and not slack:
        problems.append(f"{', '.join(edge)} ended at a bound")
    if extra.get("half_step_chi2", 0.0) > max(HALF_STEP, slack):
        problems.append(f"halving the time step changes chi-square by {extra['half_step_chi2']:.2g}")
    return tuple(problems)


def _other_starts(
    problem: Problem, free: np.ndarray, origin: np.ndarray, number: int, seed: int, spread: float, goal: _Objective
) -> np.ndarray:
    if number <= 0:
        return np.zeros((0, len(origin)))
    size = 1 << max(0, (number - 1).bit_length())
    cube = qmc.Sobol(len(free), rng=np.random.default_rng(seed)).random(size)[:number]
    width = np.array([spread * min(1.0, problem.coordinates[i].prior) for i in free])
    out = np.repeat(origin[None], number, axis=0)
    out[:, free] = np.clip(origin[free] + (2.0 * cube - 1.0) * width, goal.low, goal.high)
    return out


def _at_bound(problem: Problem, goal: _Objective, best: _Descent) -> tuple[str, ...]:
    at = best.u[goal.free]
    edge = (at <= goal.low + _EDGE) | (at >= goal.high - _EDGE)
    # The bounds of a candidate are where its physics ends: a share of 1, a friction of 0.
    own = np.concatenate([np.zeros(0, int), *problem.candidates.values()])
    return tuple(problem.coordinates[i].key for i, e in zip(goal.free, edge, strict=True)
                 if e and not problem.coordinates[i].physical and i not in own)  # fmt: skip
