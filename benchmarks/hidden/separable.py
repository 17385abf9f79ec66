"""What a table can tell, from the generator's own physics: how much of an effect a refit of the soil leaves, and which
other effects could imitate it. The tool is not asked."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from . import bed_effects
from .bed import Soil, measure
from .bed_logs import Truth

SEPARABLE = 10.0
"""Least length in sigma of what no refit of the soil explains, for an effect to count as separable by a table."""
TELLS = 5.0
"""The same for one effect against another."""

_SOIL = ("k_phi", "n", "cohesion", "friction_angle", "modulus_x", "modulus_y")


def left_over(truth: Truth, names: Sequence[str], scale: float = 1.0, replicates: int = 3) -> float:
    """Length in sigma of the noise-free misfit of soil and the effects `names`, all refitted to the truth.

    Args:
      truth: what is measured. names: effects of the model that is refitted. scale: of the noise.
      replicates: runs behind each point.
    """
    clean = truth.clean()
    sigma = {q: scale * truth.sigma[q] / np.sqrt(replicates) for q in truth.channels}
    start = np.zeros(len(_SOIL))
    kinds = {**bed_effects.KNOWN, **bed_effects.OUTSIDE}
    rng = np.random.default_rng(1)
    shapes = [(n, k, v) for n in names for k, v in kinds[n].draw(rng, truth.points.radius).items()]

    def residual(u: np.ndarray) -> np.ndarray:
        values = {k: getattr(truth.soil, k) * np.exp(0.3 * x) for k, x in zip(_SOIL, u, strict=False)}
        effects: dict[str, dict[str, float]] = {n: {} for n in names}
        for (n, k, v), x in zip(shapes, u[len(_SOIL) :], strict=True):
            effects[n][k] = x * v
        hidden = [bed_effects.make(n, p, truth.points.radius) for n, p in effects.items()]
        with np.errstate(all="ignore"):
            got = measure(truth.points, dataclasses.replace(Soil(truth.soil.k_c), **values), hidden, truth.law)
        out = np.concatenate([(got[q] - clean[q]) / sigma[q] for q in truth.channels])
        return np.where(np.isfinite(out), out, 1e3)

    best = np.inf
    for amount in (0.3, -0.3) if shapes else (0.0,):
        first = np.concatenate([start, np.full(len(shapes), amount)])
        found = least_squares(residual, first, x_scale=0.3, method="trf", max_nfev=25, bounds=(-15.0, 15.0))
        best = min(best, float(np.sqrt(2.0 * found.cost)))
    return best
