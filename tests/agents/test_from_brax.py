"""SAC and PPO out of brax's losses: trained, resumed and saved like the others, and chosen by name."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.configs import get_training, learner_name, override, read_training, training_names
from lunar_mjx.agents.evaluate import evaluate
from lunar_mjx.agents.from_brax.ppo import PPO, PPOConfig, Rollout
from lunar_mjx.agents.from_brax.sac import SAC, SACConfig
from lunar_mjx.agents.learner import Learner, TrainConfig
from lunar_mjx.agents.policy import load_policy, save_policy
from lunar_mjx.agents.replay import Batch
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import PointEnv, make_agent
from lunar_mjx.errors import UserError

SMALL = {"actor_layers": (32, 32), "critic_layers": (32, 32)}
CONFIGS = {
    "sac": TrainConfig(
        SACConfig(**SMALL, n_step=3, tau=0.02, temperature=0.05, temperature_rate=3e-3),
        envs=32,
        batch=256,
        updates=2,
        buffer_steps=1000,
        random_steps=20,
        normalise=True,
        epoch_steps=100,
    ),
    "ppo": TrainConfig(PPOConfig(**SMALL, unroll=20, rate=1e-3), envs=64, normalise=True, epoch_steps=100),
}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "steps"), [("sac", 41_600), ("ppo", 64_000)])
def test_solves_the_point_task(name, steps, tmp_path):
    env = PointEnv()
    result = train(Learner(env, CONFIGS[name]), RunConfig(steps, quiet=True), None)
    policy = load_policy(save_policy(result.policy, tmp_path / "policy.npz"))
    score = evaluate(env, lambda state, key: policy.act(state.obs), 256, seed=9)
    chance = evaluate(env, make_agent("random", env), 256, seed=9)
    assert score.low > 0.85 and chance.high < 0.5


def tiny(name: str) -> Learner:
    config = dataclasses.replace(CONFIGS[name], envs=8, batch=16, updates=1, buffer_steps=32, epoch_steps=20)
    return Learner(PointEnv(), config)


@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_trains_and_saves_like_the_others(name, tmp_path):
    learner = tiny(name)
    whole = train(learner, RunConfig(320, quiet=True), None)
    assert [r["steps"] for r in whole.rows] == [160, 320]
    assert all(np.isfinite(v) for k, v in whole.rows[-1].items() if k.endswith("_loss"))
    assert len(whole.episodes["step"]) == len(whole.episodes["success"])
    policy = load_policy(save_policy(whole.policy, tmp_path / "policy.npz"))
    obs = np.random.default_rng(0).normal(size=(5, learner.env.observation_size)).astype(np.float32)
    params, statistics = learner.policy(whole.state)
    assert statistics is not None
    seen = np.clip((obs - np.asarray(statistics[0])) / np.asarray(statistics[1]), -10.0, 10.0)
    assert np.asarray(policy.act(obs)) == pytest.approx(np.asarray(learner.agent.act(params, seen)), abs=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(CONFIGS))
def test_goes_on_from_a_checkpoint_to_the_last_bit(name, tmp_path):
    learner, run = tiny(name), RunConfig(320, quiet=True)
    whole = train(learner, run, None)
    train(learner, dataclasses.replace(run, steps=160), tmp_path)
    halves = train(learner, run, tmp_path)
    assert [r["steps"] for r in halves.rows] == [160, 320]
    for a, b in zip(jax.tree.leaves(whole.policy.params), jax.tree.leaves(halves.policy.params), strict=True):
        assert (np.asarray(a) == np.asarray(b)).all()


@pytest.mark.parametrize(("kind", "config"), [(SAC, SACConfig), (PPO, PPOConfig)])
def test_the_policy_sees_no_privileged_numbers_and_acts_as_its_distribution_is_likeliest_to(kind, config):
    agent = kind(config(**SMALL, actor_last_scale=1.0), 4, 3, 2)
    state = agent.init(jax.random.PRNGKey(0))
    actor = state.actor if kind is SAC else state.params.policy
    seen = jax.random.normal(jax.random.PRNGKey(1), (6, 7))
    logits = agent.network.apply(None, actor, seen)
    assert (logits == agent.network.apply(None, actor, seen.at[:, 4:].add(5.0))).all()
    likeliest = agent.distribution.mode(logits)
    assert np.asarray(agent.act(agent.policy(state), seen[:, :4])) == pytest.approx(np.asarray(likeliest), abs=1e-6)


def test_sac_learns_a_value_that_only_privileged_numbers_tell():
    """Two states that look alike, with rewards 0 and 1: the critic tells them apart."""
    agent = SAC(SACConfig(**SMALL, critic_rate=1e-2, temperature=1e-6, gamma=0.5), 1, 1, 1)
    state = agent.init(jax.random.PRNGKey(0))
    hidden = jnp.asarray([[0.0], [1.0]] * 32)
    same = jnp.zeros((64, 1))
    batch = Batch(same, hidden, same, hidden[:, 0], jnp.zeros(64), same, hidden)
    update = jax.jit(agent.update)
    for i in range(200):
        state, losses = update(state, batch, jax.random.PRNGKey(i))
    assert float(losses["critic_loss"]) < 1e-3


def test_ppo_does_what_was_worth_more_than_expected():
    """One step of an episode: the reward is the action."""
    agent = PPO(PPOConfig(**SMALL, rate=1e-2, unroll=1, entropy=0.0), 2, 0, 1)
    state = agent.init(jax.random.PRNGKey(0))
    seen = jnp.zeros((256, 2))
    draw, update = jax.jit(agent.draw), jax.jit(agent.update)
    before = float(agent.act(agent.policy(state), seen)[0, 0])
    for i in range(10):
        action, raw, logits, log_prob = draw(state, seen, jax.random.PRNGKey(i))
        one, end = jnp.ones((256, 1)), jnp.zeros((256, 1))
        rollout = Rollout(
            *(a[:, None] for a in (seen, raw, logits)), log_prob[:, None], action, one, end, seen[:, None]
        )
        state, _ = update(state, rollout, jax.random.PRNGKey(100 + i))
    assert float(agent.act(agent.policy(state), seen)[0, 0]) > before + 0.3


def test_another_learner_takes_the_settings_that_stand_beside():
    large = get_training("large-td3")
    for learner in ("td3", "ddpg", "sac", "ppo"):
        chosen = get_training("large-td3", learner)
        assert learner_name(chosen) == learner and chosen.settings == f"large-{learner}"
        assert (chosen.environment, chosen.options) == (large.environment, large.options)
    assert get_training("large-td3", "ppo").steps == get_training("large-ppo").steps
    assert learner_name(get_training("short-ppo", "td3")) == "td3"
    for number in range(1, 6):
        rung = get_training(f"ladder-{number}")
        assert rung.train == get_training(f"large-{learner_name(rung)}").train
        assert rung.options["task"] == f"ladder/{number}"
        ppo = get_training(f"ladder-{number}", "ppo")
        assert ppo.train == get_training("large-ppo").train and ppo.steps == rung.steps
    assert {"short-ppo", "short-sac", "large-ppo", "large-sac"} <= set(training_names())


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: get_training("short", "a3c"), "--learner = 'a3c' does not exist; use one of td3, ddpg, sac, ppo"),
        (lambda: get_training("point", "ppo"), "has no settings beside those of point; give a file with a table"),
        (lambda: override(get_training("large-ppo"), batch=8), "batch = 8 is no setting of this training"),
        (lambda: override(get_training("large-sac"), noise="0.1,0.2"), "is no setting of this training"),
        (
            lambda: Learner(PointEnv(), TrainConfig(PPOConfig(), envs=8, epoch_steps=50)),
            "is no multiple of unroll = 24",
        ),
        (lambda: Learner(PointEnv(), TrainConfig(PPOConfig(), envs=6, epoch_steps=24)), "does not divide among"),
        (lambda: SACConfig(temperature=0.0), "temperature = 0.0 is out of range"),
        (lambda: PPOConfig(passes=0), "passes = 0 is below 1"),
    ],
)
def test_mistakes_are_told(make, told):
    with pytest.raises(UserError) as error:
        make()
    assert told in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("[ppo]\n[train]\nbatch = 8\n", "train.batch = 8 is an unknown key"),
        ('learner = "large-ppo"\n[td3]\n', "learner = 'large-ppo' stands beside [td3]; give one of them"),
        ('learner = "fast"\n', "training = 'fast' does not exist"),
    ],
)
def test_mistakes_in_a_training_file_are_told(text, told, tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(f'environment = "point"\nsteps = 10\n{text}', encoding="utf-8")
    with pytest.raises(UserError) as error:
        read_training(path)
    assert told in str(error.value)
