"""Windows of drives with imposed wheel speeds: cutting, prediction, and what is named of a planted change."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from lunar_mjx.diagnosis import verbs as all_verbs
from lunar_mjx.diagnosis.drives.observations import DISCREPANCY_TIME_S
from lunar_mjx.diagnosis.drives.windows import coordinates, verbs
from lunar_mjx.diagnosis.drives.windows import problem as problem_room
from lunar_mjx.diagnosis.drives.windows.bench import Bench, held_out_parts
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, CURRENTS, Cut, _held, channels_read, cut, imu_clock
from lunar_mjx.diagnosis.drives.windows.form import WindowForm, observe
from lunar_mjx.diagnosis.drives.windows.problem import (
    Noise,
    WindowProblem,
    WindowProgram,
    corners,
    learn_noise,
    proportions,
)
from lunar_mjx.diagnosis.drives.windows.settings import WindowSettings, by_motion
from lunar_mjx.diagnosis.drives.windows.verbs import fitted_model
from lunar_mjx.diagnosis.runs import Run
from lunar_mjx.diagnosis.verdict import Diagnosis, Verdict
from lunar_mjx.diagnosis.weighed.conclusion import conclude
from lunar_mjx.diagnosis.weighed.held_to_account import account
from lunar_mjx.dynamics.imposed import Windows
from lunar_mjx.errors import UserError
from lunar_mjx.inference.weighing.hypotheses import EFFECT
from lunar_mjx.inference.weighing.search import search
from lunar_mjx.logs import read_campaign
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.model.hard_floor import hard_floor
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert

pytestmark = pytest.mark.optimised
RADIUS, SAMPLES, INTERVAL = 0.165, 8, 0.15
NOISE = (Noise(0.25, 0.0, 1.0), Noise(0.25, 0.0, 1.0), Noise(0.01, 0.0, 1.0), Noise(0.05, 0.0, 1.0))


@pytest.fixture(autouse=True)
def few_at_once(request, monkeypatch):
    """Windows in batches of few alone: the program of many has to be compiled, too, and is filled up to 1,024."""
    if not request.node.get_closest_marker("slow"):
        monkeypatch.setattr(problem_room, "PROGRAM", WindowProgram(sizes=(64, 64)))


@pytest.fixture(scope="module")
def model():
    return load_model(shipped("models") / "husky" / "hard_floor.toml")


def drives(count=24, seed=0):
    """Windows of straight drives, arcs and pivots at two speeds, each on a slight slope, over four logs."""
    rng = np.random.default_rng(seed)
    sides = [(0.3, 0.3), (0.6, 0.6), (-0.3, -0.3), (0.1, 0.4), (-0.15, 0.15), (0.3, -0.3)]
    speed = np.zeros((count, 2 * SAMPLES + 1, 4))
    for w in range(count):
        left, right = sides[w % len(sides)]
        speed[w, :, [0, 2]], speed[w, :, [1, 3]] = left / RADIUS, right / RADIUS
    slope = np.radians(rng.uniform(-3.0, 3.0, count))
    flat = np.zeros(speed.shape[:2])
    up = flat + 9.81 * np.sin(slope)[:, None], flat, flat + 9.81 * np.cos(slope)[:, None]
    yaw = (speed[:, 0, 1] - speed[:, 0, 0]) * RADIUS / 0.9
    measured = {c: np.zeros((count, SAMPLES)) for c in CHANNELS}
    number = np.arange(count) % 4
    return Cut(number, np.arange(count) * 2.0, INTERVAL, Windows(speed, *up, yaw), measured, {}, count)


def measured(found, model, changes, rng, magnitude=True):
    """The windows as a rover with changed values would have measured them."""
    found = dataclasses.replace(found, magnitude=dict.fromkeys(CURRENTS, 0.6) if magnitude else {})
    problem = WindowProblem(found, model)
    unknowns = tuple(coordinates.Unknown(*key.split("."), std=1.0) for key in changes)
    row = np.array([[v - problem.begin(q) for q, v in zip(unknowns, changes.values(), strict=True)]])
    truth = problem.predict(unknowns, row)[0]
    values = {c: truth[k] + rng.normal(0.0, NOISE[k].std, truth[k].shape) for k, c in enumerate(CHANNELS)}
    return dataclasses.replace(found, measured=values)


def form_of(model, found, names=()):
    """The form of some suspects beside a model, on windows of which the last are held out."""
    problem = WindowProblem(found, model)
    splits = np.where(np.arange(len(found)) < 18, "fit", "test")
    observations = observe(problem, NOISE, [f"log {k}" for k in range(4)], splits)
    suspects = [s for s in coordinates.suspects_of(model) if s.name in names]
    return WindowForm(lambda _: problem, coordinates.baseline(model), suspects, observations, WindowSettings())


def weigh(model, found, names):
    """What a search finds beside a model whose parameters are known to a tenth, and the form."""
    known = {
        q.key: (coordinates.start_of(model, q), 0.1 * q.std * (coordinates.start_of(model, q) if q.factor else 1.0))
        for q in coordinates.baseline(model)
    }
    form = form_of(dataclasses.replace(model, priors=known), found, names)
    s = form.settings
    return search([form], s.most_refits, s.most_terms, s.window), form


SUSPECTS = ("rolling_resistance", "hard_ground.mu", "payload", "calibration.current_left", "calibration.pitch")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"hard_ground.mu": 0.15}, "hard_ground.mu"),
        pytest.param({"rolling_resistance.coefficient": 0.12}, "rolling_resistance", marks=pytest.mark.slow),
        pytest.param({"calibration.current_left": -0.2}, "calibration.current_left", marks=pytest.mark.slow),
    ],
)
def test_a_planted_change_is_named(model, changes, name):
    found, form = weigh(model, measured(drives(), model, changes, np.random.default_rng(1)), SUSPECTS)
    said = conclude(found, 0.95)
    assert name in said.effects
    assert len(said.effects) == 1
    best = next(h for h in found.hypotheses if name in h.effects and h.refitted)
    base = found.base(form.name)
    usual = dataclasses.replace(base.evidence, tau=np.array([f.usual for f in base.refit.linear.fields]))
    scores = [e.log_score(h.refit.linear.judged.select(h.places)) for e, h in ((best.evidence, best), (usual, base))]
    # what predicts windows that no fit saw better by log 20 does so by chance with 5 % at most (Ville's inequality)
    assert scores[0] - scores[1] > np.log(20.0)
    held_out = form.residual(best.refit.u)[form.observations.in_split("test")]
    assert np.sqrt(np.mean(held_out**2)) < 1.1
    key, value = next(iter(changes.items()))
    at = [i for i, q in enumerate(form.unknowns) if q.key == key]
    start = form.coordinates[at[0]].start
    moved = sum(form.unknowns[i].std * best.refit.u[i] for i in at)
    fitted = start * np.exp(moved) if form.unknowns[at[0]].factor else start + moved
    assert fitted == pytest.approx(value, rel=0.25)


def test_nothing_is_named_where_nothing_is_missing(model):
    found, _ = weigh(model, measured(drives(), model, {"hard_ground.mu": 0.6}, np.random.default_rng(2)), SUSPECTS)
    assert conclude(found, 0.95).effects == ()
    assert found.probability_of(lambda h: not h.effects) > 0.7


def test_a_ground_that_differs_as_grounds_do_is_no_effect(model):
    """Four recordings whose resistance differs by the usual 0.02 want no name."""
    rng = np.random.default_rng(6)
    whole = drives()
    values = {c: np.zeros((len(whole), SAMPLES)) for c in CHANNELS}
    for number, more in enumerate(rng.normal(0.02, 0.015, 4)):
        mine = measured(whole, model, {"rolling_resistance.coefficient": abs(more)}, rng)
        for c in CHANNELS:
            values[c][whole.log == number] = mine.measured[c][whole.log == number]
    found, _ = weigh(model, dataclasses.replace(mine, measured=values), SUSPECTS)
    assert conclude(found, 0.95).effects == ()


def test_an_imu_askew_leaves_ground_level_that_nobody_measured(model):
    """A log without accelerometer or attitude is on level ground, whatever the mounting of an IMU."""
    found = dataclasses.replace(drives(), unlevelled=frozenset({1}))
    problem = WindowProblem(found, model)
    pitch = (coordinates.Unknown("calibration", "pitch", 1.0),)
    given, turned = problem.predict(pitch, np.array([[0.0], [3.0]]))
    moved = np.abs(turned - given)[:2].max(axis=(0, 2))
    assert moved[found.log == 1].max() == 0.0
    assert moved[found.log != 1].min() > 0.1


def test_noise_is_told_from_residuals():
    rng = np.random.default_rng(3)
    truth = Noise(0.5, 0.9, 1.0)
    block = rng.standard_normal((200, 13)) @ truth.factor(np.ones(13, bool), 0.15).T
    found = learn_noise(block[None], np.ones((1, 200, 13), bool), 0.15)[0]
    assert found.share >= 0.7
    assert found.std == pytest.approx(0.5, rel=0.2)


def test_noise_in_proportion_to_the_current_is_told():
    """Windows of ten times the current scatter more, by the share that is learnt."""
    rng = np.random.default_rng(7)
    size = np.tile([1.0, 10.0], 100)
    residual = rng.standard_normal((1, 200, 13)) * np.hypot(0.3, 0.2 * size)[None, :, None]
    scale = proportions(residual, np.ones((1, 200, 13), bool), size[None])[0]
    assert scale[1] / scale[0] == pytest.approx(np.hypot(0.3, 2.0) / np.hypot(0.3, 0.2), rel=0.3)
    even = proportions(residual / np.hypot(0.3, 0.2 * size)[None, :, None], np.ones((1, 200, 13), bool), size[None])[0]
    assert even[1] / even[0] == pytest.approx(1.0, rel=0.1)


def test_a_rover_is_held_where_its_wheels_turn_and_it_does_not():
    left, right = np.array([0.15, 0.15, 0.15, 0.15]), np.array([-0.15, -0.15, 0.16, -0.15])
    yaw = np.array([[0.001], [-0.2], [0.0], [np.nan]])
    np.testing.assert_array_equal(_held(left, right, yaw, 0.57), [True, False, False, False])
    assert not _held(left, right, yaw, np.inf).any()


def test_priors_survive_the_file(model, tmp_path):
    known = dataclasses.replace(model, priors={"hard_ground.mu": (0.6, 0.05), "calibration.pitch": (0.4, 0.2)})
    again = load_model(save_model(known, tmp_path / "model.toml"))
    assert again.priors == known.priors
    base = {q.key: q for q in coordinates.baseline(again)}
    assert base["hard_ground.mu"].std == pytest.approx(0.05 / 0.6)
    assert base["calibration.pitch"].std == pytest.approx(0.2)


def test_a_fit_teaches_priors(model, tmp_path):
    form = form_of(model, measured(drives(), model, {"hard_ground.mu": 0.6}, np.random.default_rng(4)))
    taught = fitted_model(form, form.refit(frozenset(), None, None))
    value, std = taught.priors["hard_ground.mu"]
    assert value == taught.parameters["hard_ground"]["mu"] == pytest.approx(0.6, rel=0.1)
    assert 0.0 < std < 0.35 * value
    size, spread = taught.priors["between_drives.resistance"]
    assert 0.0 < size < 0.02 and 0.0 < spread < 0.02
    # what `compare` writes is what the next `compare --model` reads
    assert load_model(save_model(taught, tmp_path / "fitted.toml")).priors == taught.priors


def a_log(folder, **more):
    """A log folder with a gap of a second, on a slope that its accelerometer tells; `more` columns with one value."""
    folder.mkdir()
    time = np.concatenate([np.arange(40) * 0.1, 5.0 + np.arange(30) * 0.1])
    rows = [f"{t:.3f},{2.0},{2.0},{3.0},{3.1},{1.7},{0.0},{9.66},{0.01}" for t in time]
    rows = [",".join([row, *map(str, more.values())]) for row in rows]
    header = (
        "time_s,joint_left_drive_speed_rad_s,joint_right_drive_speed_rad_s,motor_left_drive_current_A,"
        "motor_right_drive_current_A,accelerometer_x_m_s2,accelerometer_y_m_s2,accelerometer_z_m_s2,gyro_z_rad_s"
    )
    (folder / "drive.csv").write_text("\n".join([",".join([header, *more]), *rows]) + "\n")
    (folder / "log.toml").write_text(
        'format = "lunar-mjx-log/1"\nrover = "husky"\nmanoeuvre = "straight"\ngravity_m_s2 = 9.81\n'
        'imposed = "wheel_speed"\n[tables.drive]\nfile = "drive.csv"\nrate_hz = 10.0\n'
    )
    return folder


def test_logs_are_cut_where_speeds_are(tmp_path):
    """A gap of a second ends a window, and the accelerometer tells the slope."""
    model = load_model(shipped("models") / "husky" / "hard_floor.toml")
    found = cut(read_campaign([a_log(tmp_path / "drive")]), corners(model), RADIUS, 10)
    np.testing.assert_allclose(found.start_s, [0.0, 2.0, 5.0], atol=1e-9)
    slope = np.arctan2(np.asarray(found.imposed.up_x), np.asarray(found.imposed.up_z))
    np.testing.assert_allclose(np.degrees(slope), 9.98, atol=0.1)
    np.testing.assert_allclose(found.measured[CHANNELS[0]], 3.0)


def test_settings_and_a_known_error_of_the_model_are_honoured(tmp_path):
    """The error is in the noise of its channels, and stays there in what a later verb reads."""
    log, model = a_log(tmp_path / "drive"), load_model(shipped("models") / "husky" / "hard_floor.toml")
    given = {"settings": {"most_terms": "2"}, "discrepancy": {"motor_*_current_A": 0.5}}
    run = all_verbs.compare([log], model, tmp_path / "run", **given)
    bench = Bench(run, run.campaign())
    assert bench.settings.most_terms == 2
    left, right, gyro, _ = bench.noise()
    assert left.std > 0.5 and right.std > 0.5 and gyro.std < 0.1
    wrong = {"settings": {"effect_size": 2.0}, "discrepancy": {"yaw_deg": 1.0}}
    words = {
        "settings": "is not read where wheel speeds are imposed",
        "discrepancy": "is not compared; use one of gyro",
    }
    for option, value in wrong.items():
        with pytest.raises(UserError, match=words[option]):
            all_verbs.compare([log], model, tmp_path / "other", **{option: value})
        assert not (tmp_path / "other").exists()


@pytest.mark.parametrize("name", ["usual_discrepancy", "effect_size", "effect_freedom"])
def test_a_setting_that_no_window_reads_is_refused(name):
    with pytest.raises(UserError, match=f"{name}.* is not read where wheel speeds are imposed.* leave it out"):
        WindowSettings.of({name: "2"})


def test_what_no_window_holds_is_named_with_the_reason(tmp_path):
    """Positions without a heading were left out without a word."""
    place, heading = {"position_x_m": 1.0, "position_y_m": 2.0}, {"yaw_deg": 5.0}
    logs = [a_log(tmp_path / "a"), a_log(tmp_path / "b", **place), a_log(tmp_path / "c", **place, **heading)]
    read = [channels_read(log) for log in read_campaign(logs)]
    assert read[0] == read[1] and read[2] - read[0] == {*place, *heading}
    run = Run(tmp_path / "run", logs[1:2], load_model(shipped("models") / "husky" / "hard_floor.toml"))
    bench = Bench(run, run.campaign())
    told = bench.question([Noise(1.0, 0.0, 1.0)] * len(CHANNELS), ()).unused
    assert told == (
        "Not used: position_x_m, position_y_m (a speed over ground needs a heading that is known, yaw_deg)."
    )
    table = logs[0] / "drive.csv"
    table.write_text(table.read_text().replace("accelerometer_y_m_s2", "roll_deg"))
    run = Run(tmp_path / "other", logs[:1], run.model)
    told = Bench(run, run.campaign()).question([Noise(1.0, 0.0, 1.0)] * len(CHANNELS), ()).unused
    assert "accelerometer_x_m_s2, accelerometer_z_m_s2 (the slope needs all three axes of it" in told


def test_a_known_error_is_a_coloured_part_of_the_noise():
    there = np.ones(4, bool)
    for noise in (Noise(0.2, 0.4, 3.0), Noise(0.2, 0.0, 9.0)):
        before, wider = noise.factor(there, 0.1), noise.with_discrepancy(0.3).factor(there, 0.1)
        lag = 0.1 * np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
        added = 0.09 * np.exp(-lag / (3.0 if noise.share else DISCREPANCY_TIME_S))
        np.testing.assert_allclose(wider @ wider.T, before @ before.T + added)


def test_a_channel_with_gaps_weighs_as_much_as_its_samples(model):
    """Samples that are missing are marginalised: the whitened rest has unit variance, and nothing else counts."""
    found = drives(120)
    rng = np.random.default_rng(5)
    noise = [Noise(0.3, 0.8, 1.0)] * len(CHANNELS)
    values = {
        c: rng.standard_normal((120, SAMPLES)) @ noise[0].factor(np.ones(SAMPLES, bool), INTERVAL).T for c in CHANNELS
    }
    for v in values.values():
        v[::2, 1::3] = np.nan
        v[5] = np.nan
    problem = WindowProblem(dataclasses.replace(found, measured=values), model)
    white = problem.whitened(problem.residual(np.zeros((len(CHANNELS), 120, SAMPLES))), noise)
    assert np.all(white[~problem.there] == 0.0)
    assert np.mean(white[problem.there] ** 2) == pytest.approx(1.0, abs=0.1)
    learnt = learn_noise(problem.residual(np.zeros(white.shape)), problem.there, INTERVAL)[0]
    assert learnt.std == pytest.approx(0.3, rel=0.15)
    assert learnt.share >= 0.5


def write_drive(folder, columns, head="", tables=""):
    """A log of one table of columns (name: values), and further tables as TOML."""
    folder.mkdir()
    rows = [",".join(f"{v:.5f}" for v in row) for row in zip(*columns.values(), strict=True)]
    (folder / "drive.csv").write_text("\n".join([",".join(columns), *rows]) + "\n")
    (folder / "log.toml").write_text(
        'format = "lunar-mjx-log/1"\nrover = "husky"\nmanoeuvre = "by hand"\ngravity_m_s2 = 9.81\n'
        f'imposed = "wheel_speed"\n{head}[tables.drive]\nfile = "drive.csv"\n{tables}'
    )
    return read_campaign([folder])[0]


def turning(time):
    """Speeds of the sides, rad/s, and the yaw rate, rad/s, of a drive that swings from side to side."""
    swing = 0.8 * np.sin(0.9 * time) + 0.5 * np.sin(2.3 * time)
    return 2.0 - swing, 2.0 + swing, 0.2 * swing


def test_the_clock_of_an_imu_is_told_by_turning(tmp_path):
    time = np.arange(0.0, 40.0, 0.1)
    left, right, _ = turning(time)
    drive = {"time_s": time, "joint_left_drive_speed_rad_s": left, "joint_right_drive_speed_rad_s": right}
    own = np.arange(0.0, 40.0, 0.02)
    late = turning(own + 0.35)[2]  # the IMU's clock shows 0.35 s less than the wheels'
    folder = tmp_path / "late"
    log_of = 'file = "imu.csv"\nclock_offset_std_s = 0.4\n'
    (tmp_path / "imu.csv").write_text(
        "time_s,gyro_z_rad_s\n" + "".join(f"{t:.3f},{v:.6f}\n" for t, v in zip(own, late, strict=True))
    )
    log = write_drive(folder, drive, tables="[tables.imu]\n" + log_of.replace("imu.csv", "../imu.csv"))
    sides = [log.channel(f"joint_{s}_drive_speed_rad_s") for s in ("left", "right")]
    offset, std = imu_clock(log, *sides)
    assert offset == pytest.approx(0.35, abs=0.03)
    assert std < 0.05


def test_wheels_with_a_motor_each_and_no_imu(tmp_path, model):
    """Currents of wheels add up to their side's, and what no channel tells is no unknown."""
    time = np.arange(0.0, 10.0, 0.1)
    left, right, _ = turning(time)
    columns = {"time_s": time}
    for corner, speed in (("lf", left), ("rf", right), ("lr", left), ("rr", right)):
        columns[f"joint_{corner}_drive_speed_rad_s"] = speed
        columns[f"motor_{corner}_drive_current_A"] = 1.0 + 0.0 * time
    log = write_drive(tmp_path / "wheels", columns)
    found = cut([log], corners(model), RADIUS, 10)
    np.testing.assert_allclose(found.measured[CURRENTS[0]], 2.0)
    assert found.channels == set(CURRENTS)
    names = {q.key for q in coordinates.baseline(model, found.channels)}
    assert "calibration.gyro_scale" not in names
    assert "calibration.current_difference" in names


