"""A measured drive beside a model's: where the rovers stand, what the page gets and does, and what is refused."""

from __future__ import annotations

import base64
import json
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.diagnosis.report.driven import replayed
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.model.file import save_model
from lunar_mjx.rover import load_rover
from lunar_mjx.viewer.replay import Course, Replay
from lunar_mjx.viewer.server import Viewer
from tests.viewer.viewer_client import ask

HOSTILE = "<img src=x onerror='document.title=1'>"
SECONDS, AWAY = 12.0, 0.8


def write_run(folder: Path, channels: tuple[str, str] = ("position_x_m", "position_y_m")) -> Path:
    """A run in which a rover drove a quarter circle of 4 m; the model as given ended `AWAY` m to the side."""
    folder.mkdir()
    model = make_model("luvmi_x", "slope:10deg")
    save_model(model, folder / "model.toml")
    time = np.linspace(0.0, SECONDS, 61)
    angle = 0.5 * np.pi * time / SECONDS
    measured = np.concatenate([4.0 * np.sin(angle), 4.0 - 4.0 * np.cos(angle)])
    given = measured + np.concatenate([np.zeros(61), -AWAY * time / SECONDS])
    predicted = np.stack([given, measured + 0.01])
    n = len(measured)
    np.savez_compressed(
        folder / "series.npz",
        measured=measured,
        sigma=np.full(n, 0.1),
        time=np.tile(time, 2),
        place=np.zeros((0, 3)),
        unit=np.zeros(n, int),
        unit_names=np.array(["arc"]),
        split=np.array(["fit"]),
        series_start=np.array([0, 61]),
        series_channel=np.array(channels),
        series_log=np.array([0, 0]),
        logs=np.array(["arc" + HOSTILE]),
        labels=np.array(["as given", "refitted"]),
        predicted=predicted,
        residual=(measured - predicted) / 0.1,
    )
    run = {"format": "lunar-mjx-run/1", "logs": ["gone"], "hashes": {}, "added": []}
    (folder / "run.json").write_text(json.dumps(run), encoding="utf-8")
    return folder


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    return replayed(write_run(tmp_path_factory.mktemp("replay") / "run"))


def _bodies(text: str, frames: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), "<f4").reshape(frames, -1, 7)


def test_rovers_stand_where_they_were_and_lean_with_the_ground(replay):
    told = replay.scene["replay"]
    measured = _bodies(told["measured"], len(told["time"]))
    given, refitted = (_bodies(m["bodies"], len(told["time"])) for m in told["models"])
    chassis = replay.model.rover.compile().body(replay.model.rover.chassis).id
    place = measured[:, chassis, :3]
    # the body stands upright over its ground, so that its middle is moved downhill by its height times sin(10 deg)
    offset = replay.model.rover.standing_height * np.sin(np.radians(10.0)) + 0.02
    np.testing.assert_allclose(place[0, :2], [0.0, 0.0], atol=offset)
    np.testing.assert_allclose(place[-1, :2], [4.0, 4.0], atol=offset)
    w, x, y, z = measured[:, chassis, 3:].T
    yaw = np.unwrap(np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)))
    assert yaw[-1] - yaw[0] == pytest.approx(0.5 * np.pi, abs=0.1)  # its heading is that of its way
    up = 1 - 2 * (x * x + y * y)
    np.testing.assert_allclose(up, np.cos(np.radians(10.0)), atol=2e-3)
    gap = np.hypot(*(given[-1, chassis, :2] - place[-1, :2]))
    assert gap == pytest.approx(AWAY, rel=0.05)
    assert np.hypot(*(refitted[-1, chassis, :2] - place[-1, :2])) < 0.05
    trace = told["traces"][0]
    assert len(trace["predicted"]) == 2 and len(trace["measured"]) == 61 and trace["residual"][0][-1] is not None


def test_what_cannot_be_replayed_is_said(tmp_path):
    with pytest.raises(UserError, match="measured no positions"):
        replayed(write_run(tmp_path / "still", ("gyro_x_rad_s", "gyro_z_rad_s")))
    folder = write_run(tmp_path / "run")
    with pytest.raises(UserError, match="--log = 'nowhere' is none of its logs"):
        replayed(folder, "nowhere")
    (folder / "model.toml").unlink()
    with pytest.raises(UserError, match="model cannot be loaded"):
        replayed(folder)
    (folder / "series.npz").unlink()
    with pytest.raises(UserError, match=r"no series\.npz"):
        replayed(folder)


