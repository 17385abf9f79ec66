"""A rover, not a point: the shipped training `short` learns to drive to goals within minutes on two CPU cores."""

from __future__ import annotations

import jax
import pytest

from lunar_mjx.agents.configs import get_training
from lunar_mjx.agents.evaluate import Evaluator
from lunar_mjx.agents.learner import Learner
from lunar_mjx.agents.run import learner_agent
from lunar_mjx.envs import make

STEPS, EPISODES = 28_800, 64


@pytest.mark.slow
def test_a_rover_learns_to_reach_goals_that_it_was_not_trained_on():
    """Return rises by more than 300 (the goal pays 500, the way 50 to 90), success from below 20 to above 80 %."""
    training = get_training("short")
    env = make(training.environment, **training.options)
    learner = Learner(env, training.train)
    judge, unseen = Evaluator(env, learner_agent(learner), EPISODES), env.place(seed=7919)
    state = learner.init(0)
    before = judge(unseen, jax.device_get(learner.policy(state)), 5)
    for _ in range(STEPS // (training.train.envs * training.train.epoch_steps)):
        state, _ = learner.epoch(env.params, state)
    after = judge(unseen, jax.device_get(learner.policy(state)), 5)
    assert before.high < 0.2 and after.low > 0.8
    assert after.episode_return > before.episode_return + 300.0
