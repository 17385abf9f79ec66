"""Trainings that begin with another one's policy: what it did it does still, and what does not fit is refused."""

from __future__ import annotations

import dataclasses
import types

import jax
import numpy as np
import pytest

from lunar_mjx.agents.from_brax.begin import _check, begin_with
from lunar_mjx.agents.from_brax.ppo import PPOConfig
from lunar_mjx.agents.learner import Learner, TrainConfig
from lunar_mjx.agents.policy import load_policy, policy_of, save_policy, shipped_policy
from lunar_mjx.agents.td3 import TD3Config
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import make, make_navigation
from lunar_mjx.errors import UserError

SMALL = PPOConfig((16, 16), (16,), minibatches=2, passes=1, unroll=12)


def config(algorithm=SMALL, **more):
    return TrainConfig(algorithm, **{"envs": 8, "normalise": True, "epoch_steps": 24, **more})


@pytest.fixture(scope="module")
def learned(tmp_path_factory):
    """A learner in the environment without physics, and the file of a policy that it has trained."""
    learner = Learner(make("point"), config())
    state = train(learner, RunConfig(4 * 8 * 24, seed=3, quiet=True), None).state
    path = tmp_path_factory.mktemp("begin") / "policy.npz"
    save_policy(policy_of(learner, state, {"name": "point", "options": {}}, {}), path)
    return learner, path


def test_the_first_policy_is_the_other_one(learned):
    learner, path = learned
    state = begin_with(learner, learner.init(0), str(path))
    other, obs = load_policy(path), np.random.default_rng(0).normal(size=(32, learner.env.observation_size))
    made = policy_of(learner, state, {}, {})
    np.testing.assert_allclose(made.act(obs), other.act(obs), atol=1e-6)
    assert np.abs(policy_of(learner, learner.init(0), {}, {}).act(obs) - other.act(obs)).max() > 0.1


def test_it_trains_on_and_remembers_what_it_began_with(learned, tmp_path):
    learner, path = learned
    result = train(learner, RunConfig(2 * 8 * 24, quiet=True, begin_with=str(path)), tmp_path)
    assert result.policy.notes["begin_with"] == str(path)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(result.policy.params))
    with pytest.raises(UserError, match="begin_with"):
        train(learner, RunConfig(4 * 8 * 24, quiet=True), tmp_path)


def test_resumed_it_goes_on_as_if_never_stopped_and_does_not_begin_again(learned, tmp_path, monkeypatch):
    learner, path = learned
    whole = train(learner, RunConfig(4 * 8 * 24, quiet=True, begin_with=str(path)), None)
    train(learner, RunConfig(2 * 8 * 24, quiet=True, begin_with=str(path)), tmp_path)
    monkeypatch.setattr("lunar_mjx.agents.train.begin_with", lambda *_: pytest.fail("began again"))
    resumed = train(learner, RunConfig(4 * 8 * 24, quiet=True, begin_with=str(path)), tmp_path)
    for one, other in zip(jax.tree.leaves(resumed.state), jax.tree.leaves(whole.state), strict=True):
        np.testing.assert_allclose(np.asarray(one, float), np.asarray(other, float), rtol=1e-6, atol=1e-7)
    assert [row["steps"] for row in resumed.rows] == [8 * 24 * n for n in (1, 2, 3, 4)]
    assert resumed.policy.notes["begin_with"] == str(path)


def test_observations_that_are_new_count_nothing_at_first(learned, monkeypatch):
    learner, path = learned
    policy = load_policy(path)
    less = policy.network["obs"] - 1
    kernel = policy.params["params"]["hidden_0"]
    params = {"params": {**policy.params["params"], "hidden_0": {**kernel, "kernel": kernel["kernel"][:less]}}}
    short = dataclasses.replace(
        policy,
        params=params,
        mean=policy.mean[:less],
        deviation=policy.deviation[:less],
        network={**policy.network, "obs": less},
    )
    monkeypatch.setattr("lunar_mjx.agents.from_brax.begin._check", lambda *_: None)
    monkeypatch.setattr("lunar_mjx.agents.from_brax.begin.load_policy", lambda _: short)
    made = policy_of(learner, begin_with(learner, learner.init(0), str(path)), {}, {})
    obs = np.random.default_rng(1).normal(size=(16, less + 1))
    np.testing.assert_allclose(made.act(obs), short.act(obs[:, :less]), atol=1e-6)


@pytest.mark.parametrize(
    ("made", "says"),
    [
        (config(dataclasses.replace(SMALL, actor_layers=(8, 8))), "layers"),
        (config(normalise=False), "normalise"),
        (config(TD3Config(), batch=8, buffer_steps=64), "--learner ppo"),
    ],
)
def test_what_does_not_fit_is_refused(learned, made, says):
    _, path = learned
    learner = Learner(make("point"), made)
    with pytest.raises(UserError, match=says):
        begin_with(learner, learner.init(0), str(path))


def test_a_policy_of_another_environment_is_refused(learned):
    learner, _ = learned
    with pytest.raises(UserError, match="--begin-with"):
        begin_with(learner, learner.init(0), "luvmi_x/ladder-3")
    with pytest.raises(UserError, match="is no policy that ships"):
        begin_with(learner, learner.init(0), "nobody")


@pytest.mark.parametrize(("field", "value"), [("action", "paper"), ("four_wheel_steering", False)])
def test_actions_that_mean_something_else_are_refused(field, value):
    path = shipped_policy("luvmi_x")
    assert path is not None
    policy = load_policy(path)
    like = {name: policy.network[name] for name in ("activation", "layer_norm")}
    made = config(dataclasses.replace(SMALL, actor_layers=tuple(policy.network["layers"]), **like))
    told = {"preset": "consistent", "terrain": "flat", "places": 8, "goal_distance": (2.0, 4.0)}
    learner = types.SimpleNamespace(config=made, env=make_navigation("large", **told))
    _check(learner, policy, "luvmi_x")
    learner.env = make_navigation("large", **told, **{field: value})
    with pytest.raises(UserError, match=f"has {field} = .*--env {field}="):
        _check(learner, policy, "luvmi_x")


def test_a_policy_whose_file_names_no_task_is_told_by_what_the_user_did():
    path = shipped_policy("luvmi_x")
    assert path is not None
    policy = load_policy(path)
    options = {**policy.environment["options"], "task": "maze"}
    policy = dataclasses.replace(policy, environment={**policy.environment, "options": options})
    like = {name: policy.network[name] for name in ("activation", "layer_norm")}
    made = config(dataclasses.replace(SMALL, actor_layers=tuple(policy.network["layers"]), **like))
    env = make_navigation("large", preset="consistent", terrain="flat", places=8, goal_distance=(2.0, 4.0))
    with pytest.raises(UserError, match="train: --begin-with luvmi_x: the policy's task = 'maze' does not exist"):
        _check(types.SimpleNamespace(config=made, env=env), policy, "luvmi_x")
