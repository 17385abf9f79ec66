"""What a contact law may get wrong at a wheel's ports: gains on its stresses, forces and moment, per point of a table.

A field of discrepancy is one smooth function w of slip, slip angle, load and speed. It multiplies a stress or force of
the law by 1 + w, so that drawbar pull, side force, torque and sinkage of a point move together as physics has it. A law
is usually inexact in what it has; a force that it lacks altogether is something unlisted, and a second smooth function
adds it there, as a share of the load.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from lunar_mjx.effects.base import Effect, Parameter

_LAST = 10_000
"""Order at a port: after every effect."""


SCALED, ADDED, DRAWN = "scaled", "added", "drawn"


@dataclasses.dataclass(frozen=True)
class Gain:
    """A gain at a port.

    Attributes:
      field: the discrepancy that it belongs to.
      port: of the effects' pipeline.
      act: function(ctx, amount, value) that applies it.
      kind: SCALED for a gain on a stress or force that is there, ADDED for a force that is missing, as a share of the
        load, DRAWN for a change of the wheel's shape.
    """

    field: str
    port: str
    act: Callable[[Any, Any, Any], Any]
    kind: str


def _stiffness(ctx: Any, a: Any, soil: Any) -> Any:
    # Both moduli: pressure is proportional to their sum over one width, and the gain is on the pressure.
    return dataclasses.replace(soil, k_c=soil.k_c * (1.0 + a), k_phi=soil.k_phi * (1.0 + a))


def _strength(ctx: Any, a: Any, soil: Any) -> Any:
    return dataclasses.replace(soil, tan_phi=soil.tan_phi * (1.0 + a), cohesion=soil.cohesion * (1.0 + a))


def _resistance(ctx: Any, a: Any, wheel: Any) -> Any:
    # Resistance opposes the motion whichever way the wheel drives.
    push = wheel.direction * a * ctx.normal.resistance
    return dataclasses.replace(wheel, force=wheel.force._replace(x=wheel.force.x - push))


def _drag(ctx: Any, a: Any, wheel: Any) -> Any:
    return dataclasses.replace(wheel, force=wheel.force._replace(x=wheel.force.x - a * ctx.normal.load))


def _thrust(ctx: Any, a: Any, wheel: Any) -> Any:
    # The force is thrust less resistance; put back, it leaves the shear stress alone, which also makes the moment.
    thrust = wheel.force.x + wheel.direction * ctx.normal.resistance
    force = wheel.force._replace(x=wheel.force.x + a * thrust)
    return dataclasses.replace(wheel, force=force, moment=wheel.moment._replace(y=wheel.moment.y * (1.0 + a)))


def _side(ctx: Any, a: Any, wheel: Any) -> Any:
    return dataclasses.replace(wheel, force=wheel.force._replace(y=wheel.force.y * (1.0 + a)))


def _push_aside(ctx: Any, a: Any, wheel: Any) -> Any:
    return dataclasses.replace(wheel, force=wheel.force._replace(y=wheel.force.y + a * ctx.normal.load))


def _moment(ctx: Any, a: Any, wheel: Any) -> Any:
    return dataclasses.replace(wheel, moment=wheel.moment._replace(y=wheel.moment.y * (1.0 + a)))


def _seal(ctx: Any, a: Any, wheel: Any) -> Any:
    added = a * ctx.normal.load * ctx.geometry.radius
    return dataclasses.replace(wheel, moment=wheel.moment._replace(y=wheel.moment.y - added))


def _radius(ctx: Any, a: Any, geometry: Any) -> Any:
    return dataclasses.replace(geometry, radius=geometry.radius * (1.0 + a))


MOMENT = "wheel_shear: driving moment"
"""Field of the moment about the axle: the shear stress along the wheel at one lever, the radius, whatever its place."""

GAINS: tuple[Gain, ...] = (
    Gain("soil: stiffness", "soil", _stiffness, SCALED),
    Gain("soil: shear strength", "soil", _strength, SCALED),
    Gain("wheel_normal: resistance", "wheel_shear", _resistance, SCALED),
    Gain("wheel_normal: resistance", "wheel_shear", _drag, ADDED),
    Gain("wheel_shear: longitudinal force", "wheel_shear", _thrust, SCALED),
    Gain("wheel_shear: lateral force", "wheel_shear", _side, SCALED),
    Gain("wheel_shear: lateral force", "wheel_shear", _push_aside, ADDED),
    Gain(MOMENT, "wheel_shear", _moment, SCALED),
    Gain(MOMENT, "wheel_shear", _seal, ADDED),
    Gain("geometry: radius", "geometry", _radius, DRAWN),
)
"""Gains of all fields; a wheel bed takes one amount of each, which may differ between points."""

FIELDS: Mapping[str, str] = {
    "soil: stiffness": "normal stress",
    "soil: shear strength": "shear strength",
    "wheel_normal: resistance": "resistance of the normal stress",
    "wheel_shear: longitudinal force": "shear stress along the wheel",
    "wheel_shear: lateral force": "side force",
    MOMENT: "driving torque",
    "geometry: radius": "radius of the wheel under its load",
}
"""Fields of discrepancy, and what is "good to so many per cent" in the user's words."""

EFFECT = "port_gains"


def gains_effect() -> Effect:
    """All gains as one effect, whose parameters `gain_0`, `gain_1`, ... are the amounts of `GAINS`."""

    def at(port: str) -> Callable[..., Any]:
        mine = [(i, g) for i, g in enumerate(GAINS) if g.port == port]

        def function(ctx: Any, p: Any, x: Any, value: Any) -> Any:
            # Each gain sees the law's own value: amounts stay additive to first order, whatever their order.
            for i, gain in mine:
                value = gain.act(ctx, getattr(p, f"gain_{i}"), value)
            return value

        return function

    parameters = {
        f"gain_{i}": Parameter(0.0, 0.0, (-1.0, 1.0), "1", f"discrepancy of {g.field}", "unknown input")
        for i, g in enumerate(GAINS)
    }
    ports = dict.fromkeys(g.port for g in GAINS)
    return Effect(EFFECT, {port: at(port) for port in ports}, parameters, order=_LAST, doc="Unknown inputs at ports.")
