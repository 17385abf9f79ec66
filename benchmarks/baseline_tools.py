"""Other tools on a wheel table: a parameter refit with mujoco.sysid, and pySINDy on what the refit leaves.

Both are lent our wheel bed, the scales and bounds of its parameters, the noise of the points and the split.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import types
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar_mjx.errors import UserError

FEATURES = ("slip", "angle", "load", "sinkage")
"""What a formula may hold."""
THRESHOLDS, RIDGES = (0.3, 1.0, 3.0, 10.0, 30.0), (1e-6, 1e-2, 1.0)
"""Tried in pySINDy: least coefficient, sigma per unit of a feature (scaled to a largest value of 1), and ridge."""
_SPARSER = 1.02
"""Factor on the smallest held-out error within which fewer terms are better."""
_FARTHEST = 15.0
"""Scales by which a refit may move a parameter at most, where its own bounds allow more."""
_FIRST = 0.3
"""Size of an effect at the start of its refit, as a share of its nominal one."""


def require() -> None:
    """Refuses to start without the other tools.

    Raises:
      UserError: which one is missing, and what to install.
    """
    from mujoco import sysid

    if not hasattr(sysid, "optimize"):
        raise UserError("mujoco.sysid is not complete here; pip install 'lunar-mjx[baselines]' brings what it needs.")
    try:
        import pysindy  # noqa: F401
    except ImportError:
        raise UserError("pySINDy is not installed; pip install 'lunar-mjx[baselines]' brings it.") from None


# --- the refit --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, eq=False)
class Refit:
    """A fit by mujoco.sysid: its effect or "" for the soil alone, place, moved coordinates, residual (n,) in sigma."""

    effect: str
    u: np.ndarray
    free: np.ndarray
    residual: np.ndarray
    evaluations: int


def sysid_fit(problem: Any, effect: str, start: np.ndarray, most: int = 40) -> Refit:
    """Fits the soil and one effect's parameters to the fitted slip angles with mujoco.sysid's own optimiser.

    Args:
      problem: the table. effect: candidate, or "". start: (coordinates,) where to begin. most: iterations.
    """
    from mujoco import sysid

    free = problem.free([effect] if effect else [])
    value, sigma = problem.observations.value, problem.observations.sigma()
    fitted = problem.observations.in_split("fit")
    low, high = (np.clip(b, -_FARTHEST, _FARTHEST) for b in problem.bounds(free))
    count = 0

    def residual(u: np.ndarray) -> np.ndarray:
        nonlocal count
        count += 1
        away = (problem.predict(u[None])[0] - value) / sigma
        return np.where(np.isfinite(away), away, 1e3)

    def at(x: np.ndarray) -> np.ndarray:
        u = start.copy()
        u[free] = np.clip(np.asarray(x, float).ravel(), low, high)
        return u

    def residual_fn(x: np.ndarray, params: Any) -> tuple[list[np.ndarray], None, None]:
        del params
        if np.ndim(x) == 1:
            return [residual(at(x))[fitted]], None, None
        # its finite differences hand over one column per parameter
        return [np.stack([residual(at(column))[fitted] for column in np.transpose(x)], axis=1)], None, None

    params = sysid.ParameterDict()
    for i, a, b in zip(free, low, high, strict=True):
        params.add(sysid.Parameter(problem.coordinates[i].key, float(np.clip(start[i], a, b)), a, b))
    params.move_off_bounds()  # as its own warning advises
    with contextlib.redirect_stdout(io.StringIO()):
        found, _ = sysid.optimize(params, residual_fn, verbose=False, max_iters=most)
    u = at(found.as_vector())
    return Refit(effect, u, free, residual(u), count)


def refits(problem: Any) -> list[Refit]:
    """The soil alone, then the soil with each candidate that changes anything, the better of its starts."""
    fitted = problem.observations.in_split("fit")
    base = sysid_fit(problem, "", problem.origin())
    found = [base]
    for effect, places in problem.candidates.items():
        amounts = [i for i in places if problem.coordinates[i].amplitude]
        low, _ = problem.bounds(np.array(amounts, int))
        signs = (1.0, -1.0) if np.any(low < 0.0) else (1.0,)
        tried = []
        for sign in signs:
            start = base.u.copy()
            start[amounts] = np.maximum(sign * _FIRST, low)
            if not np.allclose(problem.predict(start[None]), problem.predict(base.u[None]), rtol=1e-7, atol=1e-9):
                tried.append(sysid_fit(problem, effect, start))
        if tried:
            found.append(min(tried, key=lambda f: float(np.sum(f.residual[fitted] ** 2))))
    return found


def at_noise(problem: Any, residual: np.ndarray, free: np.ndarray, *splits: str) -> bool:
    """Our noise test of a residual (n,) in sigma, lent to the other tools."""
    from lunar_mjx.inference.held_out import noise_test

    fit = types.SimpleNamespace(residual=residual, free=free, fitted=problem.observations.in_split("fit"))
    return noise_test(problem, fit, splits).passes


def answers(problem: Any, found: Sequence[Refit]) -> dict[str, dict[str, Any]]:
    """What the two rules say: verdict and named effects by rule."""
    held = problem.observations.in_split("select")
    error = {f.effect: float(np.sqrt(np.mean(f.residual[held] ** 2))) for f in found}
    noise = {f.effect: at_noise(problem, f.residual, f.free, "fit", "select") for f in found}
    first = min(error, key=lambda n: error[n])
    best = min((n for n in error if n), key=lambda n: error[n])

    def says(name: str) -> dict[str, Any]:
        return {"verdict": "KNOWN" if name else "NOISE_ONLY", "named": [name] if name else []}

    careful = says("") if noise[""] else says(best) if noise[best] else {"verdict": "UNKNOWN", "named": []}
    return {"smallest": says(first), "careful": careful, "held_out_error": error, "at_noise": noise}


# --- the formula ------------------------------------------------------------------------------------------------------


def features(problem: Any, base: Refit) -> np.ndarray:
    """(points, 4) slip ratio, slip angle, load and the refit's sinkage, each over its largest size.

    The measured sinkage would bring its own noise into the formula for itself.
    """
    s = next(s for s in problem.observations.series if s.channel == "sinkage_m")
    part = slice(s.start, s.stop)
    sinkage = problem.observations.value[part] + base.residual[part] * problem.observations.sigma()[part]
    x = np.column_stack([problem.observations.place[part], sinkage])
    return x / np.abs(x).max(axis=0)


def sindy(problem: Any, base: Refit) -> dict[str, Any]:
    """A sparse polynomial for what a refit leaves of each channel.

    Returns:
      Terms by channel with the rise of chi-square when each is removed, dearest first; root mean square of the formula
      by channel and held-out error, in sigma; whether refit and formula are at the noise on held-out points.
    """
    import pysindy

    observations = problem.observations
    channels = [s.channel for s in observations.series]
    # Every channel has the same points. What is missing is measured less predicted.
    target = np.column_stack([-base.residual[s.start : s.stop] for s in observations.series])
    first = slice(observations.series[0].start, observations.series[0].stop)
    fitted, held = observations.in_split("fit")[first], observations.in_split("select")[first]
    library = pysindy.PolynomialLibrary(degree=2)
    theta = np.asarray(library.fit_transform(features(problem, base)))
    tried = [np.zeros((len(channels), theta.shape[1]))]
    for threshold in THRESHOLDS:
        for ridge in RIDGES:
            optimiser = pysindy.STLSQ(threshold=threshold, alpha=ridge)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # it says that a threshold leaves nothing
                optimiser.fit(theta[fitted], target[fitted])
            tried.append(np.asarray(optimiser.coef_))
    error = [float(np.sqrt(np.mean((target - theta @ c.T)[held] ** 2))) for c in tried]
    near = [i for i, e in enumerate(error) if e <= _SPARSER * min(error)]
    best = min(near, key=lambda i: (np.count_nonzero(tried[i]), error[i]))
    predicted = theta @ tried[best].T
    names = library.get_feature_names(list(FEATURES))
    terms = {c: _terms(theta[fitted], target[fitted][:, k], tried[best][k], names) for k, c in enumerate(channels)}
    strength = dict(zip(channels, np.sqrt(np.mean(predicted[fitted] ** 2, axis=0)).tolist(), strict=True))
    return {
        "terms": terms,
        "strength": strength,
        "held_out_error": error[best],
        "silent": not any(terms.values()),
        "number_of_terms": sum(len(t) for t in terms.values()),
        "at_noise": at_noise(problem, -(target - predicted).T.ravel(), base.free, "select"),
    }


def _terms(theta: np.ndarray, target: np.ndarray, row: np.ndarray, names: Sequence[str]) -> list[tuple[str, float]]:
    """Terms of one channel's formula with the rise of chi-square where each is removed and the others are refitted."""
    active = np.flatnonzero(row)

    def chi2(columns: np.ndarray) -> float:
        if not len(columns):
            return float(target @ target)
        left = target - theta[:, columns] @ np.linalg.lstsq(theta[:, columns], target, rcond=None)[0]
        return float(left @ left)

    whole = chi2(active)
    return sorted(((names[i], chi2(active[active != i]) - whole) for i in active), key=lambda r: -r[1])
