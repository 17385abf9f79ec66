"""Telemetry as log channels, and the operations on them, against formulas written here in NumPy."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics.signals import (
    Signals,
    apply_sensors,
    measure,
    observe,
    sample_signals,
    sensor_context,
    side_channels,
    with_sides,
)
from lunar_mjx.dynamics.state import Ambient, Params, Telemetry
from lunar_mjx.effects import Parameter, StateVariable, effect
from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import UserError
from lunar_mjx.rover import Rover, load_rover
from lunar_mjx.spatial import Vec3

Array = Any
GRAVITY = 1.625
TIMES = np.linspace(0.0, 4.0, 81)


@pytest.fixture(scope="module")
def rover() -> Rover:
    return load_rover("luvmi_x")


def system_of(rover: Rover, *effects: Effect) -> Any:
    """What `observe` and `measure` read of a system, without building one."""
    params = Params(jnp.asarray(GRAVITY), Ambient(300.0, 300.0, 0.0, 1.0), {e.name: e.nominal() for e in effects}, None)
    model = SimpleNamespace(rover=rover, effects=effects)
    return SimpleNamespace(model=model, params=params, info=None)


def quaternion(roll: Array, pitch: Array, yaw: Array) -> Array:
    """w, x, y, z of R_z(yaw) R_y(pitch) R_x(roll), by the product of three quaternions."""

    def product(a: Array, b: Array) -> Array:
        w = a[0] * b[0] - a[1:] @ b[1:]
        return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])

    def turn(angle: float, axis: int) -> Array:
        q = np.zeros(4)
        q[0], q[1 + axis] = np.cos(angle / 2), np.sin(angle / 2)
        return q

    angles = np.stack(np.broadcast_arrays(roll, pitch, yaw), axis=-1)
    return np.array([product(product(turn(a[2], 2), turn(a[1], 1)), turn(a[0], 0)) for a in angles])


def matrix(q: Array) -> Array:
    w, v = q[0], q[1:]
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def telemetry(
    times: Array = TIMES, roll: Array = 0.0, pitch: Array = 0.0, yaw: Array = 0.0, **known: Array
) -> Telemetry:
    """A drive of which some quantities are given and the others are zero."""
    n = len(times)
    joint, wheel = np.zeros((n, 12)), np.zeros((n, 4))
    nil, none = Vec3(*np.zeros((3, n))), Vec3(*np.zeros((3, n, 4)))
    fields: dict[str, Any] = {
        "time": times,
        "position": nil,
        "quaternion": quaternion(roll + 0 * times, pitch, yaw),
        "euler": Vec3(*(a + 0 * times for a in (roll, pitch, yaw))),
        "velocity": nil,
        "angular_velocity": nil,
        **dict.fromkeys(
            (
                "joint_angle",
                "joint_speed",
                "joint_torque",
                "current",
                "voltage",
                "joule_heat",
                "winding_heat",
                "housing_heat",
            ),
            joint,
        ),
        "winding_temperature": joint + 300.0,
        "housing_temperature": joint + 290.0,
        **dict.fromkeys(("wheel_position", "wheel_velocity", "wheel_force", "wheel_moment"), none),
        **dict.fromkeys(("sinkage", "slip", "slip_angle", "on_terrain"), wheel),
    }
    return Telemetry(**{**fields, **known})


def test_at_rest_on_a_slope_the_accelerometer_feels_the_reaction_to_weight(rover: Rover) -> None:
    """Nose 10 deg down (pitch +10 deg): f = g (-sin, 0, cos) in the body; level: +g along body z."""
    with jax.enable_x64(True):
        for pitch in (0.0, np.radians(10)):
            seen = observe(system_of(rover), telemetry(pitch=pitch)).channels
            force = [np.asarray(seen[f"accelerometer_{a}_m_s2"]) for a in "xyz"]
            for got, want in zip(force, (-np.sin(pitch), 0.0, np.cos(pitch)), strict=True):
                assert got == pytest.approx(GRAVITY * want * np.ones(81), abs=1e-12)


def test_accelerometer_and_gyro_in_a_curve(rover: Rover) -> None:
    """Speed v on a circle at rate w: centripetal v w to the left; at a lever arm r ahead of the centre also -w^2 r."""
    v, w = 0.4, 0.3
    with jax.enable_x64(True):
        seen = telemetry(
            yaw=w * TIMES,
            velocity=Vec3(v * np.cos(w * TIMES), v * np.sin(w * TIMES), 0 * TIMES),
            angular_velocity=Vec3(0 * TIMES, 0 * TIMES, w + 0 * TIMES),
        )
        plain = {k: np.asarray(a) for k, a in observe(system_of(rover), seen).channels.items()}
        far = {k: np.asarray(a) for k, a in observe(system_of(rover), seen, None, (0.5, 0.0, 0.0)).channels.items()}
    inner = slice(1, -1)  # the ends have one-sided differences
    assert plain["body_velocity_x_m_s"] == pytest.approx(v)
    assert plain["body_velocity_y_m_s"] == pytest.approx(0.0, abs=1e-12)
    assert plain["gyro_z_rad_s"] == pytest.approx(w)
    assert plain["accelerometer_y_m_s2"][inner] == pytest.approx(v * w, rel=1e-4)
    assert plain["accelerometer_x_m_s2"][inner] == pytest.approx(0.0, abs=1e-9)
    assert far["accelerometer_x_m_s2"][inner] == pytest.approx(-w * w * 0.5, rel=1e-6)


def test_channels_name_quantities_and_units(rover: Rover) -> None:
    joint = np.arange(81 * 12.0).reshape(81, 12)
    wheel = np.arange(81 * 4.0).reshape(81, 4)
    with jax.enable_x64(True):
        seen = telemetry(
            joint_angle=joint,
            winding_temperature=joint + 273.15,
            slip_angle=wheel,
            wheel_force=Vec3(wheel, -wheel, wheel),
        )
        found = {k: np.asarray(v) for k, v in observe(system_of(rover), seen).channels.items()}
    number = rover.joints.index(rover.wheels[1].steer)
    corner = rover.wheels[1].corner
    np.testing.assert_array_equal(found[f"joint_{corner}_steer_angle_rad"], joint[:, number])
    np.testing.assert_allclose(found[f"winding_{corner}_steer_temperature_degC"], joint[:, number], atol=1e-10)
    np.testing.assert_allclose(found[f"wheel_{corner}_slip_angle_deg"], np.degrees(wheel[:, 1]))
    np.testing.assert_array_equal(found[f"wheel_{corner}_force_y_N"], -wheel[:, 1])


def test_a_batch_of_drives_leads_and_agrees_with_each_drive(rover: Rover) -> None:
    one, two = telemetry(pitch=0.1), telemetry(pitch=-0.2, yaw=TIMES)
    both = jax.tree.map(lambda a, b: np.stack([a, b]), one, two)
    system = system_of(rover)
    with jax.enable_x64(True):
        batch, first, second = (observe(system, t).channels for t in (both, one, two))
        for name, values in batch.items():
            assert values.shape == (2, 81)
            np.testing.assert_allclose(values, np.stack([first[name], second[name]]), atol=1e-13, err_msg=name)


def test_derivatives_reach_the_channels(rover: Rover) -> None:
    """d accelerometer_x / d (acceleration along x) = 1, through `observe` under jit."""
    system = system_of(rover)
    with jax.enable_x64(True):
        seen = jax.tree.map(jnp.asarray, telemetry())

        def forward(a: Array) -> Array:
            moving = seen.velocity._replace(x=a * seen.time)
            return observe(system, dataclasses.replace(seen, velocity=moving)).channels["accelerometer_x_m_s2"]

        rate = np.asarray(jax.jit(jax.jacfwd(forward))(jnp.asarray(0.2)))
    assert rate == pytest.approx(np.ones(81), rel=1e-9)


@effect(
    "sensor",
    order=1,
    state={"memory": StateVariable(2.0, "1", "x")},
    gain=Parameter(3.0, 1.0, (0.0, 10.0), "1", "gain", "test"),
)
def gain(ctx: Any, p: Any, x: Any, signals: Signals) -> Any:
    """y_m = gain memory y of the position; a user's own sensor."""
    return signals.with_channels({"position_x_m": p.gain * x.memory * signals.channels["position_x_m"]}), {}


