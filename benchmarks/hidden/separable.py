"""What a table can tell, from the generator's own physics: how much of an effect a refit of the soil leaves, and which
other effects could imitate it. The tool is not asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
from scipy.optimize import least_squares

from .bed import effects as bed_effects
from .bed.bench import Soil, measure
from .bed.logs import Truth

SEPARABLE = 10.0
"""Least length in sigma of what no refit of the soil explains, for an effect to count as separable by a table."""
TELLS = 5.0
"""The same for one effect against another."""

_SOIL = ("k_phi", "n", "cohesion", "friction_angle", "modulus_x", "modulus_y")


_SHAPES = ("density", "count")
"""Parameters that mean nothing while their effect has no size."""
_NULLS = {("exit_angle", "c1"): 0.5}
"""Values at which an amplitude vanishes, where it is not zero."""
_SURELY = 4.0
"""Times `SEPARABLE` that a linear estimate must leave for an effect not to be refitted as well."""


def left_over(truth: Truth, names: Sequence[str], scale: float = 1.0, replicates: int = 3) -> float:
    """Length in sigma of the noise-free misfit of soil and the effects `names`, all refitted to the truth.

    Args:
      truth: what is measured. names: effects of the model that is refitted. scale: of the noise.
      replicates: runs behind each point.
    """
    residual, amounts = _misfit(truth, names, scale, replicates)
    best = np.inf
    for amount in (0.3, -0.3) if amounts else (0.0,):
        first = np.concatenate([np.zeros(len(_SOIL)), np.full(amounts, amount)])
        found = least_squares(residual, first, x_scale=0.3, method="trf", max_nfev=25, bounds=(-15.0, 15.0))
        best = min(best, float(np.sqrt(2.0 * found.cost)))
    return best


def nearest(truth: Truth, scale: float = 1.0, replicates: int = 3) -> tuple[str, float]:
    """The effect of the catalogue, not hidden itself, that imitates the truth best, and the sigma that it leaves.

    Linear estimates at the refitted soil screen the effects; only those that come near are refitted.
    """
    plain, _ = _misfit(truth, [], scale, replicates)
    base = least_squares(plain, np.zeros(len(_SOIL)), x_scale=0.3, max_nfev=25, bounds=(-15.0, 15.0))
    found = []
    for name in (n for n in bed_effects.KNOWN if n not in truth.effects):
        residual, amounts = _misfit(truth, [name], scale, replicates)
        at = np.concatenate([base.x, np.zeros(amounts)])
        columns = []
        for k in range(len(at)):
            step = np.zeros(len(at))
            step[k] = 0.1 if k >= len(_SOIL) else 1e-3
            columns.append(
                (residual(at + step) - residual(at + (0.0 if k >= len(_SOIL) else -1.0) * step))
                / (step[k] * (1.0 if k >= len(_SOIL) else 2.0))
            )
        jacobian = np.stack(columns, axis=1)
        solved = np.linalg.lstsq(jacobian, base.fun, rcond=1e-10)[0]
        left = float(np.linalg.norm(base.fun - jacobian @ solved))
        found.append((left, name))
    refitted = [
        (min(left, left_over(truth, [n], scale, replicates)) if left < _SURELY * SEPARABLE else left, n)
        for left, n in sorted(found)
    ]
    left, name = min(refitted)
    return name, left


def _misfit(
    truth: Truth, names: Sequence[str], scale: float, replicates: int
) -> tuple[Callable[[np.ndarray], np.ndarray], int]:
    """Residual in sigma as a function of the soil's and the effects' coordinates, and the number of the latter."""
    clean = truth.clean()
    sigma = {q: scale * truth.sigma[q] / np.sqrt(replicates) for q in truth.channels}
    kinds = {**bed_effects.KNOWN, **bed_effects.OUTSIDE}
    rng = np.random.default_rng(1)
    shapes = [(n, k, v) for n in names for k, v in kinds[n].draw(rng, truth.points.radius).items()]

    def residual(u: np.ndarray) -> np.ndarray:
        values = {k: getattr(truth.soil, k) * np.exp(0.3 * x) for k, x in zip(_SOIL, u, strict=False)}
        effects: dict[str, dict[str, float]] = {n: {} for n in names}
        for (n, k, v), x in zip(shapes, u[len(_SOIL) :], strict=True):
            null = _NULLS.get((n, k), 0.0)
            effects[n][k] = v * np.exp(0.3 * x) if k in _SHAPES else null + x * (v - null)
        hidden = [bed_effects.make(n, p, truth.points.radius) for n, p in effects.items()]
        with np.errstate(all="ignore"):
            got = measure(truth.points, dataclasses.replace(Soil(truth.soil.k_c), **values), hidden, truth.law)
        out = np.concatenate([(got[q] - clean[q]) / sigma[q] for q in truth.channels])
        return np.where(np.isfinite(out), out, 1e3)

    return residual, len(shapes)
