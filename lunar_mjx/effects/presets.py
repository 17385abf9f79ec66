"""The two presets: what is in each, what the paper leaves unsaid, and every difference between them by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from lunar_mjx.effects.joint.motor import WINDINGS
from lunar_mjx.effects.soil.ground import SOILS

PRESETS: Mapping[str, tuple[str, ...]] = {
    "consistent": (
        "joint_control",
        "thermal_cutoff",
        "motor",
        "soil",
        "surface_type",
        "pressure_sinkage",
        "shear_state",
        "closed_form_shear",
        "hard_ground",
        "boulders",
        "chassis_contact",
        "joint_limits",
        "winding_conduction",
        "rotor_stator_path",
        "housing_conduction",
        "housing_radiation",
    ),
    "paper": (
        "joint_control",
        "thermal_cutoff",
        "motor",
        "soil",
        "surface_type",
        "penalty_contact",
        "printed_shear",
        "engine_friction",
        "boulders",
        "chassis_contact",
        "joint_limits",
        "winding_conduction",
        "housing_convection",
    ),
}
"""Effects of each preset: `consistent`, the corrected physics and default, and `paper`, the equations as printed."""

_PAPER_WINDING = WINDINGS[12]

PRESET_PARAMETERS: Mapping[str, Mapping[str, Mapping[str, float | Mapping[str, float]]]] = {
    "consistent": {},
    "paper": {
        "thermal_cutoff": {"hysteresis": 500.0},
        "joint_control": {"current_limit": _PAPER_WINDING["current_limit"]},
        "motor": {
            "resistance": _PAPER_WINDING["resistance"],
            "torque_constant": _PAPER_WINDING["torque_constant"],
            "gear_ratio": {"drive": 62.0},
            "gear_efficiency": {"drive": 0.8},
        },
        "soil": SOILS["paper"],
    },
}
"""Where a preset departs from the nominal values; a table gives one value per joint group."""

UNSAID: Mapping[str, str] = {
    "time step": "2 ms",
    "thermal integrator": "explicit Euler, eqs. 4 and 5",
    "winding": "12 V of the maxon ECX TORQUE 22 XL (R_0 0.292 ohm, K_0 17.0e-3 N m/A, stall current 41.1 A)",
    "drive gear": "62:1, the smallest three-stage ratio of the GPX 26 HP, efficiency 0.8 "
    "(15 N m reach 150 degC only below about 80 / efficiency)",
    "steering and suspension gear": "as the rover's folder says",
    "drive gains": "the rover's, in proportion to the inertia at the joint, which the gear changes",
    "heat capacities C_R, C_S": "4.07 and 55 J/K: time constants of 10 s and 10 min over R_th1 and R_th2",
    "winding and magnet": "copper, alpha 0.0040 1/K; NdFeB, beta -0.0012 1/K",
    "ambient temperature T_A": "25 degC",
    "after the cut-off": "the current stays off: the paper says that the torque drops to zero, not that it returns",
    "soil": "the paper's release: k_c 1e5, k_phi 1e3, n 1.1, c 462.3 Pa, phi 0.3889 rad, K_s = K_y = 0.015 m",
    "contact k_N, c_N": "5e4 N/m, 300 N s/m",
    "friction mu": "0.8, on rock and under the soil forces alike",
    "theta_s of eq. 14": "read as the steering angle of the wheel, with its toe",
    "rover masses": "those of the real rovers with inertias from geometry, in both presets (flaw 10)",
    "terrain scale": "true scale in both presets (flaw 11)",
}
"""What the paper leaves as a range or unsaid, and the one value that the preset `paper` takes."""


class Flaw(NamedTuple):
    """One named difference between the presets."""

    number: int
    where: str
    paper: str
    consistent: str
    mended_by: str


FLAWS: tuple[Flaw, ...] = (
    Flaw(
        1, "eq. 3", "the stator receives no heat from the rotor", "it receives (T_R - T_S)/R_th1", "rotor_stator_path"
    ),
    Flaw(
        2,
        "III-C4",
        "penalty contact: the soil force is decorative",
        "the normal force is the vertical integral of the stress",
        "pressure_sinkage (or stress_integral) for penalty_contact and engine_friction",
    ),
    Flaw(
        3,
        "j",
        "second term lacks the radius",
        "j = r[(theta1-theta) - (1-s)(sin theta1 - sin theta)]",
        "closed_form_shear; or printed_shear.mend_j = 1",
    ),
    Flaw(
        4,
        "eq. 8",
        "undefined at standstill, wrong sign backing up, no static friction",
        "shear displacement as a state",
        "shear_state; or printed_shear.mend_slip = 1 with shear_state",
    ),
    Flaw(
        5,
        "eq. 10",
        "r and r_s swapped",
        "r_s with the shear, r with the normal stress",
        "closed_form_shear; or printed_shear.mend_shear_radius = 1",
    ),
    Flaw(
        6,
        "eqs. 11, 14",
        "theta_s undefined; F_S vanishes where the wheel does not slip along",
        "no theta_s term; lateral shear has its own displacement",
        "closed_form_shear; or printed_shear.mend_side = 1",
    ),
    Flaw(
        7,
        "reward",
        "progress is never negative",
        "signed decrease of the distance to the goal",
        "the reward of the navigation task",
    ),
    Flaw(
        8,
        "motor",
        "15 N m without a gear needs 882 A",
        "gear ratio and efficiency explicit, 48 V winding",
        "motor.gear_ratio, motor.gear_efficiency",
    ),
    Flaw(
        9,
        "R_th2",
        "10.9 K/W holds in air",
        "radiation and conduction into the structure",
        "housing_radiation and housing_conduction for housing_convection",
    ),
    Flaw(
        10,
        "models",
        "rover masses and inertias of a desk model",
        "masses of the real rovers, inertias from geometry",
        "the rovers' folders, in both presets",
    ),
    Flaw(
        11,
        "terrain",
        "hills the size of the rover at 1:100",
        "true scale with procedural detail",
        "the terrains' folders, in both presets",
    ),
)
"""Every flaw of the paper as a named difference (numbers as in the project's physics notes)."""
