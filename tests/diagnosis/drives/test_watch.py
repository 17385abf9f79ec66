"""watch: what is refused, alarms of a drive that grows while it is followed, and a planted change found and named."""

import dataclasses
import json

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.diagnosis import watch as watching
from lunar_mjx.diagnosis.drives.windows import coordinates
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, CURRENTS, GYRO
from lunar_mjx.diagnosis.drives.windows.following import Follower
from lunar_mjx.diagnosis.drives.windows.problem import Noise, Proportion, WindowProblem
from lunar_mjx.diagnosis.runs import RESTLESS_FILE, RUN_FILE, Run
from lunar_mjx.errors import UserError
from lunar_mjx.inference.changes import Restlessness
from lunar_mjx.logs import read_log
from lunar_mjx.model.file import save_model
from lunar_mjx.model.hard_floor import hard_floor

INTERVAL, SAMPLES = 0.2, 10
NOISE = {CURRENTS[0]: 0.1, CURRENTS[1]: 0.1, GYRO: 0.005}

LOG = """format = "lunar-mjx-log/1"
rover = "husky"
gravity_m_s2 = 9.81
manoeuvre = "up and down"
imposed = "wheel_speed"

[tables.drive]
file = "drive.csv"
rate_hz = 5.0

[noise]
"""


def write_log(folder, frame, text=LOG):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "log.toml").write_text(text, encoding="utf-8")
    frame.to_csv(folder / "drive.csv", index=False)
    return folder


def still(count=40):
    """A log of constant speed as a table."""
    time = INTERVAL * np.arange(count)
    return pd.DataFrame(
        {
            "time_s": time,
            "joint_left_drive_speed_rad_s": 2.0,
            "joint_right_drive_speed_rad_s": 2.0,
            "motor_left_drive_current_A": 3.0,
            "motor_right_drive_current_A": 3.0,
            "gyro_z_rad_s": 0.0,
        }
    )


def make_run(folder, log):
    """A run of undisturbed drives as `compare` and an earlier `watch` leave it."""
    model = hard_floor("husky")
    known = {
        q.key: (coordinates.start_of(model, q), 0.1 * q.std * (coordinates.start_of(model, q) if q.factor else 1.0))
        for q in coordinates.baseline(model)
    }
    model = dataclasses.replace(model, priors=known)
    run = Run(folder, (log.resolve(),), model)
    run.write()
    save_model(model, folder / "fitted.toml")
    noise = [dataclasses.asdict(Noise(NOISE.get(c, 1.0), 0.0, 1.0)) for c in CHANNELS]
    run.save("windows.json", {"window_s": 2.0, "interval_s": INTERVAL, "used": [], "noise": noise})
    proportions = [dataclasses.asdict(Proportion()) for _ in CHANNELS]
    run.save(
        RESTLESS_FILE, {"restlessness": dataclasses.asdict(Restlessness()), "proportions": proportions, "windows": 0}
    )
    return run


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path / "run", write_log(tmp_path / "hard", still()))


def test_a_recording_is_to_be_imported_first(run, tmp_path):
    with pytest.raises(UserError, match=r"drive\.mcap.*lunar-mjx log import"):
        next(watching.watch(tmp_path / "drive.mcap", run))


def test_drives_by_commands_are_refused(run, tmp_path):
    log = write_log(tmp_path / "log", still(), LOG.replace('imposed = "wheel_speed"\n', ""))
    with pytest.raises(UserError, match="imposed"):
        next(watching.watch(log, run))


def test_another_rover_is_refused(run, tmp_path):
    log = write_log(tmp_path / "log", still(), LOG.replace('"husky"', '"cuadriga"'))
    with pytest.raises(UserError, match=r"cuadriga.*husky"):
        next(watching.watch(log, run))


def test_a_run_of_other_logs_is_refused(run, tmp_path):
    (run.folder / "windows.json").unlink()
    with pytest.raises(UserError, match="no windows"):
        next(watching.watch(write_log(tmp_path / "log", still()), run))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"splits": {"nowhere": "test"}}, r"run\.json: splits = 'nowhere=test' names nothing of these logs"),
        ({"added": ["warp"]}, r"run\.json: added = 'warp' is no effect"),
        ({"discrepancy": {"gyro_z_rad_s": 1e12}}, r"run\.json: discrepancy: gyro_z_rad_s = .* is out of range"),
    ],
)
def test_what_a_run_says_of_other_logs_is_refused(run, tmp_path, change, said):
    run.save(RUN_FILE, {**run.load(RUN_FILE), **change})
    with pytest.raises(UserError, match=said):
        next(watching.watch(write_log(tmp_path / "log", still()), run.folder))