def write_windows(folder: Path, speed_measured: bool = True) -> Path:
    """A run of imposed wheel speeds: two windows of a straight drive that is cut by a pause, and one of a turn.

    The model as given is a tenth too fast, and turns at half the rate.
    """
    folder.mkdir()
    save_model(make_model("husky", "flat"), folder / "model.toml")
    at, ones = 0.1 * np.arange(20), np.ones(20)
    straight, turn = np.concatenate([5.0 + at, 9.0 + at]), at
    ahead, gyro = "body_velocity_x_m_s" if speed_measured else "motor_left_drive_current_A", "gyro_z_rad_s"
    # (log, channel, times, measured, predicted as given)
    series = [
        (0, ahead, straight, 0.5 * np.tile(ones, 2), 0.55 * np.tile(ones, 2)),
        (0, gyro, straight, 0.0 * straight, 0.0 * straight),
        (2, ahead, turn[3::4], 0.5 * ones[3::4], 0.5 * ones[3::4]),
        (2, gyro, turn, 0.4 * ones, 0.2 * ones),
    ]
    measured, given = (np.concatenate([s[k] for s in series]) for k in (3, 4))
    n = len(measured)
    predicted = np.stack([given, measured])
    np.savez_compressed(
        folder / "series.npz",
        measured=measured,
        sigma=np.full(n, 0.1),
        time=np.concatenate([s[2] for s in series]),
        place=np.zeros((0, 3)),
        unit=np.concatenate([np.full(len(s[2]), min(s[0], 1)) for s in series]),
        unit_names=np.array(["straight", "turn"]),
        split=np.array(["fit", "test"]),
        series_start=np.cumsum([0] + [len(s[2]) for s in series[:-1]]),
        series_channel=np.array([s[1] for s in series]),
        series_log=np.array([s[0] for s in series]),
        logs=np.array(["straight", "unused", "turn"]),
        labels=np.array(["as given", "refitted"]),
        predicted=predicted,
        residual=(measured - predicted) / 0.1,
    )
    used = [("straight", 5.0, "fit"), ("straight", 9.0, "fit"), ("turn", 0.0, "test")]
    windows = {
        "window_s": 2.0,
        "interval_s": 0.1,
        "used": [{"log": log, "start_s": start, "split": split} for log, start, split in used],
    }
    (folder / "windows.json").write_text(json.dumps(windows), encoding="utf-8")
    run = {"format": "lunar-mjx-run/1", "logs": ["gone"], "hashes": {}, "added": []}
    (folder / "run.json").write_text(json.dumps(run), encoding="utf-8")
    return folder


def test_windows_of_imposed_speeds_are_shown_one_after_another(tmp_path):
    folder = write_windows(tmp_path / "run")
    shown = replayed(folder)
    told = shown.scene["replay"]
    assert [p["title"] for p in told["parts"]] == [
        "straight, from 5.0 s",
        "straight, from 9.0 s",
        "turn, from 0.0 s, held out",
    ]
    assert [p["begin"] for p in told["parts"]] == [0.0, 2.0, 4.0]
    time = np.array(told["time"])
    chassis = shown.model.rover.compile().body(shown.model.rover.chassis).id
    measured = _bodies(told["measured"], len(time))[:, chassis, :2]
    given, refitted = (_bodies(m["bodies"], len(time))[:, chassis, :2] for m in told["models"])
    apart = np.hypot(*(given - measured).T)
    # 1.9 s at 0.5 m/s a window, and from there on; the model sets out at the measured place again
    for end, way in ((1.9, 0.95), (3.9, 1.9)):
        at = np.abs(time - end).argmin()
        assert measured[at, 0] - measured[0, 0] == pytest.approx(way, abs=0.01)
        assert apart[at] == pytest.approx(0.095, abs=0.01)
    assert apart[np.abs(time - 2.0).argmin()] < 0.01 and apart[np.abs(time - 4.0).argmin()] < 0.01
    # an arc of 0.5 / 0.4 m through 0.76 rad, of which the model turned half
    angle = 0.4 * 1.9
    end = 1.25 * np.array([np.sin(angle), 1.0 - np.cos(angle)])
    np.testing.assert_allclose(measured[-1] - measured[np.abs(time - 4.0).argmin()], end, atol=0.01)
    assert apart[-1] > 0.1 and np.hypot(*(refitted - measured).T).max() < 1e-6
    trace = next(t for t in told["traces"] if t["label"].startswith("gyro"))
    # a gap between windows, so that no line joins them
    assert len(trace["time"]) == 63 and [i for i, v in enumerate(trace["measured"]) if v is None] == [20, 41, 62]
    alone = replayed(folder, "turn").scene["replay"]
    assert [p["title"] for p in alone["parts"]] == ["turn, from 0.0 s, held out"] and alone["time"][-1] == 1.9


