"""Drive logs of whole rovers as a problem: every hypothesis is one more rover in the batch.

Rows of parameters times logs are simulated together, in float64; derivatives are difference quotients between rovers of
one batch, so that a Jacobian costs no program of its own (`jacfwd` through the step takes minutes to compile on a CPU).
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import jax
import numpy as np

from lunar_mjx.criticism.coordinates import Coordinate, of_candidate
from lunar_mjx.criticism.drive_baseline import BASELINE, baseline_coordinates, usable
from lunar_mjx.criticism.drive_noise import Noises
from lunar_mjx.criticism.drive_nuisances import (
    STANDING,
    STEP_ERROR,
    direction,
    from_first,
    is_linear,
    nuisances,
    standing_shows,
)
from lunar_mjx.criticism.drive_observations import observations_of
from lunar_mjx.criticism.drive_program import STOOD, Rows
from lunar_mjx.criticism.drive_runs import Bench
from lunar_mjx.criticism.fitted import fitted_model
from lunar_mjx.criticism.fitting import Fit, Progress, silent
from lunar_mjx.criticism.gather import Gather
from lunar_mjx.criticism.inputs import FOLLOWS, SMOOTH, amplitude, smooth_inputs
from lunar_mjx.criticism.observations import Observations
from lunar_mjx.criticism.problem import Problem
from lunar_mjx.criticism.simulated import Key, Simulated, keys_of_rows, stamp_of_observations
from lunar_mjx.effects.base import Effect
from lunar_mjx.model import Model

if TYPE_CHECKING:
    from lunar_mjx.criticism.log import Log

STEP = 1e-7
"""Difference quotient's step in scales. Predictions jump by hundredths of a sigma where a wheel at rest changes the
sign of its slip; a step this short rarely meets a jump, and rounding spoils only the faintest derivatives."""

STEP_CHI2 = 1.0
"""Squared whitened change by halving the time step, beyond its nuisances, from which these are taken anew at a fit."""

SIMULATED = Simulated()
"""What all problems of this process have simulated."""


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
        self.effects, self.not_tested = usable(model, candidates)
        self.progress = progress
        self.bench = Bench(model, self.logs, chunk, engine)
        self._batched = jax.default_backend() != "cpu"
        self._together = max(1, self.bench.chunk // len(self.logs))
        # A program holds only the candidates that leave their null in it: fewer compile and run faster.
        self._benches: dict[frozenset[str], Bench] = {frozenset(): self.bench}
        self._focus: frozenset[str] = frozenset()
        self._gather: Gather | None = None
        self._foreseen: list[np.ndarray] = []
        self._stamped: tuple[Observations | None, bytes] = None, b""
        self._lock = threading.RLock()
        found = baseline_coordinates(model, baseline)
        count = len(found)
        self._noises = Noises(self.logs)
        self.observations = observations_of(self.bench, self.logs, splits or {}, channels, self._noises)
        self.noise_unlearnt = any(s.correlation_time > 0.0 for s in self.observations.series)
        shows = self._standing_shows()
        for number, run in enumerate(self.bench.runs):
            found += nuisances(number, run, self.observations, number in shows)
        self.baseline = np.arange(len(found))
        self._nuisance = np.arange(count, len(found))
        self.candidates = {}
        for name, effect in self.effects.items():
            mine = of_candidate(effect)
            self.candidates[name] = np.arange(len(found), len(found) + len(mine))
            found += mine
        self._smooth = smooth_inputs(frozenset(port for e in model.effects for port in e.ports))
        own = {c.name: len(found) + k for k, c in enumerate(of_candidate(self._smooth))}
        amplitudes = {label: [amplitude(label, q) for q in quantities] for label, quantities in FOLLOWS.items()}
        self.inputs = {k: np.array([own[n] for n in names]) for k, names in amplitudes.items() if names[0] in own}
        self.coordinates = (*found, *of_candidate(self._smooth))
        self._step_error: np.ndarray | None = None
        self._halved: tuple[np.ndarray, np.ndarray] | None = None

    @property
    def eager(self) -> bool:
        """On a GPU a Jacobian costs as little as a residual; not, though, for many refits at once."""
        return self._batched and self._gather is None

    def _standing_shows(self) -> frozenset[int]:
        """Logs on a slope whose predictions depend on how long the rover had stood before."""
        sloped = [n for n, run in enumerate(self.bench.runs) if STOOD in run.unknown]
        if not sloped:
            return frozenset()
        values = {("initial", STOOD, n, False): np.array(STANDING) for n in sloped}
        seen = np.full((2, len(self.observations)), np.nan)
        for number, rows, sampled in self.bench.run(2, values, self.observations, silent):
            seen[rows, self._of_log(number)] = sampled
        return frozenset(n for n in sloped if standing_shows(seen[1] - seen[0], n, self.observations))

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
        if self._gather is None:
            return self._predict(rows)
        with self._lock:
            known = self._all_known(rows)
        return self._predict(rows) if known else self._gather(rows)

    def foresee(self, rows: np.ndarray, which: np.ndarray | None = None) -> None:
        if self._batched:
            blocks = [rows] if which is None else [self._difference_rows(row, which)[0] for row in rows]
            with self._lock:
                self._foreseen += blocks

    @contextlib.contextmanager
    def together(self, threads: int) -> Iterator[Callable[[], None]]:
        self._gather = Gather(self._predict, threads)
        try:
            yield self._gather.leave
        finally:
            self._gather = None

    def _predict(self, rows: np.ndarray) -> np.ndarray:
        with self._lock:
            out = self._simulations(self._bench_for(rows), rows, self.progress)
        for i, c in enumerate(self.coordinates):
            if is_linear(c) and np.any(amount := c.value(rows[:, i])):
                part = self._of_log(c.log_index)
                out[:, part] += np.outer(amount, self._direction(c)[part])
        return out

    def _all_known(self, rows: np.ndarray) -> bool:
        """Whether nothing has to be simulated for these rows."""
        return all(k in SIMULATED for k in self._keys(self._bench_for(rows), rows))

    def _keys(self, bench: Bench, rows: np.ndarray) -> list[Key]:
        """What a bench's simulation of each row depends on."""
        acting = frozenset(e for params in bench.params for e in params.effects) | {"initial"}
        which = [i for i, c in enumerate(self.coordinates) if c.effect in acting and not is_linear(c)]
        names = [(c.effect, c.name, c.log_index, c.factor) for c in (self.coordinates[i] for i in which)]
        columns = [np.asarray(self.coordinates[i].value(rows[:, i]), float) for i in which]
        table = np.stack(columns, axis=1) if columns else np.zeros((len(rows), 0))
        return keys_of_rows((*bench.stamp, self._sampled_at()), names, table)

    def _sampled_at(self) -> bytes:
        if self._stamped[0] is not self.observations:
            self._stamped = self.observations, stamp_of_observations(self.observations)
        return self._stamped[1]

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
        with self._lock:
            return self._simulations(bench, row, silent)[0]

    def _simulations(self, bench: Bench, rows: np.ndarray, progress: Progress) -> np.ndarray:
        """(k, n) what a bench predicts for rows of coordinates, without linear nuisances, kept or simulated."""
        keys = self._keys(bench, rows)
        found = {k: row for k in dict.fromkeys(keys) if (row := SIMULATED.get(k)) is not None}
        new = {k: n for n, k in enumerate(keys) if k not in found}
        if new:
            wanted = rows[list(new.values())]
            for k, row in self._room_for(bench, wanted):
                if k not in new and k not in SIMULATED:
                    new[k] = len(wanted)
                    wanted = np.concatenate([wanted, row[None]])
            simulated = np.full((len(wanted), len(self.observations)), np.nan)
            for number, k, sampled in bench.run(len(wanted), self._values(wanted), self.observations, progress):
                simulated[k, self._of_log(number)] = sampled
            simulated = from_first(simulated, self.observations)
            for k, row in zip(new, simulated, strict=True):
                SIMULATED.keep(k, row)
                found[k] = row
        return np.stack([found[k] for k in keys])

    def _room_for(self, bench: Bench, rows: np.ndarray) -> Iterator[tuple[Key, np.ndarray]]:
        """Foreseen rows, with their keys, that a bench simulates beside others at no cost; the others are forgotten."""
        if bench not in self._benches.values():
            return
        room = -len(rows) % self._together
        foreseen, self._foreseen = self._foreseen, []
        for block in foreseen:
            if len(block) <= room and self._active(block) <= frozenset(bench.model.effect_names):
                room -= len(block)
                yield from zip(self._keys(bench, block), block, strict=True)

    @contextlib.contextmanager
    def focused(self, effects: Sequence[str]) -> Iterator[None]:
        before, self._focus = self._focus, frozenset(effects)
        try:
            yield
        finally:
            self._focus = before

    def _bench_for(self, rows: np.ndarray) -> Bench:
        """The bench whose model holds every candidate that leaves its null in some row, and few others."""
        active = self._active(rows)
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

    def _active(self, rows: np.ndarray) -> frozenset[str]:
        """Candidates that leave their null in some row, with the unknown inputs as one."""
        moved = {**self.candidates, SMOOTH: np.concatenate([np.zeros(0, int), *self.inputs.values()])}
        return frozenset(e for e, places in moved.items() if np.any(rows[:, places] != 0.0))

    def linearise(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
        parts = [self._difference_rows(row, which) for row in u]
        values = self.predict(np.concatenate([rows for rows, _ in parts]))
        ends = np.cumsum([len(rows) for rows, _ in parts])
        pieces = np.split(values, ends[:-1])
        return np.stack([p[0] for p in pieces]), lambda k: self._quotients(pieces[k], which, parts[k][1])

    def jacobian_and(self, u: np.ndarray, which: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        own, steps = self._difference_rows(u, which)
        values = self.predict(np.concatenate([own, rows]))
        return self._quotients(values[: len(own)], which, steps), values[len(own) :]

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
        return self.observations.of_log.get(number, slice(0, 0))

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

    def kept_step_error(self) -> np.ndarray | None:
        return self.step_error

    def use_step_error(self, kept: np.ndarray | None) -> None:
        if kept is not None:
            self._step_error = kept

    def renew_step_error(self, u: np.ndarray) -> bool:
        change = self._halving(u)
        for number in range(len(self.logs)):
            part = self._of_log(number)
            if not np.isfinite(change[part]).all():
                change[part] = 0.0
        whitened = self.observations.whiten(self._unabsorbed(change))[self.observations.in_split("fit")]
        if not float(whitened @ whitened) > STEP_CHI2:
            return False
        self._step_error = 2.0 * change
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
        whiten, change = self.observations.whiten, change.copy()
        for c in self.coordinates:
            if c.name == STEP_ERROR:
                mine, own = self._of_log(c.log_index), np.zeros(len(change))
                own[mine] = change[mine]
                known = self._direction(c)
                along = whiten(known)
                size = float(along @ along)
                change[mine] -= (float(along @ whiten(own)) / size if size > 0.0 else 0.0) * known[mine]
        return change
