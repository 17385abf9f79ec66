"""Drive logs of whole rovers as a problem: every hypothesis is one more rover in the batch.

Rows of parameters times logs are simulated together, in float64; derivatives are difference quotients between rovers of
one batch, so that a Jacobian costs no program of its own (`jacfwd` through the step takes minutes to compile on a CPU).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from lunar_mjx.criticism.coordinates import Coordinate, default_coordinate, of_candidate
from lunar_mjx.criticism.drive_noise import Noises
from lunar_mjx.criticism.drive_nuisances import STEP_ERROR, direction, from_first, is_linear, nuisances
from lunar_mjx.criticism.drive_program import Rows
from lunar_mjx.criticism.drive_runs import Bench
from lunar_mjx.criticism.fitted import fitted_model
from lunar_mjx.criticism.fitting import Fit, Progress, silent
from lunar_mjx.criticism.gather import Gather
from lunar_mjx.criticism.inputs import FOLLOWS, SMOOTH, amplitude, smooth_inputs
from lunar_mjx.criticism.observations import Observations, Series
from lunar_mjx.criticism.problem import NotTested, Problem
from lunar_mjx.criticism.slip_samples import defined
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.model import Model

if TYPE_CHECKING:
    from lunar_mjx.criticism.log import Log

STEP = 1e-7
"""Difference quotient's step in scales. Predictions jump by hundredths of a sigma where a wheel at rest changes the
sign of its slip; a step this short rarely meets a jump, and rounding spoils only the faintest derivatives."""

STEP_CHI2 = 1.0
"""Squared whitened change by halving the time step, beyond its nuisances, from which these are taken anew at a fit."""

BASELINE: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "soil": {
        "k_phi": (0.3, 2.0), "n": (0.1, 2.0), "cohesion": (0.3, 2.0), "friction_angle": (0.1, 2.0),
        "shear_modulus_x": (0.3, 2.0), "shear_modulus_y": (0.3, 2.0),
    },
    "penalty_contact": {"stiffness": (0.3, 2.0)},
    "motor": {
        "resistance": (0.05, 2.0), "torque_constant": (0.05, 2.0), "gear_efficiency": (0.1, 1.0),
        "winding_capacity": (0.2, 2.0), "housing_capacity": (0.2, 2.0), "R_th1": (0.2, 2.0),
    },
    "housing_convection": {"R_th2": (0.3, 2.0)},
    "housing_conduction": {"conductance": (0.3, 2.0)},
}  # fmt: skip
"""What a refit moves, by effect and parameter: scale as a share of the value, and prior standard deviation in scales:
how well soil and motor are known before a drive."""

NOT_MISSING = frozenset(
    {"parking_brake", "payload", "tether", "hard_surface", "surface_type", "soil_gradient", "boulders"}
)
"""Effects that describe an arrangement of the test, which its user knows, and are never candidates by themselves."""


class DriveProblem(Problem):
    """Drive logs against a model."""

    cheap_jacobian = False

    def __init__(
        self,
        logs: Sequence[Log],
        model: Model,
        candidates: Mapping[str, Effect],
        splits: Mapping[str, str] | None = None,
        baseline: Mapping[str, Mapping[str, tuple[float, float]]] = BASELINE,
        channels: Sequence[str] | None = None,
        chunk: int | None = None,
        engine: str = "auto",
        progress: Progress = silent,
    ):
        """Makes the problem.

        Args:
          logs: of one rover, checked.
          model: the model as it is.
          candidates: effects that may be missing, by name.
          splits: split of a log by its name, in place of the default.
          baseline: what a refit may move: scale and prior by effect and parameter.
          channels: to compare; all that are measured and modelled if None.
          chunk: rovers simulated at once.
          engine: of the dynamics.
          progress: told of every chunk.
        """
        self.logs, self.model = tuple(logs), model
        self._splits, self._baseline_spec, self._channels = dict(splits or {}), baseline, channels
        self._start: dict[str, float] = {}
        self.effects, self.not_tested = _usable(model, candidates)
        self.progress = progress
        self.bench = Bench(model, self.logs, chunk, engine)
        self._batched = jax.default_backend() != "cpu"
        # A program holds only the candidates that leave their null in it: fewer compile and run faster.
        self._benches: dict[frozenset[str], Bench] = {frozenset(): self.bench}
        self._focus: frozenset[str] = frozenset()
        self._gather: Gather | None = None
        found = _baseline_coordinates(model, baseline)
        count = len(found)
        self._noises = Noises(self.logs)
        self.observations = _observations(self.bench, self.logs, splits or {}, channels, self._noises)
        self.noise_unlearnt = any(s.correlation_time > 0.0 for s in self.observations.series)
        for number, run in enumerate(self.bench.runs):
            found += nuisances(number, run, self.observations)
        self.baseline = np.arange(len(found))
        self._nuisance = np.arange(count, len(found))
        self.candidates = {}
        for name, effect in self.effects.items():
            mine = of_candidate(effect)
            self.candidates[name] = np.arange(len(found), len(found) + len(mine))
            found += mine
        self._smooth = smooth_inputs(frozenset(port for e in model.effects for port in e.ports))
        self.inputs = {}
        own = {c.name: len(found) + k for k, c in enumerate(of_candidate(self._smooth))}
        for label, quantities in FOLLOWS.items():
            names = [amplitude(label, q) for q in quantities]
            if names[0] in own:
                self.inputs[label] = np.array([own[n] for n in names])
        self.coordinates = (*found, *of_candidate(self._smooth))
        self._step_error: np.ndarray | None = None
        self._halved: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def eager(self) -> bool:
        """On a GPU a Jacobian costs as little as a residual; not, though, for many refits at once."""
        return self._batched and self._gather is None

    def with_candidates(self, candidates: Mapping[str, Effect], fit: Fit, progress: Progress = silent) -> DriveProblem:
        """The same logs against the fitted model, with other candidates; its origin is the fit."""
        model = self.model
        for name, places in self.candidates.items():
            if np.any(fit.u[places] != 0.0):
                model = model.add(self.effects[name], "criticism", **self.effects[name].null())
        model = fitted_model(self, fit, model)
        other = DriveProblem(self.logs, model, candidates, self._splits, self._baseline_spec, self._channels,
                             self.bench.chunk, self.bench.engine, progress)  # fmt: skip
        other.observations, other.noise_unlearnt = self.observations, self.noise_unlearnt
        other._start = {self.coordinates[i].key: fit.u[i] for i in self._nuisance}
        return other

    def with_effects(self, candidates: Mapping[str, Effect], progress: Progress = silent) -> DriveProblem:
        """The same model and logs with other candidates."""
        return DriveProblem(self.logs, self.model, candidates, self._splits, self._baseline_spec, self._channels,
                            self.bench.chunk, self.bench.engine, progress)  # fmt: skip

    def instead(self, model: Model, candidates: Mapping[str, Effect], progress: Progress = silent) -> DriveProblem:
        """The same logs, with the noise as it was learnt, against another model of the same rover."""
        other = DriveProblem(self.logs, model, candidates, self._splits, self._baseline_spec, self._channels,
                             self.bench.chunk, self.bench.engine, progress)  # fmt: skip
        other.observations, other.noise_unlearnt = self.observations, self.noise_unlearnt
        other._step_error = self.step_error  # of the first order: hardly another, and it costs a program
        return other

    def learn_noise(self, u: np.ndarray) -> None:
        self.observations = self._noises.refined(self.observations, self.observations.value - self.predict(u[None])[0])
        self.noise_unlearnt = False

    def origin(self) -> np.ndarray:
        return np.array([self._start.get(c.key, 0.0) for c in self.coordinates])

    def predict(self, u: np.ndarray) -> np.ndarray:
        rows = np.atleast_2d(u)
        return self._predict(rows) if self._gather is None else self._gather(rows)

    @contextlib.contextmanager
    def together(self, threads: int) -> Iterator[Callable[[], None]]:
        self._gather = Gather(self._predict, threads)
        try:
            yield self._gather.leave
        finally:
            self._gather = None

    def _predict(self, rows: np.ndarray) -> np.ndarray:
        bench = self._bench_for(rows)
        values = self._values(rows)
        out = np.full((len(rows), len(self.observations)), np.nan)
        for number, k, sampled in bench.run(len(rows), values, self.observations, self.progress):
            out[k, self._of_log(number)] = sampled
        out = from_first(out, self.observations)
        for i, c in enumerate(self.coordinates):
            if is_linear(c) and np.any(amount := c.value(rows[:, i])):
                out += np.outer(amount, self._direction(c))
        return out

    def _direction(self, c: Coordinate) -> np.ndarray:
        return direction(c, self.observations, self.step_error if c.name == STEP_ERROR else np.zeros(0))

    @property
    def step_error(self) -> np.ndarray:
        """(n,) what a vanishing time step would add to the predictions of the model as given, to first order.

        The step's error leads joints by a step or so, which an encoder sees. How much of it a log contains is a
        nuisance of the log: all where a rover was measured, nothing where a simulator with the same step recorded it.
        """
        if self._step_error is None:
            origin = self.origin()[None] * 0.0
            coarse, fine = self._simulated(self.bench, origin), self._simulated(self.bench.halved(), origin)
            found = 2.0 * (fine - coarse)
            self._step_error = np.where(np.isfinite(found), found, 0.0)
        return self._step_error

    def _simulated(self, bench: Bench, row: np.ndarray) -> np.ndarray:
        """(n,) what a bench predicts for one row of coordinates, without linear nuisances."""
        out = np.full(len(self.observations), np.nan)
        for number, _, sampled in bench.run(1, self._values(row), self.observations, silent):
            out[self._of_log(number)] = sampled[0]
        return from_first(out, self.observations)

    @contextlib.contextmanager
    def focused(self, effects: Sequence[str]) -> Iterator[None]:
        before, self._focus = self._focus, frozenset(effects)
        try:
            yield
        finally:
            self._focus = before

    def _bench_for(self, rows: np.ndarray) -> Bench:
        """The bench whose model holds every candidate that leaves its null in some row, and few others."""
        null = np.zeros(len(self.coordinates))
        active = frozenset(e for e, places in self.candidates.items() if np.any(rows[:, places] != null[places]))
        if any(np.any(rows[:, places] != 0.0) for places in self.inputs.values()):
            active |= {SMOOTH}
        fitting = [e for e in self._benches if active <= e]
        best = min(fitting, key=len, default=None)
        if active <= self._focus and (best is None or len(best) > len(self._focus)):
            best = self._focus
        elif best is None or len(best) > len(active) + 8:
            best = active
        if best not in self._benches:
            union = self.model
            for name, effect in {**self.effects, SMOOTH: self._smooth}.items():
                if name in best:
                    union = union.add(effect, "criticism", **effect.null())
            self._benches[best] = Bench(union, self.logs, self.bench.chunk, self.bench.engine)
        return self._benches[best]

    def linearise(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        parts = [self._difference_rows(row, which) for row in u]
        values = self.predict(np.concatenate([rows for rows, _ in parts]))
        ends = np.cumsum([len(rows) for rows, _ in parts])
        pieces = np.split(values, ends[:-1])
        return (
            np.stack([p[0] for p in pieces]),
            np.stack([self._quotients(p, which, steps) for p, (_, steps) in zip(pieces, parts, strict=True)]),
        )

    def jacobian(self, u: np.ndarray, which: np.ndarray) -> np.ndarray:
        """As in `Problem`; nuisances of different logs are perturbed together, since a log feels only its own."""
        rows, steps = self._difference_rows(u, which)
        return self._quotients(self.predict(rows), which, steps)

    def _kinds(self, which: np.ndarray) -> tuple[list[int], list[int], list[str]]:
        """Nuisances, shared coordinates, and the names of the nuisances."""
        own = [int(i) for i in which if self.coordinates[i].log_index >= 0 and not is_linear(self.coordinates[i])]
        shared = [int(i) for i in which if self.coordinates[i].log_index < 0]
        return own, shared, sorted({self.coordinates[i].name for i in own})

    def _difference_rows(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own, shared, kinds = self._kinds(which)
        rows = np.repeat(u[None], 1 + len(shared) + len(kinds), axis=0)
        steps = np.empty(len(shared))
        for k, i in enumerate(shared):
            high = self.coordinates[i].bounds()[1]
            steps[k] = STEP if u[i] + STEP <= high else -STEP
            rows[1 + k, i] += steps[k]
        for k, kind in enumerate(kinds):
            same = [i for i in own if self.coordinates[i].name == kind]
            rows[1 + len(shared) + k, same] += STEP
        return rows, steps

    def _quotients(self, values: np.ndarray, which: np.ndarray, steps: np.ndarray) -> np.ndarray:
        _, shared, kinds = self._kinds(which)
        difference = values[1:] - values[:1]
        out = np.zeros((len(self.observations), len(which)))
        for column, i in enumerate(which):
            c = self.coordinates[i]
            if is_linear(c):
                out[:, column] = c.scale * self._direction(c)
            elif c.log_index < 0:
                k = shared.index(int(i))
                out[:, column] = difference[k] / steps[k]
            else:
                part = self._of_log(c.log_index)
                out[part, column] = difference[len(shared) + kinds.index(c.name), part] / STEP
        return out

    def _of_log(self, number: int) -> slice:
        mine = [s for s in self.observations.series if s.log == number]
        return slice(mine[0].start, mine[-1].stop) if mine else slice(0, 0)

    def _values(self, rows: np.ndarray) -> Rows:
        return {
            (c.effect, c.name, c.log_index, c.factor): np.asarray(c.value(rows[:, i]))
            for i, c in enumerate(self.coordinates)
        }

    def certificate(self, u: np.ndarray, free: np.ndarray) -> Mapping[str, float]:
        """The change of chi-square by halving the time step, beyond what the nuisance of the step's error absorbs."""
        del free
        keep, whiten = self.observations.in_split("fit"), self.observations.whiten
        change = self._unabsorbed(self._halving(u))
        coarse = self.observations.value - self.predict(u[None])[0]
        chi2 = [np.sum(whiten(r)[keep] ** 2) for r in (coarse, coarse - change)]
        return {"half_step_chi2": float(abs(chi2[0] - chi2[1]))}

    def renew_step_error(self, u: np.ndarray) -> bool:
        change = self._halving(u)
        whitened = self.observations.whiten(self._unabsorbed(change))[self.observations.in_split("fit")]
        if not float(whitened @ whitened) > STEP_CHI2:
            return False
        self._step_error = np.where(np.isfinite(change), 2.0 * change, 0.0)
        return True

    def _halving(self, u: np.ndarray) -> np.ndarray:
        """(n,) the change of the predictions by halving the time step."""
        if self._halved is None or not np.array_equal(self._halved[0], u):
            bench = self._bench_for(u[None])
            change = self._simulated(bench.halved(), u[None]) - self._simulated(bench, u[None])
            self._halved = u.copy(), change
        return self._halved[1].copy()

    def _unabsorbed(self, change: np.ndarray) -> np.ndarray:
        """(n,) what of a change the nuisances of the step's error cannot take up."""
        whiten = self.observations.whiten
        for c in self.coordinates:
            if c.name == STEP_ERROR:
                mine, own = self._of_log(c.log_index), np.zeros(len(change))
                own[mine] = change[mine]
                known = self._direction(c)
                along = whiten(known)
                size = float(along @ along)
                change = change - (float(along @ whiten(own)) / size if size > 0.0 else 0.0) * known
        return change


