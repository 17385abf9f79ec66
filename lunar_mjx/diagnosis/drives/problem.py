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

from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.drives.baseline import BASELINE, baseline_coordinates, unfit
from lunar_mjx.diagnosis.drives.differences import STEP, WIDE, Differences
from lunar_mjx.diagnosis.drives.instruments import instrument_direction, instrument_nuisances, is_instrument
from lunar_mjx.diagnosis.drives.log_run import STOOD
from lunar_mjx.diagnosis.drives.noise import Noises
from lunar_mjx.diagnosis.drives.nuisances import (
    STANDING,
    STEP_ERROR,
    direction,
    from_first,
    is_linear,
    nuisances,
    standing_shows,
    step_error_share,
    unabsorbed,
)
from lunar_mjx.diagnosis.drives.observations import observations_of, with_discrepancy
from lunar_mjx.diagnosis.drives.program import Rows
from lunar_mjx.diagnosis.drives.rollouts import Bench
from lunar_mjx.diagnosis.drives.simulated_rows import Key, Simulated, keys_of_rows, stamp_of_observations
from lunar_mjx.diagnosis.drives.unused import unused_sentence
from lunar_mjx.diagnosis.effect_coordinates import of_candidate
from lunar_mjx.diagnosis.fitted_model import fitted_model
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS, SMOOTH, amplitude, smooth_inputs
from lunar_mjx.effects.base import Effect
from lunar_mjx.inference.coordinates import NUISANCE, Coordinate
from lunar_mjx.inference.fitting import Fit, Progress, silent
from lunar_mjx.inference.gather import Gather
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.problem import Problem
from lunar_mjx.model import Model

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

STEP_CHI2 = 1.0
"""Squared whitened change by halving the time step, beyond its nuisances, from which these are taken anew at a fit."""

SIMULATED = Simulated()
"""What all problems of this process have simulated."""


