"""The structured engine inside the whole step: against MJX with soil, batches, derivatives, choice of the engine."""

import dataclasses
import logging
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import structured_models as made

from lunar_mjx.dynamics import Params, System, build
from lunar_mjx.dynamics.engines import make_engine
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.terrain import inclined, stack


def _controls(system, steps):
    """Drive with a little steering, (time, joint)."""
    names = [g.name for g in system.model.rover.groups for _ in g.joints]
    time = np.linspace(0.0, 1.0, steps)[:, None]
    base = np.array([1.0 if n == "drive" else 0.0 for n in names])
    steer = np.array([0.2 if n == "steer" else 0.0 for n in names])
    return jnp.asarray(base + steer * np.sin(2 * np.pi * time), jnp.result_type(float))


def _starts(system, count):
    x = jnp.linspace(-4.0, 4.0, count)
    return jax.jit(jax.vmap(lambda x, y: system.reset(system.params, x, y)))(x, 0.5 * x)


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
def test_drives_with_soil_agree_with_mjx(rover):
    """20 s with soil, motors and heat: the difference stays within the noise floor of float32, found by moving the
    start by one unit in the last place. VIPER's loops are soft in MJX: the floor there is their sag."""
    model = make_model(rover, preset="consistent")
    ends = {}
    for engine, shift in (("structured", 0.0), ("structured", 1.0), ("mjx", 0.0)):
        system = build(model, engine)
        state = jax.jit(system.reset)(system.params, 0.0, 0.0)
        moved = state.qpos.at[2].multiply(1.0 + shift * np.finfo(np.float32).eps)
        state = dataclasses.replace(state, qpos=moved)
        run = jax.jit(lambda s, c, system=system: system.rollout(system.params, s, c, every=100))
        _, seen = run(state, _controls(system, 100))
        ends[engine, shift] = np.stack(seen.position, axis=-1), np.asarray(seen.winding_temperature)
    ours, near, theirs = ends["structured", 0.0], ends["structured", 1.0], ends["mjx", 0.0]
    travelled = np.linalg.norm(ours[0][-1] - ours[0][0])
    floor = np.abs(ours[0] - near[0]).max()
    assert travelled > 1.0
    assert np.abs(ours[0] - theirs[0]).max() < (20.0 * floor + 1e-4 if rover == "luvmi_x" else 5e-3 * travelled)
    assert np.abs(ours[1] - theirs[1]).max() < 0.05


@pytest.mark.slow
def test_one_step_agrees_with_mjx_in_float32():
    model = make_model("luvmi_x")
    new = {}
    for engine in ("structured", "mjx"):
        system = build(model, engine)
        # MJX compiles faster than it runs operation by operation, the structured engine does not
        step = jax.jit(system.step) if engine == "mjx" else system.step
        new[engine] = step(system.params, jax.jit(system.reset)(system.params), _controls(system, 3)[1])
    for a, b in zip(*(jax.tree.leaves(v) for v in new.values()), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-4 * max(1.0, float(jnp.abs(b).max())))


@pytest.mark.parametrize(
    "chunk",
    [
        pytest.param(None, marks=pytest.mark.slow),
        pytest.param(4, marks=pytest.mark.slow),
        pytest.param(3, marks=pytest.mark.slow),
    ],
)
def test_batches_equal_single_rovers(chunk):
    """Batch last inside, chunks that do and do not divide the batch, terrains and parameters per rover."""
    system = build(make_model("viper", terrain=inclined(0.1)))
    count = 8
    grounds = stack([inclined(0.02 * i) for i in range(count)])
    grounds = dataclasses.replace(grounds, name=system.params.terrain.name)
    effects = {**system.params.effects}
    effects["soil"] = {**effects["soil"], "cohesion": jnp.linspace(100.0, 300.0, count)}
    params = Params(jnp.linspace(1.0, 2.0, count), system.params.ambient, effects, jax.tree.map(jnp.asarray, grounds))
    shared = {name: dict.fromkeys(values) for name, values in effects.items()}
    shared["soil"]["cohesion"] = 0
    axes = Params(0, None, shared, 0)
    per_rover = jax.tree.broadcast(jax.tree.map(lambda a: a is not None, axes, is_leaf=lambda a: a is None), params)
    start = jax.jit(jax.vmap(lambda x: system.reset(system.params, x)))(jnp.linspace(-1.0, 1.0, count))
    controls = jnp.broadcast_to(_controls(system, 5), (count, 5, len(system.joint_names)))
    end, seen = jax.jit(lambda s, c: system.rollout_batch(params, s, c, every=2, params_axes=axes, chunk=chunk))(
        start, controls
    )
    step, _ = jax.jit(lambda s, c: system.step_batch(params, s, c, axes, chunk))(start, controls[:, 0])
    single = jax.jit(system.step)
    for i in (0, 5, 7):
        own = jax.tree.map(lambda a, mine, i=i: a[i] if mine else a, params, per_rover)
        states, reports = [jax.tree.map(lambda a, i=i: a[i], start)], []
        for control in np.repeat(controls[i], 2, axis=0):
            new, report = single(own, states[-1], control)
            states.append(new)
            reports.append(report)
        alone = (states[-1], jax.tree.map(lambda *rows: jnp.stack(rows), *reports[::2])), states[1]
        together = jax.tree.map(lambda a, i=i: a[i], ((end, seen), step))
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4 * max(1.0, float(jnp.abs(b).max())))


