"""Finished fits, so that a diagnosis that was stopped goes on where it was."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem

_KEPT = 1e-3
"""Share of chi-square by which a fit may be off that is recalled at its old place."""


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
        """The fit with these effects at its old place, its residual and Jacobian computed anew; None if unknown.

        One that was made with an error of the time step of its own is recalled with that.
        """
        entry = self.entries.get("+".join(effects))
        free = problem.free(effects)
        if entry is None or set(entry["u"]) != {problem.coordinates[i].key for i in free}:
            return None
        u = problem.origin()
        for i in free:
            u[i] = entry["u"][problem.coordinates[i].key]
        if entry.get("own_step_error"):
            problem.renew_step_error(u, 0.0)
        goal = Objective(problem, free, problem.observations.in_split("fit"))
        wide = np.array([entry["wide"][problem.coordinates[i].key] for i in free]) if entry.get("wide") else None
        problem.foresee(u[None], free)
        if wide is not None:
            problem.foresee_wide(u, free, wide)
        residual, chi2 = goal.residuals(u[None])
        # elsewhere than it was: the physics is another by now, and the certificate is not its own
        if not abs(chi2[0] - entry.get("chi2", np.nan)) <= 1.0 + _KEPT * abs(chi2[0]):
            return None
        jacobian = goal.jacobian(u)
        if wide is not None:
            jacobian = goal.without_jumps(jacobian, goal.wide_jacobian(u, wide))
        return Fit(
            u=u,
            free=free,
            chi2=float(chi2[0]),
            residual=residual[0],
            jacobian=jacobian,
            fitted=goal.fitted,
            gradient=entry["gradient"],
            starts=tuple(entry["starts"]),
            at_bound=tuple(entry["at_bound"]),
            extra=entry["extra"],
            problems=tuple(entry["problems"]),
            step_error=problem.kept_step_error(),
            own_step_error=bool(entry.get("own_step_error")),
            wide=wide,
        )

    def place(self, problem: Problem, name: str) -> np.ndarray | None:
        """(coordinates,) as kept under a name; None if unknown or of other coordinates."""
        entry = self.entries.get(f"at {name}")
        free = problem.free()
        if entry is None or set(entry) != {problem.coordinates[i].key for i in free}:
            return None
        u = problem.origin()
        u[free] = [entry[problem.coordinates[i].key] for i in free]
        return u

    def keep_place(self, problem: Problem, name: str, u: np.ndarray) -> None:
        """Remembers the baseline's coordinates at a place."""
        self._store(f"at {name}", {problem.coordinates[i].key: float(u[i]) for i in problem.free()})

    def keep(self, problem: Problem, effects: Sequence[str], found: Fit) -> None:
        """Remembers a fit."""
        entry = {
            "u": {problem.coordinates[i].key: float(found.u[i]) for i in found.free},
            "gradient": found.gradient,
            "starts": list(found.starts),
            "at_bound": list(found.at_bound),
            "extra": dict(found.extra),
            "problems": list(found.problems),
            "chi2": found.chi2,
            "own_step_error": found.own_step_error,
            "wide": None
            if found.wide is None
            else {problem.coordinates[i].key: float(w) for i, w in zip(found.free, found.wide, strict=True)},
        }
        self._store("+".join(effects), entry)

    def _store(self, name: str, entry: Mapping[str, Any]) -> None:
        with self._lock:
            self.entries[name] = entry
            if self._save is not None:
                self._save(dict(self.entries))
