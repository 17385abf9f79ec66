"""Soils by name, and the physical bounds of their parameters."""

from __future__ import annotations

SOILS: dict[str, dict[str, float]] = {
    "lunar_nominal": {
        "k_c": 1.4e3,
        "k_phi": 8.2e5,
        "n": 1.0,
        "cohesion": 170.0,
        "friction_angle": 0.6108652381980153,
        "shear_modulus_x": 0.0178,
        "shear_modulus_y": 0.0178,
    },
    "paper": {
        "k_c": 1e5,
        "k_phi": 1e3,
        "n": 1.1,
        "cohesion": 462.3,
        "friction_angle": 0.3889,
        "shear_modulus_x": 0.015,
        "shear_modulus_y": 0.015,
    },
    "ding_2011": {
        "k_c": 15.6e3,
        "k_phi": 2.4074e6,
        "n": 1.10,
        "cohesion": 250.0,
        "friction_angle": 0.5567600313861338,
        "shear_modulus_x": 0.0114,
        "shear_modulus_y": 0.0114,
    },
    "marssim": {
        "k_c": 13600.0,
        "k_phi": 2259100.0,
        "n": 0.92,
        "cohesion": 462.3,
        "friction_angle": 0.6108652381980153,
        "shear_modulus_x": 0.015,
        "shear_modulus_y": 0.015,
    },
    "lete_sand": {
        "k_c": 102e3,
        "k_phi": 5.301e6,
        "n": 0.793,
        "cohesion": 1300.0,
        "friction_angle": 0.5427973973702366,
        "shear_modulus_x": 0.012,
        "shear_modulus_y": 0.012,
    },
}
"""Soils by name, in SI units (angles in rad): Lunar Sourcebook; the seed paper's release (k_c and k_phi look swapped
there); Ding et al. 2011 (shear moduli 0.0097-0.0131 m, middle taken); MarsSim's parameter file; Wong (LETE sand)."""

BOUNDS: dict[str, tuple[float, float]] = {
    "k_c": (-1e7, 1e7),
    "k_phi": (0.0, 1e9),
    "n": (0.1, 3.0),
    "cohesion": (0.0, 1e6),
    "friction_angle": (0.0, 1.2),
    "shear_modulus_x": (1e-5, 1.0),
    "shear_modulus_y": (1e-5, 1.0),
}
"""Admissible closed intervals of the parameters of a soil, in SI units."""
UNITS: dict[str, str] = {
    "k_c": "N/m^(n+1)",
    "k_phi": "N/m^(n+2)",
    "n": "1",
    "cohesion": "Pa",
    "friction_angle": "rad",
    "shear_modulus_x": "m",
    "shear_modulus_y": "m",
}
"""Units of the parameters of a soil."""
