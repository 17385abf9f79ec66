"""Picks and places entries at addresses known when the step is traced: slices, never gathers or scatters."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def select(array: Any, at: np.ndarray) -> Any:
    """`array[at]` along the only axis, as one strided slice where `at` is an arithmetic progression."""
    at = np.asarray(at)
    stride = int(at[1] - at[0]) if len(at) > 1 else 1
    first, last = int(at[0]), int(at[-1])
    # The whole array in order: no operation at all.
    if len(at) == array.shape[0] and stride == 1 and first == 0 and np.all(np.diff(at) == 1):
        return array
    if stride > 0 and np.all(np.diff(at) == stride):
        return jax.lax.slice(array, (first,), (last + 1,), (stride,))
    # Irregular addresses are rare (a rover whose joints are listed out of order) and short: one slice each still fuses,
    # a gather would not.
    return jnp.concatenate([jax.lax.slice(array, (int(i),), (int(i) + 1,)) for i in at])


def assemble(pieces: list[Any], at: list[np.ndarray]) -> Any:
    """One array whose entries `at[k]` are `pieces[k]`; the addresses fill the array without gaps.

    Runs of entries that lie side by side stay one operand of the concatenation; pieces that interleave regularly are
    stacked and flattened.
    """
    if not pieces:
        return jnp.zeros((0,))
    if len(pieces) == 1 and np.all(np.diff(at[0]) == 1):
        return pieces[0]
    starts = sorted(range(len(pieces)), key=lambda k: int(at[k][0]))
    runs: list[Any] = []
    while starts:
        block = _interleaved(starts, at)
        if block is None:
            break
        size = len(block)
        joined = pieces[block[0]] if size == 1 else jnp.stack([pieces[k] for k in block], axis=1).reshape(-1)
        runs.append(joined)
        starts = starts[size:]
    else:
        return runs[0] if len(runs) == 1 else jnp.concatenate(runs)
    source_of = {int(a): (k, i) for k, places in enumerate(at) for i, a in enumerate(places)}
    return jnp.concatenate([jax.lax.slice(pieces[k], (i,), (i + 1,)) for _, (k, i) in sorted(source_of.items())])


def _interleaved(starts: list[int], at: list[np.ndarray]) -> list[int] | None:
    """The pieces that together fill a run of addresses, each with a stride of their number; None if there are none."""
    first = at[starts[0]]
    stride = int(first[1] - first[0]) if len(first) > 1 else 1
    block = starts[:stride]
    if stride < 1 or len(block) < stride:
        return None
    for offset, k in enumerate(block):
        places = at[k]
        if len(places) != len(first) or np.any(places != first[0] + offset + stride * np.arange(len(first))):
            return None
    return block
