"""Drives as a dataset: every episode whole, with the labels of its own end, and read back by Minari."""

from __future__ import annotations

import importlib
import json
import resource
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.export import dataset
from lunar_mjx.envs import make, make_agent, make_navigation, split_keys
from lunar_mjx.envs.navigation.randomise import Range
from lunar_mjx.errors import UserError

ROVERS, FRAMES, NAME = 3, 40, "lunar-mjx/tests-v0"
LACKS = "the extra lunar-mjx[datasets] is not installed"


@pytest.fixture(scope="module")
def env():
    return make_navigation(
        "consistent",
        terrain="flat",
        preset="consistent",
        decimation=5,
        places=16,
        episode_time=0.06,
        action="velocity",
        observations=("goal_body", "body_velocity", "slip"),
        randomise=(Range("soil.cohesion", 0.5, 2.0, "log", relative=True),),
    )


@pytest.fixture(scope="module")
def driven(env):
    return list(dataset.drives(env, env.params, make_agent("random", env), ROVERS, FRAMES, 3))


def test_episodes_are_whole_and_hold_what_the_steps_told(env, driven):
    """Against `step`, one call after another, which begins anew where an episode ends."""
    agent, step = make_agent("random", env), jax.jit(env.step)
    key_reset, key = jax.random.split(jax.random.PRNGKey(3))
    state = jax.jit(env.reset)(env.params, split_keys(key_reset, ROVERS))
    keys = jax.random.split(jax.random.fold_in(key, 0), dataset._PIECE)
    told = []
    for i in range(14):
        action = agent(state, keys[i])
        new = step(env.params, state, action)
        told.append(jax.device_get((state.obs, action, new.final_obs, new.reward, new.done, new.truncated)))
        state = new
    before, action, after, reward, done, truncated = (np.stack(a) for a in zip(*told, strict=True))
    assert done.sum() == 2 * ROVERS and truncated.sum() == 2 * ROVERS
    # whole steps of all rovers, at least as many as asked for: 14 of 3; six actions an episode, the last ones cut off
    assert sorted(len(e["rewards"]) for e in driven) == [2] * ROVERS + [6] * 2 * ROVERS
    for rover, found in enumerate(driven[0 : 2 * ROVERS : 2]):
        np.testing.assert_allclose(found["observations"][:-1], before[:6, rover], atol=1e-5)
        np.testing.assert_allclose(found["observations"][1:], after[:6, rover], atol=1e-5)
        np.testing.assert_array_equal(found["actions"], action[:6, rover])
        np.testing.assert_allclose(found["rewards"], reward[:6, rover], atol=1e-4)
    for found in driven:
        assert not found["terminations"].any() and found["truncations"].tolist() == [False] * (
            len(found["rewards"]) - 1
        ) + [True]


def test_labels_of_an_end_are_the_old_episodes(env, driven):
    for found in driven:
        infos, steps = found["infos"], len(found["rewards"])
        assert all(len(value) == steps + 1 for value in infos.values())
        # no jump to where the next episode begins
        assert np.abs(np.diff(infos["position"], axis=0)).max() < 0.1
        slip = found["observations"][1:, -4:]
        np.testing.assert_allclose(np.clip(infos["slip"][1:], -1.0, 1.0), slip, atol=1e-5)
        assert np.abs(infos["slip"][1:]).max() > 0.0
        assert np.ptp(infos["drawn.soil.cohesion"]) == 0.0


def _written(env, episodes, folder):
    return dataset.write_dataset(iter(episodes), env, folder, NAME, {"seed": 3})


def test_minari_loads_it(env, driven, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari", reason=LACKS)
    assert _written(env, driven, tmp_path) == (len(driven), 42)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    loaded = minari.load_dataset(NAME)
    assert (loaded.total_episodes, loaded.total_steps) == (len(driven), 42)
    assert loaded.observation_space.shape == (env.observation_size,)
    assert loaded.action_space.shape == (env.action_size,)
    for found, wrote in zip(loaded.iterate_episodes(), driven, strict=True):
        for name in ("observations", "actions", "rewards", "terminations", "truncations"):
            np.testing.assert_array_equal(getattr(found, name), wrote[name])
        assert found.infos.keys() == wrote["infos"].keys()
        np.testing.assert_array_equal(found.infos["slip"], wrote["infos"]["slip"])


def test_a_failure_keeps_the_dataset_that_was_there(env, driven, tmp_path):
    pytest.importorskip("h5py", reason=LACKS)
    _written(env, driven, tmp_path)
    data = tmp_path / NAME / "data"
    before = {p.name: p.read_bytes() for p in data.iterdir()}
    told = json.loads(before["metadata.json"])
    assert len(told["observations"]) == env.observation_size and told["observations"][0] == "goal_body: distance [m]"

    def failing():
        yield driven[0]
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        dataset.write_dataset(failing(), env, tmp_path, NAME, {})
    assert {p.name: p.read_bytes() for p in data.iterdir()} == before


def test_a_full_disk_is_told_in_a_sentence(env, driven, tmp_path):
    """A file that may not grow stands for it; HDF5's own writes ended the process with a fault of memory."""
    pytest.importorskip("h5py", reason=LACKS)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
    try:
        with pytest.raises(UserError, match=r"main_data.hdf5: cannot be written \(File too large\)"):
            _written(env, driven * 20, tmp_path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list((tmp_path / NAME / "data").iterdir())


def test_metadata_tell_the_whole_environment(env, driven, tmp_path):
    pytest.importorskip("h5py", reason=LACKS)
    _written(env, driven, tmp_path)
    told = json.loads((tmp_path / NAME / "data" / "metadata.json").read_text())
    assert told["rover"] == "luvmi_x" and "slip_sinkage" not in told["effects"] and told["effects"]
    settings = told["settings"]
    assert (settings["decimation"], settings["observations"][0]) == (5, "goal_body")
    assert settings["randomise"][0]["parameter"] == "soil.cohesion"


def test_observations_that_are_not_finite_are_not_written(env):
    def broken(state, key):
        del key
        return jnp.full((ROVERS, env.action_size), jnp.nan)

    with pytest.raises(UserError, match=r"divergence = 'stop' lets .* not finite; give --env divergence=reset"):
        list(dataset.drives(env, env.params, broken, ROVERS, FRAMES, 3))


def _unread(*_):
    raise AssertionError("drove")


@pytest.mark.parametrize(
    ("name", "frames", "said"),
    [("drives", 40, "is no dataset's name"), ("../up-v0", 40, "is no dataset's name"), (NAME, 2, "--rovers = 3")],
)
def test_mistakes_are_told_before_any_rover_drives(env, tmp_path, name, frames, said):
    with pytest.raises(UserError, match=said):
        dataset.export_dataset(env, env.params, _unread, tmp_path, name, ROVERS, frames, 0, print, {})


def test_what_is_not_installed_is_told(env, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(UserError, match=r"pip install 'lunar-mjx\[datasets\]'"):
        dataset.export_dataset(env, env.params, _unread, tmp_path, NAME, ROVERS, FRAMES, 0, print, {})


def test_an_environment_without_rovers_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(importlib, "import_module", lambda name: None)
    with pytest.raises(UserError, match="has no rovers"):
        dataset.export_dataset(make("point"), None, _unread, tmp_path, NAME, 1, 4, 0, print, {})


def test_the_command_refuses_in_one_sentence(run):
    result = run("export", "dataset", "--name", "drives", "--device", "cpu")
    assert result.status == 2 and "is no dataset's name" in result.err and len(result.err.splitlines()) == 1