def test_wheels_of_a_turn_on_the_spot_roll_against_each_other():
    model = make_model("husky", "flat")
    time = np.linspace(0.0, 2.0, 21)
    course = Course("spin", time, 0.0 * time, 0.0 * time, 0.5 * time)
    told = Replay(model, "spin", course, [course], []).scene["replay"]
    spun = _bodies(told["measured"], len(told["time"]))
    mj = model.rover.compile()
    turned = {}
    for wheel in model.rover.wheels:
        body = mj.body(wheel.body).id
        w, _, y, _ = spun[5, body, 3:]
        turned[wheel.side] = float(2.0 * np.arctan2(y, w))
    assert turned["left"] < -0.01 and turned["right"] > 0.01


def test_windows_that_tell_no_way_are_refused_in_a_sentence(tmp_path):
    with pytest.raises(UserError, match=r"nor in windows a speed ahead and a yaw rate; .*lunar-mjx studio"):
        replayed(write_windows(tmp_path / "currents", speed_measured=False))
    folder = write_windows(tmp_path / "run")
    with pytest.raises(UserError, match="use one of straight, turn"):
        replayed(folder, "unused")
    content = json.loads((folder / "windows.json").read_text(encoding="utf-8"))
    del content["used"][0]["start_s"]
    (folder / "windows.json").write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(UserError, match=r"windows\.json: is damaged \(used\.0\.start_s"):
        replayed(folder)


def _straight(slip: float, speed: float = 0.5, noise: float = 0.0, seed: int = 0, without: str = "") -> Course:
    """Ten seconds straight ahead with wheels that are known to turn faster than they roll, places off by some noise."""
    rover = load_rover("luvmi_x")
    time, random = np.linspace(0.0, 10.0, 101), np.random.default_rng(seed)
    x, y = speed * time + random.normal(0.0, noise, 101), random.normal(0.0, noise, 101)
    joints = {w.drive: (time, (1.0 + slip) * speed * time / w.radius) for w in rover.wheels}
    joints |= {w.steer: (time, np.zeros(101)) for w in rover.wheels if w.steer}
    joints.pop(without, None)
    return Course("straight", time, x, y, np.zeros(101), joints, noise)


def _thrown(course: Course, preset: str = "consistent") -> Grains:
    model = make_model("luvmi_x", "flat", preset=preset)
    return Replay(model, "straight", course, [_straight(0.0)], []).thrown(8.0, 0)


def test_wheels_that_are_measured_to_slip_throw_dust_and_others_none():
    rover = load_rover("luvmi_x")
    grains = _thrown(_straight(0.6))
    assert len(grains.area) > 20 and set(grains.wheel) == set(range(len(rover.wheels)))
    # about the rover, which is 4 m on its way, and behind where it throws: no faster than its rim slips
    assert (np.abs(grains.position[:, 0] - 4.0) < 2.0).all() and (grains.position[:, 2] >= 0.0).all()
    assert np.linalg.norm(grains.velocity, axis=1).max() < 0.8 + 1.625 * 1.0
    assert len(_thrown(_straight(0.0)).area) == 0
    # twice the slip, more of it: the ground is the same
    assert _thrown(_straight(1.2)).area.sum() > grains.area.sum()


def test_noise_of_places_is_no_slip():
    seen = [len(_thrown(_straight(0.0, noise=0.02, seed=s)).area) for s in range(5)]
    assert seen == [0] * 5
    assert len(_thrown(_straight(0.6, noise=0.02)).area) > 20


def test_no_dust_where_slip_is_not_known_or_nothing_flies():
    wheel = next(w for w in load_rover("luvmi_x").wheels if w.steer)
    for joint in (wheel.drive, wheel.steer):
        assert len(_thrown(_straight(0.6, without=joint)).area) == 0
    model = make_model("luvmi_x", "flat")
    for still in (model.replace(gravity=9.81), model.add("hard_surface")):
        assert len(Replay(still, "straight", _straight(0.6), [_straight(0.6)], []).thrown(8.0, 0).area) == 0


