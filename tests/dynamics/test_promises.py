"""What a long or a large run promises: the same bits in any place of a batch, sound states after a million steps."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import psutil
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model

pytestmark = pytest.mark.slow

STEPS, BATCH = 500, 64
ULPS = 40
"""Largest difference after 500 steps between batches of different sizes, in units in the last place of each quantity's
size or of one (measured: 12 for 48 of 64 VIPERs in float32, 9 for 33 of 64 LUVMI-X in float64)."""
MILLION, PIECES = 1_000_000, 50


@pytest.fixture(scope="module", params=["luvmi_x", "viper"])
def system(request):
    return build(make_model(request.param))


def _control(system, drive: float = 1.0, steer: float = 0.1) -> np.ndarray:
    values = {"drive": drive, "steer": steer}
    return np.array([values.get(g.name, 0.0) for g in system.model.rover.groups for _ in g.joints], np.float32)


def _rovers(system, count: int):
    """Rovers on different ground, driven differently: states and (rover, joint) controls."""
    place = jnp.linspace(-4.0, 4.0, count)
    state = jax.jit(jax.vmap(lambda x: system.reset(system.params, x, 0.5 * x, 0.3 * x)))(place)
    control = jnp.asarray(_control(system))[None] * jnp.linspace(0.5, 1.5, count)[:, None]
    return state, control


def _after(system):
    """A function from states and controls to the states after `STEPS` steps."""

    def run(state, control):
        controls = jnp.broadcast_to(control[:, None], (len(control), 1, control.shape[1]))
        return system.rollout_batch(system.params, state, controls, every=STEPS, report=lambda t: None, one_body=True)[
            0
        ]

    return jax.jit(run)


def _take(tree, which):
    return jax.tree.map(lambda a: a[which], tree)


def _largest_gap(one, other) -> tuple[float, str]:
    """Largest difference of a leaf, relative to its largest value, or to one; and the leaf's name."""
    gaps = {
        jax.tree_util.keystr(path): np.abs(np.asarray(a, np.float64) - np.asarray(b, np.float64)).max()
        / max(1.0, float(np.abs(b).max()))
        for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(other), strict=True)
    }
    worst = max(gaps, key=lambda name: gaps[name])
    return gaps[worst], worst


def test_a_rover_moves_alike_wherever_it_stands_in_a_batch(system):
    state, control = _rovers(system, BATCH)
    run = _after(system)
    end = run(state, control)
    assert float(jnp.abs(end.qpos[:, :2] - state.qpos[:, :2]).max()) > 0.05
    order = np.random.default_rng(0).permutation(BATCH)
    moved = run(_take(state, order), control[order])
    for a, b in zip(jax.tree.leaves(_take(end, order)), jax.tree.leaves(moved), strict=True):
        np.testing.assert_array_equal(a, b)
    again = run(state, control)
    for a, b in zip(jax.tree.leaves(end), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("count", [1, 7, 33, 48])
def test_the_size_of_a_batch_matters_as_rounding_does(system, count):
    """Every size is a program of its own, in which the compiler fuses other products and sums into one rounding."""
    assert _gap_of_sizes(system, count) < ULPS * np.finfo(np.float32).eps


def test_in_double_precision_the_size_matters_as_its_rounding_does():
    """A gap that shrinks with the precision holds nothing but rounding."""
    with jax.enable_x64(True):
        assert _gap_of_sizes(build(make_model("luvmi_x")), 33) < ULPS * np.finfo(np.float64).eps


def _gap_of_sizes(system, count: int) -> float:
    """Largest gap between the first rovers of a whole batch and the same rovers in a batch of their own."""
    state, control = _rovers(system, BATCH)
    run = _after(system)
    whole = _take(run(state, control), slice(count))
    part = run(_take(state, slice(count)), control[:count])
    gap, where = _largest_gap(part, whole)
    print(f"{system.model.rover.name}, {count} of {BATCH}, {part.qpos.dtype}: {gap:.1e} in {where}")
    return gap


def test_a_million_steps_keep_the_memory_and_the_quaternion():
    """LUVMI-X drives circles for 2,000 s."""
    system = build(make_model("luvmi_x", "flat"))
    state = jax.jit(system.reset)(system.params)
    controls = jnp.asarray(_control(system, 1.0, 0.3))[None]
    run = jax.jit(lambda s: system.rollout(system.params, s, controls, every=MILLION // PIECES)[0])
    process, used, errors = psutil.Process(), [], []
    for _ in range(PIECES):
        state = jax.block_until_ready(run(state))
        used.append(process.memory_info().rss)
        errors.append(abs(float(np.linalg.norm(np.asarray(state.qpos[3:7], np.float64))) - 1.0))
    assert int(state.step) == MILLION
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(state))
    assert max(errors) < 1e-6
    # the first pieces fill caches
    assert used[-1] - used[PIECES // 10] < 10e6
    moved = dataclasses.replace(state, step=state.step * 0)
    assert float(jnp.linalg.norm(run(moved).qpos[:2] - state.qpos[:2])) > 0.01, "it still drives"
