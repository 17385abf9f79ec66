"""Follows a drive window by window with a fitted model: what the model leaves of it, and when something began.

The state of a drive is everything by which it may differ from the model: the model's own unknowns, as well as they are
known, and the differences between drives of `settings.DIFFERENCES`. These may depend on how it is driven: no law of
friction is exact, and what it leaves of a turn is not what it leaves of a straight drive (`MOTION`). How much all this
moves within an undisturbed drive is learnt from the run's own logs. A jump of one of the differences, of the size of
something unlisted, is what is looked for.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.drives.windows.coordinates import baseline, sizes
from lunar_mjx.diagnosis.drives.windows.cut import CUTTING, Cut, cut
from lunar_mjx.diagnosis.drives.windows.form import WindowForm, observe
from lunar_mjx.diagnosis.drives.windows.problem import Noise, Proportion, WindowProblem, corners, proportion
from lunar_mjx.diagnosis.drives.windows.settings import DIFFERENCES, WindowSettings
from lunar_mjx.diagnosis.runs import FITTED_FILE, RESTLESS_FILE, WINDOWS_FILE, Run
from lunar_mjx.errors import UserError
from lunar_mjx.inference.changes import Amounts, ChangeDetector, Restlessness, Step, learn
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs import Log
from lunar_mjx.model.file import load_model

MOST_LEARNT = 400
"""Windows of the run's logs from which is learnt how much an undisturbed drive moves: a quarter of an hour."""
SLOPE = "slope"
"""Coordinate of a drive's ground that no difference names, and that moves within a drive all the same."""
MOTION = ("ahead or back", "left or right", "turning", "fast")
"""What of a window's motion the differences may depend on."""


@dataclasses.dataclass(frozen=True, eq=False)
class Steps:
    """Windows of one drive in order of time, as steps of a series.

    Attributes:
      cut: the windows. steps: columns and residuals of each, in units of the noise.
      amounts: what is known of the drive's amounts beforehand. names: of these, as coordinates.
    """

    cut: Cut
    steps: Sequence[Step]
    amounts: Amounts
    names: Sequence[str]