@pytest.mark.parametrize("hours", [0.0, float("nan"), -1.0])
def test_hours_between_alarms_are_positive(run, tmp_path, hours):
    with pytest.raises(UserError, match="--hours"):
        next(watching.watch(write_log(tmp_path / "log", still()), run, hours=hours))


def test_a_log_too_short_for_a_window_is_told(run, tmp_path):
    with pytest.raises(UserError, match="no window"):
        next(watching.watch(write_log(tmp_path / "log", still(6)), run, once=True))


class Recorder(watching._Watch):
    """Takes note of the windows that are followed, without a detector."""

    followed: list

    def _follow(self, log, found, until_s, once):
        begun = self.seen[-1] if self.seen else -np.inf
        mine = [float(t) for t in found.start_s if t > begun and t + found.seconds <= until_s + 1e-6]
        self.seen += mine
        self.followed.append(mine)
        yield from ()


def test_a_growing_log_is_followed_until_it_stands_still(run, tmp_path):
    """Every window is seen once, and a line that is half written is waited for."""
    whole = still(80)
    folder = write_log(tmp_path / "log", whole.head(6))
    left = [whole.head(30), whole.head(55), whole]

    def sleep(_):
        if left:
            write_log(folder, left.pop(0))
            if len(left) == 1:
                with (folder / "drive.csv").open("a", encoding="utf-8") as file:
                    file.write("11.2,2.0,2.")

    follower = Follower(run)
    watch = Recorder(folder, run, follower, Restlessness(), 10.0, tmp_path / "out", lambda *_: None)
    watch.followed = []
    assert list(watch.alarms(False, 6.0, sleep)) == []
    assert watch.seen == sorted(set(watch.seen))
    assert len(watch.seen) == 7
    assert len([part for part in watch.followed if part]) >= 3


def simulated(follower, folder, changes, count, onset, rng):
    """Writes the log of a drive of `count` windows, in which values are others from window `onset` on."""
    time = INTERVAL * np.arange(count * SAMPLES)
    ahead, turn = 0.4 + 0.2 * np.sin(time / 5.0), 0.12 * np.sin(time / 3.7)
    frame = pd.DataFrame({"time_s": time, **dict.fromkeys(NOISE, 0.0)})
    frame["joint_left_drive_speed_rad_s"], frame["joint_right_drive_speed_rad_s"] = (
        (ahead + sign * turn) / 0.165 for sign in (-1.0, 1.0)
    )
    # cut as it will be, so that what is measured belongs to the very motion that is imposed
    found = follower.windows(read_log(write_log(folder, frame)))
    problem = WindowProblem(found, follower.model)
    unknowns = tuple(coordinates.Unknown(*key.split("."), std=1.0) for key in changes)
    moved = [v - problem.begin(q) for q, v in zip(unknowns, changes.values(), strict=True)]
    before, after = problem.predict(unknowns, np.array([np.zeros(len(moved)), moved]))
    truth = np.where((np.arange(len(found)) >= onset)[:, None], after, before)
    for k, channel in enumerate(CHANNELS):
        if channel in NOISE:
            values = truth[k].reshape(-1)
            frame.loc[: len(values) - 1, channel] = values + rng.normal(0.0, NOISE[channel], len(values))
    return write_log(folder, frame.head(truth[0].size))


@pytest.mark.slow
def test_a_planted_change_raises_one_alarm_and_is_named(run, tmp_path):
    rng = np.random.default_rng(0)
    follower = Follower(run)
    for name, drag in (("quiet", 0.0), ("drag", 0.1)):
        simulated(follower, tmp_path / name, {"rolling_resistance.coefficient": drag}, 40, 20, rng)
    assert list(watching.watch(tmp_path / "quiet", run, once=True)) == []
    alarm, named = watching.watch(tmp_path / "drag", run, once=True, out=tmp_path / "out")
    assert 40.0 <= alarm.raised_s <= 70.0
    assert alarm.first_s <= 40.0 <= alarm.last_s
    assert next(iter(alarm.differences)) == "wheel_normal: resistance"
    assert "rolling_resistance" in named.diagnosis.effects
    assert json.dumps(named.to_dict())
    assert read_log(tmp_path / "drag").imposed == "wheel_speed"
