"""Formulas that might be missing at a port, each with an amount and a null, as the source of an effect file."""

from __future__ import annotations

import dataclasses
import re
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from lunar_mjx.diagnosis.formulas import expression as f
from lunar_mjx.diagnosis.formulas.targets import (
    AGAINST,
    ALONG,
    CARRIED,
    CONSTANTS,
    DRIVE,
    LEFT,
    MODULUS,
    RESIST,
    SHEAR,
    STIFFNESS,
    STRENGTH,
    Target,
    carried,
    known,
)
from lunar_mjx.effects.base import PORTS, Effect
from lunar_mjx.logs.schema import CHANNELS, unit_of

if TYPE_CHECKING:
    from sympy import Expr

_LEAST = "jnp.maximum({}, 0.01)"
"""What a factor 1 + x never falls below."""


FORMULA_PORTS = tuple(p for p in PORTS if p != "power")
"""Ports at which formulas are looked for; what acts at `power` is what is aboard, and no law to be found."""

SUGGESTED = '"""Suggested by `lunar-mjx unknown`'
"""How every effect file begins that is made here."""


@dataclasses.dataclass(frozen=True)
class Term:
    """One formula at a port.

    Attributes:
      port: where it acts. target: what it changes there, in words. formula: the changed quantity, its amount called a.
      unit: of the amount. size: amount that would be clearly visible. source: complete effect file.
      latex: the formula for a report. length: operations and symbols in it. factor: what the amount multiplies.
    """

    port: str
    target: str
    formula: str
    unit: str
    size: float
    source: str
    latex: str = ""
    length: int = 0
    factor: str = ""

    @property
    def name(self) -> str:
        """Name of the effect that the formula becomes."""
        return "term_" + re.sub(r"\W+", "_", f"{self.port}_{self.target}_{_words(self.formula)}").strip("_")


def _words(text: str) -> str:
    for mark, word in (("**", " to "), ("-", " minus "), ("/", " per "), ("+", " plus ")):
        text = text.replace(mark, word)
    return text


def effect_of(term: Term) -> Effect:
    """The term's effect, made by running its source as a user's effect file would be."""
    module = types.ModuleType(term.name)
    # The text is our own, made below.
    exec(compile(term.source, f"<{term.name}>", "exec"), module.__dict__)
    # The decorator has put an effect where the function was; a file holds one.
    return next(v for v in vars(module).values() if isinstance(v, Effect))


def with_amount(
    term: Term, amount: float, name: str, provenance: str, constants: Mapping[str, float] | None = None
) -> str:
    """The term's effect file with its fitted amount and constants, another name and where it came from."""
    text = term.source.replace(f"def {term.name}(", f"def {name}(")
    for key, value in {"amount": amount, **(constants or {})}.items():
        declared = re.search(rf"\b{key}=Parameter\(([^,]+), ([^,]+), \(([^,]+), ([^)]+)\)", text)
        # A constant that the formula does not hold has no declaration.
        if declared is None:
            continue
        # a search may end beyond the bounds that a term is given at first
        low, high = (
            b(float(declared[n]), value * s)
            for b, n, s in ((min, 3, 0.1 if value > 0.0 else 10.0), (max, 4, 10.0 if value > 0.0 else 0.1))
        )
        # An amount about a null of zero may take either sign, in the next search as in this one.
        low, high = (min(low, -high), max(high, -low)) if declared[2] == "0.0" else (low, high)
        text = text.replace(declared[0], f"{key}=Parameter({value:.6g}, {declared[2]}, ({low!r}, {high!r})", 1)
    return text.replace('source="suggested"', f"source={provenance!r}")


def terms(port: str, sensors: Sequence[str] = ()) -> list[Term]:
    """Formulas at a port, few enough to be simulated one by one; tables are searched through `slots` for many more.

    Args:
      port: one of the ports. What needs memory has no formula at `command`; `power` has none at all.
      sensors: kinds of channels for the port `sensor`, such as `motor_drive_current_A`.
    """
    makers = {
        "soil": _soil,
        "wheel_normal": _normal,
        "wheel_shear": _shear,
        "motor_torque": _motor,
        "heat": _heat,
        "command": _command,
        "body_wrench": _body,
        "geometry": _geometry,
    }
    return list(_sensor(sensors)) if port == "sensor" else list(makers[port]()) if port in makers else []


