"""Formulas as SymPy expressions, and the slots that hold any of them: units, one form, code that means the same."""

from __future__ import annotations

import itertools
from collections import Counter
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.diagnosis.formulas import expression as f
from lunar_mjx.diagnosis.formulas.slots import WHEEL_PORTS, Choice, library, slots_effect, targets
from lunar_mjx.diagnosis.formulas.targets import features, known, wheel_targets
from lunar_mjx.diagnosis.formulas.terms import effect_of, term, terms
from lunar_mjx.effect_contract.dimensions import check_unit
from lunar_mjx.effects.base import PORTS
from lunar_mjx.effects.context import Soil, WheelForce
from lunar_mjx.effects.ports import initial_normal
from lunar_mjx.spatial import Vec3
from lunar_mjx.units import si_dimensions

SHEAR = known("wheel_shear")


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("Max(s, 0)*Abs(s)", "Max(s, 0)**2"),
        ("sin(beta)**2 + cos(beta)**2", "1"),
        ("3*z/r", "z/r"),
        ("Abs(s*sin(beta))", "2*Abs(sin(beta))*Abs(s)"),
        ("(z**2 - r**2)/r**2", "(z/r - 1)*(z/r + 1)"),
    ],
)
def test_what_is_algebraically_equal_is_one_formula(a, b):
    assert f.same(f.parsed(a, SHEAR), f.parsed(b, SHEAR))


@pytest.mark.parametrize(("a", "b"), [("s", "Abs(s)"), ("z/r", "z**2/r**2"), ("Max(s, 0)", "s"), ("1 - s", "s")])
def test_what_is_not_equal_is_two(a, b):
    assert not f.same(f.parsed(a, SHEAR), f.parsed(b, SHEAR))


def test_products_hold_no_formula_twice():
    given = [f.parsed(t, SHEAR) for t in ("1", "Max(s, 0)", "Abs(s)", "s")]
    found = [given[i] * given[j] for i, j in f.pairs(given)]
    assert len(found) > len(given)
    assert not [(a, b) for a, b in itertools.combinations(found, 2) if f.same(a, b)]
    # s+ |s| and s+ s are s+^2, and |s| |s| is s s
    assert sorted(map(str, found)) == ["1", "Abs(s)", "Max(0, s)", "Max(0, s)**2", "s", "s**2", "s*Abs(s)"]


def test_units_follow_from_scaling():
    assert f.unit_of(f.parsed("W*r*Abs(s)", SHEAR), SHEAR) == {"N": 1, "m": 1}
    assert f.unit_of(f.parsed("log(W/W_1)*z/r", SHEAR), SHEAR) == {}
    with pytest.raises(ValueError, match="does not scale"):
        f.unit_of(f.parsed("z + z**2", SHEAR), SHEAR)
    assert f.per("N m", {"rad/s": 2, "A": -1}) == "N m s2 A/rad2"
    assert [t.unit for t in terms("motor_torque")][:4] == ["N m", "N m s/rad", "N m s2/rad2", "N m/A"]
    for kind, unit in (("motor_drive_current_A", "A"), ("winding_drive_temperature_degC", "K"), ("bus_load_W", "W")):
        assert [t.unit for t in terms("sensor", (kind,))] == [unit, "1", "s", f"{unit}/s"]


def test_what_a_force_may_be_is_every_product_of_the_same_unit():
    torque = {t.carrier for t in wheel_targets("wheel_shear") if t.words == "driving torque"}
    assert torque == {"d", "d*W*r", "d*R*r", "d*Abs(F_x)*r", "d*Abs(F_y)*r", "d*Abs(M_y)"}
    for port in WHEEL_PORTS:
        for target in wheel_targets(port):
            unit = f.unit_of(f.parsed(target.carrier, known(port)), known(port))
            if unit:
                whole = Counter()
                for name, power in unit.items():
                    whole.update({base: power * k for base, k in si_dimensions(name)})
                own = "N m" if target.words == "driving torque" else "N"
                assert {k: v for k, v in whole.items() if v} == dict(si_dimensions(own))


@pytest.mark.parametrize("port", WHEEL_PORTS)
def test_jax_code_means_what_the_expression_says(port):
    rng = np.random.default_rng(0)
    symbols = sorted(set().union(*(e.free_symbols for e in features(port))), key=str)
    at = {s.name: rng.uniform(0.05, 1.2, 9) * (1.0 if s.is_positive else rng.choice([-1.0, 1.0], 9)) for s in symbols}
    at["s"] = rng.uniform(-0.9, 0.9, 9)
    for e in features(port):
        got = eval(f.code(e), {"jnp": jnp, **{k: jnp.asarray(v) for k, v in at.items()}})
        want = f.function(e, symbols)(**at)
        np.testing.assert_allclose(np.broadcast_to(got, 9), np.broadcast_to(want, 9), rtol=2e-4, atol=2e-6)


