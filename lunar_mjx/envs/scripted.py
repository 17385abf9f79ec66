"""Agents that learn nothing, to look at an environment and to beat.

Zero, random, straight for the goal, to and fro out of a hole, around what the height scan shows, along the way on a map
drawn while driving, and along that of one who knows the whole map.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.core import Environment, State
from lunar_mjx.envs.ladder.follower import Follower, toward
from lunar_mjx.envs.navigation.env import NavigationEnv, NavigationParams
from lunar_mjx.envs.navigation.view import SCAN_SCALE, VIEW
from lunar_mjx.errors import bad_input

Agent = Callable[[State, Any], Any]
"""Function of the batch's state and a random key to actions (env, action)."""

AGENTS = ("zero", "random", "scripted", "rocking", "reactive", "mapper", "planner")


def make_agent(name: str, env: Environment, params: Any = None) -> Agent:
    """An agent by name.

    `zero` does nothing, `random` draws uniformly, `scripted` drives straight for the goal (straight ahead where the
    task is to escape), `rocking` to and fro until it is free, `reactive` steers around what the height scan shows.
    `mapper` follows the way on the map of what it has seen, `planner` the shortest way over the whole map of a
    ladder's worlds, which it knows.

    Args:
      name: of the agent. env: to drive in. params: of the environment, whose map `planner` knows; `env.params` if None.

    Raises:
      UserError: unknown name, or an environment that the agent cannot drive.
    """
    if name == "zero":
        return lambda state, key: jnp.zeros((state.obs.shape[0], env.action_size), state.obs.dtype)
    if name == "random":
        return lambda state, key: jax.random.uniform(
            key, (state.obs.shape[0], env.action_size), state.obs.dtype, -1.0, 1.0
        )
    if name not in AGENTS:
        raise bad_input("agent", "agent", name, "does not exist", f"use one of {', '.join(AGENTS)}")
    if not isinstance(env, NavigationEnv):
        if name != "scripted":
            raise bad_input("agent", "agent", name, "drives rovers only", "use zero, random or scripted")
        return lambda state, key: _toward(state.info["goal_body"])
    modes = ("paper", "velocity") if name == "scripted" else ("velocity",)
    if env.config.action not in modes:
        remedy = f"use the action mode {' or '.join(modes)}"
        raise bad_input("agent", name, env.config.action, "is no action mode that it can drive in", remedy)
    if name == "rocking":
        return rocking_rule(env)
    if name == "reactive":
        return reactive_rule(env)
    if name == "mapper":
        return _mapper(env)
    if name == "planner":
        return _planner(env, env.params if params is None else params)
    return _driver(env)


def _toward(goal: Any) -> Any:
    # The longer component at full speed; slower within 0.1 m, so as not to overshoot.
    return goal / jnp.maximum(jnp.max(jnp.abs(goal), axis=-1, keepdims=True), 0.1)


def _driver(env: NavigationEnv) -> Agent:
    """Full speed ahead, steering in proportion to the bearing of the goal; suspension untouched."""
    joints = env.model.rover.joints
    fronts = [joints.index(w.steer) for w in env.model.rover.wheels if w.row == "front" and w.steer]
    torque = env.config.action == "paper"
    limit = min(env.model.rover.joint_limits[joints[i]][1] for i in fronts)

    def act(state: State, key: Any) -> Any:
        goal = state.info["goal_body"]
        bearing = jnp.arctan2(goal[:, 1], goal[:, 0])
        if env.config.escape_distance:
            # no goal to steer for
            bearing = jnp.zeros_like(bearing)
        wanted = jnp.clip(1.5 * bearing, -limit, limit)
        if torque:
            # a proportional controller for the angle: the motor's own damping does the rest
            angle = jnp.mean(state.info["joint_angle"][:, jnp.array(fronts)], axis=-1)
            steer = 2.0 * (wanted - angle) / limit
            speed = state.info["body_velocity"][:, 0]
            # Torque has no speed of its own; without a loop the rover would run away downhill.
            drive = jnp.clip(2.0 * (0.5 - speed), -1.0, 1.0)
        else:
            steer, drive = wanted / limit, jnp.ones_like(bearing)
        other_actions = jnp.zeros((goal.shape[0], env.action_size - 2), goal.dtype)
        return jnp.concatenate([jnp.stack([drive, jnp.clip(steer, -1.0, 1.0)], axis=-1), other_actions], axis=-1)

    return act


@dataclasses.dataclass(frozen=True)
class Reactive:
    """Settings of the reactive rule; lengths in m, for a rover as wide as LUVMI-X.

    Attributes:
      tall: height over the standing plane that is driven around. half_width: of the corridor that must be free.
      horizon: how far ahead it looks. turn_price: what a radian off the goal's bearing costs, in shares of the horizon.
      gain: steering angle per radian. near: free way below which it backs off. patience: s without progress after
        which it does so, too.
    """

    tall: float = 0.12
    half_width: float = 0.45
    horizon: float = 3.0
    turn_price: float = 0.5
    gain: float = 1.5
    near: float = 0.6
    patience: float = 4.0


def _steering_limit(env: NavigationEnv) -> float:
    rover = env.model.rover
    return min(rover.joint_limits[w.steer][1] for w in rover.wheels if w.row == "front" and w.steer)


