"""Unknown inputs at the ports: what the measurements would show if something nobody modelled acted there.

For drives an input is a course over time, one of its own in every log, with a random-walk prior between knots; for
steady-state tables it is a smooth function of slip, slip angle and load.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.tables.problem import TableProblem
from lunar_mjx.diagnosis.unknown_inputs.inputs import PROBES, present, unknown_input
from lunar_mjx.inference.fitting import Fit, Progress
from lunar_mjx.inference.problem import Problem

KNOTS = 8
"""Knots of an unknown input over the longest log."""
_LENGTHS = (0.35, 25.0, 0.3)
"""Length scales of an unknown input over slip ratio, slip angle in deg, and relative load."""


def port_columns(problem: Problem, fit: Fit, progress: Progress) -> dict[str, np.ndarray]:
    """Whitened signatures of unknown inputs, by label; columns have unit prior variance at the input's typical size."""
    if isinstance(problem, TableProblem):
        return _table_columns(problem, fit)
    assert isinstance(problem, DriveProblem)
    return _drive_columns(problem, fit, progress)


def _table_columns(problem: TableProblem, fit: Fit) -> dict[str, np.ndarray]:
    labels = [
        label for label, probe in PROBES.items() if probe[0] in ("geometry", "soil", "wheel_normal", "wheel_shear")
    ]
    probes = {label: unknown_input(label, 1, 1.0) for label in labels}
    other = TableProblem(
        problem.logs,
        problem.fitted_bed(fit.u),
        {p.name: p for p in probes.values()},
        problem.splits,
        extra_sigma=problem.extra_sigma,
    )
    observations = problem.observations
    modes = _smooth_modes(observations.place)
    which = np.array([other.candidates[probes[label].name][0] for label in labels])
    columns = other.observations.whiten(other.jacobian(other.origin(), which))
    return {label: columns[:, [i]] * modes for i, label in enumerate(labels)}


def _smooth_modes(place: np.ndarray | None) -> np.ndarray:
    """(n, modes) principal modes of a smooth random function of the points, together of unit variance."""
    assert place is not None
    scaled = np.column_stack([place[:, 0] / _LENGTHS[0], place[:, 1] / _LENGTHS[1], np.log(place[:, 2]) / _LENGTHS[2]])
    unique, inverse = np.unique(np.round(scaled, 6), axis=0, return_inverse=True)
    distance = np.sum((unique[:, None] - unique[None]) ** 2, axis=-1)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * distance))
    keep = values > 1e-3 * values.max()
    return (vectors[:, keep] * np.sqrt(values[keep]))[inverse.reshape(-1)]


def _drive_columns(problem: DriveProblem, fit: Fit, progress: Progress) -> dict[str, np.ndarray]:
    span = max(r.end - r.begin for r in problem.bench.runs)
    probes = {label: unknown_input(label, KNOTS, span) for label in PROBES}
    ports = frozenset(port for e in problem.model.effects for port in e.ports)
    usable = {label: p for label, p in probes.items() if present(label, ports)}
    other = problem.with_candidates({p.name: p for p in usable.values()}, fit, progress)
    observations = problem.observations
    which = np.concatenate([other.candidates[p.name] for p in usable.values()])
    jacobian = observations.whiten(other.jacobian(other.origin(), which))
    found = {}
    for label, probe in usable.items():
        columns = jacobian[:, np.isin(which, other.candidates[probe.name])]
        found[label] = _walk(_by_log(problem, np.where(np.isfinite(columns), columns, 0.0)))
    found |= _sensor_columns(problem, span)
    return found


def _by_log(problem: DriveProblem, columns: np.ndarray) -> list[np.ndarray]:
    """The columns of every log by itself: an unknown input of one log is no other log's."""
    parts = []
    for number in range(len(problem.logs)):
        own = np.zeros_like(columns)
        for s in problem.observations.series:
            if s.log == number:
                own[s.start : s.stop] = columns[s.start : s.stop]
        parts.append(own)
    return parts


def _walk(parts: list[np.ndarray]) -> np.ndarray:
    """Columns of a random walk from the columns of its knots: unit steps, from a start of unit size."""
    return np.concatenate([np.cumsum(p[:, ::-1], axis=1)[:, ::-1] for p in parts], axis=1)


def _sensor_columns(problem: DriveProblem, span: float) -> dict[str, np.ndarray]:
    """Unknown inputs that act on one kind of channel alone, a course over time in every log."""
    observations = problem.observations
    kinds: dict[str, list[Any]] = {}
    for s in observations.series:
        parts = s.channel.split("_")
        kind = "_".join(w for w in parts if w not in ("lf", "rf", "lm", "rm", "lr", "rr", "x", "y", "z"))
        kinds.setdefault(kind, []).append(s)
    found = {}
    for kind, series in kinds.items():
        columns = np.zeros((len(observations), KNOTS))
        for s in series:
            assert s.time is not None
            place = (s.time - problem.bench.runs[s.log].begin) / span * (KNOTS - 1)
            hats = np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(KNOTS)))
            columns[s.start : s.stop] = hats * np.sqrt(np.square(s.white) + s.coloured**2)
        found[f"sensor: {kind}"] = _walk(_by_log(problem, observations.whiten(columns)))
    return found
