"""Work spread over processes of one core each, until the time is up; what fails or takes too long ends nothing else."""

from __future__ import annotations

import concurrent.futures as futures
import contextlib
import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures.process import BrokenProcessPool
from typing import Any


class TooLong(BaseException):
    """A case took longer than its limit; no `except Exception` of what is asked holds it up."""


def prepare() -> None:
    """Sets this process and its children up to compute on one core; before anything of the tool is imported."""
    os.environ["OMP_NUM_THREADS"] = "1"
    flags = os.environ.get("XLA_FLAGS", "")
    if "multi_thread_eigen" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1".strip()


@contextlib.contextmanager
def limit(seconds: float) -> Iterator[None]:
    """Raises `TooLong` in this process's main thread after so many seconds of wall time; 0: no limit."""

    def end(*_: Any) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, end)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def silent() -> None:
    """Drops what this process prints."""
    sys.stdout = sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


class Pool:
    """Processes that are started anew where one of them dies.

    Args:
      processes: number. begin, arguments: called in each process first.
    """

    def __init__(self, processes: int, begin: Callable[..., None], *arguments: Any) -> None:
        self.processes = processes
        self._begin = (begin, arguments)
        self._start()

    def _start(self) -> None:
        begin, arguments = self._begin
        context = multiprocessing.get_context("spawn")
        self._pool = futures.ProcessPoolExecutor(self.processes, context, begin, arguments)

    def end(self) -> None:
        """Kills the processes."""
        for process in list((self._pool._processes or {}).values()):
            process.kill()
        self._pool.shutdown(wait=False, cancel_futures=True)

    def answers(self, do: Callable[..., Any], jobs: Iterable[Any], until: float) -> Iterator[tuple[Any, Any]]:
        """Jobs and what `do` says of each, as they come; an exception where it raised one or its process died.

        Args:
          do: of one job. jobs: to be done in their order. until: `time.monotonic` after which no answer is waited for.
        """
        rest, waiting = iter(jobs), {}
        while time.monotonic() < until:
            # Few jobs wait in the pool's own queue, so that it can be ended at once.
            while len(waiting) < self.processes + 1 and (job := next(rest, None)) is not None:
                waiting[self._pool.submit(do, job)] = job
            if not waiting:
                return
            done, _ = futures.wait(waiting, max(until - time.monotonic(), 0.0), futures.FIRST_COMPLETED)
            broken = False
            for future in done:
                job, error = waiting.pop(future), future.exception()
                broken |= isinstance(error, BrokenProcessPool)
                yield job, error if error is not None else future.result()
            if broken:
                # All jobs under way are lost with the process that died: which of them killed it is not known.
                yield from ((job, BrokenProcessPool("a process died")) for job in waiting.values())
                waiting.clear()
                self.end()
                self._start()


def told(answers: Iterable[tuple[Any, Any]], name: Callable[[Any], str]) -> Iterator[Any]:
    """Answers that are not None; a job that failed is printed by its name and ends no other."""
    for job, answer in answers:
        if isinstance(answer, BaseException):
            print(f"{name(job)} failed: {type(answer).__name__}: {answer}", flush=True)
        elif answer is not None:
            yield answer
