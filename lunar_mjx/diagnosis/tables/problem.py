"""Steady-state tables of single-wheel test beds as a problem: exact derivatives through the wheel bed."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.effect_coordinates import of_candidate
from lunar_mjx.diagnosis.tables.noise import scatter, sweeps
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import UserError
from lunar_mjx.inference.coordinates import WIDE, Coordinate
from lunar_mjx.inference.observations import Chain, Observations, Series
from lunar_mjx.inference.problem import Problem
from lunar_mjx.wheel_bed.bed import PORTS, WheelBed, WheelTest
from lunar_mjx.wheel_bed.scatter import point_scatter
from lunar_mjx.wheel_bed.table import QUANTITIES, SteadyStateTable, average, replicate_groups

if TYPE_CHECKING:
    from lunar_mjx.logs import SteadyLog

APART_DEG = 89.0
"""From this slip angle on a point is set apart: the wheel's frame has no slip ratio there."""

BASELINE: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = {
    "soil": {
        "k_phi": (0.3, WIDE, 1e4, 1e9),
        "n": (0.1, WIDE, 0.3, 2.5),
        "cohesion": (0.5, WIDE, 0.0, 2e4),
        "friction_angle": (0.1, WIDE, 0.05, 0.9),
        "shear_modulus_x": (0.3, WIDE, 1e-4, 0.5),
        "shear_modulus_y": (0.3, WIDE, 1e-4, 0.5),
    },
    "penalty_contact": {"stiffness": (0.3, WIDE, 1e2, 1e7)},
    "engine_friction": {"mu": (0.3, WIDE, 0.0, 2.0)},
}
"""What a refit of a wheel model moves: scale as a share of the value, prior in scales, bounds. k_c acts on one wheel
width only through k_c/b + k_phi and is held."""


def points(log: SteadyLog) -> tuple[SteadyStateTable, dict[str, np.ndarray]]:
    """A table with replicates averaged, and the standard deviation of each averaged point by quantity.

    The noise is the scatter of the replicates where there are any, growing with the reading as far as they show it;
    else what each row states; else what the log states.

    Raises:
      UserError: nothing of these is there.
    """
    table = average(log.table)
    group = replicate_groups(log.table)
    count = np.bincount(group)
    noise = {}
    for quantity, values in log.table.measured.items():
        column = QUANTITIES[quantity][0]
        mean = table.measured[quantity]
        squares = np.bincount(group, weights=(values - mean[group]) ** 2)
        # replicates first: they hold what a stated noise forgets (preparation of the bed, refilling)
        if squares.any():
            noise[quantity] = point_scatter(squares, count - 1, mean) / np.sqrt(count)
            continue
        rows = log.row_std.get(column)
        if rows is None or not (rows > 0.0).all():
            stated = log.noise.get(column)
            if stated is None:
                raise UserError(
                    f"{log.folder}: nothing tells the noise of {column}; give replicates, or state "
                    f"[noise.{column}] std in log.toml."
                )
            rows = np.full(len(values), stated.std)
        noise[quantity] = np.sqrt(np.bincount(group, weights=rows**2 / log.table.replicates)) / count
    return table, noise


def default_units(table: SteadyStateTable) -> tuple[np.ndarray, list[str]]:
    """Groups of points that are left out together: slip angles, else loads, else slip ratios.

    Returns:
      Group number of each point, and names of the groups.
    """
    for column, decimals, unit in (("slip_angle_deg", 0, "deg"), ("normal_load_N", 0, "N"), ("slip_ratio", 2, "")):
        keys, group = np.unique(np.round(table.test[column], decimals), return_inverse=True)
        if len(keys) >= 3 or column == "slip_ratio":
            return group.reshape(-1), [f"{column.rsplit('_', 1)[0]} {k:g} {unit}".strip() for k in keys]
    raise AssertionError


def default_splits(number: int, apart: Sequence[bool]) -> list[str]:
    """Every fourth group from the second on is held out to judge, and of eight or more every other of these for a test.

    Held-out groups choose nothing, so that few are kept: what chooses is worth more.
    """
    out = []
    for i in range(number):
        held = "test" if number >= 8 and i % 8 == 5 else "select"
        out.append("apart" if apart[i] else held if i % 4 == 1 and number >= 3 else "fit")
    return out


