"""Drives of the foreign worlds: rovers stand, drive, climb and turn as physics wants, and their logs can be read."""

from __future__ import annotations

import dataclasses
import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.foreign.drives import cases
from benchmarks.foreign.drives.rollout import Ground, Motors, Setup, simulate, wheel_forces
from benchmarks.foreign.drives.rovers import CORNERS, ROVERS, Build, mjcf
from benchmarks.foreign.wheel import Rows, World, run

LUVMI = ROVERS["luvmi_x"]
SOIL = {
    "reece_c": 10.0,
    "reece_phi": 220.0,
    "unit_weight": 2600.0,
    "exponent": 0.9,
    "cohesion": 200.0,
    "friction_angle": 0.6,
    "shear_x": 0.012,
    "shear_y": 0.015,
}
LOAD = LUVMI.mass * LUVMI.gravity / 4.0


def world(**effects: dict[str, float]) -> World:
    return World("integral", LUVMI.radius, LUVMI.width, SOIL, {}, None, LOAD, effects)


def ground(slope_deg: float = 0.0) -> Ground:
    return Ground(np.radians(slope_deg), np.zeros((1, 2)), np.zeros(1), np.zeros(1))


def straight(t: float) -> tuple[np.ndarray, np.ndarray]:
    return np.full(4, 1.5 * min(max(t - 0.3, 0.0) / 0.3, 1.0)), np.zeros(4)


def left(t: float) -> tuple[np.ndarray, np.ndarray]:
    return straight(t)[0], 0.3 * np.array([1.0, 1.0, -1.0, -1.0])


def setup(command=straight, slope_deg: float = 0.0) -> Setup:
    return Setup(Build(), Motors(), ground(slope_deg), command, {}, 8e4)


@pytest.fixture(scope="module")
def driven() -> dict[str, np.ndarray]:
    """On the level, up a slope, and to the left."""
    return simulate(LUVMI, world(), [setup(), setup(slope_deg=6.0), setup(left)], 1.6)


@pytest.mark.parametrize("name", ROVERS)
def test_a_rover_weighs_what_it_should(name: str) -> None:
    rover = ROVERS[name]
    model = mujoco.MjModel.from_xml_string(mjcf(rover, Build(mass=1.1)))
    assert model.body_mass.sum() == pytest.approx(1.1 * rover.mass, rel=1e-3)
    assert model.nu == 0
    assert model.nv == 6 + (12 if rover.steered else 4)


def test_it_stands_before_it_drives(driven: dict[str, np.ndarray]) -> None:
    rest = driven["time"][0] < 0.25
    np.testing.assert_allclose(driven["accelerometer"][0, rest], [[0.0, 0.0, LUVMI.gravity]] * rest.sum(), atol=0.05)
    assert np.ptp(driven["position"][0, rest, 0]) < 1e-3
    # What the wheels bear is the rover's weight: sinkage is the bed's at its load, slip and speed zero.
    bed = run(world(), Rows(*(np.array([v]) for v in (0.0, 0.0, LOAD, 0.05, LUVMI.gravity))))
    assert driven["sinkage"][0, rest].mean() == pytest.approx(bed.sinkage[0], rel=0.15)


def test_it_drives_forward_climbs_slower_and_turns_left(driven: dict[str, np.ndarray]) -> None:
    gone = driven["position"][:, -1] - driven["position"][:, 0]
    assert 0.05 < gone[1, 0] < gone[0, 0] < 1.5 * 0.1 * 1.3
    assert abs(gone[0, 1]) < 1e-3
    assert gone[1, 2] == pytest.approx(np.tan(np.radians(6.0)) * gone[1, 0], abs=0.004)
    assert driven["slip"][1, -1].mean() > driven["slip"][0, -1].mean() > 0.0
    assert driven["current"][1, -1].mean() > driven["current"][0, -1].mean() > 0.0
    assert driven["gyro"][2, -1, 2] > 0.02


