"""Unknown inputs that act on wheels which hardly move."""

from __future__ import annotations

from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS, QUANTITY_SIZES, amplitude, smooth_inputs
from lunar_mjx.effects.ports import WheelForce
from lunar_mjx.spatial import Vec3

LABEL = "wheel_shear: shear at a crawl"


def pushed(rim: list[float], hub: list[float], **amounts: float) -> tuple[np.ndarray, np.ndarray]:
    """Longitudinal force (wheels,) and driving moment (wheels,) that were 10 N and -2 N m, with amounts of inputs."""
    one = jnp.ones(len(rim))
    contact = SimpleNamespace(rim_speed=jnp.asarray(rim), v_x=jnp.asarray(hub), soil_slip=0.0 * one)
    nothing = SimpleNamespace(load=100.0 * one)
    ctx = SimpleNamespace(contact=contact, normal=nothing, geometry=SimpleNamespace(radius=0.1 * one))
    inputs = smooth_inputs(frozenset({"wheel_shear"}))
    values = SimpleNamespace(**{name: amounts.get(name, 0.0) for name in inputs.parameters})
    wheel = WheelForce(
        slip_x=0.0 * one,
        slip_y=0.0 * one,
        direction=one,
        force=Vec3(10.0 * one, 0.0 * one, 0.0 * one),
        moment=Vec3(0.0 * one, -2.0 * one, 0.0 * one),
    )
    out = inputs.ports["wheel_shear"](ctx, values, None, wheel)
    return np.asarray(out.force.x), np.asarray(out.moment.y)


@pytest.mark.parametrize(
    ("quantity", "speed"), [("below 1 cm/s", 0.01), ("below 3 cm/s", 0.03), ("below 10 cm/s", 0.1)]
)
def test_shear_at_a_crawl_fades_with_the_speed_of_rim_and_hub(quantity: str, speed: float):
    assert quantity in FOLLOWS[LABEL] and QUANTITY_SIZES[quantity] == 1.0
    force, moment = pushed(
        [0.0, speed, -speed, 20.0 * speed], [0.0, speed, -speed, 20.0 * speed], **{amplitude(LABEL, quantity): 0.5}
    )
    share = 1.0 + 0.5 * np.exp([0.0, -1.0, -1.0, -20.0])
    np.testing.assert_allclose(force, 10.0 * share, rtol=1e-6)
    np.testing.assert_allclose(moment, -2.0 * share, rtol=1e-6)


def test_nothing_acts_at_amounts_of_zero():
    force, moment = pushed([0.0, 0.3], [0.0, 0.2])
    np.testing.assert_array_equal(force, [10.0, 10.0])
    np.testing.assert_array_equal(moment, [-2.0, -2.0])


@pytest.mark.parametrize("label", ["wheel_shear: longitudinal force", "wheel_shear: driving moment"])
def test_a_wheel_has_no_front(label: str):
    """What an input adds to a wheel that rolls back is the mirror image of what it adds to one that rolls ahead."""
    assert "rolling direction" in FOLLOWS[label]
    for quantity in ("rolling direction", "wheel speed"):
        force, moment = pushed([0.3, -0.3], [0.2, -0.2], **{amplitude(label, quantity): 0.05})
        added = (force - 10.0) if "force" in label else (moment + 2.0)
        assert added[0] != 0.0 and added[1] == pytest.approx(-added[0])
