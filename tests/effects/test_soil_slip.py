"""The slip that soil effects see: what the soil under the wheel remembers."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Contact
from lunar_mjx.effects.ports import Pipeline, initial_normal, initial_soil, initial_wheel, nominal_geometry, wheel_ports
from lunar_mjx.spatial import Vec3
from tests.effects.effects_harness import bare_context, rover_info


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
    still = 0 * one
    contact = Contact(
        0.01 * one, still, 0.7 * one, still, one, still, one, nil, nil, nil, one == 1, 0.7 * one, 0.7 * one
    )
    ctx = bare_context(contact=contact)
    seen = _Seen((CATALOGUE["shear_state"],))
    wheel_ports(seen, ctx, {"other": {"depth": one}})
    assert float(seen.contact.soil_slip[0]) == pytest.approx(0.7)
    wheel_ports(seen, ctx, {"shear_state": {"slip_x": slip_x * one, "direction": direction * one}})
    assert float(seen.contact.soil_slip[0]) == pytest.approx(expected)
    assert float(seen.contact.soil_slid[0]) == pytest.approx(abs(expected))


def test_soil_under_opposed_rim_and_hub_has_been_sheared_in_full():
    """From locked to spinning backwards the growth of the exponent goes from that of skid to that of driving."""
    share = jnp.linspace(0.0, 3.0, 301)  # rim speed against the travel, over it
    fastest = jnp.maximum(share, 1.0)
    kept = {"slip_x": -(1.0 + share) / fastest, "direction": jnp.clip(1.0 - share, -fastest, fastest) / fastest}
    one, nil = jnp.ones_like(share), Vec3(0 * share, 0 * share, 0 * share)
    still = 0 * one
    contact = Contact(0.01 * one, still, still, still, one, still, -share, nil, nil, nil, one == 1, still, still)
    ctx = bare_context(contact=contact, geometry=nominal_geometry(rover_info(0.1 * one, 0.1 * one)))
    seen = _Seen((CATALOGUE["shear_state"],))
    wheel_ports(seen, ctx, {"shear_state": kept})
    ctx = dataclasses.replace(ctx, contact=seen.contact)
    effect = CATALOGUE["slip_sinkage"]
    values = SimpleNamespace(**{**effect.nominal(), "driving": 1.0, "skid": 0.5})
    growth = np.asarray(effect.ports["soil"](ctx, values, None, initial_soil(one)).n - initial_soil(one).n)
    assert growth[0] == pytest.approx(0.5)
    assert growth[100] == pytest.approx(0.75)  # as fast back as ahead
    assert (np.diff(growth) >= -1e-6).all() and np.diff(growth).max() < 0.02
    assert growth[-1] > 0.9


def test_what_is_pushed_ahead_goes_with_the_travel():
    """Front resistance is in proportion to travel over the faster of rim and travel, also where these are opposed."""
    rim = jnp.array([-2.0, -1.0, -0.5, 0.0, 0.5, 1.0, 2.0])
    one, nil = jnp.ones_like(rim), Vec3(0 * rim, 0 * rim, 0 * rim)
    still = 0 * one
    contact = Contact(0.01 * one, still, still, still, one, still, rim, nil, nil, nil, one == 1, still, still)
    geometry = nominal_geometry(rover_info(0.1 * one, 0.1 * one))
    ctx = bare_context(
        contact=contact, geometry=geometry, gravity=1.62, normal=initial_normal(one), soil=initial_soil(one)
    )
    effect = CATALOGUE["bulldozing"]
    values = SimpleNamespace(**{**effect.nominal(), "front": 1.0})
    pushed = np.asarray(effect.ports["wheel_shear"](ctx, values, None, initial_wheel(contact)).force.x)
    np.testing.assert_allclose(pushed, pushed[3] / np.maximum(np.abs(rim), 1.0), rtol=1e-5)
    assert pushed[3] < 0.0
