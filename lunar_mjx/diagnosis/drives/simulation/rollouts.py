"""Simulating many hypotheses of many logs at once: rows of parameters times logs, in chunks of one size."""

from __future__ import annotations

import concurrent.futures
import dataclasses
import functools
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from lunar_mjx.diagnosis.drives.simulation.log_run import READS_BEFORE, LogRun, log_run
from lunar_mjx.diagnosis.drives.simulation.program import Logs, Program, Rows, cores, stack_logs
from lunar_mjx.diagnosis.drives.simulation.simulated_rows import stamp
from lunar_mjx.dynamics.bus import BUS_CURRENT, BUS_VOLTAGE, tells_bus_voltage
from lunar_mjx.dynamics.state import Ambient, Params
from lunar_mjx.effects.sensor.channels import EULER
from lunar_mjx.inference.coordinates import NUISANCE
from lunar_mjx.inference.deadline import Deadline
from lunar_mjx.inference.fitting import Progress
from lunar_mjx.inference.observations import Observations
from lunar_mjx.logs.schema import parse_name, sensor_of
from lunar_mjx.model import Model
from lunar_mjx.model.sun import make_sun

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

CHUNK = {"cpu": 32, "gpu": 512}
"""Rovers simulated at once. (2,048 with 44 effects and channels of 50 Hz need more than 22 GiB.)"""

_AT_ONCE = frozenset({"motor_current", "motor_voltage", "motor_torque", "bus_voltage", "bus_current"})
"""Quantities that jump at the instant at which a command does: no inertia stands between them and the controller."""

_PROGRAMS: dict[Any, Program] = {}
"""Programs take every number as an argument, so that campaigns of one rover share them; a program keeps its model, so
that no other effect takes the identity of one of its own."""
_MOST_PROGRAMS = 32
"""Compiled programs that are kept; the oldest goes first."""


class Bench:
    """All logs of a campaign, grouped by what one program can run, until their `deadline`.

    Args:
      model: under no log's conditions. logs: of one rover. chunk: rovers simulated at once. engine: of the dynamics.
      like: bench of a model with the same time step, whose commands and starts are the same.
    """

    def __init__(self, model: Model, logs: Sequence[Log], chunk: int | None, engine: str, like: Bench | None = None):
        self.logs, self.model, self.engine = tuple(logs), model, engine
        self.chunk = chunk or CHUNK.get(jax.default_backend(), 64)
        from lunar_mjx.logs import log_model

        if like is None:
            runs = [log_run(log, model) for log in logs]
        else:
            runs = [dataclasses.replace(r, model=log_model(log, model)) for r, log in zip(like.runs, logs, strict=True)]
        self.runs = _alike(runs)
        self.params = [_params(run) for run in self.runs]
        self._stacked: list[Logs] | None = None
        self.deadline = Deadline() if like is None else like.deadline

    def halved(self) -> Bench:
        """A bench of these logs that simulates with half the time step."""
        other = Bench.__new__(Bench)
        other.logs, other.engine, other.chunk = self.logs, self.engine, self.chunk
        other.model = self.model.replace(timestep=0.5 * self.model.timestep)
        other.runs = [
            # Twice as many steps a command: it lasts as long in seconds.
            dataclasses.replace(r, model=r.model.replace(timestep=0.5 * r.model.timestep), every=2 * r.every)
            for r in self.runs
        ]
        other.params, other._stacked, other.deadline = self.params, None, self.deadline
        return other

    @functools.cached_property
    def stamp(self) -> tuple[Any, ...]:
        """What all that it simulates depends on beside the rows: programs, and what the logs put into them."""
        given = [
            (
                *(r.commands, dict(r.start), dict(r.motion), r.begin, r.end, r.every, r.imu),
                *(r.ground and r.ground.modes, r.bus_voltage),
            )
            for r in self.runs
        ]
        return *(logs.program.number for logs in self._groups()), stamp(self.params, given)

    def channels(self, number: int) -> list[str]:
        """Channels of a log that the model gives, in a fixed order."""
        run = self.runs[number]
        known = _modelled(run.model, run.bus_voltage is not None)
        return [c for c in self.logs[number].channel_names if c in known and not c.startswith("quaternion")]

    def _program(self, number: int) -> Program:
        run = self.runs[number]
        wanted = tuple(sorted({c for n in range(len(self.runs)) for c in self.channels(n)}))
        shapes = tuple((a.shape, str(a.dtype)) for a in jax.tree.leaves(self.params[number].terrain))
        modes, gains = (tuple(sorted(d.items())) for d in (run.model.modes, run.model.gains))
        model = run.model
        key = (
            str(model.rover.folder),
            model.timestep,
            model.thermal_integrator,
            tuple(id(e) for e in model.effects),
            self.engine,
            modes,
            gains,
            shapes,
            run.ground is not None,
            run.every,
            run.imu,
            wanted,
        )
        if key not in _PROGRAMS:
            while len(_PROGRAMS) >= _MOST_PROGRAMS:
                _PROGRAMS.pop(next(iter(_PROGRAMS)), None)
            _PROGRAMS[key] = Program(run.model, run.every, wanted, run.imu, self.engine)
        return _PROGRAMS[key]

    def _groups(self) -> list[Logs]:
        """Logs by the program and the length that they share."""
        if self._stacked is None:
            groups: dict[Any, list[int]] = {}
            for number, run in enumerate(self.runs):
                program = self._program(number)
                groups.setdefault((id(program), program.length(len(run.commands))), []).append(number)
            self._stacked = []
            for n in groups.values():
                runs, params = [self.runs[i] for i in n], [self.params[i] for i in n]
                self._stacked.append(stack_logs(self._program(n[0]), n, runs, params))
        return self._stacked

    def run(
        self, rows: int, values: Rows, observations: Observations, progress: Progress
    ) -> Iterator[tuple[int, slice, np.ndarray]]:
        """Simulates all logs with all rows and yields (log, rows, (rows, samples) of the log's observations).

        Raises:
          TimeUp: the deadline passed.
        """
        places = _places(self.runs, observations)
        before = values.get((NUISANCE, READS_BEFORE, -1, False))
        before = np.zeros(rows) if before is None else before
        for logs in self._groups():
            jobs = np.stack(np.meshgrid(np.arange(len(logs.numbers)), np.arange(rows), indexing="ij"), -1).reshape(
                -1, 2
            )
            parts = [jobs[at : at + self.chunk] for at in range(0, len(jobs), self.chunk)]
            for part, signals in zip(parts, self._signals(logs, parts, values), strict=True):
                edges = np.searchsorted(part[:, 0], np.arange(len(logs.numbers) + 1))
                for number, low, high in zip(logs.numbers, edges[:-1], edges[1:], strict=True):
                    if low < high:
                        row = slice(part[low, 1], part[high - 1, 1] + 1)
                        own, names = signals[low:high], logs.program.channels
                        yield number, row, _sample(own, names, places[number], observations.value, before[row])
                # how many simulations a fit takes is not known beforehand: no share of them is one of the whole
                progress("simulating", math.nan)

    def _signals(self, logs: Logs, parts: Sequence[np.ndarray], values: Rows) -> Iterator[np.ndarray]:
        """Signals (rovers, channels, time) of every part in turn.

        On a CPU one part per core at a time, as XLA runs a loop on one core.
        """

        def one(part: np.ndarray) -> np.ndarray:
            # filled up with copies: another number of rovers would be another program to compile
            full = np.concatenate([part, np.repeat(part[-1:], self.chunk - len(part), axis=0)])
            return logs.program(logs, full[:, 0], full[:, 1], values, len(part), self.deadline)

        workers = cores() if jax.default_backend() == "cpu" else 1
        # the first part compiles alone, or every thread would compile the same program
        if workers < 2 or len(parts) < 2 or not logs.program.compiled:
            yield one(parts[0])
            parts = parts[1:]
        if parts:
            with concurrent.futures.ThreadPoolExecutor(max(workers, 1)) as pool:
                yield from pool.map(one, parts)


