"""What every effect promises, checked: null value, derivatives, units, cost (`lunar-mjx effect test FILE`)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.effect_contract import random_rovers as probe
from lunar_mjx.effect_contract.cost import measure_overhead
from lunar_mjx.effect_contract.dimensions import BASES, Rescaling, check_unit
from lunar_mjx.effect_contract.random_channels import act_on_channels, channel_states
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.errors import UserError


@dataclasses.dataclass(frozen=True)
class Tolerances:
    """How exactly effects have to keep their promises."""

    rovers: int = 24
    """Random rovers in a check; derivatives and null value are looked at on each."""
    ulp: int = 4
    """Largest deviation at the null value, in units in the last place (float64)."""
    homogeneity: float = 1e-9
    """Largest relative change of a result with the choice of base units."""
    overhead: float = 0.05
    """Largest cost of an effect, relative to the effects of a step."""


TOLERANCES = Tolerances()


# no factor is a power of another, so that wrong units do not cancel by accident
_FACTORS = {"[length]": 1.7, "[mass]": 0.6, "[time]": 2.3, "[temperature]": 0.8, "[current]": 1.4}
Outputs = dict[str, Any]
_Act = Callable[[Mapping[str, Any] | None, Any], Outputs]


class Check(NamedTuple):
    """One promise: whether it is kept (None where there is nothing to judge), and the measured number in words."""

    name: str
    passed: bool | None
    detail: str


def check_effect(
    effect: Effect, *, rovers: int = TOLERANCES.rovers, seed: int = 0, overhead: bool = True
) -> list[Check]:
    """Checks an effect on random rovers with four and six wheels, in float64; about a minute of compiling on a CPU.

    Checks of a list with the preset `consistent`: declared units; agreement with the list without it at its null
    values; finite derivatives by every parameter and input at null and nominal values; derivatives at null that are not
    zero; homogeneity (the port functions give the same physics in other base units); cost.

    Args:
      effect: from the catalogue or the user's own.
      rovers: number of random rovers; the first six stand still, hang in the air, touch, sit deep, roll and back up.
      seed: of the random states.
      overhead: whether to measure the cost.

    Returns:
      The checks in that order, up to a declaration that is wrong; the effect keeps its contract where none has failed.

    Raises:
      UserError: a port function does not run.
    """
    checks = [_declaration(effect)]
    if checks[0].passed is False:
        return checks
    on_sensors = "sensor" in effect.ports
    # Six wheels show an effect that takes the number of wheels, or of steered ones, for granted.
    sizes = (4,) if on_sensors else (4, 6)
    # In float32 a cancelled difference looks like a null value that is missed.
    with jax.enable_x64(True):
        runs = [_subject(effect, wheels, rovers, seed) for wheels in sizes]
        _try(effect, runs[0])
        checks.append(_requirements(effect))
        if checks[-1].passed is False:
            return checks
        checks.append(_null(effect, runs))
        checks += _derivatives(effect, runs, seed)
        checks.append(_homogeneity(effect, rovers, seed))
    # Sensors act once on a whole drive, outside of the step.
    if overhead and not on_sensors:
        cost, noise = measure_overhead(base_list(effect, without=True), base_list(effect))
        checks.append(_cost(cost, noise))
    return checks


def base_list(effect: Effect, without: bool = False) -> list[Effect]:
    """The preset `consistent` with `effect` in the place of those that it replaces; or without it."""
    kept = [catalogue.CATALOGUE[n] for n in PRESETS["consistent"] if n != effect.name]
    if without:
        return kept
    return [*(e for e in kept if e.name not in effect.replaces), effect]


def _declaration(effect: Effect) -> Check:
    # All problems at once: whoever mends one would else meet the next.
    problems = []
    if len(effect.doc) < 10:
        problems.append("no docstring states its equation and source")
    named = {**effect.parameters, **effect.state}
    for name, declared in named.items():
        try:
            check_unit(declared.unit)
        except ValueError as error:
            problems.append(f"the unit of {name}: {error}")
    listed = f"{len(effect.parameters)} parameters and {len(effect.state)} states in SI units"
    return Check("declaration", not problems, "; ".join(problems) or listed)


def _subject(effect: Effect, wheels: int, rovers: int, seed: int) -> tuple[_Act, Any]:
    """What is probed: a function of the parameters (None: without the effect) and one state, and random states."""
    if "sensor" in effect.ports:
        return functools.partial(act_on_channels, effect), jax.tree.map(jnp.asarray, channel_states(rovers, seed))
    # One ground for both lists, so that the effect alone tells them apart.
    world = probe.terrain()

    def act(values: Mapping[str, Any] | None, s: Any) -> Outputs:
        if values is None:
            return probe.act(base_list(effect, without=True), world, {}, s)
        return probe.act(base_list(effect), world, {effect.name: values}, s)

    return act, jax.tree.map(jnp.asarray, probe.states(rovers, wheels, seed))


def _try(effect: Effect, run: tuple[_Act, Any]) -> None:
    act, s = run
    try:
        jax.eval_shape(jax.vmap(functools.partial(act, _numbers(effect.nominal()))), s)
    except Exception as error:  # whatever a user's function raises
        reason = " ".join(str(error).split())[:300]
        raise UserError(f"effect {effect.name}: does not run: {type(error).__name__}: {reason}; mend it.") from error


class _Noting(dict[str, Any]):
    """Parameters by effect that note whose were looked up as if they had to be there."""

    def __init__(self, values: Mapping[str, Any], read: set[str]):
        super().__init__(values)
        self._read = read

    def __getitem__(self, name: str) -> Any:
        self._read.add(name)
        return super().__getitem__(name)


def _requirements(effect: Effect) -> Check:
    """Whether every effect whose parameters it reads is declared; what is asked for by `get` may be missing."""
    read: set[str] = set()

    def noting(function: Callable[..., Any]) -> Callable[..., Any]:
        def noted(ctx: Any, p: Any, x: Any, value: Any) -> Any:
            return function(dataclasses.replace(ctx, parameters=_Noting(ctx.parameters, read)), p, x, value)

        return noted

    watched = dataclasses.replace(effect, ports={port: noting(f) for port, f in effect.ports.items()})
    act, s = _subject(watched, 4, 1, 0)
    jax.eval_shape(jax.vmap(functools.partial(act, _numbers(effect.nominal()))), s)
    missing = sorted(read - {effect.name, *effect.requires})
    remedy = f"reads the parameters of {', '.join(missing)}: say requires={tuple(missing)}" if missing else ""
    return Check("requirements", not missing, remedy or f"reads of others: {', '.join(effect.requires) or 'nothing'}")


def _numbers(values: Mapping[str, float]) -> dict[str, Any]:
    return {k: jnp.asarray(v, float) for k, v in values.items()}


def _null(effect: Effect, runs: Sequence[tuple[_Act, Any]]) -> Check:
    name = "vanishes at null"
    if not any(p.null is not None for p in effect.parameters.values()):
        return Check(name, None, "no parameter has a null value: the effect cannot be switched off")
    worst, worst_quantity = 0.0, ""
    for act, s in runs:
        with_it = jax.vmap(functools.partial(act, _numbers(effect.null())))(s)
        forces_without = jax.vmap(functools.partial(act, None))(s)
        for key, ulp in _ulps(jax.device_get(with_it), jax.device_get(forces_without)).items():
            # written so that not a number counts as worse
            if not ulp <= worst:
                worst, worst_quantity = ulp, key
    detail = f"{worst:.2g} ulp" + (f" in {worst_quantity}" if worst else "")
    if not worst <= TOLERANCES.ulp:
        detail += "; give a null value only to parameters that switch the effect off, and see that they do"
    return Check(name, bool(worst <= TOLERANCES.ulp), detail)


def _ulps(got: Outputs, want: Outputs) -> dict[str, float]:
    """Largest deviation in ulp of the largest component on the same rover; moments count with the forces."""
    largest = {k: np.abs(v).reshape(len(v), -1).max(axis=1) for k, v in want.items()}
    if "wheel_moment" in largest:
        # a moment is a force times a lever of about a metre: cancelled moments carry the rounding of their forces
        largest["wheel_moment"] = np.maximum(largest["wheel_moment"], largest["wheel_force"])
    out = {}
    for key, value in want.items():
        difference = np.abs(got[key] - value).reshape(len(value), -1).max(axis=1)
        out[key] = float(np.max(difference / np.spacing(np.maximum(largest[key], 1e-300))))
    return out


def _derivatives(effect: Effect, runs: Sequence[tuple[_Act, Any]], seed: int) -> list[Check]:
    """Reverse mode with random weights shows every partial derivative; forward mode in a random direction as well."""
    rng = np.random.default_rng(seed)
    bad: list[str] = []
    by_parameter = dict.fromkeys(effect.parameters, 0.0)
    act, s = runs[0]
    weights = {}
    for label, values in (("null", effect.null()), ("nominal", effect.nominal())):
        numbers = _numbers(values)
        # one random direction: a derivative that is not finite shows in it unless its factor is zero
        way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), (numbers, s))

        def one(numbers: Any, state: Any, toward: Any) -> Any:
            out, forward = jax.jvp(act, (numbers, state), toward)
            if not weights:
                weights.update({k: jnp.asarray(rng.normal(size=v.shape)) for k, v in out.items()})
            # Random weights: one pass back shows the derivatives of all outputs, and none cancels another.
            _, pull = jax.vjp(act, numbers, state)
            return forward, pull(weights)

        forward, (by_value, by_state) = jax.vmap(one, in_axes=(None, 0, (None, 0)))(numbers, s, way)
        for kind, tree in (("", by_value), ("input ", by_state)):
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree):
                wrong = ~np.isfinite(np.asarray(leaf)).reshape(len(leaf), -1).all(axis=1)
                if wrong.any():
                    parameter = jax.tree_util.keystr(path).strip("[]'")
                    bad.append(f"by {kind}{parameter} at {label} values (rover {int(np.argmax(wrong))})")
        if not all(np.isfinite(np.asarray(v)).all() for v in forward.values()):
            bad.append(f"forward mode at {label} values")
        if label == "null":
            by_parameter = {k: float(np.abs(np.asarray(v)).max()) for k, v in by_value.items()}
    looked = f"by every parameter and input of {len(jax.tree.leaves(s)[0])} rovers, at null and nominal values"
    finite = Check("finite derivatives", not bad, "not finite " + ", ".join(bad[:4]) if bad else looked)
    zero = [k for k, p in effect.parameters.items() if p.null is not None and by_parameter[k] == 0.0]
    note = "every parameter with a null value can be tested there"
    if zero:
        note = f"none by {', '.join(zero)}: no score test at the null can see it; linear amplitudes can be seen"
    return [finite, Check("derivatives at null", None if zero else True, note)]


def _homogeneity(effect: Effect, rovers: int, seed: int) -> Check:
    """The port functions on rovers described in other base units, one base at a time and all together."""
    on_sensors = "sensor" in effect.ports
    effects = [effect] if on_sensors else base_list(effect)
    settings = {base: {base: factor} for base, factor in _FACTORS.items()} | {"all": _FACTORS}
    scales = {label: Rescaling(factors, effects) for label, factors in settings.items()}

    def errors(s: Any) -> list[tuple[Any, Any]]:
        differences: list[tuple[str, str, Any, Any]] = []
        watched = _watched(effect, scales, differences)
        if on_sensors:
            act_on_channels(watched, _numbers(effect.nominal()), s)
        else:
            probe.act([watched if e is effect else e for e in effects], probe.terrain(), {}, s)
        names[:] = [(label, port) for label, port, _, _ in differences]
        return [(error, size) for _, _, error, size in differences]

    names: list[tuple[str, str]] = []
    runs = channel_states(rovers, seed) if on_sensors else probe.states(rovers, 4, seed)
    result = jax.device_get(jax.vmap(errors)(jax.tree.map(jnp.asarray, runs)))
    worst: dict[str, dict[str, float]] = {label: {} for label in settings}
    for (label, port), (error, size) in zip(names, result, strict=True):
        for e, m in zip(error, size, strict=True):
            relative = float(np.max(e) / max(float(np.max(m)), 1e-300)) if np.isfinite(e).all() else np.inf
            worst[label][port] = max(worst[label].get(port, 0.0), relative)
    # One base at a time names the quantity that stands as a number in the function.
    guilty = [(base, port, w) for base in BASES for port, w in worst[base].items() if not w <= TOLERANCES.homogeneity]
    if guilty:
        broken = ", ".join(f"of {BASES[base]} (port {port}, {w:.0e})" for base, port, w in guilty)
        return Check(
            "units",
            False,
            f"the result depends on the unit {broken}: a number in the function stands for a "
            "quantity; make it a parameter or an Annotated constant with that unit, or mend the unit of a parameter",
        )
    largest = max([w for ports in worst.values() for w in ports.values()], default=0.0)
    return Check("units", bool(largest <= TOLERANCES.homogeneity), f"homogeneous to {largest:.1g} in other base units")


def _watched(effect: Effect, scales: Mapping[str, Rescaling], found: list[tuple[str, str, Any, Any]]) -> Effect:
    """The effect with port functions that also work in other base units and note by how much they then differ."""

    def watch(port: str, function: Callable[..., Any]) -> Callable[..., Any]:
        # Torques are bare arrays; what other ports hand on says its units by its class.
        unit = "N m" if port == "motor_torque" else "own"

        def both(ctx: Any, p: Any, x: Any, value: Any) -> Any:
            result = function(ctx, p, x, value)
            for label, scale in scales.items():
                state = SimpleNamespace(**scale.state(effect, vars(x)))
                mode = ctx.rover.mode
                given = scale.value(ctx), scale.parameters(effect, p), state, scale.value(value, unit, mode=mode)
                with scale.constants():
                    other = function(*given)
                want: Any = result
                if effect.state and isinstance(result, tuple):
                    new, update = result
                    want = scale.value(new, unit, mode=mode), scale.state(effect, update, rates=True)
                else:
                    want = scale.value(result, unit, mode=mode)
                found.append((label, port, *_differences(other, want, _summed(effect, want))))
            return result

        return both

    ports = {port: watch(port, function) for port, function in effect.ports.items()}
    return dataclasses.replace(effect, ports=ports)


def _summed(effect: Effect, result: Any) -> Any:
    """The result, with the sum itself in place of a state that keeps its rounding: the scale of what it may be off."""
    if not (effect.state and isinstance(result, tuple)):
        return result
    value, update = result
    return value, {name: update[effect.state[name].rounding_of or name] for name in update}


def _differences(got: Any, want: Any, scale: Any) -> tuple[list[Any], list[Any]]:
    """Largest difference of each number, and largest size of what it is held against, leaf by leaf."""
    pairs = list(zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True))
    pairs = [(jnp.asarray(a, float), jnp.asarray(b, float)) for a, b in pairs]
    # Equal infinities (a stop that is none) are no difference.
    errors = [jnp.max(jnp.where(a == b, 0.0, jnp.abs(a - b))) for a, b in pairs]
    sizes = [jnp.asarray(c, float) for c in jax.tree.leaves(scale)]
    return errors, [jnp.max(jnp.where(jnp.isfinite(c), jnp.abs(c), 0.0)) for c in sizes]


def _cost(cost: float, noise: float) -> Check:
    measured = f"{100 * cost:+.1f} % of the effects of a step, repeats differ by {100 * noise:.1f} %"
    if cost <= TOLERANCES.overhead:
        return Check("cost", True, measured)
    # a busy machine must not fail an effect
    if cost - noise <= TOLERANCES.overhead:
        return Check("cost", None, measured + ": too near the limit of 5 % for a verdict on this machine")
    return Check("cost", False, measured + "; the limit is 5 %")
