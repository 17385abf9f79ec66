"""Fits that earn a certificate: Levenberg-Marquardt from many starts on whitened residuals, with priors and bounds.

A fit that has not converged leaves structure in the residual, which then looks like missing physics; so nothing is
said about physics without a certificate (small gradient, starts that agree, no bound that is not physics).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy.stats import qmc

from lunar_mjx.inference.descent import (
    EDGE,
    SAME_CHI2,
    SMALL_GRADIENT,
    Descent,
    Rival,
    chase,
    descend,
    same_chi2,
    slack_of,
)
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.slow_disturbance import inflated

AGREEING = 3
"""Starts that must end at the same chi-square."""

HALF_STEP = 1.0
"""Largest change of chi-square by halving the time step."""

_AGAIN = 3
"""Times that other starts begin about a fit, each lower than the one before."""
_NEARER = 0.3
"""Share of the box of starts within which others begin, about the first fit, where rows are dear."""

_ROUGHEST = 25.0
"""Jumps of chi-square that are put up with at most: below what would name an effect."""
STD_GROWTH_LIMIT, MAX_STEP_WIDENINGS = 1.5, 3
"""Derivatives are taken over wider steps again while standard errors grow by more than this, so many times at most."""
ROUGH = 4.0
"""Largest promise of the gradient, in jumps of chi-square, at a bottom that jumps (wheels at rest in drives)."""

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
      jacobian: (n, free) whitened sensitivities, those for intervals where there is a certificate.
      fitted: (n,) which observations were fitted.
      gradient: drop of chi-square that one more step promises. starts: chi-square that each start ended with.
      at_bound: names of parameters at a bound that is not physics. extra: other figures of the certificate.
      problems: why there is no certificate; empty where there is.
      step_error: (n,) what was taken for the error of the time step, for drives. own_step_error: whether it was taken
        anew near this fit. wide: (free,) standard errors that the steps of the Jacobian are, for intervals.
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
    step_error: np.ndarray | None = None
    own_step_error: bool = False
    wide: np.ndarray | None = None

    def covariance(self, problem: Problem) -> np.ndarray:
        """(free, free) covariance of the free coordinates, by the Gauss-Newton Hessian with the priors.

        Wider where the residual is slower than the noise (see `slow_disturbance`).
        """
        known = Objective(problem, self.free, self.fitted).covariance(self.u, self.jacobian)
        return inflated(problem.observations, self.fitted, self.residual, self.jacobian, known)

    def rms(self, keep: np.ndarray) -> float:
        """Root mean square residual of some observations, in sigma."""
        return float(np.sqrt(np.mean(self.residual[keep] ** 2))) if keep.any() else float("nan")


def _with_own_nuisances(goal: Objective, best: Descent) -> Descent:
    """Fits the starts of logs that are held out to these logs themselves; what all logs share stays where it is."""
    u = _held_out_nuisance_estimate(goal, best)
    if u is None:
        return best
    residual = goal.residuals(u[None])[0][0]
    return dataclasses.replace(best, u=u, residual=residual) if np.isfinite(residual).all() else best


def foreseen_fit(goal: Objective, at: Descent) -> Fit:
    """The fit that a descent would give here, held-out logs fitted to themselves by linear theory."""
    u = _held_out_nuisance_estimate(goal, at)
    residual = at.residual if u is None else at.residual - at.jacobian @ (u - at.u)[goal.free]
    return Fit(at.u if u is None else u, goal.free, at.chi2, residual, at.jacobian, goal.fitted, at.promise)


def _held_out_nuisance_estimate(goal: Objective, best: Descent) -> np.ndarray | None:
    """(coordinates,) u after one Gauss-Newton step of the held-out logs' nuisances; None where no log is held out."""
    problem = goal.problem
    held = {n for n, split in enumerate(problem.observations.split) if split != "fit"}
    own = np.array([problem.coordinates[i].log_index in held for i in goal.free])
    if not own.any() or not np.isfinite(best.chi2):
        return None
    rows = ~goal.fitted
    prior, scale = problem.prior_rows(best.u, goal.free)
    j = best.jacobian[rows][:, own]
    r = best.residual[rows]
    if not np.isfinite(r).all():
        return None
    u = best.u.copy()
    at = goal.free[own]
    step = np.linalg.lstsq(j.T @ j + np.diag(scale[own] ** 2), j.T @ r - scale[own] * prior[own], rcond=None)[0]
    u[at] = np.clip(u[at] + step, goal.low[own], goal.high[own])
    return u


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
    rival: Rival | float = np.inf,
    known: tuple[np.ndarray, np.ndarray] | None = None,
    eager: bool = False,
    outdone: Callable[[Descent], bool] | None = None,
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
      rival: chi-square that another model reaches: a fit that cannot is left unfinished where fits are dear.
      known: whitened residual (n,) and Jacobian (n, free) at the start, if they have been computed.
      eager: takes Jacobians with the residuals, as where rows cost nothing.
      outdone: whether to leave, asked before every step of the first descent with where it is.

    Returns:
      The best fit, with its certificate.

    Raises:
      Outdone: it was left.
    """
    fitted = problem.observations.in_split(*splits)
    goal = Objective(problem, free, fitted, eager)
    origin = problem.origin() if start is None else np.asarray(start, float)
    progress("fitting", 0.0)
    others = _other_starts(problem, free, origin, starts - 1, seed, spread, goal)
    problem.foresee(_near(goal, origin, origin, others), free)
    first = descend(goal, origin, rival=rival, known=known, outdone=outdone)
    _foresee_end(goal, first, certify)
    lowest, chi2s = _lowest(goal, first, origin, others, progress)
    best = _with_own_nuisances(goal, lowest)
    edge = _at_bound(problem, goal, best)
    extra = dict(problem.certificate(best.u, free)) if certify and np.isfinite(best.chi2) else {}
    count = int(fitted.sum())
    if certify and _asks_roughness(goal, best):
        extra["roughness_chi2"] = goal.roughness(lowest.u, lowest.residual, lowest.jacobian)
    jacobian, wide = best.jacobian, None
    if certify and np.isfinite(best.chi2) and not problem.cheap_jacobian:
        jacobian, wide = _for_intervals(goal, best)
    agreeing = sum(c <= best.chi2 + same_chi2(best.chi2, count) for c in chi2s)
    problems = _faults(best, slack_of(best.chi2, count), agreeing, starts, edge, extra)
    return Fit(
        u=best.u,
        free=np.asarray(free),
        chi2=best.chi2,
        residual=best.residual,
        jacobian=jacobian,
        fitted=fitted,
        gradient=best.promise,
        starts=chi2s,
        at_bound=edge,
        extra=extra,
        problems=problems,
        step_error=problem.kept_step_error(),
        wide=wide,
    )


def step_too_long(found: Fit) -> bool:
    """Whether a fit at the noise depends on the length of the time step."""
    slack = slack_of(found.chi2, int(found.fitted.sum()))
    return not found.extra.get("half_step_chi2", 0.0) <= max(HALF_STEP, slack)


def _for_intervals(goal: Objective, best: Descent) -> tuple[np.ndarray, np.ndarray]:
    """The Jacobian (n, free) by short steps and by some of about the standard errors (free,), and these.

    Where what both tell leaves much larger errors, they are the next steps.
    """
    jacobian, std = best.jacobian, goal.standard_errors(best.u, best.jacobian)
    for _ in range(MAX_STEP_WIDENINGS):
        jacobian = goal.without_jumps(jacobian, goal.wide_jacobian(best.u, std))
        told = goal.standard_errors(best.u, jacobian)
        if np.all(told <= STD_GROWTH_LIMIT * std):
            break
        std = np.maximum(std, told)
    return jacobian, std


def _asks_roughness(goal: Objective, best: Descent) -> bool:
    return np.isfinite(best.chi2) and not goal.problem.cheap_jacobian and best.promise > SMALL_GRADIENT


def _foresee_end(goal: Objective, first: Descent, certify: bool) -> None:
    """What will be asked for if no other start descends further."""
    if not goal.problem.eager:
        return
    own = _held_out_nuisance_estimate(goal, first)
    if own is not None:
        goal.problem.foresee(own[None])
    if certify:
        std = goal.standard_errors(first.u, first.jacobian)
        end = first.u if own is None else own
        goal.problem.foresee_wide(end, goal.free, std)
        goal.problem.foresee(end[None], goal.free)  # to recall the fit
        if _asks_roughness(goal, first):
            goal.foresee_roughness(first.u, first.residual, first.jacobian)


def _lowest(
    goal: Objective, first: Descent, origin: np.ndarray, others: np.ndarray, progress: Progress
) -> tuple[Descent, tuple[float, ...]]:
    """The lowest descent, and the chi-square of every start.

    Where rows are dear, other starts chase the first. One that ends lower is what has to be agreed upon, and the others
    begin again about it.
    """
    if goal.problem.cheap_jacobian:
        found = [first]
        for i, other in enumerate(others):
            progress("fitting", (i + 1) / (len(others) + 1))
            found.append(descend(goal, other))
        return min(found, key=lambda d: d.chi2), tuple(sorted(d.chi2 for d in found))
    if not len(others) or slack_of(first.chi2, int(goal.fitted.sum())):
        return first, (first.chi2,)
    # where the first gained nothing that matters, the others have been simulated beside it
    gained = float(goal.residuals(origin[None])[1][0]) - first.chi2
    lowest, centre, ends = first, origin if gained < SAME_CHI2 else first.u, [first.chi2]
    for _ in range(_AGAIN):
        caught = lowest
        more, ends = _chased(goal, caught, _near(goal, centre, origin, others))
        ends = [caught.chi2, *ends]
        lowest = min([caught, *more], key=lambda d: d.chi2)
        if lowest.chi2 >= caught.chi2 - same_chi2(caught.chi2, int(goal.fitted.sum())):
            break
        centre = lowest.u
    return lowest, tuple(sorted(ends))


def _chased(goal: Objective, first: Descent, near: np.ndarray) -> tuple[list[Descent], list[float]]:
    """Descents of their own, and the chi-square of every start (k, coordinates) near a fit that is to be confirmed."""
    places, ends = chase(goal, first, near)
    found = []
    same = same_chi2(first.chi2, int(goal.fitted.sum()))
    enough = first.chi2 + same
    # A fixed Jacobian may lead a start astray that descends well with its own, and one that went lower has not arrived.
    for i in np.argsort(ends):
        if ends[i] < first.chi2 - same:
            found.append(descend(goal, places[i]))
            return found, [found[-1].chi2]
        if 1 + sum(e <= enough for e in ends) >= AGREEING:
            break
        if ends[i] > enough:
            found.append(descend(goal, near[i]))
            ends[i] = found[-1].chi2
    return found, ends


def _near(goal: Objective, centre: np.ndarray, origin: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Starts (k, coordinates) drawn about an origin as they lie, nearer, about another centre."""
    out = centre[None] + _NEARER * (others - origin[None])
    out[:, goal.free] = np.clip(out[:, goal.free], goal.low, goal.high)
    return out


