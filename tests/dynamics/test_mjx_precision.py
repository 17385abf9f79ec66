"""Engines and cameras keep every bit of float32, on a GPU too; MJX gets what it leaves out of a loop."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lunar_mjx._quiet import mjx
from lunar_mjx.cameras import Pinhole, front_mount
from lunar_mjx.cameras.raymarch import depth_image, mounted
from lunar_mjx.cameras.shapes import body_poses
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.mjx import MjxEngine, _cast
from lunar_mjx.model import make_model
from lunar_mjx.rover import load_rover


def test_products_keep_all_bits():
    """A GPU shortens the factors of a matrix product to ten bits unless it is told not to."""
    system = build(make_model("viper", "flat"), "mjx")
    control = jnp.zeros(len(system.joint_names))
    state = jax.eval_shape(lambda: system.reset(system.params))
    text = str(jax.make_jaxpr(lambda p, s: system.step(p, s, control)[0])(system.params, state))
    assert text.count("dot_general[") > 50 and text.count("Precision.HIGHEST") >= text.count("dot_general[")
    assert "precision=None" not in text


def test_a_rover_is_set_down_and_seen_with_all_bits():
    system = build(make_model("luvmi_x", "lunar_plain", preset="field"))
    control = jnp.zeros(len(system.joint_names))
    camera = Pinhole(width=4, height=3)

    def drive_and_look(params):
        state, _ = system.step(params, system.reset(params), control)
        places, turns = body_poses(system.model.rover, state.qpos)
        picture = depth_image(params.terrain, places[1], turns[1], camera)
        return picture, mounted(front_mount(system.model.rover), state.qpos)

    text = str(jax.make_jaxpr(drive_and_look)(system.params))
    products = text.count("dot_general[")
    assert products >= 4 and text.count("Precision.HIGHEST") == 2 * products, "one for each factor"


def test_loops_accelerate_at_given_speeds_as_in_native_mujoco():
    """J' v of VIPER's pins in float64: MJX leaves it out of the reference acceleration, MuJoCo takes it away there."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        engine = MjxEngine(load_rover("viper"))
        engine.mj_model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        native = mujoco.MjData(engine.mj_model)
        data = jax.tree.map(lambda a: _cast(a, float), engine._data)
        m = engine._mjx

        @jax.jit
        def bias(qpos, qvel):
            d = data.replace(qpos=qpos, qvel=qvel)
            return engine._pins.bias(mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, d))))

        for _ in range(3):
            native.qpos[:] = engine.qpos0 + 0.2 * rng.normal(size=engine.nq)
            native.qpos[3:7] /= np.linalg.norm(native.qpos[3:7])
            native.qvel[:] = rng.normal(size=engine.nv)
            mujoco.mj_forward(engine.mj_model, native)
            stiffness, damping, impedance = native.efc_KBIP.T[:3]
            speed = native.efc_J.reshape(-1, engine.nv) @ native.qvel
            expected = -damping * speed - stiffness * impedance * native.efc_pos - native.efc_aref
            found = np.asarray(bias(native.qpos, native.qvel))
            assert np.abs(expected).max() > 0.1
            np.testing.assert_allclose(found, expected, atol=1e-9)
