"""A batch of environments for Stable-Baselines3's algorithms (extra `sb3`): DDPG, TD3, SAC and PPO train on it."""

from __future__ import annotations

from typing import Any

import gymnasium as gym
import numpy as np

from lunar_mjx.envs.core import Environment
from lunar_mjx.envs.gymnasium_env import VectorEnv
from lunar_mjx.errors import UserError

try:
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]
except ImportError as error:
    raise UserError("envs.sb3: stable-baselines3 is not installed; install the extra lunar-mjx[sb3].") from error


class SB3VecEnv(VecEnv):
    """`VectorEnv` as SB3 wants it: one list of infos, with `terminal_observation`, `TimeLimit.truncated`, `episode`.

    Args:
      num_envs: environments. environment, **options: as for `lunar_mjx.envs.gymnasium_env.SingleEnv`.
    """

    def __init__(self, num_envs: int, environment: Environment | str = "navigation", **options: Any):
        self.render_mode = None
        self.envs = VectorEnv(num_envs, environment, **options)
        super().__init__(num_envs, self.envs.single_observation_space, self.envs.single_action_space)
        self._actions: Any = None
        self._seed: int | None = None

    def reset(self) -> np.ndarray:
        # One seed for the batch: its environments have keys of their own.
        obs, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        self._reset_options()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict]]:
        obs, reward, terminated, truncated, seen = self.envs.step(self._actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        # Few environments end in a step; infos of the others stay empty.
        for i in np.flatnonzero(terminated | truncated):
            final = seen["final_info"]
            episode = {"r": float(final["episode_return"][i]), "l": int(final["episode_length"][i])}
            infos[i] = {
                "terminal_observation": seen["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(final["success"][i]),
                "episode": episode,
            }
        return obs, reward.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise UserError(f"SB3VecEnv: {attr_name} cannot be set: all environments are one program; make it anew.")

    def env_method(self, method_name: str, *method_args: Any, indices: Any = None, **method_kwargs: Any) -> list[Any]:
        raise UserError(f"SB3VecEnv: {method_name} cannot be called: all environments are one program.")

    def env_is_wrapped(self, wrapper_class: type[gym.Wrapper], indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))
