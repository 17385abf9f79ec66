"""Every mistake in a rover's files is told in one sentence that names the file, the field, the value and the remedy."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert, load_rover

BODY_INERTIA = 'ixx="0.5" ixy="0" ixz="0" iyy="1.3" iyz="0" izz="1.6"'
CYLINDER = '<cylinder radius="0.12" length="0.09"/>'
LIMIT = 'lower="-0.4" upper="0.6"'
WHEEL_MASS = '<mass value="1.9"/>'
FLOATING = '<joint name="x" type="floating"><parent link="Body"/><child link="FrontLeftArm"/></joint>'
CYCLE = (
    '<link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint>'
)
MOVING_FRAME = (
    '<link name="arm_tip"/><joint name="tip" type="revolute"><parent link="Body"/><child link="arm_tip"/>'
    '<axis xyz="0 0 1"/><limit lower="0" upper="1"/></joint>'
)

# what is wrong: (text to replace, replacement, words that the message must hold)
URDF_MISTAKES = {
    "broken XML": ("</robot>", "</robt>", ["not well-formed"]),
    "not a robot": ("robot", "sdf", ["'sdf'", "<robot>"]),
    "no wheels": (CYLINDER, '<box size="1 1 1"/>', ["wheels", "fewer than 3"]),
    "dangling child": ('<child link="FrontLeftArm"/>', '<child link="Arm"/>', ["FrontLeftArmJoint", "'Arm'"]),
    "dangling parent": ('<parent link="FrontLeftArm"/>', '<parent link="Arm"/>', ["FrontLeftForkJoint", "'Arm'"]),
    "missing parent": ('<parent link="FrontLeftArm"/>', "", ["FrontLeftForkJoint", "parent", "missing"]),
    "two roots": ("</robot>", '<link name="stray"/></robot>', ["root", "Body, stray"]),
    "cycle": ("</robot>", CYCLE + "</robot>", ["a, b", "cycle"]),
    "two parents": ("</robot>", FLOATING.replace("floating", "fixed") + "</robot>", ["FrontLeftArm", "[[loops]]"]),
    "zero mass": (WHEEL_MASS, '<mass value="0"/>', ["FrontLeftWheel", "mass", "not positive"]),
    "negative mass": (WHEEL_MASS, '<mass value="-1.9"/>', ["FrontLeftWheel", "-1.9", "not positive"]),
    "mass not a number": (WHEEL_MASS, '<mass value="heavy"/>', ["'heavy'", "not a number"]),
    "mass not finite": (WHEEL_MASS, '<mass value="nan"/>', ["'nan'", "not finite"]),
    "mass missing": (WHEEL_MASS, "", ["FrontLeftWheel", "mass", "missing"]),
    "zero inertia": (BODY_INERTIA, 'ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"', ["Body", "zero"]),
    "moving link without inertia": ("</robot>", MOVING_FRAME + "</robot>", ["arm_tip", "inertia", "tip"]),
    "indefinite inertia": (BODY_INERTIA, BODY_INERTIA.replace('ixy="0"', 'ixy="2"'), ["Body", "not all positive"]),
    "triangle inequality": (BODY_INERTIA, BODY_INERTIA.replace("1.6", "1.9"), ["Body", "triangle"]),
    "inertia missing": (BODY_INERTIA, BODY_INERTIA.replace('izz="1.6"', ""), ["Body", "izz", "missing"]),
    "duplicate link": ('<link name="FrontLeftArm">', '<link name="Body">', ["link name", "'Body'", "more than once"]),
    "duplicate joint": ('name="FrontLeftArmJoint"', 'name="BackLeftArmJoint"', ["joint name", "more than once"]),
    "unnamed link": ('<link name="FrontLeftArm">', "<link>", ["link name", "missing"]),
    "unknown joint type": ('type="revolute"', 'type="hinge"', ["FrontLeftArmJoint", "'hinge'", "continuous"]),
    "planar joint": ('type="revolute"', 'type="planar"', ["'planar'"]),
    "second floating joint": ("revolute", "floating", ["FrontLeftArmJoint", "floating"]),
    "limits crossed": (LIMIT, 'lower="0.6" upper="-0.4"', ["FrontLeftArmJoint", "lower", "above upper"]),
    "limits missing": (f'<limit {LIMIT} effort="50" velocity="2"/>', "", ["FrontLeftArmJoint", "limit", "missing"]),
    "limit not finite": (LIMIT, 'lower="-inf" upper="0.6"', ["FrontLeftArmJoint", "not finite"]),
    "axis of no length": ('<axis xyz="0 1 0"/>', '<axis xyz="0 0 0"/>', ["FrontLeftArmJoint", "no length"]),
    "axis of two numbers": ('<axis xyz="0 1 0"/>', '<axis xyz="0 1"/>', ["FrontLeftArmJoint", "2 numbers"]),
    "origin not finite": ('xyz="0.15 0.25 -0.05"', 'xyz="0.15 nan -0.05"', ["FrontLeftArmJoint", "not finite"]),
    "negative radius": (CYLINDER, CYLINDER.replace("0.12", "-0.12"), ["FrontLeftWheel", "cylinder", "not positive"]),
    "xacro left over": (
        '<robot name="steered">',
        '<robot name="steered" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm side="left"/>',
        ["xacro:arm", "not expanded"],
    ),
    "joint called free": ('name="FrontLeftArmJoint"', 'name="free"', ["repeated name 'free'"]),
    "bad robot name": ('<robot name="steered">', '<robot name="../steered">', ["name", "cannot name a file"]),
}
EVERY_OCCURRENCE = {"not a robot", "no wheels"}


@pytest.mark.parametrize("mistake", URDF_MISTAKES)
def test_urdf_mistake(mistake: str, data: Path, tmp_path: Path) -> None:
    old, new, words = URDF_MISTAKES[mistake]
    text = (data / "steered.urdf").read_text()
    assert old in text
    urdf = tmp_path / "rover.urdf"
    urdf.write_text(text.replace(old, new, -1 if mistake in EVERY_OCCURRENCE else 1))
    message = _refused(lambda: convert(urdf, tmp_path / "out"), "rover.urdf")
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists(), "nothing may be written for a refused rover"


def test_missing_urdf(tmp_path: Path) -> None:
    assert "not there" in _refused(lambda: convert(tmp_path / "gone.urdf", tmp_path), "gone.urdf")


def test_folder_instead_of_urdf(tmp_path: Path) -> None:
    assert "folder" in _refused(lambda: convert(tmp_path, tmp_path), tmp_path.name)


def test_binary_instead_of_urdf(tmp_path: Path) -> None:
    (tmp_path / "rover.urdf").write_bytes(bytes(range(256)))
    assert "not well-formed" in _refused(lambda: convert(tmp_path / "rover.urdf", tmp_path), "rover.urdf")


def test_empty_robot(tmp_path: Path) -> None:
    (tmp_path / "rover.urdf").write_text('<robot name="empty"/>')
    assert "missing" in _refused(lambda: convert(tmp_path / "rover.urdf", tmp_path), "rover.urdf")


def test_two_wheels_are_too_few(data: Path, tmp_path: Path) -> None:
    text = (data / "steered.urdf").read_text().replace(CYLINDER, '<box size="0.1 0.1 0.1"/>', 2)
    (tmp_path / "rover.urdf").write_text(text)
    message = _refused(lambda: convert(tmp_path / "rover.urdf", tmp_path / "out"), "rover.urdf")
    assert "BackLeftWheel, BackRightWheel" in message


def test_output_folder_that_is_a_file(data: Path, tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    assert "cannot be written" in _refused(lambda: convert(data / "steered.urdf", tmp_path / "out"), "out")


LOOP = '[[loops]]\nlink1 = "Body"\nlink2 = "FrontLeftArm"\nanchor1 = [0.15, 0.25, -0.05]\nanchor2 = [0, 0, 0]\n'
DESCRIPTION_MISTAKES = {
    "not TOML": ("name = ", ["not valid TOML"]),
    "unknown key": ("colour = 3", ["colour", "unknown key"]),
    "unknown group": ("[joints.lift]\nmode = 'position'", ["joints.lift", "unknown key"]),
    "unknown key in a group": ("[joints.drive]\ngear = 3", ["joints.drive.gear", "gear_ratio"]),
    "unknown mode": ("[joints.drive]\nmode = 'fast'", ["'fast'", "velocity"]),
    "unknown winding": ("[joints.drive]\nwinding = 13", ["13", "48"]),
    "negative damping": ("[joints.steer]\ndamping = -1", ["joints.steer.damping", "-1"]),
    "zero gear": ("[joints.steer]\ngear_ratio = 0", ["gear_ratio", "above 0"]),
    "efficiency above one": ("[joints.steer]\ngear_efficiency = 60", ["gear_efficiency", "60", "fraction"]),
    "gain as text": ("[joints.drive]\nvelocity_gain = 'high'", ["velocity_gain", "not a number"]),
    "gain not finite": ("[joints.drive]\nvelocity_gain = nan", ["velocity_gain", "not finite"]),
    "level without a spring": ("[joints.suspension]\nspring_reference = 'level'", ["level", "stiffness"]),
    "level steering": ("[joints.steer]\nstiffness = 1\nspring_reference = 'level'", ["level", "suspension only"]),
    "joints not a table": ("joints = 3", ["joints", "not a table"]),
    "wheels not tables": ("wheels = 4", ["wheels", "[[wheels]]"]),
    "wheel without a link": ("[[wheels]]\ncorner = 'lf'", ["wheels[0].link", "missing"]),
    "wheel that is not there": ("[[wheels]]\nlink = 'Wheel'", ["'Wheel'", "not a link of rover.urdf"]),
    "wheel that does not turn": ("[[wheels]]\nlink = 'Body'", ["'Body'", "does not turn"]),
    "wheel about z": ("[[wheels]]\nlink = 'FrontLeftFork'", ["FrontLeftFork", "about y"]),
    "steer that is not there": ("[[wheels]]\nlink = 'FrontLeftWheel'\nsteer = 's'", ["'s'", "not a joint"]),
    "negative wheel radius": ("[[wheels]]\nlink = 'FrontLeftWheel'\nradius = -1", ["wheels[0].radius", "-1"]),
    "too few described wheels": ("[[wheels]]\nlink = 'FrontLeftWheel'", ["fewer than 3"]),
    "loop to a missing link": (LOOP.replace('"FrontLeftArm"', '"Strut"'), ["loops[0].link2", "'Strut'"]),
    "loop without an anchor": (LOOP.replace("anchor2 = [0, 0, 0]\n", ""), ["loops[0].anchor2", "missing"]),
    "loop with two numbers": (LOOP.replace("[0, 0, 0]", "[0, 0]"), ["loops[0].anchor2", "3 numbers"]),
    "loop anchors apart": (LOOP.replace("[0, 0, 0]", "[0, 0, 0.002]"), ["loops[0]", "2 mm", "apart"]),
    "loop within one body": (LOOP.replace('"FrontLeftArm"', '"Body"'), ["loops[0].link2", "body of link1"]),
    "zero time step": ("timestep = 0", ["timestep", "above 0"]),
}


@pytest.mark.parametrize("mistake", DESCRIPTION_MISTAKES)
def test_description_mistake(mistake: str, data: Path, tmp_path: Path) -> None:
    text, words = DESCRIPTION_MISTAKES[mistake]
    shutil.copy(data / "steered.urdf", tmp_path / "rover.urdf")
    (tmp_path / "rover.rover.toml").write_text(text)
    message = _refused(lambda: convert(tmp_path / "rover.urdf", tmp_path / "out"), "rover.")
    for word in words:
        assert word in message
    assert not (tmp_path / "out").exists()


def test_missing_description(data: Path, tmp_path: Path) -> None:
    message = _refused(lambda: convert(data / "steered.urdf", tmp_path, tmp_path / "told.toml"), "told.toml")
    assert "not there" in message


FILE_MISTAKES = {
    "lost mass": ("mass = 442.9", "mass = 460.0", ["460", "mass was lost"]),
    "negative mass": ("mass = 442.9", "mass = -1.0", ["mass", "-1"]),
    "unknown key": ('chassis = "chassis"', 'chassis = "chassis"\ncolour = 1', ["colour", "unknown key"]),
    "missing key": ("standing_height = 0.35\n", "", ["standing_height", "missing"]),
    "chassis that is not there": ('chassis = "chassis"', 'chassis = "body"', ["'body'", "not a body"]),
    "wheel that is not there": ('body = "lf_wheel"', 'body = "wheel"', ["wheels[0].body", "'wheel'"]),
    "joint that is not there": ('drive = "lf_drive"', 'drive = "lf"', ["wheels[0].drive", "'lf'"]),
    "motors in another order": ('"lf_drive",\n    "rf_drive"', '"rf_drive",\n    "lf_drive"', ["motors"]),
    "text for a number": ("radius = 0.25", 'radius = "0.25"', ["radius", "not a number"]),
    "other format": ("lunar-mjx-rover/1", "lunar-mjx-rover/2", ["format", "lunar-mjx-rover/2"]),
    "missing MJCF": ('mjcf = "viper.xml"', 'mjcf = "gone.xml"', ["gone.xml", "not there"]),
    "MJCF outside the folder": ('mjcf = "viper.xml"', 'mjcf = "../viper.xml"', ["mjcf", "beside"]),
    "broken TOML": ("[groups.drive]", "[groups.drive", ["not valid TOML"]),
}


@pytest.mark.parametrize("mistake", FILE_MISTAKES)
def test_rover_file_mistake(mistake: str, tmp_path: Path) -> None:
    old, new, words = FILE_MISTAKES[mistake]
    folder = tmp_path / "viper"
    shutil.copytree(shipped("models") / "viper", folder)
    text = (folder / "rover.toml").read_text()
    assert old in text
    (folder / "rover.toml").write_text(text.replace(old, new, 1))
    message = _refused(lambda: load_rover(folder), "")
    for word in words:
        assert word in message


def test_broken_mjcf(tmp_path: Path) -> None:
    folder = tmp_path / "viper"
    shutil.copytree(shipped("models") / "viper", folder)
    (folder / "viper.xml").write_text("<mujoco><worldbody><body/></mujoco>")
    assert "cannot compile" in _refused(lambda: load_rover(folder), "viper.xml")


def test_unknown_rover_lists_the_known_ones() -> None:
    message = _refused(lambda: load_rover("sojourner"), "sojourner")
    assert "luvmi_x" in message and "viper" in message


def _refused(call, source: str) -> str:
    """Runs `call`, which must raise one sentence that names `source`; returns it."""
    with pytest.raises(UserError) as caught:
        call()
    message = str(caught.value)
    assert source in message
    assert message.endswith(".") and "\n" not in message
    return message
