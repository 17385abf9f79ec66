"""A toy form: a curve over x with effects, discrepancy and a calibration, nonlinear in one effect."""

from __future__ import annotations

import math

import numpy as np
from scipy import optimize

from lunar_mjx.inference.evidence import Amplitudes, EvidenceError, Field, Gram, NoiseSize
from lunar_mjx.inference.weighing.hypotheses import CALIBRATION, EFFECT, UNLISTED, Form, Linear, Refit, Term

X = np.linspace(-1.0, 1.0, 60)
NOISE = 0.02
BASE, EFFECTS = 2, {"square": 2, "wave": 3, "twin": 4}


def curve(u):
    """Level and slope, and three effects: x^2, an exponential wave, and nearly x^2."""
    return u[0] + u[1] * X + u[2] * X**2 + np.sin(4.0 * X) * np.expm1(0.5 * u[3]) + u[4] * (X**2 + 1e-3 * X**3)


class ToyForm(Form):
    """Values measured at X."""

    name, log_prior = "toy", 0.0
    curve = staticmethod(curve)
    terms = (
        *(Term(e, EFFECT, math.log(0.02)) for e in EFFECTS),
        Term("level", UNLISTED, math.log(0.01)),
        Term("gauge", CALIBRATION, math.log(0.01)),
    )

    def __init__(self, value, broken=()):
        self.value, self.broken = value, frozenset(broken)

    def refit(self, effects, near, start):
        if self.broken & effects:
            raise EvidenceError("broken on purpose")
        free = [0, 1, *(EFFECTS[e] for e in effects)]
        u = np.zeros(5) if start is None else np.where(np.isin(np.arange(5), free), start, 0.0)

        def residual(x):
            place = u.copy()
            place[free] = x
            return np.concatenate([(self.value - self.curve(place)) / NOISE, x / 3.0])

        u[free] = optimize.least_squares(residual, u[free]).x
        return Refit(self.name, frozenset(effects), u, self.linear(u))

    def linear(self, u):
        step = 1e-6 * np.eye(5)
        own = np.stack([(self.curve(u + h) - self.curve(u - h)) / 2e-6 for h in step], axis=1)
        modes = np.stack([np.cos(k * np.pi * (X + 1.0) / 2.0) / (1.0 + k) for k in range(8)], axis=1)
        columns = np.column_stack([own, self.curve(u), modes]) / NOISE
        amplitudes = Amplitudes.of(
            np.concatenate([np.full(5, 3.0), [0.02], np.ones(8)]),
            np.array([-1] * 6 + [0] * 8),
            np.append(-u, np.zeros(9)),
        )
        at = np.concatenate([np.where(np.arange(5) >= BASE, u, 0.0), np.zeros(9)])
        rows = (self.value - self.curve(u)) / NOISE
        free = np.full(14, np.inf)
        return Linear(
            Gram.of(columns, rows),
            {},
            amplitudes,
            -free,
            free,
            np.r_[0, 1, 5:14],
            {e: np.array([p]) for e, p in EFFECTS.items()},
            at,
            {"gauge": np.array([5])},
            {},
            (Field("level", 0.02),),
            (NoiseSize("y", 0.3),),
            0.5,
            5.0,
        )


class TwoValleys(ToyForm):
    """A toy whose level has a better optimum below zero; only a descent with effects leads into it."""

    @staticmethod
    def curve(u):
        """The toy's curve (n,) at the level |u[0]|, with a hump x^2 / 2 added where u[0] is positive."""
        return curve(np.concatenate([np.abs(u[:1]), u[1:]])) + 0.5 * X**2 * (u[0] > 0.0)

    def refit(self, effects, near, start):
        if start is None:
            start = np.array([0.1, 0.0, 0.0, 0.0, 0.0])
        elif effects:
            start = np.concatenate([-np.abs(start[:1]), start[1:]])
        return super().refit(effects, near, start)


def measured(seed, **effects):
    """Values of a truth with some effects, and noise."""
    u = np.array([0.5, -0.4, 0.0, 0.0, 0.0])
    for name, amount in effects.items():
        u[EFFECTS[name]] = amount
    return curve(u) + NOISE * np.random.default_rng(seed).normal(size=len(X))
