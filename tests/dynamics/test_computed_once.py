"""Costly intermediate values are computed once on CPUs, with the same results and derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics.batching.computed_once import computed_once
from lunar_mjx.dynamics.reverse import reversible


def _many_readers(x, table):
    """A chain of products that many results read, a look-up, a sum over legs, an unused value, a nested jit."""
    y = x
    for k in range(30):
        y = y * x + 0.1 * k * x
    y = jax.jit(lambda a: a * (1.0 - a * x))(y)
    _unused = jnp.exp(y)
    seen = table[jnp.clip((3.0 * y).astype(int), 0, 3)]
    legs = jnp.sum(y[None] * jnp.arange(1.0, 5.0)[:, None], axis=0)
    return {"parts": [y * (x + k) - y for k in range(12)], "legs": legs, "seen": seen, "same": x}


@pytest.fixture(scope="module")
def inputs():
    return jnp.linspace(0.1, 0.9, 256), jnp.array([1.0, 2.0, 4.0, 8.0])


def test_results_are_equal_at_a_fraction_of_the_arithmetic(inputs):
    plain, once = (jax.jit(f).lower(*inputs).compile() for f in (_many_readers, computed_once(_many_readers)))
    for a, b in zip(*(jax.tree.leaves(f(*inputs)) for f in (plain, once)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-5)
    assert once.cost_analysis()["flops"] < 0.5 * plain.cost_analysis()["flops"]


@pytest.mark.optimised
def test_derivatives_and_maps_are_those_of_the_function(inputs):
    x, table = inputs

    def number(function):
        return lambda x, t: sum(jnp.sum(jnp.sin(a)) for a in jax.tree.leaves(function(x, t)))

    plain, once = number(_many_readers), number(computed_once(_many_readers))
    for change in (jax.grad, jax.jacfwd, lambda f: jax.vmap(f, in_axes=(0, None))):
        batch = jnp.stack([x, 0.5 * x]) if change not in (jax.grad, jax.jacfwd) else x[:200]
        ours, theirs = (jax.jit(change(f))(batch, table) for f in (once, plain))
        np.testing.assert_allclose(ours, theirs, rtol=1e-4)


def test_other_devices_get_the_function_itself(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert computed_once(_many_readers) is _many_readers


def test_reverse_mode_of_a_loop_keeps_its_arguments_only(inputs):
    """Whole numbers in the state, tables and several results; the gradient is that of the plain loop."""
    x, table = inputs

    def step(scale, state, table):
        made = _many_readers(0.5 * scale * state["x"], table)
        return {"x": state["x"] - 1e-3 * made["legs"] - 1e-4 * sum(made["parts"]), "count": state["count"] + 1}

    def end(one):
        def run(scale, table):
            start = {"x": x, "count": jnp.zeros((), jnp.int32)}
            last = jax.lax.scan(lambda s, _: (one(scale, s, table), None), start, length=5)[0]
            return jnp.sum(last["x"] ** 2) + 0.0 * last["count"]

        return jax.jit(jax.grad(run, argnums=(0, 1)))

    ours, theirs = (end(f)(jnp.asarray(1.1), table) for f in (reversible(step), step))
    for a, b in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4)
    assert abs(float(ours[0])) > 1e-3
