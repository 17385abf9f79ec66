"""What an effect declares of others: whose parameters it reads, and whose state speaks for the contact."""

from __future__ import annotations

import dataclasses

import jax
import pytest

from lunar_mjx.effect_contract import promises
from lunar_mjx.effect_contract.promises import check_effect
from lunar_mjx.effects import Parameter, effect
from lunar_mjx.errors import UserError


@effect("motor_torque", share=Parameter(0.0, 0.0, (-1.0, 1.0), "1", "share of the torque", "test"))
def reader(ctx, p, x, torque):
    """tau (1 + s R/R) with the gear ratio R of the motor: reads the motor's parameters."""
    ratio = ctx.parameters["motor"].gear_ratio
    return torque * (1.0 + p.share * ratio / ratio)


def test_what_an_effect_reads_must_be_declared() -> None:
    found = {c.name: c for c in check_effect(reader, overhead=False)}["requirements"]
    assert found.passed is False
    assert "requires=('motor',)" in found.detail
    declared = dataclasses.replace(reader, requires=("motor",))
    with jax.enable_x64(True):
        assert promises._requirements(declared).passed


def test_recall_needs_a_state() -> None:
    with pytest.raises(UserError, match="recall is given without a state"):
        dataclasses.replace(reader, recall=lambda x, contact: contact)
