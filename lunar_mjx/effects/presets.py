"""The presets: what is in each, what the paper leaves unsaid, and every difference between them by name."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

from lunar_mjx.effects.joint.motor import WINDINGS
from lunar_mjx.terrain.soil.named import SOILS

MEANT_FOR: Mapping[str, str] = {
    "field": "What a drive outdoors needs; simulate, view and the environments run it unless told otherwise.",
    "consistent": "The seed paper's physics corrected, assuming least; diagnosis and make_model start from it.",
    "paper": "The seed paper's equations as printed, flaws included.",
}
"""What each preset is for, in a sentence."""

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
    "field": (
        "joint_control",
        "voltage_saturation",
        "thermal_cutoff",
        "motor",
        "directional_gear_efficiency",
        "rim_contact",
        "soil",
        "surface_type",
        "slip_sinkage",
        "multipass",
        "stress_integral",
        "shear_state",
        "skid_shear",
        "friction_circle",
        "bulldozing",
        "hard_ground",
        "rolling_resistance",
        "static_boulders",
        "chassis_contact",
        "joint_limits",
        "winding_conduction",
        "rotor_stator_path",
        "gear_friction_heat",
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
"""Effects of each preset: `consistent`, the paper's equations mended, `field`, what a drive outdoors needs beyond them,
and `paper`, the equations as printed."""

DEFAULT_PRESET = "field"
"""Preset of drives for which none is named: `simulate`, `view` and the environments.

Diagnosis starts from `consistent` all the same: it adds what the measurements ask for and takes nothing away, so that
its baseline must not hold coefficients (of slip-sinkage, ruts, rolling) which were chosen and not measured."""

_PAPER_WINDING = WINDINGS[12]

PRESET_PARAMETERS: Mapping[str, Mapping[str, Mapping[str, float | Mapping[str, float]]]] = {
    "consistent": {},
    # the whole contact time of a braked wheel, hence j = r[(theta_1 - theta) - (sin theta_1 - sin theta)/(1 + s)], and
    # soil that is shoved ahead in front of it
    "field": {"skid_shear": {"share": 1.0, "reversal": 1.0}},
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

PRESET_AMBIENT: Mapping[str, tuple[float, float]] = {"field": (230.0, 90.0)}
"""Noon and night temperature, K, of presets whose ambient follows the lunar day, which begins at noon: a sunlit ridge
near the south pole, where VIPER was to drive; chosen within what Diviner maps there (Paige et al. 2010, Science
330:479)."""

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


class Change(NamedTuple):
    """One flaw that `consistent` keeps and `field` mends, or that `field` keeps as well."""

    where: str
    consistent: str
    field: str
    mended_by: str


FIELD_CHANGES: tuple[Change, ...] = (
    Change(
        "normal and shear stress",
        "closed form: drawbar pull at 40 % slip 6 % high in lunar soil",
        "integrated over the contact arc",
        "stress_integral for pressure_sinkage and closed_form_shear",
    ),
    Change(
        "braking wheel",
        "displacement of eq. 8: the soil of a skidding wheel stays too little mobilised",
        "displacement over the wheel's own turning, 1/(1 + s)",
        "skid_shear, share = reversal = 1",
    ),
    Change(
        "shear strength",
        "whole along and whole across: up to sqrt(2) times Mohr-Coulomb",
        "one strength for both",
        "friction_circle",
    ),
    Change("slipping wheel", "sinks no deeper, cannot dig in", "exponent n_0 + n_1 s", "slip_sinkage"),
    Change("rear wheels", "meet virgin soil", "roll in the ruts of the front wheels", "multipass"),
    Change("soil before and beside the wheel", "not pushed", "passive earth pressure", "bulldozing"),
    Change("rolling", "costs compaction alone", "and deforms the wheel", "rolling_resistance"),
    Change("motor voltage", "without limit: any speed", "within 48 V", "voltage_saturation"),
    Change("gear driven back", "gives more power than it takes up", "loses both ways", "directional_gear_efficiency"),
    Change("gear loss", "vanishes", "heats the housing", "gear_friction_heat"),
    Change(
        "friction of wheels on boulders",
        "creeps: tanh of the sliding speed",
        "holds up to mu F_N",
        "static_boulders for boulders",
    ),
    Change("ambient temperature", "25 degC for ever", "lunar day and night near the pole", "the model's ambient"),
    Change("chassis on ground and boulders", "friction creeps", "friction creeps", "nothing yet"),
    Change(
        "wheel contact",
        "the facet under the axle: load steps at facet edges",
        "a plane fitted along and beside the rim",
        "rim_contact",
    ),
    Change(
        "dug soil",
        "no rut stays in the terrain",
        "remembered by the wheels alone (multipass, 20 places); the opt-in effect `ruts` digs them",
        "nothing yet",
    ),
)
"""What `consistent` leaves out and `field` has, and what both leave out."""