def _usable(model: Model, candidates: Mapping[str, Effect]) -> tuple[dict[str, Effect], tuple[NotTested, ...]]:
    present = set(model.effect_names)
    usable, refused = {}, []
    for name, effect in candidates.items():
        if name in present:
            continue
        if name in NOT_MISSING:
            refused.append(NotTested(name, "describes the arrangement of a test, which its user knows"))
        elif present & set(effect.replaces):
            refused.append(NotTested(name, f"would replace {', '.join(sorted(present & set(effect.replaces)))}"))
        elif all(p.null is None for p in effect.parameters.values()):
            refused.append(NotTested(name, "has no null value"))
        else:
            usable[name] = effect
    return usable, tuple(refused)


def _baseline_coordinates(model: Model, baseline: Mapping[str, Mapping[str, tuple[float, float]]]) -> list[Coordinate]:
    """Baseline parameters; one that differs between wheels or joints moves by a common factor."""
    found = []
    for effect in model.effects:
        for name, (relative, prior) in baseline.get(effect.name, {}).items():
            value = np.atleast_1d(np.asarray(model.parameters[effect.name][name], float))
            p = effect.parameters[name]
            if np.all(value > 0.0):
                low, high = max(p.bounds[0] / value.min(), 1e-3), min(p.bounds[1] / value.max(), 1e3)
                found.append(Coordinate(effect.name, name, 1.0, relative, low, high, True, prior, factor=True))
        # Effects beyond the preset were added to explain measurements; they are refitted with the rest.
        if effect.name not in PRESETS.get(model.preset, ()) and effect.name not in NOT_MISSING:
            for name, p in effect.parameters.items():
                value = np.asarray(model.parameters[effect.name][name], float)
                if p.null is not None and value.ndim == 0:
                    found.append(default_coordinate(effect, name, float(value), 0.3, 10.0))
    return found


