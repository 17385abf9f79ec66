"""Thousands of formulas in one compiled wheel bed: what a slot holds is a number, so that no formula compiles anew.

A slot changes one target by its amount times the product of two features. All formulas are scored at once: the
derivative by an amount is that by an unknown input at the target, times the factor at every point of the table. The
best are then fitted through the bed itself, exactly as their effect files would act.
"""

from __future__ import annotations

import dataclasses
import functools
import types
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from lunar_mjx.diagnosis.formulas import expression as f
from lunar_mjx.diagnosis.formulas.targets import CONSTANTS, SEEN, Target, constants, features, known, wheel_targets
from lunar_mjx.diagnosis.formulas.terms import Term, term
from lunar_mjx.diagnosis.tables.problem import TableProblem
from lunar_mjx.effects.base import Effect, Parameter

WHEEL_PORTS = ("soil", "wheel_normal", "wheel_shear")
SLOTS = 2
"""Formulas at a time."""
_SHAPED = {k for k, v in CONSTANTS.items() if v[4]}


@functools.cache
def targets() -> tuple[Target, ...]:
    """Everything that slots may change; a `Choice` names its target by the place in this tuple."""
    return tuple(t for port in WHEEL_PORTS for t in wheel_targets(port))


@functools.cache
def shaped(port: str) -> tuple[str, ...]:
    """For every feature of a port the name of the constant in it that a fit refines; empty without one."""
    return tuple(next((str(s) for s in e.free_symbols if str(s) in _SHAPED), "") for e in features(port))


@dataclasses.dataclass(frozen=True)
class Choice:
    """A formula as numbers: target, two features, and whether the target is multiplied by 1 + x in place of exp x."""

    target: int
    first: int
    second: int
    linear: bool = False

    @property
    def port(self) -> str:
        """Port at which the formula acts."""
        return targets()[self.target].port

    @property
    def early(self) -> bool:
        """Whether the formula acts before the port's own laws make their forces."""
        return targets()[self.target].order < 0

    @property
    def shape(self) -> str:
        """Name of the constant in the formula that a fit refines; empty without one."""
        names = shaped(self.port)
        return names[self.first] or names[self.second]

    @functools.cached_property
    def term(self) -> Term:
        """The chosen formula, with its amount and null, as a `Term`."""
        of = features(self.port)
        return term(targets()[self.target], of[self.first] * of[self.second], self.linear)


@functools.cache
def library(ports: tuple[str, ...]) -> tuple[Choice, ...]:
    """All formulas at some ports that hold at most one constant to refine."""
    functions = []
    for k, target in enumerate(targets()):
        if target.port not in ports:
            continue
        shapes, plain = shaped(target.port), features(target.port)[0]
        for i, j in _pairs(target.port):
            # At the soil a bare constant is a parameter, which every refit moves anyway.
            one = plain == 1 and (i, j) == (0, 0)
            if not (shapes[i] and shapes[j]) and not (one and target.port == "soil"):
                functions.append(Choice(k, i, j))
    return tuple(functions)


@functools.cache
def _pairs(port: str) -> tuple[tuple[int, int], ...]:
    return tuple(f.pairs(features(port)))


_NUMBERS = ("target", "first", "second", "scale", "linear")


@functools.cache
def slots_effect(early: bool) -> Effect:
    """The effect that computes the formulas chosen by its parameters, before (`early`) or after the port's laws."""
    ports = {}
    for port in WHEEL_PORTS:
        mine = [(k, t) for k, t in enumerate(targets()) if t.port == port and (t.order < 0) == early]
        if mine:
            ports[port] = _act(port, mine)
    parameters = {}
    for n in range(SLOTS):
        parameters[f"amount_{n}"] = Parameter(1.0, 0.0, (-1e3, 1e3), "1", "amount", "a search")
    for n in range(SLOTS):
        parameters[f"shape_{n}"] = Parameter(1.0, None, (0.1, 8.0), "1", "constant over its nominal", "a search")
        for name in _NUMBERS:
            parameters[f"{name}_{n}"] = Parameter(0.0, None, (-1e9, 1e9), "1", "which formula", "a search")
    # Two effects, since a formula acts before or after the law that it corrects, and order belongs to an effect.
    name, order = ("slots_early", -5) if early else ("slots", 500)
    return Effect(name, ports, parameters, order=order, doc="any formulas, chosen by numbers")