def test_motors_give_more_than_the_drive_takes(driven: dict[str, np.ndarray]) -> None:
    electric = np.sum(driven["voltage"] * driven["current"], axis=-1)
    climbed = LUVMI.mass * LUVMI.gravity * (driven["position"][1, -1, 2] - driven["position"][1, 0, 2])
    assert 0.01 * np.sum(electric[1]) > climbed > 0.0


def test_a_wheel_of_a_rover_meets_the_forces_of_the_bed() -> None:
    """Steady rolling through the rover's code gives what the bed measures at that sinkage."""
    at = Rows(*(np.array([v]) for v in (0.3, np.radians(15.0), LOAD, 0.1, LUVMI.gravity)))
    bed = run(world(), at)
    along, across = 0.1 * np.cos(at.angle), 0.1 * np.sin(at.angle)
    soil = {k: np.array([[v]]) for k, v in SOIL.items()}
    for way in (1.0, -1.0):
        found = wheel_forces(
            world(),
            soil,
            way * along / 0.7,
            way * along,
            across,
            np.array([0.1]),
            bed.sinkage,
            np.ones(1),
            LUVMI.gravity,
            1e-6,
        )  # rolling either way
        np.testing.assert_allclose(found[0], LOAD, rtol=1e-6)
        np.testing.assert_allclose(found[1], way * bed.drawbar_pull, rtol=1e-6)
        np.testing.assert_allclose(found[2], -bed.side_force, rtol=1e-6)
        np.testing.assert_allclose(found[3], way * bed.driving_torque, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "amounts", "quantity", "sign"),
    [
        ("coulomb_friction", {"torque": 0.3}, "current", 1),
        ("voltage_saturation", {"bus": 15.0}, "drive_speed", -1),
        ("spooling_cable", {"per_metre": 60.0}, "position", -1),
        ("backlash", {"half_gap": 0.03, "stiffness": 1200.0, "damping": 2.0}, "drive_angle", -1),
    ],
)
def test_effects_push_the_right_way(driven, name: str, amounts: dict[str, float], quantity: str, sign: int) -> None:
    one = setup()
    if name == "backlash":
        one = dataclasses.replace(one, build=Build(rotor_share=0.02))
    there = simulate(LUVMI, world(**{name: amounts}), [one], 1.6)
    bare, with_it = (found[quantity][0, -30:].reshape(30, -1)[:, 0].mean() for found in (driven, there))
    assert sign * (with_it - bare) > 0.01 * abs(bare)


def test_campaigns_are_planned_drawn_and_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cases, "SECONDS", 0.4)
    report = cases.plan("report", 60)
    assert {h for _, hidden, _ in report for h in hidden} == set(cases.REPORT_KNOWN + cases.REPORT_OUTSIDE)
    assert not set(cases.TUNE_OUTSIDE) & set(cases.REPORT_OUTSIDE)
    for number, job in enumerate(report):
        assert cases.draw("report", 1, number, *job).hidden == job[1]
    case = cases.draw("tune", 1, 0, "single", ("imu_bias",), "luvmi_x")
    found = simulate(case.rover, case.world, case.setups, 0.4)
    cases.write(case, found, tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(cases.SPLITS)
    about = tomllib.loads((tmp_path / "climb" / "log.toml").read_text(encoding="utf-8"))
    assert about["rover"] == "luvmi_x" and about["terrain"] == "slope:6deg"
    head = (tmp_path / "climb" / "drive.csv").read_text(encoding="utf-8").splitlines()[0].split(",")
    assert {f"command_{c}_drive_speed_rad_s" for c in CORNERS} < set(head)
    assert set(about["noise"]) > {c for c in head if c.startswith(("joint", "motor", "position"))}
    assert "imu_bias" not in "".join(p.read_text(encoding="utf-8") for p in tmp_path.rglob("*.*"))
