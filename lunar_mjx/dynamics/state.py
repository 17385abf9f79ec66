"""The state of a simulated rover, its parameters, and what a step reports; one layout for every engine."""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float

from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.model.ambient import Ambient
from lunar_mjx.pytree import AnyArray, pytree
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.sky import Sun


@pytree
class Temperature:
    """Temperatures as offsets from 298.15 K, each with the rounding that its last sum lost.

    In float32 a value near 300 K cannot take the increments of a millisecond step; offsets with a compensated
    (Kahan) sum can.
    """

    winding: Float[Array, "*batch joint"]
    winding_lost: Float[Array, "*batch joint"]
    housing: Float[Array, "*batch joint"]
    housing_lost: Float[Array, "*batch joint"]

    @property
    def winding_kelvin(self) -> Any:
        """Temperature of the windings, K; the state holds differences from the reference."""
        return self.winding + REFERENCE_TEMPERATURE

    @property
    def housing_kelvin(self) -> Any:
        """Temperature of the housings, K; the state holds differences from the reference."""
        return self.housing + REFERENCE_TEMPERATURE


def compensated_add(total: Any, lost: Any, increment: Any) -> tuple[Any, Any]:
    """Kahan's sum: returns the new total and the rounding that it lost."""
    # Do not simplify: the parentheses are the algorithm, and XLA keeps the order of float operations.
    increment = increment - lost
    new = total + increment
    return new, (new - total) - increment


@pytree
class State:
    """State of one rover.

    Attributes:
      step: number of steps since reset.
      qpos, qvel: MuJoCo's generalised positions and velocities, with the dependent joints of closed loops.
      temperature: of every actuated joint's motor.
      effects: state of the effects, by effect and name.
    """

    step: Any
    qpos: Float[Array, "*batch nq"]
    qvel: Float[Array, "*batch nv"]
    temperature: Temperature
    effects: dict[str, dict[str, Any]]


@pytree
class Params:
    """Everything that may differ between rovers of one batch.

    Attributes:
      gravity: m/s2, positive.
      ambient: ambient temperature.
      effects: parameters by effect and name, each a number or one per wheel or joint.
      terrain: the ground.
      sun: over it; None where no effect reads it but the ambient temperature, which then has a day of its own.
    """

    gravity: Any
    ambient: Ambient
    effects: dict[str, dict[str, Any]]
    terrain: Terrain
    sun: Sun | None = None

    def ambient_temperature(self, time: Any) -> Any:
        """K at `time`, s: by the height of the Sun where there is one, else by the ambient's own day."""
        if self.sun is None:
            return self.ambient.at(time)
        return self.ambient.under(self.sun.towards(time).z / self.sun.highest)


@pytree
class Supply:
    """Electric power and the chassis' temperature; None where no effect of the model tells.

    Attributes:
      load: drawn from the bus, W. solar: from the panels, W. charge: of the battery, 0 to 1. voltage: of the bus, V.
      chassis_temperature: K.
    """

    load: Float[AnyArray, "*batch"] | None = None
    solar: Float[AnyArray, "*batch"] | None = None
    charge: Float[AnyArray, "*batch"] | None = None
    voltage: Float[AnyArray, "*batch"] | None = None
    chassis_temperature: Float[AnyArray, "*batch"] | None = None


@pytree
class Telemetry:
    """What a step reports, at the beginning of that step (the seed paper's III-E, with temperatures, slip, sinkage).

    Attributes:
      time: s.
      position: of the chassis frame, world, m. quaternion: w, x, y, z, body to world. euler: roll, pitch, yaw, rad.
      velocity, angular_velocity: of the chassis frame in world coordinates, m/s, rad/s.
      joint_angle, joint_speed: rad, rad/s. joint_torque: of the motors at the joints, N m.
      current: motor current, A. voltage: V. winding_temperature, housing_temperature: K.
      joule_heat, winding_heat, housing_heat: heat made in the winding; net heat into winding and housing, W.
      wheel_position, wheel_velocity: world, m, m/s. sinkage: m. slip: eq. 8. slip_angle: rad.
      wheel_force, wheel_moment: of the ground on the wheel, wheel frame (forward, left, normal), N, N m.
      on_terrain: whether each wheel is over the terrain's grid.
      supply: electric power, of JAX engines with effects at the port `power` or a chassis node; else None.
    """

    time: Any
    position: Vec3
    quaternion: Float[AnyArray, "*batch 4"]
    euler: Vec3
    velocity: Vec3
    angular_velocity: Vec3
    joint_angle: Float[AnyArray, "*batch joint"]
    joint_speed: Float[AnyArray, "*batch joint"]
    joint_torque: Float[AnyArray, "*batch joint"]
    current: Float[AnyArray, "*batch joint"]
    voltage: Float[AnyArray, "*batch joint"]
    winding_temperature: Float[AnyArray, "*batch joint"]
    housing_temperature: Float[AnyArray, "*batch joint"]
    joule_heat: Float[AnyArray, "*batch joint"]
    winding_heat: Float[AnyArray, "*batch joint"]
    housing_heat: Float[AnyArray, "*batch joint"]
    wheel_position: Vec3
    wheel_velocity: Vec3
    sinkage: Float[AnyArray, "*batch wheel"]
    slip: Float[AnyArray, "*batch wheel"]
    slip_angle: Float[AnyArray, "*batch wheel"]
    wheel_force: Vec3
    wheel_moment: Vec3
    on_terrain: AnyArray
    supply: Supply | None = None
