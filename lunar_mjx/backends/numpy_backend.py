"""What the reference backends share: the NumPy physics around an engine that tells poses and takes forces."""

from __future__ import annotations

import abc
import copy
from collections.abc import Iterable
from typing import Any

import numpy as np

from lunar_mjx.backends.base import Backend, BackendState, Observation
from lunar_mjx.backends.hooks import Hook, Hooks
from lunar_mjx.backends.physics import Context, ForceModel, Ground, read_numbers
from lunar_mjx.backends.physics.standing import stand
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.model import Model, check_effects


class NumpyBackend(Backend):
    """A reference backend: NumPy forces on an engine's rigid bodies; see `Backend` and `hooks.Hook`."""

    def __init__(self, model: Model, hooks: Iterable[Hook] = (), rovers: int = 1) -> None:
        check_effects(model, self.name)
        self.model, self.rovers = model, rovers
        self.numbers = read_numbers(model, self.name)
        self.hooks = Hooks(hooks)
        self.ground = Ground(model.terrain)
        self.forces = ForceModel(self.numbers, self.ground, self.hooks, rovers)
        self._step = 0
        self._effects = self.forces.initial_state()
        self._winding = self._housing = np.zeros((rovers, len(self.numbers.mode)))
        self._context = Context(rovers)

    @abc.abstractmethod
    def _look(self, c: Context) -> None:
        """Fills the context's poses and velocities."""

    @abc.abstractmethod
    def _push(self, c: Context) -> None:
        """Applies the context's forces and advances the engine by one step."""

    @abc.abstractmethod
    def _place(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Puts the engine into a state."""

    @abc.abstractmethod
    def _coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        """Copies of qpos and qvel in the order of the rover's MJCF."""

    @property
    @abc.abstractmethod
    def _qpos0(self) -> np.ndarray:
        """Coordinates of the MJCF at zero joint angles, (nq,)."""

    def reset(self, x: Any = 0.0, y: Any = 0.0, yaw: Any = 0.0, winding_temperature: Any = None) -> BackendState:
        place = [np.broadcast_to(np.asarray(v, float), (self.rovers,)) for v in (x, y, yaw)]
        position, quaternion = stand(self.numbers, self.ground, *place)
        qpos = np.tile(self._qpos0, (self.rovers, 1))
        qpos[:, :3], qpos[:, 3:7] = position, quaternion
        self.hooks.reset()
        self._step = 0
        self._effects = self.forces.initial_state()
        # A rover that has not driven is as warm as its surroundings, housing and winding alike.
        warm = self.numbers.ambient_temperature(0.0) if winding_temperature is None else winding_temperature
        self._winding = np.zeros_like(self._winding) + warm
        self._housing = self._winding.copy()
        self._place(qpos, np.zeros((self.rovers, len(self._coordinates()[1][0]))))
        return self.state()

    def step(self, control: Any) -> None:
        # A new one every step: what an earlier step settled must not pass for this one's.
        c = self._context = Context(self.rovers)
        c.step = self._step
        c.winding_temperature, c.housing_temperature = self._winding, self._housing
        self._look(c)
        self.forces.start(
            c, control if isinstance(control, np.ndarray) and control.ndim == 2 else self.controls(control)
        )
        self._effects = self.forces.forces(c, self._effects)
        self._winding, self._housing = self.forces.heat(c)
        self._push(c)
        self._step += 1

    def state(self) -> BackendState:
        qpos, qvel = self._coordinates()
        effects = {e: {k: v.copy() for k, v in own.items()} for e, own in self._effects.items()}
        return BackendState(
            self._step,
            qpos,
            qvel,
            self._winding.copy(),
            self._housing.copy(),
            effects,
            copy.deepcopy(self.hooks.states),
        )

    def set_state(self, state: BackendState) -> None:
        self._step = state.step
        self._winding, self._housing = state.winding_temperature.copy(), state.housing_temperature.copy()
        self._effects = {e: {k: v.copy() for k, v in state.effects[e].items()} for e in self._effects}
        # The state of a backend without hooks tells nothing of them, and leaves them as they are.
        if len(state.hooks) == len(self.hooks.hooks):
            self.hooks.states = copy.deepcopy(state.hooks)
        self._place(state.qpos, state.qvel)

    def observe(self) -> Observation:
        return observe(self._context)


def observe(c: Context) -> Observation:
    """The context of a finished step as an observation."""
    current = np.zeros_like(c.joint_angle) if c.resistance is None else c.current
    resistance = 0.0 * current if c.resistance is None else c.resistance
    motor = c.numbers.effects.get("motor")
    back_emf = 0.0 if motor is None else c.torque_constant * motor.gear_ratio * c.joint_speed
    rotation = c.rotation
    euler = [
        np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2]),
        # Rounding may carry the entry past one, where the arcsine is no number.
        np.arcsin(np.clip(-rotation[:, 2, 0], -1.0, 1.0)),
        np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]),
    ]
    seen = {
        "time": np.full(c.rovers, c.time),
        "euler": np.stack(euler, axis=-1),
        "joint_torque": c.torque,
        "current": current,
        "voltage": current * resistance + back_emf,
        "joule_heat": current * current * resistance,
        "winding_heat": c.heat["winding"],
        "housing_heat": c.heat["housing"],
        "sinkage": c.contact["sinkage"],
        "slip": c.contact["slip"],
        "slip_angle": c.contact["slip_angle"],
        "wheel_force": c.wheel["force"],
        "wheel_moment": c.wheel["moment"],
        "on_terrain": c.contact["inside"],
    }
    names = (name for name in Telemetry.__dataclass_fields__ if name not in seen and name != "supply")
    return {k: np.array(v) for k, v in ({name: getattr(c, name) for name in names} | seen).items()}