class DriveProblem(Problem):
    """Drive logs against a model."""

    cheap_jacobian = False
    has_windows = True

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
        discrepancy: Mapping[str, float] | None = None,
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
          discrepancy: known unexplained error of the model by channel, in its unit; a name may hold `*`.

        Raises:
          UserError: a discrepancy of a channel that is not compared.
        """
        self.logs, self.model = tuple(logs), model
        self._splits, self._baseline_spec, self._channels = dict(splits or {}), baseline, channels
        self._discrepancy = dict(discrepancy or {})
        self._start: dict[str, float] = {}
        self.effects, self.not_tested = usable(model.effects, candidates, unfit)
        self.progress = progress
        self.bench = Bench(model, self.logs, chunk, engine)
        self._batched = jax.default_backend() != "cpu"
        self._together = max(1, self.bench.chunk // len(self.logs))
        # A program holds only the candidates that leave their null in it: fewer compile and run faster.
        self._benches: dict[frozenset[str], Bench] = {frozenset(): self.bench}
        self._focus: frozenset[str] = frozenset()
        self._windows = False
        self._gather: Gather | None = None
        self._foreseen: list[np.ndarray] = []
        self._stamped: tuple[Observations | None, bytes] = None, b""
        self._lock = threading.RLock()
        found = baseline_coordinates(model, baseline)
        count = len(found)
        self._noises = Noises(self.logs)
        self._noise_alone = observations_of(self.bench, self.logs, splits or {}, channels, self._noises)
        self.observations = with_discrepancy(self._noise_alone, self._discrepancy)
        self.noise_unlearnt = any(s.correlation_time > 0.0 for s in self._noise_alone.series)
        shows = self._standing_shows()
        found.append(step_error_share())
        for number, run in enumerate(self.bench.runs):
            found += nuisances(number, run, self.observations, number in shows)
            found += instrument_nuisances(number, self.logs[number], self.observations)
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
        self._instruments: dict[str, np.ndarray] = {}
        self._halved: tuple[frozenset[str], np.ndarray, np.ndarray] | None = None

    @property
    def unused(self) -> str:
        """What the logs hold and nothing reads, as one sentence; empty if all is read."""
        return unused_sentence(self.logs, [self.bench.channels(n) for n in range(len(self.logs))])

    @property
    def eager(self) -> bool:
        """On a GPU a Jacobian costs as little as a residual; not, though, for many refits at once."""
        return self._batched and (self._gather is None or self._gather.parties < 2)

    def _standing_shows(self) -> frozenset[int]:
        """Logs on a slope whose predictions depend on how long the rover had stood before."""
        sloped = [n for n, run in enumerate(self.bench.runs) if STOOD in run.unknown]
        if not sloped:
            return frozenset()
        keys = [(*self.bench.stamp, self._sampled_at(), STOOD, time) for time in STANDING]
        seen = [row for k in keys if (row := SIMULATED.get(k)) is not None]
        if len(seen) < len(keys):
            values = {(NUISANCE, STOOD, n, False): np.array(STANDING) for n in sloped}
            seen = list(self._run(self.bench, len(keys), values, silent))
            for k, row in zip(keys, seen, strict=True):
                SIMULATED.keep(k, row)
        return frozenset(n for n in sloped if standing_shows(seen[1] - seen[0], n, self.observations))

    def with_candidates(self, candidates: Mapping[str, Effect], fit: Fit, progress: Progress = silent) -> DriveProblem:
        """The same logs against the fitted model, with other candidates; its origin is the fit."""
        model = self.model
        for name, places in self.candidates.items():
            if np.any(fit.u[places] != 0.0):
                model = model.add(self.effects[name], "criticism", **self.effects[name].null())
        model = fitted_model(self, fit, model)
        other = self.with_effects(candidates, progress, model)
        other.observations, other.noise_unlearnt = self.observations, self.noise_unlearnt
        other._noise_alone = self._noise_alone
        other._start = {self.coordinates[i].key: fit.u[i] for i in self._nuisance}
        return other

    def with_effects(
        self, candidates: Mapping[str, Effect], progress: Progress = silent, model: Model | None = None
    ) -> DriveProblem:
        """The same logs with other candidates, against another model if one is given."""
        return DriveProblem(
            self.logs,
            model or self.model,
            candidates,
            self._splits,
            self._baseline_spec,
            self._channels,
            self.bench.chunk,
            self.bench.engine,
            progress,
            self._discrepancy,
        )

    def instead(self, model: Model, candidates: Mapping[str, Effect], progress: Progress = silent) -> DriveProblem:
        """The same logs, with the noise as it was learnt, against another model of the same rover."""
        other = self.with_effects(candidates, progress, model)
        other.observations, other.noise_unlearnt = self.observations, self.noise_unlearnt
        other._noise_alone = self._noise_alone
        other._step_error = self.step_error  # of the first order: hardly another, and it costs a program
        return other

    def learn_noise(self, u: np.ndarray) -> None:
        self._noise_alone = self._noises.refined(self._noise_alone, self.observations.value - self.predict(u[None])[0])
        self.observations = with_discrepancy(self._noise_alone, self._discrepancy)
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
            blocks = [rows] if which is None else [Differences(self.coordinates, which).rows(row) for row in rows]
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
                part = self._of_log(c.log_index) if c.log_index >= 0 else slice(None)
                out[:, part] += np.outer(amount, self._direction(c)[part])
        return out

    def _all_known(self, rows: np.ndarray) -> bool:
        """Whether nothing has to be simulated for these rows."""
        return all(k in SIMULATED for k in self._keys(self._bench_for(rows), rows))

    def _keys(self, bench: Bench, rows: np.ndarray) -> list[Key]:
        """What a bench's simulation of each row depends on."""
        acting = frozenset(e for params in bench.params for e in params.effects) | {NUISANCE}
        which = [i for i, c in enumerate(self.coordinates) if c.effect in acting and not is_linear(c)]
        names = [(c.effect, c.name, c.log_index, c.factor) for c in (self.coordinates[i] for i in which)]
        columns = [np.asarray(self.coordinates[i].value(rows[:, i]), float) for i in which]
        table = np.stack(columns, axis=1) if columns else np.zeros((len(rows), 0))
        return keys_of_rows((*bench.stamp, self._windows, self._sampled_at()), names, table)

    def _sampled_at(self) -> bytes:
        if self._stamped[0] is not self.observations:
            self._stamped = self.observations, stamp_of_observations(self.observations)
        return self._stamped[1]

    def _direction(self, c: Coordinate) -> np.ndarray:
        if is_instrument(c):
            return self._instrument(c)
        return direction(c, self.observations, self.step_error if c.name == STEP_ERROR else np.zeros(0))

    def _instrument(self, c: Coordinate) -> np.ndarray:
        """(n,) what one unit of a clock's or a mounting's error adds, about the predictions of the model as given."""
        if c.key not in self._instruments:
            predicted = self._simulated(self.bench, self.origin()[None] * 0.0)
            found = instrument_direction(c, self.logs[c.log_index], self.observations, predicted)
            self._instruments[c.key] = np.where(np.isfinite(found), found, 0.0)
        return self._instruments[c.key]

    @property
    def step_error(self) -> np.ndarray:
        """(n,) what a vanishing time step would add to the predictions of the model as given, to first order.

        The step's error leads joints by a step or so, which an encoder sees. How much of it logs contain is a
        nuisance: all where a rover was measured, nothing where a simulator with the same step recorded it.
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
            simulated = from_first(self._run(bench, len(wanted), self._values(wanted), progress), self.observations)
            for k, row in zip(new, simulated, strict=True):
                SIMULATED.keep(k, row)
                found[k] = row
            if list(new)[: len(keys)] == keys:
                return simulated[: len(keys)]
        return np.stack([found[k] for k in keys])

    def _run(self, bench: Bench, rows: int, values: Rows, progress: Progress) -> np.ndarray:
        """(rows, n) what a bench simulates."""
        out = np.full((rows, len(self.observations)), np.nan)
        for number, k, sampled in bench.run(rows, values, self.observations, progress, self._windows):
            out[k, self._of_log(number)] = sampled
        return out

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

    @contextlib.contextmanager
    def in_windows(self) -> Iterator[None]:
        self.use_step_error(self.step_error)  # that of whole rollouts
        self._windows = True
        try:
            yield
        finally:
            self._windows = False

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
            self._benches[best] = Bench(union, self.logs, self.bench.chunk, self.bench.engine, self.bench)
        return self._benches[best]

    def _active(self, rows: np.ndarray) -> frozenset[str]:
        """Candidates that leave their null in some row, with the unknown inputs as one."""
        moved = {**self.candidates, SMOOTH: np.concatenate([np.zeros(0, int), *self.inputs.values()])}
        return frozenset(e for e, places in moved.items() if np.any(rows[:, places] != 0.0))

    def linearise(self, u: np.ndarray, which: np.ndarray) -> tuple[np.ndarray, Callable[[int], np.ndarray]]:
        differences = Differences(self.coordinates, which)
        parts = [differences.rows(row) for row in u]
        values = np.split(self.predict(np.concatenate(parts)), np.cumsum([len(rows) for rows in parts])[:-1])
        jacobian = lambda k: differences.jacobian(u[k], values[k], self.observations, self._direction)  # noqa: E731
        return np.stack([v[0] for v in values]), jacobian

    def jacobian_and(
        self, u: np.ndarray, which: np.ndarray, rows: np.ndarray, step: float | np.ndarray = STEP
    ) -> tuple[np.ndarray, np.ndarray]:
        differences = Differences(self.coordinates, which, step)
        own = differences.rows(u)
        values = self.predict(np.concatenate([own, rows]))
        jacobian = differences.jacobian(u, values[: len(own)], self.observations, self._direction)
        return jacobian, values[len(own) :]

    def jacobian(self, u: np.ndarray, which: np.ndarray) -> np.ndarray:
        return self.jacobian_and(u, which, np.zeros((0, len(u))))[0]

    def wide_jacobian(self, u: np.ndarray, which: np.ndarray, std: np.ndarray) -> np.ndarray:
        return self.jacobian_and(u, which, np.zeros((0, len(u))), np.clip(std, *WIDE))[0]

    def foresee_wide(self, u: np.ndarray, which: np.ndarray, std: np.ndarray) -> None:
        self.foresee(Differences(self.coordinates, which, np.clip(std, *WIDE)).rows(u))

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
        change = unabsorbed(self._halving(u), self.step_error, self.observations)
        coarse = self.observations.value - self.predict(u[None])[0]
        chi2 = [np.sum(whiten(r)[keep] ** 2) for r in (coarse, coarse - change)]
        return {"half_step_chi2": float(abs(chi2[0] - chi2[1]))}

    def kept_step_error(self) -> np.ndarray | None:
        return self.step_error

    def use_step_error(self, kept: np.ndarray | None) -> None:
        if kept is not None:
            self._step_error = kept

    def renew_step_error(self, u: np.ndarray, least: float = STEP_CHI2) -> bool:
        change = self._halving(u)
        for number in range(len(self.logs)):
            part = self._of_log(number)
            if not np.isfinite(change[part]).all():
                change[part] = 0.0
        left = unabsorbed(change, self.step_error, self.observations)
        whitened = self.observations.whiten(left)[self.observations.in_split("fit")]
        if not float(whitened @ whitened) > least:
            return False
        self._step_error = 2.0 * change
        return True

    def _halving(self, u: np.ndarray) -> np.ndarray:
        """(n,) the change of the predictions by halving the time step, here or where they are less than a sigma away.

        Within that the change is the same but for a small share of itself, and fits end where they do not move at all.
        """
        bench = self._bench_for(u[None])
        coarse, active = self._simulated(bench, u[None]), self._active(u[None])
        if self._halved is not None and self._halved[0] == active:
            moved = self.observations.whiten(coarse - self._halved[1])
            if float(moved @ moved) < STEP_CHI2:
                return self._halved[2].copy()
        change = self._simulated(bench.halved(), u[None]) - coarse
        self._halved = active, coarse, change
        return change.copy()
