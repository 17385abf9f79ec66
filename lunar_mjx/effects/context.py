"""The common context that every port sees, and the values that ports hand on.

Shapes are those of one rover: `wheel` arrays have one entry per wheel, `joint` arrays one per actuated joint. All is
in SI units, temperatures in kelvin. Fields that a later part of the step fills are None before it.
"""

from __future__ import annotations

from typing import Any

from jaxtyping import Array, Float, Int

from lunar_mjx.pytree import AnyArray, pytree, static
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.sky import Sunlight


@pytree
class Command:
    """Value of the port `command`.

    Attributes:
      target: commanded control in the unit of each joint's mode (rad, rad/s, N m or A).
      current: motor current that the controller asks for, A.
    """

    target: Float[Array, "joint"]
    current: Float[Array, "joint"]


@pytree
class Geometry:
    """Value of the port `geometry`: the rover as it is, not as it was drawn.

    Attributes:
      radius, width: of the wheels, m.
      toe: angle of each wheel about its steering axis beyond the steering angle, rad, positive to the left.
      payload_mass: point mass carried on the chassis, kg.
      payload_position: its place in the chassis frame, m.
      com_offset: shift of the chassis' centre of mass, in the chassis frame, m.
      gravity: true gravity, m/s2; None where it is as stated.
      rim_share: share of the plane that is fitted along the rim; None for the tangent below the axle alone.
      relief: soil that wheels moved, whose `at(x, y)` gives its height first; None where none is remembered.
    """

    radius: Float[Array, "wheel"]
    width: Float[Array, "wheel"]
    toe: Float[Array, "wheel"]
    payload_mass: Any
    payload_position: Vec3
    com_offset: Vec3
    # None, and not neutral numbers: a model without such effects compiles no operation for them.
    gravity: Any = None
    rim_share: Any = None
    relief: Any = None


@pytree
class Contact:
    """How each wheel meets the ground.

    Attributes:
      sinkage: depth of the wheel's lowest point below the undisturbed surface, m; 0 for an airborne wheel.
      sinkage_rate: its rate, m/s, positive when sinking.
      slip: slip ratio of eq. 8 in the direction of travel (positive when driving faster than travelling).
      slip_angle: between the wheel's heading and its velocity, rad, positive when the wheel moves to its left.
      v_x, v_y: velocity of the wheel's centre along and across its heading in the ground plane, m/s.
      rim_speed: r times the wheel's angular velocity, m/s.
      forward, left, normal: axes of the wheel frame (heading, left, ground normal), in world coordinates.
      inside: whether the wheel is over the terrain's grid.
      soil_slip: the slip as the soil remembers it, within [-1, 1]: its shear displacement over the contact length. It
        tends to the slip while the wheel rolls on and stays when it stops; the slip itself where no effect keeps it.
        Where rim and hub are opposed it passes over from skidding to driving, through 0.
      soil_slid: the size of `soil_slip`, and 1 where rim and hub are opposed: soil is sheared in full there.
    """

    sinkage: Float[Array, "wheel"]
    sinkage_rate: Float[Array, "wheel"]
    slip: Float[Array, "wheel"]
    slip_angle: Float[Array, "wheel"]
    v_x: Float[Array, "wheel"]
    v_y: Float[Array, "wheel"]
    rim_speed: Float[Array, "wheel"]
    forward: Vec3
    left: Vec3
    normal: Vec3
    inside: Array
    soil_slip: Float[Array, "wheel"]
    soil_slid: Float[Array, "wheel"]


@pytree
class Soil:
    """Value of the port `soil`: the ground's parameters at each wheel.

    Attributes:
      k_c: cohesive modulus of sinkage, N/m^(n+1).
      k_phi: frictional modulus of sinkage, N/m^(n+2).
      n: sinkage exponent.
      cohesion: Pa.
      tan_phi: tangent of the angle of internal friction.
      shear_modulus_x, shear_modulus_y: Janosi shear deformation moduli K_s and K_y, m.
      rock: 1 where the wheel stands on hard rock, 0 where it stands on soil.
      rut: depth of the surface that the wheel meets below the undisturbed one, m; None where nothing has passed.
    """

    k_c: Float[Array, "wheel"]
    k_phi: Float[Array, "wheel"]
    n: Float[Array, "wheel"]
    cohesion: Float[Array, "wheel"]
    tan_phi: Float[Array, "wheel"]
    shear_modulus_x: Float[Array, "wheel"]
    shear_modulus_y: Float[Array, "wheel"]
    rock: Float[Array, "wheel"]
    rut: Any = None


