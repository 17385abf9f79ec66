"""Formulas of what a port sees, as SymPy expressions: one canonical form, units, and JAX code, text and LaTeX from it.

SymPy takes most of a second to import, so that only functions import it.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from sympy import Expr, Symbol


FLOOR = 0.02
"""Numbers up to here hold arguments of logarithms above zero."""


@dataclasses.dataclass(frozen=True)
class Quantity:
    """What a port sees, or a constant of a formula.

    Attributes:
      name: its symbol. code: JAX expression of it inside a port function. unit: SI. meaning: in a few words.
      positive: whether it never is negative.
    """

    name: str
    code: str
    unit: str
    meaning: str
    positive: bool = False

    @property
    def symbol(self) -> Symbol:
        """The quantity as a SymPy symbol."""
        return symbol(self.name, self.positive)


@functools.cache
def symbol(name: str, positive: bool = False) -> Symbol:
    """A real SymPy symbol; quantities of one name and sign share it."""
    import sympy

    return sympy.Symbol(name, positive=True) if positive else sympy.Symbol(name, real=True)


@functools.cache
def parsed(text: str, quantities: tuple[Quantity, ...]) -> Expr:
    """A formula from its text, such as `Max(s, 0)*z/r`, in the symbols of some quantities."""
    import sympy

    # SymPy evaluates the text as Python, attributes and all. So it is only given texts that this package wrote,
    # never one from a file or a command line.
    names = {q.name: q.symbol for q in quantities}
    return sympy.parse_expr(text, local_dict=names)


def canonical(expression: Expr) -> Expr:
    """The simplified formula without its leading number, which the fitted amount takes up."""
    return _simplified(expression).as_coeff_Mul()[1]


@functools.lru_cache(maxsize=4096)
def _simplified(expression: Expr) -> Any:
    import sympy

    return sympy.simplify(expression)


def same(a: Expr, b: Expr) -> bool:
    """Whether two formulas are one up to a constant factor: their ratio simplifies to a number, or is one at random
    arguments."""
    if canonical(a) == canonical(b):
        return True
    symbols = sorted(a.free_symbols | b.free_symbols, key=str)
    return _print_of(a, symbols) == _print_of(b, symbols)


def _print_of(expression: Expr, symbols: Sequence[Any]) -> bytes:
    """Fingerprint of a formula: rounded values at random arguments, alike for formulas that are algebraically equal."""
    # A fixed seed: what is printed in one call is compared with what was printed in another.
    rng = np.random.default_rng(7)
    size = 24
    arguments = [
        rng.uniform(0.05, 1.5, size) * (1.0 if s.is_positive else rng.choice([-1.0, 1.0], size)) for s in symbols
    ]
    values = np.broadcast_to(np.asarray(function(expression, symbols)(*arguments), float), (size,))
    largest = values[np.argmax(np.abs(values))]
    values = values / largest if largest else values
    # Adding zero makes -0.0 into 0.0, whose bytes differ.
    return (np.round(values, 9) + 0.0).tobytes()


def length(expression: Expr) -> int:
    """Operations and symbols in a formula: what it costs to write it down."""
    import sympy

    return int(sympy.count_ops(expression)) + sum(1 for a in sympy.preorder_traversal(expression) if a.is_Symbol)


def function(expression: Expr, symbols: Sequence[Any]) -> Any:
    """A NumPy function of a formula."""
    import sympy

    return sympy.lambdify(list(symbols), expression, modules="numpy")


def code(expression: Expr) -> str:
    """The formula as JAX code, `jnp` being jax.numpy; symbols are names."""
    return _printer().doprint(expression)


@functools.cache
def _printer() -> Any:
    from sympy.printing.numpy import JaxPrinter

    class Printer(JaxPrinter):
        """SymPy's own, with the usual name of jax.numpy, and extrema of arrays that broadcast."""

        def _module_format(self, fqn: str, register: bool = True) -> str:
            return super()._module_format(fqn, register).replace("jax.numpy.", "jnp.")

        def _extremum(self, name: str, arguments: Sequence[Any]) -> str:
            # numbers last, as reads better
            parts = [self._print(a) for a in sorted(arguments, key=lambda a: (a.is_number, str(a)))]
            return functools.reduce(lambda a, b: f"jnp.{name}({a}, {b})", parts)

        def _print_Max(self, expr: Any) -> str:
            return self._extremum("maximum", expr.args)

        def _print_Min(self, expr: Any) -> str:
            return self._extremum("minimum", expr.args)

        def _print_Abs(self, expr: Any) -> str:
            return f"jnp.abs({self._print(expr.args[0])})"

    return Printer({"fully_qualified_modules": True, "precision": 6})