def test_currents_of_a_part_of_a_sides_wheels_are_refused(tmp_path, model):
    time = np.arange(0.0, 10.0, 0.1)
    columns = {"time_s": time, "joint_left_drive_speed_rad_s": 3.0 + np.sin(time)}
    columns["joint_right_drive_speed_rad_s"] = columns["joint_left_drive_speed_rad_s"]
    columns |= {f"motor_{corner}_drive_current_A": np.ones(len(time)) for corner in ("lf", "rf", "rr")}
    log = write_drive(tmp_path / "part", columns)
    told = "motor_lr_drive_current_A = None is missing beside motor_lf_drive_current_A; .*motor_left_drive_current_A"
    with pytest.raises(UserError, match=told):
        cut([log], corners(model), RADIUS, 10)


def test_poses_tell_the_speed_ahead(tmp_path, model):
    """Without currents: the speed over ground along the chassis, from positions and heading."""
    time = np.arange(0.0, 8.0, 0.05)
    heading, speed = 0.3 + 0.2 * time, 0.5
    columns = {
        "time_s": time,
        "joint_left_drive_speed_rad_s": 3.0 + 0.01 * np.sin(time),
        "joint_right_drive_speed_rad_s": 3.2 + 0.01 * np.sin(time),
        "position_x_m": np.cumsum(np.cos(heading)) * speed * 0.05,
        "position_y_m": np.cumsum(np.sin(heading)) * speed * 0.05,
        "yaw_deg": np.degrees(heading),
    }
    found = cut([write_drive(tmp_path / "poses", columns)], corners(model), RADIUS, 10)
    assert found.channels == {CHANNELS[2], CHANNELS[3]}
    np.testing.assert_allclose(found.measured[CHANNELS[3]][1:-1], speed, rtol=0.02)
    np.testing.assert_allclose(found.measured[CHANNELS[2]][1:-1], 0.2, rtol=0.02)