@dataclasses.dataclass(frozen=True, eq=False)
class _Place:
    """Series of one log that are sampled at the same times.

    Attributes:
      channels: their names. euler: whether they are angles that jump.
      at_once: whether they jump at once with a command.
      low, share: (samples,) simulated sample before each time, and how far on towards the next one it is.
      begin, parts: where the log's observations begin, and (start, stop) of each series among all observations.
    """

    channels: list[str]
    euler: bool
    at_once: bool
    low: np.ndarray
    share: np.ndarray
    begin: int
    parts: list[tuple[int, int]]


def _places(runs: Sequence[LogRun], observations: Observations) -> list[list[_Place]]:
    """By log, where its observations lie among the simulated samples."""
    by_run: list[dict[tuple[bytes, bool, bool], _Place]] = [{} for _ in runs]
    begin: dict[int, int] = {}
    for s in observations.series:
        assert s.time is not None
        run, key = runs[s.log], (s.time.tobytes(), s.channel in EULER, at_once(s.channel))
        begin.setdefault(s.log, s.start)
        if key not in by_run[s.log]:
            # a logger's clock that ticks with the simulation's, but for rounding, meets samples and nothing between
            place = np.round((s.time - run.begin) / (run.every * run.model.timestep), 9)
            low = np.clip(np.floor(place).astype(int), 0, len(run.commands) - 1)
            by_run[s.log][key] = _Place([], key[1], key[2], low, place - low, begin[s.log], [])
        by_run[s.log][key].channels.append(s.channel)
        by_run[s.log][key].parts.append((s.start, s.stop))
    return [list(groups.values()) for groups in by_run]


