"""One small interface for every engine: reset, step, state, the stages of a step, and a run as log channels."""

from __future__ import annotations

import abc
import dataclasses
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.backends.log_channels import log_channels
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands
from lunar_mjx.spatial import Vec3

Observation = dict[str, np.ndarray]
"""What a step saw at its beginning, by the names of `Telemetry`; vectors are (rover, 3) or (rover, wheel, 3)."""

STAGES: dict[str, tuple[str, ...]] = {
    "wheel poses": ("wheel_position", "wheel_velocity"),
    "slip": ("slip", "slip_angle"),
    "sinkage": ("sinkage",),
    "soil wrench": ("wheel_force", "wheel_moment"),
    "motor torque": ("joint_torque", "current"),
    "heat": ("winding_heat", "housing_heat"),
    "acceleration": ("acceleration",),
}
"""Stages of one step, in the order in which one depends on those before it, and their quantities."""


@dataclasses.dataclass
class BackendState:
    """State of n rovers, in one layout for every engine; arrays are copies.

    Attributes:
      step: number of steps since reset.
      qpos, qvel: MuJoCo's generalised coordinates and velocities of the rover's MJCF, (n, nq), (n, nv).
      winding_temperature, housing_temperature: of every actuated joint's motor, (n, joint), K.
      effects: state of the effects, by effect and name, (n, wheel) or (n, joint).
      hooks: states of the hooks, in their order.
    """

    step: int
    qpos: np.ndarray
    qvel: np.ndarray
    winding_temperature: np.ndarray
    housing_temperature: np.ndarray
    effects: dict[str, dict[str, np.ndarray]]
    hooks: list[dict[str, Any]] = dataclasses.field(default_factory=list)


class Backend(abc.ABC):
    """A model on one engine. All arrays have a leading axis of rovers, also for one rover.

    Attributes:
      name: of the engine. model: what runs. rovers: how many at once.
    """

    name: str
    model: Model
    rovers: int

    @abc.abstractmethod
    def reset(self, x: Any = 0.0, y: Any = 0.0, yaw: Any = 0.0, winding_temperature: Any = None) -> BackendState:
        """Rovers at rest on the terrain, joints at zero, leaning with the slope under their wheels.

        Args:
          x, y, yaw: start, m and rad; a number or one per rover.
          winding_temperature: of all motors, winding and housing alike, K; ambient if None.
        """

    @abc.abstractmethod
    def step(self, control: Any) -> None:
        """Advances by one time step with a control (joint,) or (rover, joint), in the unit of each joint's mode."""

    @abc.abstractmethod
    def state(self) -> BackendState:
        """Copies of the engine's state."""

    @abc.abstractmethod
    def set_state(self, state: BackendState) -> None:
        """Continues from another state, of this engine or another."""

    @abc.abstractmethod
    def observe(self) -> Observation:
        """What the last step saw at its beginning, as copies."""

    def close(self) -> None:  # noqa: B027 - most engines hold nothing outside Python
        """Frees what the engine holds outside Python."""

    def controls(self, control: Any) -> np.ndarray:
        """The control as (rover, joint), checked."""
        wanted = (self.rovers, len(self.model.rover.joints))
        values = np.asarray(control, float)
        if values.shape not in (wanted, wanted[1:]):
            raise bad_input(
                f"{self.name}.step", "control", values.shape, "has another shape", f"give ({wanted[1]},) or {wanted}"
            )
        # One control drives all rovers alike.
        return np.broadcast_to(values, wanted)

    def stages(self, control: Any) -> dict[str, Observation]:
        """Every stage of the step that `control` would make from the present state, which stays as it is."""
        # The step is made and taken back: engines have no other way to tell its stages.
        before = self.state()
        self.step(control)
        seen = self.observe()
        # Engines integrate velocities semi-implicitly: the difference quotient is the acceleration of the step, to
        # rounding.
        seen["acceleration"] = (self.state().qvel - before.qvel) / self.model.timestep
        self.set_state(before)
        return {stage: {name: seen[name] for name in names} for stage, names in STAGES.items()}

    def run(self, commands: Commands) -> Telemetry:
        """Drives through a sequence of commands from the present state.

        Args:
          commands: values (time, joint) for all rovers or (rover, time, joint), each held for the interval.

        Returns:
          Telemetry at the beginning of every command, NumPy arrays with leading axes (rover, time).

        Raises:
          UserError: an interval that is no whole number of time steps, or a run that diverged.
        """
        steps_per_command = whole_steps(commands, self.model.timestep)
        values = np.asarray(commands.values, float)
        rows = []
        with np.errstate(all="ignore"):  # a run that diverges is told below, not by a warning
            for k in range(values.shape[-2]):
                control = self.controls(values[..., k, :])
                for i in range(steps_per_command):
                    self.step(control)
                    if i == 0:
                        rows.append(self.observe())
                # Once a command and not once a step: NaN stays, and checks cost.
                self._check_finite(rows[-1])
        return telemetry(rows)

    def _check_finite(self, seen: Observation) -> None:
        fine = np.isfinite(seen["position"]).all() and np.isfinite(seen["velocity"]).all()
        if not (fine and np.isfinite(seen["joint_speed"]).all()):
            time_s = round(float(seen["time"].flat[0]), 6)
            raise bad_input(
                self.name,
                "time, s",
                time_s,
                "is where the simulation diverged",
                "use a smaller timestep_s, softer gains or smaller commands",
            )

    def channels(self, seen: Telemetry, commands: Commands, rover: int = 0) -> pd.DataFrame:
        """One rover's telemetry as log channels (units in the names, temperatures in degrees Celsius)."""
        return log_channels(self.model, seen, commands, rover)


def whole_steps(commands: Commands, timestep: float) -> int:
    """Time steps for which each command is held."""
    steps_per_command = round(commands.interval / timestep)
    if steps_per_command < 1 or abs(steps_per_command * timestep - commands.interval) > 1e-3 * commands.interval:
        better = commands.interval / max(steps_per_command, 1)
        raise bad_input(
            "run",
            "interval",
            f"{commands.interval:g} s",
            f"is no whole number of time steps of {timestep:g} s",
            f"set timestep_s = {better:.6g}, or resample the commands",
        )
    return steps_per_command


VECTORS = (
    "position",
    "velocity",
    "angular_velocity",
    "wheel_position",
    "wheel_velocity",
    "wheel_force",
    "wheel_moment",
    "euler",
)


def telemetry(rows: list[Observation]) -> Telemetry:
    """Observations of several times as `Telemetry` with leading axes (rover, time)."""
    names = [f.name for f in dataclasses.fields(Telemetry) if f.name in rows[0]]
    stacked = {name: np.stack([row[name] for row in rows], axis=1) for name in names}
    fields: dict[str, Any] = {k: Vec3(*np.moveaxis(v, -1, 0)) if k in VECTORS else v for k, v in stacked.items()}
    return Telemetry(**fields)


def observation(seen: Telemetry) -> Observation:
    """A batch of telemetry as plain arrays; without `supply`, of which reference backends know nothing."""
    return {
        f.name: np.stack([np.asarray(a) for a in value], -1) if isinstance(value, Vec3) else np.asarray(value)
        for f in dataclasses.fields(seen)
        for value in (getattr(seen, f.name),)
        if f.name != "supply"
    }