@pytree
class Arc:
    """Integrals of the linearised stress over the contact arc, in units of its maximum: of cos, of sin, and of 1."""

    cos: Float[Array, "wheel"]
    sin: Float[Array, "wheel"]
    one: Float[Array, "wheel"]


@pytree
class Stress:
    """Normal stress at quadrature nodes over the contact arc.

    Attributes:
      theta: angles, rad. weight: of the nodes, rad. sigma: stress, Pa.
    """

    theta: Float[Array, "node wheel"]
    weight: Float[Array, "node wheel"]
    sigma: Float[Array, "node wheel"]


@pytree
class Normal:
    """Value of the port `wheel_normal`.

    Attributes:
      entrance, exit, theta_m: entrance angle, exit angle and angle of maximum stress, rad from the vertical.
      sigma_m: maximum normal stress, Pa.
      load: upward force on the wheel of the normal stress alone, N.
      resistance: backward force of the normal stress (compaction resistance) for rolling forward, N.
      damping: upward force that resists sinking, N.
      stress: the stress at quadrature nodes, where an effect integrates it.
      arc: integrals of the linearised stress where it does not run from 0 over theta_1/2 to theta_1.
      reversal: angle in front of which a braked wheel shoves its soil ahead, rad; None where no effect tells it.
    """

    entrance: Float[Array, "wheel"]
    exit: Float[Array, "wheel"]
    theta_m: Float[Array, "wheel"]
    sigma_m: Float[Array, "wheel"]
    load: Float[Array, "wheel"]
    resistance: Float[Array, "wheel"]
    damping: Float[Array, "wheel"]
    stress: Stress | None = None
    arc: Arc | None = None
    reversal: Any = None


@pytree
class WheelForce:
    """Value of the port `wheel_shear`.

    Attributes:
      slip_x: rim speed less travel speed over the larger of the two, signed in the wheel's frame (positive pushes the
        soil backward); equals eq. 8 when the rover moves forward.
      slip_y: (1 - s) tan(beta) of eq. 11, signed as the lateral velocity.
      direction: +1 when the wheel rolls forward, -1 when it rolls backward; rim and travel speed together over the
        larger where they are opposed.
      force: on the wheel's centre in the wheel frame (forward, left, ground normal), N.
      moment: on the wheel about its centre in the wheel frame, N m.
      circle: share of the shear stress that both directions have in common (friction circle); None for none.
      lug: how far the shearing surface lies beyond the radius of shear, m; None for not at all.
      grip: factor of the shear stress; None for 1.
      slip_ahead: slip_x of the soil in front of `Normal.reversal`; None where it is the same.
    """

    slip_x: Float[Array, "wheel"]
    slip_y: Float[Array, "wheel"]
    direction: Float[Array, "wheel"]
    force: Vec3
    moment: Vec3
    # Optional terms of the law: None, and not a neutral number, so that a model without them compiles no operation for
    # them.
    circle: Any = None
    lug: Any = None
    grip: Any = None
    slip_ahead: Any = None


@pytree
class BodyWrench:
    """Value of the port `body_wrench`.

    Attributes:
      force: on the chassis, world frame, N.
      moment: on the chassis about the origin of its frame, world frame, N m.
      joint_torque: extra torque at the actuated joints, N m.
    """

    force: Vec3
    moment: Vec3
    joint_torque: Float[Array, "joint"]