def text(expression: Expr) -> str:
    """The formula in one line."""
    import sympy

    return sympy.sstr(expression)


def latex(expression: Expr) -> str:
    """The formula for a report."""
    import sympy

    return sympy.latex(expression)


def unit_of(expression: Expr, quantities: Sequence[Quantity]) -> dict[str, int]:
    """Units of a product of quantities: their powers, found by scaling all quantities of one unit.

    Raises:
      ValueError: it is no product of powers, such as a sum of lengths and forces.
    """
    used = [q for q in quantities if q.symbol in expression.free_symbols]
    symbols = [q.symbol for q in used]
    of = function(expression, symbols)
    rng = np.random.default_rng(3)
    at = [rng.uniform(0.3, 0.9, 16) * (1.0 if q.positive else rng.choice([-1.0, 1.0], 16)) for q in used]
    base = np.broadcast_to(np.asarray(of(*at), float), (16,))
    # Where a maximum is zero it stays zero, and tells nothing of how the formula scales.
    live = base != 0.0
    powers = {}
    for unit in dict.fromkeys(q.unit for q in used if q.unit not in ("1", "rad")):
        scaled = [a * (2.0 if q.unit == unit else 1.0) for a, q in zip(at, used, strict=True)]
        # A product of powers grows by the same power of two at all arguments; a sum does not.
        power = np.log2(np.broadcast_to(np.asarray(of(*scaled), float), (16,))[live] / base[live])
        if not np.allclose(power, np.round(power[0]), atol=1e-9):
            raise ValueError(f"{expression} does not scale with {unit}")
        if round(power[0]):
            powers[unit] = round(power[0])
    return powers


_FACTOR = re.compile(r"(/?)\s*([A-Za-z]+)(\d*)")


def per(unit: str, powers: Mapping[str, int]) -> str:
    """The unit of an amount, such as "N m s/rad": that of the whole over that of what it multiplies."""
    total: dict[str, int] = {}
    for name, power in [(unit, 1), *((u, -k) for u, k in powers.items())]:
        for over, base, own in _FACTOR.findall(name):
            total[base] = total.get(base, 0) + power * int(own or 1) * (-1 if over else 1)
    above = " ".join(f"{b}{k if k > 1 else ''}" for b, k in total.items() if k > 0)
    below = "".join(f"/{b}{-k if k < -1 else ''}" for b, k in total.items() if k < 0)
    return (above or "1") + below


def without_floors(expression: Expr) -> Any:
    """The formula as it is to be read: without the small numbers that hold a logarithm's argument off zero."""
    import sympy

    def bare(*arguments: Any) -> Any:
        return sympy.Max(*(a for a in arguments if not (a.is_number and 0 < a <= FLOOR)))

    return expression.replace(sympy.Max, bare)


def pairs(features: Sequence[Expr]) -> list[tuple[int, int]]:
    """Places of all products of two features, each product once: the shortest of those that are equal.

    Args:
      features: dimensionless expressions, the first of them 1.
    """
    kinds: dict[bytes, tuple[int, tuple[int, int]]] = {}
    symbols = sorted(set().union(*(e.free_symbols for e in features)), key=str)
    for i, j in itertools.combinations_with_replacement(range(len(features)), 2):
        product = features[i] * features[j]
        key, long = _print_of(product, symbols), length(product)
        if key not in kinds or long < kinds[key][0]:
            kinds[key] = long, (i, j)
    return [places for _, places in kinds.values()]


def matching(unit: tuple[int, int], quantities: Sequence[tuple[Quantity, tuple[int, int]]], arm: Quantity) -> list[str]:
    """Texts of all products of one quantity with powers of a length that have a unit.

    Args:
      unit: powers of N and m. quantities: with theirs. arm: the length.
    """
    matches = []
    for q, (newton, metre) in quantities:
        if newton == unit[0] and newton:
            power = unit[1] - metre
            # By its size: the sense is the target's own, and a force that changes its sign would turn that around.
            shown = q.name if q.positive else f"Abs({q.name})"
            matches.append(
                shown if not power else f"{shown}*{arm.name}" if power == 1 else f"{shown}*{arm.name}**{power}"
            )
    return matches
