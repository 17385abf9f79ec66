"""A test process gives back what JAX keeps of programs, and what it then computes is the same."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import pytest

from tests.memory import give_back, held

PROGRAMS, PRODUCTS = 3, 60
"""Programs, and matrix products that each is long: some megabytes of code each."""


def chain(number: int):
    @jax.jit
    def program(x):
        for i in range(PRODUCTS):
            x = jnp.tanh(x @ x + float(number + i))
        return x

    return program


@pytest.mark.skipif(not held(), reason="no kernel tells what a process holds")
def test_programs_are_given_back_beyond_a_limit_and_compute_the_same_again():
    programs = [chain(n) for n in range(PROGRAMS)]
    x = jnp.eye(3)
    first = [p(x) for p in programs]
    full = held()
    give_back(math.inf)
    assert all(p._cache_size() for p in programs), "nothing is given back below the limit"
    give_back(0.0)
    assert not any(p._cache_size() for p in programs)
    assert held() < full
    for p, before in zip(programs, first, strict=True):
        assert (p(x) == before).all()


def test_every_file_of_tests_ends_with_it(request: pytest.FixtureRequest):
    assert "memory" in request.fixturenames
