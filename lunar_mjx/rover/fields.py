"""Fields of an MJCF that the library's physics does not take up, and sizes that contradict its description.

MuJoCo alone would honour them. A model that meant them would move otherwise here, and nobody would be told.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.rover.rover import Wheel

RADIUS_TOLERANCE = 0.25
"""Share by which a wheel's radius may differ from the height at which the rover stands on it: grousers and soft tyres
change it by less; a radius in cm or of another rover by more."""


def refuse_unused_fields(mjcf: Path, model: mujoco.MjModel) -> None:
    """Raises `UserError` for fields that would be ignored."""
    problems = _joints(model) + _actuators(model)
    if problems:
        raise UserError(f"{mjcf}: {problems[0]} would be ignored; {_REMEDY[problems[0].split(' of ')[0]]}.")


def refuse_impossible_fields(mjcf: Path, model: mujoco.MjModel) -> None:
    """Raises `UserError` for numbers that single precision does not hold, and for joints that no mechanism has."""
    for name in _ARRAYS:
        values = np.asarray(getattr(model, name), np.float64)
        # MuJoCo compiles "nan" with no more than a warning.
        wrong = ~np.isfinite(values) | (np.abs(values) > np.finfo(np.float32).max)
        if wrong.any():
            problem = f"holds {float(values[wrong][0])} in {name}"
            raise UserError(f"{mjcf}: {problem}, which is no number of a rover; correct it, or convert again.")
    for j in range(model.njnt):
        low, high = (float(v) for v in model.jnt_range[j])
        field = f"the joint {model.joint(j).name!r}"
        if low > high:
            raise bad_input(mjcf, f"range of {field}", f"{low:g} {high:g}", "has its ends swapped", "swap them")
        if model.jnt_stiffness[j] < 0.0:
            value = float(model.jnt_stiffness[j])
            raise bad_input(mjcf, f"stiffness of {field}", value, "is negative", "give zero or more")
        first = int(model.jnt_dofadr[j])
        if model.dof_damping[first] < 0.0:
            value = float(model.dof_damping[first])
            raise bad_input(mjcf, f"damping of {field}", value, "is negative", "give zero or more")


_ARRAYS = (
    "body_pos",
    "body_quat",
    "body_ipos",
    "body_iquat",
    "body_mass",
    "body_inertia",
    "jnt_axis",
    "jnt_pos",
    "jnt_range",
    "jnt_stiffness",
    "qpos_spring",
    "dof_damping",
    "dof_armature",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "site_pos",
    "site_quat",
    "eq_data",
    "eq_solref",
    "eq_solimp",
)
"""Arrays of a compiled model that the physics and the pictures read."""


_REMEDY = {
    "ref": "make the pose that is meant the zero of the joint, and shift range and springref with it",
    "actuatorfrcrange": "leave it out, and give the motor its current limit in rover.toml",
    "gear": "give gear_ratio in rover.toml, and leave the MJCF's gear at 1",
    "ctrlrange": "leave it out, and limit the commands that are given",
    "forcerange": "leave it out, and give the motor its current limit in rover.toml",
    "gain, bias or dynamics": "write <motor name=... joint=...>; control is an effect",
    "transmission": "let the motor act on a joint",
}


def _joints(model: mujoco.MjModel) -> list[str]:
    problems = []
    single = (int(mujoco.mjtJoint.mjJNT_HINGE), int(mujoco.mjtJoint.mjJNT_SLIDE))
    for j in range(model.njnt):
        name = f"the joint {model.joint(j).name!r}"
        # MuJoCo turns the joint by its position less ref, the library by the position itself.
        if model.jnt_type[j] in single and model.qpos0[model.jnt_qposadr[j]] != 0.0:
            problems.append(f"ref of {name}")
        if model.jnt_actfrclimited[j]:
            problems.append(f"actuatorfrcrange of {name}")
    return problems


def _actuators(model: mujoco.MjModel) -> list[str]:
    problems = []
    for i in range(model.nu):
        name = f"the motor {model.actuator(i).name!r}"
        if model.actuator_trntype[i] != mujoco.mjtTrn.mjTRN_JOINT:
            problems.append(f"transmission of {name}")
        # A gear of its own would multiply the gear of rover.toml.
        if not np.array_equal(model.actuator_gear[i], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]):
            problems.append(f"gear of {name}")
        if model.actuator_ctrllimited[i]:
            problems.append(f"ctrlrange of {name}")
        if model.actuator_forcelimited[i]:
            problems.append(f"forcerange of {name}")
        plain = (
            model.actuator_gaintype[i] == mujoco.mjtGain.mjGAIN_FIXED
            and model.actuator_gainprm[i, 0] == 1.0
            and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
            and model.actuator_dyntype[i] == mujoco.mjtDyn.mjDYN_NONE
        )
        if not plain:
            problems.append(f"gain, bias or dynamics of {name}")
    return problems


def check_sizes(path: Path, model: mujoco.MjModel, wheels: Sequence[Wheel], standing_height: float) -> None:
    """Holds the wheels of a `rover.toml` against its MJCF.

    Raises:
      UserError: a wheel's radius does not go with the height at which the rover stands, or its shape in the MJCF.
    """
    data = mujoco.MjData(model)
    # At zero angles; no dynamics are needed for heights.
    mujoco.mj_kinematics(model, data)
    chassis = float(data.xpos[1][2])
    for i, wheel in enumerate(wheels):
        field = f"wheels[{i}].radius"
        centre = float(data.xpos[model.body(wheel.body).id][2]) - chassis + standing_height
        shape = _shape_radius(model, model.body(wheel.body).id)
        for size, size_name in ((shape, "the shape of its MJCF"), (centre, "the height at which the rover stands")):
            if size is not None and not (1 - RADIUS_TOLERANCE) * size <= wheel.radius <= (1 + RADIUS_TOLERANCE) * size:
                raise bad_input(
                    path, field, wheel.radius, f"is not the {size:.3g} m of {size_name}", "correct it, or convert again"
                )


def _shape_radius(model: mujoco.MjModel, body: int) -> float | None:
    """Largest radius of the cylinders and spheres of a wheel's body, m; None without any."""
    round_ = (int(mujoco.mjtGeom.mjGEOM_CYLINDER), int(mujoco.mjtGeom.mjGEOM_SPHERE))
    radii = [
        float(model.geom_size[g, 0]) for g in np.flatnonzero(model.geom_bodyid == body) if model.geom_type[g] in round_
    ]
    return max(radii, default=None)
