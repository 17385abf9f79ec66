"""Refuses, by name, every field of a compiled MuJoCo model that the structured engine would not honour."""

from __future__ import annotations

import mujoco
import numpy as np

from lunar_mjx.errors import UserError

_IGNORABLE = sum(
    int(getattr(mujoco.mjtDisableBit, f"mjDSBL_{flag}"))
    for flag in (
        "CONTACT",
        "LIMIT",
        "FRICTIONLOSS",
        "WARMSTART",
        "FILTERPARENT",
        "REFSAFE",
        "SENSOR",
        "MIDPHASE",
        "NATIVECCD",
        "MULTICCD",
        "ISLAND",
        "CLAMPCTRL",
        "AUTORESET",
    )
)
"""Disable flags that change nothing where there is no contact, limit, friction loss, sensor or soft constraint."""


class UnsuitableError(UserError):
    """The structured engine cannot run this rover exactly; the message says why."""


def check_model(model: mujoco.MjModel, name: str) -> None:
    """Raises `UnsuitableError` naming everything in the model that the structured engine cannot honour.

    Args:
      model: the compiled model.
      name: what to name in the message.
    """
    # All problems at once, so that a user mends a file in one go.
    problems = [*_options(model), *_joints(model), *_bodies(model), *_others(model)]
    if problems:
        raise UnsuitableError(f"{name}: the structured engine cannot honour {'; '.join(problems)}.")


def _options(model: mujoco.MjModel) -> list[str]:
    disable, option = mujoco.mjtDisableBit, model.opt
    problems = []
    if not option.disableflags & int(disable.mjDSBL_CONTACT) and (model.geom_contype | model.geom_conaffinity).any():
        problems.append('contacts (set <flag contact="disable"/>)')
    if not option.disableflags & int(disable.mjDSBL_CONTACT) and model.npair:
        problems.append('contact pairs (set <flag contact="disable"/>)')
    if not option.disableflags & int(disable.mjDSBL_LIMIT) and model.jnt_limited.any():
        problems.append('joint limits in the solver (set <flag limit="disable"/>; limits are an effect)')
    # Flags that MuJoCo adds in later releases are refused by name until someone has thought about them.
    for flag, bit in disable.__members__.items():
        if flag.startswith("mjDSBL_") and option.disableflags & int(bit) & ~_IGNORABLE:
            problems.append(f"the disable flag {flag}")
    if option.enableflags & ~int(mujoco.mjtEnableBit.mjENBL_ENERGY):
        problems.append("option enable flags")
    if option.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        problems.append('an integrator other than integrator="Euler"')
    if option.density or option.viscosity or np.any(option.wind):
        problems.append("fluid forces (density, viscosity, wind)")
    return problems


def _joints(model: mujoco.MjModel) -> list[str]:
    free, hinge = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_HINGE)
    problems = []
    for j in range(model.njnt):
        joint = model.joint(j)
        if model.jnt_type[j] not in (free, hinge):
            problems.append(f"the slide or ball joint {joint.name!r}")
    # The base is solved as a rigid body, without damping or rotor of its own.
    of_free = np.isin(model.dof_jntid, np.flatnonzero(model.jnt_type == free))
    for field in ("damping", "armature"):
        if getattr(model, f"dof_{field}")[of_free].any():
            problems.append(f"{field} of the free joint")
    if model.jnt_stiffness[model.jnt_type == free].any():
        problems.append("stiffness of the free joint")
    for field in ("dof_frictionloss", "dof_dampingpoly", "jnt_stiffnesspoly", "jnt_actgravcomp"):
        if np.any(getattr(model, field)):
            problems.append(field)
    return problems


def _bodies(model: mujoco.MjModel) -> list[str]:
    problems = []
    if np.any(model.body_gravcomp):
        problems.append("gravcomp of bodies")
    if model.nmocap:
        problems.append("mocap bodies")
    return problems


def _others(model: mujoco.MjModel) -> list[str]:
    problems = []
    for count, plural in (
        ("ntendon", "tendons"),
        ("nflex", "flexes"),
        ("nplugin", "plugins"),
        ("na", "actuator states"),
    ):
        if getattr(model, count):
            problems.append(plural)
    for i in range(model.neq):
        if model.eq_type[i] == mujoco.mjtEq.mjEQ_JOINT:
            multiplier = model.eq_data[i, 1]
            linear = np.array_equal(model.eq_data[i, :5], [0.0, multiplier, 0.0, 0.0, 0.0]) and multiplier != 0.0
            if not linear or not model.eq_active0[i] or model.eq_obj2id[i] < 0:
                problems.append(f"the joint equality {model.eq(i).name!r}, which is no fixed ratio of two angles")
        elif model.eq_type[i] != mujoco.mjtEq.mjEQ_CONNECT:
            problems.append(f"the equality constraint {model.eq(i).name!r}, which is neither connect nor joint")
        elif model.eq_objtype[i] != mujoco.mjtObj.mjOBJ_BODY:
            problems.append(f"the connect {model.eq(i).name!r} between sites")
        elif not model.eq_active0[i]:
            problems.append(f"the inactive connect {model.eq(i).name!r}")
    none = int(mujoco.mjtBias.mjBIAS_NONE)
    if (model.actuator_biastype != none).any():
        problems.append("actuators that push without control (biastype; use motors, control is an effect)")
    for field in ("actuator_damping", "actuator_dampingpoly", "actuator_armature"):
        if np.any(getattr(model, field)):
            problems.append(field)
    return problems
