"""Unknown inputs of drives: something that nobody modelled acts at a port and follows the port's quantities."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter

Act = Callable[[Any, Any, Any], Any]
SOURCE = "unknown input of a localisation"
SMOOTH = "smooth_inputs"
"""Name of the effect that holds all inputs which follow quantities of their ports."""
_ORDER = 1000
"""After all effects at a port: an unknown input adds to what they made of its value."""


def _torque(ctx, a, value):
    # group 0 drives wheels; steering and suspension joints are left as they are
    return value + jnp.where(ctx.rover.joint_group == 0, a, 0.0)


def _current(ctx, a, value):
    return dataclasses.replace(value, current=value.current + jnp.where(ctx.rover.joint_group == 0, a, 0.0))


def _radius(ctx, a, value):
    return dataclasses.replace(value, radius=value.radius * (1.0 + a))


def _stiffness(ctx, a, value):
    # Both of Bekker's moduli, so that a share is the same for wheels of any width.
    return dataclasses.replace(value, k_c=value.k_c * (1.0 + a), k_phi=value.k_phi * (1.0 + a))


def _strength(ctx, a, value):
    # Cohesion and friction together: the share is then the same at any load.
    return dataclasses.replace(value, tan_phi=value.tan_phi * (1.0 + a), cohesion=value.cohesion * (1.0 + a))


def _load(ctx, a, value):
    return dataclasses.replace(value, load=value.load * (1.0 + a))


def _resistance(ctx, a, value):
    # in loads of the wheel, so that a size means the same on every rover
    return dataclasses.replace(value, resistance=value.resistance + a * value.load)


def _force_x(ctx, a, value):
    return dataclasses.replace(value, force=value.force._replace(x=value.force.x + a * ctx.normal.load))


def _force_y(ctx, a, value):
    return dataclasses.replace(value, force=value.force._replace(y=value.force.y + a * ctx.normal.load))


def _moment_y(ctx, a, value):
    moment = value.moment.y + a * ctx.normal.load * ctx.geometry.radius
    return dataclasses.replace(value, moment=value.moment._replace(y=moment))


def _shear(ctx, a, value):
    more = 1.0 + a
    return dataclasses.replace(value, force=value.force * more, moment=value.moment * more)


def _push(ctx, a, value):
    forward = ctx.frame.forward
    return dataclasses.replace(value, force=value.force + forward * a)


def _tilt(ctx, a, value):
    left = ctx.frame.left
    return dataclasses.replace(value, moment=value.moment + left * a)


def _winding(ctx, a, value):
    return dataclasses.replace(value, winding=value.winding + jnp.where(ctx.rover.joint_group == 0, a, 0.0))


def _housing(ctx, a, value):
    return dataclasses.replace(value, housing=value.housing + jnp.where(ctx.rover.joint_group == 0, a, 0.0))


PROBES: Mapping[str, tuple[str, Act, float, str]] = {
    "command: motor current": ("command", _current, 0.05, "A"),
    "motor_torque": ("motor_torque", _torque, 0.5, "N m"),
    "geometry: wheel radius": ("geometry", _radius, 0.02, "1"),
    "soil: stiffness": ("soil", _stiffness, 0.3, "1"),
    "soil: shear strength": ("soil", _strength, 0.1, "1"),
    "wheel_normal: load": ("wheel_normal", _load, 0.1, "1"),
    "wheel_normal: resistance": ("wheel_normal", _resistance, 0.05, "1"),
    "wheel_shear: longitudinal force": ("wheel_shear", _force_x, 0.05, "1"),
    "wheel_shear: lateral force": ("wheel_shear", _force_y, 0.05, "1"),
    "wheel_shear: driving moment": ("wheel_shear", _moment_y, 0.05, "1"),
    "wheel_shear: shear at a crawl": ("wheel_shear", _shear, 0.3, "1"),
    "body_wrench: push": ("body_wrench", _push, 5.0, "N"),
    "body_wrench: pitching moment": ("body_wrench", _tilt, 2.0, "N m"),
    "heat: winding": ("heat", _winding, 0.5, "W"),
    "heat: housing": ("heat", _housing, 0.5, "W"),
}
"""Unknown inputs: label -> port, what an amount does there, its size, its unit."""


def _wheel_speed(ctx):
    return ctx.contact.rim_speed / ctx.geometry.radius


QUANTITY_SIZES: Mapping[str, float] = {
    "constant": 1.0,
    "current": 1.0,
    "joint speed": 2.0,
    "squared joint speed": 4.0,
    "direction": 1.0,
    "rolling direction": 1.0,
    "wheel speed": 2.0,
    "slip": 0.3,
    "signed slip": 0.3,
    "lateral slip": 0.3,
    "load": 100.0,
    "loss": 1.0,
    "travel speed": 0.2,
    "below 1 cm/s": 1.0,
    "below 3 cm/s": 1.0,
    "below 10 cm/s": 1.0,
}
"""Usual sizes of the quantities that an unknown input may follow: A, rad/s, slip, N, m/s; signs
follow the motion."""

_AT_REST = 0.03
"""rad/s of a joint or a wheel below which it has hardly a direction."""


def _below(speed: float) -> Callable[[Any, Any], Any]:
    """What is 1 where rim and hub stand still, and fades above a speed, m/s."""
    return lambda ctx, value: jnp.exp(-(jnp.abs(ctx.contact.rim_speed) + jnp.abs(ctx.contact.v_x)) / (2.0 * speed))


_READ: Mapping[str, Callable[[Any, Any], Any]] = {
    "constant": lambda ctx, value: 1.0,
    "current": lambda ctx, value: value.current,
    "joint speed": lambda ctx, value: ctx.joint_speed,
    # Signed, so that such a drag opposes the motion both ways.
    "squared joint speed": lambda ctx, value: ctx.joint_speed * jnp.abs(ctx.joint_speed),
    # A sign that has a derivative where the joint stands still.
    "direction": lambda ctx, value: jnp.tanh(ctx.joint_speed / _AT_REST),
    "rolling direction": lambda ctx, value: jnp.tanh(_wheel_speed(ctx) / _AT_REST),
    "wheel speed": lambda ctx, value: _wheel_speed(ctx),
    "slip": lambda ctx, value: ctx.contact.soil_slip,
    "signed slip": lambda ctx, value: value.slip_x,
    "lateral slip": lambda ctx, value: value.slip_y,
    "load": lambda ctx, value: value.load,
    "loss": lambda ctx, value: jnp.abs(ctx.command.current),
    "travel speed": lambda ctx, value: ctx.velocity.dot(ctx.frame.forward),
    "below 1 cm/s": _below(0.01),
    "below 3 cm/s": _below(0.03),
    "below 10 cm/s": _below(0.1),
}


def _quantity(name: str, ctx: Any, value: Any) -> Any:
    """A quantity over its usual size. (A loss that follows the square of the current is the winding's resistance, which
    every refit moves.)"""
    return _READ[name](ctx, value) / QUANTITY_SIZES[name]


FOLLOWS: Mapping[str, tuple[str, ...]] = {
    "command: motor current": ("constant", "current", "joint speed"),
    "motor_torque": ("direction", "joint speed", "squared joint speed"),
    "geometry: wheel radius": ("constant",),
    "soil: stiffness": ("slip", "wheel speed"),
    "soil: shear strength": ("slip", "wheel speed"),
    "wheel_normal: load": ("constant", "slip", "load"),
    "wheel_normal: resistance": ("constant", "slip", "wheel speed"),
    # A wheel has no front: what soil does to one that rolls back is the mirror image.
    "wheel_shear: longitudinal force": ("rolling direction", "signed slip", "wheel speed"),
    "wheel_shear: lateral force": ("constant", "lateral slip"),
    "wheel_shear: driving moment": ("rolling direction", "signed slip", "wheel speed"),
    # How shear begins as a wheel starts, no law of steady driving tells, and every simulator rounds it off somewhere.
    "wheel_shear: shear at a crawl": ("below 1 cm/s", "below 3 cm/s", "below 10 cm/s"),
    "body_wrench: push": ("constant", "travel speed"),
    "body_wrench: pitching moment": ("constant",),
    "heat: winding": ("constant", "loss"),
    "heat: housing": ("constant",),
}
"""What each input may follow: to first order, any smooth function of a port's own quantities. (A torque that follows
the current is the motor's constant, and other constants of the soil are its parameters: every refit moves these.)"""


