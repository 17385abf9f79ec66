"""What the force models and the hooks see of a step: plain NumPy arrays with a leading axis of rovers."""

from __future__ import annotations

from typing import Any

import numpy as np

Values = dict[str, np.ndarray]


class Context:
    """The rovers at the beginning of a step, and what the step has settled so far.

    Shapes: n rovers, w wheels, j actuated joints. SI units, temperatures in kelvin, world coordinates.

    Set before the first hook:
      time: s. step: number of steps since reset. dt: s. gravity: m/s2. ambient_temperature: K.
      position (n, 3), rotation (n, 3, 3) chassis to world, quaternion (n, 4), velocity (n, 3), angular_velocity (n, 3):
        of the chassis frame.
      joint_angle, joint_speed (n, j): rad, rad/s, output side of the gear.
      winding_temperature, housing_temperature (n, j): K.
      steering_angle (n, w): rad, positive to the left.
      wheel_position, wheel_axle, wheel_velocity, wheel_angular_velocity (n, w, 3): of the wheels' centres.
      control (n, j): the command as given.
      numbers: the model's parameters as plain numbers. ground: the terrain.

    Filled as the step goes on (None before):
      target (n, j): the command after the hooks. current (n, j): motor current, A. torque (n, j): at the joints, N m.
      resistance, torque_constant (n, j): of the windings at their temperature.
      geometry: radius, width, toe (n, w) m, m, rad; payload_mass (n,) kg; payload_position, com_offset (n, 3) m.
      contact: sinkage, sinkage_rate, slip, slip_angle, v_x, v_y, rim_speed (n, w); forward, left, normal (n, w, 3):
        the wheel frame in world coordinates; inside (n, w).
      soil: k_c, k_phi, n, cohesion, tan_phi, shear_modulus_x, shear_modulus_y, rock (n, w).
      normal: entrance, exit, theta_m rad, sigma_m Pa, load, resistance, damping N (n, w).
      slip: slip_x, slip_y, direction (n, w): what the shear force is computed from.
      wheel: force, moment (n, w, 3): on the wheel in the wheel frame, N, N m.
      body: force, moment (n, 3) on the chassis at its frame, world; joint_torque (n, j), N m.
      heat: winding, housing (n, j) W into the nodes; winding_capacity, housing_capacity (n, j) J/K.
    """

    position: Any
    rotation: Any
    quaternion: Any
    velocity: Any
    angular_velocity: Any
    joint_angle: Any
    joint_speed: Any
    winding_temperature: Any
    housing_temperature: Any
    heat_winding_temperature: Any
    heat_housing_temperature: Any
    steering_angle: Any
    wheel_position: Any
    wheel_axle: Any
    wheel_velocity: Any
    wheel_angular_velocity: Any
    control: Any
    numbers: Any
    ground: Any
    dt: float
    gravity: float
    ambient_temperature: float
    chassis_point: Any
    chassis_ground: Any

    def __init__(self, rovers: int) -> None:
        self.rovers = rovers
        self.time: float = 0.0
        self.step: int = 0
        self.resistance_factor: Any = 1.0
        self.target: Any = None
        self.current: Any = None
        self.torque: Any = None
        self.resistance: Any = None
        self.torque_constant: Any = None
        self.geometry: Values = {}
        self.contact: Values = {}
        self.soil: Values = {}
        self.normal: Values = {}
        self.slip: Values = {}
        self.wheel: Values = {}
        self.body: Values = {}
        self.heat: Values = {}
