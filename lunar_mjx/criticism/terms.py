"""Formulas that might be missing at a port: products of what the port sees, each with one amount, as effect source."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Iterator, Sequence

from lunar_mjx.effects.base import Effect

_WHEEL = {
    "s": ("ctx.contact.slip", "slip ratio"),
    "abs_s": ("jnp.abs(ctx.contact.slip)", "|s|"),
    "driving": ("jnp.maximum(ctx.contact.slip, 0.0)", "slip ratio when driving"),
    "braking": ("jnp.maximum(-ctx.contact.slip, 0.0)", "slip ratio when braking"),
    "side": ("jnp.abs(jnp.sin(ctx.contact.slip_angle))", "|sin beta|"),
    "depth": ("ctx.contact.sinkage / ctx.geometry.radius", "z/r"),
}
"""Dimensionless quantities of a wheel: name -> code, meaning."""
_WHEEL_PRODUCTS = (
    (), ("s",), ("driving",), ("braking",), ("abs_s", "abs_s"), ("side",), ("side", "side"), ("depth",),
    ("depth", "depth"), ("abs_s", "depth"), ("abs_s", "side"), ("side", "depth"),
)  # fmt: skip
_JOINT = {
    "turning": ("jnp.tanh(ctx.joint_speed / p.smooth)", "sgn omega", "1"),
    "omega": ("ctx.joint_speed", "omega", "rad/s"),
    "abs_omega": ("jnp.abs(ctx.joint_speed)", "|omega|", "rad/s"),
    "warm": ("(ctx.housing_temperature - 298.15 * p.kelvin) / (100.0 * p.kelvin)", "(T_S - 298 K)/100 K", "1"),
    "wound": ("(ctx.winding_temperature - 298.15 * p.kelvin) / (100.0 * p.kelvin)", "(T_R - 298 K)/100 K", "1"),
    "current": ("ctx.command.current", "I", "A"),
    "abs_current": ("jnp.abs(ctx.command.current)", "|I|", "A"),
}
_SHAPES = {
    "smooth": ("0.02", "(1e-4, 1.0)", "rad/s", "speed below which the sign fades"),
    "kelvin": ("1.0", "(1.0, 1.0)", "K", "one kelvin"),
}


@dataclasses.dataclass(frozen=True)
class Term:
    """One formula at a port.

    Attributes:
      port: where it acts. target: what it changes there, in words. formula: in symbols, without the amount.
      unit: of the amount. size: amount that would be clearly visible. source: complete effect file.
    """

    port: str
    target: str
    formula: str
    unit: str
    size: float
    source: str

    @property
    def name(self) -> str:
        """Name of its effect."""
        return "term_" + re.sub(r"\W+", "_", f"{self.port}_{self.target}_{self.formula}").strip("_")


def effect_of(term: Term) -> Effect:
    """The term's effect, made by running its source as a user's effect file would be."""
    module = types.ModuleType(term.name)
    # The text is our own, made above.
    exec(compile(term.source, f"<{term.name}>", "exec"), module.__dict__)
    return next(v for v in vars(module).values() if isinstance(v, Effect))


def with_amount(term: Term, amount: float, name: str, provenance: str) -> str:
    """The term's effect file with its fitted amount, another name and where it came from."""
    text = term.source.replace(f"def {term.name}(", f"def {name}(")
    text = re.sub(r"amount=Parameter\([^,]+,", f"amount=Parameter({amount:.6g},", text)
    return text.replace('source="suggested"', f"source={provenance!r}")


def terms(port: str, sensors: Sequence[str] = ()) -> list[Term]:
    """All formulas at a port.

    Args:
      port: one of the ports but `command` states that need memory.
      sensors: kinds of channels for the port `sensor`, such as `motor_drive_current_A`.
    """
    makers = {
        "soil": _soil, "wheel_normal": _normal, "wheel_shear": _shear, "motor_torque": _motor, "heat": _heat,
        "command": _command, "body_wrench": _body, "geometry": _geometry,
    }  # fmt: skip
    return list(_sensor(sensors)) if port == "sensor" else list(makers[port]())