def term(target: Target, factor: str | Expr, linear: bool = False) -> Term:
    """The term that changes a target by amount times carrier times factor, or multiplies it by what grows with that.

    Args:
      target: what changes. factor: of what the port sees. linear: multiply by 1 + x in place of exp x.
    """
    names = known(target.port)
    own = f.parsed(factor, names) if isinstance(factor, str) else factor
    product = f.parsed(target.carrier, names) * own
    # The index 0 keeps the old value apart in `k = k_0 exp(...)`; sums write `+=` and need none.
    amount, old = f.symbol("a"), f.symbol(target.symbol + ("_0" if target.multiplies else ""))
    by = _factor(amount * product, linear) if target.multiplies else amount * product
    whole = old * by if target.multiplies else by
    unit = f.per(target.unit, f.unit_of(own, names))
    used = [q for q in names if q.symbol in product.free_symbols]
    if target.multiplies:
        # exp stays positive by itself; 1 + x does not, and a negative stiffness has no meaning.
        body = _LEAST.format(f.code(by)) if linear else f.code(by)
        lines = [f"factor = {body}"]
    else:
        lines = [f"extra = {f.code(by)}"]
    sign = "=" if target.multiplies else "+="
    # Floors keep code finite; in a formula that people read they would hide the law.
    whole = f.without_floors(whole)
    shown, latex = f"{target.symbol} {sign} {f.text(whole)}", f"{target.symbol} {sign} {f.latex(whole)}"
    made = Term(target.port, target.words, shown, unit, target.size, "", latex, f.length(whole), f.text(own))
    lines = ["a = p.amount", *(f"{q.name} = {q.code}" for q in used), *lines]
    return _file(made, lines, target.change, target.bound, target.order)


def _factor(grown: Expr, linear: bool) -> Expr:
    """exp x, as a power where x holds the only logarithm, or 1 + x."""
    import sympy

    if linear:
        return 1 + grown
    logs = [a for a in sympy.Mul.make_args(grown) if isinstance(a, sympy.log)]
    if len(logs) == 1:
        # exp(a log x) is the power law that people know as x^a.
        return logs[0].args[0] ** (grown / logs[0])
    return sympy.exp(grown)


def _file(made: Term, lines: Sequence[str], change: str, bound: float = 1e3, order: int = 500) -> Term:
    """The term with the effect file that these lines and the changed value make."""
    body = "\n".join(f"    {line}" for line in (*lines, f"return {change}"))
    given = "".join(
        f'    {name}=Parameter({n!r}, None, {b!r}, "{u}", "{m}", "choice"),\n'
        for name, (n, b, u, m, _) in CONSTANTS.items()
        if re.search(rf"\bp\.{name}\b", body)
    )
    # Wide bounds: they guard against overflow, while priors hold the fit.
    limit = bound * made.size
    source = f'''{SUGGESTED}: {made.target}, {made.formula}."""

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects import Parameter, effect


@effect(
    "{made.port}",
    order={order},
    amount=Parameter({made.size!r}, 0.0, ({-limit!r}, {limit!r}), "{made.unit}", "amount a", source="suggested"),
{given})
def {made.name}(ctx, p, x, value):
    "{made.formula}, with the amount a; an empirical form found in measurements, not a law."
{body}
'''
    return dataclasses.replace(made, source=source)


_FEW = (
    "1",
    "s",
    "Max(s, 0)",
    "Max(-s, 0)",
    "s**2",
    "Abs(sin(beta))",
    "sin(beta)**2",
    "z/r",
    "z**2/r**2",
    "Abs(s)*z/r",
    "Abs(s)*Abs(sin(beta))",
    "Abs(sin(beta))*z/r",
)
"""Factors of a wheel's terms where each has to be simulated by itself."""
_HEAVY = "log(Max(W/W_1, 1/1000))"
"""Where a table holds one load only, such a term is a change of the soil."""


def _soil() -> Iterator[Term]:
    for target in (STIFFNESS, STRENGTH, MODULUS):
        # Without the constant: soil that is stiffer everywhere is what a refit of the soil takes up.
        yield from (term(target, factor) for factor in _FEW[1:])


def _normal() -> Iterator[Term]:
    yield from (term(carried(RESIST, "W", {}), factor) for factor in _FEW)
    yield from (term(CARRIED, factor, linear=True) for factor in _FEW[1:])
    yield term(RESIST, "1")
    yield term(CARRIED, _HEAVY)


def _shear() -> Iterator[Term]:
    # what does not grow with the load: cables, seals, a wheel that is mounted askew
    yield from (term(target, "1") for target in (ALONG, LEFT, carried(LEFT, "W", {"W": 0.05}), AGAINST, DRIVE))
    yield term(SHEAR, _HEAVY)
    for factor in _FEW:
        yield term(carried(ALONG, "d*W", {}), factor)
        yield term(carried(AGAINST, "-side*W", {}), factor)
        yield term(carried(DRIVE, "d*W*r", {"d*W*r": 0.05}), factor)


