"""Whether a small residual of drives has a pattern: smooth unknown inputs at the ports, beyond what was refitted.

A root mean square at the noise hides a misfit that all manoeuvres share, and what no candidate does, no score shows.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS, PROBES
from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.score import SEPARABLE, blocks, evidence_of, outside, span


@dataclasses.dataclass(frozen=True)
class Unlisted:
    """An unknown input of one amount that explains what one effect of the catalogue does.

    Attributes:
      label, quantity: of the input, and what it follows. chi2: that it explains of the baseline's residual.
      ahead: chi-square that it explains beyond what the effect does.
    """

    label: str
    quantity: str
    chi2: float
    ahead: float

    def __str__(self) -> str:
        port, _, what = self.label.partition(": ")
        follows = "" if self.quantity == "constant" else f" in proportion to {self.quantity}"
        return f"something unlisted at the port {port} ({what or port.replace('_', ' ')}{follows})"


@dataclasses.dataclass(frozen=True)
class Pattern:
    """What smooth unknown inputs explain of a residual.

    Attributes:
      label: of the input whose evidence is strongest; empty where none leaves a separable signal.
      p: how often the strongest of all inputs would be as strong on noise alone. chi2: that it explains.
      z: significance in sigma of every input, by label.
      alone: chi-square over the fitted observations by each input that follows one quantity, by (label, quantity).
    """

    label: str = ""
    p: float = 1.0
    chi2: float = 0.0
    z: Mapping[str, float] = dataclasses.field(default_factory=dict)
    alone: Mapping[tuple[str, str], float] = dataclasses.field(default_factory=dict)

    @property
    def port(self) -> str:
        """Where the strongest input acts."""
        return self.label.partition(":")[0]

    def elsewhere(self, ports: frozenset[str]) -> tuple[str, str, float]:
        """Label, quantity and chi-square of the best input of one quantity at none of these ports."""
        others = {k: v for k, v in self.alone.items() if PROBES[k[0]][0] not in ports}
        label, quantity = max(others, key=lambda k: others[k], default=("", ""))
        return label, quantity, others.get((label, quantity), 0.0)

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        alone = {f"{label} with {quantity}": v for (label, quantity), v in self.alone.items()}
        return {**dataclasses.asdict(self), "alone": alone}


def find_pattern(
    problem: Problem, fit: Fit, columns: Mapping[str, np.ndarray], draws: int = 2000, seed: int = 0
) -> Pattern:
    """The strongest smooth unknown input in what a fit at the noise leaves.

    Each input is tested as a whole, with the variance of blocks of the residual; directions in which an input of usual
    size leaves less than `SEPARABLE` sigma after a refit are not tested. The p value is the larger of the bootstrap's
    for the maximum over inputs and Bonferroni's of the chi-square.

    Args:
      problem: model and measurements. fit: whose residual is at the noise.
      columns: (n, m) whitened derivatives with respect to every input's amplitudes, by label.
      draws: of the multiplier bootstrap. seed: of its weights.
    """
    keep = problem.observations.in_split("fit", "select")
    residual, q = _with_priors(problem, fit, keep)
    number = blocks(problem.observations, fit.residual, keep)[keep]
    # every prior is a block of its own
    block = np.concatenate([number, number.max(initial=-1) + 1 + np.arange(len(fit.free))])
    rng = np.random.default_rng(seed)
    weights = rng.choice([-1.0, 1.0], size=(draws, int(block.max(initial=0)) + 1))
    chi2, z, boots = {}, {}, []
    for label, signature in columns.items():
        u, s, _ = np.linalg.svd(outside(signature[keep], q), full_matrices=False)
        u = u[:, s > SEPARABLE]
        if u.shape[1]:
            _, chi2[label], z[label], boot = evidence_of(u, residual, block, weights)
            boots.append(boot)
    alone = _alone(problem, fit, columns)
    if not z:
        return Pattern(alone=alone)
    best = max(z, key=lambda label: z[label])
    highest = np.max(boots, axis=0)
    p = (1.0 + float(np.sum(highest >= z[best]))) / (draws + 1.0)
    bonferroni = len(z) * float(stats.norm.sf(z[best]))
    return Pattern(best, min(max(p, bonferroni), 1.0), chi2[best], dict(sorted(z.items(), key=lambda i: -i[1])), alone)


def _alone(problem: Problem, fit: Fit, columns: Mapping[str, np.ndarray]) -> dict[tuple[str, str], float]:
    """Drop of the fit's chi-square by every separable input of one quantity, by (label, quantity)."""
    keep = fit.fitted
    residual, q = _with_priors(problem, fit, keep)
    out = {}
    for label, signature in columns.items():
        left = outside(signature[keep], q)
        length = np.linalg.norm(left, axis=0)
        for k, quantity in enumerate(FOLLOWS[label]):
            if length[k] > SEPARABLE:
                out[label, quantity] = float((left[:, k] @ residual / length[k]) ** 2)
    return out


def _with_priors(problem: Problem, fit: Fit, keep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n + free,) residual with that of the priors below, and an orthonormal basis of what a refit moves."""
    prior, scale = problem.prior_rows(fit.u, fit.free)
    return np.concatenate([fit.residual[keep], -prior]), span(fit.jacobian[keep], scale)