def _file(
    port: str, target: str, formula: str, unit: str, size: float, lines: Sequence[str], change: str, bound: float = 1e3
) -> Term:
    body = "\n".join(f"    {line}" for line in (*lines, f"return {change}"))
    shapes = "".join(
        f'    {name}=Parameter({n}, None, {b}, "{u}", "{m}", "choice"),\n'
        for name, (n, b, u, m) in _SHAPES.items() if f"p.{name}" in body
    )  # fmt: skip
    term = Term(port, target, formula, unit, size, "")
    source = f'''"""Suggested by `lunar-mjx unknown`: {target} += amount * {formula}."""

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects import Parameter, effect


@effect(
    "{port}",
    order=500,
    amount=Parameter({size!r}, 0.0, ({-bound * size!r}, {bound * size!r}), "{unit}", "amount", source="suggested"),
{shapes})
def {term.name}(ctx, p, x, value):
    "{target} += amount * {formula}; an empirical form found in measurements, not a law."
{body}
'''
    return dataclasses.replace(term, source=source)


def _products() -> Iterator[tuple[str, str, list[str]]]:
    """Formula, code and definitions of every product of wheel quantities."""
    for product in _WHEEL_PRODUCTS:
        lines = [f"{name} = {_WHEEL[name][0]}" for name in dict.fromkeys(product)]
        yield " ".join(_WHEEL[n][1] for n in product) or "1", " * ".join(product) or "1.0", lines


def _soil() -> Iterator[Term]:
    for formula, code, lines in _products():
        if code == "1.0":
            continue
        grow = [*lines, f"factor = jnp.exp(p.amount * {code})"]
        yield _file("soil", "log stiffness", formula, "1", 0.5, grow,
                    "dataclasses.replace(value, k_c=value.k_c * factor, k_phi=value.k_phi * factor)", 20.0)  # fmt: skip
        yield _file("soil", "log shear strength", formula, "1", 0.2, grow,
                    "dataclasses.replace(value, cohesion=value.cohesion * factor, tan_phi=value.tan_phi * factor)",
                    20.0)  # fmt: skip
        yield _file("soil", "log shear modulus", formula, "1", 0.5, grow,
                    "dataclasses.replace(value, shear_modulus_x=value.shear_modulus_x * factor, "
                    "shear_modulus_y=value.shear_modulus_y * factor)", 20.0)  # fmt: skip


def _normal() -> Iterator[Term]:
    for formula, code, lines in _products():
        yield _file("wheel_normal", "resistance", f"W {formula}", "1", 0.1,
                    [*lines, f"extra = p.amount * value.load * {code}"],
                    "dataclasses.replace(value, resistance=value.resistance + extra)")  # fmt: skip
        if code != "1.0":
            yield _file("wheel_normal", "load", f"W {formula}", "1", 0.2,
                        [*lines, f"factor = 1.0 + p.amount * {code}"],
                        "dataclasses.replace(value, load=value.load * factor, sigma_m=value.sigma_m * factor)",
                        5.0)  # fmt: skip

    yield _file("wheel_normal", "resistance", "1", "N", 5.0, [],
                "dataclasses.replace(value, resistance=value.resistance + p.amount)")  # fmt: skip
    yield _file("wheel_normal", "load", "W log(W/100 N)", "1", 0.2,
                [f"factor = 1.0 + p.amount * {_HEAVY.format('value')}"],
                "dataclasses.replace(value, load=value.load * factor, sigma_m=value.sigma_m * factor)",
                5.0)  # fmt: skip


_HEAVY = "jnp.log(jnp.maximum({}.load, 1.0) / 100.0)"
"""Loads about 100 N; where a table holds one load only, such a term is a change of the soil."""


