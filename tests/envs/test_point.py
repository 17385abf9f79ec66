"""The physics-free environment, and making environments by name."""

from __future__ import annotations

from importlib import metadata

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs import PointEnv, make, make_agent, register, registry, split_keys
from lunar_mjx.envs.contract import check_environment
from lunar_mjx.envs.core import side_by_side
from lunar_mjx.errors import UserError


def test_keeps_the_contract_of_environments():
    check_environment(PointEnv(episode_steps=7), steps=20)


def test_final_observation_is_the_true_successor():
    env = PointEnv(episode_steps=3)
    step = jax.jit(env.step)
    state = env.reset(env.params, split_keys(jax.random.PRNGKey(0), 64))
    action = jnp.full((64, 2), 0.5)
    for i in range(3):
        new = step(env.params, state, action)
        moved = jnp.clip(state.obs[:, :2] + 0.05, -1.5, 1.5)
        np.testing.assert_allclose(new.final_obs[:, :2], moved, atol=1e-6)
        alike = (new.obs == new.final_obs).all(axis=1)
        assert (np.asarray(alike) == ~np.asarray(new.done)).all()
        state = new
        assert i < 2 or bool(state.done.all())
    assert not bool((state.terminated & state.truncated).any())


def test_scripted_solves_it_and_zero_and_random_do_not():
    env = PointEnv()
    rates = {}
    for name in ("zero", "random", "scripted"):
        agent, step = make_agent(name, env), jax.jit(env.step)
        state = env.reset(env.params, split_keys(jax.random.PRNGKey(1), 128))
        over, success = np.zeros(128, bool), np.zeros(128)
        for i in range(env.episode_steps):
            state = step(env.params, state, agent(state, jax.random.PRNGKey(i)))
            first = np.asarray(state.done) & ~over
            success[first] = np.asarray(state.metrics["success"])[first]
            over |= first
        assert over.all()
        rates[name] = success.mean()
    assert rates["scripted"] == 1.0 and rates["zero"] < 0.2 and rates["random"] < 0.4


def test_environments_from_a_users_file(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text("from lunar_mjx.envs import PointEnv\ndef env(steps=5):\n    return PointEnv(steps)\n")
    assert make(f"{file}:env", steps=9).episode_steps == 9
    with pytest.raises(UserError, match="names no maker"):
        make(str(file))
    with pytest.raises(UserError, match="is not in the file"):
        make(f"{file}:other")
    with pytest.raises(UserError, match="not its options"):
        make(f"{file}:env", speed=9)
    file.write_text("1/0")
    with pytest.raises(UserError, match="ZeroDivisionError"):
        make(f"{file}:env")


def test_environments_known_by_name(monkeypatch):
    register("my_points", lambda steps=5: PointEnv(steps))
    assert make("my_points", steps=9).episode_steps == 9
    points = metadata.EntryPoints(
        [
            metadata.EntryPoint("theirs", "lunar_mjx.envs:PointEnv", registry.GROUP),
            metadata.EntryPoint("broken", "no_such_module:env", registry.GROUP),
        ]
    )
    monkeypatch.setattr(metadata, "entry_points", lambda group: points.select(group=group))
    assert make("theirs", episode_steps=7).episode_steps == 7
    with pytest.raises(UserError, match=r"broken.*does not load.*ModuleNotFoundError"):
        make("broken")
    with pytest.raises(UserError, match="my_points, theirs"):
        make("nowhere")
    with pytest.raises(UserError, match="is taken"):
        register("point", PointEnv)
    with pytest.raises(UserError, match="no plain word"):
        register("a.py:b", PointEnv)


def test_refuses_unknown_names():
    with pytest.raises(UserError, match="navigation, point"):
        make("nowhere")
    with pytest.raises(UserError, match="environment = 5 is no name; use navigation, point"):
        make(5)  # type: ignore[arg-type]
    with pytest.raises(UserError, match="zero, random, scripted"):
        make_agent("clever", PointEnv())
    with pytest.raises(UserError, match="episode_steps"):
        PointEnv(0)


def test_neighbours_lie_side_by_side_in_narrow_arrays_only():
    arrays = {"narrow": jnp.arange(24.0).reshape(8, 3), "wide": jnp.ones((8, 40)), "flat": jnp.ones(8)}
    made = jax.jit(lambda t: side_by_side(jax.tree.map(lambda a: a + 1.0, t), wanted=True)).lower(arrays).compile()
    assert "f32[8,3]{0,1}" in made.as_text() and "f32[8,40]{0,1}" not in made.as_text()
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a + 1.0, b), arrays, made(arrays))
    assert side_by_side(arrays, wanted=False) is arrays