def test_slow_wheel_speeds_are_cut_about_their_readings(tmp_path, model):
    slow = tmp_path / "speeds.csv"
    time = np.arange(0.0, 60.0, 5.0)
    slow.write_text(
        "time_s,joint_left_drive_speed_rad_s,joint_right_drive_speed_rad_s\n"
        + "".join(f"{t},{2.0 + 0.1 * (k % 2)},{2.0}\n" for k, t in enumerate(time))
    )
    fine = np.arange(0.0, 60.0, 0.1)
    columns = {"time_s": fine, "motor_left_drive_current_A": 3.0 + 0.0 * fine, "motor_right_drive_current_A": fine}
    log = write_drive(tmp_path / "slow", columns, tables='[tables.speed]\nfile = "../speeds.csv"\n')
    found = cut([log], corners(model), RADIUS, 100)
    middle = found.start_s + 0.5 * found.seconds - 0.5 * found.interval_s
    np.testing.assert_allclose(middle, time[1:-1], atol=1e-6)
    assert found.seconds == pytest.approx(2.0)


def test_nothing_to_judge_by_is_refused(tmp_path, model):
    time = np.arange(0.0, 10.0, 0.1)
    columns = {"time_s": time, "joint_left_drive_speed_rad_s": 2.0 + 0.1 * np.sin(time)}
    columns["joint_right_drive_speed_rad_s"] = columns["joint_left_drive_speed_rad_s"]
    log = write_drive(tmp_path / "bare", columns)
    with pytest.raises(UserError, match="measures nothing that imposed wheel speeds could be judged by"):
        cut([log], corners(model), RADIUS, 10)


