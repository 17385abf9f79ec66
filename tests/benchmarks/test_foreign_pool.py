"""Work over processes: what fails, dies or takes too long ends nothing else."""

from __future__ import annotations

import os
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
        time.sleep(60.0)
    return job.upper()


def test_a_case_that_raises_or_kills_its_process_ends_nothing_else():
    processes = pool.Pool(1, nothing)
    try:
        jobs = ["a", "raises", "dies", "b", "c", "d"]
        found = dict(processes.answers(answer, iter(jobs), time.monotonic() + 60.0))
    finally:
        processes.end()
    assert set(found) == set(jobs)
    assert found["a"] == "A" and isinstance(found["raises"], ValueError)
    assert isinstance(found["dies"], BrokenProcessPool) and found["d"] == "D"


def test_answers_end_when_the_time_is_up():
    processes = pool.Pool(1, nothing)
    begun = time.monotonic()
    try:
        assert list(processes.answers(answer, ["waits"], begun + 2.0)) == []
    finally:
        processes.end()
    assert time.monotonic() - begun < 30.0


def test_a_limit_is_no_error_that_a_case_can_catch():
    with pytest.raises(pool.TooLong), pool.limit(0.05):
        try:
            time.sleep(5.0)
        except Exception:
            pytest.fail("caught")
    with pool.limit(0.5):
        pass
