"""What the converter works out from the compiled model: springs that hold the rover level, and stable gains."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from lunar_mjx.errors import UserError
from lunar_mjx.rover.description import GROUPS, Description, GroupDescription
from lunar_mjx.rover.roles import Roles


@dataclasses.dataclass(frozen=True)
class GainRules:
    """Rules by which controller gains and springs follow from a rover's masses."""

    # Shares of the stability bound of an explicit step, so that the gains also hold at twice the time step.
    velocity_share: float = 0.25
    """Velocity gain times time step over inertia."""
    position_share: float = 0.05
    """Position gain times the squared time step over inertia."""
    bandwidth: float = 20.0
    """rad/s, about 3 Hz: above the rover's own motion, below the bound"""
    damping_ratio: float = 0.7
    """Damping of position control over the critical one."""
    sag: float = 0.02
    """rad that a suspension without a spring may give way under the rover's weight"""


GAIN_RULES = GainRules()


@dataclasses.dataclass(frozen=True)
class Gains:
    """Position gain N m/rad and velocity gain N m s/rad of one joint group."""

    position: float
    velocity: float


def holding_torques(model: mujoco.MjModel, roles: Roles) -> dict[str, float]:
    """Torque, in N m, at each suspension joint that holds the rover level on flat ground at zero angles.

    Solves the static equilibrium for vertical wheel loads, suspension torques and loop forces; of the loads that four
    wheels leave open, the smallest is taken. Positive torque raises the chassis.
    """
    data = mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    mujoco.mj_forward(model, data)
    columns = []
    for wheel in roles.wheels:
        body = model.body(wheel.body).id
        jacobian = np.zeros((3, model.nv))
        # Straight below the axle: no moment about the drive joint.
        mujoco.mj_jac(model, data, jacobian, None, data.xpos[body] - [0, 0, wheel.radius], body)
        # Unit vertical force at each wheel's foot, as generalised forces.
        columns.append(jacobian[2])
    joints = roles.group("suspension")
    for joint in joints:
        unit = np.zeros(model.nv)
        # Unit torque at each suspension joint.
        unit[model.joint(joint).dofadr[0]] = 1.0
        columns.append(unit)
    if data.nefc:
        rows = np.zeros((data.nefc, model.nv))
        if mujoco.mj_isSparse(model):
            mujoco.mju_sparse2dense(rows, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
        else:
            rows = data.efc_J.reshape(data.nefc, model.nv)
        # Whatever force the loops need, they give; it must not be put on the springs.
        columns.extend(rows)
    # The rover is in rest where these forces carry its weight (qfrc_bias at zero speed).
    matrix = np.array(columns).T
    # Loads of four wheels on flat ground are one too many to be determined: the smallest loads are the symmetric ones.
    solution, *_ = np.linalg.lstsq(matrix, data.qfrc_bias, rcond=1e-9)
    start = len(roles.wheels)
    return {joint: float(solution[start + i]) for i, joint in enumerate(joints)}


def level_springs(spec: mujoco.MjSpec, model: mujoco.MjModel, roles: Roles, description: Description) -> None:
    """Sets the spring references that the description leaves to "level" in `spec`."""
    group = description.groups["suspension"]
    for name in GROUPS:
        if name != "suspension" and description.groups[name].spring_reference == "level":
            raise UserError(
                f"{description.path}: joints.{name}.spring_reference = 'level' is for suspension only; give radians."
            )
    if group.spring_reference != "level":
        return
    for joint, torque in holding_torques(model, roles).items():
        # Ten significant digits: a linear solve may differ in the last ones between machines.
        spec.joint(joint).springref = float(f"{torque / group.stiffness:.10g}")


def effective_inertia(model: mujoco.MjModel, joint: str) -> float:
    """Inertia, in kg m2, that a torque on the joint feels while every other joint is free; loops left open."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    unit, response = np.zeros((1, model.nv)), np.zeros((1, model.nv))
    dof = model.joint(joint).dofadr[0]
    unit[0, dof] = 1.0
    mujoco.mj_solveM(model, data, response, unit)
    # One over the diagonal of the inverse and not of M: the others are free to yield, so the joint feels less.
    return float(1.0 / response[0, dof])


def gains(model: mujoco.MjModel, roles: Roles, description: Description, name: str) -> Gains:
    """Gains of the group `name`: as described, or else stable when applied as an explicit torque at the time step.

    A velocity loop gets kv = 0.25 I/dt. A position loop gets a bandwidth of 20 rad/s, more where it must carry the
    rover without a spring, at a damping ratio of 0.7. I is the smallest effective inertia in the group.
    """
    group: GroupDescription = description.groups[name]
    joints = roles.group(name)
    position, velocity = 0.0, 0.0
    if joints and group.mode in ("position", "velocity"):
        # The smallest: one gain serves the group, and must be stable at each joint.
        inertia = min(effective_inertia(model, j) for j in joints)
        dt = description.timestep
        if group.mode == "velocity":
            velocity = GAIN_RULES.velocity_share * inertia / dt
        else:
            load = 0.0
            if name == "suspension" and group.stiffness == 0:
                # A position loop has no integral part: what it carries, it carries by an error.
                load = max(abs(t) for t in holding_torques(model, roles).values())
            wanted = max(inertia * GAIN_RULES.bandwidth**2, load / GAIN_RULES.sag)
            position = min(wanted, GAIN_RULES.position_share * inertia / dt**2)
            # k_d = 2 zeta sqrt(k_p I), of a second-order system.
            velocity = 2 * GAIN_RULES.damping_ratio * np.sqrt(position * inertia)
    # Three digits: gains are choices, and files shall not differ between machines.
    chosen = Gains(float(f"{position:.3g}"), float(f"{velocity:.3g}"))
    return Gains(
        chosen.position if group.position_gain is None else group.position_gain,
        chosen.velocity if group.velocity_gain is None else group.velocity_gain,
    )
