"""From keys to a rover that moves: the pilot, the drive in real time, and the command."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest

from lunar_mjx.model import make_model
from lunar_mjx.viewer import window
from lunar_mjx.viewer.drive import PACE, LiveDrive, Pace
from lunar_mjx.viewer.pilot import Pilot, drivable
from tests.cli_harness import MAIN
from tests.viewer.viewer_client import Clock


@pytest.fixture(scope="module")
def model():
    return make_model("luvmi_x", "flat")


@pytest.fixture(scope="module")
def drive(model):
    return LiveDrive(model, "native", top_speed=0.5)


def test_pilot_ramps_speed_and_steering(model):
    pilot, joints = Pilot(model, 0.6), model.rover.joints
    wheel = model.rover.wheels[0]
    pilot.hold(["forward", "left"])
    first = pilot.control(0.1)
    assert first[joints.index(wheel.drive)] == pytest.approx(0.06 / wheel.radius)
    for _ in range(40):
        last = pilot.control(0.1)
    assert [last[joints.index(w.drive)] for w in model.rover.wheels] == pytest.approx([0.6 / wheel.radius] * 4)
    fronts = [last[joints.index(w.steer)] for w in model.rover.wheels[:2]]
    assert fronts == pytest.approx([0.9 * 0.52] * 2)  # to the left, short of the joints' limits
    assert [last[joints.index(w.steer)] for w in model.rover.wheels[2:]] == [0.0, 0.0]
    pilot.hold(["brake", "forward"])
    for _ in range(20):
        last = pilot.control(0.1)
    assert not last.any()


def test_pilot_takes_notches(model):
    pilot = Pilot(model, 0.5)
    for key in ("forward", "forward", "back", "forward", "right"):
        pilot.press(key)
    assert (pilot.throttle, pilot.wheel) == pytest.approx((0.4, -0.2))
    for _ in range(9):
        pilot.press("back")
    assert pilot.throttle == -1.0
    pilot.press("brake")
    assert (pilot.throttle, pilot.wheel) == (0.0, 0.0)


def test_without_steering_the_sides_differ(model):
    pilot = Pilot(model, 0.5)
    pilot._steers = []
    pilot.hold(["left"])
    for _ in range(20):
        turned = pilot.control(0.1)
    by_side = {w.corner[0]: turned[model.rover.joints.index(w.drive)] for w in model.rover.wheels}
    assert by_side["l"] < 0 < by_side["r"]


def test_motors_in_other_modes_follow_the_driver(model):
    other = model.replace(modes={"drive": "torque", "steer": "velocity"})
    assert drivable(other).modes["drive"] == "velocity" and drivable(other).modes["steer"] == "position"
    assert drivable(model) is model


def test_drives_in_whole_intervals_and_falls_behind_rather_than_stop(drive):
    drive.reset()
    begin = drive.time
    assert drive.advance(0.05) == pytest.approx(0.04)
    assert drive.advance(0.03) == pytest.approx(0.04)
    assert drive.advance(60.0) < 0.25
    assert drive.time < begin + 0.4


def test_left_is_left_and_backwards_is_backwards(drive):
    drive.reset()
    drive.pilot.hold(["back"])
    for _ in range(20):
        drive.advance(0.1)
    assert drive.qpos[0] < -0.2 and abs(drive.qpos[1]) < 0.05
    drive.reset()
    assert np.hypot(*drive.qpos[:2]) < 0.02 and drive.path < 0.02
    drive.pilot.hold(["forward", "left"])
    for _ in range(30):
        drive.advance(0.1)
    assert drive.qpos[0] > 0.2 and drive.qpos[1] > 0.02
    now = drive.readings()
    assert 3.0 < now["heading_deg"] < 90.0 and now["power_W"] > 1.0 and not now["note"]


def test_a_wheel_at_rest_has_no_slip(drive):
    drive.reset()
    drive.pilot.hold([])
    for _ in range(30):
        drive.advance(0.1)
    assert drive.readings()["slip"] == [None] * 4
    assert "lf slip, sinkage" in window.captions(drive)[0] and "at rest" in window.captions(drive)[1]
    drive.pilot.hold(["forward"])
    for _ in range(10):
        drive.advance(0.1)
    assert all(isinstance(s, float) and abs(s) <= 2.0 for s in drive.readings()["slip"])


def test_a_drive_that_diverges_begins_anew(model):
    drive = LiveDrive(model, "native")
    drive.advance(0.1)
    state = drive.backend.state()
    state.qvel[:] = 1e12
    drive.backend.set_state(state)
    drive.pilot.hold(["forward"])
    drive.advance(0.1)
    assert "Back at the start" in drive.readings()["note"] and np.isfinite(drive.bodies()).all()


def test_a_rover_on_its_back_is_said(drive):
    drive.reset()
    drive.qpos = drive.qpos.copy()
    drive.qpos[3:7] = 0.0, 1.0, 0.0, 0.0
    assert "Rolled over" in drive.readings()["note"]
    drive.reset()


def test_pace_is_that_of_the_clock(model):
    clock, shown = Clock(), []
    pace = Pace(LiveDrive(model, "native"), lambda: shown.append(pace.drive.time), clock)
    start = pace.drive.time
    for _ in range(30):
        clock.now += PACE.tick
        pace.tick()
    assert shown[-1] - start == pytest.approx(30 * PACE.tick, abs=PACE.hold)
    assert len(shown) == 30 and pace.drive.rate == pytest.approx(1.0, abs=0.01)
    clock.now += 60.0  # a machine that was asleep falls behind rather than stops
    pace.tick()
    assert 0.1 < shown[-1] - shown[-2] < 0.25


def test_pace_goes_on_in_its_thread_until_stopped(model):
    several = threading.Semaphore(0)
    pace = Pace(LiveDrive(model, "native"), several.release)
    pace.start()
    for _ in range(3):
        several.acquire()
    pace.stop()
    assert not pace._thread.is_alive() and pace.failure is None and pace.drive.time > 0.0


def test_pace_shows_what_ended_it(model):
    shown = threading.Event()
    drive = LiveDrive(model, "native")
    drive.advance = None
    pace = Pace(drive, shown.set)
    pace.start()
    shown.wait()
    assert isinstance(pace.failure, TypeError)
    pace.stop()


def test_window_needs_a_screen(monkeypatch, drive):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    if sys.platform == "linux":
        assert not window.has_screen()
        monkeypatch.setenv("DISPLAY", ":4711")  # nobody answers there
        assert not window.has_screen()
    names, values = (text.split("\n") for text in window.captions(drive))
    assert len(names) == len(values) and "lf slip, sinkage" in names and any("degC" in v for v in values)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--port", "70000"), "--port = 70000 is no port; give 1024 to 65535, or 0 for any free one"),
        (("--port", "-1"), "--port = -1 is no port"),
        (("--port", "http"), "--port"),
        (("--speed", "0"), "--speed = 0.0 is not positive"),
        (("--speed", "nan"), "--speed = nan is not finite"),
        (("--engine", "warp"), "--engine = 'warp' does not exist; use one of auto, native, structured, mjx"),
        (("--sun", "1"), "--sun = '1' is not two numbers"),
        (("--x", "1e6"), "is off the terrain flat"),
        (("--rover", "nowhere"), "nowhere"),
    ],
)
def test_mistakes_are_one_sentence(run, arguments, message):
    result = run("view", "--web", "--terrain", "flat", *arguments)
    assert result.status == 2 and message in result.err and "Traceback" not in result.err


@pytest.mark.skipif(sys.platform == "win32", reason="signals differ")
def test_control_c_ends_it_cleanly():
    # a job in the background ignores the interrupt, and its children inherit that
    main = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {MAIN}"
    process = subprocess.Popen(
        [sys.executable, "-c", main, "view", "--web", "--rover", "luvmi_x", "--terrain", "flat", "--port", "0"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )
    with process:
        try:
            assert process.stdout is not None
            assert "http://127.0.0.1:" in process.stdout.readline()
            process.send_signal(signal.SIGINT)
            out, err = process.communicate()
        finally:
            process.kill()
    assert process.returncode == 0 and not err and "luvmi_x drove 0.0 m" in out
