"""What can be hidden in a wheel table: names, sizes, what shows it, and the port at which each acts.

`KNOWN` are effects that the tool's catalogue has, under its names; `OUTSIDE` are not. Sizes are drawn from the
literature's ranges, none from what a diagnosis can find: how far who is told can separate each is measured afterwards
(`told.py`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

Draw = Callable[[np.random.Generator, "Bed"], dict[str, float]]


@dataclasses.dataclass(frozen=True)
class Bed:
    """What sizes refer to: the wheel's radius (m), the middle load (N), and the mean pressure under the wheel (Pa)."""

    radius: float
    load: float
    pressure: float


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of hidden effect.

    Attributes:
      draw: amounts. ports: where it acts, which take the same change exactly or each a part of it.
      needs: of the table: "angles", "braking", "torque", "speeds", "loads", "gravities", "rear" (contact behind the
        axle), "sinkage", "cohesive" (soil).
      laws: base laws that can hold it.
    """

    draw: Draw
    ports: tuple[str, ...]
    needs: frozenset[str] = frozenset()
    laws: tuple[str, ...] = ("linear", "integral", "granular")


def _between(rng: np.random.Generator, low: float, high: float) -> float:
    return float(rng.uniform(low, high))


def _slip_sinkage(rng: np.random.Generator, bed: Bed) -> dict[str, float]:
    del bed
    if rng.random() < 0.6:
        return {"driving": _between(rng, 0.4, 1.5), "skid": _between(rng, 0.2, 0.8)}
    return {"lyasko": _between(rng, 0.5, 1.5)}


def _radius(rng: np.random.Generator, bed: Bed) -> dict[str, float]:
    return {"offset": float(rng.choice([-1.0, 1.0])) * _between(rng, 0.04, 0.10) * bed.radius}


def _scale(rng: np.random.Generator, bed: Bed) -> dict[str, float]:
    del bed
    return {
        "force": float(rng.choice([-1.0, 1.0])) * _between(rng, 0.08, 0.20),
        "torque": float(rng.choice([-1.0, 1.0])) * _between(rng, 0.08, 0.20),
    }


_STRESSES = ("linear", "integral")
_ANGLES, _BRAKING, _TORQUE = frozenset({"angles"}), frozenset({"braking"}), frozenset({"torque"})

KNOWN: dict[str, Kind] = {
    "slip_sinkage": Kind(_slip_sinkage, ("soil",), frozenset({"sinkage"})),
    "exit_angle": Kind(
        lambda r, b: {
            "c1": _between(r, 0.3, 0.45),
            "c2": _between(r, 0.1, 0.3),
            "c3": _between(r, 0.1, 0.4),
            "c4": _between(r, 0.0, 0.2),
        },
        ("wheel_normal",),
        laws=_STRESSES,
    ),
    "friction_circle": Kind(lambda r, b: {"share": 1.0}, ("wheel_shear",), _ANGLES, _STRESSES),
    "grousers": Kind(
        lambda r, b: {"height": _between(r, 0.04, 0.12) * b.radius, "count": float(r.integers(10, 26))},
        ("wheel_shear",),
        _TORQUE,
    ),
    "wheel_radius_error": Kind(_radius, ("geometry",), _TORQUE),
    "rolling_resistance": Kind(lambda r, b: {"coefficient": _between(r, 0.02, 0.08)}, ("wheel_shear",), _TORQUE),
    "bulldozing": Kind(
        lambda r, b: {
            "front": _between(r, 0.7, 1.3),
            "side": _between(r, 0.7, 1.5),
            "density": _between(r, 1400, 1900),
        },
        ("wheel_shear",),
        _ANGLES,
        _STRESSES,
    ),
    "shear_softening": Kind(lambda r, b: {"loss": _between(r, 0.3, 0.8)}, ("wheel_normal",), laws=_STRESSES),
    "angle_sinkage": Kind(lambda r, b: {"lateral": _between(r, 0.5, 1.5)}, ("soil",), _ANGLES | {"sinkage"}, _STRESSES),
    "slide_softening": Kind(
        lambda r, b: {"softening": _between(r, 0.4, 2.0)}, ("soil",), frozenset({"sinkage"}), _STRESSES
    ),
    "side_wall": Kind(
        lambda r, b: {"pressure": _between(r, 1.0, 2.0), "density": _between(r, 1400, 1900)},
        ("wheel_shear",),
        _ANGLES | _TORQUE,
        _STRESSES,
    ),
    "skid_shear": Kind(lambda r, b: {"share": 1.0}, ("wheel_shear",), _BRAKING, _STRESSES),
    "side_entry": Kind(
        lambda r, b: {"kept": _between(r, 0.0, 0.5)}, ("wheel_normal",), _ANGLES | {"sinkage"}, _STRESSES
    ),
    "side_exit": Kind(lambda r, b: {"lost": _between(r, 0.6, 1.0)}, ("wheel_normal",), _ANGLES | {"rear"}, _STRESSES),
    "channel_scale": Kind(_scale, ("sensor",), _TORQUE),
    "gravity_soil": Kind(
        lambda r, b: {"stiffness": _between(r, 0.6, 1.4), "cohesion": _between(r, 0.2, 0.8)},
        ("soil",),
        frozenset({"gravities"}),
        _STRESSES,
    ),
}
"""Effects by the catalogue's names."""