@pytest.mark.parametrize("rover", ["husky", "warthog"])
def test_shipped_files_are_the_hard_floor_of_any_rover(rover):
    """`hard_floor.toml` of a rover's folder spells out what `hard_floor` derives from its weight and size."""
    derived, model = hard_floor(rover), load_model(shipped("models") / rover / "hard_floor.toml")
    assert [e.name for e in derived.effects] == [e.name for e in model.effects]
    for name in ("hard_ground", "coulomb_friction", "viscous_friction"):
        for key, value in derived.parameters[name].items():
            np.testing.assert_allclose(value, model.parameters[name][key], rtol=0.05)


def test_tyres_bear_the_log_s_gravity():
    earth, moon = (hard_floor("husky", g).parameters["hard_ground"]["stiffness"] for g in (9.81, 1.625))
    assert earth / moon == pytest.approx(9.81 / 1.625)


def test_sizes_follow_the_rover():
    """What is plausible of a rover twice as heavy is twice as much."""
    small, large = (coordinates.sizes(hard_floor(r)) for r in ("husky", "cuadriga"))
    model = hard_floor("cuadriga")
    payload = next(s for s in coordinates.suspects_of(model) if s.name == "payload").unknowns[0]
    assert payload.std == pytest.approx(0.17 * large["mass"])
    assert large["mass"] > small["mass"]


