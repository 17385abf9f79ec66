"""How well a table could be fitted by someone who was told what is hidden and how the noise is correlated.

Weighted least squares by the generator's own physics, linear about the truth: no unbiased estimate
without priors does better.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .bed import effects as bed_effects
from .bed.bench import Points, measure
from .bed.logs import DECAY, Truth
from .noise import Recipe

_SOIL = ("k_phi", "n", "cohesion", "friction_angle", "modulus_x", "modulus_y")
_STEP = 1e-4
_95 = 1.959964
_RANK = 1e-12


@dataclasses.dataclass(frozen=True, eq=False)
class Observed:
    """What a tool made of a table, one entry per observation.

    Attributes:
      channel, points: what was measured, and where. value: measured, the mean over replicates.
      fitted: whether the tool may fit it.
    """

    channel: np.ndarray
    points: Points
    value: np.ndarray
    fitted: np.ndarray


def told(truth: Truth, recipe: Recipe, seen: Observed, replicates: int = 3) -> dict[str, Any]:
    """The best that soil and hidden effects, refitted to the fitted observations, could do.

    Args:
      truth: what is measured and hidden. recipe: of the noise. seen: the observations. replicates: runs behind each.

    Returns:
      `over_floor`: root mean square over the observations left out, over that of the truth itself (None if there are
      none); `parameters`: relative error of each hidden one that shows, and whether its 95 % interval covers the truth.
    """
    names = [(effect, key) for effect, values in truth.effects.items() for key in values]
    sigma = np.array([truth.sigma[c] for c in seen.channel]) * recipe.scale / np.sqrt(replicates)
    clean = true_values(truth, seen) / sigma
    columns = [
        (_predicted(truth, seen, names, e) - _predicted(truth, seen, names, -e)) / (2.0 * _STEP * sigma)
        for e in _STEP * np.eye(len(_SOIL) + len(names))
    ]
    jacobian, noise, fitted = np.stack(columns, axis=1), seen.value / sigma - clean, seen.fitted
    known = np.linalg.inv(_correlation(seen, recipe)[np.ix_(fitted, fitted)])
    information = np.diag(jacobian[fitted].T @ known @ jacobian[fitted])
    felt = information > 0.0  # a number of grousers beyond which another adds nothing is not
    size = np.where(felt, 1.0 / np.sqrt(np.where(felt, information, 1.0)), 0.0)
    scaled = jacobian * size
    covariance = np.linalg.pinv(scaled[fitted].T @ known @ scaled[fitted], rcond=_RANK, hermitian=True)
    away = covariance @ scaled[fitted].T @ known @ noise[fitted]
    left = (noise - scaled @ away)[~fitted]
    std = size * np.sqrt(np.diag(covariance))
    ends = zip(names, (size * away)[len(_SOIL) :], std[len(_SOIL) :], felt[len(_SOIL) :], strict=True)
    rows = [
        {"effect": effect, "name": key, "error": float(abs(a)), "covered": bool(abs(a) <= _95 * s)}
        for (effect, key), a, s, shows in ends
        if shows
    ]
    floor = np.sqrt(np.mean(noise[~fitted] ** 2)) if left.size else 0.0
    return {"over_floor": float(np.sqrt(np.mean(left**2)) / floor) if floor else None, "parameters": rows}


def true_values(truth: Truth, seen: Observed) -> np.ndarray:
    """(n,) what would have been measured without noise."""
    return _predicted(truth, seen, [], np.zeros(len(_SOIL)))


def _predicted(truth: Truth, seen: Observed, names: list[tuple[str, str]], u: np.ndarray) -> np.ndarray:
    """(n,) predictions with the soil and the hidden parameters changed by shares (coordinates,) of themselves."""
    soil = {k: getattr(truth.soil, k) * (1.0 + x) for k, x in zip(_SOIL, u, strict=False)}
    effects = {effect: dict(values) for effect, values in truth.effects.items()}
    for (effect, key), x in zip(names, u[len(_SOIL) :], strict=True):
        effects[effect][key] *= 1.0 + x
    hidden = [bed_effects.make(n, p, truth.points.radius) for n, p in effects.items()]
    found = measure(seen.points, dataclasses.replace(truth.soil, **soil), hidden, truth.law)
    return np.select([seen.channel == c for c in truth.channels], [found[c] for c in truth.channels])


def _correlation(seen: Observed, recipe: Recipe) -> np.ndarray:
    """(n, n) of the noise: along each sweep, in the order of slip, where it is coloured."""
    if recipe.kind != "coloured":
        return np.eye(len(seen.value))
    sweep = np.stack([np.unique(seen.channel, return_inverse=True)[1], seen.points.angle, seen.points.load], axis=1)
    place = np.empty(len(seen.value))
    number = np.unique(sweep, axis=0, return_inverse=True)[1].reshape(-1)
    for k in range(number.max() + 1):
        mine = np.flatnonzero(number == k)
        place[mine[np.argsort(seen.points.slip[mine])]] = np.arange(len(mine))
    return np.where(number[:, None] == number, DECAY ** np.abs(place[:, None] - place), 0.0)