class Follower:
    """A run's fitted model, ready to follow drives.

    Attributes:
      model: as fitted. noise: of each channel, as learnt. interval_s: between samples of a window.
      proportions: how each channel's noise grows with what it measures, once `restlessness` has been called.
    """

    def __init__(self, run: Run):
        """Reads what a comparison has left.

        Raises:
          UserError: the run has no fitted windows.
        """
        found, path = run.load(WINDOWS_FILE), run.folder / FITTED_FILE
        if found is None or not Path(path).is_file():
            raise UserError(
                f"{run.folder}: holds no windows of drives with imposed wheel speeds; make the run with "
                "lunar-mjx compare on such logs."
            )
        self.run, self.model = run, load_model(path)
        self.noise = tuple(Noise(**n) for n in found["noise"])
        self.interval_s = float(found["interval_s"])
        self.proportions = (Proportion(),) * len(self.noise)
        self._joints, size = corners(self.model), sizes(self.model)
        self._radius, self._track = size["radius"], size["track"]

    def windows(self, log: Log) -> Cut:
        """All windows of a drive in which it moves and is not held, in order of time.

        Raises:
          UserError: the drive has none.
        """
        # Without a limit: what is followed must not be sampled.
        found = cut([log], self._joints, self._radius, 10**9, 0, self._track, self.interval_s)
        return found.part(np.argsort(found.start_s, kind="stable"))

    def form(self, found: Cut, log: Log) -> WindowForm:
        """The fitted model against windows of one drive, without anything missing."""
        problem = WindowProblem(found, self.model, None, silent)
        splits = np.full(len(found), "fit")
        base = baseline(self.model, found.channels, [log])
        return WindowForm(
            lambda _: problem, base, (), observe(problem, self.noise, [log.name], splits), WindowSettings()
        )

    def steps(self, found: Cut, log: Log) -> Steps:
        """What the model leaves of windows; windows whose simulation diverges are left out."""
        form = self.form(found, log)
        value, slopes = self._linear(form)
        return self._steps(found, form, value, slopes)

    @staticmethod
    def _linear(form: WindowForm) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) and derivatives (n, coordinates) by the model as fitted."""
        count = len(form.coordinates)
        with threadpool_limits(1, "blas"):
            value, slopes = form.slopes(form.origin(), range(count))
        return value, slopes[:, :count]

    def _steps(self, found: Cut, form: WindowForm, value: np.ndarray, slopes: np.ndarray) -> Steps:
        observations = form.observations
        names = [c.name for c in form.coordinates]
        bent = [i for i, name in enumerate(names) if name in DIFFERENCES]
        motion = _motion(*form.problem(None).rims)
        whole = np.column_stack([slopes, observations.value - value])
        fine = np.asarray(np.isfinite(whole).all(axis=1))
        with threadpool_limits(1, "blas"):
            white = observations.whiten(np.where(fine[:, None], whole, 0.0))
        size = _sizes(form, np.where(fine, value, 0.0))
        scale = np.stack([p.scale(s) for p, s in zip(self.proportions, size, strict=True)])
        white = white / scale[observations.at[0], observations.at[1]][:, None]
        keep, steps = [], []
        for w in range(len(found)):
            rows = np.asarray(observations.window == w)
            if rows.any() and fine[rows].all():
                keep.append(w)
                own = white[rows, :-1]
                steps.append((np.column_stack([own, *(f * own[:, bent] for f in motion[w])]), white[rows, -1]))
        names += [f"{names[i]}, {how}" for how in MOTION for i in bent]
        return Steps(found.part(np.array(keep, int)), steps, self._amounts(form), names)

    @staticmethod
    def _amounts(form: WindowForm) -> Amounts:
        names = [c.name for c in form.coordinates]
        start = np.array([c.prior for c in form.coordinates])
        moving, jump = np.zeros(len(names)), np.zeros(len(names))
        usual = form.usual_differences()
        for i, name in enumerate(names):
            if name in DIFFERENCES:
                start[i] = moving[i] = usual[name]
                jump[i] = form.settings.unlisted_discrepancy
            elif name == SLOPE:
                moving[i] = 1.0
        own = start[[name in DIFFERENCES for name in names]]
        more = np.tile(own, len(MOTION))
        none = np.zeros(len(more))
        bent = np.append(np.zeros(len(names), bool), np.ones(len(more), bool))
        return Amounts(np.append(start, more), np.append(moving, none), np.append(jump, none), bent)

    @staticmethod
    def share(difference: str) -> float:
        """Size of a difference where its amount is 1: a share, or the logarithm of a factor."""
        return DIFFERENCES[difference].share(WindowSettings().unlisted_discrepancy)

    def detector(self, steps: Steps, restless: Restlessness, hours: float) -> ChangeDetector:
        """A detector for a drive with so many hours of driving from one false alarm to the next, at least."""
        return ChangeDetector(
            restless.of(steps.amounts), steps.amounts.jumps(steps.names), 3600.0 * hours / CUTTING.window_s
        )

    def restlessness(self, progress: Progress = silent) -> Restlessness:
        """How much the run's own drives move within themselves; learnt once and kept in the run's folder."""
        kept = self.run.load(RESTLESS_FILE)
        if kept is not None:
            self.proportions = tuple(Proportion(**p) for p in kept["proportions"])
            return Restlessness(**kept["restlessness"])
        logs = [log for log in self.run.campaign() if isinstance(log, Log)]
        made, left = [], MOST_LEARNT
        for number, log in enumerate(logs):
            try:
                found = self.windows(log)
            except UserError:
                continue  # a log too short for a window
            progress("following the run's own logs", 0.5 * number / len(logs))
            # What short logs leave of the windows goes to those that follow.
            found = found.part(np.arange(min(max(left // (len(logs) - number), 1), len(found))))
            left -= len(found)
            form = self.form(found, log)
            made.append((found, form, *self._linear(form)))
        progress("learning how much they move", 0.6)
        self.proportions = _proportions([(form, value, slopes) for _, form, value, slopes in made])
        series = [self._steps(*one) for one in made]
        with threadpool_limits(1, "blas"):
            restless = learn([(one.amounts, one.steps) for one in series])
        self.run.save(
            RESTLESS_FILE,
            {
                "restlessness": dataclasses.asdict(restless),
                "proportions": [dataclasses.asdict(p) for p in self.proportions],
                "windows": sum(len(one.steps) for one in series),
            },
        )
        return restless


def _motion(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """(window, `MOTION`) how windows are driven, each between -1 and 1, from (window,) rim speeds of the sides, m/s."""
    ahead, turn = 0.5 * (left + right), 0.5 * (right - left)
    whole = np.maximum(np.abs(ahead) + np.abs(turn), 1e-9)
    fast = np.clip(whole / CUTTING.strata[1] - 1.0, -1.0, 1.0)
    return np.stack([ahead / whole, turn / whole, 2.0 * np.abs(turn) / whole - 1.0, fast], axis=1)


def _sizes(form: WindowForm, value: np.ndarray) -> np.ndarray:
    """(channel, window) root mean square of what is predicted, (n,)."""
    there = form.problem(None).there
    whole = np.zeros(there.shape)
    whole[form.observations.at] = value
    return np.sqrt(np.sum(whole**2, axis=2) / np.maximum(there.sum(axis=2), 1))


def _proportions(drives: Sequence[tuple[WindowForm, np.ndarray, np.ndarray]]) -> tuple[Proportion, ...]:
    """How each channel's noise grows with what it measures, from what is left of drives once each has its own amounts.

    Args:
      drives: form, predictions (n,) and derivatives (n, coordinates) of each.
    """
    parts = []
    for form, value, slopes in drives:
        left = form.observations.value - value
        fine = np.asarray(np.isfinite(np.column_stack([slopes, left])).all(axis=1))
        slopes, left, value = (np.where(fine if a.ndim == 1 else fine[:, None], a, 0.0) for a in (slopes, left, value))
        white = form.observations.whiten(np.column_stack([slopes, left]))
        usual = form.usual_differences()
        std = np.array([usual.get(c.name, c.prior) for c in form.coordinates])
        columns = white[:, :-1] * std
        # Each drive has amounts of its own within their priors, or the noise would be told with them in it.
        own = std * np.linalg.solve(np.eye(len(std)) + columns.T @ columns, columns.T @ white[:, -1])
        there = form.problem(None).there
        whole = np.zeros(there.shape)
        whole[form.observations.at] = left - slopes @ own
        parts.append((whole, there, _sizes(form, value)))
    residual, there, size = (np.concatenate(a, axis=1) for a in zip(*parts, strict=True))
    return tuple(proportion(*channel) for channel in zip(residual, there, size, strict=True))