@pytest.mark.parametrize(
    ("note", "std"),
    [
        ("drive: assumed the motor X; state torque_constant_Nm_A", coordinates.ASSUMED_MOTOR),
        ("drive: assumed a gear of 243; state gear_ratio", coordinates.ASSUMED_GEAR),
        (
            "drive: assumed the motor X behind a gear of 243",
            np.hypot(coordinates.ASSUMED_MOTOR, coordinates.ASSUMED_GEAR),
        ),
        ("steer: assumed the motor X behind a gear of 1526", 0.05),
    ],
)
def test_what_a_current_is_worth_is_known_as_well_as_it_was_stated(model, note, std):
    rover = dataclasses.replace(model.rover, notes=(note,))
    known = {q.key: q for q in coordinates.data_sheet(dataclasses.replace(model, rover=rover))}
    assert known["motor.torque_constant"].std == pytest.approx(std)


def test_what_is_known_is_fitted_no_further(model):
    """A prior is in the parameter's unit; what is fixed is no unknown any more; what is not plausible is refused."""
    known = coordinates.with_knowledge(model, {"hard_ground.mu": (0.5, 0.05), "motor.gear_efficiency": (0.65, 0.0)})
    base = {q.key: q for q in coordinates.baseline(known)}
    assert base["hard_ground.mu"].std == pytest.approx(0.1)
    assert known.parameters["hard_ground"]["mu"] == 0.5
    assert "motor.gear_efficiency" not in base
    assert known.parameters["motor"]["gear_efficiency"] == pytest.approx((0.65,) * 4)
    with pytest.raises(UserError, match="not plausible"):
        coordinates.with_knowledge(model, {"hard_ground.mu": (5.0, 0.1)})
    with pytest.raises(UserError, match="is not fitted here"):
        coordinates.with_knowledge(model, {"soil.n": (1.0, 0.1)})


