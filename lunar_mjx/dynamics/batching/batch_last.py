"""`vmap` that keeps the batch axis last throughout.

`jax.vmap(f, in_axes=-1, out_axes=-1)` moves the batch axis to the front wherever operands of different rank meet (a
rover's number and an array over its wheels), so that XLA sees (rover, wheel) arrays: short rows, poor vectors. Here
the function is traced for one rover and its elementwise primitives are bound again with the batch axis last; whatever
has no rule below goes through `jax.vmap`, primitive by primitive.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.extend import core

from lunar_mjx.effects.marks import BY_WHEEL, marking

_ELEMENTWISE = {
    "abs", "acos", "acosh", "add", "and", "asin", "asinh", "atan", "atan2", "atanh", "cbrt", "ceil", "clamp",
    "convert_element_type", "copy", "copy_p", "cos", "cosh", "digamma", "div", "eq", "erf", "erf_inv", "erfc", "exp",
    "exp2", "expm1", "floor", "ge", "gt", "integer_pow", "is_finite", "le", "lgamma", "log", "log1p", "logistic", "lt",
    "max", "min", "mul", "ne", "neg", "nextafter", "not", "or", "pow", "real", "rem", "round", "rsqrt", "select_n",
    "sign", "sin", "sinh", "sqrt", "square", "stop_gradient", "sub", "tan", "tanh", "xor",
}  # fmt: skip
Inline = Callable[..., list[tuple[Any, int | None]]]
"""How an equation is computed without a kernel: from it, its operands, their batch axes and which results are wanted,
to the results with their batch axes."""
INLINE = {"jit": "jaxpr", "pjit": "jaxpr", "closed_call": "call_jaxpr", "core_call": "call_jaxpr"}


def batch_last(
    function: Callable[..., Any], in_axes: tuple[Any, ...], part: Callable[..., Any] | None = None
) -> Callable[..., Any]:
    """Maps a function of one rover over the last axis of its arguments; the results have the batch axis last.

    Args:
      function: a pure function of pytrees of arrays.
      in_axes: for each argument None (shared), -1 (batch last), 0 (batch first), or a list of those, one per leaf.
      part: how parts that `marks` marks are computed (`one_kernel.as_kernels`); None: like the rest.

    Returns:
      The batched function.
    """

    def batched(*args: Any) -> Any:
        leaves, treedef = jax.tree.flatten(args)
        axes = [_spread(a, arg) for a, arg in zip(in_axes, args, strict=True)]
        flat_axes = [a for tree_axes in axes for a in tree_axes]
        single = [
            leaf if a is None else jax.ShapeDtypeStruct(_without(leaf.shape, a), leaf.dtype)
            for leaf, a in zip(leaves, flat_axes, strict=True)
        ]
        with nullcontext() if part is None else marking():
            closed, shapes = jax.make_jaxpr(lambda *x: function(*jax.tree.unflatten(treedef, x)), return_shape=True)(
                *(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in single)
            )
        size = next(leaf.shape[a] for leaf, a in zip(leaves, flat_axes, strict=True) if a is not None)
        values = [_Value(leaf, a) for leaf, a in zip(leaves, flat_axes, strict=True)]
        out = _run(closed.jaxpr, closed.consts, values, [True] * len(closed.jaxpr.outvars), part)
        return jax.tree.unflatten(jax.tree.structure(shapes), [at_end(v.array, v.axis, size) for v in out])

    return batched


class _Value:
    """An array and where its batch axis is: None, -1 or (for large maps) 0."""

    __slots__ = ("array", "axis")

    def __init__(self, array: Any, axis: int | None):
        self.array, self.axis = array, axis


def _spread(axes: Any, arg: Any) -> list[Any]:
    """The axis of every leaf of an argument."""
    return axes if isinstance(axes, list) else [axes] * len(jax.tree.leaves(arg))


def _without(shape: tuple[int, ...], axis: int) -> tuple[int, ...]:
    axis %= len(shape)
    return shape[:axis] + shape[axis + 1 :]


def at_end(array: Any, axis: int | None, size: int) -> Any:
    """An array with its batch axis, of length `size`, last; what is shared (axis None) is repeated."""
    if axis is None:
        return jnp.broadcast_to(jnp.asarray(array)[..., None], (*jnp.shape(array), size))
    return jnp.moveaxis(array, axis, -1)


def wanted(jaxpr: Any, live: list[bool]) -> set[Any]:
    """The variables that lead to those results of a jaxpr that `live` names."""
    found = {v for v, wants in zip(jaxpr.outvars, live, strict=True) if wants and not isinstance(v, core.Literal)}
    for eqn in reversed(jaxpr.eqns):
        if any(v in found for v in eqn.outvars):
            found.update(v for v in eqn.invars if not isinstance(v, core.Literal))
    return found


def _run(jaxpr: Any, consts: Any, args: list[Any], live: list[bool], part: Any) -> list[Any]:
    """Evaluates a jaxpr, equation by equation; results that are not `live` may be None."""
    env: dict[Any, Any] = {}

    def read(atom: Any) -> Any:
        return _Value(atom.val, None) if isinstance(atom, core.Literal) else env.get(atom)

    env.update(zip(jaxpr.constvars, (_Value(c, None) for c in consts), strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))
    needed = wanted(jaxpr, live)
    for eqn in jaxpr.eqns:
        wants = [v in needed for v in eqn.outvars]
        if any(wants):
            env.update(zip(eqn.outvars, _apply(eqn, [read(v) for v in eqn.invars], wants, part), strict=True))
    return [read(v) for v in jaxpr.outvars]


def _inline(eqn: Any, arrays: list[Any], axes: list[int | None], live: list[bool]) -> list[tuple[Any, int | None]]:
    inner = eqn.params[INLINE[eqn.primitive.name]]
    found = _run(inner.jaxpr, inner.consts, [_Value(*pair) for pair in zip(arrays, axes, strict=True)], live, None)
    return [(None, None) if value is None else (value.array, value.axis) for value in found]


def _apply(eqn: Any, operands: list[Any], live: list[bool], part: Any) -> list[Any]:
    name = eqn.primitive.name
    # Calls are opened up: a rule can only see an elementwise operation that is not hidden in a function.
    if name in INLINE:
        if part is not None and str(eqn.params.get("name")).startswith(BY_WHEEL):
            done = part(eqn, [o.array for o in operands], [o.axis for o in operands], live, _inline)
            if done is not None:
                return [None if array is None else _Value(array, -1) for array in done]
        inner = eqn.params[INLINE[name]]
        return _run(inner.jaxpr, inner.consts, operands, live, part)
    # What no batched value enters is computed once for the batch.
    if all(o.axis is None for o in operands):
        out = bind(eqn, [o.array for o in operands])
        return [_Value(x, None) for x in out]
    if name == "optimization_barrier":
        out = bind(eqn, [o.array for o in operands])
        return [_Value(x, o.axis) for x, o in zip(out, operands, strict=True)]
    # a map of the rover's own keeps its batch axis in front, so that its cells lie together
    if name == "reshape" and operands[0].axis == 0:
        x = operands[0].array
        return [_Value(jnp.reshape(x, (x.shape[0], *eqn.params["new_sizes"])), 0)]
    # A rule may decline (None), as for gathers of a form that it does not know; then vmap does it.
    rule = _elementwise if name in _ELEMENTWISE else _RULES.get(name)
    if rule is not None and all(o.axis in (None, -1) for o in operands):
        done = rule(eqn, operands)
        if done is not None:
            return [_Value(done, -1)]
    out = jax.vmap(lambda *x: bind(eqn, x), in_axes=tuple(o.axis for o in operands), out_axes=-1)(
        *(o.array for o in operands)
    )
    return [_Value(x, -1) for x in out]


def bind(eqn: Any, arrays: Any) -> list[Any]:
    """Binds an equation's primitive again, with whatever functions it holds (loops, custom derivatives)."""
    bound = eqn.primitive.get_bind_params(eqn.params)
    functions, params = bound if isinstance(bound, tuple) else ((), bound)
    out = eqn.primitive.bind(*functions, *arrays, **params)
    return list(out) if eqn.primitive.multiple_results else [out]


