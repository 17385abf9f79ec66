"""Energy: a dropped rover never gains any, and a batch gives what single rovers give."""

from __future__ import annotations

import dataclasses

import jax
import mujoco
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model
from lunar_mjx.terrain.soil.named import SOILS
from tests.dynamics.conftest import bench, plane


def soil_energy(rover, sinkage: np.ndarray, steps: int = 400) -> np.ndarray:
    """Work stored by the normal stress under each wheel, J: the closed form's load integrated over the sinkage."""
    soil = SOILS["lunar_nominal"]
    total = np.zeros(sinkage.shape[:-1])
    for i, wheel in enumerate(rover.wheels):
        z = sinkage[..., i, None] * (np.arange(steps) + 0.5) / steps
        theta = 0.5 * np.arccos(1.0 - np.minimum(z / wheel.radius, 1.5))
        a = (2 * np.cos(theta) - np.cos(2 * theta) - 1) / np.maximum(theta, 1e-9)
        depth = wheel.radius * (np.cos(theta) - np.cos(2 * theta))
        load = wheel.radius * wheel.width * (soil["k_c"] / wheel.width + soil["k_phi"]) * depth ** soil["n"] * a
        total += (load * sinkage[..., i, None] / steps).sum(-1)
    return total


def mechanical_energy(model: mujoco.MjModel, qpos: np.ndarray, qvel: np.ndarray) -> float:
    """Kinetic energy, weight and joint springs, J, by MuJoCo."""
    data = mujoco.MjData(model)
    data.qpos, data.qvel = qpos, qvel
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy.sum())


def test_energy_never_grows_in_a_drop() -> None:
    """Dropped from 0.3 m with free joints, rover, springs and soil together only lose energy."""
    model = make_model("luvmi_x", "flat", modes={"drive": "torque", "steer": "torque", "suspension": "torque"})
    model = model.set("motor", rotor_inertia=9e-7).set("shear_state", damping_time=0.0)
    system = build(model)
    state = jax.jit(system.reset)(system.params)
    state = dataclasses.replace(state, qpos=state.qpos.at[2].add(0.3).at[3:7].set(np.array([0.9994, 0.02, 0.028, 0.0])))
    control = np.zeros(len(system.joint_names))

    def step(s, _):
        new, seen = system.step(system.params, s, control)
        return new, (s.qpos, s.qvel, seen.sinkage)

    qpos, qvel, sinkage = jax.device_get(jax.jit(lambda s: jax.lax.scan(step, s, length=2500)[1])(state))
    compiled = model.rover.compile()
    compiled.dof_armature[:] = _armature(system)
    energy = np.array([mechanical_energy(compiled, q, v) for q, v in zip(qpos, qvel, strict=True)])
    whole = energy + soil_energy(model.rover, sinkage)
    fall = 0.3 * model.rover.mass * model.gravity
    assert sinkage.max() > 0.02  # it did land
    # up to the first order of the time step, the energy at any time is the largest that ever follows
    assert (whole[1:] - np.minimum.accumulate(whole)[:-1]).max() < 0.02 * fall
    assert whole[-1] < whole[0] - 0.9 * fall
    # rebounds never reach the height of the drop
    assert qpos[600:, 2].max() < qpos[0, 2] - 0.2


def _armature(system) -> np.ndarray:
    motor = system.params.effects["motor"]
    armature = np.zeros(system.engine.nv)
    reflected = np.asarray(motor["rotor_inertia"] * motor["gear_ratio"] ** 2) * np.ones(len(system.joint_names))
    model = system.model.rover.compile()
    for joint, value in zip(system.joint_names, reflected, strict=True):
        armature[model.joint(joint).dofadr[0]] = value
    return armature


@pytest.mark.slow
def test_a_batch_gives_what_single_rovers_give() -> None:
    """Rovers on different terrains in one batch move as each would alone."""
    b = bench("luvmi_x")
    grounds = [plane(0.0), plane(8.0, 20.0), plane(-6.0, 70.0)]
    commands = np.tile(b.control(0.7, 0.1), (20, 1))
    together, _ = b.drive(grounds, b.stand(grounds), commands, 50)
    for i, ground in enumerate(grounds):
        alone, _ = b.drive([ground], b.stand([ground]), commands, 50)
        np.testing.assert_allclose(together.qpos[i], alone.qpos[0], atol=2e-5)
    assert np.abs(together.qpos[1] - together.qpos[0]).max() > 0.01


@pytest.mark.parametrize("gravity", [1.625, 3.71])
def test_weight_follows_gravity(gravity: float) -> None:
    """Gravity is a parameter of the run, and the ground carries the weight that it gives."""
    b = bench("luvmi_x")
    grounds = [plane(0.0)]
    _, seen = b.drive(grounds, b.stand(grounds), np.tile(b.control(), (60, 1)), 50, gravity=gravity)
    load = seen.wheel_force.z[0, -1].sum()
    assert load == pytest.approx(b.model.rover.mass * gravity, rel=5e-3)
