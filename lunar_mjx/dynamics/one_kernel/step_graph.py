"""A step of one rover as a graph of single numbers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.one_kernel.scalar_graph import Graph, Node, needed, traced
from lunar_mjx.dynamics.state import Params, State


@dataclasses.dataclass(frozen=True)
class StepGraph:
    """A step of one rover, number by number.

    Attributes:
      graph: its nodes and tables.
      state: number of the input of every entry of the state; held: numbers of those that stay as they are (parameters
        of each rover, then controls).
      new: what every entry of the state becomes, a node or a number.
      dtypes: of every input.
    """

    graph: Graph
    state: tuple[int, ...]
    held: tuple[int, ...]
    new: tuple[Any, ...]
    dtypes: tuple[np.dtype, ...]


def step_graph(system: Any, params: Params, kinds: list[str], state: State, control: Any) -> StepGraph:
    """The graph of `system.step`.

    Args:
      system: with the structured engine.
      params: one rover's, tables of every rover's own with their first axis. kinds: of its leaves, see `traced`.
      state, control: one rover's, the state in pieces.
    """
    input_roles = ["input"] * (len(jax.tree.leaves((state, control))))
    graph, results, _, entries = traced(
        lambda x: system.step(x[0], x[1], x[2])[0], (params, state, control), kinds + input_roles
    )
    first = len(kinds)
    count = len(jax.tree.leaves(state))

    def numbers(some: list[Any]) -> tuple[int, ...]:
        return tuple(n.params for e in some if e is not None and e.dtype == object for n in e.reshape(-1))

    inputs = [e for e, kind in zip(entries, kinds + input_roles, strict=True) if kind == "input"]
    dtypes = tuple(n.dtype for e in inputs for n in e.reshape(-1))
    new = tuple(x for r in results for x in np.asarray(r).reshape(-1))
    of_params = numbers([e for e, k in zip(entries[:first], kinds, strict=True) if k == "input"])
    held = of_params + numbers(entries[first + count :])
    return StepGraph(graph, numbers(entries[first : first + count]), held, new, dtypes)


def evaluate(
    step: StepGraph, inputs: dict[int, Any], load: Callable[[int, Any], Any], shape: tuple[int, ...]
) -> list[Any]:
    """The new state of a block of rovers: arrays of `shape`, from those of every input; `load` reads a table."""
    values: dict[int, Any] = {}
    constants: dict[Any, Any] = {}

    def read(arg: Any) -> Any:
        if isinstance(arg, Node):
            return values[id(arg)]
        key = arg.dtype.str, arg.tobytes()
        if key not in constants:
            constants[key] = jnp.full(shape, arg, arg.dtype)
        return constants[key]

    for node in needed(list(step.new)):
        if node.op == "input":
            values[id(node)] = inputs[node.params]
        elif node.op == "load":
            values[id(node)] = load(node.params, read(node.args[0]))
        else:
            primitive, params = step.graph.primitive(node)
            values[id(node)] = primitive.bind(*(read(a) for a in node.args), **params)
    return [read(x) for x in step.new]
