"""Agents that learn nothing, to look at an environment and to beat: zero, random, and straight for the goal."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from lunar_mjx.envs.core import Environment, State
from lunar_mjx.envs.navigation.env import NavigationEnv
from lunar_mjx.errors import bad_input

Agent = Callable[[State, Any], Any]
"""Function of the batch's state and a random key to actions (env, action)."""

AGENTS = ("zero", "random", "scripted")


def make_agent(name: str, env: Environment) -> Agent:
    """An agent by name: `zero` does nothing, `random` draws uniformly, `scripted` drives straight for the goal.

    Raises:
      UserError: unknown name, or an environment that `scripted` cannot drive.
    """
    if name == "zero":
        return lambda state, key: jnp.zeros((state.obs.shape[0], env.action_size), state.obs.dtype)
    if name == "random":
        return lambda state, key: jax.random.uniform(
            key, (state.obs.shape[0], env.action_size), state.obs.dtype, -1.0, 1.0
        )
    if name != "scripted":
        raise bad_input("agent", "agent", name, "does not exist", f"use one of {', '.join(AGENTS)}")
    if not isinstance(env, NavigationEnv):
        return lambda state, key: _toward(state.info["goal_body"])
    if env.config.action not in ("paper", "velocity"):
        raise bad_input(
            "agent", "scripted", env.config.action, "has one action per motor", "use the action mode paper or velocity"
        )
    return _driver(env)


def _toward(goal: Any) -> Any:
    return goal / jnp.maximum(jnp.max(jnp.abs(goal), axis=-1, keepdims=True), 0.1)


def _driver(env: NavigationEnv) -> Agent:
    """Full speed ahead, steering in proportion to the bearing of the goal; suspension untouched."""
    joints = env.model.rover.joints
    fronts = [joints.index(w.steer) for w in env.model.rover.wheels if w.corner in ("lf", "rf") and w.steer]
    torque = env.config.action == "paper"
    limit = min(env.model.rover.joint_limits[joints[i]][1] for i in fronts)

    def act(state: State, key: Any) -> Any:
        goal = state.info["goal_body"]
        bearing = jnp.arctan2(goal[:, 1], goal[:, 0])
        wanted = jnp.clip(1.5 * bearing, -limit, limit)
        if torque:
            # a proportional controller for the angle: the motor's own damping does the rest
            angle = jnp.mean(state.info["joint_angle"][:, jnp.array(fronts)], axis=-1)
            steer = 2.0 * (wanted - angle) / limit
            speed = state.info["body_velocity"][:, 0]
            drive = jnp.clip(2.0 * (0.5 - speed), -1.0, 1.0)
        else:
            steer, drive = wanted / limit, jnp.ones_like(bearing)
        rest = jnp.zeros((goal.shape[0], env.action_size - 2), goal.dtype)
        return jnp.concatenate([jnp.stack([drive, jnp.clip(steer, -1.0, 1.0)], axis=-1), rest], axis=-1)

    return act
