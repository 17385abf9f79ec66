"""Canned manoeuvres: every one can be driven by both rovers; sides, ramps, turns on the spot and arrangements."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.manoeuvres import MANOEUVRES, Manoeuvre, commands, load_manoeuvre, with_arrangement
from lunar_mjx.model import Model, make_model
from lunar_mjx.simulate import joint_channels, simulate


@pytest.fixture(scope="module", params=("luvmi_x", "viper"))
def model(request: pytest.FixtureRequest) -> Model:
    return make_model(request.param, "flat")


@pytest.fixture(scope="module")
def luvmi() -> Model:
    return make_model("luvmi_x", "flat")


def test_the_manoeuvres_of_the_catalogue_are_there() -> None:
    wanted = {
        "rest_four_headings",
        "rest_in_shadow",
        "wheels_lifted",
        "cold_start",
        "stall_heat_soak",
        "speed_staircase",
        "square_wave",
        "slope",
        "slip_sweep",
        "three_passes",
        "crab_and_plough",
        "speed_staircase_payload",
        "square_wave_payload",
    }
    assert set(MANOEUVRES) == wanted


@pytest.mark.parametrize("name", MANOEUVRES)
def test_every_rover_can_drive_it(name: str, model: Model) -> None:
    plan = load_manoeuvre(name)
    assert 60.0 <= plan.duration_s <= 300.0 and plan.description and plan.separates
    own = with_arrangement(plan, model).replace(modes={"drive": plan.drive_mode})
    for scale in (1.0, 15.0 / plan.duration_s):
        moves = commands(plan, own, scale)
        assert len(moves.values) * moves.interval == pytest.approx(scale * plan.duration_s, abs=moves.interval)
        assert np.isfinite(moves.values).all()
        for column, joint in enumerate(own.rover.joints):
            low, high = own.rover.joint_limits[joint]
            assert low <= moves.values[:, column].min() and moves.values[:, column].max() <= high
    moved = np.ptp(commands(plan, own).values, axis=0).max()
    assert moved > 0.0, "something is commanded"
    np.testing.assert_array_equal(moves.values[0], 0.0)


def own_file(folder: Path, text: str) -> Manoeuvre:
    path = folder / "mine.toml"
    path.write_text('format = "lunar-mjx-manoeuvre/1"\n' + text)
    return load_manoeuvre(path)


def column(model: Model, joint: str) -> int:
    return joint_channels(model.rover).index(joint)


def test_sides_ramps_and_angles(luvmi: Model, tmp_path: Path) -> None:
    plan = own_file(
        tmp_path,
        """
