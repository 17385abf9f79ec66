"""Every shipped rover: it runs in native MuJoCo, is what its README says, and its folder is in order."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from rover_ground import Drive

from lunar_mjx.resources import shipped
from lunar_mjx.rover import Rover, convert, list_rovers, load_rover

CORNERS = ("lf", "rf", "lr", "rr")
MASS = {"viper": 442.9, "luvmi_x": 50.0}
DOFS = {"viper": 26, "luvmi_x": 18}
LIMITS = {"viper": {"steer": 0.52, "suspension": 1.05}, "luvmi_x": {"steer": 0.52, "suspension": 0.7}}
LOOP_ERROR = 1e-4  # m


# -- It compiles and steps ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", sorted(shipped("models").glob("*/*.xml")), ids=lambda p: f"{p.parent.name}/{p.name}")
def test_compiles_and_steps_without_warnings(path: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    random = np.random.default_rng(0)
    while data.time < 1.0:
        data.ctrl[:] = random.uniform(-1, 1, model.nu)
        mujoco.mj_step(model, data)
    assert not data.warning.number.any()
    assert np.isfinite(data.qpos).all()


def test_scene_lets_the_rover_stand(rover: Rover) -> None:
    model = mujoco.MjModel.from_xml_path(str(rover.folder / "scene.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 1500)
    assert data.ncon >= 4
    assert data.qpos[2] == pytest.approx(rover.standing_height, abs=0.02)


# -- It is what it says ---------------------------------------------------------------------------------------------


def test_list_rovers_names_both() -> None:
    assert set(list_rovers()) >= {"viper", "luvmi_x"}


def test_mass_dofs_and_wheels(rover: Rover) -> None:
    model = rover.compile()
    assert rover.mass == pytest.approx(MASS[rover.name], rel=1e-12)
    assert model.body_mass.sum() == pytest.approx(rover.mass, rel=1e-9)
    assert model.nv == DOFS[rover.name]
    assert model.neq == len(rover.loops) == (4 if rover.name == "viper" else 0)
    assert tuple(w.corner for w in rover.wheels) == CORNERS
    assert tuple(w.body for w in rover.wheels) == tuple(f"{c}_wheel" for c in CORNERS)
    assert rover.notes == ()


def test_viper_has_the_published_masses() -> None:
    model = load_rover("viper").compile()
    for corner in CORNERS:
        assert model.body(f"{corner}_wheel").mass[0] == pytest.approx(11.05)
        assert model.body(f"{corner}_upper_arm").mass[0] == pytest.approx(2.71)
        assert model.body(f"{corner}_lower_arm").mass[0] == pytest.approx(6.96)
        steering = model.body(f"{corner}_upright").mass[0] + model.body(f"{corner}_knuckle").mass[0]
        assert steering == pytest.approx(4.80)
    assert model.body("chassis").mass[0] == pytest.approx(341, abs=0.2)


def test_joints_actuators_and_limits(rover: Rover) -> None:
    expected = tuple(f"{c}_{g}" for g in ("drive", "steer", "suspension") for c in CORNERS)
    model = rover.compile()
    assert rover.joints == expected
    assert tuple(model.actuator(i).name for i in range(model.nu)) == expected
    assert [model.actuator(i).trnid[0] for i in range(model.nu)] == [model.joint(j).id for j in expected]
    np.testing.assert_array_equal(model.actuator_gear[:, 0], 1.0)
    np.testing.assert_array_equal(model.actuator_gainprm[:, 0], 1.0)
    assert not model.actuator_biasprm.any()
    for wheel in rover.wheels:
        assert rover.joint_limits[wheel.drive] == (-np.inf, np.inf)
        for group in ("steer", "suspension"):
            bound = LIMITS[rover.name][group]
            assert rover.joint_limits[getattr(wheel, group)] == (-bound, bound)


def test_equalities_are_the_only_constraints(rover: Rover) -> None:
    model = rover.compile()
    for flag in (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_LIMIT):
        assert model.opt.disableflags & flag
    assert not model.jnt_limited.any()
    assert not model.dof_frictionloss.any()
    assert (model.opt.iterations, model.opt.ls_iterations, model.opt.timestep) == (1, 1, 0.002)


def test_armature_is_the_reflected_rotor_inertia(rover: Rover) -> None:
    model = rover.compile()
    for group in rover.groups:
        for joint in group.joints:
            armature = model.dof_armature[model.joint(joint).dofadr[0]]
            assert armature == pytest.approx(group.rotor_inertia * group.gear_ratio**2, rel=1e-9)


def test_inertias_are_those_of_uniform_primitives(rover: Rover) -> None:
    for link in ET.parse(rover.folder / f"{rover.name}.urdf").getroot().iter("link"):
        inertial, shape = link.find("inertial"), link.find("collision/geometry/*")
        assert inertial is not None and shape is not None
        mass = float(inertial.find("mass").get("value"))
        found = [float(inertial.find("inertia").get(k)) for k in ("ixx", "iyy", "izz")]
        if shape.tag == "box":
            x, y, z = (float(v) for v in shape.get("size", "").split())
            expected = [mass / 12 * s for s in (y * y + z * z, x * x + z * z, x * x + y * y)]
        else:
            r, length = float(shape.get("radius", "")), float(shape.get("length", ""))
            across, along = mass / 12 * (3 * r * r + length * length), mass / 2 * r * r
            lies_along_y = link.get("name", "").endswith("wheel")
            expected = [across, along, across] if lies_along_y else [across, across, along]
        np.testing.assert_allclose(found, expected, rtol=1e-5, err_msg=link.get("name", ""))


def test_agrees_with_mujocos_own_urdf_import(rover: Rover, tmp_path: Path) -> None:
    """A second reading of the same file: masses, inertias and places must be the same."""
    text = (rover.folder / f"{rover.name}.urdf").read_text()
    text = text.replace(
        f'<robot name="{rover.name}">',
        f'<robot name="{rover.name}"><mujoco><compiler fusestatic="false"/></mujoco><link name="world"/>'
        '<joint name="free" type="floating"><parent link="world"/><child link="chassis"/></joint>',
    )
    theirs = mujoco.MjModel.from_xml_string(text)
    ours = rover.compile()
    assert theirs.body_mass.sum() == pytest.approx(ours.body_mass.sum(), rel=1e-9)
    data = [mujoco.MjData(theirs), mujoco.MjData(ours)]
    data[1].qpos[:3] = 0
    for model, state in zip((theirs, ours), data, strict=True):
        mujoco.mj_forward(model, state)
    np.testing.assert_allclose(data[0].subtree_com[1], data[1].subtree_com[1], atol=1e-9)
    for i in range(2, ours.nbody):  # body 1 is the chassis, whose fixed links are fused in ours
        name = ours.body(i).name
        np.testing.assert_allclose(data[0].body(name).xpos, data[1].body(name).xpos, atol=1e-9)
        np.testing.assert_allclose(
            np.sort(theirs.body(name).inertia), np.sort(ours.body(name).inertia), rtol=1e-9, atol=1e-12
        )
    fused = [theirs.body(n).id for n in ("chassis", *(s.name for s in rover.spec().body("chassis").sites))]
    assert theirs.body_mass[fused].sum() == pytest.approx(ours.body("chassis").mass[0], rel=1e-9)


# -- Signs and stance -----------------------------------------------------------------------------------------------


def test_wheels_just_touch_at_the_standing_height(rover: Rover) -> None:
    model = rover.compile()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    assert data.body(rover.chassis).xpos[2] == pytest.approx(rover.standing_height)
    for wheel in rover.wheels:
        assert data.body(wheel.body).xpos[2] == pytest.approx(wheel.radius, abs=1e-9)
    assert rover.chassis_points.shape == (16, 3)
    assert rover.chassis_points[:, 2].min() + rover.standing_height > 0.1  # ground clearance
    assert rover.chassis_points[:, 2].max() > 3 * rover.wheels[0].radius  # the top is there: roll-over is caught


def test_positive_joints_do_what_the_frames_say(rover: Rover) -> None:
    model = rover.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for wheel in rover.wheels:
        body = model.body(wheel.body).id
        spin, move = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        contact = data.xpos[body] - [0, 0, wheel.radius]
        mujoco.mj_jac(model, data, move, spin, contact, body)
        columns = {g: model.joint(getattr(wheel, g)).dofadr[0] for g in ("drive", "steer", "suspension")}
        assert move[0, columns["drive"]] == pytest.approx(-wheel.radius)  # the rim goes back, the rover forward
        np.testing.assert_allclose(spin[:, columns["steer"]], [0, 0, 1], atol=1e-12)
        assert move[2, columns["suspension"]] < -0.1


def test_stands_level_on_its_springs_alone(rover: Rover) -> None:
    drive = Drive(rover)
    for _ in range(4000):
        drive.step()
    assert np.abs(drive.angles("suspension")).max() < 2e-3
    np.testing.assert_allclose(drive.data.qpos[4:6], 0, atol=1e-3)
    assert np.abs(drive.data.qvel).max() < 1e-3


def test_drives_forward_and_turns_left(rover: Rover) -> None:
    drive = Drive(rover)
    steer = np.array([0.2, 0.2, -0.2, -0.2])
    for _ in range(2000):
        drive.command(drive=1.5 * min(drive.data.time, 1.0), steer=steer, suspension=0.0)
        drive.step()
    yaw = 2 * np.arctan2(drive.data.qpos[6], drive.data.qpos[3])
    assert drive.data.qpos[0] > 0.1
    assert yaw > 0.05
    np.testing.assert_allclose(drive.angles("steer"), steer, atol=0.02)
    assert np.abs(drive.angles("suspension")).max() < 0.01


def test_positive_suspension_lifts_the_chassis_and_keeps_uprights_upright(rover: Rover) -> None:
    drive = Drive(rover)
    for _ in range(2500):
        drive.command(drive=0.0, steer=0.0, suspension=0.3 * min(drive.data.time / 2, 1.0))
        drive.step()
    reach = 0.32 if rover.name == "viper" else 0.18
    assert drive.data.qpos[2] - rover.standing_height == pytest.approx(reach * np.sin(0.3), rel=0.15)
    if rover.name == "viper":  # the four-bar carries the upright parallel to the chassis
        for corner in CORNERS:
            upright, chassis = drive.data.body(f"{corner}_upright"), drive.data.body("chassis")
            np.testing.assert_allclose(upright.xmat, chassis.xmat, atol=1e-3)


@pytest.mark.slow
def test_loops_stay_closed_under_twenty_seconds_of_drive() -> None:
    rover = load_rover("viper")
    drive = Drive(rover, bump=0.06)
    twist = np.array([1, -1, -0.5, 0.5])
    while drive.data.time < 20:
        t = drive.data.time
        speed = 0.8 * min(t, 1.0) * (1 if t < 12 else -1)  # reversed at once, the hardest pull on the arms
        steer = 0.3 * np.sin(0.5 * t) * np.array([1, 1, -1, -1])
        drive.command(drive=speed, steer=steer, suspension=0.2 * np.sin(0.7 * t) * twist)
        drive.step()
    assert drive.worst_loop_error < LOOP_ERROR
    assert drive.worst_loop_error > 0  # it was measured
    assert not drive.data.warning.number.any()


def test_explicit_gains_are_stable(rover: Rover) -> None:
    """Gains act as an explicit torque: kd dt / I and kp dt^2 / I stay below one, I being what the joint feels."""
    model = rover.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    dt = model.opt.timestep
    for group in rover.groups:
        for joint in group.joints:
            unit, response = np.zeros((1, model.nv)), np.zeros((1, model.nv))
            dof = model.joint(joint).dofadr[0]
            unit[0, dof] = 1
            mujoco.mj_solveM(model, data, response, unit)
            assert group.velocity_gain * dt * response[0, dof] < 0.9
            assert group.position_gain * dt**2 * response[0, dof] < 0.2


# -- The folder is in order -----------------------------------------------------------------------------------------


def test_conversion_reproduces_the_committed_files(rover: Rover, tmp_path: Path) -> None:
    convert(rover.folder / f"{rover.name}.urdf", tmp_path)
    for name in (f"{rover.name}.xml", "scene.xml", "rover.toml"):
        assert (tmp_path / name).read_text() == (rover.folder / name).read_text(), f"convert {rover.name} again"


def test_folder_layout(rover: Rover, models: Path) -> None:
    expected = {
        f"{rover.name}.urdf",
        f"{rover.name}.rover.toml",
        f"{rover.name}.xml",
        "scene.xml",
        "rover.toml",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "look.toml",
        "policy.npz",
        "POLICY.md",
    }
    # policies of other trainings, with their cards
    others = ("ladder-3", "escape") if rover.name == "luvmi_x" else ()
    expected |= {f"{name}.{end}" for name in others for end in ("npz", "md")}
    assert {p.name for p in rover.folder.iterdir()} == expected
    assert re.fullmatch(r"[a-z][a-z0-9_]*", rover.name)
    assert rover.folder == models / rover.name
    readme = (rover.folder / "README.md").read_text()
    assert re.search(r"^## .*derivation", readme, re.MULTILINE | re.IGNORECASE)
    assert re.search(r"^1\. ", readme, re.MULTILINE)
    assert "Apache License" in (rover.folder / "LICENSE").read_text()


def test_xml_formatting(rover: Rover) -> None:
    for path in (rover.folder / f"{rover.name}.xml", rover.folder / "scene.xml", rover.folder / f"{rover.name}.urdf"):
        text = path.read_text()
        root = ET.fromstring(text)
        assert root.tag in ("mujoco", "robot")
        assert text.endswith(">\n") and "\t" not in text and "\r" not in text
        assert not re.search(r" +$", text, re.MULTILINE), "trailing blanks"
        for line in text.splitlines():
            assert (len(line) - len(line.lstrip())) % 2 == 0, line
    names = [e.get("name") for e in ET.parse(rover.mjcf).iter() if e.get("name")]
    assert all(re.fullmatch(r"[a-z][a-z0-9_]*", n) for n in names if n)
