"""Hidden effects of the test bed: those of the catalogue, written anew from their equations, and those outside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping

import numpy as np

from .bench import Act, Hidden, Values

Rng = np.random.Generator
Numbers = dict[str, float]


@dataclasses.dataclass(frozen=True)
class Kind:
    """A kind of hidden effect.

    Attributes:
      name: in the catalogue, or an own one outside it.
      draw: parameters, drawn for a wheel of radius r m.
      make: the effect at given parameters and radius.
      ports: where it acts, in the terms of the tool's ports; any of them is right.
    """

    name: str
    draw: Callable[[Rng, float], Numbers]
    make: Callable[[Numbers, float], Hidden]
    ports: tuple[str, ...]


def _with_exponent(v: Values, change: np.ndarray) -> None:
    """p = p_0 (z/r)^change: the exponent grows, the pressure at a sinkage of one radius stays."""
    scale = v["r"] ** -change
    v["k_c"], v["k_phi"], v["n"] = v["k_c"] * scale, v["k_phi"] * scale, v["n"] + change


def _one(name: str, stage: str, act: Act) -> Hidden:
    return Hidden(name, {stage: act})


# --- of the catalogue ---------------------------------------------------------------------------------------------


def _slip_sinkage(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        s = np.clip(v["slip"], -1.0, 1.0)
        _with_exponent(v, p["driving"] * np.maximum(s, 0.0) + p["skid"] * np.maximum(-s, 0.0))

    return _one("slip_sinkage", "soil", act)


def _angle_sinkage(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        s, y = np.clip(v["slip"], -1.0, 1.0), v["slide_y"]
        _with_exponent(v, p["lateral"] * (np.hypot(s, y) - np.abs(s)))

    return _one("angle_sinkage", "soil", act)


def _exit_angle(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["share_m"] = np.clip(p["c1"] + p["c2"] * v["slip"], 0.05, 0.95)
        v["share_2"] = np.clip(p["c3"] + p["c4"] * v["slip"], 0.0, 0.95)

    return _one("exit_angle", "normal", act)


def _wall(v: Values, weight: float, h: np.ndarray, h2: np.ndarray) -> np.ndarray:
    """Hegedus: D_1 (c h + D_2 gamma h^2/2) with X_c = 45 deg - phi/2, N/m."""
    phi = np.arctan(v["tan_phi"])
    x = 0.25 * np.pi - 0.5 * phi
    cot = 1.0 / np.tan(x)
    return (cot + np.tan(x + phi)) * (v["cohesion"] * h + 0.5 * (cot + cot**2 * np.tan(phi)) * weight * h2)


def _bulldozing(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        weight, z = p["density"] * v["gravity"], v["z"]
        ahead = np.clip(1.0 - v["slip"], -1.0, 1.0)
        v["fx"] = v["fx"] - p["front"] * v["b"] * _wall(v, weight, z, z**2) * ahead
        length = v["r"] * np.sin(np.minimum(v["theta_1"], 0.5 * np.pi))
        # soil beside the wheel passes at its travel, however fast the rim turns; the flank's centroid is 3/8 ahead
        passed = np.maximum(v["rim"], np.abs(v["v_x"])) / np.maximum(np.abs(v["v_x"]), 1e-9)
        j = 0.625 * length * passed * v["lateral"]
        moved = -np.sign(j) * np.expm1(-np.abs(j) / v["modulus_y"])
        v["fy"] = v["fy"] - p["side"] * length * _wall(v, weight, 2.0 / 3.0 * z, 8.0 / 15.0 * z**2) * moved

    return _one("bulldozing", "wrench", act)


def _grousers(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["lug"] = p["height"] + 0.0 * v["r"]
        v["grip"] = 1.0 + np.minimum(p["count"] * p["height"] / (2.0 * np.pi * v["r"]), 0.5)

    return _one("grousers", "shear", act)


def _friction_circle(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["circle"] = p["share"] + 0.0 * v["r"]

    return _one("friction_circle", "shear", act)


def _rolling_resistance(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["torque"] = v["torque"] + p["coefficient"] * v["r"] * np.maximum(v["vertical"], 0.0)

    return _one("rolling_resistance", "wrench", act)


def _wheel_radius_error(p: Numbers, r: float) -> Hidden:
    """The bed turns the wheel at omega = rim speed/nominal radius; slip and entrance follow the true radius."""

    def act(v: Values) -> None:
        v["rim_factor"] = (v["r"] + p["offset"]) / v["r"]
        v["r"] = v["r"] + p["offset"]

    return _one("wheel_radius_error", "geometry", act)


def _steering_toe(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["toe"] = p["angle"] + 0.0 * v["r"]

    return _one("steering_toe", "geometry", act)


def _sign(g: Rng) -> float:
    return 1.0 if g.random() < 0.5 else -1.0


KNOWN: Mapping[str, Kind] = {
    k.name: k
    for k in (
        Kind(
            "slip_sinkage",
            lambda g, r: {"driving": g.uniform(0.3, 1.2), "skid": g.uniform(0.2, 0.8)},
            _slip_sinkage,
            ("soil",),
        ),
        Kind("angle_sinkage", lambda g, r: {"lateral": g.uniform(0.5, 1.5)}, _angle_sinkage, ("soil",)),
        Kind(
            "exit_angle",
            lambda g, r: {
                "c1": g.uniform(0.35, 0.5),
                "c2": g.uniform(0.05, 0.25),
                "c3": g.uniform(0.1, 0.3),
                "c4": g.uniform(0.0, 0.2),
            },
            _exit_angle,
            ("wheel_normal",),
        ),
        Kind(
            "bulldozing",
            lambda g, r: {
                "front": g.uniform(0.6, 1.4),
                "side": g.uniform(0.6, 1.4),
                "density": g.uniform(1450.0, 1750.0),
            },
            _bulldozing,
            ("wheel_shear",),
        ),
        Kind(
            "grousers",
            lambda g, r: {"height": g.uniform(0.05, 0.12) * r, "count": float(g.integers(12, 31))},
            _grousers,
            ("wheel_shear",),
        ),
        Kind("friction_circle", lambda g, r: {"share": g.uniform(0.6, 1.0)}, _friction_circle, ("wheel_shear",)),
        Kind(
            "rolling_resistance",
            lambda g, r: {"coefficient": g.uniform(0.02, 0.08)},
            _rolling_resistance,
            ("wheel_shear",),
        ),
        Kind(
            "wheel_radius_error",
            lambda g, r: {"offset": _sign(g) * g.uniform(0.03, 0.07) * r},
            _wheel_radius_error,
            ("geometry",),
        ),
        Kind(
            "steering_toe",
            lambda g, r: {"angle": _sign(g) * np.radians(g.uniform(1.0, 4.0))},
            _steering_toe,
            ("geometry",),
        ),
    )
}
"""Effects of the catalogue that a bed in steady state can show."""


# --- outside the catalogue ----------------------------------------------------------------------------------------


def _scaled(name: str, key: str, factor: Callable[[Values, Numbers], np.ndarray]) -> Callable[[Numbers, float], Hidden]:
    def make(p: Numbers, r: float) -> Hidden:
        def act(v: Values) -> None:
            for k in key.split():
                v[k] = v[k] * factor(v, p)

        return _one(name, "soil", act)

    return make


def _added(name: str, key: str, term: Callable[[Values, Numbers], np.ndarray]) -> Callable[[Numbers, float], Hidden]:
    def make(p: Numbers, r: float) -> Hidden:
        def act(v: Values) -> None:
            v[key] = v[key] + term(v, p)

        return _one(name, "wrench", act)

    return make


def _amount(low: float, high: float) -> Callable[[Rng, float], Numbers]:
    return lambda g, r: {"amount": g.uniform(low, high)}


def _loaded(v: Values) -> np.ndarray:
    """Load over that of a contact pressure of 1500 Pa on r b."""
    return v["load"] / (1500.0 * v["r"] * v["b"])


def _layer(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["pressure"] = v["pressure"] * (1.0 + (v["z"] / (p["depth"] * v["r"])) ** 3)

    return _one("hard_layer", "normal", act)


def _deep_cohesion(p: Numbers, r: float) -> Hidden:
    def act(v: Values) -> None:
        v["cohesion"] = v["cohesion"] + p["amount"] * v["z"]

    return _one("deep_cohesion", "soil", act)


_SHEAR, _SOIL, _NORMAL = ("wheel_shear",), ("soil",), ("wheel_normal", "soil")

OUTSIDE: Mapping[str, Kind] = {
    k.name: k
    for k in (
        Kind(
            "speed_stiffness",
            _amount(0.1, 0.3),
            _scaled("speed_stiffness", "k_c k_phi", lambda v, p: np.maximum(1.0 - v["s"], 0.1) ** p["amount"]),
            _SOIL,
        ),
        Kind(
            "cable_drag",
            _amount(0.03, 0.08),
            _added("cable_drag", "fx", lambda v, p: -p["amount"] * 1500.0 * v["r"] * v["b"] * np.cos(v["beta"])),
            ("wheel_shear", "wheel_normal"),
        ),
        Kind(
            "side_offset",
            _amount(0.03, 0.08),
            _added("side_offset", "fy", lambda v, p: p["amount"] * 1500.0 * v["r"] * v["b"]),
            _SHEAR,
        ),
        Kind(
            "load_friction",
            _amount(0.08, 0.2),
            _scaled("load_friction", "tan_phi", lambda v, p: _loaded(v) ** -p["amount"]),
            _SOIL,
        ),
        Kind(
            "strain_softening",
            _amount(0.2, 0.5),
            _scaled(
                "strain_softening", "tan_phi cohesion", lambda v, p: 1.0 - p["amount"] * np.maximum(v["slip"], 0.0) ** 2
            ),
            ("soil", "wheel_shear"),
        ),
        Kind("hard_layer", lambda g, r: {"depth": g.uniform(0.2, 0.3)}, _layer, _NORMAL),
        Kind(
            "seal_torque",
            _amount(0.03, 0.08),
            _added("seal_torque", "torque", lambda v, p: p["amount"] * 1500.0 * v["r"] ** 2 * v["b"]),
            _SHEAR,
        ),
        Kind(
            "side_bearing",
            _amount(0.1, 0.3),
            _added("side_bearing", "torque", lambda v, p: p["amount"] * v["r"] * np.abs(v["fy"])),
            _SHEAR,
        ),
        Kind(
            "load_stiffness",
            _amount(0.15, 0.4),
            _scaled("load_stiffness", "k_c k_phi", lambda v, p: _loaded(v) ** p["amount"]),
            _NORMAL,
        ),
        Kind(
            "angle_modulus",
            _amount(0.8, 2.0),
            _scaled("angle_modulus", "modulus_y", lambda v, p: 1.0 + p["amount"] * np.abs(v["beta"])),
            ("soil", "wheel_shear"),
        ),
        Kind("deep_cohesion", _amount(8e3, 2e4), _deep_cohesion, ("soil", "wheel_shear")),
        Kind(
            "camber_thrust",
            _amount(0.02, 0.06),
            _added("camber_thrust", "fy", lambda v, p: p["amount"] * v["load"] * (1.0 - v["s"])),
            _SHEAR,
        ),
    )
}
"""Effects that the catalogue lacks, with the ports at which they act."""


def make(name: str, p: Numbers, radius: float) -> Hidden:
    """The hidden effect of a name at given parameters."""
    return (KNOWN[name] if name in KNOWN else OUTSIDE[name]).make(p, radius)
