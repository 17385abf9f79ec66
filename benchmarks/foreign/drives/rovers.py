"""Rovers in plain MuJoCo, built in code from published dimensions; masses and inertias are not the tool's."""

from __future__ import annotations

import dataclasses

CORNERS = ("lf", "rf", "lr", "rr")


@dataclasses.dataclass(frozen=True)
class Rover:
    """A rover as its makers describe it; SI units.

    Attributes:
      chassis_mass, chassis_inertia, chassis_com: of the chassis; the centre of mass in its frame.
      radius, width, wheel_mass: of a wheel. half_base, half_track: place of the wheels. height: of the chassis frame
        over the ground when the wheels only touch it.
      suspension: "swing" (an arm about y), "parallel" (a four-bar, here its vertical travel) or "none".
      arm: length of the arm, m. corner_mass: of arm and knuckle. gravity: in which it is driven.
      drive_gain: N m s/rad. spring, damper: of suspension with its control, N m/rad and N m s/rad at the arm.
      gear, efficiency, constant, resistance, rotor: of a drive motor (N m/A, ohm, kg m2); bus: V.
      sides: whether one motor drives all wheels of a side.
      speeds: slow, middle and fast, m/s. floor: rim speed below which shear is damped and does not follow slip, m/s.
    """

    name: str
    chassis_mass: float
    chassis_inertia: tuple[float, float, float]
    chassis_com: tuple[float, float, float]
    radius: float
    width: float
    wheel_mass: float
    half_base: float
    half_track: float
    height: float
    suspension: str
    arm: float
    corner_mass: float
    gravity: float
    drive_gain: float
    spring: float
    damper: float
    gear: float
    efficiency: float
    constant: float
    resistance: float
    rotor: float
    bus: float
    sides: bool
    speeds: tuple[float, float, float]
    floor: float

    @property
    def mass(self) -> float:
        """Of all, kg."""
        return self.chassis_mass + 4.0 * (self.wheel_mass + self.corner_mass)

    @property
    def steered(self) -> bool:
        """Whether the wheels steer."""
        return not self.sides


ROVERS = {
    "luvmi_x": Rover(
        name="luvmi_x",
        chassis_mass=38.0,
        chassis_inertia=(0.97, 2.18, 2.07),
        chassis_com=(0.013, 0.0, 0.125),
        radius=0.10,
        width=0.08,
        wheel_mass=1.2,
        half_base=0.37,
        half_track=0.254,
        height=0.16,
        suspension="swing",
        arm=0.18,
        corner_mass=1.8,
        gravity=1.625,
        drive_gain=20.0,
        spring=1020.0,
        damper=80.0,
        gear=243.0,
        efficiency=0.75,
        constant=71.6e-3,
        resistance=4.13,
        rotor=9e-7,
        bus=48.0,
        sides=False,
        speeds=(0.05, 0.10, 0.18),
        floor=0.02,
    ),
    "viper": Rover(
        name="viper",
        chassis_mass=340.82,
        chassis_inertia=(71.0, 110.0, 75.0),
        chassis_com=(0.029, 0.0, 0.42),
        radius=0.25,
        width=0.20,
        wheel_mass=11.05,
        half_base=0.642,
        half_track=0.610,
        height=0.35,
        suspension="parallel",
        arm=0.32,
        corner_mass=14.47,
        gravity=1.625,
        drive_gain=160.0,
        spring=20300.0,
        damper=480.0,
        gear=243.0,
        efficiency=0.75,
        constant=71.6e-3,
        resistance=4.13,
        rotor=9e-7,
        bus=48.0,
        sides=False,
        speeds=(0.05, 0.12, 0.20),
        floor=0.03,
    ),
    "husky": Rover(
        name="husky",
        chassis_mass=49.5,
        chassis_inertia=(1.1, 2.4, 3.0),
        chassis_com=(0.0, 0.0, 0.078),
        radius=0.165,
        width=0.114,
        wheel_mass=2.6,
        half_base=0.256,
        half_track=0.2854,
        height=0.165,
        suspension="none",
        arm=0.0,
        corner_mass=0.0,
        gravity=9.80665,
        drive_gain=23.7,
        spring=0.0,
        damper=0.0,
        gear=78.71,
        efficiency=0.70,
        constant=0.044,
        resistance=0.46,
        rotor=5e-5,
        bus=24.0,
        sides=True,
        speeds=(0.10, 0.25, 0.45),
        floor=0.06,
    ),
}
"""LUVMI-X and VIPER after the dimensions of their published models, Husky after its maker's (A200)."""


