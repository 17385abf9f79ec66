"""Reverse-mode derivatives of whole drives, compiled within a minute and with little memory.

The backward pass of a step reads most values of the forward pass, and XLA for CPUs would compute chains of them again
in every kernel: compiling a step's backward pass took more than five minutes. Here it is one function of the step's
arguments, in which every costly value is computed once (`computed_once`), and a loop over steps keeps nothing but the
states between them: checkpointing (Griewank & Walther 2008, ch. 12) with a checkpoint at every step.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.dynamics.batching.computed_once import computed_once


def reversible(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function's equal whose backward pass is one function of the arguments.

    Args:
      function: a pure function of pytrees of arrays, such as one from factors on parameters, state and control to the
        next state. What is differentiated has to be among its arguments; whole numbers get no derivative.

    Returns:
      The function, for `jax.grad` and `jax.vjp`; JAX takes no forward mode of it.
    """
    once = computed_once(function)

    @jax.custom_vjp
    def run(*args: Any) -> Any:
        return once(*args)

    def forward(*args: Any) -> Any:
        return once(*args), args

    def backward(args: Any, given: Any) -> Any:
        leaves, tree = jax.tree.flatten(args)
        # Step counters are whole numbers, of which JAX takes no derivative.
        real = [i for i, leaf in enumerate(leaves) if _is_real(leaf)]

        def pull(leaves: list[Any], given: list[Any]) -> Any:
            def of_real(*moved: Any) -> list[Any]:
                filled = list(leaves)
                for i, value in zip(real, moved, strict=True):
                    filled[i] = value
                return [out for out in jax.tree.leaves(function(*jax.tree.unflatten(tree, filled))) if _is_real(out)]

            return jax.vjp(of_real, *(leaves[i] for i in real))[1](given)

        gradients = computed_once(pull)(leaves, [g for g in jax.tree.leaves(given) if g.dtype != jax.dtypes.float0])
        cotangents: list[Any] = [None] * len(leaves)
        for i, value in zip(real, gradients, strict=True):
            cotangents[i] = value
        return jax.tree.unflatten(tree, cotangents)

    run.defvjp(forward, backward)
    return run


def _is_real(array: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(array), jnp.inexact))
