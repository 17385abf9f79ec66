"""Reads a model's parameters as plain numbers, and refuses the effects that this physics does not have."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.errors import UserError
from lunar_mjx.model import Model

MODES = ("position", "velocity", "torque", "current")

SUPPORTED = (
    "joint_control",
    "thermal_cutoff",
    "motor",
    "soil",
    "surface_type",
    "hard_surface",
    "soil_gradient",
    "pressure_sinkage",
    "penalty_contact",
    "shear_state",
    "closed_form_shear",
    "stress_integral",
    "printed_shear",
    "engine_friction",
    "hard_ground",
    "boulders",
    "static_boulders",
    "voltage_saturation",
    "directional_gear_efficiency",
    "slip_sinkage",
    "multipass",
    "ruts",
    "rim_contact",
    "skid_shear",
    "friction_circle",
    "bulldozing",
    "rolling_resistance",
    "gear_friction_heat",
    "chassis_contact",
    "joint_limits",
    "parking_brake",
    "payload",
    "com_offset",
    "wheel_radius_error",
    "steering_toe",
    "winding_conduction",
    "rotor_stator_path",
    "housing_convection",
    "housing_conduction",
    "housing_radiation",
)
"""Effects that the NumPy physics implements, by their names in the catalogue."""


@dataclasses.dataclass(frozen=True)
class Numbers:
    """A model as plain numbers.

    Attributes:
      effects: parameter values by effect, as attributes: float, or one per wheel or joint as an array.
      order: names of the effects by rising order, in list order where equal.
      gravity: m/s2. dt: s. integrator: "heun" or "euler". ambient: noon K, night K, time of noon s, period s.
      radius, width: of the wheels as drawn, (wheel,) m. steer: index of each wheel's steering joint, -1 if none.
      group: 0 drive, 1 steer, 2 suspension, (joint,). lower, upper: joint limits, (joint,) rad.
      mode: index into `MODES`, (joint,). position_gain: N m/rad. velocity_gain: N m s/rad.
      chassis_points: (point, 3) m, where the chassis can touch the ground, in its frame.
      box_center, box_half: (box, 3) m, the chassis' bounding boxes in its frame.
      feet: (wheel, 3) m, wheel centres in the chassis frame at zero joint angles.
      standing_height: m. joint_inertia: torque per acceleration of each joint of the rover as drawn, without
        rotors of motors, (joint,) kg m2.
    """

    effects: dict[str, SimpleNamespace]
    order: tuple[str, ...]
    gravity: float
    dt: float
    integrator: str
    ambient: tuple[float, float, float, float]
    radius: np.ndarray
    width: np.ndarray
    steer: np.ndarray
    group: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    mode: np.ndarray
    position_gain: np.ndarray
    velocity_gain: np.ndarray
    chassis_points: np.ndarray
    box_center: np.ndarray
    box_half: np.ndarray
    feet: np.ndarray
    standing_height: float
    joint_inertia: np.ndarray

    def __contains__(self, effect: str) -> bool:
        return effect in self.effects

    def ambient_temperature(self, time: float) -> float:
        """Ambient temperature at `time` s, K: the equilibrium of a surface under the Sun between night and noon."""
        noon, night, noon_time, period = self.ambient
        sun = np.cos(2.0 * np.pi * (time - noon_time) / period)
        # Sunlight taken in goes as the cosine of its angle and heat given off as T^4: hence the fourth root.
        return float(night + (noon - night) * max(sun, 0.0) ** 0.25)


def check_supported(model: Model, backend: str) -> None:
    """Raises `UserError` naming every effect of the model that the NumPy physics does not implement."""
    foreign = [
        e.name
        for e in model.effects
        # A user's effect may bear the name of one of ours; its physics is another.
        if e.name not in SUPPORTED or not all(f.__module__.startswith("lunar_mjx.effects") for f in e.ports.values())
    ]
    if foreign:
        raise UserError(
            f"{backend}: effects = {', '.join(foreign)} are not among those that this backend implements; remove them, "
            "or run the model on the structured or MJX engine."
        )


def read_numbers(model: Model, backend: str = "backend") -> Numbers:
    """The model as plain numbers.

    Args:
      model: the model.
      backend: name for the error.

    Raises:
      UserError: an effect that the NumPy physics does not implement.
    """
    check_supported(model, backend)
    if model.sun is not None:
        raise UserError(
            f"{backend}: sun = {model.sun.date or 'at rest'} is followed by the structured and MJX engines alone; run "
            "the model on one of these, or remove [sun]."
        )
    rover = model.rover
    groups = [g for g in rover.groups for _ in g.joints]
    kinds = ("drive", "steer", "suspension")
    limits = np.array([rover.joint_limits[j] for j in rover.joints], float)
    compiled = rover.compile()
    dofs = [compiled.joint(j).dofadr[0] for j in rover.joints]
    center, half = _boxes(compiled, rover.chassis)
    noon, night, noon_time, period = model.ambient
    return Numbers(
        effects={e.name: SimpleNamespace(**_values(model.parameters[e.name])) for e in model.effects},
        order=tuple(e.name for e in sorted(model.effects, key=lambda e: e.order)),
        gravity=float(model.gravity),
        dt=float(model.timestep),
        integrator=model.thermal_integrator,
        ambient=(float(noon), float(night), float(noon_time), float(period)),
        radius=np.array([w.radius for w in rover.wheels]),
        width=np.array([w.width for w in rover.wheels]),
        steer=np.array([rover.joints.index(w.steer) if w.steer else -1 for w in rover.wheels]),
        group=np.array([kinds.index(g.name) for g in groups]),
        lower=limits[:, 0],
        upper=limits[:, 1],
        mode=np.array([MODES.index(model.modes[g.name]) for g in groups]),
        position_gain=np.array([model.gains[g.name][0] for g in groups]),
        velocity_gain=np.array([model.gains[g.name][1] for g in groups]),
        chassis_points=np.asarray(rover.chassis_points, float).reshape(-1, 3),
        box_center=center,
        box_half=half,
        feet=_feet(compiled, rover),
        standing_height=float(rover.standing_height),
        joint_inertia=1.0 / compiled.dof_invweight0[dofs] - ("motor" in model.parameters) * compiled.dof_armature[dofs],
    )


def _values(parameters: Any) -> dict[str, Any]:
    return {k: np.asarray(v, float) if isinstance(v, tuple) else float(v) for k, v in parameters.items()}


def _boxes(model: mujoco.MjModel, chassis: str) -> tuple[np.ndarray, np.ndarray]:
    """Boxes around the chassis' shapes along its axes: centres and half sides, (box, 3)."""
    centers, halves = [], []
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] != model.body(chassis).id:
            continue
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        rotation = rotation.reshape(3, 3)
        centers.append(model.geom_pos[geom] + rotation @ model.geom_aabb[geom, :3])
        # Half sides of the box along the axes that holds a turned box.
        halves.append(np.abs(rotation) @ model.geom_aabb[geom, 3:])
    return np.reshape(centers, (-1, 3)), np.reshape(halves, (-1, 3))


def _feet(model: mujoco.MjModel, rover: Any) -> np.ndarray:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    chassis = model.body(rover.chassis).id
    wheels = [model.body(w.body).id for w in rover.wheels]
    return (data.xpos[wheels] - data.xpos[chassis]) @ data.xmat[chassis].reshape(3, 3)