def test_a_formula_is_read_as_a_power_where_it_is_one():
    power = term(targets()[0], "log(Max(1 - s, 1/50))")
    assert power.formula == "k = k_0*(1 - s)**a"
    assert power.latex == r"k = k_{0} \left(1 - s\right)^{a}"
    assert "jnp.maximum(1 - s, 1/50)**a" in power.source
    assert term(targets()[0], "s**2", linear=True).formula == "k = k_0*(a*s**2 + 1)"


def _moment(port):
    """Context and value at a port, of three wheels."""

    def of(*values):
        return jnp.asarray(values, float)

    contact = SimpleNamespace(slip=of(-0.1, 0.2, 0.6), slip_angle=of(0.0, -0.3, 0.5), sinkage=of(0.01, 0.02, 0.04))
    soil = Soil(
        of(1e3, 1e3, 1e3),
        of(8e5, 8e5, 8e5),
        of(1.0, 1.1, 0.9),
        of(170.0, 200.0, 300.0),
        of(0.6, 0.7, 0.5),
        of(0.02, 0.02, 0.01),
        of(0.02, 0.03, 0.01),
        of(0.0, 0.0, 0.0),
    )
    normal = initial_normal(of(0.0, 0.0, 0.0))
    normal = type(normal)(
        **{
            **vars(normal),
            "load": of(50.0, 80.0, 120.0),
            "resistance": of(5.0, 8.0, 20.0),
            "sigma_m": of(2e3, 4e3, 9e3),
        }
    )
    force, moment = Vec3(of(5.0, 9.0, 20.0), of(0.1, -4.0, 9.0), of(50.0, 80.0, 120.0)), Vec3(*[of(0.1, -0.5, 2.0)] * 3)
    wheel = WheelForce(of(0.1, 0.2, 0.3), of(0.0, -0.3, 0.4), of(1.0, 1.0, -1.0), force, moment)
    ctx = SimpleNamespace(contact=contact, geometry=SimpleNamespace(radius=of(0.2, 0.2, 0.2)), soil=soil, normal=normal)
    return ctx, {"soil": soil, "wheel_normal": normal, "wheel_shear": wheel}[port]


CHOICES = [Choice(k, k % 2, k % 15 + 1, bool(k % 3)) for k in range(len(targets()))]


@pytest.mark.parametrize("choice", [c for c in CHOICES if not (c.linear and not targets()[c.target].multiplies)])
def test_a_slot_does_what_the_effect_file_does(choice):
    with jax.enable_x64(True):
        ctx, value = _moment(choice.port)
        own, slots = effect_of(choice.term), slots_effect(choice.early)
        amount, scale = 0.3, targets()[choice.target].size
        numbers = {
            **slots.null(),
            "amount_1": amount,
            "scale_1": scale,
            "target_1": float(choice.target),
            "first_1": float(choice.first),
            "second_1": float(choice.second),
            "linear_1": float(choice.linear),
            "target_0": float(choice.target),
        }
        given = SimpleNamespace(**{k: jnp.asarray(v, float) for k, v in numbers.items()})
        alone = SimpleNamespace(**{**own.null(), "amount": amount * scale})
        got = jax.tree.leaves(slots.ports[choice.port](ctx, given, None, value))
        want = jax.tree.leaves(own.ports[choice.port](ctx, alone, None, value))
        before = jax.tree.leaves(value)
        assert len(got) == len(want)
        for a, b in zip(got, want, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9)
        assert len(want) > len(before) or any(
            np.any(np.asarray(b) != np.asarray(c)) for b, c in zip(want, before, strict=True)
        )


def test_the_library_is_large_and_holds_no_formula_twice():
    found = library(WHEEL_PORTS)
    assert len(found) > 5000
    assert len(set(found)) == len(found)
    assert {c.port for c in found} == set(WHEEL_PORTS)
    assert all(c.port == "soil" for c in library(("soil",)))


def test_every_port_has_units_that_the_contract_knows():
    for port in PORTS:
        for t in terms(port, ("motor_drive_current_A",)):
            check_unit(t.unit)
    for choice in library(WHEEL_PORTS)[::97]:
        check_unit(choice.term.unit)