@effect("sensor", order=0)
def plus_one(ctx: Any, p: Any, x: Any, signals: Signals) -> Any:
    """y_m = y + 1 of the position, before the gain."""
    return signals.with_channels({"position_x_m": 1.0 + signals.channels["position_x_m"]})


def test_sensors_run_in_order_and_only_at_their_port(rover: Rover) -> None:
    system = system_of(rover, gain, plus_one)
    drive = telemetry(position=Vec3(TIMES, TIMES, TIMES))
    with jax.enable_x64(True):
        seen = measure(system, drive)
        np.testing.assert_allclose(seen.channels["position_x_m"], 6.0 * (1.0 + TIMES))
        np.testing.assert_array_equal(seen.channels["position_y_m"], TIMES)
        plain = observe(system, drive)
        same = apply_sensors((), system.params, plain, sensor_context(system, plain))
    assert same is plain, "no sensor, no change"


def signals_of(**channels: Array) -> Signals:
    return Signals(TIMES, channels)


def test_sampling_is_linear_between_samples_and_goes_on_outside() -> None:
    with jax.enable_x64(True):
        signals = signals_of(position_x_m=np.where(TIMES < 2.0, TIMES, 2.0))
        at = np.array([-0.5, 0.0, 0.01, 1.99, 2.01, 4.0, 5.0])
        got = np.asarray(sample_signals(signals, "position_x_m", at))
    assert got == pytest.approx([-0.5, 0.0, 0.01, 1.99, 2.0, 2.0, 2.0], abs=1e-12)
    with pytest.raises(UserError, match="position_w"):
        sample_signals(signals, "position_w", at)


