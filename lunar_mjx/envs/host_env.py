"""The navigation task for Gymnasium around physics that run elsewhere: a backend in NumPy, such as PyBullet.

from lunar_mjx.backends.pybullet import PyBulletBackend
env = HostedEnv(PyBulletBackend, task="large", randomise=())
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.envs.gymnasium_env import SingleEnv
from lunar_mjx.envs.navigation.env import NavigationEnv, NavigationParams
from lunar_mjx.envs.registry import make
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree


@pytree
class _HostParams(NavigationParams):
    """Parameters with what the backend made of the action: state, slip and sinkage."""

    driven: Any = None


class _HostTask(NavigationEnv):
    """The navigation task around physics that ran elsewhere."""

    def _drive(self, params: Any, inner: Any, action: Any) -> Any:
        physics, *seen = params.driven
        return physics, tuple(seen)


class HostedEnv(SingleEnv):
    """One rover whose physics between two actions is a backend's; observations, rewards and ends are the task's.

    Soil and motors are the model's own in every episode: a backend does not draw them.

    Args:
      backend: makes the backend of a model. **options: as for `make_navigation`.

    Raises:
      UserError: unknown options, an effect that the backend lacks, or actions that set another quantity of the motors
        than the model's backend controls.
    """

    def __init__(self, backend: Callable[[Any], Any], **options: Any):
        made: Any = make("navigation", **options)
        super().__init__(_HostTask(made.model, made.config))
        self.env: Any
        self.backend = backend(made.model)
        if (self.backend.numbers.mode != self.env.actions.mode).any():
            remedy = "choose an action that sets what the model's motors are controlled by"
            raise bad_input("HostedEnv", "action", made.config.action, "is not what the backend controls", remedy)
        self._around, self._step = jax.jit(self._after), self._drive

    def _after(self, params: Any, state: Any, action: Any, driven: Any) -> Any:
        fields = {name: getattr(params, name) for name in NavigationParams.__dataclass_fields__}
        return self.env.step(_HostParams(**fields, driven=driven), state, action)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        """Begins an episode, in the backend where the task's own physics stands."""
        obs, info = super().reset(seed=seed)
        physics = self._state.inner.physics
        qpos = np.asarray(physics.qpos[0], float)
        w, x, y, z = qpos[3:7]
        yaw = float(np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
        warm = float(physics.temperature.winding[0, 0]) + REFERENCE_TEMPERATURE
        self.backend.reset(qpos[0], qpos[1], yaw, warm)
        return obs, info

    def _drive(self, params: Any, state: Any, action: Any) -> Any:
        """The state after an action: the backend drives, the task does the rest."""
        control = np.asarray(self.env.actions.controls(action), float)
        for _ in range(self.env.config.decimation):
            self.backend.step(control)
        seen, now, old = self.backend.observe(), self.backend.state(), state.inner.physics
        single = functools.partial(jnp.asarray, dtype=jnp.float32)
        kelvin = {"winding": now.winding_temperature, "housing": now.housing_temperature}
        warm = {name: single(value - REFERENCE_TEMPERATURE) for name, value in kelvin.items()}
        warm = dataclasses.replace(old.temperature, **warm)
        physics = dataclasses.replace(old, qpos=single(now.qpos), qvel=single(now.qvel), temperature=warm)
        return self._around(params, state, action, (physics, single(seen["slip"]), single(seen["sinkage"])))