OUTSIDE: dict[str, Kind] = {
    "rate_friction": Kind(  # mu(I): friction that grows with the speed of sliding
        lambda r, b: {"per_decade": float(r.choice([-1.0, 1.0])) * _between(r, 0.1, 0.25)},
        ("soil", "wheel_shear"),
        frozenset({"speeds"}),
        _STRESSES,
    ),
    "curved_envelope": Kind(  # strength grows as a power of pressure (Maksimovic 1989: curved envelopes)
        lambda r, b: {"power": _between(r, 0.5, 0.75), "pressure": b.pressure},
        ("wheel_shear", "soil"),
        frozenset({"loads"}),
        _STRESSES,
    ),
    "hard_layer": Kind(  # a firm layer some millimetres down (Wong 2008, ch. 2: layered snow and soil)
        lambda r, b: {
            "modulus": _between(r, 3.0, 8.0) * b.pressure / (0.1 * b.radius),
            "depth": _between(r, 0.02, 0.05),
        },
        ("wheel_normal", "soil"),
        frozenset({"sinkage", "loads"}),
        _STRESSES,
    ),
    "soft_tyre": Kind(  # a flexible wheel whose rolling radius falls with the load
        lambda r, b: {"share": _between(r, 0.05, 0.12)}, ("geometry",), frozenset({"loads", "torque"})
    ),
    "peak_shear": Kind(  # dense sand: a hump of strength at small displacement
        lambda r, b: {"height": _between(r, 0.4, 0.9)}, ("wheel_shear", "soil"), frozenset(), _STRESSES
    ),
    # Soil lifted by the rear of a spinning rim. Its weight presses the wheel down, as too little normal stress would,
    # and has a lever about the axle. Normal stress makes no such moment, so that this part acts at the other port. With
    # base constants refitted either part alone stands out by about half of what both do.
    "rear_lift": Kind(
        lambda r, b: {"density": _between(r, 3000, 8000)},
        ("wheel_normal", "wheel_shear"),
        frozenset({"sinkage", "torque"}),
    ),
    "bearing_side_load": Kind(  # friction of the axle's bearing under side load
        lambda r, b: {"arm": _between(r, 0.08, 0.2)}, ("wheel_shear", "motor_torque"), _ANGLES | _TORQUE
    ),
    "cohesion_lost": Kind(  # cohesion that shearing breaks
        lambda r, b: {"ways": _between(r, 0.2, 1.0)}, ("soil", "wheel_shear"), frozenset({"cohesive"}), _STRESSES
    ),
    "creep_stiffness": Kind(  # soil that yields with time: stiffness grows with the travel speed
        lambda r, b: {"per_decade": _between(r, 0.15, 0.4)}, ("soil", "wheel_normal"), frozenset({"speeds", "sinkage"})
    ),
    "bed_wall": Kind(  # the wall of the bed near the wheel's flank
        lambda r, b: {"stiffer": _between(r, 0.3, 1.0)}, ("wheel_shear",), _ANGLES
    ),
}
"""Effects that no catalogue has."""

TUNE_KNOWN = (
    "slip_sinkage",
    "exit_angle",
    "friction_circle",
    "grousers",
    "wheel_radius_error",
    "rolling_resistance",
    "bulldozing",
    "shear_softening",
)
TUNE_OUTSIDE = ("rate_friction", "curved_envelope", "hard_layer", "soft_tyre")
REPORT_KNOWN = tuple(KNOWN)
"""All: what a set was tuned on and as many kinds that it was not; the score shows them apart."""
REPORT_OUTSIDE = tuple(k for k in OUTSIDE if k not in TUNE_OUTSIDE)
