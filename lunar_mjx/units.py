"""Units of values that come from files: conversion to the SI unit that a parameter declares."""

from __future__ import annotations

import functools
import math
import re
from pathlib import Path
from typing import Any

from lunar_mjx.errors import bad_input

_NAME = r"[A-Za-zµμΩ°%_]+"
_FACTOR = rf"(?:1|{_NAME}(?:(?:\^|\*\*)?-?\d)?)"
_UNIT = re.compile(rf"{_FACTOR}(?:\s*[*/· ]\s*{_FACTOR})*")
_PART = re.compile(rf"(?P<operator>[*/·])|(?P<name>1|{_NAME})(?:(?:\^|\*\*)?(?P<power>-?\d))?")
_OFFSET = ("degC", "°C", "celsius", "degF", "°F", "fahrenheit")

_ANGLE = {
    "rad": "plane_radian",
    "radian": "plane_radian",
    "mrad": "milliplane_radian",
    "deg": "plane_degree",
    "degree": "plane_degree",
    "°": "plane_degree",
    "rev": "plane_turn",
    "turn": "plane_turn",
    "rpm": "plane_turn_per_minute",
}
"""Pint takes an angle for a pure number, and so 1 Hz for 1 rad/s; here an angle is a dimension of its own."""


@functools.cache
def _registry() -> Any:
    import pint

    registry = pint.UnitRegistry(autoconvert_offset_to_baseunit=True)
    registry.define("plane_radian = [plane_angle]")
    registry.define(f"plane_degree = {math.pi / 180.0!r} * plane_radian")
    registry.define(f"plane_turn = {2.0 * math.pi!r} * plane_radian")
    registry.define("plane_turn_per_minute = plane_turn / minute")
    return registry


def _expression(unit: str) -> str:
    """A unit as in "N m/rad" or "kg m2", in Pint's grammar.

    Raises:
      ValueError: it is not written as factors with whole powers, such as "N m s/rad" or "1/K".
    """
    text = unit.strip()
    if not _UNIT.fullmatch(text):
        raise ValueError(unit)
    out, operator = "", ""
    for part in _PART.finditer(text):
        if part["operator"]:
            operator = "/" if part["operator"] == "/" else "*"
            continue
        name = {"%": "percent", **_ANGLE}.get(part["name"], part["name"])
        out += (operator or "*") * bool(out) + name + (f"**{part['power']}" if part["power"] else "")
        operator = ""
    return out if out != "1" else ""


def to_unit(value: float, unit: str, wanted: str, source: str | Path, field: str, *, difference: bool = False) -> float:
    """Converts `value` from `unit` to the unit `wanted`.

    Units with a power that depends on the sinkage exponent, such as N/m^(n+1), must be written exactly so.

    Args:
      value: number in `unit`.
      unit: such as "kPa", "deg", "N m/rad" or "kg m2".
      wanted: the unit to convert to.
      source: file to name in the error.
      field: field to name in the error.
      difference: the value is a difference of temperatures, which degrees Celsius cannot say.

    Raises:
      UserError: `unit` is unknown, of another dimension, or leaves no finite number.
    """
    if unit == wanted:
        return value
    shown, remedy = f"{value:g} {unit}", f"give it in {wanted}"
    if difference and unit.strip() in _OFFSET:
        raise bad_input(source, field, shown, "is a point of a scale where a difference is meant", remedy)
    try:
        quantity = _registry().Quantity(value, _expression(unit))
        converted = float(quantity.to(_expression(wanted)).magnitude)
    except Exception as error:  # Pint raises its own errors, and some of Python's parser
        raise bad_input(source, field, shown, f"does not convert to {wanted}", remedy) from error
    if not math.isfinite(converted):
        raise bad_input(source, field, shown, f"is not finite in {wanted}", "give a smaller number")
    return converted


@functools.cache
def si_dimensions(unit: str) -> tuple[tuple[str, int], ...]:
    """Base dimensions of a coherent SI unit with their powers, an angle being a pure number.

    Args:
      unit: such as "N m/rad"; without powers that depend on the sinkage exponent.

    Returns:
      Pairs such as ("[length]", 2), sorted by name; empty for a pure number.

    Raises:
      ValueError: not a unit, or not the SI unit of its dimension (such as mm, deg or degC).
    """
    try:
        quantity = _registry().Quantity(1.0, _expression(unit)).to_base_units()
    except Exception as error:  # Pint raises its own errors, and some of Python's parser
        raise ValueError(f"{unit!r} is not a unit") from error
    if not math.isclose(quantity.magnitude, 1.0, rel_tol=1e-12):
        raise ValueError(f"{unit!r} is not the SI unit, which is {quantity.units:~}")
    powers = {name: round(power) for name, power in quantity.dimensionality.items()}
    return tuple(sorted((name, power) for name, power in powers.items() if name != "[plane_angle]"))
