"""Units of values that come from files: conversion to the SI unit that a parameter declares."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any

from lunar_mjx.errors import bad_input


@functools.cache
def _registry() -> Any:
    import pint

    return pint.UnitRegistry(autoconvert_offset_to_baseunit=True)


def _expression(unit: str) -> str:
    """MuJoCo-style units to Pint's grammar: "N m/rad" to "N*m/rad", "m2" to "m**2"."""
    text = unit.strip().replace("^", "**").replace(" ", "*")
    out = []
    for i, c in enumerate(text):
        if c.isdigit() and i and text[i - 1].isalpha():
            out.append("**")
        out.append(c)
    return "".join(out)


def to_unit(value: float, unit: str, wanted: str, source: str | Path, field: str) -> float:
    """Converts `value` from `unit` to the unit `wanted`.

    Units with a power that depends on the sinkage exponent, such as N/m^(n+1), must be written exactly so.

    Raises:
      UserError: `unit` is unknown or of another dimension.
    """
    if unit == wanted:
        return value
    remedy = f"give it in {wanted}"
    try:
        quantity = _registry().Quantity(value, _expression(unit) if unit != "1" else "")
        target = _expression(wanted) if wanted != "1" else ""
        if "(" in target:
            raise bad_input(source, field, f"{value} {unit}", f"is not in {wanted}", remedy)
        return float(quantity.to(target).magnitude)
    except Exception as error:
        raise bad_input(source, field, f"{value} {unit}", f"does not convert to {wanted}", remedy) from error