def test_speeds_of_wheels_in_a_run_turn_them(tmp_path):
    """From the measured and the predicted series: a rover whose wheels stand throws none."""
    folder = write_run(tmp_path / "run")
    with np.load(folder / "series.npz") as kept:
        stored = dict(kept)
    rover, time = load_rover("luvmi_x"), np.linspace(0.0, SECONDS, 61)
    rolling = 0.5 * np.pi * 4.0 / SECONDS
    for joint, measured, predicted in [
        *((f"joint_{w.corner}_drive_speed_rad_s", 1.5 * rolling / w.radius, 0.0) for w in rover.wheels),
        *((f"joint_{w.corner}_steer_angle_rad", 0.0, 0.0) for w in rover.wheels if w.steer),
    ]:
        start = len(stored["measured"])
        stored["measured"] = np.concatenate([stored["measured"], np.full(61, measured)])
        stored["predicted"] = np.concatenate([stored["predicted"], np.full((2, 61), predicted)], axis=1)
        for name, more in (("sigma", np.full(61, 0.1)), ("time", time), ("unit", np.zeros(61, int))):
            stored[name] = np.concatenate([stored[name], more])
        stored["series_start"] = np.append(stored["series_start"], start)
        stored["series_channel"] = np.append(stored["series_channel"], joint)
        stored["series_log"] = np.append(stored["series_log"], 0)
    stored["residual"] = (stored["measured"] - stored["predicted"]) / 0.1
    np.savez_compressed(folder / "series.npz", **stored)
    shown = replayed(folder)
    # places that are off by 10 cm hide 0.26 m/s of slip; by a millimetre they do not
    assert len(shown.thrown(6.0, 1).area) == 0
    sure = dict(stored, sigma=np.where(np.arange(len(stored["sigma"])) < 122, 1e-3, stored["sigma"]))
    np.savez_compressed(folder / "series.npz", **sure)
    shown = replayed(folder)
    grains = shown.thrown(6.0, 1)
    assert shown.scene["replay"]["dusty"] and len(grains.area) > 20
    place = 4.0 * np.array([np.sin(0.25 * np.pi), 1.0 - np.cos(0.25 * np.pi)])
    assert (np.linalg.norm(grains.position[:, :2] - place, axis=1) < 2.0).all()


@pytest.fixture
def dusty():
    course = _straight(0.6)
    yield from _served(Replay(make_model("luvmi_x", "flat"), "straight", course, [course], []))


@pytest.fixture
def served(replay):
    yield from _served(replay)


def _served(replay):
    viewer = Viewer(replay, port=0)
    thread = threading.Thread(target=viewer.run)
    thread.start()
    yield viewer
    viewer.shutdown()
    thread.join()


def test_strangers_get_nothing_and_keys_move_nothing(served):
    port = served.server_address[1]
    assert ask(served, "GET", "/scene", Host=f"evil.example:{port}")[0] == 403
    assert ask(served, "GET", "/replay.js", Origin="http://evil.example")[0] == 403
    assert ask(served, "GET", "/replay.js")[0] == 200
    assert ask(served, "POST", "/keys", {"held": ["forward"]})[0] == 200
    assert ask(served, "POST", "/reset", {})[0] == 200
    told = json.loads(ask(served, "GET", "/scene")[2])
    assert len(told["replay"]["models"]) == 2 and told["rover"] == "luvmi_x"


def test_dust_is_told_of_a_time_and_nonsense_refused(dusty):
    told = json.loads(ask(dusty, "GET", "/dust?time=8&model=0")[2])
    assert len(told) % 5 == 0 and len(told) > 100 and np.isfinite(told).all()
    assert json.loads(ask(dusty, "GET", "/dust?time=8&model=0")[2]) == told
    assert json.loads(ask(dusty, "GET", "/dust?time=-5&model=0")[2]) == []
    for nonsense in ("", "?time=nan&model=0", "?time=1", "?time=1&model=1", "?time=1&model=-1", "?time=1&model=x"):
        assert ask(dusty, "GET", f"/dust{nonsense}")[0] == 400


