"""Environments for Gymnasium: one rover, or a batch in one program; importing this module registers them.

    import gymnasium as gym
    import lunar_mjx.envs.gymnasium_env
    env = gym.make("LunarMJX/Navigation-v0", task="consistent", render_mode="rgb_array")
    envs = gym.make_vec("LunarMJX/Navigation-v0", num_envs=256, task="large")

`gym.make("lunar_mjx.envs.gymnasium_env:LunarMJX/Navigation-v0")` imports it by itself.
"""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from lunar_mjx.envs.core import Environment, State, split_keys
from lunar_mjx.envs.ladder.rungs import RUNGS
from lunar_mjx.envs.picture import Picture
from lunar_mjx.envs.registry import make
from lunar_mjx.errors import bad_input

NAVIGATION, POINT = "LunarMJX/Navigation-v0", "LunarMJX/Point-v0"
_BOUND = 1e6
"""Bound of observations that their space states: they have none, and Gymnasium warns of infinite ones."""
RENDER_MODES = ("rgb_array",)


def _spaces(env: Environment) -> tuple[gym.spaces.Box, gym.spaces.Box]:
    observation = gym.spaces.Box(-_BOUND, _BOUND, (env.observation_size,), np.float32)
    return observation, gym.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32)


def _made(environment: Environment | str, options: dict[str, Any]) -> Environment:
    return make(environment, **options) if isinstance(environment, str) else environment


def _check_mode(render_mode: str | None, env: Environment) -> None:
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise bad_input("gym.make", "render_mode", render_mode, "does not exist", "use rgb_array or None")
    if render_mode is not None and not Picture.fits(env):
        raise bad_input("gym.make", "render_mode", render_mode, "has no rover to draw", "leave it out")


