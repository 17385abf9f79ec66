"""Windows of drives with imposed wheel speeds: cutting, prediction, and what is named of a planted change."""

import dataclasses

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.windows import coordinates, judge
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, Cut, cut
from lunar_mjx.diagnosis.drives.windows.problem import Noise, WindowProblem, corners, learn_noise
from lunar_mjx.diagnosis.drives.windows.verbs import fitted_model
from lunar_mjx.dynamics.imposed import Windows
from lunar_mjx.logs import read_campaign
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.resources import shipped

RADIUS, SAMPLES, INTERVAL = 0.165, 8, 0.15
NOISE = (Noise(0.25, 0.0, 1.0), Noise(0.25, 0.0, 1.0), Noise(0.01, 0.0, 1.0))


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
    return Cut(number, np.arange(count) * 2.0, INTERVAL, Windows(speed, *up, yaw), measured, frozenset(), count)


def measured(found, model, changes, rng, magnitude=True):
    """The windows as a rover with changed values would have measured them."""
    found = dataclasses.replace(found, magnitude=frozenset(CHANNELS[:2]) if magnitude else frozenset())
    problem = WindowProblem(found, model)
    unknowns = tuple(coordinates.Unknown(*key.split("."), std=1.0) for key in changes)
    row = np.array([[v - problem.begin(q) for q, v in zip(unknowns, changes.values(), strict=True)]])
    truth = problem.predict(unknowns, row)[0]
    values = {c: truth[k] + rng.normal(0.0, NOISE[k].std, truth[k].shape) for k, c in enumerate(CHANNELS)}
    return dataclasses.replace(found, measured=values)


def weigh(model, found, names):
    """Probability of hypotheses of one suspect, against a model whose parameters are known to a tenth."""
    known = {
        q.key: (coordinates.start_of(model, q), 0.1 * q.std * (coordinates.start_of(model, q) if q.factor else 1.0))
        for q in coordinates.baseline(model)
    }
    model = dataclasses.replace(model, priors=known)
    problem = WindowProblem(found, model)
    split = judge.Split(np.ones(len(found), bool), np.zeros(len(found), bool))
    base = coordinates.baseline(model)
    suspects = [s for s in coordinates.suspects_of(model) if s.name in names]
    hypotheses = [judge.fit(problem, base, s, NOISE, split) for s in [(), *((s,) for s in suspects)]]
    return judge.probabilities(hypotheses), hypotheses


SUSPECTS = ("rolling_resistance", "hard_ground.mu", "payload", "calibration.current_left", "calibration.pitch")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"rolling_resistance.coefficient": 0.12}, "rolling_resistance"),
        ({"hard_ground.mu": 0.15}, "hard_ground.mu"),
        ({"calibration.current_left": -0.2}, "calibration.current_left"),
    ],
)
def test_a_planted_change_is_named(model, changes, name):
    chance, found = weigh(model, measured(drives(), model, changes, np.random.default_rng(1)), SUSPECTS)
    assert max(chance, key=chance.get) == name
    assert chance[name] > 0.95
    best = next(f for f in found if f.name == name)
    key, value = next(iter(changes.items()))
    at = [q.key for q in best.unknowns].index(key)
    q = best.unknowns[at]
    start = coordinates.start_of(model, q) if q.effect in model.effect_names else 0.0
    assert float(q.value(start, best.u[at])) == pytest.approx(value, rel=0.25)


def test_nothing_is_named_where_nothing_is_missing(model):
    chance, _ = weigh(model, measured(drives(), model, {"hard_ground.mu": 0.6}, np.random.default_rng(2)), SUSPECTS)
    assert chance["the model"] > 0.7


def test_noise_is_told_from_residuals():
    rng = np.random.default_rng(3)
    truth = Noise(0.5, 0.9, 1.0)
    block = rng.standard_normal((200, 13)) @ truth.factor(13, 0.15).T
    found = learn_noise(block[None], np.ones((1, 200), bool), 0.15)[0]
    assert found.share >= 0.7
    assert found.std == pytest.approx(0.5, rel=0.2)


def test_priors_survive_the_file(model, tmp_path):
    known = dataclasses.replace(model, priors={"hard_ground.mu": (0.6, 0.05), "calibration.pitch": (0.4, 0.2)})
    again = load_model(save_model(known, tmp_path / "model.toml"))
    assert again.priors == known.priors
    base = {q.key: q for q in coordinates.baseline(again)}
    assert base["hard_ground.mu"].std == pytest.approx(0.05 / 0.6)
    assert base["calibration.pitch"].std == pytest.approx(0.2)


def test_a_fit_teaches_priors(model):
    found = measured(drives(), model, {"hard_ground.mu": 0.6}, np.random.default_rng(4))
    split = judge.Split(np.ones(len(found), bool), np.zeros(len(found), bool))
    fitted = judge.fit(WindowProblem(found, model), coordinates.baseline(model), (), NOISE, split)
    taught = fitted_model(model, fitted)
    value, std = taught.priors["hard_ground.mu"]
    assert value == taught.parameters["hard_ground"]["mu"] == pytest.approx(0.6, rel=0.1)
    assert 0.0 < std < 0.35 * value


def test_logs_are_cut_where_speeds_are(tmp_path):
    """A gap of a second ends a window, and the accelerometer tells the slope."""
    log = tmp_path / "drive"
    log.mkdir()
    time = np.concatenate([np.arange(40) * 0.1, 5.0 + np.arange(30) * 0.1])
    rows = [f"{t:.3f},{2.0},{2.0},{3.0},{3.1},{1.7},{0.0},{9.66},{0.01}" for t in time]
    header = (
        "time_s,joint_left_drive_speed_rad_s,joint_right_drive_speed_rad_s,motor_left_drive_current_A,"
        "motor_right_drive_current_A,accelerometer_x_m_s2,accelerometer_y_m_s2,accelerometer_z_m_s2,gyro_z_rad_s"
    )
    (log / "drive.csv").write_text("\n".join([header, *rows]) + "\n")
    (log / "log.toml").write_text(
        'format = "lunar-mjx-log/1"\nrover = "husky"\nmanoeuvre = "straight"\ngravity_m_s2 = 9.81\n'
        'imposed = "wheel_speed"\n[tables.drive]\nfile = "drive.csv"\nrate_hz = 10.0\n'
    )
    model = load_model(shipped("models") / "husky" / "hard_floor.toml")
    found = cut(read_campaign([log]), corners(model), RADIUS, 10)
    np.testing.assert_allclose(found.start_s, [0.0, 2.0, 5.0], atol=1e-9)
    slope = np.arctan2(np.asarray(found.imposed.up_x), np.asarray(found.imposed.up_z))
    np.testing.assert_allclose(np.degrees(slope), 9.98, atol=0.1)
    np.testing.assert_allclose(found.measured[CHANNELS[0]], 3.0)
