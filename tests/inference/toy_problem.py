"""Problems with known answers, without a simulator: linear, and a decaying exponential."""

from __future__ import annotations

import numpy as np

from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.problem import Problem


def coordinate(effect: str, name: str, amplitude: bool = False, **changes) -> Coordinate:
    given = {"start": 0.0, "scale": 1.0, "low": -1e6, "high": 1e6, "prior": 1e3, "amplitude": amplitude, **changes}
    return Coordinate(effect, name, **given)


def manoeuvres(number: int, samples: int, **noise) -> Observations:
    """`number` logs of one channel, each a manoeuvre of its own; the last two are held out where there are six."""
    series = tuple(
        Series(i, "y", i * samples, (i + 1) * samples, np.arange(samples) * 0.1, **{"white": 1.0, **noise})
        for i in range(number)
    )
    split = tuple("select" if number >= 6 and i >= number - 2 else "fit" for i in range(number))
    names = tuple(f"log{i}" for i in range(number))
    return Observations(
        np.zeros(number * samples), series, names, split, np.repeat(np.arange(number), samples), split, names
    )


class Linear(Problem):
    """y = A u: `base` columns are the baseline, `extra` columns one candidate each."""

    def __init__(self, base: np.ndarray, extra: dict[str, np.ndarray], observations: Observations, **limits):
        self.matrix = np.column_stack([base, *extra.values()])
        own = [coordinate("base", f"b{i}", **limits) for i in range(base.shape[1])]
        self.coordinates = (*own, *(coordinate(e, "amount", True) for e in extra))
        self.baseline = np.arange(base.shape[1])
        self.candidates = {e: np.array([base.shape[1] + i]) for i, e in enumerate(extra)}
        self.observations, self.effects, self.not_tested = observations, {}, ()

    def predict(self, u):
        return np.atleast_2d(u) @ self.matrix.T

    def jacobian(self, u, which):
        return self.matrix[:, which]


class Decay(Problem):
    """y = a exp(-b t), observed at the given times."""

    def __init__(self, time: np.ndarray, value: np.ndarray, **limits):
        self.time = time
        self.coordinates = (coordinate("base", "a", **limits), coordinate("base", "b", low=0.0, high=50.0))
        self.baseline, self.candidates = np.arange(2), {}
        self.observations = Observations(
            value,
            (Series(0, "y", 0, len(time), time, 0.01),),
            ("log",),
            ("fit",),
            np.zeros(len(time), int),
            ("fit",),
            ("log",),
        )
        self.effects, self.not_tested = {}, ()

    def predict(self, u):
        u = np.atleast_2d(u)
        return u[:, :1] * np.exp(-u[:, 1:] * self.time)

    def jacobian(self, u, which):
        e = np.exp(-u[1] * self.time)
        return np.column_stack([e, -u[0] * self.time * e])[:, which]


class TwoMinima(Problem):
    """Residuals 10 (u^2 - 1) and 3 (u - 1): at the noise at u = 1, and a worse minimum near u = -1, where it starts."""

    def __init__(self):
        self.coordinates, self.baseline, self.candidates = (coordinate("base", "u"),), np.arange(1), {}
        self.observations = Observations(
            np.zeros(2),
            (Series(0, "y", 0, 2, np.arange(2.0), 1.0),),
            ("log",),
            ("fit",),
            np.zeros(2, int),
            ("fit",),
            ("log",),
        )
        self.effects, self.not_tested = {}, ()

    def origin(self):
        return np.array([-1.5])

    def predict(self, u):
        u = np.atleast_2d(u)[:, 0]
        return np.column_stack([10.0 * (u**2 - 1.0), 3.0 * (u - 1.0)])

    def jacobian(self, u, which):
        return np.array([[20.0 * u[0]], [3.0]])[:, which]
