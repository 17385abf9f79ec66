"""Multiple shooting: windows of a log that begin at the measured state, before whole rollouts are fitted.

In a whole rollout what a wrong model does to the course of a drive adds up, until a descent sees little else; in
windows it begins anew. Source: Bock (1983), with the states at the windows' edges measured rather than fitted.
"""

from __future__ import annotations

import numpy as np

from lunar_mjx.inference.descent import descend
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.problem import Problem

FAR = 5.0
"""Root mean square residual in sigma of the model as given from which windows are fitted first. Nearer, whole rollouts
are nearly linear in the parameters: of five campaigns with one missing effect four begin at 2 to 3, one at 43."""
_ITERATIONS = 8
"""Steps of the descent in windows, whose end is but a start."""


def shoot(problem: Problem, free: np.ndarray, start: np.ndarray, progress: Progress = silent) -> np.ndarray:
    """Where whole rollouts begin: at a fit of windows, if the start is far from the measurements and that is nearer.

    Args:
      problem: model and measurements. free: places of the coordinates that move. start: (coordinates,).
      progress: told when windows are fitted.

    Returns:
      (coordinates,).
    """
    if not problem.has_windows:
        return start
    fitted = problem.observations.in_split("fit")
    whole = Objective(problem, free, fitted)
    given = float(whole.residuals(start[None])[1][0])
    if given < FAR**2 * int(fitted.sum()):
        return start
    progress("fitting windows", 0.0)
    with problem.in_windows():
        found = descend(Objective(problem, free, fitted), start, iterations=_ITERATIONS)
    return found.u if float(whole.residuals(found.u[None])[1][0]) < given else start
