"""Simulated tables like those of a run, through the whole search: nulls and single effects, with discrepancy and noise.

Truths are drawn from what every hypothesis takes for usual: parameters at the refit, discrepancy of usual size at every
port, calibration errors, noise of an uncertain size. So the rates say how often the tool is wrong where its priors are
right.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence

import numpy as np
from threadpoolctl import threadpool_limits

from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.tables.loop import build_tables
from lunar_mjx.diagnosis.tables.wheel_form import WheelForm
from lunar_mjx.diagnosis.weighed.conclusion import Conclusion, conclude
from lunar_mjx.inference.weighing.search import LEAST_SIGNAL, search
from lunar_mjx.logs import SteadyLog

VISIBLE = 15.0
"""Length in sigma, at least, of the signature of a simulated effect that is to be found."""


class SimulatedTables:
    """Draws and diagnoses tables like those of a run; even cases hide nothing, odd ones an effect that can show."""

    def __init__(self, run: Run, logs: Sequence[SteadyLog]):
        """Refits the run's model once; cases are drawn about it."""
        self._problem = build_tables(run, logs)
        self._seed = run.seed
        own = self._problem.own
        with threadpool_limits(1, "blas"):
            refit = own.refit(frozenset(), None, None)
        self._u = refit.u
        linear, self._columns, _ = own.linearise(refit.u)
        self._amplitudes, self._fields, self._noises = linear.amplitudes, linear.fields, linear.noises
        self._usual = np.setdiff1d(
            linear.always, np.arange(len(own.coordinates))
        )  # calibration and fields, none unlisted
        self._sizes = {
            name: min(max(1.0, VISIBLE / length), self._room(own, name))
            for name, length in linear.shows().items()
            if length >= LEAST_SIGNAL
        }

    def _room(self, own: WheelForm, name: str) -> float:
        """How far all amplitudes of an effect may go, in prior sizes."""
        low, high = np.array(
            [own.coordinates[i].bounds() for i in own.candidates[name] if own.coordinates[i].amplitude]
        ).T
        return float(np.min(np.maximum(high, -low)))

    def case(self, number: int) -> tuple[str, float, Conclusion]:
        """The effect hidden in a case ("" for none), its amount in prior sizes, and what is said about it."""
        own, rng = self._problem.own, np.random.default_rng([self._seed, number])
        truth, amount, u = "", 0.0, self._u.copy()
        if number % 2 and self._sizes:
            truth = sorted(self._sizes)[int(rng.integers(len(self._sizes)))]
            amount = self._sizes[truth]
            for i in own.candidates[truth]:
                c = own.coordinates[i]
                if c.amplitude:
                    low, high = c.bounds()
                    sign = rng.choice([-1.0, 1.0]) if low < 0.0 < high else 1.0 if high > 0.0 else -1.0
                    u[i] = min(max(sign * amount, low), high)
        observations = own.data.observations
        sigma = observations.sigma()
        # Half-normal, as the prior of every field's size is.
        size = np.abs(rng.normal(size=len(self._fields))) * [f.usual for f in self._fields]
        scale = self._amplitudes.std * np.append(size, 1.0)[self._amplitudes.field]
        usual = self._usual
        misfit = self._columns[:, usual] @ (scale[usual] * rng.normal(size=len(usual)))
        noise = np.exp([rng.normal(0.0, n.log_std) for n in self._noises])[own.noise_group()]
        value = own.predict(u)[0] + sigma * (misfit + noise * rng.normal(size=len(sigma)))
        drawn = dataclasses.replace(own.data, observations=dataclasses.replace(observations, value=value))
        forms = []
        for form in self._problem.forms:
            other = copy.copy(form)
            other.data = drawn
            forms.append(other)
        settings = self._problem.settings
        with threadpool_limits(1, "blas"):
            model_search = search(forms, settings.most_refits, settings.most_terms, settings.window)
        return truth, amount, conclude(model_search, settings.sure, settings.largest_class)
