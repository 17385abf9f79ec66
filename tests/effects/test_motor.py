"""Motors: control modes, torque and resistance over temperature, cut-off, current limit (eqs. 6, 7, 15, 16)."""

from __future__ import annotations

import dataclasses
from typing import Any

import effects_reference as ref
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects.context import Command
from lunar_mjx.effects.joint.motor import CURRENT, POSITION, TORQUE, VELOCITY, WINDINGS
from lunar_mjx.effects.ports import Pipeline, heat_flow
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

Array = Any
MOTOR = ("joint_control", "thermal_cutoff", "motor")
POSITION_GAIN, VELOCITY_GAIN = 40.0, 3.0  # of the harness
PER_AMPERE = 243.0 * 0.75 * 71.6e-3


def drive(
    mode: Any,
    target: Any,
    angle: Any = 0.0,
    speed: Any = 0.0,
    celsius: Any = 25.0,
    names: tuple[str, ...] = MOTOR,
    tripped: Any = 0.0,
    **values: Any,
) -> dict[str, Array]:
    """Current, torque and heat of motors with these targets, angles, speeds and winding temperatures."""
    mode, target, angle, speed, celsius, tripped = np.broadcast_arrays(
        np.atleast_1d(mode), target, angle, speed, celsius, tripped
    )
    with jax.enable_x64(True):
        pipeline = Pipeline(effects_named(names))
        ctx = bare_context(
            dt=jnp.asarray(0.002),
            joint_angle=jnp.asarray(angle, float),
            joint_speed=jnp.asarray(speed, float),
            winding_temperature=jnp.asarray(celsius + 273.15, float),
            housing_temperature=jnp.asarray(celsius + 273.15, float),
            rover=rover_info(jnp.ones(1), jnp.ones(1), len(mode), jnp.asarray(mode)),
            parameters=parameters(pipeline.effects, values),
        )
        nil = jnp.zeros(len(mode))
        state = {"thermal_cutoff": {"tripped": jnp.asarray(tripped, float)}}
        command, state = pipeline.run("command", ctx, state, Command(jnp.asarray(target, float), nil))
        ctx = dataclasses.replace(ctx, command=command)
        torque, state = pipeline.run("motor_torque", ctx, state, nil)
        heat, state = heat_flow(pipeline, ctx, state)
        result = {"current": command.current, "torque": torque, "winding": heat.winding, "housing": heat.housing}
        if "thermal_cutoff" in names:
            result["tripped"] = state["thermal_cutoff"]["tripped"]
        return {k: np.asarray(v) for k, v in result.items()}


def test_position_control() -> None:
    """tau = k_p (q* - q) - k_d qdot, rad and rad/s: toward the target, against the speed."""
    target, angle, speed = np.array([0.3, -0.3, 0.0, 0.1]), np.array([0.1, 0.1, 0.0, 0.1]), np.array([0, 0, 0.5, -0.5])
    out = drive(POSITION, target, angle, speed)
    torque = POSITION_GAIN * (target - angle) - VELOCITY_GAIN * speed
    assert out["torque"] == pytest.approx(torque, rel=1e-12)
    assert out["current"] == pytest.approx(torque / PER_AMPERE, rel=1e-12)
    assert np.sign(out["torque"]).tolist() == [1, -1, -1, 1]


def test_velocity_control() -> None:
    """tau = k_d (omega* - omega), rad/s: the angle does not matter."""
    target, speed = np.array([1.0, -1.0, 0.5, 0.0]), np.array([0.0, 0.0, 1.0, 2.0])
    out = drive(VELOCITY, target, np.array([9.0, -9.0, 1.0, 0.0]), speed)
    assert out["torque"] == pytest.approx(VELOCITY_GAIN * (target - speed), rel=1e-12)
    assert np.sign(out["torque"]).tolist() == [1, -1, -1, -1]


def test_torque_control_gives_the_asked_torque_at_25_degC() -> None:
    """N m at the joint, behind the gear (eq. 15 with gear ratio and efficiency, flaw 8)."""
    out = drive(TORQUE, np.array([15.0, -15.0, 0.1, 0.0]))
    assert out["torque"] == pytest.approx([15.0, -15.0, 0.1, 0.0], rel=1e-12)
    assert out["current"] == pytest.approx(np.array([15.0, -15.0, 0.1, 0.0]) / (243 * 0.75 * 0.0716), rel=1e-12)


def test_torque_without_a_gear_needs_the_current_of_flaw_8() -> None:
    """15 N m with K_0 = 17.0e-3 and no gear: 882 A."""
    values = {
        "motor": {"gear_ratio": 1.0, "gear_efficiency": 1.0, "torque_constant": 17.0e-3},
        "joint_control": {"current_limit": 1000.0},
    }
    assert drive(TORQUE, 15.0, **values)["current"] == pytest.approx(882.35, abs=0.01)