def _shear() -> Iterator[Term]:
    # what does not grow with the load: cables, seals, a wheel that is mounted askew
    yield _file("wheel_shear", "longitudinal force", "1", "N", 5.0, ["extra = p.amount * value.direction"],
                "dataclasses.replace(value, force=value.force._replace(x=value.force.x + extra))")  # fmt: skip
    for formula, code, unit, size in (
        ("1", "p.amount", "N", 5.0), ("W", "p.amount * ctx.normal.load", "1", 0.05),
        ("-sgn(v_y)", "-p.amount * jnp.tanh(20.0 * value.slip_y)", "N", 5.0),
    ):  # fmt: skip
        yield _file("wheel_shear", "lateral force", formula, unit, size, [f"extra = {code}"],
                    "dataclasses.replace(value, force=value.force._replace(y=value.force.y + extra))")  # fmt: skip
    yield _file("wheel_shear", "driving torque", "1", "N m", 0.5, ["extra = -p.amount * value.direction"],
                "dataclasses.replace(value, moment=value.moment._replace(y=value.moment.y + extra))")  # fmt: skip
    yield _file("wheel_shear", "shear force", "F log(W/100 N)", "1", 0.2,
                [f"factor = 1.0 + p.amount * {_HEAVY.format('ctx.normal')}",
                 "force = value.force._replace(x=value.force.x * factor, y=value.force.y * factor)"],
                "dataclasses.replace(value, force=force)", 5.0)  # fmt: skip
    for formula, code, lines in _products():
        yield _file("wheel_shear", "longitudinal force", f"W {formula}", "1", 0.1,
                    [*lines, f"extra = p.amount * ctx.normal.load * value.direction * {code}"],
                    "dataclasses.replace(value, force=value.force._replace(x=value.force.x + extra))")  # fmt: skip
        yield _file("wheel_shear", "lateral force", f"-W sgn(v_y) {formula}", "1", 0.1,
                    [*lines, "outward = jnp.tanh(20.0 * value.slip_y)",
                     f"extra = -p.amount * ctx.normal.load * outward * {code}"],
                    "dataclasses.replace(value, force=value.force._replace(y=value.force.y + extra))")  # fmt: skip
        yield _file("wheel_shear", "driving torque", f"W r {formula}", "1", 0.05,
                    [*lines, f"extra = -p.amount * ctx.normal.load * ctx.geometry.radius * value.direction * {code}"],
                    "dataclasses.replace(value, moment=value.moment._replace(y=value.moment.y + extra))")  # fmt: skip


def _joint_terms(products: Sequence[tuple[str, ...]]) -> Iterator[tuple[str, str, str, list[str]]]:
    for product in products:
        lines = [f"{name} = {_JOINT[name][0]}" for name in dict.fromkeys(product)]
        units = "*".join(f"({_JOINT[n][2]})" for n in product if _JOINT[n][2] != "1") or "1"
        yield " ".join(_JOINT[n][1] for n in product) or "1", " * ".join(product) or "1.0", units, lines


_DRIVEN = "jnp.where(ctx.rover.joint_group == 0, {}, 0.0)"


def _motor() -> Iterator[Term]:
    products = (("turning",), ("omega",), ("omega", "abs_omega"), ("turning", "abs_current"), ("current",),
                ("current", "abs_current"), ("omega", "warm"), ("turning", "warm"), ("current", "warm"),
                ("current", "wound"), ("current", "abs_omega"), ())  # fmt: skip
    for formula, code, units, lines in _joint_terms(products):
        size = 0.3 if "current" not in code else 3.0
        unit = "N m" if units == "1" else f"N m/({units.strip('()') if units.count('(') == 1 else units})"
        yield _file("motor_torque", "torque", f"-{formula}", unit, size,
                    [*lines, f"extra = -p.amount * {_DRIVEN.format(code)}"], "value + extra")  # fmt: skip


