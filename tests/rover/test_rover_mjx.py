"""Every shipped rover in MJX: it loads, steps in float32, agrees with native MuJoCo, and its loops stay closed."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx
from rover_ground import CREEP, DAMPING, FRICTION, STIFFNESS, loop_errors

from lunar_mjx.rover import Rover

STEPS = 1500  # 3 s
LOOP_ERROR = 1e-4  # m


def _run(rover: Rover) -> tuple[mujoco.MjModel, Any]:
    """Drives over bumps in one compiled scan; returns the poses of all bodies at every step, (step, body, ...)."""
    model = rover.compile()
    mx = mjx.put_model(model)
    wheels = np.array([model.body(w.body).id for w in rover.wheels])
    radius = jnp.array([w.radius for w in rover.wheels])
    dofs = {g.name: np.array([model.joint(j).dofadr[0] for j in g.joints]) for g in rover.groups}
    gains = {g.name: (g.position_gain, g.velocity_gain) for g in rover.groups}

    def step(data: mjx.Data, _: None) -> tuple[mjx.Data, Any]:
        def torque(name: str, target: jax.Array | float, speed: jax.Array | float = 0.0) -> jax.Array:
            kp, kd = gains[name]
            q, v = data.qpos[dofs[name] + 1], data.qvel[dofs[name]]
            return kp * (target - q) + kd * (speed - v)

        t = data.time
        ctrl = [
            torque("drive", 0.0, 0.8 * jnp.minimum(t, 1.0)),
            torque("steer", 0.3 * jnp.sin(2 * t) * jnp.array([1, 1, -1, -1])),
            torque("suspension", 0.2 * jnp.sin(2 * t) * jnp.array([1, -1, -0.5, 0.5])),
        ]
        center = data.xpos[wheels]
        # cvel is about the tree's centre of mass; moved to the contact point.
        spin, speed = data.cvel[wheels, :3], data.cvel[wheels, 3:]
        arm = jnp.stack([jnp.zeros(4), jnp.zeros(4), -radius], 1)
        sliding = speed + jnp.cross(spin, center + arm - data.subtree_com[1])
        ground = 0.06 * jnp.sin(6 * center[:, 0]) * (center[:, 1] > 0) * jnp.minimum(t, 1)
        depth = radius + ground - center[:, 2]
        load = jnp.where(depth > 0, jnp.maximum(STIFFNESS * depth - DAMPING * sliding[:, 2], 0.0), 0.0)
        force = (-FRICTION * load[:, None] * jnp.tanh(sliding / CREEP)).at[:, 2].set(load)
        wrench = jnp.concatenate([force, jnp.cross(arm, force)], 1)
        data = data.replace(ctrl=jnp.concatenate(ctrl), xfrc_applied=jnp.zeros((model.nbody, 6)).at[wheels].set(wrench))
        data = mjx.step(mx, data)
        return data, (data.xpos, data.xmat, data.qpos)

    data = mjx.make_data(mx)
    data = data.replace(qpos=data.qpos.at[2].set(rover.standing_height))
    _, history = jax.jit(lambda d: jax.lax.scan(step, d, None, STEPS))(data)
    return model, jax.tree.map(np.asarray, history)


@pytest.fixture(scope="module")
def drive(rover: Rover) -> tuple[mujoco.MjModel, Any]:
    return _run(rover)


def test_steps_without_nan_in_float32(rover: Rover, drive: tuple[mujoco.MjModel, Any]) -> None:
    _, (_, _, qpos) = drive
    assert qpos.dtype == np.float32
    assert np.isfinite(qpos).all()
    assert 0.05 < qpos[-1, 0] < 2.0  # it went forward
    assert qpos[-1, 2] == pytest.approx(rover.standing_height, abs=0.1)


@pytest.mark.slow
def test_accelerations_agree_with_native_mujoco(rover: Rover) -> None:
    """One solve in each engine from the same moving state, with closed loops; float32 against float64."""
    model = rover.compile()
    native = mujoco.MjData(model)
    random = np.random.default_rng(1)
    native.qvel[:] = random.normal(size=model.nv) * 0.1
    native.ctrl[:] = random.normal(size=model.nu) * 10
    if rover.loops:  # a parallelogram: the upper arm turns with the lower, the upright by the opposite angle
        for wheel in rover.wheels:
            rate = native.joint(wheel.suspension).qvel[0]
            native.joint(f"{wheel.corner}_upper_pivot").qvel[:] = rate
            native.joint(f"{wheel.corner}_upright_pivot").qvel[:] = -rate
    mx = mjx.put_model(model)
    start = mjx.make_data(mx).replace(qvel=jnp.array(native.qvel), ctrl=jnp.array(native.ctrl))
    ours = jax.jit(lambda d: mjx.forward(mx, d))(start)
    mujoco.mj_forward(model, native)
    scale = np.abs(native.qacc).max()
    np.testing.assert_allclose(np.asarray(ours.qacc), native.qacc, atol=1e-3 * scale)


def test_loops_stay_closed_in_float32(rover: Rover, drive: tuple[mujoco.MjModel, Any]) -> None:
    model, (xpos, xmat, _) = drive
    errors = [e for i in range(0, STEPS, 5) for e in loop_errors(rover, model, xpos[i], xmat[i])]
    print(f"{rover.name}: worst loop error {1e3 * max(errors, default=0.0):.4f} mm")
    assert max(errors, default=0.0) < LOOP_ERROR
    assert bool(errors) == bool(rover.loops)
