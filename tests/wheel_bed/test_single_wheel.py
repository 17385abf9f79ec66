"""The single-wheel test bed: equilibrium, signs, symmetry, derivatives, and what it refuses."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.criticism import WheelBed, wheel_test
from lunar_mjx.effects import Parameter, effect
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from tests.wheel_bed.small_wheel import LOAD, RADIUS, WIDTH, small_test

SLIPS = np.linspace(-1.0, 0.95, 9)


def test_vertical_force_equals_the_load(bed):
    slip, angle = np.meshgrid(SLIPS, [0.0, 30.0, 75.0])
    result = bed.run(small_test(slip, angle))
    assert result.reached.all()
    np.testing.assert_allclose(result.vertical_force, LOAD, rtol=1e-9)
    assert (result.sinkage > 0).all()


def test_drawbar_pull_rises_with_slip(bed):
    result = bed.run(small_test(SLIPS, 0.0))
    # The printed displacement dips by a little at high slip.
    assert (np.diff(result.drawbar_pull) > -0.05 * LOAD).all()
    assert result.drawbar_pull[0] < -0.3 * LOAD < result.drawbar_pull[-1]


def test_locked_wheel_is_dragged_and_driven_wheel_needs_torque(consistent):
    result = consistent.run(small_test(np.array([-1.0, 0.8]), 0.0))
    assert result.driving_torque[0] < 0.0 < result.driving_torque[1]


def test_side_force_opposes_the_lateral_motion_and_is_odd_in_the_slip_angle(bed):
    angle = np.array([0.0, 10.0, 45.0, -10.0, -45.0])
    result = bed.run(small_test(0.2, angle))
    assert abs(result.side_force[0]) < 1e-9
    assert (result.side_force[1:3] > 0.0).all()
    np.testing.assert_allclose(result.side_force[3:], -result.side_force[1:3], rtol=1e-9)
    np.testing.assert_allclose(result.drawbar_pull[3:], result.drawbar_pull[1:3], rtol=1e-9)
    np.testing.assert_allclose(result.sinkage[3:], result.sinkage[1:3], rtol=1e-9)


@effect("wheel_shear", order=1000)
def reads_slip(ctx, p, x, wheel):
    """Puts the slip and slip angle that effects see into the moments, for the test to read."""
    contact = ctx.contact
    moment = wheel.moment._replace(y=-contact.slip)
    return dataclasses.replace(wheel, moment=moment, force=wheel.force._replace(y=-contact.slip_angle))


@pytest.mark.parametrize("definition", ["wheel_frame", "travel_speed"])
def test_slip_and_slip_angle_are_imposed_exactly(consistent, definition):
    probe = consistent.with_effect(reads_slip)
    angle = np.radians(60.0)
    with jax.enable_x64(True):
        test = wheel_test(SLIPS, angle, LOAD, RADIUS, WIDTH, definition)
    result = probe.run(test)
    if definition == "wheel_frame":
        np.testing.assert_allclose(result.driving_torque, SLIPS, atol=1e-12)
    else:
        rim, v_x = np.asarray(test.rim_speed), np.asarray(test.travel_speed) * np.cos(angle)
        np.testing.assert_allclose(result.driving_torque, (rim - v_x) / np.maximum(rim, v_x), atol=1e-12)
    np.testing.assert_allclose(result.side_force, angle, rtol=1e-12)


def test_derivatives_agree_with_finite_differences(consistent):
    test = small_test(np.array([-0.5, 0.1, 0.6]), np.array([0.0, 20.0, 50.0]))

    def outputs(k_phi):
        values = consistent.merged({"soil": {"k_phi": k_phi}})
        result = consistent(values, test)
        return jnp.stack([result.drawbar_pull, result.side_force, 1e3 * result.sinkage])

    with jax.enable_x64(True):
        at, step = 8.2e5, 10.0
        run = jax.jit(outputs)
        forward = jax.jit(jax.jacfwd(outputs))(at)
        difference = (run(at + step) - run(at - step)) / (2.0 * step)
        reverse = jax.jit(jax.grad(lambda k: outputs(k).sum()))(at)
    forward, difference, reverse = (np.asarray(v) for v in (forward, difference, reverse))
    np.testing.assert_allclose(forward, difference, rtol=2e-5, atol=1e-12)
    np.testing.assert_allclose(reverse, forward.sum(), rtol=1e-9)


def test_a_load_out_of_reach_is_flagged_and_finite(consistent):
    weak = consistent.with_values({"soil": {"k_phi": 10.0, "k_c": 0.0, "cohesion": 0.0}})
    result = weak.run(small_test(SLIPS, 0.0))
    assert not result.reached.any()
    for field in (result.drawbar_pull, result.side_force, result.driving_torque, result.sinkage):
        assert np.isfinite(field).all()


def test_transient_effects_are_left_out(consistent):
    assert "shear_state" not in consistent.parameters
    assert set(consistent.parameters) >= {"soil", "pressure_sinkage", "closed_form_shear"}


def test_users_mistakes_are_told(consistent):
    with pytest.raises(UserError, match="slip_definition = 'rim'"):
        wheel_test(0.1, 0.0, 20.0, RADIUS, WIDTH, "rim")
    with pytest.raises(UserError, match="preset = 'papre'"):
        WheelBed.of_preset("papre")
    with pytest.raises(UserError, match="no wheel-soil contact"):
        WheelBed(["soil"])
    with pytest.raises(UserError, match=r"effects\.soil\.kphi is unknown"):
        WheelBed(consistent.effects, {"soil": {"kphi": 1e6}})
    with pytest.raises(UserError, match=r"effects\.soil\.n = 9 1 is outside"):
        WheelBed(consistent.effects, {"soil": {"n": 9.0}})
    with pytest.raises(UserError, match="does not act on this wheel"):
        consistent.with_values({"penalty_contact": {"stiffness": 1.0}})


def test_a_table_of_a_rover_whose_wheels_differ_is_taken_for_its_first_wheel():
    model = make_model("luvmi_x", "flat", preset="consistent")
    model = model.add("wheel_radius_error").set("wheel_radius_error", offset=(0.01, 0.0, 0.0, 0.0))
    bed = WheelBed.of_first_wheel(model, 1.6)
    assert bed.parameters["wheel_radius_error"]["offset"] == 0.01 and bed.gravity == 1.6
    with pytest.raises(UserError, match="has one value per wheel"):
        WheelBed.of_model(model)


def test_an_effect_of_the_users_own_changes_the_bed(consistent):
    @effect("wheel_shear", order=50, force=Parameter(1.0, 0.0, (0.0, 10.0), "N", "drag", "test"))
    def drag(ctx, p, x, wheel):
        """A constant drag."""
        return dataclasses.replace(wheel, force=wheel.force._replace(x=wheel.force.x - p.force))

    test = small_test(np.array([0.1, 0.5, 0.9]), 0.0)
    before, after = consistent.run(test), consistent.with_effect(drag, force=2.0).run(test)
    np.testing.assert_allclose(after.drawbar_pull, before.drawbar_pull - 2.0, rtol=1e-12)