def present(label: str, ports: frozenset[str]) -> bool:
    """Whether an input can act on a model whose effects are at these ports."""
    return PROBES[label][0] in ports or PROBES[label][0] in ("geometry", "body_wrench")


@functools.cache
def smooth_inputs(ports: frozenset[str]) -> Effect:
    """All inputs that follow quantities of their ports, as one effect; amplitudes are named by `amplitude`.

    Args:
      ports: at which the model's effects act.
    """
    labels = [label for label in PROBES if present(label, ports)]
    amplitudes = {
        amplitude(label, quantity): _amplitude(*PROBES[label][2:], f"{label} with {quantity}")
        for label in labels
        for quantity in FOLLOWS[label]
    }

    def at(port: str) -> Callable[..., Any]:
        mine = [label for label in labels if PROBES[label][0] == port]

        def function(ctx, p, x, value):
            # all follow what came in: otherwise the order of the inputs would matter
            given = value
            for label in mine:
                amount = sum(getattr(p, amplitude(label, q)) * _quantity(q, ctx, given) for q in FOLLOWS[label])
                value = PROBES[label][1](ctx, amount, value)
            return value

        return function

    own = dict.fromkeys(PROBES[label][0] for label in labels)
    return Effect(SMOOTH, {port: at(port) for port in own}, amplitudes, order=_ORDER, doc=SOURCE)


def amplitude(label: str, quantity: str) -> str:
    """Name of the amplitude of an input that follows a quantity."""
    return f"{_word(label)}__{_word(quantity)}"


def _amplitude(size: float, unit: str, meaning: str) -> Parameter:
    return Parameter(size, 0.0, (-1e3 * size, 1e3 * size), unit, meaning, SOURCE)


def _word(label: str) -> str:
    return "".join(c if c.isalnum() else "_" for c in label)