_SIGN = "tanh(omega/omega_0)"
_WARM, _WOUND = "(T_S - T_0)/T_1", "(T_R - T_0)/T_1"
_DRIVEN = "jnp.where(ctx.rover.joint_group == 0, {}, 0.0)"


def _joints(port: str, words: str, symbol: str, unit: str, change: str, carrier: str = "1") -> Target:
    return Target(port, words, symbol, unit, 0.3, carrier, change.replace("extra", _DRIVEN.format("extra")))


def _motor() -> Iterator[Term]:
    target = _joints("motor_torque", "torque", "tau", "N m", "value + extra", "-1")
    for factor in (
        _SIGN,
        "omega",
        "omega*Abs(omega)",
        f"{_SIGN}*Abs(I)",
        "I",
        "I*Abs(I)",
        f"omega*{_WARM}",
        f"{_SIGN}*{_WARM}",
        f"I*{_WARM}",
        f"I*{_WOUND}",
        "I*Abs(omega)",
        "1",
    ):
        # Per ampere, or in newton metres: sizes that a drive motor would show.
        yield term(dataclasses.replace(target, size=3.0 if "I" in factor else 0.3), factor)


def _heat() -> Iterator[Term]:
    for node in ("winding", "housing"):
        target = _joints(
            "heat", f"heat into the {node}", "Q", "W", f"dataclasses.replace(value, {node}=value.{node} + extra)"
        )
        for factor in ("1", "Abs(omega)", "omega**2", "Abs(I)", "I**2", "Abs(I*omega)", _WARM, _WOUND):
            yield term(target, factor)


def _command() -> Iterator[Term]:
    target = Target(
        "command",
        "motor current",
        "I",
        "1",
        0.05,
        "I",
        f"dataclasses.replace(value, current=value.current + {_DRIVEN.format('extra')})",
    )
    for factor in ("1", "Abs(omega)", _WARM, _WOUND):
        yield term(target, factor)


def _body() -> Iterator[Term]:
    push = "dataclasses.replace(value, force=value.force + ctx.frame.forward * extra)"
    for factor, size in (("1", 5.0), ("v", 20.0), ("v*Abs(v)", 50.0), ("climb", 20.0)):
        yield term(Target("body_wrench", "push forward", "F", "N", size, "-1", push), factor)
    turn = "dataclasses.replace(value, moment=value.moment + ctx.frame.left * extra)"
    yield term(Target("body_wrench", "pitching moment", "M", "N m", 2.0, "1", turn), "1")


def _geometry() -> Iterator[Term]:
    yield term(
        Target(
            "geometry",
            "wheel radius",
            "r",
            "1",
            0.02,
            "1",
            "dataclasses.replace(value, radius=value.radius * factor)",
            bound=10.0,
        ),
        "1",
        linear=True,
    )
    yield term(
        Target(
            "geometry", "toe", "toe", "rad", 0.02, "1", "dataclasses.replace(value, toe=value.toe + extra)", bound=10.0
        ),
        "1",
    )


def _sensor(kinds: Sequence[str]) -> Iterator[Term]:
    for kind in kinds:
        first, unit = kind.split("_")[0], _unit_of(kind)
        words = list(kind.split("_")[1:])
        # By words and not by whole names: a kind stands for the channels of all corners.
        test = " and ".join([f"name.startswith({first!r} + '_')", *(f"{('_' + w)!r} in name" for w in words)])
        pick = [f"chosen = [name for name in value.channels if {test}]"]
        for shown, code, per, size in (
            ("a", "jnp.ones_like(value.channels[name])", unit, 0.05),
            ("a*y", "value.channels[name]", "1", 0.02),
            ("a*dy/dt", "slope(value.channels[name], value.time)", "s", 0.05),
            ("a*t", "value.time", f"{unit}/s", 0.005),
        ):
            made = Term("sensor", kind, f"y += {shown}", per, size, "", f"y += {shown}", len(shown), shown)
            changed = f"changed = {{name: value.channels[name] + p.amount * {code} for name in chosen}}"
            draft = _file(made, [*pick, changed], "value.with_channels(changed)")
            yield dataclasses.replace(
                draft,
                source=draft.source.replace(
                    "from lunar_mjx.effects import Parameter, effect",
                    "from lunar_mjx.effects import Parameter, effect\n"
                    "from lunar_mjx.effects.sensor.channels import slope",
                ),
            )


def _unit_of(kind: str) -> str:
    """Unit of a change of a kind of channel, by the longest suffix of the schema that ends its name."""
    suffix = max((c.suffix for c in CHANNELS if c.suffix and kind.endswith(f"_{c.suffix}")), key=len, default="")
    # a difference of temperatures
    return "K" if suffix == "degC" else unit_of(suffix)