def _heat() -> Iterator[Term]:
    products = ((), ("abs_omega",), ("omega", "omega"), ("abs_current",), ("current", "current"),
                ("abs_current", "abs_omega"), ("warm",), ("wound",))  # fmt: skip
    for formula, code, units, lines in _joint_terms(products):
        unit = "W" if units == "1" else f"W/({units.strip('()') if units.count('(') == 1 else units})"
        for node in ("winding", "housing"):
            yield _file("heat", f"heat into the {node}", formula, unit, 0.3,
                        [*lines, f"extra = p.amount * {_DRIVEN.format(code)}"],
                        f"dataclasses.replace(value, {node}=value.{node} + extra)")  # fmt: skip


def _command() -> Iterator[Term]:
    products = ((), ("abs_omega",), ("warm",), ("wound",))
    for formula, code, units, lines in _joint_terms(products):
        yield _file("command", "motor current", f"I {formula}", "1" if units == "1" else f"1/{units}", 0.05,
                    [*lines, f"factor = 1.0 + p.amount * {_DRIVEN.format(code)}"],
                    "dataclasses.replace(value, current=value.current * factor)")  # fmt: skip


def _body() -> Iterator[Term]:
    speed = "v = ctx.velocity.dot(ctx.frame.forward)"
    for formula, code, unit, size in (("1", "1.0", "N", 5.0), ("v", "v", "N s/m", 20.0),
                                      ("v |v|", "v * jnp.abs(v)", "N s2/m2", 50.0),
                                      ("sin pitch", "-ctx.frame.forward.z", "N", 20.0)):  # fmt: skip
        lines = [speed] if "v" in code.replace("jnp", "") and "frame" not in code else []
        yield _file("body_wrench", "push forward", f"-{formula}", unit, size,
                    [*lines, f"push = -p.amount * ({code})"],
                    "dataclasses.replace(value, force=value.force + ctx.frame.forward * push)")  # fmt: skip
    yield _file("body_wrench", "pitching moment", "1", "N m", 2.0, ["turn = p.amount"],
                "dataclasses.replace(value, moment=value.moment + ctx.frame.left * turn)")  # fmt: skip


def _geometry() -> Iterator[Term]:
    yield _file("geometry", "wheel radius", "r", "1", 0.02, [],
                "dataclasses.replace(value, radius=value.radius * (1.0 + p.amount))", 10.0)  # fmt: skip
    yield _file("geometry", "toe", "1", "rad", 0.02, [], "dataclasses.replace(value, toe=value.toe + p.amount)", 10.0)


def _sensor(kinds: Sequence[str]) -> Iterator[Term]:
    for kind in kinds:
        first, unit = kind.split("_")[0], _unit_of(kind)
        words = list(kind.split("_")[1:])
        test = " and ".join([f"name.startswith({first!r} + '_')", *(f"{('_' + w)!r} in name" for w in words)])
        pick = [f"chosen = [name for name in value.channels if {test}]"]
        for formula, code, per, size in (
            ("1", "jnp.ones_like(value.channels[name])", unit, 0.05), ("y", "value.channels[name]", "1", 0.02),
            ("dy/dt", "slope(value.channels[name], value.time)", "s", 0.05),
            ("t", "value.time", f"{unit}/s", 0.005),
        ):  # fmt: skip
            term = _file("sensor", kind, formula, per, size,
                         [*pick, f"changed = {{name: value.channels[name] + p.amount * {code} for name in chosen}}"],
                         "value.with_channels(changed)")  # fmt: skip
            yield dataclasses.replace(term, source=term.source.replace(
                "from lunar_mjx.effects import Parameter, effect",
                "from lunar_mjx.effects import Parameter, effect\nfrom lunar_mjx.effects.channels import slope",
            ))  # fmt: skip


_UNITS = {"m": "m", "s": "m/s", "s2": "m/s2", "rad": "rad", "deg": "deg", "A": "A", "V": "V", "Nm": "N m", "N": "N",
          "degC": "K", "ratio": "1"}  # fmt: skip


def _unit_of(kind: str) -> str:
    if kind.endswith("rad_s"):
        return "rad/s"
    return _UNITS.get(kind.rsplit("_", 1)[-1], "1")