class TableProblem(Problem):
    """Steady-state tables against a wheel bed."""

    def __init__(
        self,
        logs: Sequence[SteadyLog],
        bed: WheelBed,
        candidates: Mapping[str, Effect],
        splits: Mapping[str, str] | None = None,
        baseline: Mapping[str, Mapping[str, tuple[float, float, float, float]]] = BASELINE,
        values: Mapping[str, Mapping[str, float]] | None = None,
        extra_sigma: Mapping[str, float] | None = None,
    ):
        """Makes the problem.

        Args:
          logs: tables of one slip definition or several.
          bed: the model's wheel.
          candidates: effects that may be missing, by name.
          splits: split of a group of points by its name, in place of the default.
          baseline: what a refit may move, by effect and parameter.
          values: start of candidates' shape parameters.
          extra_sigma: a model's own known discrepancy by quantity, SI units, added to the noise.
        """
        self.logs, self.splits, self.extra_sigma = tuple(logs), dict(splits or {}), dict(extra_sigma or {})
        self.effects, self.not_tested = usable(bed.effects, candidates, _unfit)
        union = bed
        for effect in self.effects.values():
            union = union.with_effect(effect, **effect.null())
        self.bed, self._union = bed, union
        self.coordinates, self.baseline, self.candidates = _coordinates(bed, self.effects, baseline, values or {})
        self.observations, tests = _observations(self.logs, splits or {}, extra_sigma or {})
        layout = tuple((c.effect, c.name, c.log) for c in self.coordinates)
        self._run, self._slope = _programs(union, layout, tuple(tuple(q) for _, q in tests))
        with jax.enable_x64(True):
            self._given = (
                {e: {k: jnp.asarray(x, float) for k, x in v.items()} for e, v in union.parameters.items()},
                jnp.asarray([[c.start, c.scale] for c in self.coordinates], float).reshape(-1, 2),
                [test for test, _ in tests],
            )

    def values(self, u: np.ndarray) -> dict[str, dict[str, float]]:
        """Parameter values at a place, by effect and name, of the coordinates alone."""
        out: dict[str, dict[str, float]] = {}
        for c, place in zip(self.coordinates, u, strict=True):
            out.setdefault(c.effect, {})[c.name] = float(c.value(place))
        return out

    def fitted_bed(self, u: np.ndarray) -> WheelBed:
        """The wheel bed with all effects whose values a place changes from the model's, at these values."""
        values = self.values(u)
        moved = [e for e, places in self.candidates.items() if np.any(u[places] != 0.0)]
        bed = self.bed
        for name in moved:
            bed = bed.with_effect(self.effects[name], **{**self.effects[name].null(), **values[name]})
        return bed.with_values({e: v for e, v in values.items() if e in bed.parameters})

    @property
    def union(self) -> WheelBed:
        """The bed with all candidates."""
        return self._union

    @property
    def tests(self) -> list[WheelTest]:
        """What every table imposes."""
        return self._given[2]

    def merged(self, u: np.ndarray) -> dict[str, dict[str, Any]]:
        """Values of all parameters of the union at a place."""
        moved = self.values(u)
        return {e: {**v, **moved.get(e, {})} for e, v in self._given[0].items()}

    def with_constants(self, values: Mapping[str, Mapping[str, float]]) -> TableProblem:
        """This problem with other values of parameters that no fit moves; the compiled programs are shared."""
        other, (given, *rest) = copy.copy(self), self._given
        with jax.enable_x64(True):
            changed = {e: {k: jnp.asarray(x, float) for k, x in v.items()} for e, v in values.items()}
        other._given = ({e: {**v, **changed.get(e, {})} for e, v in given.items()}, *rest)
        return other

    def predict(self, u: np.ndarray) -> np.ndarray:
        """Predicted observations, (k, n) in SI units, for rows of coordinates (k, coordinates)."""
        with jax.enable_x64(True):
            # One row at a time: every number of rows would be another program.
            rows = [np.asarray(self._run(jnp.asarray(row, float), *self._given)) for row in np.atleast_2d(u)]
        return np.stack(rows)

    def jacobian(self, u: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Derivatives (n, which) of the predictions by some coordinates, at `u` (coordinates,)."""
        with jax.enable_x64(True):
            # All derivatives, of which some are taken: every other choice would be another program to compile.
            return np.asarray(self._slope(jnp.asarray(u, float), *self._given))[:, which]


_PROGRAMS: dict[Any, tuple[WheelBed, Any, Any]] = {}
_MOST_PROGRAMS = 24
"""Compiled beds that a process keeps at most, each with its code in memory; the oldest goes first."""


def _programs(
    union: WheelBed, layout: tuple[tuple[str, str, bool], ...], quantities: tuple[tuple[str, ...], ...]
) -> tuple[Any, Any]:
    """Predictions and their derivatives as compiled functions of (u, parameters, starts and scales, tests).

    They take a table's numbers as arguments: tables of one shape and one list of effects share a program, because
    compiling it takes a thousand times as long as running it.

    Args:
      union: the model's effects and the candidates. layout: effect, name and whether the logarithm moves, by
        coordinate. quantities: measured by each table.
    """
    key = (tuple(id(e) for e in union.effects), union.gravity, layout, quantities)
    if key not in _PROGRAMS:

        def vector(u: Any, parameters: Any, scales: Any, tests: Any) -> Any:
            values = {e: dict(v) for e, v in parameters.items()}
            for i, (effect, name, log) in enumerate(layout):
                start, scale = scales[i, 0], scales[i, 1]
                values[effect][name] = start * jnp.exp(scale * u[i]) if log else start + scale * u[i]
            parts = []
            for test, wanted in zip(tests, quantities, strict=True):
                result = union(values, test)
                parts += [getattr(result, q) for q in wanted]
            return jnp.concatenate(parts)

        while len(_PROGRAMS) >= _MOST_PROGRAMS:
            _PROGRAMS.pop(next(iter(_PROGRAMS)))
        # The bed is kept beside its programs, so that no other effect takes the identity of one of its own.
        _PROGRAMS[key] = union, jax.jit(vector), jax.jit(jax.jacfwd(vector))
    return _PROGRAMS[key][1:]


SENSORS = "reads channels of drives; of a table's instruments scale, zero and cross-talk are weighed as calibration"


def _unfit(name: str, effect: Effect) -> str:
    """Why a steady-state bed cannot hold an effect beside the model's own, or ""."""
    del name
    if "sensor" in effect.ports:
        return SENSORS
    held = not effect.transient and any(port in PORTS for port in effect.ports)
    return "" if held else "does not act on a wheel in steady state"


def _coordinates(
    bed: WheelBed,
    effects: Mapping[str, Effect],
    baseline: Mapping[str, Mapping[str, tuple[float, float, float, float]]],
    values: Mapping[str, Mapping[str, float]],
) -> tuple[tuple[Coordinate, ...], np.ndarray, dict[str, np.ndarray]]:
    coordinates: list[Coordinate] = []
    for effect in bed.effects:
        for name, (relative, prior, low, high) in baseline.get(effect.name, {}).items():
            p, at = effect.parameters[name], float(bed.parameters[effect.name][name])
            if low > 0.0:
                # a parameter without prior knowledge moves by its logarithm, and a logarithm needs a start inside its
                # bounds
                at = min(max(at, low), high)
                coordinates.append(Coordinate(effect.name, name, at, relative, low, high, True, prior, unit=p.unit))
            else:
                scale = relative * (at or 0.1 * min(high, 1e4))
                coordinates.append(Coordinate(effect.name, name, at, scale, low, high, False, prior, unit=p.unit))
        # Effects added earlier are refitted with the rest, their shapes within a third, as those of candidates are.
        amplitudes = [p for p in effect.parameters.values() if p.null is not None]
        if effect.name not in baseline and amplitudes and not _unfit(effect.name, effect):
            for name, p in effect.parameters.items():
                at = float(bed.parameters[effect.name][name])
                if p.null is not None:
                    scale = 0.3 * (abs(at) or abs(p.nominal) or 1.0)
                    coordinates.append(Coordinate(effect.name, name, at, scale, *p.bounds, False, WIDE, unit=p.unit))
                elif at > 0.0 and p.bounds[0] >= 0.0:
                    coordinates.append(Coordinate(effect.name, name, at, 0.3, *p.bounds, True, 1.0, unit=p.unit))
    count, places = len(coordinates), {}
    for name, effect in effects.items():
        mine = of_candidate(effect, values.get(name))
        places[name] = np.arange(len(coordinates), len(coordinates) + len(mine))
        coordinates += mine
    return tuple(coordinates), np.arange(count), places


def _observations(
    logs: Sequence[SteadyLog], splits: Mapping[str, str], extra_sigma: Mapping[str, float]
) -> tuple[Observations, list[tuple[WheelTest, list[str]]]]:
    value, series, unit, place, unit_names, unit_split, tests = [], [], [], [], [], [], []
    at = 0
    for number, log in enumerate(logs):
        table, noise = points(log)
        known = scatter(log)
        group, names = default_units(table)
        apart = [bool(np.all(np.abs(table.test["slip_angle_deg"][group == g]) > APART_DEG)) for g in range(len(names))]
        default = default_splits(len(names), apart)
        chosen = [log.split or splits.get(name, default[i]) for i, name in enumerate(names)]
        order, follows = sweeps(table, group)
        covariates = np.column_stack([table.test[c] for c in ("slip_ratio", "slip_angle_deg", "normal_load_N")])
        for quantity, measured in table.measured.items():
            n = len(measured)
            white = np.sqrt(noise[quantity] ** 2 + extra_sigma.get(quantity, 0.0) ** 2)
            own = known[quantity]
            chain = None
            # what a known discrepancy adds is no noise, and follows no chain
            if own.correlation and follows.any() and not extra_sigma.get(quantity, 0.0):
                chain = Chain(order, follows, own.correlation, own.innovation)
            series.append(
                Series(
                    number,
                    QUANTITIES[quantity][0],
                    at,
                    at + n,
                    None,
                    white,
                    level=own.level,
                    chain=chain,
                    dependence=1.0 if chain else own.dependence,
                )
            )
            value.append(measured)
            unit.append(group + len(unit_names))
            place.append(covariates)
            at += n
        prefix = f"{log.name}: " if len(logs) > 1 else ""
        unit_names += [prefix + name for name in names]
        unit_split += chosen
        with jax.enable_x64(True):
            tests.append((table.wheel_test(), list(table.measured)))
    observations = Observations(
        value=np.concatenate(value),
        series=tuple(series),
        logs=tuple(log.name for log in logs),
        split=tuple(log.split or "fit" for log in logs),
        unit=np.concatenate(unit),
        unit_split=tuple(unit_split),
        unit_names=tuple(unit_names),
        place=np.concatenate(place),
    )
    return observations, tests
