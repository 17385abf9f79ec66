"""Work over processes: what fails, dies or takes too long ends nothing else."""

from __future__ import annotations

import os
import threading
import time
from concurrent.futures.process import BrokenProcessPool

import pytest

from benchmarks.foreign import pool


def nothing() -> None:
    """Called in each process first."""


def answer(job: str) -> str:
    if job == "raises":
        raise ValueError(job)
    if job == "dies":
        os._exit(1)
    if job == "waits":
        threading.Event().wait()
    return job.upper()


def test_a_case_that_raises_or_kills_its_process_ends_nothing_else():
    processes = pool.Pool(1, nothing)
    try:
        jobs = ["a", "raises", "dies", "b", "c", "d"]
        found = dict(processes.answers(answer, iter(jobs), time.monotonic() + 1e6))
    finally:
        processes.end()
    assert set(found) == set(jobs)
    assert found["a"] == "A" and isinstance(found["raises"], ValueError)
    assert isinstance(found["dies"], BrokenProcessPool) and found["d"] == "D"


def test_answers_end_when_the_time_is_up():
    processes = pool.Pool(1, nothing)
    try:
        assert list(processes.answers(answer, ["waits"], time.monotonic() + 0.5)) == []
        begun = list(processes._pool._processes.values())
    finally:
        processes.end()
    for process in begun:
        process.join()  # would wait for ever for one that still answers


def test_a_limit_is_no_error_that_a_case_can_catch():
    with pytest.raises(pool.TooLong), pool.limit(0.05):
        try:
            threading.Event().wait()
        except Exception:
            pytest.fail("caught")
    with pool.limit(3600.0):
        pass
