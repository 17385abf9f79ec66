"""Ruts that stay, under one wheel with a quarter of VIPER's mass: passes, a trench, and the mass of the soil."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.soil.ruts import PATCH
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import flat
from tests.effects.ruts_harness import DT, GRAVITY, MASS, RADIUS, WIDTH, Wheels, fresh_patch

CELL = 0.3 * WIDTH
STEPS = 6000


@functools.cache
def _program() -> Any:
    wheels = Wheels(1)
    field = jax.tree.map(jnp.asarray, flat(20.0).field)
    zero = 0.0 * wheels.one

    def step(carry: Any, told: Any) -> Any:
        z, v_z, x, v_x, ruts = carry
        place, speed, rim, free, pull = told
        x, v_x = jnp.where(free > 0.5, x, place), jnp.where(free > 0.5, v_x, speed)
        at = Vec3(x * wheels.one, zero, z * wheels.one)
        done, new, force = wheels.forces(field, at, v_x, v_z, rim, ruts)
        v_z = v_z + DT * (force.z[0] / MASS - GRAVITY)
        v_x = v_x + DT * (force.x[0] - pull) / MASS
        moved = new["moved"]
        seen = (z, x, done.contact.sinkage[0], done.soil.rut[0], moved.sum(), jnp.abs(moved).sum(), force.x[0])
        return (z + DT * v_z, v_z, x + DT * v_x, v_x, new), seen

    return jax.jit(lambda start, told: jax.lax.scan(step, start, told))


def _start() -> Any:
    return (*(jnp.asarray(v) for v in (RADIUS - 0.025, 0.0, 0.0, 0.0)), fresh_patch())


def _drive(start: Any, speed: Any, rim: Any, at: float = 0.0, free: float = 0.0, pull: float = 0.0) -> Any:
    """The end, and height, place, sinkage, rut met, sums of soil moved and of its size, and pull, over time."""
    speed, rim = (np.broadcast_to(v, (STEPS,)).astype(np.float32) for v in (speed, rim))
    place = at + np.concatenate([[0.0], np.cumsum(speed[:-1]) * DT]).astype(np.float32)
    told = [jnp.asarray(np.broadcast_to(v, (STEPS,)), jnp.float32) for v in (place, speed, rim, free, pull)]
    end, seen = _program()(start, tuple(told))
    return end, dict(zip(("z", "x", "sinkage", "rut", "sum", "size", "pull"), map(np.asarray, seen), strict=True))


def test_the_way_back_meets_the_rut() -> None:
    """Out on virgin soil, back in one's own rut, out again: deeper by 15 and 10 %; it pulls better.

    Published ruts deepen as n^(1/a), a from 2 (loose) to 5 (firm) and beyond: 1.08 to 1.41 for the second pass.
    """
    third = STEPS // 3
    sign = np.repeat([1.0, -1.0, 1.0], third)
    _, seen = _drive(_start(), 0.04 * sign, 0.05 * sign)
    middle = [slice(k * third + third // 3, k * third + 2 * third // 3) for k in range(3)]
    depth = [seen["sinkage"][m].mean() for m in middle]
    assert np.abs(seen["rut"][middle[0]]).max() < 1e-3
    assert 1.08 < depth[1] / depth[0] < 1.41
    assert 1.0 < depth[2] / depth[1] < depth[1] / depth[0]
    pull = [s * seen["pull"][m].mean() for s, m in zip((1.0, -1.0, 1.0), middle, strict=True)]
    assert pull[1] > pull[0] + 0.005 * MASS * GRAVITY


def test_a_spinning_wheel_digs_a_trench_and_mass_is_kept() -> None:
    """Two minutes in place at 5 cm/s: 2 cm deeper, ever slower; no soil is made or lost."""
    _, seen = _drive(_start(), 0.0, 0.05)
    sunk = seen["z"][0] - seen["z"][:: STEPS // 4]
    assert seen["z"][250] - seen["z"][-1] > 0.015
    late = np.diff(seen["z"][[250, 2000, 4000, STEPS - 1]])
    assert (late < 0.0).all() and abs(late[-1]) < abs(late[0]), sunk
    assert seen["size"][-1] * CELL**2 > 1e-3 * 0.2
    assert abs(seen["sum"][-1]) < 0.01 * seen["size"][-1]


def test_a_standing_wheel_changes_nothing() -> None:
    """Neither pressed nor dug, it stands where it stood."""
    end, seen = _drive(_start(), 0.0, 0.0)
    assert float(jnp.abs(end[4]["pressed"]).max()) == 0.0 and seen["size"][-1] == 0.0
    assert abs(seen["z"][-1] - seen["z"][STEPS // 2]) < 1e-6


def test_cells_one_patch_on_are_new() -> None:
    """What lies 64 cells away has the same address and is not taken for it."""
    end, _ = _drive(_start(), 0.03, 0.0375)
    _, again = _drive(end, 0.03, 0.0375, at=PATCH.side * CELL)
    assert np.abs(again["rut"][500:2000]).max() < 1e-3
    _, back = _drive(end, 0.03, 0.0375)
    assert back["rut"][500:2000].min() > 0.01


def test_a_wheel_that_has_dug_in_is_stuck_and_rocks_free() -> None:
    """Against 30 N: on virgin soil it drives off; in its trench it stays for two minutes; rocking frees it.

    A minute of rocking at 8 cm/s, forwards and backwards every 1.5 s, and on at the 5 cm/s that did not help before.
    """
    trench, _ = _drive(_start(), 0.0, 0.05)
    time = np.arange(STEPS) * DT
    rocking = np.where(time < 60.0, 0.08 * np.sign(np.sin(2.0 * np.pi * time / 3.0)), 0.05)
    virgin, steady, rocked = (
        _drive(start, 0.0, rim, free=1.0, pull=30.0)[1]["x"][-1]
        for start, rim in ((_start(), 0.05), (trench, 0.05), (trench, rocking))
    )
    assert virgin > 3.0 and steady < 0.1 and rocked > 0.5