def _sample(
    signals: np.ndarray, names: Sequence[str], places: Sequence[_Place], measured: np.ndarray, before: np.ndarray
) -> np.ndarray:
    """(rovers, samples) of one log's observations from its (rovers, channels, time) signals.

    `before` (rovers,) is how far what jumps at once with a command is read before it.
    """
    count = sum(len(p.low) * len(p.channels) for p in places)
    out = np.empty((len(signals), count))
    for p in places:
        at, after = _run_of(p.low), _run_of(np.minimum(p.low + 1, signals.shape[2] - 1))
        for channel, (start, stop) in zip(p.channels, p.parts, strict=True):
            one = signals[:, names.index(channel)]
            if p.euler:
                # a mean of 179 and -179 degrees would be 0: samples are interpolated without jumps
                one = np.rad2deg(np.unwrap(np.deg2rad(one), axis=1))
            one = one[:, at] * (1.0 - p.share) + one[:, after] * p.share if np.any(p.share) else one[:, at]
            if p.at_once and np.any(before):
                # the last simulated sample that ends before the time of the reading
                earlier = signals[:, names.index(channel)][:, np.maximum(p.low - (p.share == 0.0), 0)]
                one = one + before[:, None] * (earlier - one)
            if p.euler:
                # whichever turn is nearest to what was measured, so that no residual is near 360 degrees
                one = measured[start:stop] + (one - measured[start:stop] + 180.0) % 360.0 - 180.0
            out[:, start - p.begin : stop - p.begin] = one
    return out


def at_once(channel: str) -> bool:
    """Whether a motor's channel jumps at the instant at which a command does."""
    parts = parse_name(channel)
    return parts is not None and parts.quantity in _AT_ONCE


def jumps(channel: str) -> bool:
    """Whether a channel jumps where a command does: a motor's, or an acceleration, which follows from its torque."""
    return at_once(channel) or sensor_of(channel) == "accelerometer"


def _run_of(places: np.ndarray) -> np.ndarray | slice:
    """Places as a slice, which copies nothing, where they follow each other."""
    first, last = int(places[0]), int(places[-1])
    return slice(first, last + 1) if np.array_equal(places, np.arange(first, last + 1)) else places


def _alike(runs: Sequence[LogRun]) -> list[LogRun]:
    """Runs whose models all hold what the conditions of some log add, at its null elsewhere: one program for all."""
    extra = {e.name: e for r in runs for e in r.model.effects if any(e.name not in o.model.effect_names for o in runs)}
    out = []
    for run in runs:
        model = run.model
        for name, effect in extra.items():
            if name not in model.effect_names and any(p.null is not None for p in effect.parameters.values()):
                model = model.add(effect, "criticism", **effect.null())
        out.append(dataclasses.replace(run, model=model))
    return out


def _params(run: LogRun) -> Params:
    """As `default_params`, in NumPy: a thousand single numbers, none of which is worth a way to a GPU and back.

    The terrain has no name, which would make programs of their own.
    """
    model = run.model
    effects = {e.name: {k: np.asarray(v, float) for k, v in model.parameters[e.name].items()} for e in model.effects}
    field = model.terrain.field if run.ground is None else run.ground.field
    terrain = jax.tree.map(_array, dataclasses.replace(model.terrain, name="", field=field))
    ambient = Ambient(*(np.asarray(v, float) for v in model.ambient))
    sun = jax.tree.map(_array, make_sun(model.sun, model.terrain))
    return Params(np.asarray(model.gravity, float), ambient, effects, terrain, sun)


def _array(leaf: Any) -> np.ndarray:
    array = np.asarray(leaf)
    return array.astype(float) if np.issubdtype(array.dtype, np.floating) else array


def _modelled(model: Model, reads_bus_voltage: bool) -> frozenset[str]:
    """Channels that a model gives of a log, which may read the voltage of its bus."""
    from lunar_mjx.dynamics.signals import joint_channels, side_channels

    joints, corners = joint_channels(model.rover), [w.corner for w in model.rover.wheels]
    names = [f"position_{a}_m" for a in "xyz"]
    names += [f"{f}_velocity_{a}_m_s" for f in ("world", "body") for a in "xyz"]
    names += [*EULER, *(f"gyro_{a}_rad_s" for a in "xyz"), *(f"accelerometer_{a}_m_s2" for a in "xyz")]
    for j in joints:
        names += [f"joint_{j}_angle_rad", f"joint_{j}_speed_rad_s", f"motor_{j}_torque_Nm", f"motor_{j}_current_A"]
        names += [f"motor_{j}_voltage_V", f"winding_{j}_temperature_degC", f"housing_{j}_temperature_degC"]
    for c in corners:
        names += [f"wheel_{c}_sinkage_m", f"wheel_{c}_slip_ratio"]
        names += [f"wheel_{c}_force_{a}_N" for a in "xyz"] + [f"wheel_{c}_moment_{a}_Nm" for a in "xyz"]
    names += side_channels(model.rover)
    if "bus_droop" in model.effect_names:
        names.append(BUS_VOLTAGE)
    if reads_bus_voltage or tells_bus_voltage(model.effect_names):
        names.append(BUS_CURRENT)
    return frozenset(names)
