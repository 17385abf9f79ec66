"""Rows of drives that have been simulated lately, so that a program simulates none of them twice."""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from lunar_mjx.inference.observations import Observations

MOST_BYTES = 2**30
"""Memory that simulated rows may take; those not asked for longest go first. (A diagnosis of eight drives of 10 s
simulates 1,300 to 1,700 rows on a GPU, 0.4 GB and more; with half of this one simulated its first rows once more.)"""

Key = tuple[Any, ...]


class Simulated:
    """Simulated rows by everything that they depend on.

    Args:
      most: bytes of rows that are kept.
    """

    def __init__(self, most: int = MOST_BYTES):
        self._most, self._bytes = most, 0
        self._rows: OrderedDict[Key, np.ndarray] = OrderedDict()
        self._lock = threading.Lock()

    def __contains__(self, key: Key) -> bool:
        return key in self._rows

    def clear(self) -> None:
        """Forgets all."""
        with self._lock:
            self._rows.clear()
            self._bytes = 0

    def get(self, key: Key) -> np.ndarray | None:
        """(n,) the row, or None."""
        with self._lock:
            row = self._rows.get(key)
            if row is not None:
                self._rows.move_to_end(key)
            return row

    def keep(self, key: Key, row: np.ndarray) -> None:
        """Remembers a copy of a row (n,)."""
        if row.nbytes > self._most:
            return
        with self._lock:
            if key in self._rows:
                return
            # A view would keep the whole batch in memory, uncounted.
            self._rows[key] = row.copy()
            self._bytes += row.nbytes
            while self._bytes > self._most:
                _, old = self._rows.popitem(last=False)
                self._bytes -= old.nbytes


def stamp(*given: Any) -> bytes:
    """Of numbers, arrays and pytrees of them; names in a pytree count, too."""
    digest = hashlib.sha256()
    leaves, tree = jax.tree.flatten(given)
    digest.update(repr(tree).encode())
    for leaf in leaves:
        array = np.asarray(leaf)
        # Bytes alone do not tell a row from a column, nor whole numbers from real ones.
        digest.update(f"{array.dtype} {array.shape} ".encode())
        # Bytes of objects are addresses, which say nothing of what lies there.
        digest.update(array.tobytes() if array.dtype.kind in "biuf" else repr(leaf).encode())
    return digest.digest()


def stamp_of_observations(observations: Observations) -> bytes:
    """Where predictions are sampled, and the measured angles next to which they are counted."""
    series = [(s.log, s.channel, s.start, s.stop, np.asarray(s.time)) for s in observations.series]
    return stamp(observations.value, series)


def keys_of_rows(stamp: Key, names: Sequence[Any], table: np.ndarray) -> list[Key]:
    """Keys of rows (k, values) with the names of their columns."""
    first = hashlib.sha256(repr(names).encode()).digest()
    return [(*stamp, first, hashlib.sha256(row.tobytes()).digest()) for row in np.ascontiguousarray(table)]
