"""Units of values from files: what converts, and what is refused by name."""

from __future__ import annotations

import math

import pytest

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError
from lunar_mjx.units import to_unit

CONVERSIONS = [
    (180.0, "deg", "rad", math.pi),
    (180.0, "°", "rad", math.pi),
    (60.0, "rpm", "rad/s", 2.0 * math.pi),
    (2.5, "kPa", "Pa", 2500.0),
    (2.5, "mm", "m", 0.0025),
    (3.0, "cm^2", "m2", 3e-4),
    (3.0, "cm2", "m2", 3e-4),
    (150.0, "degC", "K", 423.15),
    (-40.0, "°C", "K", 233.15),
    (32.0, "degF", "K", 273.15),
    (0.5, "W/degC", "W/K", 0.5),
    (0.004, "1/degC", "1/K", 0.004),
    (71.6, "mN m/A", "N m/A", 0.0716),
    (0.0716, "V s", "N m/A", 0.0716),
    (9.0, "g cm2", "kg m2", 9e-7),
    (math.pi, "N m/deg", "N m/rad", 180.0),
    (2.0, "kohm", "ohm", 2000.0),
    (75.0, "%", "1", 0.75),
    (3.0, "1", "1", 3.0),
    (2.0, "N·m", "N m", 2.0),
    (3.0, "kg s^-2", "N/m", 3.0),
    (5.0, "N/m^(n+1)", "N/m^(n+1)", 5.0),
]


@pytest.mark.parametrize(("value", "unit", "wanted", "expected"), CONVERSIONS)
def test_conversion(value: float, unit: str, wanted: str, expected: float) -> None:
    assert to_unit(value, unit, wanted, "file", "field") == pytest.approx(expected, rel=1e-12)


REFUSED = [
    ("m", "Pa"),
    ("furlongs_per_moon", "m"),
    ("", "m"),
    ("1", "rad"),  # an angle is no pure number
    ("deg", "1"),
    ("Hz", "rad/s"),
    ("N m", "N m/rad"),
    ("N/m^(n+1)", "N/m^(n+2)"),
    ("kN/m^(n+1)", "N/m^(n+1)"),
    ("m", "N/m^(n+1)"),
    ("9**9**9**9", "m"),  # must not be computed
    ("1000 m", "m"),
    ("m + m", "m"),
    ("__import__('os')", "m"),
]


@pytest.mark.parametrize(("unit", "wanted"), REFUSED)
def test_refused_unit(unit: str, wanted: str) -> None:
    with pytest.raises(UserError) as caught:
        to_unit(2.0, unit, wanted, "model.toml", "effects.soil.n")
    text = str(caught.value)
    assert text.startswith("model.toml: effects.soil.n = ") and f"2 {unit}" in text.replace('"', "'")
    assert f"does not convert to {wanted}; give it in {wanted}." in text


def test_overflow_is_refused() -> None:
    with pytest.raises(UserError, match="not finite"):
        to_unit(1e308, "km", "m", "file", "field")


def test_degrees_celsius_say_no_difference() -> None:
    with pytest.raises(UserError, match="difference is meant; give it in K"):
        to_unit(20.0, "degC", "K", "file", "field", difference=True)
    assert to_unit(20.0, "delta_degC", "K", "file", "field", difference=True) == pytest.approx(20.0)
    assert to_unit(20.0, "K", "K", "file", "field", difference=True) == 20.0


def test_every_unit_of_the_catalogue_is_one_that_files_can_convert_to() -> None:
    units = {p.unit for e in CATALOGUE.values() for p in e.parameters.values()}
    plain = {u for u in units if "(" not in u}
    assert {"rad", "Pa", "kg m2", "1"} <= plain
    for unit in plain:
        assert to_unit(3.0, f" {unit} ", unit, "file", "field") == pytest.approx(3.0), unit
