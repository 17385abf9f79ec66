"""A race of candidates: which of them would gain by a refit, told by a few cheap steps of each."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.differences import Differences
from lunar_mjx.diagnosis.drives.refitting.descent import Cost, Descent, within_box
from lunar_mjx.diagnosis.drives.refitting.errors import Errors
from lunar_mjx.diagnosis.drives.refitting.fields import Sizes
from lunar_mjx.diagnosis.drives.refitting.own import OwnRefit
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.refitting.steps import bounded_step
from lunar_mjx.inference.evidence import EvidenceError


@dataclasses.dataclass(eq=False)
class Runner:
    """A candidate under way.

    Attributes:
      effect: its name; empty for the model without any. own: places of its coordinates.
      free: of all that it moves, its own last.
      u: (coordinates,) where it has come. errors, sizes: as they were found there. damping: of its next step.
      value: log density of the measurements, and of the prior, where it has come in the end; see `OwnRefit.held`.
    """

    effect: str
    own: np.ndarray
    free: np.ndarray
    u: np.ndarray
    errors: Errors
    sizes: Sizes | None = None
    damping: float = DRIVE_REFIT.damping
    value: float = -np.inf


@dataclasses.dataclass(eq=False)
class Race:
    """Descents of many candidates side by side, with one Jacobian of the model without them.

    A Jacobian of all that a refit moves takes most of its time. For the first steps that of the refit without the
    candidate does (chord method: Ortega & Rheinboldt 1970); the candidate's own columns are taken anew.

    Attributes:
      own: refit of the model, by whose rules errors are learnt. descent: its costs. longest_step: half the box of a
        step, in scales. free: coordinates of the refit that all begin beside. slopes: (n, free) derivatives there.
      u: (coordinates,) where that has ended.
      ends: (coordinates,) where each effect's descent has come, by its name.
    """

    own: OwnRefit
    descent: Descent
    longest_step: float
    free: np.ndarray
    slopes: np.ndarray
    u: np.ndarray
    ends: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    def run(self, groups: Iterable[Sequence[str]], acting: Callable[[np.ndarray, str], np.ndarray]) -> dict[str, float]:
        """What each effect gains by a few steps over what the model without any does, nats; `ends` holds where to.

        Errors of channels are learnt by the steps of the model without any, no smaller than the present floor, and hold
        for all: with errors of its own each, one that is missing comes 27th of 34 beside a foreign Husky, as what it
        gains is less than what errors differ by from place to place. With the same ones it comes first.

        Args:
          groups: effects, by the program that simulates them.
          acting: the place (coordinates,) of another with an effect of some size: at its null it may have no slope.

        Errors of channels are held afterwards; whoever asks for a race does so within `OwnRefit.apart`.

        Raises:
          TimeUp: before all had run.
        """
        errors = self.own.errors
        before = self._runner("", lambda u, effect: u, errors.present)
        self._lead([before])
        errors.channels_held = True
        # once more, by the errors of the others: that has to gain as much by steps alone
        alone = self._runner("", lambda u, effect: u, before.errors)
        self._lead([alone])
        gains = {}
        for names in groups:
            runners = [self._runner(name, acting, before.errors) for name in names]
            self._lead(runners)
            gains |= {r.effect: r.value - alone.value for r in runners}
            self.ends |= {r.effect: r.u for r in runners}
            self.own.progress("a race of what may be missing", np.nan)
        return gains

    def _runner(self, effect: str, acting: Callable[[np.ndarray, str], np.ndarray], errors: Errors) -> Runner:
        own = self.own.prior.places.candidates[effect] if effect else np.zeros(0, int)
        free = np.concatenate([self.free, own])
        return Runner(effect, own, free, acting(self.u, effect), errors)

    def _lead(self, runners: list[Runner]) -> None:
        """Steps of some runners, whose rovers are simulated together; one that diverges stays where it is."""
        for _ in range(DRIVE_REFIT.race_steps):
            slopes = self._own_slopes(runners)
            at = [(r, own, self._settled(r, own)) for r, own in zip(runners, slopes, strict=True)]
            self._step([(r, own, cost) for r, own, cost in at if cost is not None])
        for runner in runners:
            self._judge(runner)

    def _own_slopes(self, runners: Sequence[Runner]) -> list[np.ndarray]:
        """(n, own) derivatives by each one's own coordinates where it stands."""
        drives, steps = self.own.drives, self.own.derivatives.steps
        taken = [Differences(drives.coordinates, r.own, steps=steps) for r in runners]
        rows = [d.rows(r.u) for d, r in zip(taken, runners, strict=True)]
        values = np.split(drives.predict(np.concatenate(rows)), np.cumsum([len(r) for r in rows])[:-1])
        nothing = np.zeros(len(drives.observations))
        slopes = [
            d.jacobian(r.u, v, drives.observations, lambda c: nothing)
            for d, r, v in zip(taken, runners, values, strict=True)
        ]
        return [np.where(np.isfinite(s), s, 0.0) for s in slopes]

    def _settled(self, runner: Runner, own_slopes: np.ndarray) -> Cost | None:
        """What the next step of a runner lowers, with errors that have settled; None where nothing can be told."""
        own, errors = self.own, self.own.errors
        if not np.isfinite(own.drives.predict(runner.u[None])).all():
            return None
        errors.present = runner.errors
        slopes = np.column_stack([self.slopes, own_slopes])
        try:
            _, runner.sizes = own.settle(runner.u, runner.free, slopes, runner.sizes, False)
        # One of which nothing can be told says nothing of the others.
        except (EvidenceError, np.linalg.LinAlgError):
            return None
        runner.errors = errors.present
        return self.descent.cost(runner.u, runner.free, runner.sizes, own.prior.places.inputs(runner.free, slopes))

    def _judge(self, runner: Runner) -> None:
        """Takes down what the place of a runner explains by itself."""
        own, errors = self.own, self.own.errors
        if not np.isfinite(own.drives.predict(runner.u[None])).all():
            return
        errors.present = runner.errors
        # what moves is held: its own slopes say nothing
        slopes = np.column_stack([self.slopes, np.zeros((len(self.slopes), len(runner.own)))])
        try:
            runner.value = own.held(runner.u, runner.free, slopes, runner.sizes, False)[0]
        except (EvidenceError, np.linalg.LinAlgError):
            return

    def _step(self, at: Sequence[tuple[Runner, np.ndarray, Cost]]) -> None:
        """One step of each, the best of a few that are tried."""
        value, low_high = self.own.drives.observations.value, self.own.drives.bounds
        rows, before = [], []
        for runner, own_slopes, cost in at:
            x = runner.u[runner.free]
            white = cost.white(np.column_stack([self.slopes, own_slopes]))
            left = cost.white(value - self.own.drives.predict(runner.u[None])[0])
            before.append(cost.chi2(left, x))
            normal, downhill = cost.normal(white), cost.downhill(white, left, x)
            low, high = low_high(runner.free)
            box = within_box(self.own.prior, runner.free, x, low, high, self.longest_step)
            tried = np.repeat(runner.u[None], len(DRIVE_REFIT.race_tried), axis=0)
            for row, (factor, share) in zip(tried, DRIVE_REFIT.race_tried, strict=True):
                stiff = normal + np.diag(runner.damping * factor * np.diag(normal))
                row[runner.free] = np.clip(x + share * bounded_step(stiff, downhill, x, *box), low, high)
            rows.append(tried)
        if not rows:
            return
        count, values = len(DRIVE_REFIT.race_tried), self.own.drives.predict(np.concatenate(rows))
        for k, ((runner, _, cost), tried) in enumerate(zip(at, rows, strict=True)):
            lefts = [cost.white(value - v) for v in values[k * count : (k + 1) * count]]
            reached = [cost.chi2(left, u[runner.free]) for left, u in zip(lefts, tried, strict=True)]
            best = int(np.argmin(reached))
            if reached[best] < before[k]:
                runner.u = tried[best]
                factor = DRIVE_REFIT.race_tried[best][0]
                runner.damping = max(DRIVE_REFIT.softer * factor * runner.damping, DRIVE_REFIT.damping)
            else:
                runner.damping *= DRIVE_REFIT.stiffer
