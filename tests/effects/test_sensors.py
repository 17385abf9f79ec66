"""Effects at the port `sensor`: nulls, derivatives, and each against its formula in NumPy."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects import catalogue
from lunar_mjx.effects.sensor.channels import FAMILIES, SensorContext, Signals, family

Array = Any
TIMES = np.linspace(0.0, 6.0, 121)
JOINTS = ("lf_drive", "rf_drive")
NAMES = tuple(name for name, e in catalogue.CATALOGUE.items() if set(e.ports) == {"sensor"})
G = 1.625


def moving(times: Array = TIMES) -> dict[str, Array]:
    """A curved drive with a channel of every kind, through 180 deg of yaw."""
    yaw = np.radians(150.0) + 0.2 * times
    vectors = {
        "position_{}_m": (np.sin(times), 0.3 * times, 0.01 * times),
        "world_velocity_{}_m_s": (np.cos(times), 0.3 + 0 * times, 0.01 + 0 * times),
        "gyro_{}_rad_s": (0.1 * np.sin(times), 0.05 * np.cos(times), 0.2 + 0 * times),
        "accelerometer_{}_m_s2": (np.sin(3 * times), 0.1 * times, G + 0.1 * np.cos(times)),
    }
    out = {p.format(a): v for p, triple in vectors.items() for a, v in zip("xyz", triple, strict=True)}
    out |= {"quaternion_w": np.cos(yaw / 2), "quaternion_x": 0 * yaw, "quaternion_y": 0 * yaw}
    out["quaternion_z"] = np.sin(yaw / 2)
    out |= {"roll_deg": np.sin(times), "pitch_deg": 2 * np.cos(times)}
    out["yaw_deg"] = (np.degrees(yaw) + 180.0) % 360.0 - 180.0
    for i, joint in enumerate(JOINTS):
        out[f"joint_{joint}_angle_rad"] = 0.8 * times + 0.1 * i
        out[f"joint_{joint}_speed_rad_s"] = 0.8 + 0.1 * np.sin(times + i)
        out[f"motor_{joint}_current_A"] = 1.5 * np.sin(2 * times + i)
        out[f"motor_{joint}_voltage_V"] = 20.0 + 3 * np.sin(2 * times + i)
        out[f"motor_{joint}_torque_Nm"] = 8.0 * np.sin(2 * times + i)
        out[f"winding_{joint}_temperature_degC"] = 25.0 + 5 * times
        out[f"housing_{joint}_temperature_degC"] = 25.0 + times**2
    out |= {"wheel_lf_sinkage_m": 0.01 + 0.001 * np.sin(times), "wheel_lf_force_z_N": 100.0 + times}
    return {**out, "command_lf_drive_speed_rad_s": 0.8 + 0 * times}


def resting() -> dict[str, Array]:
    return {k: np.full_like(v, v[0]) for k, v in moving().items()}


def sense(name: str, values: Any, channels: Any, times: Array = TIMES) -> dict[str, Array]:
    """The channels after one effect; values not given are at their null."""
    effect = catalogue.get(name)
    own = SimpleNamespace(**{**effect.null(), **values})
    ctx = SensorContext(times, G, 300.0, None, {name: own}, JOINTS, ("lf",))
    return effect.ports["sensor"](ctx, own, SimpleNamespace(), Signals(times, dict(channels))).channels


_compiled = jax.jit(sense, static_argnums=0)


def sensed(name: str, values: Any, channels: Any, times: Array = TIMES) -> dict[str, Array]:
    """`sense` in float64, compiled once for an effect; values not given are at their null."""
    with jax.enable_x64(True):
        whole, arrays, at = jax.tree.map(jnp.asarray, ({**catalogue.get(name).null(), **values}, dict(channels), times))
        return {k: np.asarray(v) for k, v in _compiled(name, whole, arrays, at).items()}


@pytest.mark.parametrize("name", NAMES)
def test_null_leaves_every_channel(name: str) -> None:
    for channels in (moving(), resting()):
        found = sensed(name, {}, channels)
        for key, want in channels.items():
            assert (np.abs(found[key] - want) <= 4 * np.spacing(np.abs(want))).all(), key
    nominal = sensed(name, catalogue.get(name).nominal(), moving())
    truth = moving()
    assert any(key not in truth or np.abs(value - truth[key]).max() > 1e-6 for key, value in nominal.items())


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_at_the_null_and_at_the_nominal(name: str) -> None:
    """Finite at rest and in motion; in motion not zero and as the difference quotient, quantisation apart."""
    effect = catalogue.get(name)
    with jax.enable_x64(True):
        times = jnp.asarray(TIMES)
        drives = [{k: jnp.asarray(v) for k, v in c.items()} for c in (moving(), resting())]

        @jax.jit
        def stacked(values: Any, channels: Any) -> Array:
            return jnp.stack([jnp.broadcast_to(v, times.shape) for v in sense(name, values, channels, times).values()])

        slopes = jax.jit(jax.jacfwd(stacked))
        for point in (effect.null(), effect.nominal()):
            values = {k: jnp.asarray(v, float) for k, v in point.items()}
            for drive in drives:
                way = jax.tree.map(jnp.ones_like, drive)
                through = jax.jvp(lambda c, v=values: stacked(v, c), (drive,), (way,))[1]
                assert np.isfinite(np.asarray(through)).all()
                rates = {k: np.asarray(v) for k, v in slopes(values, drive).items()}
                assert all(np.isfinite(v).all() for v in rates.values())
            if point != effect.null():
                continue
            rates = {k: np.asarray(v) for k, v in slopes(values, drives[0]).items()}
            base = np.asarray(stacked(values, drives[0]))
            for key, rate in rates.items():
                if effect.parameters[key].null is None:
                    continue
                if name == "encoder_quantisation":
                    assert (rate == 0.0).all(), "as its documentation says"
                    continue
                numeric = (np.asarray(stacked({**values, key: values[key] + 1e-6}, drives[0])) - base) / 1e-6
                assert np.abs(rate).max() > 0.0, key
                assert np.abs(rate - numeric).max() < 1e-3 * np.abs(rate).max(), key


def test_every_measured_channel_has_a_family() -> None:
    assert {family(name) for name in moving()} == {*FAMILIES, None}
    assert [name for name in moving() if family(name) is None] == ["command_lf_drive_speed_rad_s"]


@pytest.mark.parametrize(
    "name, values, late",
    [
        ("clock_offset", {"odometry": 0.03}, 0.03),
        ("clock_offset", {"odometry": -0.12}, -0.12),
        ("clock_drift", {"odometry": 0.01}, 0.01 * TIMES),
    ],
)
def test_a_clock_that_is_late(name: str, values: Any, late: Array) -> None:
    """y_m(t) = y(t - delta), for one family only; yaw and quaternion turn on through 180 deg."""
    found, truth = sensed(name, values, moving()), moving()
    shifted = moving(TIMES - late)
    inner = slice(4, -4)
    for key, want in shifted.items():
        if family(key) == "odometry":
            error = (found[key] - want)[inner]
            error = (error + 180.0) % 360.0 - 180.0 if key == "yaw_deg" else error
            assert np.abs(error).max() < 2e-5, key
        else:
            np.testing.assert_array_equal(found[key], truth[key], err_msg=key)
    assert np.abs(found["yaw_deg"]).max() <= 180.0


def test_a_late_clock_is_right_to_first_order() -> None:
    """Derivative by the offset at 0: minus the rate of the signal, second order in the interval of samples."""
    with jax.enable_x64(True):
        channels = {"joint_lf_drive_angle_rad": jnp.sin(TIMES)}

        def angle(offset: Array) -> Array:
            return sense("clock_offset", {"joint": offset}, channels, jnp.asarray(TIMES))["joint_lf_drive_angle_rad"]

        slope = np.asarray(jax.jit(jax.jacfwd(angle))(jnp.zeros(())))
    assert np.abs(slope + np.cos(TIMES))[1:-1].max() < 1e-3


def test_scales() -> None:
    """2 % of the current; a position by the distance from where the log begins."""
    channels = moving()
    channels["position_x_m"] = channels["position_x_m"] + 7.0
    found = sensed("channel_scale", {"current": 0.02, "position": -0.1}, channels)
    assert found["motor_rf_drive_current_A"] == pytest.approx(1.02 * channels["motor_rf_drive_current_A"], rel=1e-12)
    assert found["position_x_m"] == pytest.approx(7.0 + 0.9 * np.sin(TIMES), rel=1e-12)
    np.testing.assert_array_equal(found["motor_rf_drive_voltage_V"], channels["motor_rf_drive_voltage_V"])


def test_quantisation() -> None:
    step = 0.05
    found = sensed("encoder_quantisation", {"angle": step}, moving())["joint_lf_drive_angle_rad"]
    assert found / step == pytest.approx(np.round(found / step), abs=1e-9)
    error = found - 0.8 * TIMES
    assert np.abs(error).max() <= step / 2 + 1e-12 and np.abs(error).max() > step / 4


def test_odometry_whose_heading_drifts_draws_an_arc() -> None:
    """Straight 10 m at 0.02 rad/m: x = sin(kL)/k, y = (1 - cos kL)/k; 1 % of the way up."""
    way = np.linspace(0.0, 10.0, 121)
    channels = {"position_x_m": 3.0 + way, "position_y_m": 0 * way, "position_z_m": 0 * way, "yaw_deg": 0 * way}
    found = sensed("odometry_drift", {"heading": 0.02, "vertical": 0.01}, channels)
    assert found["position_x_m"] == pytest.approx(3.0 + np.sin(0.02 * way) / 0.02, abs=1e-5)
    assert found["position_y_m"] == pytest.approx((1 - np.cos(0.02 * way)) / 0.02, abs=1e-5)
    assert found["position_z_m"] == pytest.approx(0.01 * way, abs=1e-12)
    assert found["yaw_deg"][-1] == pytest.approx(np.degrees(0.2))


def test_an_imu_mounted_askew() -> None:
    """Pitch and roll of the mount: R_x^T R_y^T f; biases are added; attitude and quaternion lean by their biases."""
    pitch, roll = 0.1, -0.05
    channels = {**moving(), **resting()}
    channels |= {"accelerometer_x_m_s2": 0 * TIMES, "accelerometer_y_m_s2": 0 * TIMES}
    channels["accelerometer_z_m_s2"] = G + 0 * TIMES
    values = {"pitch": pitch, "roll": roll, "accelerometer_y": 0.3, "gyro_z": 0.01, "pitch_bias": 0.2}
    found = sensed("imu_bias", values, channels)
    cp, sp, cr, sr = np.cos(pitch), np.sin(pitch), np.cos(roll), np.sin(roll)
    ry, rx = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]), np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    force = (ry @ rx).T @ np.array([0, 0, G]) + [0, 0.3, 0]
    spin = (ry @ rx).T @ np.array([0.0, 0.05, 0.2]) + [0, 0, 0.01]
    for i, a in enumerate("xyz"):
        assert found[f"accelerometer_{a}_m_s2"] == pytest.approx(force[i] + 0 * TIMES, abs=1e-12)
        assert found[f"gyro_{a}_rad_s"] == pytest.approx(spin[i] + 0 * TIMES, abs=1e-12)
    assert found["pitch_deg"] == pytest.approx(channels["pitch_deg"] + np.degrees(0.2))
    half = np.radians(150.0) / 2
    expected = [np.cos(half) * np.cos(0.1), -np.sin(half) * np.sin(0.1), np.cos(half) * np.sin(0.1)]
    for part, want in zip("wxy", expected, strict=True):
        assert found[f"quaternion_{part}"] == pytest.approx(want + 0 * TIMES, abs=1e-12)
    level = sensed("imu_bias", {"pitch": pitch}, channels)["accelerometer_x_m_s2"]
    assert level == pytest.approx(-G * np.sin(pitch) + 0 * TIMES), "as on a slope down ahead"


def test_thermistor_lag_is_exact_at_any_samples() -> None:
    """A ramp a t reads a (t - tau (1 - exp(-t/tau))), however few or uneven the samples; self-heating is added."""
    rng = np.random.default_rng(0)
    times = np.sort(np.append(rng.uniform(0, 60, 20), 0.0))
    ramp = {
        "winding_lf_drive_temperature_degC": 10.0 + 2.0 * times,
        "housing_lf_drive_temperature_degC": 5.0 + 0 * times,
    }
    found = sensed("thermistor_lag", {"winding": 5.0, "housing": 30.0, "self_heating": 0.3}, ramp, times)
    expected = 10.3 + 2.0 * (times - 5.0 * -np.expm1(-times / 5.0))
    assert found["winding_lf_drive_temperature_degC"] == pytest.approx(expected, rel=1e-12)
    assert found["housing_lf_drive_temperature_degC"] == pytest.approx(5.3 + 0 * times)


def test_harness_resistance_per_joint() -> None:
    found, truth = sensed("harness_resistance", {"resistance": np.array([0.2, 1.0])}, moving()), moving()
    for joint, ohm in zip(JOINTS, (0.2, 1.0), strict=True):
        want = truth[f"motor_{joint}_voltage_V"] + ohm * truth[f"motor_{joint}_current_A"]
        assert found[f"motor_{joint}_voltage_V"] == pytest.approx(want, rel=1e-12)


def test_bus_voltage_sags_with_power() -> None:
    found, truth = sensed("bus_droop", {"resistance": 0.5, "voltage": 40.0}, moving()), moving()
    power = sum(truth[f"motor_{j}_voltage_V"] * truth[f"motor_{j}_current_A"] for j in JOINTS)
    assert found["bus_voltage_V"] == pytest.approx(40.0 - 0.5 * power / 40.0, rel=1e-12)


def test_cross_talk() -> None:
    found, truth = sensed("cross_talk", {"axis": 0.02, "current": 0.5}, moving()), moving()
    want = truth["accelerometer_z_m_s2"] + 0.02 * truth["accelerometer_x_m_s2"]
    assert found["accelerometer_z_m_s2"] == pytest.approx(want, rel=1e-12)
    want = truth["winding_lf_drive_temperature_degC"] + 0.5 * np.abs(truth["motor_lf_drive_current_A"])
    assert found["winding_lf_drive_temperature_degC"] == pytest.approx(want, rel=1e-12)


def test_a_batch_of_drives_is_sensed_as_each_alone() -> None:
    """Shared parameters, channels with a leading batch axis."""
    one, two = moving(), {k: 2.0 * v for k, v in resting().items()}
    both = {k: np.stack([one[k], two[k]]) for k in one}
    for name in NAMES:
        values = catalogue.get(name).nominal()
        batch = sensed(name, values, both)
        for i, single in enumerate((one, two)):
            for key, want in sensed(name, values, single).items():
                assert batch[key][i] == pytest.approx(want, abs=1e-11), f"{name} {key}"
