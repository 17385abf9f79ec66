"""What a refit of drives may move of a model, and which effects may be missing in it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from lunar_mjx.diagnosis.effect_coordinates import default_coordinate
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.model import Model

BASELINE: Mapping[str, Mapping[str, tuple[float, float]]] = {
    "soil": {
        "k_phi": (0.3, 2.0),
        "n": (0.1, 2.0),
        "cohesion": (0.3, 2.0),
        "friction_angle": (0.1, 2.0),
        "shear_modulus_x": (0.3, 2.0),
        "shear_modulus_y": (0.3, 2.0),
    },
    "penalty_contact": {"stiffness": (0.3, 2.0)},
    # How contact moves from one steady state to the next: choices, of which no test of steady wheels tells even the
    # order.
    "pressure_sinkage": {"damping": (1.0, 2.3)},
    "stress_integral": {"damping": (1.0, 2.3)},
    "granular_resistance": {"damping": (1.0, 2.3)},
    "shear_state": {"damping_time": (1.0, 2.3), "relaxation": (1.0, 2.3)},
    "motor": {
        "resistance": (0.05, 2.0),
        "torque_constant": (0.05, 2.0),
        "gear_efficiency": (0.1, 1.0),
        "rotor_inertia": (0.3, 2.0),
        "winding_capacity": (0.2, 2.0),
        "housing_capacity": (0.2, 2.0),
        "R_th1": (0.2, 2.0),
    },
    "housing_convection": {"R_th2": (0.3, 2.0)},
    "housing_conduction": {"conductance": (0.3, 2.0)},
}
"""What a refit moves, by effect and parameter: scale as a share of the value, and prior standard deviation in scales:
how well soil and motor are known before a drive."""
FROM_NOTHING: Mapping[str, Mapping[str, tuple[float, float, float]]] = {"shear_state": {"creep": (0.01, 5.0, 0.3)}}
"""Parameters that are nothing in a model as it comes: scale in SI units, prior standard deviation in scales, and step
of a derivative in scales. (How shear begins as a wheel starts, no law of steady driving tells, and every simulator
rounds it off somewhere, at a few centimetres a second by choice; a wheel crosses a crawl in a few readings, of which no
short step tells.)"""

NOT_MISSING = frozenset(
    {
        "parking_brake",
        "payload",
        "tether",
        "hard_surface",
        "surface_type",
        "soil_gradient",
        "boulders",
        "static_boulders",
    }
)
"""Effects that describe an arrangement of the test, which its user knows, and are never candidates by themselves."""


ASSUMED = "assumed_torque_per_ampere"
"""Parameter of `joint_control` that holds what controllers expect of an ampere, N m; 0 where they know their motor."""


def unfit(name: str, effect: Effect) -> str:
    """Why an effect is no candidate for drives, or ""."""
    del effect
    return "describes the arrangement of a test, which its user knows" if name in NOT_MISSING else ""


def with_nominal_controller(model: Model) -> Model:
    """A model whose controllers reckon with the constants that its motors have now, as those of a data sheet.

    A refit moves the motors, and no controller knows what was built in: were it to follow, a motor that is 3 % stronger
    would be asked for 3 % less current, and speeds and currents would contradict its torque. Joints whose controllers
    are told what to expect are left as they are. So is a rover whose motor `convert` assumed: nobody's controller
    reckons with that one.
    """
    if not {"motor", "joint_control"} <= set(model.effect_names):
        return model
    if model.rover.assumed:
        return model
    motor, joints = model.parameters["motor"], len(model.rover.joints)
    told = np.broadcast_to(np.asarray(model.parameters["joint_control"][ASSUMED], float), joints)
    if np.all(told > 0.0):
        return model
    expected = np.ones(joints)
    for name in ("gear_ratio", "gear_efficiency", "torque_constant"):
        expected = expected * np.broadcast_to(np.asarray(motor[name], float), joints)
    return model.set("joint_control", "compare", **{ASSUMED: np.where(told > 0.0, told, expected)})


def baseline_coordinates(model: Model, baseline: Mapping[str, Mapping[str, tuple[float, float]]]) -> list[Coordinate]:
    """Baseline parameters; one that differs between wheels or joints moves by a common factor."""
    coordinates = []
    for effect in model.effects:
        for name, (scale, prior, _) in FROM_NOTHING.get(effect.name, {}).items() if effect.name in baseline else ():
            p, value = effect.parameters[name], np.asarray(model.parameters[effect.name][name], float)
            if value.ndim == 0:
                own = Coordinate(effect.name, name, float(value), scale, *p.bounds, prior=prior, unit=p.unit)
                coordinates.append(own)
        for name, (relative, prior) in baseline.get(effect.name, {}).items():
            value = np.atleast_1d(np.asarray(model.parameters[effect.name][name], float))
            p = effect.parameters[name]
            # A factor moves no zero, and its logarithm needs a positive value.
            if np.all(value > 0.0):
                # The factor ends where the first of the wheels or joints reaches a bound of its own.
                low, high = max(p.bounds[0] / value.min(), 1e-3), min(p.bounds[1] / value.max(), 1e3)
                coordinates.append(Coordinate(effect.name, name, 1.0, relative, low, high, True, prior, factor=True))
        # Effects beyond the preset were added to explain measurements; they are refitted with the rest.
        if effect.name not in PRESETS.get(model.preset, ()) and effect.name not in NOT_MISSING:
            for name, p in effect.parameters.items():
                value = np.asarray(model.parameters[effect.name][name], float)
                if p.null is not None and value.ndim == 0:
                    coordinates.append(default_coordinate(effect, name, float(value), 0.3, 10.0))
    return coordinates