@dataclasses.dataclass(frozen=True)
class Build:
    """How a rover as built differs from its description: factors of mass and inertia, a shift of the chassis' centre of
    mass (m), a payload (kg, m), the share of the rotor that turns rigidly with the wheel, and the step of time (s)."""

    mass: float = 1.0
    inertia: tuple[float, float, float] = (1.0, 1.0, 1.0)
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    payload: float = 0.0
    payload_at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rotor_share: float = 1.0
    timestep: float = 1e-3


def mjcf(rover: Rover, build: Build) -> str:
    """The rover's MJCF: free chassis, and per corner suspension, steering and wheel; no contact, no actuator."""
    rotor = rover.rotor * rover.gear**2 * build.rotor_share / (2.0 if rover.sides else 1.0)
    com = [a + b for a, b in zip(rover.chassis_com, build.com, strict=True)]
    inertia = [a * b * build.mass for a, b in zip(rover.chassis_inertia, build.inertia, strict=True)]
    payload = ""
    if build.payload:
        payload = (
            f'<body name="payload" pos="{_list(build.payload_at)}"><inertial pos="0 0 0" mass="{build.payload}" '
            f'diaginertia="{_list([0.004 * build.payload] * 3)}"/></body>'
        )
    corners = "".join(_corner(rover, build, c, rotor) for c in CORNERS)
    ties = "".join(f'<joint joint1="{s}f_drive" joint2="{s}r_drive" solref="0.004 1"/>' for s in "lr" if rover.sides)
    return f"""<mujoco model="foreign_{rover.name}">
  <compiler angle="radian" autolimits="false"/>
  <option timestep="{build.timestep}" integrator="Euler" gravity="0 0 {-rover.gravity}">
    <flag contact="disable" limit="disable"/>
  </option>
  <worldbody>
    <body name="chassis" pos="0 0 {rover.height}">
      <freejoint/>
      <inertial pos="{_list(com)}" mass="{rover.chassis_mass * build.mass}" diaginertia="{_list(inertia)}"/>
      <site name="imu"/>
      {payload}
      {corners}
    </body>
  </worldbody>
  <equality>{ties}</equality>
  <sensor><gyro site="imu"/><accelerometer site="imu"/></sensor>
</mujoco>"""


def _list(values: object) -> str:
    return " ".join(f"{v:.9g}" for v in values)  # type: ignore[attr-defined]


def _corner(rover: Rover, build: Build, corner: str, rotor: float) -> str:
    front = 1.0 if corner[1] == "f" else -1.0
    left = 1.0 if corner[0] == "l" else -1.0
    x, y, down = front * rover.half_base, left * rover.half_track, rover.height - rover.radius
    wheel = rover.wheel_mass * build.mass
    spin = 0.5 * wheel * rover.radius**2
    tilt = wheel * (3.0 * rover.radius**2 + rover.width**2) / 12.0
    disc = (
        f'<body name="{corner}_wheel"><inertial pos="0 0 0" mass="{wheel}" diaginertia="{_list([tilt, spin, tilt])}"/>'
        f'<joint name="{corner}_drive" axis="0 1 0" armature="{rotor}"/></body>'
    )
    if rover.suspension == "none":
        knuckle = f'<body name="{corner}_knuckle" pos="{_list([x, y, -down])}"><inertial pos="0 0 0" mass="1e-3" '
        return knuckle + f'diaginertia="1e-5 1e-5 1e-5"/>{disc}</body>'
    half = 0.5 * rover.corner_mass * build.mass
    small = _list([0.002 * half] * 3)
    steer = 2.1  # rotor behind a gear of some 1500, kg m2
    if rover.suspension == "swing":
        pivot, ahead = x - front * rover.arm, rover.arm * front
        joint = f'<joint name="{corner}_sus" axis="0 {front:g} 0" armature="{steer}"/>'
        arm = f'<body name="{corner}_arm" pos="{_list([pivot, y, 0.0])}">{joint}'
        hub = [ahead, 0.0, -down]
    else:
        joint = f'<joint name="{corner}_sus" type="slide" axis="0 0 -1" armature="{steer / rover.arm**2}"/>'
        arm = f'<body name="{corner}_arm" pos="{_list([x, y, 0.0])}">{joint}'
        hub = [0.0, 0.0, -down]
    return (
        f'{arm}<inertial pos="{_list([0.5 * v for v in hub])}" mass="{half}" diaginertia="{small}"/>'
        f'<body name="{corner}_knuckle" pos="{_list(hub)}"><inertial pos="0 0 0" mass="{half}" diaginertia="{small}"/>'
        f'<joint name="{corner}_steer" axis="0 0 1" armature="{steer}"/>{disc}</body></body>'
    )