def _act(port: str, mine: Sequence[tuple[int, Target]]) -> Any:
    """The function of the slots at a port, made of the same code as effect files."""
    names, of = known(port), features(port)
    lines = [f"{q.name} = {q.code}" for q in SEEN[port]]
    lines += [f"{q.name} = {CONSTANTS[q.name][0]!r}" for q in constants()]
    lines += [f"f_{n} = jnp.broadcast_to({f.code(e)}, s.shape)" for n, e in enumerate(of) if not shaped(port)[n]]
    carriers = list(dict.fromkeys(t.carrier for _, t in mine))
    lines += [f"carrier_{n} = {f.code(f.parsed(c, names))} * jnp.ones_like(s)" for n, c in enumerate(carriers)]
    for slot in range(SLOTS):
        lines += [f"{name} = {CONSTANTS[name][0]!r} * p.shape_{slot}" for name in sorted(_SHAPED)]
        shown = [f.code(e) if shaped(port)[n] else f"f_{n}" for n, e in enumerate(of)]
        lines += [
            f"features = jnp.stack([{', '.join(shown)}])",
            f"both = features[p.first_{slot}.astype(int)] * features[p.second_{slot}.astype(int)]",
            f"target = p.target_{slot}",
            f"whole = jnp.where({_any(k for k, _ in mine)}, p.amount_{slot} * p.scale_{slot}, 0.0) * both",
            "carrier = carrier_0",
        ]
        for n, carrier in list(enumerate(carriers))[1:]:
            lines.append(
                f"carrier = jnp.where({_any(k for k, t in mine if t.carrier == carrier)}, carrier_{n}, carrier)"
            )
        lines.append("changed = whole * carrier")
        # An exponential keeps a factor positive whatever the amount; 1 + x has to be held there.
        if any(t.multiplies for _, t in mine):
            lines.append(
                f"grown = jnp.where(p.linear_{slot} > 0.5, jnp.maximum(1.0 + changed, 0.01), jnp.exp(changed))"
            )
        # Targets that differ in their carriers alone share a line.
        for change in dict.fromkeys(t.change for _, t in mine):
            of_it = _any(k for k, t in mine if t.change == change)
            grown = (
                "factor = jnp.where({}, grown, 1.0)" if "factor" in change else "extra = jnp.where({}, changed, 0.0)"
            )
            lines += [grown.format(of_it), f"value = {change}"]
    body = "\n".join(f"    {line}" for line in [*lines, "return value"])
    module = types.ModuleType("slots")
    text = f"import dataclasses\nimport jax.numpy as jnp\ndef act(ctx, p, x, value):\n{body}\n"
    exec(compile(text, "<slots>", "exec"), module.__dict__)
    return module.act


def _any(numbers: Iterable[int]) -> str:
    return " | ".join(f"(target == {k})" for k in numbers)