def _wheels(env: NavigationEnv, drive: Any, steer: Any) -> Any:
    """Actions of the mode `velocity` from speed and steering, each (env,)."""
    first = jnp.stack([drive, jnp.clip(steer, -1.0, 1.0)], axis=-1)
    return jnp.pad(first, ((0, 0), (0, env.action_size - 2)))


@dataclasses.dataclass(frozen=True)
class Rocking:
    """Settings of the rule that rocks a rover out of its hole; choices.

    Attributes:
      period: s of once ahead and once back. free: m from the hole from which on it drives away from it.
    """

    period: float = 6.0
    free: float = 0.5


def rocking_rule(env: NavigationEnv, settings: Rocking | None = None) -> Agent:
    """Full speed ahead and back in turn; once out, on to the side that it is on.

    Raises:
      UserError: the environment is none to escape in, where `goal_body` would be a goal to drive away from.
    """
    if not env.config.escape_distance:
        raise bad_input("agent", "rocking", env.config.escape_distance, "is no escape_distance", "use the task escape")
    r = settings or Rocking()

    def act(state: State, key: Any) -> Any:
        hole = state.info["goal_body"]
        time = state.inner.steps.astype(hole.dtype) * env.control_interval
        rock = jnp.where(time % r.period < 0.5 * r.period, 1.0, -1.0)
        out = jnp.where(hole[:, 0] < 0.0, 1.0, -1.0)
        drive = jnp.where(jnp.linalg.norm(hole, axis=-1) > r.free, out, rock)
        return _wheels(env, drive, jnp.zeros_like(drive))

    return act


def reactive_rule(env: NavigationEnv, settings: Reactive | None = None) -> Agent:
    """Picks, of some headings, the one that is free for longest and nearest to the goal's; backs off where none is."""
    for block in ("height_scan", "waited"):
        if block not in env.blocks:
            raise bad_input("agent", "reactive", env.config.observations, f"lacks the block {block}", "add it")
    r, limit = settings or Reactive(), _steering_limit(env)
    scale = SCAN_SCALE.get(env.model.rover.name, 1.0)
    ahead, aside = (scale * a.ravel() for a in np.meshgrid(VIEW.scan_ahead, VIEW.scan_aside, indexing="ij"))
    headings = np.radians(np.arange(-75.0, 76.0, 15.0))
    along = ahead * np.cos(headings)[:, None] + aside * np.sin(headings)[:, None]
    across = np.abs(aside * np.cos(headings)[:, None] - ahead * np.sin(headings)[:, None])
    corridor = (along > 0.1) & (across < scale * r.half_width)
    horizon = scale * r.horizon

    def act(state: State, key: Any) -> Any:
        goal, scan = state.info["goal_body"], state.obs[:, env.blocks["height_scan"]]
        waited = 10.0 * state.obs[:, env.blocks["waited"]][:, 0]
        bearing = jnp.arctan2(goal[:, 1], goal[:, 0])
        far = jnp.sqrt(jnp.sum(goal * goal, axis=-1))
        # Holes as well as boulders.
        wall = (jnp.abs(scan) > scale * r.tall)[:, None, :] & corridor
        free = jnp.min(jnp.where(wall, along, horizon), axis=-1)
        # what lies behind the goal does not matter
        free = jnp.where(free > far[:, None], horizon, jnp.minimum(free, horizon)) / horizon
        # A goal behind is sought on the side where it is: all headings look ahead.
        off = jnp.abs(jnp.clip(bearing, -1.4, 1.4)[:, None] - headings)
        best = jnp.argmax(free - r.turn_price * off, axis=-1)
        heading = jnp.asarray(headings)[best]
        room = horizon * jnp.take_along_axis(free, best[:, None], axis=-1)[:, 0]
        backing = (room < scale * r.near) | (waited > r.patience)
        steer = r.gain * heading / limit
        # Backing off, the wheels are turned the other way, so that the rover comes out facing the free side.
        return _wheels(env, jnp.where(backing, -0.7, 1.0), jnp.where(backing, -steer, steer))

    return act


def _mapper(env: NavigationEnv) -> Agent:
    """Aims where the block `plan` says, and backs off where it comes no farther."""
    for block in ("plan", "waited"):
        if block not in env.blocks:
            raise bad_input("agent", "mapper", env.config.observations, f"lacks the block {block}", "add it")
    limit = _steering_limit(env)

    def act(state: State, key: Any) -> Any:
        aim = state.obs[:, env.blocks["plan"]][:, :2]
        waited = 10.0 * state.obs[:, env.blocks["waited"]][:, 0]
        drive, steer = toward(jnp.arctan2(aim[:, 1], aim[:, 0]), waited)
        return _wheels(env, drive, steer / limit)

    return act


def _planner(env: NavigationEnv, params: NavigationParams) -> Agent:
    """Follows the way over the planning grid that is cheapest where room is dear."""
    if params.pool is None or params.side is None:
        raise bad_input(
            "agent", "planner", env.config.rung, "is no rung of the ladder", "use a task ladder/1 to ladder/5"
        )
    follower, limit = Follower(params.pool), _steering_limit(env)

    def act(state: State, key: Any) -> Any:
        drive, steer = follower.command(state.inner)
        return _wheels(env, drive, steer / limit)

    return act
