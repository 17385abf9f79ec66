"""Fields of discrepancy at a rover's ports: what each is "good to", and how large an unknown input of size 1 is.

A field multiplies what acts at its port by 1 + w, or adds a share of it, where w is a smooth function of the port's own
quantities (see `inputs`). Sizes are relative, so that 5 per cent means the same on every rover.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from lunar_mjx.diagnosis.unknown_inputs.inputs import QUANTITY_SIZES

WORDS: Mapping[str, str] = {
    "command: motor current": "motor current",
    "motor_torque": "torque at the joints",
    "geometry: wheel radius": "radius of the wheels under their load",
    "soil: stiffness": "normal stress",
    "soil: shear strength": "shear strength",
    "wheel_normal: load": "load of the wheels",
    "wheel_normal: resistance": "resistance of the normal stress",
    "wheel_shear: longitudinal force": "shear force along the wheel",
    "wheel_shear: lateral force": "side force",
    "wheel_shear: driving moment": "driving torque",
    "wheel_shear: shear at a crawl": "shear of wheels that crawl",
    "body_wrench: push": "force on the body",
    "body_wrench: pitching moment": "pitching moment on the body",
    "heat: winding": "heat of the windings",
    "heat: housing": "heat of the housings",
}
"""Fields of discrepancy, and what is "good to so many per cent" in the user's words."""

ADDED, DRAWN, CRAWLING, DRIVEN = 0.25, 0.1, 15.0, 0.2
"""Sizes over that of the field: of a force that is added, over the load; of the wheel's deformation, over its radius
(as for tables); of the shear of wheels that hardly move, of which no more than the order is known; of a motor's current
and of the torque at its joint, whose laws are known better than any soil's (a choice: beside constants and effects that
are fitted, 1 % in place of 5)."""
SHARES: Mapping[str, float] = {
    "command: motor current": DRIVEN,
    "motor_torque": DRIVEN,
    "geometry: wheel radius": DRAWN,
    "wheel_normal: resistance": ADDED,
    "wheel_shear: longitudinal force": ADDED,
    "wheel_shear: lateral force": ADDED,
    "wheel_shear: driving moment": ADDED,
    "wheel_shear: shear at a crawl": CRAWLING,
    "body_wrench: push": ADDED,
    "body_wrench: pitching moment": ADDED,
}
"""Relative sizes of fields, by name; a field that is not listed is a gain and has that of gains."""


DRAWBAR = 0.1
"""Drawbar pull that is usual, over the load."""


@dataclasses.dataclass(frozen=True)
class Usual:
    """What is usual on a rover, SI units.

    Load of a wheel, its radius and its speed in rad/s; torque that acts at its drive, and that of a usual drawbar pull;
    current that acts; resistance of the winding; weight and half the wheelbase.
    """

    load: float
    radius: float
    speed: float
    torque: float
    drawbar_torque: float
    current: float
    resistance: float
    weight: float
    half_base: float

    @property
    def amounts(self) -> Mapping[str, float]:
        """What an effect of usual size amounts to on this rover, by its unit: a joint's friction takes the torque, or
        at usual speed the damping, of a drawbar pull of a tenth of the load; forces are a tenth of a wheel's load."""
        torque = self.drawbar_torque
        return {"N m": torque, "N m s/rad": torque / self.speed, "N": DRAWBAR * self.load}

    def size(self, label: str, quantity: str) -> float:
        """Amplitude, in the unit of an unknown input, of a field of size 1 that follows a quantity."""
        heat = self.current**2 * self.resistance
        amounts = {
            "command: motor current": self.current,
            "motor_torque": self.torque,
            "body_wrench: push": self.weight,
            "body_wrench: pitching moment": self.weight * self.half_base,
            "heat: winding": heat,
            "heat: housing": heat,
        }
        usual = {
            "current": self.current,
            "loss": self.current,
            "joint speed": self.speed,
            "squared joint speed": self.speed**2,
            "wheel speed": self.speed,
            "load": self.load,
            "travel speed": self.speed * self.radius,
        }
        # inputs are made for one size of rover; here their quantity is one at this rover's own usual value
        follows = QUANTITY_SIZES[quantity] / usual[quantity] if quantity in usual else 1.0
        return SHARES.get(label, 1.0) * amounts.get(label, 1.0) * follows


def rotation(columns: np.ndarray, least: float) -> np.ndarray:
    """What turns columns (n, m) so that few are left, (m, k): those at least `least` long."""
    values, vectors = np.linalg.eigh(columns.T @ columns)
    # squared lengths along principal axes; an axis shorter than that cannot be told from noise
    return vectors[:, values > least**2]