class Slots:
    """A table's problem with slots, and the formulas in them.

    Args:
      plain: the table's problem. held: choice and scale by slot number.
    """

    def __init__(self, plain: TableProblem, held: Mapping[int, tuple[Choice, float]] | None = None):
        effects = {e.name: e for e in (slots_effect(False), slots_effect(True))}
        self.empty = TableProblem(plain.logs, plain.bed, effects, plain.splits, extra_sigma=plain.extra_sigma)
        self.held = dict(held or {})
        self.problem = self.empty.with_constants(self._numbers())

    def holding(self, held: Mapping[int, tuple[Choice, float]]) -> Slots:
        """This table's problem with other formulas in its slots; no program compiles anew."""
        # Past the constructor, which would make the problem and its programs anew.
        other = object.__new__(Slots)
        other.empty, other.held = self.empty, dict(held)
        other.problem = self.empty.with_constants(other._numbers())
        return other

    def _numbers(self) -> dict[str, dict[str, float]]:
        given: dict[str, dict[str, float]] = {}
        for k, (c, scale) in self.held.items():
            numbers = (float(c.target), float(c.first), float(c.second), scale, float(c.linear))
            mine = {f"{name}_{k}": value for name, value in zip(_NUMBERS, numbers, strict=True)}
            given[_name(c)] = {**given.get(_name(c), {}), **mine}
        return given

    def own(self, number: int) -> list[int]:
        """Coordinates of a slot: its amount's, and its constant's where its formula has one."""
        choice = self.held[number][0]
        # Amounts come first among the parameters, and then constants, each by slot.
        places = [int(i) for i in self.problem.candidates[_name(choice)]]
        return [places[number], places[SLOTS + number]] if choice.shape else [places[number]]

    def place(self, number: int) -> int:
        """Coordinate of a slot's amount."""
        return self.own(number)[0]

    @property
    def free(self) -> np.ndarray:
        """Coordinates that a fit moves: the baseline's, and every slot's amount and constant."""
        return np.concatenate([self.problem.baseline, *(self.own(k) for k in self.held)]).astype(int)

    @property
    def spare(self) -> int:
        """Number of the first slot without a formula."""
        return next(k for k in range(SLOTS) if k not in self.held)

    def probes(self, u: np.ndarray, which: Sequence[int]) -> dict[int, np.ndarray]:
        """(n,) derivatives by an unknown input at each of some targets, in their own sizes, beside what is held.

        Args:
          u: (coordinates,) where. which: numbers of targets.
        """
        # In a slot of its own: what is held keeps its numbers, and the derivatives are beside it.
        probe_rows, number = {}, self.spare
        for k in which:
            other = self.holding({**self.held, number: (Choice(k, 0, 0), targets()[k].size)})
            probe_rows[k] = other.problem.jacobian(u, np.array([other.place(number)]))[:, 0]
        return probe_rows

    def factors(self, u: np.ndarray, port: str) -> np.ndarray:
        """(n, features) what every feature of a port is at the observed points of the bed at a place."""
        columns = []
        for test, sinkage in zip(self.problem.tests, self._sinkages(u), strict=True):
            rim, beta = np.asarray(test.rim_speed), np.asarray(test.slip_angle)
            v_x = np.asarray(test.travel_speed) * np.cos(beta)
            values = {
                # Over the larger speed, so that slip lies between -1 and 1 for driven and braked wheels alike.
                "s": (rim - v_x) / np.maximum(np.maximum(rim, np.abs(v_x)), 1e-9),
                "z": sinkage,
                "beta": beta,
                "r": np.asarray(test.radius),
                "W": np.asarray(test.normal_load),
            }
            values |= {k: np.asarray(v[0]) for k, v in CONSTANTS.items()}
            rows = np.stack(
                [np.broadcast_to(of(**{n: values[n] for n in names}), sinkage.shape) for names, of in _functions(port)],
                axis=1,
            )
            columns.append(rows)
        out = np.zeros((len(self.problem.observations), len(features(port))))
        for s in self.problem.observations.series:
            out[s.start : s.stop] = columns[s.log]
        return out

    def _sinkages(self, u: np.ndarray) -> list[np.ndarray]:
        observed = {s.log: s for s in self.problem.observations.series if s.channel == "sinkage_m"}
        if len(observed) == len(self.problem.tests):
            predicted = self.problem.predict(u[None])[0]
            return [predicted[s.start : s.stop] for _, s in sorted(observed.items())]
        with jax.enable_x64(True):
            values = self.problem.merged(u)
            return [np.asarray(_settled(self.problem.union)(values, test)) for test in self.problem.tests]


def _name(choice: Choice) -> str:
    return slots_effect(choice.early).name


_SETTLED: dict[tuple[int, ...], Any] = {}


def _settled(bed: Any) -> Any:
    """The bed's sinkage as a compiled function; beds of the same effects share it."""
    key = (*(id(e) for e in bed.effects), hash(bed.gravity))
    if key not in _SETTLED:
        _SETTLED.clear()
        _SETTLED[key] = jax.jit(lambda values, test: bed(values, test).sinkage)
    return _SETTLED[key]


@functools.cache
def _functions(port: str) -> tuple[tuple[list[str], Any], ...]:
    functions = []
    for e in features(port):
        symbols = sorted(e.free_symbols, key=str)
        functions.append(([str(s) for s in symbols], f.function(e, symbols)))
    return tuple(functions)
