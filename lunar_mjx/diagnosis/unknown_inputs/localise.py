"""Where the model fails: evidence for an unknown input at each port, and what the residual and parameters follow."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.refit import Candidate
from lunar_mjx.diagnosis.tables.problem import TableProblem
from lunar_mjx.diagnosis.unknown_inputs.probes import port_columns
from lunar_mjx.inference.fitting import Fit, Progress, silent
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.score import leash, project

_SIZES = np.geomspace(1e-3, 1e2, 21)
"""Sizes of an unknown input, in units of its typical one, over which the evidence is maximised."""
_SAME = 1.0
"""Difference of log evidence below which two ports count as one."""
COVARIATES = ("slip ratio", "slip angle", "load")


@dataclasses.dataclass(frozen=True)
class Localisation:
    """Where a model fails.

    Attributes:
      port: with the most evidence; None where no unknown input is better than noise. label: of the input there.
      ports: gain of log evidence by label of unknown input. ceiling: chi-square that any smooth input there explains.
      dependence: chi-square that a baseline parameter explains by following a covariate, "parameter ~ covariate".
    """

    port: str | None
    label: str
    ports: Mapping[str, float]
    ceiling: Mapping[str, float]
    dependence: Mapping[str, float]

    @property
    def alike(self) -> tuple[str, ...]:
        """The port, and others whose evidence is as good: the same signal may enter a bed at two of them."""
        if self.port is None:
            return ()
        best = self.ports[self.label]
        near = [label.partition(":")[0] for label, gain in self.ports.items() if gain > best - _SAME]
        return tuple(dict.fromkeys([self.port, *near]))

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only."""
        return {**dataclasses.asdict(self), "alike": list(self.alike)}


def localise(
    problem: Problem, base: Candidate, chosen: Candidate, progress: Progress = silent, always: bool = False
) -> Localisation:
    """Evidence by port for the residual that is left with the effects named.

    Args:
      problem: model and measurements. base: the model as it is, refitted. chosen: with the effects that are named.
      progress: told of simulations.
      always: also where the residual is at the noise.
    """
    if not always and chosen.at_noise:
        return Localisation(None, "", {}, {}, {})
    at = base.fit if not chosen.effects or chosen.at_noise else chosen.fit
    if chosen.patterned and chosen.pattern is not None:
        # What is left is too small for inputs that differ from log to log.
        ordered = {label: 0.5 * z * abs(z) for label, z in chosen.pattern.z.items()}
        return Localisation(chosen.pattern.port, chosen.pattern.label, ordered, {}, dependence(problem, at))
    gains, ceiling = {}, {}
    for label, signature in port_columns(problem, at, progress).items():
        gains[label], ceiling[label] = evidence(problem, at, signature)
    best = max(gains, key=lambda k: gains[k]) if gains else ""
    port = best.partition(":")[0] if best and gains[best] > 3.0 else None
    ordered = dict(sorted(gains.items(), key=lambda item: -item[1]))
    return Localisation(port, best, ordered, ceiling, dependence(problem, at))


def pattern(problem: Problem, fit: Fit) -> float:
    """Log evidence of the best smooth unknown input in what a fit to tables leaves; 0 for drives (see `patterns`).

    A root mean square at the noise may hide a small misfit that all manoeuvres share, most of all in coloured noise.
    """
    if not isinstance(problem, TableProblem):
        return 0.0
    columns = port_columns(problem, fit, silent)
    return max((evidence(problem, fit, signature)[0] for signature in columns.values()), default=0.0)


def evidence(problem: Problem, fit: Fit, signature: np.ndarray) -> tuple[float, float]:
    """Gain of the log evidence by an unknown input of the best size, and the chi-square that it explains.

    Args:
      problem: model and measurements. fit: where the residual is taken. signature: (n, m) whitened, unit prior.
    """
    keep = problem.observations.in_split("fit", "select")
    columns = project(signature[keep], fit.jacobian[keep], leash(problem, fit))[: int(keep.sum())]
    residual = fit.residual[keep]
    u, s, _ = np.linalg.svd(columns, full_matrices=False)
    along = u.T @ residual
    gains = []
    for size in _SIZES:
        power = (size * s) ** 2
        gains.append(0.5 * float(np.sum(along**2 * power / (1.0 + power)) - np.sum(np.log1p(power))))
    k = int(np.argmax(gains))
    power = (_SIZES[k] * s) ** 2
    return max(gains[k], 0.0), float(np.sum(along**2 * power / (1.0 + power)))


def dependence(problem: Problem, fit: Fit) -> dict[str, float]:
    """Chi-square that each baseline parameter explains by following slip, slip angle or load (tables)."""
    place = problem.observations.place
    if place is None:
        return {}
    keep = fit.fitted
    _, scale = problem.prior_rows(fit.u, fit.free)
    out = {}
    for k, i in enumerate(fit.free):
        for n, name in enumerate(COVARIATES):
            z = np.abs(place[keep, n]) if name == "slip angle" else place[keep, n]
            if np.ptp(z) <= 1e-3 * max(np.abs(z).max(), 1e-12):
                continue
            z = (z - z.mean()) / z.std()
            column = project((fit.jacobian[keep, k] * z)[:, None], fit.jacobian[keep], scale)[: int(keep.sum()), 0]
            length = float(np.linalg.norm(column))
            if length > 1e-6:
                out[f"{problem.coordinates[i].key} ~ {name}"] = float((column @ fit.residual[keep] / length) ** 2)
    return dict(sorted(out.items(), key=lambda item: -item[1])[:12])
