"""A traced function of small arrays as a graph of single numbers: what one thread of a kernel computes.

A step is written for one rover, with arrays over its wheels, legs, joints and stress nodes. A kernel that keeps a rover
in the registers of one thread has no arrays there: slicing, stacking and reducing must vanish while it is built. Here
every entry of every array becomes a node of its own, equal nodes become one, and nodes that lead to no result are never
made. Large tables (terrain, rocks) stay arrays in memory, read by index.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from lunar_mjx.dynamics.batching.batch_last import ELEMENTWISE, INLINE, bind

TABLE = 9
"""Entries from which an array that is read at places found during the step counts as a table in memory."""


class UnsupportedError(NotImplementedError):
    """An operation of the traced function that a kernel of single numbers cannot hold; the sentence names it."""


class Node:
    """A single number: an operation on others.

    Attributes:
      op: name of a `lax` primitive, `input` or `load`.
      args: nodes and NumPy numbers.
      params: of the primitive; the number of an input or of a table.
      dtype: of the value.
    """

    __slots__ = ("args", "dtype", "op", "params")

    def __init__(self, op: str, args: tuple[Any, ...], params: Any, dtype: np.dtype):
        self.op, self.args, self.params, self.dtype = op, args, params, dtype


class Table:
    """An array in memory that a step reads by index.

    Attributes:
      values: flat, shape (entry,), or (rover, entry) where every rover has its own.
      number: place among the graph's tables.
      own: whether every rover has its own.
    """

    def __init__(self, values: Any, number: int, own: bool):
        self.values, self.number, self.own = values, number, own

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one rover's table."""
        return self.values.shape[1:] if self.own else self.values.shape