def test_sampling_takes_the_short_way_around() -> None:
    """Yaw from 170 to 190 deg is interpolated through 180; a quaternion whose sign flips is one rotation."""
    yaw = 170.0 + 5.0 * TIMES
    wrapped = (yaw + 180.0) % 360.0 - 180.0
    q = quaternion(0 * TIMES, 0.0, np.radians(yaw))
    q[40:] *= -1.0
    at = TIMES[:-1] + 0.5 * np.diff(TIMES)
    with jax.enable_x64(True):
        signals = signals_of(yaw_deg=wrapped, **{f"quaternion_{c}": q[:, i] for i, c in enumerate("wxyz")})
        got = np.asarray(sample_signals(signals, "yaw_deg", at))
        parts = [np.asarray(sample_signals(signals, f"quaternion_{c}", at)) for c in "wxyz"]
    true = 170.0 + 5.0 * at
    assert np.max(np.abs((got - true + 180.0) % 360.0 - 180.0)) < 1e-9
    assert np.abs(got).max() <= 180.0
    assert parts[0] == pytest.approx(np.cos(np.radians(true) / 2), abs=1e-6)
    assert sum(p * p for p in parts) == pytest.approx(np.ones(80))


def test_sampling_of_a_batch() -> None:
    times = np.stack([TIMES, TIMES + 1.0])
    with jax.enable_x64(True):
        signals = Signals(times, {"position_x_m": np.stack([TIMES**2, 3.0 * TIMES])})
        got = np.asarray(sample_signals(signals, "position_x_m", np.array([[1.0, 1.5], [2.5, 4.0]])))
    assert got == pytest.approx(np.array([[1.0, 2.25], [4.5, 9.0]]), abs=1e-3)


def test_the_motor_of_a_side_draws_what_its_wheels_do_and_turns_as_they_do() -> None:
    husky = load_rover("husky")
    wheels = {
        f"{kind}_{c}_drive_{unit}": np.array([value])
        for kind, unit, values in (
            ("motor", "current_A", (1.0, 10.0, 2.0, 20.0)),
            ("joint", "speed_rad_s", (3.0, 5.0, 3.0, 5.0)),
            ("joint", "angle_rad", (0.1, 0.2, 0.1, 0.2)),
        )
        for c, value in zip(("lf", "rf", "lr", "rr"), values, strict=True)
    }
    seen = with_sides(husky, wheels)
    assert set(seen) - set(wheels) == set(side_channels(husky))
    assert seen["motor_left_drive_current_A"] == 3.0 and seen["motor_right_drive_current_A"] == 30.0
    assert seen["joint_left_drive_speed_rad_s"] == 3.0 and seen["joint_right_drive_angle_rad"] == 0.2
    assert not side_channels(load_rover("viper"))