def test_a_steered_rover_is_refused():
    with pytest.raises(UserError, match="drives are its only joints"):
        corners(hard_floor("luvmi_x"))


def test_a_rover_on_free_rockers_is_refused_with_the_remedy(tmp_path):
    """Its rockers have no actuator, so that no group of joints names them."""
    text = (shipped("models") / "husky" / "husky.urdf").read_text()
    for wheel in ("lf", "lr"):
        text = text.replace(
            f'<parent link="chassis"/>\n    <child link="{wheel}', f'<parent link="rocker"/>\n    <child link="{wheel}'
        )
    rocker = """<link name="rocker"><inertial><mass value="3"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="pivot" type="revolute"><parent link="chassis"/><child link="rocker"/><axis xyz="0 1 0"/>
      <limit lower="-0.1" upper="0.1" effort="1" velocity="1"/></joint></robot>"""
    (tmp_path / "husky.urdf").write_text(text.replace("</robot>", rocker))
    convert(tmp_path / "husky.urdf", tmp_path / "out")
    with pytest.raises(UserError, match='only joints, and it has pivot; write type="fixed" for them in its URDF'):
        corners(hard_floor(tmp_path / "out"))


def test_a_name_that_does_not_help_what_was_held_out_is_taken_back():
    """Three windows of mixed gain refuse a name and keep its port; eight that all gain keep it."""
    named = Diagnosis(Verdict.KNOWN, ("soft_ground",), "soft_ground is missing.")
    families = {"soft_ground": "ground"}
    said = verbs._held_to_account(named, account(np.array([3.0, -2.0, 1.0])), families)
    assert said.verdict is Verdict.UNKNOWN
    assert (said.effects, said.port) == ((), "wheel_normal")
    assert "wheel_normal" in said.sentence
    assert verbs._held_to_account(named, account(np.linspace(1.0, 3.0, 8)), families).verdict is Verdict.KNOWN
    assert verbs._held_to_account(named, account(np.zeros(0)), families) is named


