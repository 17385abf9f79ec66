"""Conversion of URDFs that were not written for this converter."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rover_ground import Drive

from lunar_mjx.rover import Rover, convert, load_rover

CORNERS = ("lf", "rf", "lr", "rr")


@pytest.fixture
def skid_steer(data: Path, tmp_path: Path) -> Rover:
    return convert(data / "skid_steer.urdf", tmp_path)


@pytest.fixture
def steered(data: Path, tmp_path: Path) -> Rover:
    return convert(data / "steered.urdf", tmp_path)


def test_skid_steer_keeps_all_mass_and_finds_its_wheels(skid_steer: Rover) -> None:
    assert skid_steer.mass == pytest.approx(45.5 + 1.25 + 4 * 2.637, rel=1e-12)
    assert skid_steer.chassis == "base_link"
    assert skid_steer.standing_height == pytest.approx(0.165 - 0.03282)
    assert [w.corner for w in skid_steer.wheels] == list(CORNERS)
    assert [w.body for w in skid_steer.wheels] == [
        f"{row}_{side}_wheel_link" for row in ("front", "rear") for side in ("left", "right")
    ]
    assert {(w.radius, w.width, w.steer, w.suspension) for w in skid_steer.wheels} == {(0.165, 0.1143, None, None)}
    assert [g.name for g in skid_steer.groups] == ["drive"]
    assert skid_steer.compile().nv == 10


def test_skid_steer_centre_of_mass_is_that_of_its_links(skid_steer: Rover) -> None:
    model = skid_steer.compile()
    body, lidar = np.array([-0.01, 0.002, 0.07]), np.array([0.3, 0, 0.35])
    expected = (45.5 * body + 1.25 * lidar) / 46.75
    np.testing.assert_allclose(model.body("base_link").ipos, expected, atol=1e-12)
    sites = {s.name for s in skid_steer.spec().sites}
    assert sites == {"base_footprint", "inertial_link", "lidar_mount", "camera_optical_frame"}


def test_reversed_axes_are_mended_and_said(skid_steer: Rover, steered: Rover) -> None:
    assert [n.split("'")[1] for n in skid_steer.notes if "axis" in n] == ["front_right_wheel", "rear_right_wheel"]
    text = " ".join(steered.notes)
    assert "FrontRightForkJoint': axis reversed so that positive steers to the left" in text
    assert "BackLeftArmJoint': axis reversed so that positive raises the chassis" in text
    # A reversed axis takes its limits along.
    assert steered.joint_limits["FrontLeftForkJoint"] == (-0.5, 0.9)
    assert steered.joint_limits["FrontRightForkJoint"] == (-0.9, 0.5)
    assert steered.joint_limits["BackLeftArmJoint"] == (-0.6, 0.4)


def test_steered_roles_and_wheel_frames(steered: Rover) -> None:
    for wheel, name in zip(steered.wheels, ("FrontLeft", "FrontRight", "BackLeft", "BackRight"), strict=True):
        assert (wheel.drive, wheel.steer, wheel.suspension) == tuple(
            f"{name}{part}Joint" for part in ("Wheel", "Fork", "Arm")
        )
    model = steered.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for wheel in steered.wheels:  # whatever the file's frames, y is the axle and z is up
        np.testing.assert_allclose(data.body(wheel.body).xmat.reshape(3, 3), np.eye(3), atol=1e-6)
        np.testing.assert_allclose(model.joint(wheel.drive).axis, [0, 1, 0], atol=1e-6)
        np.testing.assert_allclose(data.body(wheel.body).xpos[2], wheel.radius, atol=1e-9)


@pytest.mark.parametrize("name", ["skid_steer", "steered", "rocker_bogie"])
def test_drives_forward_under_inferred_gains(name: str, data: Path, tmp_path: Path) -> None:
    rover = convert(data / f"{name}.urdf", tmp_path)
    drive = Drive(rover)
    for _ in range(2000):
        drive.command(drive=2.0 * min(drive.data.time, 1.0), steer=0.0, suspension=0.0)
        drive.step()
    assert drive.data.qpos[0] > 0.3
    assert abs(drive.data.qpos[1]) < 0.1 * drive.data.qpos[0]
    assert np.isfinite(drive.data.qpos).all() and not drive.data.warning.number.any()
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, drive.data.qpos[3:7])
    assert np.arccos(turned[8]) < np.deg2rad(2.0)  # rocker_bogie.rover.toml has its differential
    if "suspension" in drive.q:
        assert np.abs(drive.angles("suspension")).max() < 0.05


def test_rocker_bogie_has_six_wheels_and_passive_pivots(data: Path, tmp_path: Path) -> None:
    rover = convert(data / "rocker_bogie.urdf", tmp_path)
    assert [w.corner for w in rover.wheels] == ["lf", "rf", "lm", "rm", "lr", "rr"]
    assert {w.suspension for w in rover.wheels} == {None}
    assert sum("left passive" in n for n in rover.notes) == 4
    assert len(rover.joints) == 6


def test_folder_can_be_loaded_from_any_path(steered: Rover) -> None:
    again = load_rover(steered.folder)
    assert (again.wheels, again.groups, again.joint_limits) == (steered.wheels, steered.groups, steered.joint_limits)
    np.testing.assert_array_equal(again.chassis_points, steered.chassis_points)


def test_name_and_description_are_taken(data: Path, tmp_path: Path) -> None:
    told = tmp_path / "told.toml"
    told.write_text('name = "told"\n[joints.drive]\nvelocity_gain = 7.5\nwinding = 24\n')
    rover = convert(data / "skid_steer.urdf", tmp_path / "a", told)
    assert (rover.name, rover.mjcf.name) == ("told", "told.xml")
    assert (rover.groups[0].velocity_gain, rover.groups[0].winding) == (7.5, 24)
    assert convert(data / "skid_steer.urdf", tmp_path / "b", told, name="other").name == "other"


def test_description_beside_the_urdf_is_found(data: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.urdf").write_text((data / "skid_steer.urdf").read_text())
    (tmp_path / "mine.rover.toml").write_text('name = "beside"\n')
    assert convert(tmp_path / "mine.urdf", tmp_path / "out").name == "beside"


def test_wheels_without_a_cylinder_take_the_described_radius(data: Path, tmp_path: Path) -> None:
    urdf = tmp_path / "mesh.urdf"
    text = (data / "steered.urdf").read_text()
    urdf.write_text(text.replace('<cylinder radius="0.12" length="0.09"/>', '<mesh filename="package://x/wheel.stl"/>'))
    names = ("FrontLeft", "FrontRight", "BackLeft", "BackRight")
    wheels = "".join(f'[[wheels]]\nlink = "{n}Wheel"\nradius = 0.13\nwidth = 0.1\n' for n in names)
    (tmp_path / "mesh.rover.toml").write_text(wheels)
    rover = convert(urdf, tmp_path / "out")
    assert {(w.radius, w.width) for w in rover.wheels} == {(0.13, 0.1)}
    assert any("mesh was left out" in n for n in rover.notes)


def test_world_link_above_a_floating_base_is_dropped(data: Path, tmp_path: Path) -> None:
    urdf = tmp_path / "floating.urdf"
    text = (data / "skid_steer.urdf").read_text()
    joint = '<joint name="f" type="floating"><parent link="world"/><child link="base_footprint"/></joint>'
    urdf.write_text(text.replace("</robot>", f'<link name="world"/>{joint}</robot>'))
    rover = convert(urdf, tmp_path / "out")
    assert rover.compile().nv == 10
    assert rover.mass == pytest.approx(57.298)


def test_a_visual_cylinder_stands_in_for_a_collision_mesh(data: Path, tmp_path: Path) -> None:
    mesh = '<collision><geometry><mesh filename="package://x/wheel.stl"/></geometry></collision>'
    text = re.sub(r"<(/?)collision>", r"<\1visual>", (data / "steered.urdf").read_text())
    urdf = tmp_path / "mesh.urdf"
    urdf.write_text(text.replace("</link>", f"{mesh}</link>"))
    rover = convert(urdf, tmp_path / "out")
    assert {(w.radius, w.width) for w in rover.wheels} == {(0.12, 0.09)}


def test_a_joint_without_a_role_is_named(data: Path, tmp_path: Path) -> None:
    mast = (
        '<link name="mast"><inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/>'
        '</inertial></link><joint name="pan" type="revolute"><parent link="Body"/><child link="mast"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1"/></joint>'
    )
    urdf = tmp_path / "mast.urdf"
    urdf.write_text((data / "steered.urdf").read_text().replace("</robot>", f"{mast}</robot>"))
    rover = convert(urdf, tmp_path / "out")
    assert [n for n in rover.notes if "'pan'" in n and "no motor" in n]
    assert not [n for n in convert(data / "steered.urdf", tmp_path / "plain").notes if "no motor" in n]