def _faults(
    best: Descent, slack: float, agreeing: int, starts: int, edge: Sequence[str], extra: Mapping[str, float]
) -> tuple[str, ...]:
    problems = []
    if not np.isfinite(best.chi2):
        return ("every start diverged",)
    rough = ROUGH * min(extra.get("roughness_chi2", 0.0), _ROUGHEST)
    if best.promise > max(SMALL_GRADIENT, slack, rough):
        problems.append(f"the gradient still promises a drop of chi-square of {best.promise:.2g}")
    if starts >= AGREEING and agreeing < AGREEING and not slack:
        problems.append(f"only {agreeing} of {starts} starts agree")
    # A model that misfits presses its parameters against bounds; they count once it is at the noise.
    if edge and not slack:
        problems.append(f"{', '.join(edge)} ended at a bound")
    if not extra.get("half_step_chi2", 0.0) <= max(HALF_STEP, slack):
        problems.append(f"halving the time step changes chi-square by {extra['half_step_chi2']:.2g}")
    return tuple(problems)


def _other_starts(
    problem: Problem, free: np.ndarray, origin: np.ndarray, number: int, seed: int, spread: float, goal: Objective
) -> np.ndarray:
    if number <= 0:
        return np.zeros((0, len(origin)))
    size = 1 << max(0, (number - 1).bit_length())
    cube = qmc.Sobol(len(free), rng=np.random.default_rng(seed)).random(size)[:number]
    width = np.array([spread * min(1.0, problem.coordinates[i].prior) for i in free])
    out = np.repeat(origin[None], number, axis=0)
    out[:, free] = np.clip(origin[free] + (2.0 * cube - 1.0) * width, goal.low, goal.high)
    return out


def _at_bound(problem: Problem, goal: Objective, best: Descent) -> tuple[str, ...]:
    at = best.u[goal.free]
    edge = (at <= goal.low + EDGE) | (at >= goal.high - EDGE)
    # The bounds of a candidate are where its physics ends: a share of 1, a friction of 0.
    own = np.concatenate([np.zeros(0, int), *problem.candidates.values()])
    return tuple(
        problem.coordinates[i].key
        for i, e in zip(goal.free, edge, strict=True)
        if e and not problem.coordinates[i].physical and i not in own
    )
