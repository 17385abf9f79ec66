"""What a formula may change at a port, and what the ports see: the alphabet of suggested formulas."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import TYPE_CHECKING

from lunar_mjx.diagnosis.formulas.expression import Quantity, matching, parsed

if TYPE_CHECKING:
    from sympy import Expr

_CONTACT = (
    Quantity("s", "ctx.contact.slip", "1", "slip ratio"),
    Quantity("beta", "ctx.contact.slip_angle", "rad", "slip angle"),
    Quantity("z", "ctx.contact.sinkage", "m", "sinkage", True),
    Quantity("r", "ctx.geometry.radius", "m", "wheel radius", True),
)
_SHARE = "ctx.normal.sigma_m * ctx.soil.tan_phi"
_FORCES = (
    Quantity("F_x", "value.force.x", "N", "longitudinal force"),
    Quantity("F_y", "value.force.y", "N", "lateral force"),
    Quantity("M_y", "value.moment.y", "N m", "moment about the axle"),
    Quantity("d", "value.direction", "1", "direction of rolling"),
    # A smooth sign: forces have a derivative where the wheel does not slide aside.
    Quantity("side", "jnp.tanh(20.0 * value.slip_y)", "1", "side to which the wheel slides"),
    Quantity(
        "q",
        f"{_SHARE} / jnp.where(ctx.soil.cohesion + {_SHARE} > 0.0, ctx.soil.cohesion + {_SHARE}, 1.0)",
        "1",
        "share of friction in the shear strength",
        True,
    ),
)
_JOINT = (
    Quantity("omega", "ctx.joint_speed", "rad/s", "speed of the joint"),
    Quantity("T_R", "ctx.winding_temperature", "K", "temperature of the winding", True),
    Quantity("T_S", "ctx.housing_temperature", "K", "temperature of the housing", True),
)
_CURRENT = Quantity("I", "ctx.command.current", "A", "motor current")
SEEN: Mapping[str, tuple[Quantity, ...]] = {
    "soil": _CONTACT,
    "wheel_normal": (
        *_CONTACT,
        Quantity("W", "value.load", "N", "load that the soil carries", True),
        Quantity("R", "value.resistance", "N", "resistance of compaction", True),
    ),
    "wheel_shear": (
        *_CONTACT,
        Quantity("W", "ctx.normal.load", "N", "load that the soil carries", True),
        Quantity("R", "ctx.normal.resistance", "N", "resistance of compaction", True),
        *_FORCES,
    ),
    **dict.fromkeys(("motor_torque", "heat"), (_CURRENT, *_JOINT)),
    "command": (dataclasses.replace(_CURRENT, code="value.current"), *_JOINT),
    "body_wrench": (
        Quantity("v", "ctx.velocity.dot(ctx.frame.forward)", "m/s", "speed forward"),
        Quantity("climb", "ctx.frame.forward.z", "1", "sine of the pitch"),
    ),
    "geometry": (),
}
"""What formulas at a port may hold."""

CONSTANTS: Mapping[str, tuple[float, tuple[float, float], str, str, bool]] = {
    "W_1": (100.0, (100.0, 100.0), "N", "unit of load", False),
    "T_0": (298.15, (298.15, 298.15), "K", "temperature from which is counted", False),
    "T_1": (100.0, (100.0, 100.0), "K", "unit of temperature", False),
    "omega_0": (0.02, (1e-4, 1.0), "rad/s", "speed below which the sign fades", False),
    "s_0": (0.2, (0.02, 2.0), "1", "slip at which it begins or saturates", True),
    "beta_0": (0.2, (0.02, 1.5), "rad", "slip angle at which it begins", True),
    "z_0": (0.1, (0.01, 1.0), "1", "sinkage over radius at which it begins", True),
}
"""Constants of formulas: nominal value, bounds, unit, meaning, and whether a fit refines it."""


def constants() -> tuple[Quantity, ...]:
    """The constants as quantities: parameters of the effect."""
    return tuple(Quantity(k, f"p.{k}", unit, meaning, True) for k, (_, _, unit, meaning, _) in CONSTANTS.items())


def known(port: str) -> tuple[Quantity, ...]:
    """Quantities and constants of a port's formulas."""
    return (*SEEN[port], *constants())


ONE = "1"
SLIP = (
    "s",
    "Abs(s)",
    "Max(s, 0)",
    "Max(-s, 0)",
    "1 - s",
    "log(Max(1 - s, 1/50))",
    "1 - exp(-Abs(s)/s_0)",
    "Max(Abs(s) - s_0, 0)",
)
ANGLE = ("Abs(sin(beta))", "cos(beta)", "Abs(beta)", "Max(Abs(beta) - beta_0, 0)")
DEPTH = ("z/r", "z**2/r**2", "log(Max(z/r, 1/1000))", "Max(z/r - z_0, 0)")
LOAD = ("W/W_1", "log(Max(W/W_1, 1/1000))")
LOADED = ("wheel_normal", "wheel_shear")
"""Ports at which the load is known."""


@functools.cache
def features(port: str) -> tuple[Expr, ...]:
    """1, and dimensionless features of a wheel at a port, of which products are made."""
    texts = (ONE, *SLIP, *ANGLE, *DEPTH, *(LOAD if port in LOADED else ()))
    return tuple(parsed(t, known(port)) for t in texts)


