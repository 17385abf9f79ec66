"""Calls of several threads joined into one batch: refits of many candidates then cost the time of one."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np


class Gather:
    """Holds calls back until every thread that takes part waits in one, then makes one call for all.

    Args:
      function: of (k, coordinates) rows, returning (k, n).
      parties: threads that take part; each must call `leave` when it is done.

    Attributes:
      parties: threads that still take part.
    """

    def __init__(self, function: Callable[[np.ndarray], np.ndarray], parties: int):
        self._function, self.parties = function, parties
        self._condition = threading.Condition()
        self._waiting: list[_Call] = []

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        call = _Call(rows)
        with self._condition:
            self._waiting.append(call)
            self._run_if_complete()
            while call.result is None and call.error is None:
                self._condition.wait()
        if call.error is not None:
            raise call.error
        assert call.result is not None
        return call.result

    def leave(self) -> None:
        """A thread makes no more calls."""
        with self._condition:
            self.parties -= 1
            self._run_if_complete()

    def _run_if_complete(self) -> None:
        if not self._waiting or len(self._waiting) < self.parties:
            return
        calls, self._waiting = self._waiting, []
        try:
            values = self._function(np.concatenate([c.rows for c in calls]))
            at = 0
            for c in calls:
                c.result = values[at : at + len(c.rows)]
                at += len(c.rows)
        except BaseException as error:
            for c in calls:
                c.error = error
        self._condition.notify_all()


class _Call:
    def __init__(self, rows: np.ndarray):
        self.rows = rows
        self.result: np.ndarray | None = None
        self.error: BaseException | None = None