class Graph:
    """The nodes of a function, equal ones made once.

    Attributes:
      tables: arrays that the function reads by index.
    """

    def __init__(self) -> None:
        self._made: dict[Any, Node] = {}
        self._primitives: dict[Any, Any] = {}
        self.tables: list[Table] = []

    def input(self, number: int, dtype: Any) -> Node:
        """The node of an argument's entry."""
        return self._node("input", (), number, np.dtype(dtype))

    def table(self, values: Any, own: bool = False) -> Table:
        """An array in memory; `own` where its first axis is over rovers."""
        for table in self.tables:
            if table.values is values or (not own and not table.own and np.array_equal(table.values, values)):
                return table
        self.tables.append(Table(values, len(self.tables), own))
        return self.tables[-1]

    def primitive(self, node: Node) -> tuple[Any, dict[str, Any]]:
        """The `lax` primitive of a node and its parameters."""
        return self._primitives[node.op, node.params]

    def run(self, jaxpr: Any, consts: Any, args: list[Any]) -> list[Any]:
        """Results of a jaxpr: arrays of numbers where they depend on no input, else of objects (nodes, numbers)."""
        env: dict[Any, Any] = dict(zip(jaxpr.constvars, (_known(c) for c in consts), strict=True))
        env.update(zip(jaxpr.invars, args, strict=True))

        def read(atom: Any) -> Any:
            return (
                np.asarray(atom.val, getattr(atom.aval, "dtype", None)) if isinstance(atom, core.Literal) else env[atom]
            )

        for eqn in jaxpr.eqns:
            env.update(zip(eqn.outvars, self._apply(eqn, [read(v) for v in eqn.invars]), strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _apply(self, eqn: Any, operands: list[Any]) -> list[Any]:
        name = eqn.primitive.name
        inner = INLINE.get(name, "call_jaxpr" if name == "custom_jvp_call" else None)
        if inner is not None:
            return self.run(eqn.params[inner].jaxpr, eqn.params[inner].consts, operands)
        if name == "optimization_barrier":
            return operands
        if not any(isinstance(o, Table) or o.dtype == object for o in operands):
            with jax.ensure_compile_time_eval():
                return [np.asarray(x) for x in bind(eqn, operands)]
        if name in ELEMENTWISE:
            return [self._elementwise(eqn, operands)]
        rule = _RULES.get(name)
        if rule is None:
            raise UnsupportedError(f"{name}: no rule to compute it number by number")
        return [rule(self, eqn, operands)]

    def _elementwise(self, eqn: Any, operands: list[Any]) -> Any:
        aval = eqn.outvars[0].aval
        out = np.empty(aval.shape, object)
        wide = [np.broadcast_to(o, aval.shape) for o in operands]
        for at in np.ndindex(*aval.shape):
            out[at] = self.operate(eqn.primitive, eqn.params, [w[at] for w in wide], aval.dtype)
        return out

    def operate(self, primitive: Any, params: dict[str, Any], args: list[Any], dtype: Any) -> Any:
        """One elementwise operation on single numbers."""
        name, dtype = primitive.name, np.dtype(dtype)
        if not any(isinstance(a, Node) for a in args):
            with jax.ensure_compile_time_eval():
                return np.asarray(primitive.bind(*args, **params))[()]
        if name == "integer_pow":
            return self._power(args[0], params["y"], dtype)
        if name == "square":
            return self._power(args[0], 2, dtype)
        if name == "clamp":
            low, x, high = args
            return self.operate(lax.min_p, {}, [self.operate(lax.max_p, {}, [x, low], dtype), high], dtype)
        if name in ("copy", "copy_p", "stop_gradient") or (name == "convert_element_type" and args[0].dtype == dtype):
            return args[0]
        if name == "select_n" and (not isinstance(args[0], Node) or all(a is args[1] for a in args[2:])):
            return args[1] if isinstance(args[0], Node) else args[1 + int(args[0])]
        if name in ("add", "sub", "mul", "div"):
            neutral = 0 if name in ("add", "sub") else 1
            if not isinstance(args[1], Node) and args[1] == neutral:
                return args[0]
            if name in ("add", "mul") and not isinstance(args[0], Node) and args[0] == neutral:
                return args[1]
        if name in ("add", "mul", "max", "min", "and", "or", "eq", "ne"):
            args = sorted(args, key=_order)
        key = _frozen(params)
        self._primitives.setdefault((name, key), (primitive, params))
        return self._node(name, tuple(args), key, dtype)

    def load(self, table: Table, index: Any, dtype: Any) -> Any:
        """An entry of a table."""
        if isinstance(index, Node) or table.own:
            return self._node("load", (index,), table.number, np.dtype(dtype))
        return np.asarray(table.values[int(index)])[()]

    def _power(self, x: Any, exponent: int, dtype: np.dtype) -> Any:
        if exponent < 0:
            return self.operate(lax.div_p, {}, [dtype.type(1), self._power(x, -exponent, dtype)], dtype)
        if exponent == 1:
            return x
        half = self._power(x, exponent // 2, dtype)
        whole = self.operate(lax.mul_p, {}, [half, half], dtype)
        return self.operate(lax.mul_p, {}, [whole, x], dtype) if exponent % 2 else whole

    def _node(self, op: str, args: tuple[Any, ...], params: Any, dtype: np.dtype) -> Node:
        # the bits of a number tell 0 from -0
        key = (op, params, dtype, *(id(a) if isinstance(a, Node) else (a.dtype.str, a.tobytes()) for a in args))
        node = self._made.get(key)
        if node is None:
            node = self._made[key] = Node(op, args, params, dtype)
        return node


def needed(outputs: list[Any]) -> list[Node]:
    """The nodes that lead to outputs, operands before what reads them."""
    order: list[Node] = []
    seen: set[int] = set()
    stack = [(o, False) for o in reversed(outputs) if isinstance(o, Node)]
    while stack:
        node, ready = stack.pop()
        if ready:
            order.append(node)
        elif id(node) not in seen:
            seen.add(id(node))
            stack.append((node, True))
            stack.extend((a, False) for a in reversed(node.args) if isinstance(a, Node) and id(a) not in seen)
    return order


def _known(value: Any) -> Any:
    return value if isinstance(value, Table) else np.asarray(value)


def _order(arg: Any) -> tuple[int, int]:
    return (0, id(arg)) if isinstance(arg, Node) else (1, 0)


def _frozen(params: dict[str, Any]) -> Any:
    return tuple(sorted((k, str(v)) for k, v in params.items()))


def _reduce(primitive: Any) -> Callable[[Graph, Any, list[Any]], Any]:
    def rule(graph: Graph, eqn: Any, operands: list[Any]) -> Any:
        x, axes, aval = operands[0], eqn.params["axes"], eqn.outvars[0].aval
        kept_axes = [i for i in range(x.ndim) if i not in axes]
        out = np.empty(aval.shape, object)
        flat = x.transpose(*kept_axes, *axes).reshape(*aval.shape, -1)
        for at in np.ndindex(*aval.shape):
            total = flat[at][0]
            for value in flat[at][1:]:
                total = graph.operate(primitive, {}, [total, value], aval.dtype)
            out[at] = total
        return out

    return rule


def _broadcast_in_dim(graph: Graph, eqn: Any, operands: list[Any]) -> Any:
    shape, at = eqn.params["shape"], eqn.params["broadcast_dimensions"]
    full = [1] * len(shape)
    for axis, size in zip(at, operands[0].shape, strict=True):
        full[axis] = size
    return np.broadcast_to(operands[0].reshape(full), shape)


def _reshape(graph: Graph, eqn: Any, operands: list[Any]) -> Any:
    x = operands[0]
    if isinstance(x, Table):
        return graph.table(x.values.reshape(*x.values.shape[:1], -1) if x.own else x.values.reshape(-1), x.own)
    return x.reshape(eqn.params["new_sizes"])


def _slice(graph: Graph, eqn: Any, operands: list[Any]) -> Any:
    p = eqn.params
    steps = p["strides"] or (1,) * len(p["start_indices"])
    return operands[0][tuple(map(slice, p["start_indices"], p["limit_indices"], steps))]


def _gather(graph: Graph, eqn: Any, operands: list[Any]) -> Any:
    values, index = operands
    p, aval = eqn.params, eqn.outvars[0].aval
    numbers = p["dimension_numbers"]
    if (
        len(values.shape) != 1
        or p["slice_sizes"] != (1,)
        or numbers.offset_dims
        or numbers.collapsed_slice_dims != (0,)
        or p["mode"] != lax.GatherScatterMode.PROMISE_IN_BOUNDS
    ):
        raise UnsupportedError(
            f"gather from {values.shape} in mode {p['mode']}: entries of flat tables, in bounds, alone"
        )
    index = index.reshape(aval.shape)
    if isinstance(values, Table) or len(values) >= TABLE:
        if not isinstance(values, Table) and values.dtype == object:
            raise UnsupportedError("gather from a state: a thread cannot look up its registers by number")
        table = values if isinstance(values, Table) else graph.table(values)
        out = np.empty(aval.shape, object)
        for at in np.ndindex(*aval.shape):
            out[at] = graph.load(table, index[at], aval.dtype)
        return out
    if index.dtype != object:
        return values[index]
    out = np.empty(aval.shape, object)
    for at in np.ndindex(*aval.shape):
        chosen = values[0]
        for k in range(1, len(values)):
            hit = graph.operate(lax.eq_p, {}, [index[at], np.int32(k)], bool)
            chosen = graph.operate(lax.select_n_p, {}, [hit, chosen, values[k]], aval.dtype)
        out[at] = chosen
    return out


_RULES: dict[str, Callable[[Graph, Any, list[Any]], Any]] = {
    "broadcast_in_dim": _broadcast_in_dim,
    "concatenate": lambda g, e, o: np.concatenate([np.asarray(x, object) for x in o], e.params["dimension"]),
    "gather": _gather,
    "reduce_and": _reduce(lax.and_p),
    "reduce_max": _reduce(lax.max_p),
    "reduce_min": _reduce(lax.min_p),
    "reduce_or": _reduce(lax.or_p),
    "reduce_prod": _reduce(lax.mul_p),
    "reduce_sum": _reduce(lax.add_p),
    "reshape": _reshape,
    "slice": _slice,
    "squeeze": lambda g, e, o: o[0].reshape(e.outvars[0].aval.shape),
    "stack": lambda g, e, o: np.stack([np.asarray(x, object) for x in o], e.params["axis"]),
    "transpose": lambda g, e, o: o[0].transpose(e.params["permutation"]),
}


def traced(function: Callable[..., Any], args: Any, kinds: list[Any]) -> tuple[Graph, list[Any], Any, list[Any]]:
    """The graph of a function of one rover.

    Args:
      function: of one pytree.
      args: the pytree, its leaves with one rover's shapes, or with a first axis over rovers for tables of their own.
      kinds: per leaf "known" (its value is built into the graph), "input" (numbers of a rover), or "table" (a table of
        every rover's own).

    Returns:
      The graph; per leaf of the result its entries (NumPy arrays of numbers, or of objects: nodes and numbers); the
      structure of the result; and per leaf of `args` its entries likewise (None for tables).

    Raises:
      UnsupportedError: the function holds an operation that has no place in such a graph.
    """
    leaves, treedef = jax.tree.flatten(args)
    graph, count = Graph(), itertools.count()
    operands: list[Any] = []
    single = []
    for leaf, kind in zip(leaves, kinds, strict=True):
        shape = leaf.shape[1:] if kind == "table" else jnp.shape(leaf)
        single.append(leaf if kind == "known" else jax.ShapeDtypeStruct(shape, jnp.result_type(leaf)))
        if kind == "table":
            operands.append(graph.table(leaf, own=True))
        elif kind == "known":
            operands.append(np.asarray(leaf))
        else:
            entries = np.empty(shape, object)
            for at in np.ndindex(*shape):
                entries[at] = graph.input(next(count), jnp.result_type(leaf))
            operands.append(entries)
    closed, shapes = jax.make_jaxpr(lambda *x: function(jax.tree.unflatten(treedef, x)), return_shape=True)(
        *(jax.ShapeDtypeStruct(jnp.shape(x), jnp.result_type(x)) for x in single)
    )
    results = graph.run(closed.jaxpr, closed.consts, operands)
    entries = [o if isinstance(o, np.ndarray) else None for o in operands]
    return graph, results, jax.tree.structure(shapes), entries