def test_rollout_holds_controls_and_reports_their_first_step():
    """What the test above asks of batches, for one rover: the reference there goes step by step."""

    def step(params, state, control):
        return params * state + control, (state, control)

    controls = jnp.array([1.0, 5.0, 2.0])
    for every in (1, 3):
        end, seen = System.rollout(SimpleNamespace(step=step), 0.5, jnp.asarray(8.0), controls, every)
        states = [8.0]
        for control in np.repeat(controls, every):
            states.append(0.5 * states[-1] + float(control))
        assert float(end) == states[-1]
        np.testing.assert_array_equal(seen, (states[:-1:every], controls))


def test_batches_refuse_axes_that_differ():
    system = build(make_model("luvmi_x"))
    state = _starts(system, 3)
    with pytest.raises(UserError, match="do not agree with the 3 rovers"):
        system.step_batch(system.params, state, jnp.zeros((2, len(system.joint_names))))


def _three_steps(system, state, control, params):
    """A number of the state after three steps, run op by op: compiling reverse mode takes minutes on a CPU."""
    for _ in range(3):
        state, _ = system.step(params, state, control)
    return state.qvel @ jnp.linspace(1.0, 2.0, state.qvel.shape[0])


def _settled(system, params):
    """A rover that has come to rest, so that no wheel lands within the steps to differentiate."""
    still = jnp.zeros((1, len(system.joint_names)))
    return jax.jit(lambda s: system.rollout(params, s, still, every=500)[0])(system.reset(params))


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["viper", "luvmi_x"])
def test_derivatives_agree_with_finite_differences(rover):
    """Forward and reverse mode through three steps on smooth ground, in float64."""
    with jax.enable_x64(True):
        system = build(make_model(rover, terrain=inclined(0.1)), "structured")
        control = _controls(system, 1)[0]
        state = _settled(system, system.params)

        def end(scale):
            effects = {**system.params.effects}
            effects["soil"] = {**effects["soil"], "k_phi": effects["soil"]["k_phi"] * scale}
            effects["motor"] = {**effects["motor"], "torque_constant": effects["motor"]["torque_constant"] * scale}
            params = dataclasses.replace(system.params, effects=effects, gravity=system.params.gravity * scale)
            return _three_steps(system, state, control, params)

        one = jnp.asarray(1.0)
        _, forward = jax.jvp(end, (one,), (one,))
        reverse = jax.grad(end)(one)
        h = 1e-5
        central = (end(one + h) - end(one - h)) / (2 * h)
        forward, reverse, central = float(forward), float(reverse), float(central)
    assert abs(forward) > 1e-6
    assert abs(forward - reverse) < 1e-9 * abs(forward)
    assert abs(forward - central) < 1e-6 * max(abs(forward), 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["viper", "luvmi_x"])
def test_gradients_are_finite_in_float32(rover):
    """Reverse mode by every parameter, for a rover that lands, on terrain with craters and boulders."""
    system = build(make_model(rover), "structured")
    state, control = jax.jit(system.reset)(system.params), _controls(system, 1)[0]
    gradient = jax.grad(lambda p: _three_steps(system, state, control, p), allow_int=True)(system.params)
    leaves = jax.tree.leaves((gradient.gravity, gradient.effects))
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in leaves)
    assert any(bool((leaf != 0.0).any()) for leaf in leaves)


@pytest.mark.slow
def test_loops_stay_closed_over_ten_minutes():
    """VIPER's pins after 300,000 steps in float32: the loop error is that of rounding one angle."""
    import mujoco

    system = build(make_model("viper"))
    engine = system.engine
    state = jax.jit(system.reset)(system.params)
    run = jax.jit(lambda s, c: system.rollout(system.params, s, c, every=5000)[0])
    state = run(state, _controls(system, 60))
    data = mujoco.MjData(engine.mj_model)
    data.qpos[:] = np.asarray(state.qpos, np.float64)
    mujoco.mj_forward(engine.mj_model, data)
    assert np.abs(data.efc_pos).max() < 1e-5


def test_auto_takes_structured_and_says_why_not(tmp_path, caplog):
    assert build(make_model("viper")).engine.name == "structured"
    rover = made.spider(tmp_path, 3, links=1)
    text = rover.mjcf.read_text().replace("</worldbody>", '</worldbody><equality><joint joint1="l0_drive"/></equality>')
    rover.mjcf.write_text(text)
    with caplog.at_level(logging.WARNING):
        assert make_engine(rover).name == "mjx"
    assert "joint equality" in caplog.text and len(caplog.records) == 1
    with pytest.raises(UserError, match="does not exist"):
        make_engine(rover, "warp")
