"""The JAX engines (structured and MJX) behind the same interface, in float64 or float32.

For work with many rovers use `lunar_mjx.dynamics.System` and its batched functions: this adapter moves every state
between the host and the device.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.backends.base import Backend, BackendState, Observation, observation, whole_steps
from lunar_mjx.dynamics import Params, State, System, Telemetry, build
from lunar_mjx.dynamics.state import Temperature
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model
from lunar_mjx.pytree import tree_of
from lunar_mjx.simulate import Commands
from lunar_mjx.terrain import Terrain

PRECISIONS = ("float64", "float32")

_EACH_TERRAIN = tree_of(Params, gravity=None, ambient=None, effects=None, terrain=0)


class JaxBackend(Backend):
    """One of the package's JAX engines as a backend.

    Args:
      model: the model.
      engine: "structured", "mjx" or "auto".
      rovers: how many at once.
      precision: "float64" or "float32".

    Raises:
      UserError: unknown engine or precision, or a rover that the engine cannot run.
    """

    def __init__(self, model: Model, engine: str = "auto", rovers: int = 1, precision: str = "float64") -> None:
        if precision not in PRECISIONS:
            raise bad_input("backend", "precision", precision, "does not exist", f"use one of {', '.join(PRECISIONS)}")
        self.model, self.rovers, self.precision = model, rovers, precision
        with self._precision():
            self.system: System = build(model, engine)
            self.params = self.system.params
            self._advance = jax.jit(self._hold, static_argnames="axes")
        self.name = self.system.engine.name if precision == "float64" else f"{self.system.engine.name}, float32"
        self._axes: Params | None = None
        self._seen: Telemetry | None = None
        self.reset()

    @contextlib.contextmanager
    def _precision(self) -> Iterator[None]:
        # For the call alone: the switch is global, and other engines in this process want theirs.
        with jax.enable_x64(self.precision == "float64"):
            yield

    def _hold(self, params: Params, state: State, control: Any, count: Any, axes: Params | None) -> Any:
        """`count` steps under one control, and what the first saw: one program for single steps and for drives."""

        def one(k: Any, carry: tuple[State, Telemetry]) -> tuple[State, Telemetry]:
            new, now = self.system.step_batch(params, carry[0], control, params_axes=axes)
            return new, jax.tree.map(lambda a, b: jnp.where(k == 0, a, b), now, carry[1])

        # A loop needs its carry's shapes before the first step; this finds them without a step.
        shapes = jax.eval_shape(lambda s: self.system.step_batch(params, s, control, params_axes=axes)[1], state)
        empty = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
        # The count is traced: single steps and drives share one compiled program.
        return jax.lax.fori_loop(0, count, one, (state, empty))

    def _go(self, control: np.ndarray, count: int) -> Telemetry:
        held = jnp.asarray(self.controls(control), float)
        self._state, seen = self._advance(self.params, self._state, held, jnp.int32(count), axes=self._axes)
        return seen

    def set_terrain(self, terrain: Terrain, each: bool = False) -> None:
        """Puts another terrain under the rovers; nothing is compiled anew where its grids have the old one's shapes.

        Args:
          terrain: the ground, or with `each` a stack of one per rover.
          each: whether `terrain` has a leading axis of rovers.
        """
        with self._precision():
            floating = jax.tree.map(
                lambda a: jnp.asarray(a, float if np.asarray(a).dtype.kind == "f" else None), terrain
            )
            # the name is part of the compiled structure
            named = dataclasses.replace(floating, name=self.model.terrain.name)
            self.params = dataclasses.replace(self.params, terrain=named)
            self._axes = _EACH_TERRAIN if each else None

    def reset(self, x: Any = 0.0, y: Any = 0.0, yaw: Any = 0.0, winding_temperature: Any = None) -> BackendState:
        with self._precision():
            east, north, heading = (jnp.broadcast_to(jnp.asarray(v, float), (self.rovers,)) for v in (x, y, yaw))
            reset = jax.vmap(self.system.reset, in_axes=(self._axes, 0, 0, 0, None))
            self._state = reset(self.params, east, north, heading, winding_temperature)
        return self.state()

    def step(self, control: Any) -> None:
        with self._precision():
            self._seen = self._go(control, 1)

    def run(self, commands: Commands) -> Telemetry:
        steps_per_command = whole_steps(commands, self.model.timestep)
        values = np.asarray(commands.values, float)
        with self._precision():
            rows = [jax.device_get(self._go(values[..., k, :], steps_per_command)) for k in range(values.shape[-2])]
        return jax.tree.map(lambda *a: np.stack(a, axis=1), *rows)

    def state(self) -> BackendState:
        s = self._state
        effects = {e: {k: np.array(v, float) for k, v in own.items()} for e, own in s.effects.items()}
        return BackendState(
            step=int(np.asarray(s.step).flat[0]),
            qpos=np.array(s.qpos, float),
            qvel=np.array(s.qvel, float),
            winding_temperature=np.array(s.temperature.winding, float) + REFERENCE_TEMPERATURE,
            housing_temperature=np.array(s.temperature.housing, float) + REFERENCE_TEMPERATURE,
            effects=effects,
        )

    def set_state(self, state: BackendState) -> None:
        with self._precision():
            offsets = [
                jnp.asarray(k - REFERENCE_TEMPERATURE, float)
                for k in (state.winding_temperature, state.housing_temperature)
            ]
            # What Kahan's sums had lost is not part of a state that another engine can give.
            zero = jnp.zeros_like(offsets[0])
            effects = {
                e: {k: jnp.asarray(state.effects[e][k], float) for k in own} for e, own in self._state.effects.items()
            }
            self._state = State(
                step=jnp.full((self.rovers,), state.step, jnp.int32),
                qpos=jnp.asarray(state.qpos, float),
                qvel=jnp.asarray(state.qvel, float),
                temperature=Temperature(offsets[0], zero, offsets[1], zero),
                effects=effects,
            )

    def observe(self) -> Observation:
        if self._seen is None:
            raise bad_input(self.name, "observe", "nothing", "was seen before the first step", "call step first")
        return {k: v.astype(float) if v.dtype.kind == "f" else v for k, v in observation(self._seen).items()}
