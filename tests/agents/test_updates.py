"""One update of DDPG and TD3 against gradients worked out by hand for linear networks, and Adam's first step."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.ddpg import DDPG, DDPGConfig
from lunar_mjx.agents.replay import Batch
from lunar_mjx.agents.td3 import TD3, TD3Config, project
from lunar_mjx.errors import UserError

RATE, TAU = 1e-2, 0.1


@pytest.fixture
def batch() -> Batch:
    rng = np.random.default_rng(3)
    return Batch(
        obs=jnp.asarray(rng.normal(size=(4, 2))),
        privileged=jnp.asarray(rng.normal(size=(4, 1))),
        action=jnp.asarray(rng.uniform(-1, 1, size=(4, 1))),
        reward=jnp.asarray(rng.normal(size=4)),
        discount=jnp.asarray([0.9, 0.81, 0.0, 0.9]),
        next_obs=jnp.asarray(rng.normal(size=(4, 2))),
        next_privileged=jnp.asarray(rng.normal(size=(4, 1))),
    )


def linear(params) -> tuple[np.ndarray, np.ndarray]:
    layer = params["params"]["hidden_0"]
    return np.asarray(layer["kernel"], float), np.asarray(layer["bias"], float)


def adam(value, gradient):
    """Adam's first step: the moments' bias corrections leave g / (|g| + eps)."""
    return value - RATE * gradient / (np.abs(gradient) + 1e-8)


class ByHand:
    """The networks of an agent with no hidden layers: a = tanh(s W + b), Q_i = (s, p, a) U_i + c_i."""

    def __init__(self, state):
        self.actor, self.critic = linear(state.actor), linear(state.critic)

    def act(self, s):
        return np.tanh(s @ self.actor[0] + self.actor[1])

    def value(self, i, s, p, a):
        return (np.concatenate([s, p, a], 1) @ self.critic[0][i] + self.critic[1][i])[:, 0]

    def critic_step(self, i, b, target):
        x = np.concatenate([b.obs, b.privileged, b.action], 1)
        error = self.value(i, b.obs, b.privileged, b.action) - target
        kernel, bias = 2 * (x * error[:, None]).mean(0)[:, None], np.array([2 * error.mean()])
        return adam(self.critic[0][i], kernel), adam(self.critic[1][i], bias)

    def actor_step(self, b, kernel):
        slope = kernel[-1, 0] * (1 - self.act(b.obs) ** 2)  # dQ/da times da/du
        return adam(self.actor[0], -(b.obs * slope).mean(0)[:, None]), adam(self.actor[1], -slope.mean(0))


def test_ddpg(batch):
    with jax.enable_x64(True):
        agent = DDPG(DDPGConfig((), (), actor_rate=RATE, critic_rate=RATE, tau=TAU, reward_scale=0.5), 2, 1, 1)
        old = agent.init(jax.random.PRNGKey(0))
        batch = jax.tree.map(jnp.asarray, batch)
        new, losses = jax.jit(lambda s, b: agent.update(s, b, jax.random.PRNGKey(1)))(old, batch)
        hand, b = ByHand(old), jax.tree.map(lambda a: np.asarray(a, float), batch)
        target = 0.5 * b.reward + b.discount * hand.value(0, b.next_obs, b.next_privileged, hand.act(b.next_obs))
        error = hand.value(0, b.obs, b.privileged, b.action) - target
        kernel, bias = hand.critic_step(0, b, target)
        actor = hand.actor_step(b, kernel)
        close = {"rtol": 0, "atol": 1e-6}
        assert float(losses["critic_loss"]) == pytest.approx((error**2).mean(), abs=1e-6)
        np.testing.assert_allclose(linear(new.critic)[0][0], kernel, **close)
        np.testing.assert_allclose(linear(new.critic)[1][0], bias, **close)
        for found, wanted in zip(linear(new.actor), actor, strict=True):
            np.testing.assert_allclose(found, wanted, **close)
        for found, before, wanted in zip(linear(new.actor_target), hand.actor, actor, strict=True):
            np.testing.assert_allclose(found, 0.9 * before + 0.1 * wanted, **close)
        np.testing.assert_allclose(linear(new.critic_target)[0][0], 0.9 * hand.critic[0][0] + 0.1 * kernel, **close)


def test_ddpg_clips_targets_to_what_the_task_can_pay(batch):
    free = DDPG(DDPGConfig((), ()), 2, 1, 1)
    state, b = free.init(jax.random.PRNGKey(0)), jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), batch)
    targets = np.asarray(free.targets(state, b))
    low, high = np.sort(targets)[[0, -1]] + [0.1, -0.1]
    bounded = DDPG(DDPGConfig((), (), value_range=(low, high)), 2, 1, 1)
    np.testing.assert_allclose(bounded.targets(state, b), np.clip(targets, low, high), rtol=1e-6)
    with pytest.raises(UserError, match="value_range"):
        DDPGConfig(value_range=(1.0, 1.0))


def test_td3_takes_the_least_target_and_waits_with_the_policy(batch):
    with jax.enable_x64(True):
        config = TD3Config((), (), actor_rate=RATE, critic_rate=RATE, tau=TAU, target_noise=0.0, policy_delay=2)
        agent = TD3(config, 2, 1, 1)
        old = agent.init(jax.random.PRNGKey(0))
        batch = jax.tree.map(jnp.asarray, batch)
        update = jax.jit(lambda s, b: agent.update(s, b, jax.random.PRNGKey(1)))
        first, losses = update(old, batch)
        hand, b = ByHand(old), jax.tree.map(lambda a: np.asarray(a, float), batch)
        following = hand.act(b.next_obs)
        values = [hand.value(i, b.next_obs, b.next_privileged, following) for i in (0, 1)]
        target = b.reward + b.discount * np.minimum(*values)
        assert (values[0] < values[1]).any() and (values[1] < values[0]).any(), "both critics count"
        errors = [hand.value(i, b.obs, b.privileged, b.action) - target for i in (0, 1)]
        close = {"rtol": 0, "atol": 1e-6}
        assert float(losses["critic_loss"]) == pytest.approx(sum((e**2).mean() for e in errors), abs=1e-6)
        for i in (0, 1):
            kernel, bias = hand.critic_step(i, b, target)
            np.testing.assert_allclose(linear(first.critic)[0][i], kernel, **close)
            np.testing.assert_allclose(linear(first.critic)[1][i], bias, **close)
        for name in ("actor", "actor_target", "critic_target"):
            for a, b_ in zip(linear(getattr(first, name)), linear(getattr(old, name)), strict=True):
                np.testing.assert_array_equal(a, b_, err_msg=f"{name} must wait for the second update")
        second, _ = update(first, batch)
        kernel = linear(second.critic)[0][0]
        for found, wanted in zip(linear(second.actor), ByHand(first).actor_step(b, kernel), strict=True):
            np.testing.assert_allclose(found, wanted, **close)
        mixed = 0.9 * hand.critic[0] + 0.1 * linear(second.critic)[0]
        np.testing.assert_allclose(linear(second.critic_target)[0], mixed, **close)


def test_td3_bounds_the_targets_noise(batch):
    config = TD3Config((), (), target_noise=50.0, target_clip=0.25, critics=1)
    agent = TD3(config, 2, 1, 1)
    state, b = agent.init(jax.random.PRNGKey(0)), jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), batch)
    quiet = TD3(TD3Config((), (), target_noise=0.0, critics=1), 2, 1, 1).targets(state, b, jax.random.PRNGKey(0))
    kernel = linear(state.critic)[0][0, -1, 0]
    shifts = np.stack([agent.targets(state, b, jax.random.PRNGKey(i)) - quiet for i in range(50)])
    bound = 0.25 * abs(kernel) * np.asarray(b.discount)
    assert (np.abs(shifts) <= bound + 1e-6).all()
    assert np.abs(shifts).max() > 0.9 * bound.min(where=bound > 0, initial=9), "there is noise"


def test_projection_keeps_probability_and_mean_and_clips():
    support = jnp.linspace(-1.0, 1.0, 5)
    probabilities = jnp.array([[0.1, 0.2, 0.4, 0.2, 0.1]])
    places = 0.2 + 0.5 * support[None]
    out = project(support, places, probabilities)
    assert float(out.sum()) == pytest.approx(1.0)
    assert float((out @ support)[0]) == pytest.approx(float((places * probabilities).sum()), abs=1e-6)
    # 0.2 lies 0.4 of a step above 0: shares by hand, all mass at one place
    one = project(support, jnp.full((1, 5), 0.2), probabilities)
    np.testing.assert_allclose(one[0], [0, 0, 0.6, 0.4, 0], atol=1e-6)
    far = project(support, jnp.full((1, 5), 7.0), probabilities)
    np.testing.assert_allclose(far[0], [0, 0, 0, 0, 1], atol=1e-6)


def test_distributional_critic_learns_the_mean(batch):
    b = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), batch)
    b = type(b)(**{**vars(b), "discount": jnp.zeros(4), "reward": jnp.array([1.0, -2.0, 0.5, 3.0])})
    config = TD3Config((32,), (64,), atoms=51, value_range=(-5.0, 5.0), critic_rate=1e-2)
    agent = TD3(config, 2, 1, 1)
    state = agent.init(jax.random.PRNGKey(0))
    update = jax.jit(lambda s, k: agent.update(s, b, k)[0])
    for i in range(250):
        state = update(state, jax.random.PRNGKey(i))
    out = agent.critics.apply(state.critic, jnp.concatenate([b.obs, b.privileged], 1), b.action)
    np.testing.assert_allclose(agent.mean_value(jax.nn.softmax(out, -1)), np.tile(b.reward, (2, 1)), atol=0.15)