def default_splits(logs: Sequence[Log]) -> list[str]:
    """Splits of logs that state none: with four or more every fourth is held out, the first of these for selection."""
    out = []
    for i, log in enumerate(logs):
        held = "select" if i % 8 == 3 else "test"
        out.append(log.split or (held if len(logs) >= 4 and i % 4 == 3 else "fit"))
    return out


def _observations(
    bench: Bench, logs: Sequence[Log], splits: Mapping[str, str], channels: Sequence[str] | None, noise: Noises
) -> Observations:
    value, series, unit, at = [], [], [], 0
    default = default_splits(logs)
    for number, (log, run) in enumerate(zip(logs, bench.runs, strict=True)):
        for channel in bench.channels(number):
            if channels is not None and channel not in channels:
                continue
            found = log.channel(channel)
            if found is None:
                continue
            time, measured = found
            inside = (time >= run.begin - 1e-9) & (time <= run.end + 1e-9) & defined(log, run, channel, time)
            time, measured = time[inside], measured[inside]
            if len(time) < 2:
                continue
            white, coloured, tau = noise(log, channel)
            series.append(Series(number, channel, at, at + len(time), time, white, coloured, tau))
            value.append(measured)
            unit.append(np.full(len(time), number))
            at += len(time)
    names = tuple(log.name for log in logs)
    split = tuple(splits.get(n, d) for n, d in zip(names, default, strict=True))
    return Observations(
        value=np.concatenate(value), series=tuple(series), logs=names, split=split,
        unit=np.concatenate(unit), unit_split=split, unit_names=names,
    )  # fmt: skip
