"""The MJX engine's loops: solved at once, with every bit of float32."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx._quiet import mjx
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.mjx import MjxEngine, solve_equalities
from lunar_mjx.model import make_model
from lunar_mjx.rover import load_rover


@pytest.fixture(scope="module")
def engine():
    return MjxEngine(load_rover("viper"), 0.002)


def _cast(tree):
    return jax.tree.map(lambda a: jnp.asarray(a, float) if getattr(a, "dtype", np.dtype(int)).kind == "f" else a, tree)


def test_loops_are_solved_as_by_the_line_search(engine):
    """From states whose loops are open by millimetres, in float64."""
    with jax.enable_x64(True):
        m, data = _cast(engine._mjx), _cast(engine._data)

        @jax.jit
        def both(qpos, qvel, torque):
            d = data.replace(qpos=qpos, qvel=qvel, qfrc_applied=torque)
            d = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, d)))
            d = mjx.make_constraint(m, mjx.factor_m(m, mjx.crb(m, mjx.tendon(m, d))))
            d = mjx.fwd_acceleration(m, mjx.fwd_velocity(m, mjx.transmission(m, d)))
            found = [solve(m, d) for solve in (mjx.solve, solve_equalities)]
            return [(f.qacc, f.qfrc_constraint, f._impl.efc_force) for f in found]

        rng = np.random.default_rng(0)
        for _ in range(3):
            qpos = np.array(engine.qpos0)
            qpos[7:] += 0.01 * rng.normal(size=len(qpos) - 7)
            theirs, ours = both(qpos, 0.1 * rng.normal(size=engine.nv), 5.0 * rng.normal(size=engine.nv))
            for a, b in zip(theirs, ours, strict=True):
                assert np.abs(np.asarray(a)).max() > 1.0
                assert float(jnp.abs(a - b).max() / jnp.abs(a).max()) < 1e-10


def test_products_keep_all_bits():
    """A GPU shortens the factors of a matrix product to ten bits unless it is told not to."""
    system = build(make_model("viper", "flat"), "mjx")
    control = jnp.zeros(len(system.joint_names))
    state = jax.eval_shape(lambda: system.reset(system.params))
    text = str(jax.make_jaxpr(lambda p, s: system.step(p, s, control)[0])(system.params, state))
    assert text.count("dot_general[") > 50 and text.count("Precision.HIGHEST") >= text.count("dot_general[")
    assert "precision=None" not in text