@dataclasses.dataclass(frozen=True)
class Target:
    """A quantity at a port that a formula changes by adding to it or by multiplying it.

    Attributes:
      port: where. words: what. symbol: what it is called in formulas.
      unit: of an amount times the carrier at 1. size: amount that is clearly visible.
      carrier: text of what multiplies amount and factor, such as a load.
      change: code of the changed value, with `extra` what is added, or `factor` what multiplies.
      order: of the effect at its port. bound: of the amount, in sizes.
    """

    port: str
    words: str
    symbol: str
    unit: str
    size: float
    carrier: str
    change: str
    order: int = 500
    bound: float = 1e3

    @property
    def multiplies(self) -> bool:
        """Whether the formula multiplies the quantity; else it adds to it."""
        return "factor" in self.change


def _scaled(port: str, words: str, symbol: str, size: float, *fields: str) -> Target:
    changed = ", ".join(f"{f}=value.{f} * factor" for f in fields)
    return Target(port, words, symbol, "1", size, "1", f"dataclasses.replace(value, {changed})", bound=20.0 / size)


def _force(axis: str) -> str:
    return f"dataclasses.replace(value, force=value.force._replace({axis}=value.force.{axis} + extra))"


_TORQUE = "dataclasses.replace(value, moment=value.moment._replace(y=value.moment.y - extra))"
_GRIP = "dataclasses.replace(value, grip=factor if value.grip is None else value.grip * factor)"
# The moduli go along, so that the pressure at a sinkage of one radius stays as it was.
_EXPONENT = (
    "dataclasses.replace(value, n=value.n + extra, k_c=value.k_c * ctx.geometry.radius ** -extra, "
    "k_phi=value.k_phi * ctx.geometry.radius ** -extra)"
)

STIFFNESS = _scaled("soil", "stiffness", "k", 0.5, "k_c", "k_phi")
STRENGTH = _scaled("soil", "shear strength", "tau", 0.2, "cohesion", "tan_phi")
MODULUS = _scaled("soil", "shear modulus", "K", 0.5, "shear_modulus_x", "shear_modulus_y")
CARRIED = _scaled("wheel_normal", "load", "W", 0.2, "load", "sigma_m")
GRIP = Target("wheel_shear", "shear stress", "tau", "1", 0.2, "1", _GRIP, order=-5, bound=100.0)
_BOTH = "dataclasses.replace(value, force=value.force._replace(x=value.force.x * factor, y=value.force.y * factor))"
SHEAR = Target("wheel_shear", "shear force", "F", "1", 0.2, "1", _BOTH, bound=25.0)


def carried(base: Target, carrier: str, sizes: Mapping[str, float]) -> Target:
    """A target of force or torque with another carrier: the amount is then a share."""
    return dataclasses.replace(base, carrier=carrier, unit="1", size=sizes.get(carrier, 0.1))


RESIST = Target(
    "wheel_normal", "resistance", "R", "N", 5.0, "1", "dataclasses.replace(value, resistance=value.resistance + extra)"
)
ALONG = Target("wheel_shear", "longitudinal force", "F_x", "N", 5.0, "d", _force("x"))
LEFT = Target("wheel_shear", "lateral force", "F_y", "N", 5.0, "1", _force("y"))
AGAINST = Target("wheel_shear", "lateral force", "F_y", "N", 5.0, "-side", _force("y"))
DRIVE = Target("wheel_shear", "driving torque", "M", "N m", 0.5, "d", _TORQUE)


@functools.cache
def wheel_targets(port: str) -> tuple[Target, ...]:
    """All that formulas may change at a port of a wheel: fields one by one, and what has their unit with every product
    of forces and lengths that matches it."""
    if port == "soil":
        one = [
            _scaled("soil", "angle of friction", "tan_phi", 0.2, "tan_phi"),
            _scaled("soil", "longitudinal shear modulus", "K_x", 0.5, "shear_modulus_x"),
            _scaled("soil", "lateral shear modulus", "K_y", 0.5, "shear_modulus_y"),
            Target(
                "soil",
                "cohesion",
                "c",
                "Pa",
                500.0,
                "1",
                "dataclasses.replace(value, cohesion=jnp.maximum(value.cohesion + extra, 0.0))",
            ),
            Target("soil", "sinkage exponent", "n", "1", 0.2, "1", _EXPONENT, bound=5.0),
        ]
        return (STIFFNESS, STRENGTH, MODULUS, *one)
    named = {q.name: q for q in SEEN[port]}
    if port == "wheel_normal":
        loads = matching((1, 0), [(named["W"], (1, 0)), (named["R"], (1, 0))], named["r"])
        return (CARRIED, RESIST, *(carried(RESIST, c, {}) for c in loads))
    forces = [
        (named[n], unit)
        for n, unit in (("W", (1, 0)), ("R", (1, 0)), ("F_x", (1, 0)), ("F_y", (1, 0)), ("M_y", (1, 1)))
    ]
    targets = [GRIP, dataclasses.replace(GRIP, words="friction", carrier="q"), SHEAR]
    for base, unit in ((ALONG, (1, 0)), (LEFT, (1, 0)), (AGAINST, (1, 0)), (DRIVE, (1, 1))):
        own = "" if base.carrier == "1" else f"{base.carrier}*"
        targets += [base, *(carried(base, own + c, {}) for c in matching(unit, forces, named["r"]))]
    return tuple(targets)
