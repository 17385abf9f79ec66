"""Constants that say their unit may stand in an effect; bare numbers that stand for a quantity may not."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax
import pytest

from lunar_mjx.effect_contract import promises
from lunar_mjx.effects import effect
from lunar_mjx.effects.catalogue import CATALOGUE

ROVERS = 4
TOLD: Annotated[float, "rad/s"] = 0.3
WRONG: Annotated[float, "s"] = 0.3
BARE = 0.3


def _effect(name: str, constant: str):
    @effect("motor_torque", requires=("motor",))
    def one(ctx, p, x, torque):
        """tau (1 + omega/omega_0)."""
        return torque * (1.0 + ctx.joint_speed / globals()[constant])

    return dataclasses.replace(one, name=name)


def _units(one):
    with jax.enable_x64(True):
        return promises._homogeneity(one, ROVERS, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chassis_node", "motor_power", "housing_radiation", "angle_sinkage"])
def test_effects_with_constants_of_nature_hold_in_any_units(name: str) -> None:
    assert _units(CATALOGUE[name]).passed


def test_only_the_right_unit_makes_a_number_a_quantity() -> None:
    assert _units(_effect("told", "TOLD")).passed
    for name, constant in (("wrong", "WRONG"), ("bare", "BARE")):
        found = _units(_effect(name, constant))
        assert not found.passed and "of time (port motor_torque" in found.detail
    assert TOLD == BARE == 0.3


def test_a_map_of_moduli_with_exponents_of_its_own_does_not() -> None:
    """k_c in N/m^(n+1) between two places with different n has no unit: the check is right to refuse it."""
    assert not _units(CATALOGUE["surface_type"]).passed