class SingleEnv(gym.Env):
    """One environment of this package for Gymnasium, without automatic reset.

    Args:
      environment: an `Environment`, or what `lunar_mjx.envs.make` takes: a name or my_env.py:maker.
      render_mode: "rgb_array", for environments with a rover, or None.
      view: of the pictures: "camera" (needs OpenGL), "top", or "auto": camera where it works.
      **options: of the environment's maker.

    Raises:
      UserError: unknown names or options.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 10}  # noqa: RUF012

    def __init__(
        self,
        environment: Environment | str = "navigation",
        render_mode: str | None = None,
        view: str = "auto",
        **options: Any,
    ):
        self.env = _made(environment, options)
        _check_mode(render_mode, self.env)
        self.render_mode = render_mode
        modes = list(RENDER_MODES) if Picture.fits(self.env) else []
        self.metadata = {"render_modes": modes, "render_fps": max(1, round(1.0 / self.env.control_interval))}
        self.observation_space, self.action_space = _spaces(self.env)
        # Compiled with the first call and not here: an environment may be made for its spaces alone.
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self._state: Any = None
        self._picture = Picture(self.env, view) if render_mode else None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begins an episode; the same seed gives the same start, goal and soil."""
        super().reset(seed=seed)
        # From Gymnasium's own generator: without a seed the next episode differs, with one it is the same again.
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self._state = self._reset(self.env.params, split_keys(key, 1))
        if self._picture:
            self._picture.begin(self._state)
        return np.asarray(self._state.obs[0], np.float32), _info(self._state, 0)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Acts once. After `terminated` or `truncated` call `reset`."""
        if self._state is None:
            raise bad_input("gym.step", "action", "a step", "comes before the first reset", "call reset first")
        self._state = self._step(self.env.params, self._state, jnp.asarray(action, jnp.float32)[None])
        # One transfer: field by field each would wait for the device.
        state = jax.device_get(self._state)
        done = bool(state.done[0])
        if self._picture:
            self._picture.add(self._state, done)
        # Metrics are sums over an episode: they mean something when it has ended.
        info = _info(state, 0) | ({k: float(v[0]) for k, v in state.metrics.items()} if done else {})
        return (
            # Gymnasium's single environment does not reset itself.
            np.asarray(state.final_obs[0], np.float32),
            float(state.reward[0]),
            bool(state.terminated[0]),
            bool(state.truncated[0]),
            info,
        )

    def render(self) -> np.ndarray | None:
        """A picture, (height, width, 3) uint8, in the render mode rgb_array."""
        if self._picture is None:
            return None
        return self._picture.frame()

    def close(self) -> None:
        if self._picture:
            self._picture.close()


def _info(state: State, index: int) -> dict[str, Any]:
    return {name: np.asarray(value[index]) for name, value in state.info.items()}


class NavigationGymEnv(SingleEnv):
    """Drive a lunar rover to a goal.

    ## Description
    A rover (LUVMI-X by default, or VIPER) stands on lunar ground and is sent to a goal in the plane. Contact, soil,
    motors and their heat are simulated with every effect of the model; the task is that of the seed paper's section V.

    ## Action space
    `Box(-1, 1, (n,), float32)`. In the mode `paper` six torques: drive, steering and one per suspension motor; in
    `velocity` the same six as wheel speed, steering angle and suspension angles; `joint_torque`, `joint_current` and
    `joint_velocity` take one number per motor.

    ## Observation space
    `Box(-1e6, 1e6, (n,), float32)`. By default 17 numbers:

    | index | what | unit |
    |---|---|---|
    | 0-2 | position from the start, world axes | m |
    | 3-5 | roll, pitch, yaw | rad |
    | 6-8 | velocity, world axes | m/s |
    | 9-11 | angular velocity, world axes | rad/s |
    | 12-14 | Kalman-filtered acceleration, world axes | m/s2 |
    | 15-16 | goal from the start, world axes | m |

    `observations=(...)` names other blocks: `lunar_mjx.envs.navigation.observations.BLOCKS`.

    ## Rewards
    Per action: 20 times the metres come nearer to the goal (`task="paper"`: as printed, the length of the way, which
    also pays for driving away), 0.1 cos(bearing of the goal), 0.05 (-|roll| - |pitch|) and -0.1 |vertical
    acceleration|; 500 at the goal and -60 at a failure. `large`: progress, 0.05 of the tilt, 0.02 of the acceleration
    and -0.02 times the squared change of the action; -100 at a failure.

    ## Starting state
    At rest on the ground within 2 m of the origin, heading within 90 degrees of the goal, 4 to 6 m away. The task
    `large` starts anywhere on rough ground with any heading, goals 10 to 40 m away, soil and motors drawn anew.

    ## Episode end
    Terminated at the goal (within 0.5 m; VIPER 1 m), rolled over (60 degrees), stuck (within 0.1 m for 8 s; task
    `large` 0.3 m for 10 s) or off the terrain. Truncated after 30 s (`large`: 120 s). `info` then holds `success`,
    `episode_return` and the ends.

    ## Arguments
    `task` = `paper`, `consistent` (default), `large`, `escape` (also `LunarMJX/Escape-v0`) or `ladder/1` to `ladder/5`
    (also `LunarMJX/Ladder1-v0` and so on); `rover`, `terrain`, `preset`, `model`, `engine`; every field of
    `lunar_mjx.envs.NavigationConfig`, such as `decimation` (physics steps per action), `episode_time` or
    `goal_distance`; `render_mode="rgb_array"`, `view` = `auto`, `camera` or `top`.

    ## Version history
    v0: first release.
    """


class VectorEnv(gym.vector.VectorEnv):
    """Many environments in one compiled program, each reset in the step in which it ends (SAME_STEP).

    `infos["final_obs"]` holds the true last observations, an object array with None where the episode goes on, and
    `infos["final_info"]` the metrics of the episodes that ended, each with its mask (`_final_obs`, `_final_info`).

    Args:
      num_envs: environments. environment, **options: as for `SingleEnv`.
      render_mode: None; pictures are made by the single environment.
    """

    def __init__(
        self,
        num_envs: int = 1,
        environment: Environment | str = "navigation",
        render_mode: str | None = None,
        **options: Any,
    ):
        # True is an int in Python.
        if isinstance(num_envs, bool) or not isinstance(num_envs, int) or num_envs < 1:
            raise bad_input("gym.make_vec", "num_envs", num_envs, "is not a whole number of at least 1", "give one")
        if render_mode is not None:
            raise bad_input(
                "gym.make_vec",
                "render_mode",
                render_mode,
                "does not exist for a batch",
                "render one environment from gym.make",
            )
        self.env, self.num_envs, self.render_mode = _made(environment, options), num_envs, None
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.single_observation_space, self.single_action_space = _spaces(self.env)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._reset, self._step = jax.jit(self.env.reset), jax.jit(self.env.step)
        self.state: Any = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict]:
        """Begins an episode in every environment."""
        super().reset(seed=seed)
        key = jax.random.PRNGKey(int(self.np_random.integers(2**31)))
        self.state = self._reset(self.env.params, split_keys(key, self.num_envs))
        return np.asarray(self.state.obs, np.float32), self._infos(jax.device_get(self.state.info))

    def step(self, actions: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Acts in every environment, `actions` (env, action)."""
        if self.state is None:
            raise bad_input("gym.step", "actions", "a step", "comes before the first reset", "call reset first")
        self.state = self._step(self.env.params, self.state, jnp.asarray(actions, jnp.float32))
        # The inner state stays on the device: for thousands of rovers it is most of the bytes.
        seen = {
            name: getattr(self.state, name)
            for name in ("obs", "final_obs", "reward", "terminated", "truncated", "info", "metrics")
        }
        seen = jax.device_get(seen)
        infos = self._infos(seen["info"])
        done = seen["terminated"] | seen["truncated"]
        if done.any():
            # Gymnasium's own form: None where the episode goes on.
            final = np.full(self.num_envs, None, dtype=object)
            for i in np.flatnonzero(done):
                final[i] = np.asarray(seen["final_obs"][i], np.float32)
            # Sums of unfinished episodes mean nothing.
            metrics = {k: np.where(done, v, 0.0) for k, v in seen["metrics"].items()}
            infos |= {
                "final_obs": final,
                "_final_obs": done.copy(),
                "_final_info": done.copy(),
                "final_info": self._infos(metrics, done),
            }
        return (
            np.asarray(seen["obs"], np.float32),
            np.asarray(seen["reward"], np.float64),
            np.asarray(seen["terminated"]),
            np.asarray(seen["truncated"]),
            infos,
        )

    def _infos(self, values: dict[str, Any], mask: np.ndarray | None = None) -> dict[str, Any]:
        mask = np.ones(self.num_envs, bool) if mask is None else mask
        return {**{k: np.asarray(v) for k, v in values.items()}, **{f"_{k}": mask.copy() for k in values}}


def _point(**options: Any) -> SingleEnv:
    return SingleEnv("point", **options)


def _point_vector(num_envs: int = 1, **options: Any) -> VectorEnv:
    return VectorEnv(num_envs, "point", **options)


def register() -> None:
    """Registers the environments with Gymnasium, once."""
    for name, single, vector in ((NAVIGATION, NavigationGymEnv, VectorEnv), (POINT, _point, _point_vector)):
        # This module may be imported by several names, and Gymnasium warns of a second registration.
        if name not in gym.registry:
            gym.register(name, entry_point=single, vector_entry_point=vector)
    tasks = {"Escape": "escape", **{f"Ladder{rung}": f"ladder/{rung}" for rung in RUNGS}}
    for word, task in tasks.items():
        name = f"LunarMJX/{word}-v0"
        if name not in gym.registry:
            gym.register(name, entry_point=NavigationGymEnv, vector_entry_point=VectorEnv, kwargs={"task": task})


register()
