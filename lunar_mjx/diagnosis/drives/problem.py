"""Drive logs of whole rovers as a problem: every hypothesis is one more rover in the batch.

Rows of parameters times logs are simulated together, in float64; derivatives are difference quotients between rovers of
one batch, so that a Jacobian costs no program of its own (`jacfwd` through the step takes minutes to compile on a CPU).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.contact_laws import no_addition
from lunar_mjx.diagnosis.drives.baseline import BASELINE, baseline_coordinates, unfit
from lunar_mjx.diagnosis.drives.differences import Differences, flatter
from lunar_mjx.diagnosis.drives.instruments import (
    USUAL,
    instrument_direction,
    instrument_nuisances,
    is_instrument,
    usual_errors,
    usual_nuisances,
)
from lunar_mjx.diagnosis.drives.means import Means
from lunar_mjx.diagnosis.drives.noise import Noises
from lunar_mjx.diagnosis.drives.nuisances import (
    STANDING,
    STEP_ERROR,
    direction,
    from_first,
    is_linear,
    nuisances,
    reads_before_share,
    standing_shows,
    step_error_share,
)
from lunar_mjx.diagnosis.drives.observations import observations_of, with_discrepancy
from lunar_mjx.diagnosis.drives.simulation.log_run import STOOD
from lunar_mjx.diagnosis.drives.simulation.program import Rows
from lunar_mjx.diagnosis.drives.simulation.rollouts import Bench, at_once, jumps
from lunar_mjx.diagnosis.drives.simulation.simulated_rows import (
    Key,
    Simulated,
    keys_of_rows,
    stamp,
    stamp_of_observations,
)
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import ground_coordinates
from lunar_mjx.diagnosis.drives.unused import unused_sentence
from lunar_mjx.diagnosis.effect_coordinates import of_candidate
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS, SMOOTH, amplitude, smooth_inputs
from lunar_mjx.effects.base import Effect
from lunar_mjx.inference.coordinates import NUISANCE, Coordinate
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.observations import Observations
from lunar_mjx.model import Model

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

SIMULATED = Simulated()
"""What all problems of this process have simulated."""


class DriveProblem:
    """Drive logs against a model, and every effect and unknown input that may be added to it.

    Attributes:
      observations: what was measured. coordinates: everything that may move; unknown inputs come last.
      baseline: places of those of the model as it is. candidates: places by effect that may be missing.
      ground: places of the amounts of modes of ground that nobody mapped.
      effects: the candidates. not_tested: those that cannot enter.
      inputs: places of the amplitudes of unknown inputs that follow quantities of their ports, by label.
      noise_unlearnt: whether the noise's colour is known from rest alone, so that `learn_noise` is to be called.
    """

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
        span: float = 0.0,
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
          span: over which readings are averaged, s; 0 for every reading by itself.

        Raises:
          UserError: a discrepancy of a channel that is not compared.
        """
        self.logs, self.model, self.progress = tuple(logs), model, progress
        self._discrepancy = dict(discrepancy or {})
        present = [e.name for e in model.effects]
        self.effects, self.not_tested = usable(
            model.effects, candidates, lambda name, effect: unfit(name, effect) or no_addition(present, name)
        )
        self.bench = Bench(model, self.logs, chunk, engine)
        self._stamped: tuple[Observations | None, bytes] = None, b""
        coordinates = baseline_coordinates(model, baseline)
        self._noises = Noises(self.logs)
        self._readings = observations_of(self.bench, self.logs, splits or {}, channels, self._noises)
        self._means = Means(self._readings, span, [run.begin for run in self.bench.runs])
        self._rate: np.ndarray | None = None
        self.observations = self._averaged()
        self.noise_unlearnt = any(s.correlation_time > 0.0 for s in self._readings.series)
        shows = self._standing_shows()
        coordinates.append(step_error_share())
        if any(at_once(s.channel) for s in self.observations.series):
            coordinates.append(reads_before_share())
        for number, run in enumerate(self.bench.runs):
            coordinates += nuisances(number, run, self.observations, number in shows)
            coordinates += instrument_nuisances(number, self.logs[number], self.observations)
        coordinates += usual_nuisances(self.observations)
        self.baseline = np.arange(len(coordinates))
        radius = float(np.mean([w.radius for w in model.rover.wheels]))
        for number, run in enumerate(self.bench.runs):
            if run.ground is not None:
                coordinates += ground_coordinates(number, run.ground, radius)
        self.ground = np.arange(len(self.baseline), len(coordinates))
        self.candidates: dict[str, np.ndarray] = {}
        for name, effect in self.effects.items():
            mine = of_candidate(effect)
            self.candidates[name] = np.arange(len(coordinates), len(coordinates) + len(mine))
            coordinates += mine
        smooth = smooth_inputs(frozenset(port for e in model.effects for port in e.ports))
        own = {c.name: len(coordinates) + k for k, c in enumerate(of_candidate(smooth))}
        amplitudes = {label: [amplitude(label, q) for q in quantities] for label, quantities in FOLLOWS.items()}
        self.inputs = {k: np.array([own[n] for n in names]) for k, names in amplitudes.items() if names[0] in own}
        self.coordinates = (*coordinates, *of_candidate(smooth))
        self._additions = {**self.effects, SMOOTH: smooth}
        self._wider: dict[frozenset[str], Bench] = {}
        self._devoted: set[frozenset[str]] = set()
        self._step_error: np.ndarray | None = None
        self._instruments: dict[str, np.ndarray] = {}
        self._reference = self.origin()

    @property
    def unused(self) -> str:
        """What the logs hold and nothing reads, as one sentence; empty if all is read."""
        return unused_sentence(self.logs, [self.bench.channels(n) for n in range(len(self.logs))])

    @property
    def together(self) -> int:
        """Rows that two chunks hold: as many on every machine, as what a descent tries must not depend on its cores."""
        return max(1, 2 * self.bench.chunk // len(self.logs))

    def origin(self) -> np.ndarray:
        """(coordinates,) the model as given."""
        return np.zeros(len(self.coordinates))

    def free(self, effects: Sequence[str] = ()) -> np.ndarray:
        """Places of the baseline's coordinates and of those of some candidates."""
        return np.concatenate([self.baseline, *(self.candidates[e] for e in effects)]).astype(int)

    def bounds(self, which: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper bounds of some coordinates."""
        pairs = np.array([self.coordinates[i].bounds() for i in which], float).reshape(-1, 2)
        return pairs[:, 0], pairs[:, 1]

    def about(self, u: np.ndarray) -> None:
        """Sets the place (coordinates,) at whose predictions errors of instruments and of finite steps are linear.

        It is the model as given until then. Where that errs much, an instrument's scale there is one of other signals.
        """
        self._reference = self.origin()
        for places in (self.baseline, self.ground, *self.inputs.values()):
            self._reference[places] = u[places]
        self._rate, self._step_error, self._instruments = None, None, {}

    def _standing_shows(self) -> frozenset[int]:
        """Logs on a slope whose predictions depend on how long the rover had stood before."""
        sloped = [n for n, run in enumerate(self.bench.runs) if STOOD in run.unknown]
        if not sloped:
            return frozenset()
        keys = [(*self.bench.stamp, self._sampled_at(), STOOD, time) for time in STANDING]
        seen = [row for k in keys if (row := SIMULATED.get(k)) is not None]
        if len(seen) < len(keys):
            values = {(NUISANCE, STOOD, n, False): np.array(STANDING) for n in sloped}
            seen = list(self._means(self._run(self.bench, len(keys), values, silent)))
            for k, row in zip(keys, seen, strict=True):
                SIMULATED.keep(k, row)
        return frozenset(n for n in sloped if standing_shows(seen[1] - seen[0], n, self.observations))

    def learn_noise(self, u: np.ndarray) -> None:
        """Takes the noise's colour anew from the residual at a fit (coordinates,)."""
        simulated = from_first(self._run(self._bench_for(u[None]), 1, self._values(u[None]), silent), self._readings)[0]
        # what is linear is known of means alone, and changes little within one
        linear = self.predict(u[None])[0] - self._means(simulated)
        self._readings = self._noises.refined(
            self._readings, self._readings.value - simulated - self._means.each(linear)
        )
        self.observations = self._averaged()
        self.noise_unlearnt = False

    def take_noise(self, other: DriveProblem) -> None:
        """Takes the noise as another problem of these logs has learnt it."""
        self._readings, self.noise_unlearnt = other._readings, other.noise_unlearnt
        self.observations = self._averaged()

    def _averaged(self) -> Observations:
        """Means of the readings, with the noise of the present."""
        return with_discrepancy(self._means.observations(self._readings), self._discrepancy)

    def predict(self, u: np.ndarray) -> np.ndarray:
        """(k, n) predicted observations at (k, coordinates), in the channels' units; not finite where one diverged."""
        rows = np.atleast_2d(u)
        out = self._simulations(self._bench_for(rows), rows, self.progress)
        for i, c in enumerate(self.coordinates):
            if is_linear(c) and np.any(amount := c.value(rows[:, i])):
                part = self._of_log(c.log_index) if c.log_index >= 0 else slice(None)
                out[:, part] += np.outer(amount, self._direction(c)[part])
        return out

    def jacobian(
        self, u: np.ndarray, which: np.ndarray, side: int = 1, steps: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) at (coordinates,), and their derivatives (n, m) by some coordinates per unit of them.

        Args:
          u: the place. which: coordinates. side: 1 or -1, to which steps are taken.
          steps: (coordinates,) their sizes in scales; short ones if None.
        """
        differences = Differences(self.coordinates, which, side, steps)
        values = self.predict(differences.rows(u))
        return values[0], differences.jacobian(u, values, self.observations, self._direction)

    def _keys(self, bench: Bench, rows: np.ndarray) -> list[Key]:
        """What a bench's simulation of each row depends on."""
        acting = frozenset(e for params in bench.params for e in params.effects) | {NUISANCE}
        # Linear nuisances are added afterwards: rows that differ in them alone share a simulation.
        nonlinear = [i for i, c in enumerate(self.coordinates) if c.effect in acting and not is_linear(c)]
        names = [(c.effect, c.name, c.log_index, c.factor) for c in (self.coordinates[i] for i in nonlinear)]
        columns = [np.asarray(self.coordinates[i].value(rows[:, i]), float) for i in nonlinear]
        table = np.stack(columns, axis=1) if columns else np.zeros((len(rows), 0))
        return keys_of_rows((*bench.stamp, self._sampled_at()), names, table)

    def _sampled_at(self) -> bytes:
        if self._stamped[0] is not self._readings:
            self._stamped = self._readings, stamp(self._means.starts, stamp_of_observations(self._readings))
        return self._stamped[1]

    @property
    def _there(self) -> Bench:
        """The bench that simulates the place of `about`."""
        return self._bench_for(self._reference[None])

    def _direction(self, c: Coordinate) -> np.ndarray:
        if is_instrument(c):
            return self._instrument(c)
        return direction(c, self.observations, self.step_error if c.name == STEP_ERROR else np.zeros(0))

    def _instrument(self, c: Coordinate) -> np.ndarray:
        """(n,) what one unit of an instrument's error adds, see `about`."""
        if c.key not in self._instruments:
            predicted = self._simulations(self._there, self._reference[None], silent)[0]
            if c.name.startswith(USUAL):
                direction = usual_errors(self.observations, predicted, self.rate)[c.name.removeprefix(USUAL)]
            else:
                log = self.logs[c.log_index]
                direction = instrument_direction(c, log, self.observations, predicted, self.rate)
            self._instruments[c.key] = np.where(np.isfinite(direction), direction, 0.0)
        return self._instruments[c.key]

    @property
    def rate(self) -> np.ndarray:
        """(n,) change of the predictions by time, unit/s, over a simulated sample, at the place of `about`."""
        if self._rate is None:
            found = self._rate_there()
            self._rate = np.where(np.isfinite(found), found, 0.0)
        return self._rate

    def _rate_there(self) -> np.ndarray:
        """(n,) change over a sample each way; of what jumps with a command, over the sample where it changes less.

        A jump is no slope: a current that was read before a command is no other where its clock is a millisecond off.
        (By the mean of both ways a few milliseconds stood for 3 A at every jump of a Husky's commands: its fit left 60
        sigma of such a reading, and held two other parameters at their bounds.)
        """
        bench = self._there
        interval = [run.every * run.model.timestep for run in bench.runs]

        def sampled(side: float) -> np.ndarray:
            series = [
                dataclasses.replace(s, time=np.asarray(s.time) + side * interval[s.log]) for s in self._readings.series
            ]
            at = dataclasses.replace(self._readings, series=tuple(series))
            simulated = self._run(bench, 1, self._values(self._reference[None]), silent, at)
            return self._means(from_first(simulated, self._readings)[0])

        before, there, after = (sampled(side) for side in (-1.0, 0.0, 1.0))
        rate = 0.5 * (after - before)
        for s in self.observations.series:
            part = slice(s.start, s.stop)
            if jumps(s.channel):
                rate[part] = flatter(there[part] - before[part], after[part] - there[part])
            rate[part] /= interval[s.log]
        return rate

    @property
    def step_error(self) -> np.ndarray:
        """(n,) what a vanishing time step would add to the model's predictions (see `about`), to first order.

        The step's error leads joints by a step or so, which an encoder sees. How much of it logs contain is a
        nuisance: all where a rover was measured, nothing where a simulator with the same step recorded it.
        """
        # the integrator is of first order: halving the step halves its error, so that twice the change is all of it
        if self._step_error is None:
            there = self._reference[None]
            coarse, fine = (self._simulations(b, there, silent)[0] for b in (self._there, self._there.halved()))
            two_step_error = 2.0 * (fine - coarse)
            self._step_error = np.where(np.isfinite(two_step_error), two_step_error, 0.0)
        return self._step_error

    def _simulations(self, bench: Bench, rows: np.ndarray, progress: Progress) -> np.ndarray:
        """(k, n) what a bench predicts for rows of coordinates, without linear nuisances, kept or simulated."""
        keys = self._keys(bench, rows)
        known_rows = {k: row for k in dict.fromkeys(keys) if (row := SIMULATED.get(k)) is not None}
        # by key, so that a row that is asked for twice is simulated once
        new = {k: n for n, k in enumerate(keys) if k not in known_rows}
        if new:
            wanted = rows[list(new.values())]
            simulated = from_first(self._run(bench, len(wanted), self._values(wanted), progress), self._readings)
            for k, row in zip(new, self._means(simulated), strict=True):
                SIMULATED.keep(k, row)
                known_rows[k] = row
        return np.stack([known_rows[k] for k in keys])

    def _run(
        self, bench: Bench, rows: int, values: Rows, progress: Progress, at: Observations | None = None
    ) -> np.ndarray:
        """(rows, readings) what a bench simulates, at the times of other readings if these are given."""
        out = np.full((rows, len(self._readings)), np.nan)
        for number, k, sampled in bench.run(rows, values, self._readings if at is None else at, progress):
            out[k, self._readings.of_log.get(number, slice(0, 0))] = sampled
        return out

    def devote(self, effects: frozenset[str]) -> None:
        """Gives rows in which just these effects act programs of their own from now on; for what simulates many.

        Compiling takes as long as some ten simulations. In a program of seven candidates more, ruts among
        them, a refit had not ended after 1,180 s.
        """
        needed = {n for name in effects for n in self._additions[name].requires}
        self._devoted.add(effects | frozenset(needed & set(self._additions)))

    def _bench_for(self, rows: np.ndarray) -> Bench:
        """The model's own bench, or that of the fewest candidates and unknown inputs which holds all that rows move.

        Every effect of a program costs time in every rover of it, whether it acts there or not: with the whole
        catalogue a step takes nine times as long as with one effect more.
        """
        places = {**self.candidates, SMOOTH: np.concatenate([np.zeros(0, int), *self.inputs.values()])}
        moved = {name for name, own in places.items() if np.any(rows[:, own] != 0.0)}
        needed = {n for name in moved for n in self._additions[name].requires}
        acting = frozenset(moved | (needed & set(self._additions)))
        if not acting:
            return self.bench
        # A bench that is there and holds more costs less than compiling another, but where it is used again and again.
        devoted = acting - {SMOOTH} in self._devoted
        most = acting | {SMOOTH} if devoted else frozenset({*self._additions})
        wide_enough = [names for names in list(self._wider) if acting <= names <= most]
        if wide_enough:
            return self._wider[min(wide_enough, key=len)]
        union = self.model
        for name in self._additions:
            if name in acting:
                union = union.add(self._additions[name], "criticism", **self._additions[name].null())
        self._wider[acting] = Bench(union, self.logs, self.bench.chunk, self.bench.engine, self.bench)
        return self._wider[acting]

    def _of_log(self, number: int) -> slice:
        return self.observations.of_log.get(number, slice(0, 0))

    def _values(self, rows: np.ndarray) -> Rows:
        return {
            (c.effect, c.name, c.log_index, c.factor): np.asarray(c.value(rows[:, i]))
            for i, c in enumerate(self.coordinates)
        }
