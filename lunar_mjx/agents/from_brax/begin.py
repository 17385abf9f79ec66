"""Trainings that begin with what another one has learnt: the policy of an easier task drives from the first step."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.agents.from_brax.ppo import PPOConfig
from lunar_mjx.agents.policy import Policy, load_policy, shipped_policy, taught_in
from lunar_mjx.envs import NavigationEnv
from lunar_mjx.errors import bad_input

FIELD = "--begin-with"


def begin_with(learner: Any, state: Any, source: str) -> Any:
    """The first state of a training by PPO whose policy is, but for its noise, another one.

    Observations that the other policy did not have come last, and count nothing until they are learnt. The value is as
    it was drawn.

    Args:
      learner: of the training (`Learner`). state: its first state (`TrainState`).
      source: path of a policy, or the name of one that ships.

    Raises:
      UserError: no such policy, one of another network, rover or observations, or another algorithm than PPO.
    """
    path = Path(source) if source.endswith(".npz") else shipped_policy(source)
    if path is None:
        raise bad_input("train", FIELD, source, "is no policy that ships", "give a policy.npz, or luvmi_x/ladder-3")
    policy = load_policy(path)
    _check(learner, policy, source)
    obs, actions = policy.network["obs"], policy.network["actions"]

    def first(new: Any, old: Any) -> Any:
        """An array that begins with another, along both axes."""
        out = np.array(new)
        out[tuple(slice(n) for n in np.shape(old))] = old
        return out

    # On the host: devices may share the state among them, and arrays of other shapes are put together here.
    params = jax.device_get(state.agent.params.policy)["params"]
    known = policy.params["params"]
    # Weights of new observations are zero: whatever they say, the policy does as before.
    fresh = {**params, "hidden_0": {**params["hidden_0"], "kernel": 0.0 * np.asarray(params["hidden_0"]["kernel"])}}
    made = {
        layer: {name: first(fresh[layer][name], known[layer][name]) for name in arrays}
        for layer, arrays in fresh.items()
    }
    assert made[f"hidden_{len(policy.network['layers'])}"]["bias"].shape == (2 * actions,)
    agent = dataclasses.replace(state.agent, params=state.agent.params.replace(policy={"params": made}))
    statistics = jax.device_get(state.statistics)
    if policy.mean is not None:
        # They count as one unroll of all environments: the first epochs may correct them.
        count = float(learner.config.envs * learner.config.algorithm.unroll)
        mean = {**statistics.mean, "obs": np.concatenate([policy.mean, np.zeros(learner.env.observation_size - obs)])}
        std = {
            "obs": np.concatenate([np.asarray(policy.deviation), np.ones(learner.env.observation_size - obs)]),
            "privileged": np.ones_like(statistics.std["privileged"]),
        }
        statistics = statistics.replace(
            mean=mean,
            std=std,
            summed_variance={name: count * np.square(s) for name, s in std.items()},
            count=statistics.count.replace(hi=np.uint32(0), lo=np.uint32(count)),
        )
    before = state
    state = dataclasses.replace(state, agent=agent, statistics=statistics)
    like = jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), state, before)
    return jax.device_put(like, learner.shardings(like))


def _check(learner: Any, policy: Policy, source: str) -> None:
    """Raises `UserError` where a training cannot begin with a policy."""
    config, env, network = learner.config.algorithm, learner.env, policy.network

    def refuse(problem: str, remedy: str) -> Any:
        return bad_input("train", FIELD, source, problem, remedy)

    if not isinstance(config, PPOConfig):
        raise refuse(f"cannot begin a training by {type(config).__name__.removesuffix('Config')}", "use --learner ppo")
    for name, theirs, ours in (
        ("actions", network["actions"], env.action_size),
        ("layers", tuple(network["layers"]), tuple(config.actor_layers)),
        ("activation", network["activation"], config.activation),
        ("layer_norm", network["layer_norm"], config.layer_norm),
        ("normalise", policy.mean is not None, learner.config.normalise),
        ("picture", network.get("picture"), getattr(env, "picture", None)),
    ):
        if theirs != ours:
            raise refuse(f"has {name} = {theirs}, and the training {ours}", "give a policy of a training like this one")
    # Of environments that say no names of observations, their number has to do.
    fits, said = network["obs"] == env.observation_size, (network["obs"], env.observation_size)
    if isinstance(env, NavigationEnv) and policy.environment.get("name") == "navigation":
        task, rover = taught_in(policy, f"train: {FIELD} {source}")
        if rover is not None and rover != env.model.rover.name:
            raise refuse(f"drives {rover}, and the training {env.model.rover.name}", "give a policy of the same rover")
        # As many actions may mean something else: torques in place of speeds.
        for field in ("action", "four_wheel_steering"):
            theirs, ours = getattr(task, field), getattr(env.config, field)
            if theirs != ours:
                remedy = f"give --env {field}={str(theirs).lower()}"
                raise refuse(f"has {field} = {theirs}, and the training {ours}", remedy)
        theirs, ours = tuple(task.observations), tuple(env.config.observations)
        fits = ours[: len(theirs)] == theirs and env.blocks[theirs[-1]].stop == network["obs"]
        said = list(theirs), list(ours)
    if not fits:
        problem = f"has observations {said[0]}, and the training {said[1]}"
        raise refuse(problem, "let the training's observations begin with the policy's")
