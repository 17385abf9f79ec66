"""A run's logs cut into windows: their splits, their noise, and the problem of what may be missing."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.observations import discrepancy_of
from lunar_mjx.diagnosis.drives.unused import unused_sentence
from lunar_mjx.diagnosis.drives.windows.coordinates import (
    CALIBRATION,
    Suspect,
    baseline,
    catalogue_of,
    data_sheet,
    sizes,
    suspects_of,
)
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, Cut, channels_read, cut
from lunar_mjx.diagnosis.drives.windows.form import SOFT, WindowForm, observe
from lunar_mjx.diagnosis.drives.windows.problem import (
    Noise,
    WindowProblem,
    corners,
    learn_noise,
    proportions,
    student_weights,
)
from lunar_mjx.diagnosis.drives.windows.settings import BETWEEN, DIFFERENCES, WindowSettings
from lunar_mjx.diagnosis.runs import WINDOWS_FILE, Run
from lunar_mjx.diagnosis.weighed.form import Problem
from lunar_mjx.effects import catalogue
from lunar_mjx.errors import bad_input
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import silent
from lunar_mjx.logs import Log
from lunar_mjx.model import Model

MOST_WINDOWS = 60
"""Windows of a campaign that are simulated: two minutes of driving, drawn evenly over speeds and turns."""


UNUSED = {
    "position": "a speed over ground needs a heading that is known, yaw_deg",
    "accelerometer": "the slope needs all three axes of it, or roll and pitch",
    "bus_current": "imposed speeds are judged by a current per motor or side; log commands to compare that of the bus",
}
"""Why channels are in no window, by their quantity."""

PARTS = 10
"""Parts of a log of which every third is held out."""


class Bench:
    """A run's logs cut into windows, with the problems of every form of the ground made once.

    Attributes:
      cut: the windows. names: of the logs. splits: (window,) of every window.
      base: the model's own unknowns. suspects: what may be missing of it.
      settings: of the run. discrepancy: known unexplained error of the model by channel, in its unit.
      weight: (channel, window) of every window's measurements.
    """

    def __init__(self, run: Run, logs: Sequence[Log]):
        self.run, self.logs, self.model = run, list(logs), run.model
        _require_known(run.model)
        self.settings = WindowSettings.of(run.settings)
        joints, size = corners(run.model), sizes(run.model)
        self.cut: Cut = cut(self.logs, joints, size["radius"], MOST_WINDOWS, run.seed, size["track"])
        alone = len({g.name for g in logs}) == len(logs)
        self.names = [log.name if alone else f"{log.folder.parent.name}/{log.name}" for log in logs]
        self.splits = _splits(run, self.logs, self.names, self.cut)
        self.held_out = np.isin(self.splits, ("select", "test"))
        self.fitted = self.splits == "fit"
        self.discrepancy = discrepancy_of(run.discrepancy, self.cut.channels)
        self.base = baseline(self.model, self.cut.channels, self.logs)
        self.suspects = suspects_of(self.model, self.cut.channels)
        self.weight = np.ones((len(CHANNELS), len(self.cut)))
        self._made: dict[str | None, WindowProblem] = {}

    def problem(self, form: str | None) -> WindowProblem:
        """The problem with a form of the ground, made once."""
        if form not in self._made:
            self._made[form] = WindowProblem(self.cut, self.model, form, silent)
            self._made[form].weight = self.weight
        return self._made[form]

    def form(self, noise: Sequence[Noise], suspects: Sequence[Suspect] | None = None) -> WindowForm:
        """The model and what may be missing of it, against the windows with their noise."""
        observations = observe(self.problem(None), noise, self.names, self.splits)
        mine = self.suspects if suspects is None else suspects
        return WindowForm(self.problem, self.base, mine, observations, self.settings, self.other_ground)

    @property
    def grounds(self) -> tuple[str, ...]:
        """What the logs that are fitted were driven on, as far as they say."""
        fitted = np.unique(self.cut.log[self.fitted])
        return tuple(sorted({self.logs[k].ground for k in fitted} - {""}))

    @property
    def other_ground(self) -> bool:
        """Whether every log names a ground, and none that the model was fitted on."""
        named = {log.ground for log in self.logs}
        return bool(self.model.grounds) and "" not in named and not named & set(self.model.grounds)

    def question(self, noise: Sequence[Noise], suspects: Sequence[Suspect] | None = None) -> Problem:
        """The windows and everything that may be missing, as the problem that the search of hypotheses takes.

        Args:
          noise: of each channel. suspects: what may be missing; all that the run knows if None.
        """
        form = self.form(noise, suspects)
        effects = {name: catalogue.CATALOGUE[name] for name in form.candidates if name in catalogue.CATALOGUE}
        read = [channels_read(log) for log in self.logs]
        unused = unused_sentence(self.logs, read, UNUSED, "windows hold currents, the yaw rate and the speed ahead")
        return Problem((form,), effects, (), form.settings, unused)

    def noise(self) -> list[Noise]:
        """The noise that a run has kept, or what the best single explanation leaves of the windows."""
        kept = self.run.load(WINDOWS_FILE)
        if kept is not None and "noise" in kept:
            self.use_weight(np.array(kept["weight"]))
            return [Noise(**n) for n in kept["noise"]]
        form = self.form(self.ripple())
        best, left = -math.inf, None
        # Where soft ground is no candidate the two sets are one, which is then refitted once.
        for effects in dict.fromkeys((frozenset[str](), frozenset({SOFT} & set(form.candidates)))):
            try:
                value, rest = form.explained(form.refit(effects, None, None))
            except (EvidenceError, np.linalg.LinAlgError):
                if left is None:
                    raise
                continue
            if value > best:
                best, left = value, rest
        problem, at = self.problem(None), form.observations.at
        whole, predicted = np.zeros(problem.there.shape), np.zeros(problem.there.shape)
        whole[at], predicted[at] = left, form.observations.value - left
        count = np.maximum(problem.there.sum(axis=2), 1)
        scale = proportions(whole, problem.there, np.sqrt(np.sum(predicted**2, axis=2) / count))
        whole, mine = whole / scale[..., None], self.fitted
        found = learn_noise(whole[:, mine], problem.there[:, mine], self.cut.interval_s)
        self.use_weight(student_weights(whole, problem.there, found, self.cut.interval_s) / scale**2)
        return [n.with_discrepancy(self.discrepancy.get(c, 0.0)) for n, c in zip(found, CHANNELS, strict=True)]

    def ripple(self) -> list[Noise]:
        """Noise by what fluctuates within windows, whatever the model: a first guess."""
        problem = self.problem(None)
        residual = problem.residual(problem.predict(self.base, np.zeros((1, len(self.base))))[0])
        there = problem.there
        count = np.maximum(there.sum(axis=-1, keepdims=True), 1)
        inside = np.where(there, residual - residual.sum(axis=-1, keepdims=True) / count, 0.0)
        many = there.sum(axis=-1) > 1
        out = []
        for r, t, m in zip(inside, there, many, strict=True):
            # a channel with one sample a window shows no ripple: what differs from window to window takes its place
            values = r[m][t[m]] if m.any() else residual[len(out)][t]
            out.append(Noise(max(float(np.sqrt(np.mean(values**2))), 1e-6) if values.size else 1.0, 0.5, 0.5))
        return out

    def use_weight(self, weight: np.ndarray) -> None:
        """Takes the weights of the windows for all problems."""
        self.weight = weight
        for made in self._made.values():
            made.weight = weight


def _require_known(model: Model) -> None:
    """Refuses priors about logs that nothing here reads."""
    known = {q.key for s in catalogue_of(model) for q in s.unknowns} | {q.key for q in data_sheet(model)}
    known |= {f"{BETWEEN}.{d.key}" for d in DIFFERENCES.values()}
    for key in model.priors:
        if key.partition(".")[0] in (CALIBRATION, BETWEEN) and key not in known:
            mine = ", ".join(sorted(k for k in known if k.partition(".")[0] == key.partition(".")[0]))
            raise bad_input("the model", "priors", key, "is not known of drives", f"use one of {mine}")


def _splits(run: Run, logs: Sequence[Log], names: Sequence[str], found: Cut) -> np.ndarray:
    """(window,) split: as the user says, as the logs say, else every third log held out; of fewer, parts of each."""
    own = [run.splits.get(n, run.splits.get(log.name, log.split)) for n, log in zip(names, logs, strict=True)]
    if any(own):
        return np.array([own[k] or "fit" for k in found.log])
    if len(logs) >= 3:
        return np.array(["test" if k % 3 == 2 else "fit" for k in found.log])
    out = np.array(["fit"] * len(found), dtype="<U6")
    for k in np.unique(found.log):
        mine = np.flatnonzero(found.log == k)
        out[mine[held_out_parts(found.start_s[mine])]] = "test"
    return out


def held_out_parts(start_s: np.ndarray) -> np.ndarray:
    """(window,) whether a window of one log is held out: every third of ten parts in order of time.

    Parts, not the end: ground and ways of driving at the end of a drive are often unlike those before.

    Args:
      start_s: (window,) when each begins.
    """
    rank = np.argsort(np.argsort(start_s))
    return rank * PARTS // len(start_s) % 3 == 2
