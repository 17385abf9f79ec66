"""A rollout as one kernel, run by CuPy on the arrays of JAX."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.one_kernel.cuda_source import cuda_source
from lunar_mjx.dynamics.one_kernel.step_graph import StepGraph, step_graph
from lunar_mjx.dynamics.state import Params, State


class KernelRollout:
    """Many steps of many rovers under one control, in one kernel per call.

    Attributes:
      step: the graph of one step.
      source: CUDA C.
      rows: the inputs of a batch, shape (entry, rover), from its state and controls; whole numbers by their bits.
      state: the batch from the kernel's rows.

    Args:
      system: with the structured engine.
      params: as for `System.step_batch`; what all rovers share is built into the kernel and must be known.
      params_axes: as for `System.step_batch`; leaves of more than two axes become tables of every rover's own.
      block: rovers per block. blocks: of them that a multiprocessor should hold. options: of the compiler.

    Raises:
      UnsupportedError: the step holds an operation that a kernel cannot.
    """

    def __init__(
        self,
        system: Any,
        params: Params,
        params_axes: Any = None,
        block: int = 128,
        blocks: int = 1,
        options: tuple[str, ...] = (),
    ):
        leaves, treedef = jax.tree.flatten(params)
        flags = jax.tree.map(lambda a: a is not None, params_axes, is_leaf=lambda a: a is None)
        own = jax.tree.leaves(jax.tree.broadcast(flags, params))
        kinds = ["known" if not o else "table" if a.ndim > 2 else "input" for o, a in zip(own, leaves, strict=True)]
        one = [leaf[0] if kind == "input" else leaf for leaf, kind in zip(leaves, kinds, strict=True)]
        start = jax.tree.map(np.asarray, system.reset(system.params))
        qpos, qvel = system.engine.split(start.qpos, start.qvel)
        self._single = dataclasses.replace(start, qpos=qpos, qvel=qvel)
        control = np.zeros(len(system.joint_names), np.float32)
        self.step: StepGraph = step_graph(system, jax.tree.unflatten(treedef, one), kinds, self._single, control)
        self.source = cuda_source(self.step, block, blocks)
        self._varying = [leaf for leaf, kind in zip(leaves, kinds, strict=True) if kind == "input"]
        self._system, self._block, self._options = system, block, options
        self._kernel: Any = None
        self.rows = jax.jit(self._rows)
        self.state = jax.jit(self._state)

    def _rows(self, state: State, control: Any) -> Any:
        """All inputs, shape (entry, rover), whole numbers by their bits."""
        split = jax.vmap(self._system.engine.split)(state.qpos, state.qvel)
        pieces = dataclasses.replace(state, qpos=split[0], qvel=split[1])
        batch = state.step.shape[0]
        rows = [
            jnp.moveaxis(leaf.reshape(batch, -1), 1, 0) for leaf in jax.tree.leaves((self._varying, pieces, control))
        ]
        return jnp.concatenate(
            [r if r.dtype == jnp.float32 else jax.lax.bitcast_convert_type(r, jnp.float32) for r in rows]
        )

    def _state(self, rows: Any) -> State:
        """The batch's state from the kernel's rows."""
        leaves, treedef = jax.tree.flatten(self._single)
        new, at = [], 0
        for leaf in leaves:
            size = int(np.prod(leaf.shape))
            part = jnp.moveaxis(rows[at : at + size], 0, 1).reshape(rows.shape[1], *leaf.shape)
            new.append(part if leaf.dtype == np.float32 else jax.lax.bitcast_convert_type(part, leaf.dtype))
            at += size
        pieces = jax.tree.unflatten(treedef, new)
        qpos, qvel = jax.vmap(self._system.engine.join)(pieces.qpos, pieces.qvel)
        return dataclasses.replace(pieces, qpos=qpos, qvel=qvel)

    def compile(self) -> None:
        """Compiles the kernel for the GPU at hand."""
        import cupy  # pyright: ignore[reportMissingImports]

        if self._kernel is None:
            self._kernel = cupy.RawKernel(self.source, "rollout", options=self._options)
            self._kernel.compile()
            self._tables = [cupy.asarray(np.asarray(t.values).reshape(-1)) for t in self.step.graph.tables]

    @property
    def registers(self) -> int:
        """Of a thread."""
        self.compile()
        return self._kernel.num_regs

    @property
    def spilled(self) -> int:
        """Bytes of a thread's memory besides its registers."""
        self.compile()
        return self._kernel.local_size_bytes

    def run_rows(self, rows: Any, steps: int) -> Any:
        """The state's rows after `steps` steps, CuPy arrays both."""
        import cupy  # pyright: ignore[reportMissingImports]

        self.compile()
        batch = rows.shape[1]
        out = cupy.empty((len(self.step.state), batch), np.float32)
        grid = (-(-batch // self._block),)
        arguments = (rows, out, np.int32(batch), np.int32(steps), *self._tables)
        self._kernel(grid, (self._block,), arguments)
        return out

    def __call__(self, state: State, control: Any, steps: int) -> State:
        """The state after `steps` steps.

        Args:
          state: with a leading batch axis, on the GPU.
          control: (batch, joint) targets, held.
          steps: number of steps.
        """
        import cupy  # pyright: ignore[reportMissingImports]

        rows = cupy.from_dlpack(jax.block_until_ready(self.rows(state, control)))
        out = self.run_rows(rows, steps)
        cupy.cuda.get_current_stream().synchronize()
        return self.state(jnp.from_dlpack(out))
