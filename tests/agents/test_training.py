"""Whole trainings: they solve the task without physics, survive SIGKILL bit for bit, and stop at nan."""

from __future__ import annotations

import math
import signal
import subprocess
from pathlib import Path

import jax
import pytest

from lunar_mjx.agents import guard
from lunar_mjx.agents.configs import get_training, override, read_training, training_names
from lunar_mjx.agents.ddpg import DDPGConfig
from lunar_mjx.agents.evaluate import Evaluator, evaluate, wilson
from lunar_mjx.agents.learner import Learner, TrainConfig
from lunar_mjx.agents.policy import load_policy, save_policy
from lunar_mjx.agents.td3 import TD3Config
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import PointEnv, make_agent
from lunar_mjx.errors import UserError
from tests.agents.point_process import command, run


def settings(algorithm) -> TrainConfig:
    return TrainConfig(
        algorithm,
        envs=32,
        batch=256,
        updates=2,
        buffer_steps=1000,
        random_steps=20,
        noise=(0.05, 0.4),
        normalise=True,
        epoch_steps=100,
    )


SMALL = {"actor_layers": (64, 64), "critic_layers": (64, 64), "n_step": 3, "tau": 0.02}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("algorithm", "steps"),
    [
        (DDPGConfig(**SMALL), 25_600),
        (TD3Config(**SMALL, atoms=31, value_range=(-10.0, 30.0), layer_norm=True, weight_decay=0.01), 60_000),
    ],
    ids=["ddpg", "td3-distributional"],
)
def test_solves_the_point_task(algorithm, steps, tmp_path):
    env = PointEnv()
    result = train(Learner(env, settings(algorithm)), RunConfig(steps, quiet=True), None)
    policy = load_policy(save_policy(result.policy, tmp_path / "policy.npz"))
    score = evaluate(env, lambda state, key: policy.act(state.obs), 256, seed=9)
    chance = evaluate(env, make_agent("random", env), 256, seed=9)
    assert score.low > 0.85 and chance.high < 0.5
    # the straight way at full speed is the best that can be done
    best = evaluate(env, make_agent("scripted", env), 256, seed=9)
    early = result.rows[0]["episode_return"]
    assert score.episode_return > 0.9 * best.episode_return > early + 5.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("whole")
    return folder, run(folder)


KILLS = [f"file:{n}" for n in (1, 4, 9, 14, 20, 27, 35, 44, 54, 65)] + [f"epoch:{1 + n % 3}" for n in range(10)]
"""Where trainings are killed, one after the other in one folder: ten within checkpoints, ten between."""


@pytest.mark.slow
def test_killed_and_resumed_it_ends_bit_for_bit_alike(tmp_path, whole):
    _, whole = whole
    folder = tmp_path / "broken"
    for where in KILLS:
        line, env = command(folder, "--kill", where)
        killed = subprocess.run(line, env=env, capture_output=True, text=True, check=False)
        assert killed.returncode == -signal.SIGKILL, (where, killed.stderr[-2000:])
    resumed = run(folder)
    assert resumed["digest"] == whole["digest"]
    assert resumed["curve"] == whole["curve"]
    rows = (folder / "progress.csv").read_text().splitlines()
    assert len(rows) == 1 + len(whole["curve"])


def test_stops_at_a_value_that_is_not_finite_and_keeps_the_state_for_replay(tmp_path):
    env = PointEnv(episode_steps=40, poison=7)
    config = override(get_training("point"), epoch_steps=10).train
    with pytest.raises(guard.DivergenceError, match=r"environment \d+ .* step 7; .*not_finite.npz"):
        train(Learner(env, config), RunConfig(3200, quiet=True), tmp_path)
    again = guard.replay(env, tmp_path / "not_finite.npz")
    assert math.isnan(float(again.reward[0]))
    with pytest.raises(UserError, match="not the state of this environment"):
        guard.replay(_Wider(), tmp_path / "not_finite.npz")


class _Wider(PointEnv):
    def _observe(self, inner):
        obs, privileged = super()._observe(inner)
        return jax.numpy.concatenate([obs, obs], axis=-1), privileged


def test_a_checkpoint_of_other_settings_is_refused(tmp_path):
    config = override(get_training("point"), epoch_steps=5).train
    train(Learner(PointEnv(), config), RunConfig(160, quiet=True), tmp_path)
    other = override(get_training("point"), epoch_steps=5, actor_layers=(32, 32)).train
    with pytest.raises(UserError, match=r"train\.algorithm\.actor_layers = \[32, 32\] is not \[64, 64\]"):
        train(Learner(PointEnv(), other), RunConfig(320, quiet=True), tmp_path)


def test_evaluation_counts_the_first_episode_of_each_environment():
    env = PointEnv(episode_steps=5)
    score = evaluate(env, make_agent("zero", env), 400, seed=0)
    # a start within 0.1 m of its goal is a success at once: about pi 0.1^2 / 4 of all
    assert score.success < 0.05 and score.ends["time"] == pytest.approx(1 - score.success)
    assert score.episode_time == pytest.approx(0.5, abs=0.03)
    twice = Evaluator(env, lambda _, state, key: make_agent("random", env)(state, key), 50)
    assert twice(env.params, (), 3) == twice(env.params, (), 3)


@pytest.mark.parametrize(
    ("successes", "count", "low", "high"), [(8, 10, 0.4902, 0.9433), (0, 10, 0.0, 0.2775), (256, 256, 0.9852, 1.0)]
)
def test_wilson_interval(successes, count, low, high):
    """Published values (Wilson score, 95 %)."""
    assert wilson(successes, count) == pytest.approx((low, high), abs=1e-4)


def test_overrides_by_name():
    changed = override(get_training("large-td3"), envs="64", noise="0.1,0.2", atoms="51", normalise="false")
    assert (changed.train.envs, changed.train.noise, changed.train.normalise) == (64, (0.1, 0.2), False)
    assert changed.train.algorithm.atoms == 51
    with pytest.raises(UserError, match="is no setting"):
        override(get_training("point"), speed=1)
    with pytest.raises(UserError, match="is not like 8192"):
        override(get_training("large-td3"), envs="many")
    with pytest.raises(UserError, match="does not exist"):
        get_training("fast")
    with pytest.raises(UserError, match="random_steps"):
        override(get_training("point"), random_steps=1)


def test_every_training_that_ships_is_read():
    assert set(training_names()) >= {"paper-td3", "paper-ddpg", "large-td3", "large-ddpg", "short", "point"}
    for name in training_names():
        training = get_training(name)
        assert training.note and training.steps > 0
    large = get_training("large-td3")
    assert large.train.algorithm.value_range == (-3.0, 7.0) and large.unseen["terrain"] == "world:heldout"


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("steps = 10\n[td3]\n", "environment = None is not a text"),
        (
            'environment = "point"\nsteps = 10\n',
            r"algorithm = 'none' is not one table; give one of \[td3\] or \[ddpg\]",
        ),
        ('environment = "point"\nsteps = 10\n[td3]\ngama = 0.9\n', r"td3\.gama = 0\.9 is an unknown key"),
        ('environment = "point"\nsteps = 10\n[td3]\n[train]\nenvs = "many"\n', r"train\.envs = 'many' is not like 1"),
        ('environment = "point"\nstep = 10\n[td3]\n', "step = 10 is an unknown key"),
    ],
)
def test_mistakes_in_a_training_file_are_told(text, told, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(UserError, match=told):
        read_training(path)
