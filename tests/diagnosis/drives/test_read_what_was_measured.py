"""What a log states of its start and its IMU reaches the simulation, and what nothing reads is named."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from lunar_mjx.diagnosis.drives.observations import with_discrepancy
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.simulation.log_run import log_run
from lunar_mjx.diagnosis.drives.unused import unused_channels
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.signals import observe
from lunar_mjx.errors import UserError
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.logs import Log, read_log, write_log
from lunar_mjx.model import Model, make_model

TIME = 0.05 * np.arange(41)
CORNERS = ("lf", "rf", "lr", "rr")


@pytest.fixture(scope="module")
def model() -> Model:
    return make_model("luvmi_x", terrain="flat", timestep=0.0025)


def make(folder: Path, columns: Mapping[str, object], speed: float = 1.0, **settings: object) -> Log:
    frame = {"time_s": TIME, **{f"command_{c}_drive_speed_rad_s": np.full(len(TIME), speed) for c in CORNERS}}
    frame |= {k: np.broadcast_to(v, len(TIME)) for k, v in columns.items()}  # type: ignore[call-overload]
    write_log(folder, {"drive": pd.DataFrame(frame)}, rover="luvmi_x", gravity_m_s2=1.625, **settings)  # type: ignore[arg-type]
    log = read_log(folder)
    assert isinstance(log, Log)
    return log


def test_a_start_by_quaternions(tmp_path: Path, model: Model) -> None:
    turned = Rotation.from_euler("z", 70.0, degrees=True).as_quat(scalar_first=True)
    columns = {f"quaternion_{c}": v for c, v in zip("wxyz", turned, strict=True)}
    run = log_run(make(tmp_path / "a", columns), model)
    assert run.start["yaw"] == pytest.approx(np.radians(70.0)) and "yaw" in run.unknown


def test_initial_values_beyond_the_position(tmp_path: Path, model: Model) -> None:
    turned = Rotation.from_euler("ZYX", [50.0, 3.0, -2.0], degrees=True).as_quat(scalar_first=True)
    for name, stated in (("angle", {"yaw_deg": 50.0}), ("quaternion", {"quaternion": turned.tolist()})):
        initial = {"position_m": [1.0, 2.0, 0.0], "winding_temperature_degC": 40.0, **stated}
        run = log_run(make(tmp_path / name, {"gyro_z_rad_s": 0.0}, initial=initial), model)
        assert (run.start["x"], run.start["y"]) == (1.0, 2.0)
        assert run.start["yaw"] == pytest.approx(np.radians(50.0), abs=1e-3)
        assert run.start["temperature"] == pytest.approx(313.15)


def test_a_log_may_begin_in_motion(tmp_path: Path, model: Model) -> None:
    radius = model.rover.wheels[0].radius
    rest = log_run(make(tmp_path / "rest", {f"joint_{c}_drive_speed_rad_s": TIME for c in CORNERS}), model)
    assert not rest.motion["moves"]
    sides = {"joint_left_drive_speed_rad_s": 1.0, "joint_right_drive_speed_rad_s": 2.0, "yaw_deg": 90.0}
    run = log_run(make(tmp_path / "sides", sides), model)
    assert run.motion["moves"]
    np.testing.assert_allclose(run.motion["velocity"], [0.0, 1.5 * radius], atol=1e-12)
    assert sorted(v for v in run.motion["joint_speed"] if np.isfinite(v)) == [1.0, 1.0, 2.0, 2.0]
    stated = {"world_velocity_m_s": [0.1, -0.2, 0.0], "angular_velocity_rad_s": [0.0, 0.0, 0.3]}
    run = log_run(make(tmp_path / "stated", {"yaw_deg": 0.0}, initial=stated), model)
    assert run.motion["moves"] and run.motion["yaw_rate"] == 0.3
    np.testing.assert_allclose(run.motion["velocity"], [0.1, -0.2])


def test_the_simulation_begins_in_motion(tmp_path: Path, model: Model) -> None:
    radius = model.rover.wheels[0].radius
    columns = {f"joint_{c}_drive_speed_rad_s": 1.0 for c in CORNERS}
    columns |= {"world_velocity_x_m_s": radius, "drawbar_pull_N": 5.0}
    log = make(tmp_path / "a", columns)
    still = make(tmp_path / "b", {k: v * (TIME > 0.0) for k, v in columns.items()})
    problem = DriveProblem([log, still], model, {}, discrepancy={"world_velocity_*": 0.01})
    predicted = problem.predict(problem.origin()[None])[0]
    first = {}
    for s in problem.observations.series:
        first[s.log, s.channel] = predicted[s.start]
    assert first[0, "world_velocity_x_m_s"] == pytest.approx(radius, rel=0.2)
    assert abs(first[1, "world_velocity_x_m_s"]) < 0.1 * radius
    assert first[0, "joint_lf_drive_speed_rad_s"] == pytest.approx(1.0, rel=0.05)
    assert "drawbar_pull_N" in problem.unused and "joint_lf" not in problem.unused
    widened = next(s for s in problem.observations.series if s.channel == "world_velocity_x_m_s")
    assert widened.coloured >= 0.01 and widened.correlation_time > 0.0


def test_motors_may_be_read_before_a_command_acts(tmp_path: Path, model: Model) -> None:
    names = [f"motor_{c}_drive_current_A" for c in CORNERS]
    rest = pd.DataFrame({"time_s": TIME, **dict.fromkeys(names, 0.0), "world_velocity_x_m_s": 0.0})
    steps = pd.DataFrame(
        {"time_s": TIME, **{f"command_{c}_drive_speed_rad_s": np.where(TIME < 0.999, 0.0, 1.0) for c in CORNERS}}
    )
    write_log(tmp_path / "a", {"drive": steps, "other": rest}, rover="luvmi_x", gravity_m_s2=1.625)
    log = read_log(tmp_path / "a")
    assert isinstance(log, Log)
    problem = DriveProblem([log], model, {})
    place = next(i for i, c in enumerate(problem.coordinates) if c.name == "reads_before")
    rows = np.tile(problem.origin(), (3, 1))
    rows[1:, place] = 0.5, 1.0
    after, half, before = problem.predict(rows)
    for s in problem.observations.series:
        own, at = slice(s.start, s.stop), s.start + 20
        assert s.time is not None and s.time[20] == pytest.approx(1.0)
        if s.channel in names:
            assert after[at] > 1.0 and abs(before[at]) < 0.02 * after[at]
            np.testing.assert_allclose(half[own], 0.5 * (after[own] + before[own]), atol=1e-9)
        else:
            np.testing.assert_array_equal(before[own], after[own])


def test_the_imus_axes_are_those_of_its_channels(model: Model) -> None:
    import jax

    system = build(model, "auto")
    with jax.enable_x64(True):
        state = jax.jit(system.reset)(system.params, 0.0, 0.0, 0.0)
        commands = np.ones((8, len(model.rover.joints)))
        _, telemetry = system.rollout(system.params, state, commands, 4)
        turn = Rotation.from_euler("ZYX", [90.0, 10.0, 5.0], degrees=True)
        plain = observe(system, telemetry).channels
        turned = observe(system, telemetry, imu_quaternion=turn.as_quat(scalar_first=True).tolist()).channels
    for kind, unit in (("gyro", "rad_s"), ("accelerometer", "m_s2")):
        before, after = (np.stack([c[f"{kind}_{a}_{unit}"] for a in "xyz"], axis=-1) for c in (plain, turned))
        np.testing.assert_allclose(turn.apply(after), before, atol=1e-6)
    np.testing.assert_array_equal(plain["yaw_deg"], turned["yaw_deg"])


def test_what_nothing_reads_is_named(tmp_path: Path) -> None:
    columns = {"drawbar_pull_N": 5.0, "bus_voltage_V": 48.0, "gyro_z_rad_s": 0.0, "joint_left_drive_speed_rad_s": 1.0}
    columns |= {"joint_right_drive_speed_rad_s": 1.0, "wheel_lf_slip_angle_deg": 0.0, "motor_left_drive_current_A": 1.0}
    log = make(tmp_path / "a", columns, imposed="wheel_speed")
    found = unused_channels(log, {"gyro_z_rad_s"})
    words = {"drawbar_pull_N": "tether", "bus_voltage_V": "bus_droop", "wheel_lf_slip_angle_deg": "camera"}
    words |= {"motor_left_drive_current_A": "a motor of its own"}
    assert set(found) == set(words) and all(word in found[name] for name, word in words.items())


def test_a_discrepancy_of_an_unknown_channel_is_refused() -> None:
    series = Series(0, "yaw_deg", 0, 3, np.arange(3.0), 0.1)
    seen = Observations(np.zeros(3), (series,), ("a",), ("fit",), np.zeros(3, int), ("fit",), ("a",))
    assert with_discrepancy(seen, {"yaw_*": 0.5}).series[0].coloured == 0.5
    for name, size, words in (("speed", 1.0, "is not compared; use one of yaw_deg"), ("yaw_deg", -1.0, "no size")):
        with pytest.raises(UserError, match=words):
            with_discrepancy(seen, {name: size})


@pytest.mark.slow
def test_clocks_and_mountings_known_within_an_error(tmp_path: Path, model: Model) -> None:
    late, turn = 0.02, np.radians(0.5)
    speed = {f"command_{c}_drive_speed_rad_s": 1.0 + np.sin(2.0 * TIME) for c in CORNERS}
    drive = pd.DataFrame({"time_s": TIME, **speed, "world_velocity_x_m_s": 0.1})
    names = [f"{k}_{a}_{u}" for k, u in (("gyro", "rad_s"), ("accelerometer", "m_s2")) for a in "xyz"]
    imu = pd.DataFrame({"time_s": TIME[4:-4], **dict.fromkeys(names, 0.1)})
    mounting = Rotation.from_euler("ZYX", [30.0, -5.0, 4.0], degrees=True)
    tilted = Rotation.from_rotvec([0.0, turn, 0.0]) * mounting

    def log(name: str, rotation: Rotation, shift: float) -> Log:
        axes = {"quaternion": rotation.as_quat(scalar_first=True).tolist(), "mounting_std_deg": [0.0, 1.0, 180.0]}
        tables = {"drive": drive, "imu": imu}
        offset = {"imu": (shift, 0.01)}
        write_log(tmp_path / name, tables, rover="luvmi_x", gravity_m_s2=1.625, imu=axes, clock_offsets_s=offset)
        found = read_log(tmp_path / name)
        assert isinstance(found, Log)
        return found

    logs = [log("nominal", mounting, 0.0), log("late", mounting, late), log("turned", tilted, 0.0)]
    problem = DriveProblem(logs, model, {})
    own = {c.name: i for i, c in enumerate(problem.coordinates) if c.nuisance and c.log_index == 0}
    assert {"clock imu", "mounting y"} <= set(own) and "mounting z" not in own
    rows = np.tile(problem.origin(), (3, 1))
    rows[1, own["clock imu"]] = late / 0.01
    rows[2, own["mounting y"]] = turn / np.radians(1.0)
    predicted = problem.predict(rows)
    for which, other in ((1, 1), (2, 2)):
        for s in problem.observations.series:
            if s.log != 0 or s.channel not in names:
                continue
            twin = next(t for t in problem.observations.series if t.log == other and t.channel == s.channel)
            before, after = predicted[0, s.start : s.stop], predicted[which, s.start : s.stop]
            truth = predicted[0, twin.start : twin.stop]
            if np.max(np.abs(truth - before)) > 3e-4:
                # of the second order in the error, and at the ends of one-sided quotients
                assert np.median(np.abs(after - truth)) < 0.25 * np.median(np.abs(before - truth)), (s.channel, which)
