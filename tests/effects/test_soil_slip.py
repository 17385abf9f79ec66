"""The slip that soil effects see: what the soil under the wheel remembers."""

from __future__ import annotations

import jax.numpy as jnp
import pytest

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Contact
from lunar_mjx.effects.ports import Pipeline, wheel_ports
from lunar_mjx.spatial import Vec3
from tests.effects.effects_harness import bare_context


class _Seen(Pipeline):
    """A pipeline that keeps what the port `soil` is shown, and runs no effect."""

    def run(self, port, ctx, state, value):
        if port == "soil":
            self.contact = ctx.contact
        return value, state


@pytest.mark.parametrize(
    ("slip_x", "direction", "expected"), [(0.3, 1.0, 0.3), (-0.3, -1.0, 0.3), (0.3, -0.5, -0.15), (4.0, 1.0, 1.0)]
)
def test_soil_remembers_the_slip_where_an_effect_keeps_it(slip_x, direction, expected):
    """The kept shear displacement in the direction of rolling; without one the slip of the moment, as in a test bed."""
    one = jnp.ones(1)
    nil = Vec3(0 * one, 0 * one, 0 * one)
    contact = Contact(0.01 * one, 0 * one, 0.7 * one, 0 * one, one, 0 * one, one, nil, nil, nil, one == 1, 0.7 * one)
    ctx = bare_context(contact=contact)
    seen = _Seen((CATALOGUE["shear_state"],))
    wheel_ports(seen, ctx, {"other": {"depth": one}})
    assert float(seen.contact.soil_slip[0]) == pytest.approx(0.7)
    wheel_ports(seen, ctx, {"shear_state": {"slip_x": slip_x * one, "direction": direction * one}})
    assert float(seen.contact.soil_slip[0]) == pytest.approx(expected)