def _elementwise(eqn: Any, operands: list[_Value]) -> Any:
    """Operands get the rank of the result and a last axis, of length 1 where they are shared."""
    rank = len(eqn.outvars[0].aval.shape)
    arrays = []
    for o in operands:
        if o.axis is None and jnp.ndim(o.array) == 0:
            arrays.append(o.array)
            continue
        shape = jnp.shape(o.array) if o.axis is None else o.array.shape[:-1]
        last = 1 if o.axis is None else o.array.shape[-1]
        # a rover's number beside an array over its wheels: new axes go in front of the batch axis, which stays the last
        lead = (1,) * (rank - len(shape)) if not shape else ()
        arrays.append(jnp.reshape(o.array, (*lead, *shape, last)))
    full = jnp.broadcast_shapes(*(jnp.shape(a) for a in arrays))
    # lax takes equal shapes (and plain scalars); broadcasts fuse away
    arrays = [a if jnp.shape(a) == full else jnp.broadcast_to(a, full) for a in arrays]
    return bind(eqn, arrays)[0]


def _broadcast_in_dim(eqn: Any, operands: list[_Value]) -> Any:
    x = operands[0].array
    shape = (*eqn.params["shape"], x.shape[-1])
    return lax.broadcast_in_dim(x, shape, (*eqn.params["broadcast_dimensions"], len(shape) - 1))


def _reshape(eqn: Any, operands: list[_Value]) -> Any:
    x = operands[0].array
    return None if eqn.params.get("dimensions") else jnp.reshape(x, (*eqn.params["new_sizes"], x.shape[-1]))


def _squeeze(eqn: Any, operands: list[_Value]) -> Any:
    return lax.squeeze(operands[0].array, eqn.params["dimensions"])


def _slice(eqn: Any, operands: list[_Value]) -> Any:
    x, p = operands[0].array, eqn.params
    strides = None if p["strides"] is None else (*p["strides"], 1)
    return lax.slice(x, (*p["start_indices"], 0), (*p["limit_indices"], x.shape[-1]), strides)


def _concatenate(eqn: Any, operands: list[_Value]) -> Any:
    size = next(o.array.shape[-1] for o in operands if o.axis is not None)
    return lax.concatenate([at_end(o.array, o.axis, size) for o in operands], eqn.params["dimension"])


def _gather(eqn: Any, operands: list[_Value]) -> Any:
    """Look-up of single entries of a shared array."""
    table, index = operands
    numbers = eqn.params["dimension_numbers"]
    # Only the look-up of a terrain's height is common enough to deserve a rule.
    if table.axis is not None or numbers.offset_dims or index.axis is None:
        return None
    return bind(eqn, [table.array, jnp.moveaxis(index.array, -1, -2)])[0]


_RULES: dict[str, Callable[[Any, list[_Value]], Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": _reshape,
    "squeeze": _squeeze,
    "slice": _slice,
    "concatenate": _concatenate,
    "gather": _gather,
}
