"""Ruts shared by rovers of one world: a wheel that follows another, a lone one, two that dig, and the soil's mass."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.effects.soil.ruts import PATCH, cell_numbers, tile_of
from lunar_mjx.effects.soil.shared_ruts import SharedGround, exchange, shared_ground
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from tests.effects.test_ruts import CELL, DT, _program, _start

EVERY, PARTS = 25, 100
GROUND = ((-4.0, -2.0), (8.0, 2.0))


@functools.cache
def _together(shared: bool) -> Any:
    """Wheels side by side in a batch, told what to do for half a second at a time; ground exchanged in between."""
    wheel = _program()

    def part(carry: Any, told: Any) -> Any:
        state, ground = carry
        state, seen = jax.vmap(wheel)(state, told)
        if shared:
            ground, ruts = exchange(ground, state[4], state[2], 0.0 * state[2])
            state = (*state[:4], ruts)
        return (state, ground), seen

    return jax.jit(lambda carry, told: jax.lax.scan(part, carry, told))


def _drive(at: list[float], world: list[int], speed: float, rim: float, shared: bool = True) -> Any:
    """The shared ground and, by name, (wheel, step) of sinkage and rut met, for wheels that start at places."""
    count = len(at)
    state = jax.tree.map(lambda a: jnp.broadcast_to(a, (count, *a.shape)), _start())
    ground = shared_ground(state[4], jnp.asarray(world), *GROUND, CELL)
    state = (*state[:2], jnp.asarray(at, jnp.float32), *state[3:])
    place = np.asarray(at)[:, None] + speed * DT * np.arange(EVERY * PARTS)
    given = (place, *(np.full_like(place, v) for v in (speed, rim, 0.0, 0.0)))
    told = tuple(jnp.asarray(v.reshape(count, PARTS, EVERY).swapaxes(0, 1), jnp.float32) for v in given)
    (state, ground), seen = _together(shared)((state, ground), told)
    sinkage, rut = (np.asarray(seen[k]).swapaxes(0, 1).reshape(count, -1) for k in (2, 3))
    return state, ground, place, sinkage, rut


def test_a_rover_that_follows_meets_the_ruts_of_the_one_ahead() -> None:
    """A metre behind, in the same world and in another; without sharing it meets none."""
    at, world = [1.0, 0.0, 0.0], [0, 0, 1]
    _, ground, place, sinkage, rut = _drive(at, world, 0.04, 0.05)
    # the first half metre of the way is the leader's start, whose sinkage still changes
    late = (place[1] > 1.4) & (place[1] < 1.9)
    ahead = (place[0] > 1.4) & (place[0] < 1.9)
    assert rut[1][late].mean() == pytest.approx(0.8 * sinkage[0][ahead].mean(), rel=0.05)
    assert np.abs(rut[[0, 2]]).max() < 1e-3
    assert 1.08 < sinkage[1][late].mean() / sinkage[2][late].mean() < 1.41
    moved = np.asarray(ground.moved)
    assert np.abs(moved).sum(axis=(1, 2)).min() > 0.0
    assert np.abs(moved.sum(axis=(1, 2))).max() < 1e-4 * np.abs(moved).sum()
    alone = _drive(at, world, 0.04, 0.05, shared=False)[4]
    assert np.abs(alone).max() < 1e-3


def test_a_lone_rover_notices_no_exchange() -> None:
    """It drives two metres, half a patch: what it was told is what it did."""
    one, other = (_drive([0.0, 0.0, 0.0], [0, 1, 2], 0.04, 0.05, shared) for shared in (True, False))
    np.testing.assert_allclose(one[3], other[3], atol=1e-6)


def test_two_that_dig_at_one_place_dig_one_hole() -> None:
    """What both carried away adds up, to the mass; each then knows the whole hole."""
    state, ground, *_ = _drive([0.0, 0.0, 3.0], [0, 0, 0], 0.0, 0.05)
    moved, pressed = np.asarray(ground.moved[0]), np.asarray(ground.pressed[0])
    assert np.abs(moved.sum()) < 1e-4 * np.abs(moved).sum()
    assert moved.min() < -1e-3 and pressed.max() > 1e-3
    cells = np.asarray(state[4]["moved"])
    np.testing.assert_array_equal(cells[0], cells[1])
    # the third, too far off for the patches to meet, dug half as much
    first = -ground.first[0] + round(1.5 / CELL)
    left, right = np.abs(moved[:, :first]).sum(), np.abs(moved[:, first:]).sum()
    assert 1.2 < left / right < 2.2


@pytest.mark.slow
def test_a_whole_rover_that_follows_meets_the_ruts_of_the_one_ahead() -> None:
    """LUVMI-X under `field`, 1.2 m behind another: it sinks deeper and slips less than one in a world of its own."""
    model = make_model("luvmi_x", "flat", "field").add("ruts")
    system = build(model)
    wheels = model.rover.wheels
    state = jax.jit(jax.vmap(lambda x: system.reset(system.params, x)))(jnp.array([1.2, 0.0, 0.0]))
    cell = model.parameters["ruts"]["cell"] * float(np.mean([w.width for w in wheels]))
    ground = shared_ground(state.effects["ruts"], jnp.array([0, 0, 1]), (-3.0, -3.0), (6.0, 3.0), cell)
    drives = np.array([1.0 if g.name == "drive" else 0.0 for g in model.rover.groups for _ in g.joints])
    told = jnp.broadcast_to(jnp.asarray(drives * 0.2 / wheels[0].radius, jnp.float32), (3, 5, len(drives)))

    def part(carry: Any, _: Any) -> Any:
        state, ground = carry
        state, seen = system.rollout_batch(
            system.params, state, told, 50, report=lambda t: (t.position.x, t.sinkage, t.slip)
        )
        ground, ruts = exchange(ground, state.effects["ruts"], state.qpos[:, 0], state.qpos[:, 1])
        return (dataclasses.replace(state, effects={**state.effects, "ruts": ruts}), ground), seen

    (_, ground), seen = jax.jit(lambda c: jax.lax.scan(part, c, length=12))((state, ground))
    # (rover, tenth of a second, wheel), front wheels first
    x, sinkage, slip = (np.moveaxis(np.asarray(a), 1, 0).reshape(3, 60, *a.shape[3:]) for a in seen)
    follows, alone = 1, 2
    sinkage, slip = sinkage[..., :2], slip[..., :2]
    before = x[follows] < 0.2
    np.testing.assert_allclose(sinkage[follows][before], sinkage[alone][before], atol=1e-5)
    late = slice(50, 60)
    assert 1.08 < sinkage[follows, late].mean() / sinkage[alone, late].mean() < 1.41
    assert slip[follows, late].mean() < 0.8 * slip[alone, late].mean()
    moved = np.asarray(ground.moved)
    assert np.abs(moved.sum(axis=(1, 2))).max() < 1e-4 * np.abs(moved).sum()


def test_every_slot_holds_the_cell_nearest_to_the_rover() -> None:
    u, v = np.random.default_rng(0).uniform(-1000.0, 1000.0, (2, 50)).astype(np.float32)
    i, j = (np.asarray(n) for n in cell_numbers(tile_of(jnp.asarray(u), jnp.asarray(v))))
    assert i.shape == (50, PATCH.side * PATCH.side)
    assert np.abs(i + 0.5 - u[:, None]).max() <= 0.5 * PATCH.side + 1e-3
    assert np.abs(j + 0.5 - v[:, None]).max() <= 0.5 * PATCH.side + 1e-3
    slots = np.mod(i, PATCH.side) + PATCH.side * np.mod(j, PATCH.side)
    np.testing.assert_array_equal(slots, np.broadcast_to(np.arange(PATCH.side * PATCH.side), slots.shape))


def test_beyond_the_shared_ground_ruts_stay_with_the_rover() -> None:
    state = jax.tree.map(lambda a: a[None], _start())
    ground = shared_ground(state[4], jnp.zeros(1, int), (0.0, 0.0), (1.0, 1.0), CELL)
    assert isinstance(ground, SharedGround)
    here = tile_of(jnp.asarray([-10.0]), jnp.asarray([0.0]))
    ruts = {
        "moved": jnp.ones((1, PATCH.side * PATCH.side)),
        "pressed": jnp.ones((1, PATCH.side * PATCH.side)),
        "tile": here,
    }
    ground, new = exchange(ground, ruts, jnp.asarray([-10.0 * CELL]), jnp.asarray([0.0]))
    assert 0 < np.asarray(ground.moved).sum() < PATCH.side * PATCH.side  # of the patch a part lies on it
    np.testing.assert_array_equal(new["moved"], ruts["moved"])


@pytest.mark.parametrize(("low", "high", "cell"), [((0, 0), (-1, 1), 0.1), ((0, 0), (1, 1), 0.0)])
def test_bad_ground_is_refused(low: tuple[float, float], high: tuple[float, float], cell: float) -> None:
    with pytest.raises(UserError, match="shared ruts"):
        shared_ground(jax.tree.map(lambda a: a[None], _start())[4], jnp.zeros(1, int), low, high, cell)