@pytree
class Power:
    """Value of the port `power`: electric power of the rover's bus.

    Attributes:
      load: what is drawn, W, with what amplifiers lose.
      solar: what panels give, W.
      loss: what of it heats the chassis, W.
      current, voltage: of the battery, A (positive when it gives) and V; None without one.
    """

    load: Any
    solar: Any
    loss: Any
    current: Any = None
    voltage: Any = None


@pytree
class Heat:
    """Value of the port `heat`: heat flow into the two nodes of every motor, W, and their heat capacities, J/K."""

    winding: Float[Array, "joint"]
    housing: Float[Array, "joint"]
    winding_capacity: Float[Array, "joint"]
    housing_capacity: Float[Array, "joint"]


@pytree
class RoverInfo:
    """What never changes during a run: the rover as drawn.

    Attributes:
      wheel_radius, wheel_width: nominal, m.
      joint_group: 0 drive, 1 steer, 2 suspension, for each actuated joint.
      joint_lower, joint_upper: joint limits, rad; infinite where there is none.
      mode: control mode of each joint: 0 position, 1 velocity, 2 torque, 3 current.
      position_gain: N m/rad. velocity_gain: N m s/rad.
      chassis_points: where the chassis can touch the ground, in its frame, m.
      joint_inertia: torque per acceleration of each joint of the rover as drawn, without rotors of motors, kg m2;
        None where unknown.
      box_center, box_half: centres and half sides of the chassis' boxes, along the axes of its frame, m.
    """

    wheel_radius: Float[AnyArray, "wheel"]
    wheel_width: Float[AnyArray, "wheel"]
    joint_group: Int[AnyArray, "joint"]
    joint_lower: Float[AnyArray, "joint"]
    joint_upper: Float[AnyArray, "joint"]
    mode: Int[AnyArray, "joint"]
    position_gain: Float[AnyArray, "joint"]
    velocity_gain: Float[AnyArray, "joint"]
    chassis_points: Vec3
    box_center: Vec3 | None = None
    box_half: Vec3 | None = None
    joint_inertia: Float[AnyArray, "joint"] | None = None
    name: str = static(default="rover")


@pytree
class Context:
    """State of the rover and results of earlier ports, as every port function receives them.

    Attributes:
      time: s. dt: time step, s. gravity: m/s2, positive. ambient_temperature: K.
      position, frame, velocity, angular_velocity: of the chassis frame, in world coordinates.
      joint_angle, joint_speed: of the actuated joints, rad, rad/s (output side of the gear).
      winding_temperature, housing_temperature: of their motors, K.
      steering_angle: of each wheel, rad, positive to the left; 0 where it is not steered.
      wheel_position, wheel_axle, wheel_velocity, wheel_angular_velocity: of the wheels' centres, world coordinates.
      terrain: the ground.
      rover: the rover as drawn.
      parameters: every effect's parameters, by effect and name.
      command, torque, geometry, contact, soil, normal, wheel, power: what the ports before have settled.
      sunlight: where the rover is; None for a model without a Sun.
      bus_voltage: of the battery under the load of the last steps, V; None for a model without a battery.
    """

    time: Any
    dt: Any
    gravity: Any
    ambient_temperature: Any
    position: Vec3
    frame: Frame
    velocity: Vec3
    angular_velocity: Vec3
    joint_angle: Float[Array, "joint"]
    joint_speed: Float[Array, "joint"]
    winding_temperature: Float[Array, "joint"]
    housing_temperature: Float[Array, "joint"]
    steering_angle: Float[Array, "wheel"]
    wheel_position: Vec3
    wheel_axle: Vec3
    wheel_velocity: Vec3
    wheel_angular_velocity: Vec3
    terrain: Terrain
    rover: RoverInfo
    parameters: Any
    # None before its port has run: an effect that reads ahead of the order fails at once instead of reading old values.
    command: Command | None = None
    torque: Float[Array, "joint"] | None = None
    geometry: Geometry | None = None
    contact: Contact | None = None
    soil: Soil | None = None
    normal: Normal | None = None
    wheel: WheelForce | None = None
    power: Power | None = None
    sunlight: Sunlight | None = None
    bus_voltage: Any = None
