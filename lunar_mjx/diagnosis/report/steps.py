"""The chain of models that a report tells of, the error of each with its interval and the noise floor."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.diagnosis.report.read import Result
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.score import blocks

_DRAWS = 1000
"""Bootstrap draws of an interval: 25 of them lie beyond either end of its 95 %."""


@dataclasses.dataclass(frozen=True, eq=False)
class Step:
    """One model of a chain of runs, with the row of its residuals and predictions in its run.

    Attributes:
      label: what it is. short: its label on an axis. run: name of its run folder.
      result: that it comes from. row: its place among the run's models.
    """

    label: str
    short: str
    run: str
    result: Result
    row: int

    @property
    def observations(self) -> Observations:
        """Measurements with their residuals; the step must have been traced."""
        assert self.result.traces is not None
        return self.result.traces.observations

    @property
    def residual(self) -> np.ndarray:
        """(n,) residuals in sigma, weighed as `compare` tells errors."""
        assert self.result.traces is not None
        return self.result.traces.residual[self.row]

    @property
    def predicted(self) -> np.ndarray:
        """(n,) predictions, in the channels' units."""
        assert self.result.traces is not None
        return self.result.traces.predicted[self.row]


def chain(results: Sequence[Result]) -> list[Step]:
    """The models of a chain of runs: the first as given, every run's refit, and what the last diagnosis proposes."""
    steps = []
    before: set[str] = set()
    for number, result in enumerate(results):
        added = result.run.get("added", [])
        new = [e for e in added if e not in before]
        before |= set(added)
        if result.traces is None:
            continue
        last = number == len(results) - 1
        for row, label in enumerate(result.traces.labels):
            if label == "as given":
                if not steps:
                    steps.append(Step("the model as given", "as given", result.name, result, row))
            elif label == "refitted":
                names = ", ".join(new)
                words = (
                    ("the model refitted", "refitted")
                    if not names
                    else (f"the model with {names}, refitted", f"+ {names}")
                )
                steps.append(Step(*words, result.name, result, row))
            # Of the last run alone: what an earlier one proposed is what the next one was made with.
            elif last:
                names = label.removeprefix("with ")
                model = f"{result.name}'s model with {names} added" if before else f"the model with {names}"
                words = (f"{model}, as the diagnosis proposes", f"+ {names}<br>(proposed)")
                steps.append(Step(*words, result.name, result, row))
    return steps


def comparable(steps: Sequence[Step]) -> bool:
    """Whether all models were held against the same measurements."""
    first = steps[0].observations
    return all(
        s.observations is first
        or (len(s.observations) == len(first) and np.allclose(s.observations.value, first.value, equal_nan=True))
        for s in steps
    )


@dataclasses.dataclass(frozen=True)
class Error:
    """Root mean square residual in sigma with its 95 % interval; `count` observations in `blocks` blocks."""

    value: float
    low: float
    high: float
    count: int
    blocks: int


def error(step: Step, splits: Sequence[str]) -> Error | None:
    """Error of a model on some splits, the interval by a bootstrap over blocks; None where they hold nothing."""
    observations, residual = step.observations, step.residual
    keep = observations.in_split(*splits) & np.isfinite(residual)
    count = int(keep.sum())
    if not count:
        return None
    number = blocks(observations, np.where(np.isfinite(residual), residual, 0.0), keep)
    inside = number >= 0
    squares = np.bincount(number[inside], weights=residual[inside] ** 2)
    sizes = np.bincount(number[inside])
    value = float(np.sqrt(squares.sum() / sizes.sum()))
    if len(squares) < 2:
        return Error(value, float("nan"), float("nan"), count, len(squares))
    # A fixed seed, so that a run always shows the same interval; blocks and not single observations are drawn, since
    # neighbours repeat each other.
    rng = np.random.default_rng(0)
    pick = rng.integers(0, len(squares), (_DRAWS, len(squares)))
    draws = np.sqrt(squares[pick].sum(axis=1) / sizes[pick].sum(axis=1))
    low, high = np.quantile(draws, (0.025, 0.975))
    return Error(value, float(low), float(high), count, len(squares))


def judged(steps: Sequence[Step]) -> tuple[tuple[str, ...], str]:
    """The splits on which the chain is judged, and what they are: those held out, else those fitted."""
    # All or none: models of one chain must not be judged on unlike points.
    held = all(s.observations.in_split("select", "test").any() for s in steps)
    return (("select", "test"), "held-out") if held else (("fit",), "fitted")