def test_a_controller_reckons_with_its_own_number_and_the_motor_does_not() -> None:
    """A motor that is 5 % stronger than its data sheet gets the data sheet's current, and gives 5 % more torque."""
    values = {"motor": {"torque_constant": 1.05 * 0.0716}}
    told = {**values, "joint_control": {"assumed_torque_per_ampere": PER_AMPERE}}
    assert drive(TORQUE, 15.0, **told)["current"] == pytest.approx(15.0 / PER_AMPERE, rel=1e-12)
    assert drive(TORQUE, 15.0, **told)["torque"] == pytest.approx(1.05 * 15.0, rel=1e-12)
    assert drive(TORQUE, 15.0, **values)["torque"] == pytest.approx(15.0, rel=1e-12)


def test_current_control() -> None:
    """A: passed on, tau = N eta K I (eq. 15)."""
    out = drive(CURRENT, np.array([2.0, -3.0]))
    assert out["current"] == pytest.approx([2.0, -3.0], rel=1e-15)
    assert out["torque"] == pytest.approx(np.array([2.0, -3.0]) * PER_AMPERE, rel=1e-12)


@pytest.mark.parametrize("mode", [POSITION, VELOCITY, TORQUE, CURRENT])
def test_current_limit(mode: int) -> None:
    """The amplifier gives no more than its limit, either way, in every mode; one limit per joint."""
    limit = np.array([11.6, 11.6, 2.0])
    out = drive(mode, np.array([1e6, -1e6, 1e6]), joint_control={"current_limit": limit})
    assert out["current"] == pytest.approx([11.6, -11.6, 2.0], rel=1e-15)


def test_modes_may_differ_between_joints() -> None:
    """One rover, four joints in the four modes."""
    out = drive(np.array([POSITION, VELOCITY, TORQUE, CURRENT]), 0.5, 0.1, 0.2)
    expected = [40 * 0.4 - 3 * 0.2, 3 * 0.3, 0.5, 0.5 * PER_AMPERE]
    assert out["torque"] == pytest.approx(expected, rel=1e-12)


def test_torque_and_heat_over_temperature() -> None:
    """Eqs. 6, 7, 16 from -173 to 149 degC: K falls by 0.12 %/K, R grows by 0.40 %/K; tau' = K'/K tau."""
    celsius = np.linspace(-173.0, 149.0, 200)
    out = drive(TORQUE, 15.0, celsius=celsius)
    ratio = ref.torque_constant(1.0, -0.0012, celsius + 273.15)
    current = 15.0 / PER_AMPERE
    assert out["torque"] == pytest.approx(15.0 * ratio, rel=1e-12)
    assert out["winding"] == pytest.approx(current**2 * ref.resistance(4.13, 0.0040, celsius + 273.15), rel=1e-12)
    assert (np.diff(out["torque"]) < 0).all() and (np.diff(out["winding"]) > 0).all()
    assert (out["housing"] == 0.0).all()
    assert drive(TORQUE, 15.0, celsius=125.0)["torque"] == pytest.approx(15.0 * 0.88, rel=1e-12)


def test_torque_drops_to_zero_at_150_degC() -> None:
    """Seed paper III-C2: at the threshold the torque drops to zero at once, and with it current and heat."""
    out = drive(TORQUE, 15.0, celsius=np.array([149.999, 150.0, 150.001, 300.0]))
    assert out["torque"][0] > 12.0
    for name in ("torque", "current", "winding"):
        assert (out[name][1:] == 0.0).all()
    assert out["tripped"].tolist() == [0, 1, 1, 1]


def test_cut_off_stays_open_until_the_winding_has_cooled() -> None:
    """With 20 K of hysteresis current returns below 130 degC; without, as printed, below 150 degC."""
    celsius = np.array([149.0, 130.5, 129.5])
    assert drive(TORQUE, 15.0, celsius=celsius, tripped=1.0)["tripped"].tolist() == [1, 1, 0]
    assert drive(TORQUE, 15.0, celsius=celsius, tripped=0.0)["tripped"].tolist() == [0, 0, 0]
    printed = drive(TORQUE, 15.0, celsius=celsius, tripped=1.0, thermal_cutoff={"hysteresis": 0.0})
    assert printed["tripped"].tolist() == [0, 0, 0] and (printed["torque"] > 0).all()


def test_without_the_cut_off_a_hot_motor_keeps_running() -> None:
    out = drive(TORQUE, 15.0, celsius=300.0, names=("joint_control", "motor"))
    assert out["torque"] == pytest.approx(15.0 * (1 - 0.0012 * 275), rel=1e-12)


def test_windings_of_the_catalogue() -> None:
    """Stall current is near V/R_0 in all five windings, so that R_0, K_0 and the limits belong together."""
    assert sorted(WINDINGS) == [12, 18, 24, 36, 48]
    for volts, winding in WINDINGS.items():
        assert winding["current_limit"] == pytest.approx(volts / winding["resistance"], rel=0.01)
    stall = {12: 0.696, 18: 0.672, 24: 0.730, 36: 0.685, 48: 0.832}
    for volts, torque in stall.items():
        assert WINDINGS[volts]["current_limit"] * WINDINGS[volts]["torque_constant"] == pytest.approx(torque, rel=0.01)
