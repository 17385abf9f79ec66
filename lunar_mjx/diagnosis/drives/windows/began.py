"""What began within a drive: suspects that act in its later windows alone, weighed by the shared search."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.windows.coordinates import Suspect, Unknown, baseline, suspects_of
from lunar_mjx.diagnosis.drives.windows.cut import Cut
from lunar_mjx.diagnosis.drives.windows.following import Follower
from lunar_mjx.diagnosis.drives.windows.form import WindowForm, WindowObservations, observe
from lunar_mjx.diagnosis.drives.windows.problem import WindowProblem
from lunar_mjx.diagnosis.drives.windows.settings import BY_MOTION, DIFFERENCES, WindowSettings
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.verdict import Diagnosis
from lunar_mjx.diagnosis.weighed import answer
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.changes import Restlessness
from lunar_mjx.inference.evidence import Field
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log


@dataclasses.dataclass(frozen=True)
class Onset:
    """How much is weighed of what began within a drive."""

    # Windows on either side of an onset that are weighed: the last before it, the first after it.
    most_before: int = 20
    most_after: int = 20
    held_out: int = 3
    """One later window of so many is held out."""
    seconds: float = 60.0
    """Time that the search may take, s."""


ONSET = Onset()


class BeganForm(WindowForm):
    """A fitted model against one drive, in which suspects act from an onset on.

    What the drive is like as a whole has coordinates of usual size. Differences at the ports are those of the later
    windows from the earlier ones: of the size by which an undisturbed drive moves, or beyond it something unlisted.
    """

    def __init__(
        self,
        problem: Callable[[str | None], WindowProblem],
        base: Sequence[Unknown],
        suspects: Sequence[Suspect],
        observations: WindowObservations,
        settings: WindowSettings,
        later: np.ndarray,
        moved: float,
    ):
        """Makes the form.

        Args:
          problem, base, suspects, observations, settings: as of `WindowForm`; the windows are of one drive.
          later: (window,) whether a window lies after the onset.
          moved: share of the usual differences by which later windows of an undisturbed drive differ from earlier ones.
        """
        super().__init__(problem, base, suspects, observations, settings)
        usual = self.usual_differences()
        self.coordinates = tuple(
            dataclasses.replace(c, prior=usual[c.name]) if i in self._field else c
            for i, c in enumerate(self.coordinates)
        )
        self._field = {}
        self._fields = tuple(
            Field(name, size if name.endswith(BY_MOTION) else moved * size) for name, size in usual.items()
        )
        self.single = False
        self._later = later[observations.at[1]]
        self._begun = np.concatenate([np.zeros(0, int), *self.candidates.values()]).astype(int)

    def _rows(self, rows: np.ndarray, soft: bool) -> np.ndarray:
        """See `WindowForm`: earlier windows without the suspects."""
        without = rows.copy()
        without[:, self._begun] = 0.0
        return np.where(self._later, super()._rows(rows, soft), super()._rows(without, False))

    def slopes(self, u: np.ndarray, wanted: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """See `WindowForm`: earlier windows do not feel the suspects."""
        value, out = super().slopes(u, wanted)
        out[np.ix_(~self._later, self._begun)] = 0.0
        return value, out

    def differences(
        self, value: np.ndarray, slopes: np.ndarray, soft: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `WindowForm`: between the later windows and the earlier ones, and between motions of the whole drive."""
        columns, field, std = super().differences(value, slopes, soft)
        keep = field >= 0
        columns, field, std = columns[:, keep], field[keep], std[keep]
        whole = np.array([name.endswith(BY_MOTION) for name in DIFFERENCES])[field]
        return np.where(self._later[:, None] | whole, columns, 0.0), field, std


def began(
    run: Run,
    follower: Follower,
    log: Log,
    found: Cut,
    onset: tuple[int, int],
    restless: Restlessness,
    progress: Progress = silent,
) -> Diagnosis:
    """Names what began in a drive.

    Args:
      run: whose folder is written to. follower: of the run. log: the drive. found: its windows, up to now.
      onset: first and last window in which it may have begun; those between and these themselves are left out, but for
        a single one, which the drive after it includes.
      restless: how much undisturbed drives move. progress: told of refits.
    """
    first, last = onset
    before = np.arange(max(0, first - ONSET.most_before), first)
    after = np.arange(last + (first != last), len(found))[: ONSET.most_after]
    part = found.part(np.append(before, after))
    later = np.arange(len(part)) >= len(before)
    # Of the later windows alone: in the earlier ones no suspect acts, and they could judge none.
    held = later & ((np.arange(len(part)) - len(before)) % ONSET.held_out == ONSET.held_out - 1)
    made: dict[str | None, WindowProblem] = {}

    def problem(form: str | None) -> WindowProblem:
        if form not in made:
            made[form] = WindowProblem(part, follower.model, form, silent)
        return made[form]

    settings = WindowSettings()
    suspects = suspects_of(follower.model, part.channels)
    observations = observe(problem(None), follower.noise, [log.name], np.where(held, "test", "fit"))
    base = baseline(follower.model, part.channels, [log])
    # A random walk goes as far as the root of its steps.
    moved = max(restless.walk * math.sqrt(len(part)), restless.scatter)
    form = BeganForm(problem, base, suspects, observations, settings, later, moved)
    effects = {name: catalogue.CATALOGUE[name] for name in form.candidates if name in catalogue.CATALOGUE}
    run.folder.mkdir(parents=True, exist_ok=True)
    return answer.diagnose(run, Problem((form,), effects, (), settings), progress, ONSET.seconds)[0]