def test_like_motions_share_what_a_law_is_off_by():
    """Two pivots share nearly all of it, straight drives and pivots next to nothing, whichever way they turn."""
    left = np.array([0.15, 0.17, 0.30, 0.24, -0.15])
    right = np.array([-0.15, -0.17, 0.30, 0.24, 0.15])
    columns = by_motion(left, right)
    covariance = columns @ columns.T
    np.testing.assert_allclose(np.diag(covariance), 1.0, atol=0.1)
    assert min(covariance[0, 1], covariance[2, 3]) > 0.8
    assert np.abs([covariance[0, 2], covariance[0, 4], covariance[2, 4]]).max() < 0.1


def test_half_of_a_laws_error_is_shared_by_recordings(model):
    """Windows of one motion share all of it within a recording, and half of it between recordings."""
    found = dataclasses.replace(drives(), log=np.arange(24) // 12)
    form = form_of(model, found)
    covariance = form._motions @ form._motions.T
    within, between = covariance[0, 6], covariance[0, 12]
    assert within == pytest.approx(1.0, abs=0.1)
    assert between == pytest.approx(0.5, abs=0.1)


def test_other_ground_raises_the_odds_of_what_belongs_to_it(model):
    problem = WindowProblem(drives(), model)
    splits = np.array(["fit"] * 24)
    observations = observe(problem, NOISE, [f"log {k}" for k in range(4)], splits)
    suspects = [s for s in coordinates.suspects_of(model) if s.name in SUSPECTS]
    settings = WindowSettings()

    def odds(other_ground):
        base = coordinates.baseline(model)
        form = WindowForm(lambda _: problem, base, suspects, observations, settings, other_ground)
        return {t.name: np.exp(t.log_prior) for t in form.terms if t.kind == EFFECT}

    usual, raised = odds(False), odds(True)
    assert list(usual.values()) == pytest.approx([settings.effect_odds] * len(usual))
    of_ground = {"rolling_resistance", "hard_ground.mu"}
    assert {n for n in usual if raised[n] > 2.0 * usual[n]} == of_ground
    assert sum(raised[n] for n in of_ground) == pytest.approx(settings.other_ground_odds)


def test_alone_a_model_predicts_better_than_with_differences_taken_out(model):
    """Where every recording differs by as much, the model alone has to take it up, and the refit leaves it to them."""
    found = measured(drives(), model, {"calibration.current_scale": -0.25}, np.random.default_rng(5))
    form = form_of(model, found)
    refit = form.refit(frozenset(), None, None)
    current = (form.observations.at[0] < 2) & form.fit

    def error(u):
        return float(np.sqrt(np.mean((form.observations.value - form.predicted(u))[current] ** 2)))

    assert error(form.alone(refit)) < 0.8 * error(refit.u)


def test_parts_held_out_are_spread_over_a_drive():
    held = held_out_parts(np.array([4.0, 0.0, 2.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 18.0]))
    np.testing.assert_array_equal(np.flatnonzero(held), [0, 5, 8])
    assert held_out_parts(np.arange(60.0)).mean() == pytest.approx(0.3)
    assert not held_out_parts(np.zeros(1)).any()


def test_what_is_named_is_not_called_hardly_told(monkeypatch):
    unknowns = [coordinates.Unknown("calibration", name, 1.0) for name in ("gyro_scale", "pitch", "gyro_scale")]
    form = SimpleNamespace(unknowns=unknowns, baseline=[0, 1], candidates={"calibration.gyro_scale": [2]})
    monkeypatch.setattr(verbs, "_posterior", lambda form, refit: {0: 0.9, 1: 0.9, 2: 0.1})
    assert verbs.not_told(form, None) == ["calibration.gyro_scale", "calibration.pitch"]
    assert verbs.not_told(form, None, ["calibration.gyro_scale"]) == ["calibration.pitch"]


def test_a_switch_between_grounds_is_shown_to_nobody():
    assert verbs._shown({"cohesion": 900.0, "instead": 1.0}) == {"cohesion": 900.0}
