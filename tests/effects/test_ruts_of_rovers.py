"""Ruts under the four wheels of one rover: what follows rolls in them, mass is kept, NumPy says the same."""

from __future__ import annotations

import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.backends.physics.contact import rim_plane, wheel_contact
from lunar_mjx.backends.physics.ground import Grid
from lunar_mjx.backends.physics.ruts import relief_of, ruts, untouched
from lunar_mjx.backends.physics.soil import uniform_soil
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.soil.ruts import PATCH
from lunar_mjx.model import make_model
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import flat
from tests.effects.ruts_harness import DT, GRAVITY, MASS, RADIUS, WIDTH, Wheels, fresh_patch

FORE = np.array([0.50037, 0.50037, -0.49963, -0.49963])
ABREAST = np.array([0.513, -0.487, 0.513, -0.487])
"""No point of a wheel lies on the border of a cell, where rounding would decide."""
SPEED, RIM = 0.05, 0.0625


@functools.cache
def _program() -> Any:
    wheels = Wheels(4)

    def step(carry: Any, told: Any) -> Any:
        z, v_z, memory = carry
        x, y = told
        field = flat(20.0, dtype=float).field
        done, memory, force = wheels.forces(field, Vec3(x, y, z), SPEED, v_z, RIM, memory)
        faster = v_z + DT * (force.z / MASS - GRAVITY)
        seen = {"z": z, "v_z": v_z, "sinkage": done.contact.sinkage, "pull": force.x}
        seen |= {k: getattr(done.soil, k) for k in ("k_phi", "cohesion", "tan_phi", "shear_modulus_x", "rut")}
        return (z + DT * faster, faster, memory), seen

    return jax.jit(lambda start, told: jax.lax.scan(step, start, told))


@functools.cache
def _drive(steps: int, shift: float = 0.0) -> Any:
    """Straight ahead, rear wheels `shift` m beside the front ones' tracks: the patch at the end, and what was seen."""
    start = (jnp.full(4, RADIUS - 0.025), jnp.zeros(4), fresh_patch())
    x = FORE + SPEED * DT * np.arange(steps)[:, None]
    y = np.broadcast_to(ABREAST + np.where(FORE < 0.0, shift, 0.0), x.shape)
    (_, _, patch), seen = _program()(start, (jnp.asarray(x), jnp.asarray(y)))
    return jax.tree.map(np.asarray, patch), {"x": x, "y": y} | {k: np.asarray(v) for k, v in seen.items()}


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def test_rear_wheels_roll_in_the_ruts_of_the_front_ones():
    """Nothing under the front wheels; e z_u under the rear ones, which sink deeper and pull better."""
    _, seen = _drive(2500)
    late = slice(1500, 2500)
    front, rear = seen["sinkage"][late, :2].mean(), seen["sinkage"][late, 2:].mean()
    assert np.abs(seen["rut"][late, :2]).max() < 1e-3 * front
    np.testing.assert_allclose(seen["rut"][late, 2:].mean(), 0.8 * front, rtol=0.05)
    assert 1.08 < rear / front < 1.41
    assert seen["pull"][late, 2:].mean() > seen["pull"][late, :2].mean() + 0.005 * MASS * GRAVITY
    # left and right see the same ground, cell by cell: their places differ within a cell of 6 cm
    np.testing.assert_allclose(seen["sinkage"][late, 0].mean(), seen["sinkage"][late, 1].mean(), rtol=0.02)


def test_rear_wheels_beside_the_ruts_meet_virgin_soil():
    _, seen = _drive(2500, shift=0.5)
    late = slice(1500, 2500)
    assert np.abs(seen["rut"][late]).max() < 1e-3 * seen["sinkage"][late].mean()
    np.testing.assert_allclose(seen["sinkage"][late, 2:].mean(), seen["sinkage"][late, :2].mean(), rtol=0.02)


def test_mass_is_kept_under_four_wheels():
    """What is taken from cells is given to others; pressed soil stays in its cell and is denser."""
    patch, _ = _drive(1500)
    assert np.abs(patch["moved"]).sum() > 1e-3
    assert abs(patch["moved"].sum()) < 1e-9 * np.abs(patch["moved"]).sum()


def test_native_mujoco_drives_with_ruts():
    """A rover of the NumPy backends leaves ruts, and forgets them at reset."""
    model = make_model("luvmi_x", "flat", "field").add("ruts")
    assert "multipass" not in model.effect_names
    backend = NativeBackend(model, rovers=2)
    command = np.array([4.0 * (g.name == "drive") for g in model.rover.groups for _ in g.joints])
    for _ in range(200):
        backend.step(command)
    patch = backend.state().effects["ruts"]
    assert patch["pressed"].shape == (2, PATCH.side * PATCH.side)
    assert (patch["pressed"].max(axis=1) > 1e-3).all() and np.isfinite(patch["moved"]).all()
    np.testing.assert_array_equal(patch["pressed"][0], patch["pressed"][1])
    assert backend.reset().effects["ruts"]["pressed"].max() == 0.0


def test_numpy_says_the_same():
    """Contact, soil and patch of a drive, step by step, in plain NumPy."""
    steps = 1500
    patch, seen = _drive(steps)
    field = flat(20.0, dtype=float).field
    grid, one = Grid(field.heights, field.x0, field.y0, field.cell), np.ones((1, 4))
    p = SimpleNamespace(**CATALOGUE["ruts"].nominal())
    nominal = SimpleNamespace(**CATALOGUE["soil"].nominal())
    state = untouched(1)
    for k in range(steps):
        place, velocity = np.zeros((1, 4, 3)), np.zeros((1, 4, 3))
        place[0, :, 0], place[0, :, 1], place[0, :, 2] = seen["x"][k], seen["y"][k], seen["z"][k]
        velocity[0, :, 0], velocity[0, :, 2] = SPEED, seen["v_z"][k]
        c: Any = SimpleNamespace(
            dt=DT,
            wheel_position=place,
            wheel_axle=np.broadcast_to([0.0, 1.0, 0.0], place.shape),
            wheel_velocity=velocity,
            wheel_angular_velocity=np.broadcast_to([0.0, RIM / RADIUS, 0.0], place.shape),
            geometry={"radius": RADIUS * one, "width": WIDTH * one, "toe": 0.0 * one},
        )
        relief = relief_of(c, p, state)
        c.contact = wheel_contact(c, *rim_plane(c, grid, relief.height), one > 0.0)
        np.testing.assert_allclose(c.contact["sinkage"][0], seen["sinkage"][k], rtol=1e-9, atol=1e-13)
        soil = uniform_soil(nominal, one)
        state = ruts(c, p, soil, state)
        for name in ("k_phi", "cohesion", "tan_phi", "shear_modulus_x", "rut"):
            np.testing.assert_allclose(soil[name][0], seen[name][k], rtol=1e-9, atol=1e-12, err_msg=name)
    for name, wanted in patch.items():
        np.testing.assert_allclose(state[name][0], wanted, rtol=1e-9, atol=1e-13, err_msg=name)