@pytest.mark.slow
def test_the_page_shows_dust_of_the_time_that_it_shows(dusty, browser):
    seek = "const s = document.getElementById('when'); s.value = {}; s.dispatchEvent(new Event('input'));"
    pause = "const p = document.getElementById('play'); if (p.textContent === 'pause') p.click();"
    browser.open(dusty.address)
    browser.wait("Number(document.body?.dataset.grains) > 20")
    told = json.loads(ask(dusty, "GET", "/dust?time=8&model=0")[2])
    browser.value(f"(() => {{ {pause} {seek.format(8)} }})()")
    browser.wait(f"Number(document.body.dataset.grains) === {len(told) // 5}")
    browser.value(f"(() => {{ {seek.format(0)} }})()")
    browser.wait("Number(document.body.dataset.grains) === 0")
    assert not browser.problems


@pytest.mark.slow
@pytest.mark.parametrize("size", [(360, 740), (740, 360)], ids=["phone", "phone, lying"])
def test_a_phone_shows_the_panels_of_a_replay_whole(served, browser, size):
    browser.resize(*size)
    browser.open(served.address)
    browser.wait("Number(document.body?.dataset.time) > 0.1")
    boxes = browser.value(
        "[...document.querySelectorAll('#pad, #pad button, #replay')].map(s => s.getBoundingClientRect())"
        ".filter(b => b.width).map(b => [b.left, b.top, b.right, b.bottom, b.height])"
    )
    assert len(boxes) > 3
    for left, top, right, bottom, _ in boxes:
        assert left >= 0 and top >= 0 and right <= size[0] and bottom <= size[1]
    assert browser.value("[...document.querySelectorAll('#pad button')].every(b => b.scrollHeight <= b.clientHeight)")
    assert not browser.problems


@pytest.mark.slow
def test_the_page_plays_chooses_and_seeks(served, browser, tmp_path):
    """What plays by the clock is paused before it is read, so that a slow machine sees the same page."""
    seek = "const s = document.getElementById('when'); s.value = {}; s.dispatchEvent(new Event('input'));"
    choose = "const c = document.getElementById('model'); c.selectedIndex = {}; c.dispatchEvent(new Event('change'));"
    pause = "const p = document.getElementById('play'); if (p.textContent === 'pause') p.click();"
    watch = "window.labels = []; new MutationObserver(() => labels.push(p.textContent)).observe(p, {childList: true});"
    time = "Number(document.body.dataset.time)"
    gap = "parseFloat(document.getElementById('gap').textContent.match(/[0-9.]+/)[0])"
    # the camera stands still, the ground has come, and what was chosen last has been drawn
    drawn = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))"
    browser.open(served.address)
    browser.wait("Number(document.body?.dataset.time) > 0.5")
    assert browser.value("document.title") != "1"  # a log's name is text
    assert HOSTILE in browser.value("document.getElementById('replay-title').textContent")
    assert browser.value("document.querySelectorAll('#plots figure').length") == 2
    browser.value(f"(() => {{ {pause} {watch} {seek.format(6)} }})()")
    browser.key("keyDown", "Space", " ")
    browser.wait("window.labels.includes('pause')")  # it plays again
    browser.value(f"(() => {{ {pause} {seek.format(6)} }})()")
    browser.key("keyDown", "ArrowRight", "ArrowRight")
    browser.wait(f"Math.abs({time} - 8) < 0.01")
    browser.value(f"(() => {{ {seek.format(12)} {choose.format(0)} }})()")
    assert browser.value(gap) == pytest.approx(AWAY, abs=0.05)
    browser.value("document.getElementById('camera').click()")
    browser.wait("document.body.dataset.ground")
    assert browser.value(drawn)
    apart = np.asarray(Image.open(browser.picture(tmp_path / "apart.png")).convert("RGB"), int)
    browser.value(f"(() => {{ {choose.format(1)} }})()")
    assert browser.value(gap) < 0.05
    assert browser.value(drawn)
    with_fit = np.asarray(Image.open(browser.picture(tmp_path / "fit.png")).convert("RGB"), int)
    middle = (slice(150, 600), slice(300, 900))
    assert (np.abs(apart[middle] - with_fit[middle]).max(axis=-1) > 40).mean() > 0.01  # the ghost has moved
    own = served.address
    assert all(r.startswith(own) for r in browser.requests if not r.startswith(("data:", "about:")))
    assert not browser.problems
