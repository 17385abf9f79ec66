"""A rover that a trained policy drives from goal to goal, in real time, for somebody who looks on."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.envs import NavigationEnv, split_keys
from lunar_mjx.envs.navigation.view import Reader
from lunar_mjx.errors import UserError
from lunar_mjx.model import ZERO_CELSIUS
from lunar_mjx.terrain import height
from lunar_mjx.viewer.pilot import Onlooker
from lunar_mjx.viewer.thrown import LiveDust


@dataclasses.dataclass(frozen=True)
class PolicyPace:
    """How a policy drives in the viewer."""

    most_steps: int = 2
    """Control intervals that one tick may catch up with: a slow machine falls behind rather than stops."""
    told: float = 4.0
    """For how long the end of an episode is told, s."""


POLICY_PACE = PolicyPace()


ENDS = {
    "success": "Goal reached",
    "rolled_over": "Rolled over",
    "stuck": "Stuck",
    "off_terrain": "Left the terrain",
    "diverged": "The simulation diverged",
}
"""How an episode ended, in words, by the environment's metric."""


class PolicyDrive:
    """An agent drives one episode after the other.

    Args:
      env: the navigation task. agent: actions (1, action) of a state and a key. name: of the agent, to be shown.
      params: ground, places and soil; the environment's own if None. seed: of the episodes.

    Attributes:
      model: with the ground that is driven on. time: s since the episode began. path: driven in it, m. rate: times
        real time. note: how the last episode ended, for a few seconds.
      scene: what the page is told once beside rover and ground.

    Raises:
      UserError: an environment without a rover.
    """

    live = True

    def __init__(
        self, env: Any, agent: Callable[[Any, Any], Any], name: str, params: Any = None, seed: int = 0
    ) -> None:
        if not isinstance(env, NavigationEnv):
            raise UserError(f"view: {name} was not trained to drive a rover; give a policy of the navigation task.")
        params = env.params if params is None else params
        self.model = env.model.replace(terrain=params.system.terrain)
        self.pilot, self.rate, self.note = Onlooker(), 1.0, ""
        self.scene: dict[str, Any] = {"driver": name}
        self._env, self._seed, self._episode, self._steps = env, seed, 0, 0
        self._reader, self._joints = Reader(env.system), joint_channels(env.model.rover)
        self._mj = env.model.rover.compile()
        self._data = mujoco.MjData(self._mj)
        self._drives = [env.model.rover.joints.index(w.drive) for w in env.model.rover.wheels]

        def step(params: Any, state: Any, key: Any) -> Any:
            return env.step(params, state, agent(state, key))

        # the ground is an argument: as a constant of the program it would be folded for twenty seconds
        self._step, self._params = jax.jit(step), params
        self._reset = jax.jit(lambda params, key: env.reset(params, split_keys(key, 1)))
        self._pose = jax.jit(self._reader.pose)
        self._told, self._ground = 0.0, 0.0
        self._thrown = LiveDust(self.model)
        self._goal: np.ndarray | None = None
        self.reset()
        self._go()  # compiles before anybody waits for a picture
        self._episode = 0
        self.reset()

    def reset(self) -> None:
        """Begins another episode, elsewhere and with another goal."""
        self._state = self._reset(self._params, jax.random.PRNGKey(self._seed + self._episode))
        self._episode += 1
        self._begin()
        self.note = ""

    def _begin(self) -> None:
        self.time, self.path, self._behind = 0.0, 0.0, 0.0
        self._take()
        self._from = self._to
        self._thrown.begin()
        self._thrown.add(self.time, self._to)

    def _take(self) -> None:
        """Reads what a picture shows from the state."""
        inner = self._state.inner
        self._to = np.asarray(inner.physics.qpos[0], float)
        goal = np.asarray(inner.goal[0], float)
        if self._goal is None or (goal != self._goal).any():
            self._goal, self._ground = goal, float(height(self._params.system.terrain.field, *goal))
        self._seen = {k: np.asarray(v[0]) for k, v in self._pose(inner.physics).items()}
        self._seen |= {"slip": np.asarray(inner.slip[0]), "sinkage": np.asarray(inner.sinkage[0])}

    def advance(self, duration: float) -> float:
        """Drives on by whole control intervals; what is left over is shown between two states. Returns s driven."""
        interval = self._env.control_interval
        # Capped, or a pause of the machine would be followed by a burst of steps.
        self._behind = min(self._behind + duration, (POLICY_PACE.most_steps + 1) * interval)
        self._told -= duration
        if self._told < 0.0:
            self.note = ""
        driven = 0.0
        while self._behind >= interval - 1e-9:
            self._go()
            self._behind = max(self._behind - interval, 0.0)
            driven += interval
        return driven

    def _go(self) -> None:
        key = jax.random.fold_in(jax.random.PRNGKey(self._seed + 1), self._steps)
        self._state, self._steps = self._step(self._params, self._state, key), self._steps + 1
        if bool(self._state.done[0]):
            # the environment has begun the next episode by itself
            flags = {k: float(self._state.metrics[k][0]) for k in ENDS}
            end = next((text for k, text in ENDS.items() if flags[k] > 0), "Time is up")
            done = f"{end} after {self.time:.0f} s and {self.path:.1f} m: on to the next goal."
            self._begin()
            self.note, self._told = done, POLICY_PACE.told
            return
        self._from = self._to
        self._take()
        self.time += self._env.control_interval
        self.path += float(np.hypot(*(self._to[:2] - self._from[:2])))
        self._thrown.add(self.time, self._to)

    @property
    def qpos(self) -> np.ndarray:
        """Coordinates (nq,) of the rover's MJCF: between the last two states, so that it moves without jerks."""
        share = min(self._behind / self._env.control_interval, 1.0)
        far = self._to.copy()
        if float(far[3:7] @ self._from[3:7]) < 0.0:
            far[3:7] *= -1.0  # the same attitude, and the shorter way to it
        return (1.0 - share) * self._from + share * far

    def dust(self) -> Grains:
        """What the wheels throw up in the moment that is shown, which lies before the last state."""
        return self._thrown.at(self.time - max(self._env.control_interval - self._behind, 0.0))

    def bodies(self) -> np.ndarray:
        """Place and quaternion (w, x, y, z) of every body of the rover's MJCF, (body, 7), the world's first."""
        self._data.qpos[:] = self.qpos
        mujoco.mj_kinematics(self._mj, self._data)
        return np.concatenate([self._data.xpos, self._data.xquat], axis=1)

    def readings(self) -> dict[str, Any]:
        """What instruments would show, as `LiveDrive.readings`, and the goal: x, y, z in m and how far it is."""
        seen, goal = self._seen, self._goal
        assert goal is not None
        winding = seen["winding_temperature"] - ZERO_CELSIUS
        hottest = int(np.argmax(winding))
        roll, pitch, yaw = (float(np.degrees(seen[k])) for k in ("roll", "pitch", "yaw"))
        return {
            "time_s": self.time,
            "path_m": self.path,
            "speed_m_s": float(np.hypot(*seen["velocity"][:2])),
            "heading_deg": yaw % 360.0,
            "roll_deg": roll,
            "pitch_deg": pitch,
            "power_W": None,
            "slip": seen["slip"].tolist(),
            "sinkage_mm": (1e3 * seen["sinkage"]).tolist(),
            "winding_degC": winding[self._drives].tolist(),
            "hottest": self._joints[hottest],
            "hottest_degC": float(winding[hottest]),
            "rate": self.rate,
            "goal": [*goal.tolist(), self._ground],
            "goal_m": float(np.hypot(*(goal - self._to[:2]))),
            "note": self.note,
        }
