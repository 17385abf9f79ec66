"""Values that many kernels read are computed once and stored: for CPUs, where XLA would compute them again in each.

XLA fuses cheap operations into every kernel that reads their result, chain by chain: a step computed the forces of a
wheel in three kernels, those of the chassis in six and the kinematics in dozens, 81 kFLOP in place of 15. XLA for CPUs
drops its optimisation barriers before it fuses, but leaves alone a call that must not be inlined; so an empty call
marks a value that is to be stored. GPUs, whose memory is slow beside their arithmetic, keep their few large kernels.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

from lunar_mjx.dynamics.batching.batch_last import INLINE, bind


@dataclasses.dataclass(frozen=True)
class KernelCosts:
    """What a GPU's work costs, in additions of single numbers."""

    kernel: float = 4000.0
    """Additions of single numbers that take as long as one more kernel, about 0.2 us."""
    traffic: float = 2.0
    """Additions that take as long as to store a number, or to read it again."""


KERNEL_COSTS = KernelCosts()


_MOVES = {"broadcast_in_dim", "convert_element_type", "copy", "reshape", "slice", "squeeze", "stop_gradient"}
_ADDITIONS = {
    "div": 4.0,
    "sqrt": 4.0,
    "rsqrt": 4.0,
    "gather": 8.0,
    "exp": 12.0,
    "log": 12.0,
    "tanh": 12.0,
    "expm1": 15.0,
    "log1p": 15.0,
    "sin": 15.0,
    "cos": 15.0,
    "tan": 30.0,
    "asin": 30.0,
    "atan2": 30.0,
    "pow": 30.0,
}
"""How many additions an operation costs, about; 1 if it is not named here."""


def computed_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function's equal, derivatives included, that stores costly intermediate values where that is faster.

    Args:
      function: a pure function of pytrees of arrays.

    Returns:
      The function, for a program that runs on CPUs (by JAX's default backend); `function` itself elsewhere.
    """
    if jax.default_backend() != "cpu":
        return function

    def run(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        closed, shapes = jax.make_jaxpr(lambda *x: function(*jax.tree.unflatten(treedef, x)), return_shape=True)(
            *leaves
        )
        steps: list[_Step] = []
        results = _flatten(closed.jaxpr, closed.consts, [_Value(x) for x in leaves], steps)
        return jax.tree.unflatten(jax.tree.structure(shapes), _evaluate(_needed(steps, results), results))

    return run


class _Value:
    """An intermediate value.

    Attributes:
      array: once it is computed.
      uses: how many operations read it.
      pending: what its readers would compute again: operations by number, with their cost in additions.
    """

    __slots__ = ("array", "pending", "uses")

    def __init__(self, array: Any = None):
        self.array, self.uses = array, 0
        self.pending: dict[int, float] = {}


_Step = tuple[Any, list[_Value], list[_Value]]
"""An equation of a jaxpr with its operands and results."""


def _flatten(jaxpr: Any, consts: Any, args: list[_Value], steps: list[_Step]) -> list[_Value]:
    """Appends a jaxpr's equations to `steps`, with those of jitted functions in their place; returns its results."""
    env: dict[Any, _Value] = dict(zip(jaxpr.constvars, map(_Value, consts), strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))

    def read(atom: Any) -> _Value:
        return _Value(atom.val) if isinstance(atom, core.Literal) else env[atom]

    for eqn in jaxpr.eqns:
        operands = [read(v) for v in eqn.invars]
        if eqn.primitive.name in INLINE:
            inner = eqn.params[INLINE[eqn.primitive.name]]
            results = _flatten(inner.jaxpr, inner.consts, operands, steps)
        else:
            results = [_Value() for _ in eqn.outvars]
            steps.append((eqn, operands, results))
        env.update(zip(eqn.outvars, results, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _needed(steps: list[_Step], results: list[_Value]) -> list[_Step]:
    """The steps that lead to the results, with the uses of every value counted."""
    for value in results:
        value.uses += 1
    kept = []
    # From the results backward, so that dead equations are dropped and count as no reader.
    for step in reversed(steps):
        if any(value.uses for value in step[2]):
            kept.append(step)
            for value in set(step[1]):
                value.uses += 1
    return kept[::-1]


def _evaluate(steps: list[_Step], results: list[_Value]) -> list[Any]:
    """Computes the results, and stores on the way what is dearer to compute again than to store and read."""
    for number, (eqn, operands, made) in enumerate(steps):
        size = int(np.prod(eqn.outvars[0].aval.shape))
        for value in set(operands):
            # what a rover's number costs, all its legs or wheels that read it would pay
            _store_if_dear(value, size / max(int(np.size(value.array)), 1))
        for value, array in zip(made, bind(eqn, [v.array for v in operands]), strict=True):
            value.array = array
        # XLA writes these results to memory anyhow; their readers recompute nothing.
        if len(made) > 1 or _own_kernel(eqn):
            continue
        for value in operands:
            # a set, not a sum: an operation that two operands need is computed once within one kernel
            made[0].pending |= value.pending
        name = eqn.primitive.name
        made[0].pending[number] = 0.0 if name in _MOVES else _ADDITIONS.get(name, 1.0) * size
        _store_if_dear(made[0], made[0].uses)
    return [value.array for value in results]


def _own_kernel(eqn: Any) -> bool:
    """Whether XLA stores the result of an operation anyhow: reductions, loops, branches."""
    parameters = [p for value in eqn.params.values() for p in (value if isinstance(value, tuple) else (value,))]
    nested = any(isinstance(p, core.ClosedJaxpr | core.Jaxpr) for p in parameters)
    return nested or eqn.primitive.name.startswith("reduce_")


def _store_if_dear(value: _Value, times: float) -> None:
    """Stores a value that would else be computed `times` over, if that pays."""
    if times <= 1.0 or not value.pending:
        return
    stored = KERNEL_COSTS.kernel + KERNEL_COSTS.traffic * (times + 1.0) * np.size(value.array)
    if sum(value.pending.values()) * (times - 1.0) > stored:
        value.array = set_xla_metadata(jax.jit(_same)(value.array), inlineable="false")
        value.pending = {}


def _same(x: Any) -> Any:
    return x
