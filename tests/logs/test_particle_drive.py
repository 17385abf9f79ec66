"""The log of a rover on a bed: read back, fit to be used, its numerical error stated, and what an early end leaves."""

from __future__ import annotations

import json
import time

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, check, read_log
from lunar_mjx.logs.recorder.instruments import INSTRUMENTS, Recording
from lunar_mjx.logs.recorder.particle_drive import STATES, numerical_error, record_sand_drive, refuse_other
from lunar_mjx.manoeuvres import commands, load_manoeuvre
from lunar_mjx.model import make_model
from lunar_mjx.wheel_bed.particles.settings import Numerics, Sand
from tests.wheel_bed.particles.spring_bed import SpringBed

pytestmark = pytest.mark.slow

PLAN = """format = "lunar-mjx-manoeuvre/1"
terrain = "slope:5deg"
[[segment]]
duration_s = 1.2
speed_m_s = 0.2
ramp_s = 0.5
[[segment]]
duration_s = 0.8
speed_m_s = 0.2
steer_deg = { front = 15.0, rear = -15.0 }
"""


def recorded(tmp_path, **options) -> list[str]:
    tmp_path.mkdir(exist_ok=True)
    path = tmp_path / "turn.toml"
    path.write_text(PLAN)
    plan = load_manoeuvre(path)
    model = make_model("luvmi_x", plan.terrain, "consistent").replace(gravity=1.625)
    out = tmp_path / "out"
    refuse_other(out)
    out.mkdir(exist_ok=True)
    moves = commands(plan, model)
    return record_sand_drive(
        out, model, "luvmi_x", plan, moves, Sand(), Numerics(0.02), "cpu", make_bed=SpringBed, **options
    )


def time_is_up_after(steps: int, patch: pytest.MonkeyPatch):
    """A progress after whose calls, `steps` of them, the clock stands beyond every limit."""
    left = iter(range(steps - 1))

    def progress(what: str, share: float) -> None:
        if next(left, None) is None:
            patch.setattr(time, "perf_counter", lambda: 1e9)

    return progress


def test_the_log_is_fit_to_be_used(tmp_path):
    shares = []
    lines = recorded(
        tmp_path, recording=Recording(forces=True), progress=lambda what, share: shares.append((what, share))
    )
    log = read_log(lines[-1])
    assert isinstance(log, Log) and log.gravity_m_s2 == 1.625 and log.terrain == "slope:5deg"
    assert log.manoeuvre == "turn" and log.rover == "luvmi_x"
    assert [f for f in check([log]) if f.severity == "bad_data"] == []
    names = set(log.channel_names)
    wanted = ("position_x_m", "yaw_deg", "joint_lf_drive_speed_rad_s", "motor_rr_drive_current_A", "gyro_z_rad_s")
    assert names.issuperset((*wanted, "wheel_lf_sinkage_m", "wheel_rr_force_z_N", "command_lf_steer_angle_rad"))
    # Softer where voxels are larger: the spring's sinkage tells the error, twice the difference.
    sheet = next(i.std for i in INSTRUMENTS if i.pattern == "wheel_*_sinkage_m")
    force = log.channel("wheel_lf_force_z_N")
    assert force is not None
    wrong = 2.0 * (0.03 - 0.02) * 4.0 / SpringBed.stiffness * float(np.sqrt(np.mean(force[1] ** 2)))
    stated = log.noise["wheel_lf_sinkage_m"]
    # the instrument's white noise and the slow error stand apart
    assert stated.white == pytest.approx(sheet) and stated.coloured == pytest.approx(wrong, rel=0.1)
    assert stated.correlation_time_s > 0.2
    facts = json.loads((tmp_path / "out" / "drive.json").read_text())
    assert facts["numerics"]["voxel"] == 0.02 and facts["control"]["driven_s"] == pytest.approx(2.0)
    assert len(pd.read_csv(tmp_path / "out" / "surface.csv")) == 1
    assert [s for _, s in shares] == sorted(s for _, s in shares) and shares[-1] == ("control", 1.0)
    assert {what for what, share in shares if share < 0.7} == {"drive"}


def test_an_early_end_leaves_what_was_driven(tmp_path, monkeypatch):
    monkeypatch.setattr(time, "perf_counter", lambda: 0.0)
    lines = recorded(tmp_path, seconds=1e6, progress=time_is_up_after(130, monkeypatch))
    log = read_log(lines[-1])
    assert isinstance(log, Log) and 0.3 < log.span_s[1] < 2.0
    assert any("are not driven" in line for line in lines)
    assert any("numerical error not computed" in line for line in lines)
    assert log.noise["position_x_m"].std == 5e-3


def test_a_drive_that_was_left_is_gone_on_with(tmp_path, monkeypatch):
    """In three parts, cut in the drive and in its control, it is the drive in one."""
    whole = read_log(recorded(tmp_path / "whole")[-1])
    part = tmp_path / "parts"
    for steps in (150, 180):
        with monkeypatch.context() as patch:
            patch.setattr(time, "perf_counter", lambda: 0.0)
            lines = recorded(part, seconds=1e6, progress=time_is_up_after(steps, patch))
        assert (part / "out" / STATES["drive"]).exists()
    assert any("numerical error from the first" in line for line in lines)
    assert (part / "out" / STATES["control"]).exists()
    log = read_log(recorded(part)[-1])
    assert isinstance(log, Log) and isinstance(whole, Log)
    for name in whole.channel_names:
        (_, one), (_, other) = whole.channel(name), log.channel(name)
        assert other == pytest.approx(one, abs=1e-7), name
    assert {c: n.std for c, n in log.noise.items()} == pytest.approx({c: n.std for c, n in whole.noise.items()})
    assert not any((part / "out" / name).exists() for name in STATES.values())
    with pytest.raises(UserError, match="exists already"):
        refuse_other(part / "out")


def test_what_is_kept_of_another_drive_is_refused(tmp_path):
    np.savez(tmp_path / STATES["drive"], key=np.array("other"))
    (tmp_path / "out").mkdir()
    (tmp_path / STATES["drive"]).rename(tmp_path / "out" / STATES["drive"])
    with pytest.raises(UserError, match=r"drive.npz: settings = 'kept' are those of another drive; name a new folder"):
        recorded(tmp_path)
    (tmp_path / "out" / STATES["drive"]).write_bytes(b"rubbish")
    with pytest.raises(UserError, match="are no state of a drive"):
        recorded(tmp_path)


def test_an_end_before_it_stands_is_told(tmp_path):
    with pytest.raises(UserError, match="ended before the rover stood; run the same command again"):
        recorded(tmp_path, seconds=0.0)


def test_numerical_error_of_a_channel():
    time = 0.1 * np.arange(400)
    slow = np.cos(2.0 * np.pi * time / 20.0)
    frame = pd.DataFrame({"time_s": time, "yaw_deg": 179.0 + 0.0 * time, "gyro_z_rad_s": slow})
    other = pd.DataFrame({"time_s": time, "yaw_deg": -179.0 + 0.0 * time, "gyro_z_rad_s": 1.1 * slow}).iloc[:300]
    found = numerical_error({"imu": frame}, {"imu": other})
    # A constant difference of 2 deg, across the cut at 180: it lasts as long as both drives.
    assert found["yaw_deg"] == pytest.approx((4.0, 30.0), rel=0.02)
    assert found["gyro_z_rad_s"][0] == pytest.approx(2.0 * 0.1 * np.sqrt(0.5), rel=0.02)
    assert numerical_error({"imu": frame}, None) == {}