[[segment]]
duration_s = 1.0
speed_m_s = { front = 0.1, left = 0.02 }
steer_deg = { left = 10.0, right = -10.0 }
[[segment]]
duration_s = 2.0
ramp_s = 1.0
speed_m_s = 0.3
""",
    )
    values = commands(plan, luvmi).values
    assert values.shape[0] == 60
    np.testing.assert_allclose(values[0, :4], [1.2, 1.0, 0.2, 0.0])
    assert values[0, column(luvmi, "lf_steer")] == pytest.approx(np.radians(10.0))
    assert values[0, column(luvmi, "rr_steer")] == pytest.approx(np.radians(-10.0))
    np.testing.assert_allclose(values[30, :4], 0.5 * (values[0, :4] + 3.0), atol=1e-9)
    np.testing.assert_allclose(values[40:, :4], 3.0)
    np.testing.assert_allclose(values[40:, 4:], 0.0, atol=1e-12)


def test_a_turn_on_the_spot(luvmi: Model, tmp_path: Path) -> None:
    plan = own_file(tmp_path, "[[segment]]\nduration_s = 1.0\nspin_deg_s = 12.0\n")
    values = commands(plan, luvmi).values[0]
    speed = np.radians(12.0) * np.hypot(0.37, 0.254) / 0.1
    np.testing.assert_allclose(values[:4], [-speed, speed, -speed, speed], rtol=1e-3)
    angles = [values[column(luvmi, f"{c}_steer")] for c in ("lf", "rf", "lr", "rr")]
    np.testing.assert_allclose(angles, [-0.52, 0.52, 0.52, -0.52])


STRAIGHT = "[[segment]]\nduration_s = 1.0\nspeed_m_s = 0.1\n"
REFUSED = {
    "no segment": ("", ["no [[segment]]"]),
    "unknown key": ("[[segment]]\nduration_s = 1.0\nvelocity = 2.0\n", ["segment 1.velocity", "unknown"]),
    "duration": ("[[segment]]\nduration_s = 0.0\n", ["duration_s = 0.0", "not positive"]),
    "ramp": ("[[segment]]\nduration_s = 1.0\nramp_s = 2.0\n", ["ramp_s = 2.0"]),
    "side": ("[[segment]]\nduration_s = 1.0\nspeed_m_s = { top = 1.0 }\n", ["top", "front"]),
    "mode": ("[[segment]]\nduration_s = 1.0\ncurrent_A = 1.0\n", ["current_A", "modes.drive"]),
    "arrangement": ("[arrangement.crane]\nlift = 1.0\n[[segment]]\nduration_s = 1.0\n", ["crane", "stand"]),
    "effects that are a number": (f"separates = 5\n{STRAIGHT}", ["separates = 5", "no list of texts"]),
    "effects that are one text": (f'separates = "slip"\n{STRAIGHT}', ["separates = 'slip'", "no list of texts"]),
    "payload below zero": (f"payload_share = -3.0\n{STRAIGHT}", ["payload_share = -3.0", "give 0 or more"]),
    "payload of a planet": (f"payload_share = 1e9\n{STRAIGHT}", ["payload_share = 1000000000.0", "5 at most"]),
    "terrain on two lines": (f'terrain = "a\\nb"\n{STRAIGHT}', ["terrain = 'a", "no name of a file"]),
    "wind": (f"{STRAIGHT}[environment]\nwind_m_s = 5.0\n", ["environment.wind_m_s", "sun_azimuth_deg"]),
    "surroundings below absolute zero": (
        f"{STRAIGHT}[environment]\nambient_temperature_degC = -300.0\n",
        ["environment.ambient_temperature_degC = -300.0", "no temperature in degC"],
    ),
    "Sun behind itself": (
        f"{STRAIGHT}[environment]\nsun_elevation_deg = 500.0\n",
        ["environment.sun_elevation_deg = 500.0", "90 at most"],
    ),
    "mode of steering": (f'{STRAIGHT}[modes]\nsteer = "velocity"\n', ["modes.steer", "use one of drive"]),
    "start of no map": (f"{STRAIGHT}[start]\nx_m = 1e300\n", ["start.x_m = 1e+300", "100000 at most"]),
    "heading without end": (f"{STRAIGHT}[start]\nyaw_deg = 1e300\n", ["start.yaw_deg = 1e+300", "360 at most"]),
    "segment that is a number": ("segment = [5]\n", ["segment = [5]", "no list of tables", "[[segment]]"]),
    "one segment in single brackets": ("[segment]\nduration_s = 1.0\n", ["segment", "no list of tables"]),
    "speed of no rover": (STRAIGHT.replace("0.1", "1e6"), ["segment 1.speed_m_s = 1000000.0", "10 at most"]),
    "speed of no rover on one side": (
        STRAIGHT.replace("0.1", "{ left = -1e6 }"),
        ["segment 1.speed_m_s.left = -1000000.0", "10 at most"],
    ),
    "steering without end": (f"{STRAIGHT}steer_deg = 1e300\n", ["segment 1.steer_deg = 1e+300", "360 at most"]),
    "spin without end": (f"{STRAIGHT}spin_deg_s = 1e300\n", ["segment 1.spin_deg_s = 1e+300", "360 at most"]),
    "current of no motor": (
        '[[segment]]\nduration_s = 1.0\ncurrent_A = 1e9\n[modes]\ndrive = "current"\n',
        ["segment 1.current_A = 1000000000.0", "200 at most"],
    ),
    "drive of ages": (STRAIGHT.replace("1.0", "1e12"), ["sum of duration_s", "above 50000 s"]),
    "drives of ages": (STRAIGHT.replace("1.0", "1e308") * 3, ["sum of duration_s = inf", "above 50000 s"]),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_files(case: str, tmp_path: Path) -> None:
    text, words = REFUSED[case]
    with pytest.raises(UserError) as caught:
        own_file(tmp_path, text)
    text = str(caught.value)
    assert text.startswith(str(tmp_path / "mine.toml")) and ";" in text and "\n" not in text
    for word in words:
        assert word in text, text


def test_refused_uses(luvmi: Model) -> None:
    with pytest.raises(UserError, match="moonwalk"):
        load_manoeuvre("moonwalk")
    with pytest.raises(UserError, match=r"control\.drive\.mode"):
        commands(load_manoeuvre("stall_heat_soak"), luvmi)
    with pytest.raises(UserError, match="positive number"):
        commands(load_manoeuvre("slope"), luvmi, 0.0)
    with pytest.raises(UserError, match=r"scale = 1000\.0 makes it \d+ s; give a smaller scale"):
        commands(load_manoeuvre("cold_start"), luvmi, 1000.0)


@pytest.mark.slow
def test_the_stand_lifts_the_wheels_and_they_turn_freely(luvmi: Model) -> None:
    plan = load_manoeuvre("wheels_lifted")
    model = with_arrangement(plan, luvmi)
    moves = commands(plan, model, 6.0 / plan.duration_s)
    _, seen = simulate(model, moves)
    late = np.asarray(seen.time) > 2.0
    assert np.abs(seen.wheel_force.z[late]).max() == 0.0, "no wheel touches the ground"
    height = seen.position.z - seen.position.z[0]
    assert height[late].min() > 0.1 and height[late].max() < 0.2
    tilt = np.abs(np.stack([seen.euler.x, seen.euler.y])[:, late]).max()
    assert tilt < 0.02, "level"
    wanted = moves.values[:, 0]
    assert np.abs(seen.joint_speed[:, 0] - wanted)[late].mean() < 0.1
    assert np.hypot(seen.position.x, seen.position.y)[late].max() < 0.01, "and in its place"
