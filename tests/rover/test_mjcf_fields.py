"""What a rover folder may say: fields that would be ignored, and sizes that contradict each other, are refused."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert, list_rovers, load_rover

JOINT, MOTOR = '<joint name="lf_suspension"', '<motor name="lf_drive" joint="lf_drive"'


@pytest.fixture
def rover(tmp_path) -> Path:
    """A folder of LUVMI-X to be changed."""
    return Path(shutil.copytree(shipped("models") / "luvmi_x", tmp_path / "rover"))


def _change(rover: Path, file: str, old: str, new: str) -> None:
    path = rover / file
    text = path.read_text()
    assert re.search(old, text)
    path.write_text(re.sub(old, new, text, count=1))


def _refused(rover: Path, file: str, old: str, new: str, said: str) -> None:
    """Loading is refused by a sentence that names the file, once `new` stands in it for the text `old`."""
    _change(rover, file, re.escape(old), new)
    with pytest.raises(UserError, match=re.escape(said)) as error:
        load_rover(rover)
    assert str(error.value).startswith(f"{rover / file}: ")


IGNORED = {
    "ref": (JOINT, 'ref="0.1"', "ref of the joint 'lf_suspension' would be ignored"),
    "actuatorfrcrange": (
        JOINT,
        'actuatorfrclimited="true" actuatorfrcrange="-1 1"',
        "actuatorfrcrange of the joint 'lf_suspension'",
    ),
    "gear": (MOTOR, 'gear="2"', "gear of the motor 'lf_drive' would be ignored; give gear_ratio"),
    "gear about another axis": (MOTOR, 'gear="1 0 1"', "gear of the motor 'lf_drive'"),
    "ctrlrange": (MOTOR, 'ctrllimited="true" ctrlrange="-1 1"', "ctrlrange of the motor 'lf_drive'"),
    "forcerange": (MOTOR, 'forcelimited="true" forcerange="-1 1"', "forcerange of the motor 'lf_drive'"),
}


@pytest.mark.parametrize("field", IGNORED)
def test_fields_of_joints_and_motors_that_would_be_ignored_are_refused(rover, field):
    element, attribute, said = IGNORED[field]
    _refused(rover, "luvmi_x.xml", element, f"{element} {attribute}", said)


@pytest.mark.parametrize("kind", ["position", "velocity", 'general gainprm="2"', 'general dyntype="integrator"'])
def test_actuators_that_are_no_plain_motors_are_refused(rover, kind):
    _change(rover, "luvmi_x.xml", "<motor (.*lf_drive.*)/>", rf"<{kind} \1/>")
    with pytest.raises(UserError, match="gain, bias or dynamics of the motor 'lf_drive'"):
        load_rover(rover)


@pytest.mark.parametrize("radius", ["5.0", "0.01", "9.0"])
def test_a_radius_that_is_not_the_wheels_is_refused(rover, radius):
    _change(rover, "rover.toml", r"radius = [\d.]+", f"radius = {radius}")
    with pytest.raises(UserError, match=rf"wheels\[0\]\.radius = {radius} is not the 0\.\d+ m of"):
        load_rover(rover)


def test_a_height_that_is_not_the_wheels_is_refused(rover):
    _change(rover, "rover.toml", r"standing_height = [\d.]+", "standing_height = 3.0")
    with pytest.raises(UserError, match="of the height at which the rover stands"):
        load_rover(rover)


NUMBERS = {
    "range nan": ('range="-0.7 0.7"', 'range="nan 0.7"', "holds nan in jnt_range"),
    "range swapped": (
        'range="-0.7 0.7"',
        'range="0.7 -0.7"',
        "range of the joint 'lf_suspension' = '0.7 -0.7' has its",
    ),
    "stiffness nan": ('stiffness="20"', 'stiffness="nan"', "holds nan in jnt_stiffness"),
    "stiffness beyond single precision": ('stiffness="20"', 'stiffness="1e300"', "holds 1e+300 in jnt_stiffness"),
    "stiffness below zero": ('stiffness="20"', 'stiffness="-20"', "stiffness of the joint 'lf_suspension' = -20.0 is"),
    "springref nan": ('springref="0.1511908784"', 'springref="nan"', "holds nan in qpos_spring"),
    "damping below zero": ('damping="10"', 'damping="-10"', "damping of the joint 'lf_suspension' = -10.0 is negative"),
    "no free joint": ('<freejoint name="free"/>', "", "its first joint is not free"),
    "hinge for a free joint": (
        '<freejoint name="free"/>',
        '<joint name="free" type="hinge"/>',
        "first joint is not free",
    ),
}


@pytest.mark.parametrize("field", NUMBERS)
def test_numbers_that_no_mechanism_has_are_refused(rover, field, monkeypatch):
    monkeypatch.chdir(rover)  # where MuJoCo writes of its warnings
    _refused(rover, "luvmi_x.xml", *NUMBERS[field])


FLEET = 'loops = []\ndrive_groups = [{name = "left", joints = [%s]}]'
DESCRIBED = {
    "notes that are a number": ("notes = []", "notes = 5", "notes = 5 is no list of texts"),
    "notes that are one text": ("notes = []", 'notes = "abc"', "notes = 'abc' is no list of texts"),
    "two wheels of one corner": ('corner = "rf"', 'corner = "lf"', "corner = 'lf' is the corner of two wheels"),
    "a corner on two lines": ('corner = "rf"', r'corner = "r\\nf"', "wheels[1].corner = 'r\\nf' is no name"),
    "a name on two lines": ('name = "luvmi_x"', r'name = "a\\nb"', "name = 'a\\nb' is no name"),
    "the body of another wheel": (
        'body = "rf_wheel"',
        'body = "lf_wheel"',
        "body = 'lf_wheel' is not what rf_drive turns",
    ),
    "a steering joint that drives": (
        'steer = "rf_steer"',
        'steer = "rf_drive"',
        "'rf_drive' is no joint of groups.steer",
    ),
    "a steering joint of another wheel": (
        'steer = "rf_steer"',
        'steer = "lf_steer"',
        "'lf_steer' does not carry rf_wheel",
    ),
    "a suspension that is free": (
        'suspension = "lf_suspension"',
        'suspension = "free"',
        "no joint of groups.suspension",
    ),
    "a gear that gains": (
        "gear_efficiency = 0.75",
        "gear_efficiency = 5.0",
        "groups.drive.gear_efficiency = 5.0 is above",
    ),
    "a wheel of light years": ("width = 0.08", "width = 1e9", "wheels[0].width = 1000000000.0 is above 1000 m"),
    "a chassis of light years": ("[-0.4, -0.3, 0.21]", "[-0.4, -0.3, 1e30]", "is more than 1000 m from the chassis"),
    "a wheel for a chassis": ('chassis = "chassis"', 'chassis = "lf_wheel"', "'lf_wheel' is not the body of the free"),
    "one joint twice in a group": ("loops = []", FLEET % '"lf_drive", "lf_drive"', "name a joint twice"),
    "wheels that nothing ties": ("loops = []", FLEET % '"lf_drive", "lr_drive"', "are not tied in the MJCF"),
}


@pytest.mark.parametrize("field", DESCRIBED)
def test_a_description_that_its_mjcf_contradicts_is_refused(rover, field):
    _refused(rover, "rover.toml", *DESCRIBED[field])


@pytest.mark.parametrize("step", ["0", "-1", "10"])
def test_a_time_step_of_the_mjcf_is_refused_by_the_rovers_name(rover, step):
    _change(rover, "luvmi_x.xml", 'timestep="0.002"', f'timestep="{step}"')
    with pytest.raises(UserError, match=re.escape(f"{rover}: timestep_s = {float(step)} is outside")):
        make_model(str(rover), "flat")


def test_gravity_is_one_in_both_files(rover):
    _change(rover, "luvmi_x.xml", 'gravity="0 0 -1.625"', 'gravity="0 0 -3.7"')
    text = (rover / "rover.toml").read_text()
    if "gravity" in text:
        with pytest.raises(UserError, match="is not the MJCF's gravity"):
            load_rover(rover)
    else:
        assert any("gravity 3.7 m/s2 is not used" in n for n in load_rover(rover).notes)
    (rover / "rover.toml").write_text("gravity = 3.7\n" + re.sub(r"(?m)^gravity = .*\n", "", text))
    assert make_model(str(rover), "flat").gravity == 3.7


def test_time_step_and_gravity_of_a_description_are_those_of_the_model(tmp_path):
    data = Path(__file__).parent / "data"
    urdf = Path(shutil.copy(data / "steered.urdf", tmp_path / "steered.urdf"))
    described = data / "steered.rover.toml"
    text = described.read_text() if described.exists() else ""
    text = re.sub(r"(?m)^(gravity|timestep) = .*\n", "", text)
    urdf.with_name("steered.rover.toml").write_text(f"gravity = 3.71\ntimestep = 0.001\n{text}")
    convert(urdf, tmp_path / "out")
    model = make_model(str(tmp_path / "out"), "flat")
    assert (model.gravity, model.timestep) == (3.71, 0.001)


@pytest.mark.parametrize("name", list_rovers())
def test_shipped_rovers_hold_to_it(name):
    rover = load_rover(name)
    assert make_model(name, "flat").timestep == rover.timestep == 0.002
