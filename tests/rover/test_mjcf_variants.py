"""Variants of one MJCF, each with another field: it is honoured as native MuJoCo honours it, or refused by name."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

from lunar_mjx.dynamics.engines import make_engine
from lunar_mjx.errors import UserError
from lunar_mjx.resources import shipped
from lunar_mjx.rover import load_rover
from tests.dynamics.structured_reference import Reference

pytestmark = pytest.mark.slow

ARM, STEER, DRIVE = (f'<joint name="lf_{part}"' for part in ("suspension", "steer", "drive"))
BODY, KNUCKLE, CHASSIS = '<body name="lf_arm"', '<body name="lf_knuckle"', '<body name="chassis"'
COMPILER, OPTION, FLAG, MOTOR = "<compiler", "<option", "<flag", '<motor name="lf_drive"'
END, WORLD = "</mujoco>", "</worldbody>"
INERTIA = 'fullinertia="0.000266667 0.00283333 0.00283333 0 0 0"'
GEOM = '<geom size="0.09 0.02 0.02"'
OUTSIDE = '<body pos="9 9 0"><inertial pos="0 0 0" mass="{}" diaginertia="1 1 1"/>{}</body>'


def _add(element: str, attribute: str, without: str = "") -> tuple[str, str, str]:
    """An element with one attribute more, and without another one."""
    return element, f"{element} {attribute}", without


def _replace(old: str, new: str) -> tuple[str, str, str]:
    return old, new, ""


def _before(old: str, new: str) -> tuple[str, str, str]:
    return old, f"{new}{old}", ""


SAME = {
    "damping of a passive joint": _replace('damping="10"', 'damping="3"'),
    "damping of a driven joint": _add(STEER, 'damping="2.5"'),
    "stiffness": _replace('stiffness="20"', 'stiffness="90"'),
    "stiffness of a driven joint": _add(DRIVE, 'stiffness="4"'),
    "springref": _replace('springref="0.1511908784"', 'springref="-0.2"'),
    "springref without stiffness": _add(DRIVE, 'springref="0.3"'),
    "armature": _replace('armature="2.0958084"', 'armature="0.5"'),
    "no armature": _replace('armature="0.0531441" ', ""),
    "oblique axis": _replace('axis="0 1 0" limited', 'axis="0.3 1 -0.2" limited'),
    "axis that is not normal": _replace('axis="0 1 0" limited', 'axis="0 7 0" limited'),
    "turned axis": _replace('axis="0 1 0" limited', 'axis="0 -1 0" limited'),
    "pos of a joint": _add(ARM, 'pos="0.01 0.02 -0.03"'),
    "margin": _add(ARM, 'margin="0.1"'),
    "solreflimit": _add(ARM, 'solreflimit="0.1 1"'),
    "limited, with limits off": _add(ARM, 'limited="true"', ' limited="false"'),
    "group of a joint": _add(ARM, 'group="3"'),
    "pos of a body": _replace('pos="0.19 0.254 0"', 'pos="0.15 0.254 0.01"'),
    "quat of a body": _add(BODY, 'quat="0.9995 0.02 0.02 0.01"'),
    "euler of a body": _add(BODY, 'euler="0.02 0.03 0.05"'),
    "pos of an inertia": _replace('<inertial pos="0.09 0 0" mass="1"', '<inertial pos="0.05 0.01 0.02" mass="1"'),
    "inertia": _replace(INERTIA, 'fullinertia="0.002 0.003 0.0025 0.0001 0 0.0002"'),
    "diaginertia with quat": _replace(INERTIA, 'diaginertia="0.002 0.003 0.0025" quat="0.9 0.3 0.1 0"'),
    "mass of a shape beside an inertia": _add(GEOM, 'mass="5"', ' mass="0"'),
    "density of a shape": _add(GEOM, 'density="800"', ' mass="0"'),
    "site": _before(KNUCKLE, '<site name="spot" pos="0.1 0 0"/>'),
    "camera": _before(KNUCKLE, '<camera name="eye" pos="0.1 0 0"/>'),
    "body without mass": _before(KNUCKLE, '<body pos="0.1 0 0"><site name="spot"/></body>'),
    "frame": _before(KNUCKLE, '<frame pos="0.1 0 0"><site name="spot"/></frame>'),
    "default class": _before("<worldbody>", '<default><joint damping="0.7"/></default>'),
    "degrees": _replace('angle="radian"', 'angle="degree"'),
    "balanceinertia": _add(COMPILER, 'balanceinertia="true"'),
    "solver": _replace('solver="Newton"', 'solver="CG"'),
    "cone": _add(OPTION, 'cone="elliptic"'),
    "impratio": _add(OPTION, 'impratio="10"'),
    "magnetic": _add(OPTION, 'magnetic="1 0 0"'),
    "time step": _replace('timestep="0.002"', 'timestep="0.001"'),
    "energy": _add(FLAG, 'energy="enable"'),
    "clampctrl": _add(FLAG, 'clampctrl="disable"'),
    "limits in the solver, of none": _replace('limit="disable"', 'limit="enable"'),
    "inertia from shapes": _add(COMPILER, 'inertiafromgeom="true"'),
    "sensor": _before(END, '<sensor><accelerometer site="mast"/></sensor>'),
    "keyframe": _before(END, '<keyframe><key name="k" time="3"/></keyframe>'),
    "numeric": _before(END, '<custom><numeric name="n" data="1 2"/></custom>'),
    "exclude": _before(END, '<contact><exclude body1="lf_arm" body2="lf_wheel"/></contact>'),
    "light": _before(WORLD, '<light pos="0 0 3"/>'),
}
"""Fields that are honoured, or that change nothing in native MuJoCo either."""

REFUSED = {
    "ref": (_add(ARM, 'ref="0.1"'), "ref of the joint"),
    "actuatorfrcrange": (_add(ARM, 'actuatorfrclimited="true" actuatorfrcrange="-1 1"'), "actuatorfrcrange"),
    "actuatorgravcomp": (_add(STEER, 'actuatorgravcomp="true"'), "actgravcomp"),
    "frictionloss": (_add(ARM, 'frictionloss="1"'), "frictionloss"),
    "contacts": (_replace('contact="disable"', 'contact="enable"'), "contacts"),
    "gravcomp": (_add(BODY, 'gravcomp="1"'), "gravcomp"),
    "mass": (_replace('mass="38"', 'mass="39"'), "mass was lost"),
    "boundmass": (_add(COMPILER, 'boundmass="2"'), "mass was lost"),
    "settotalmass": (_add(COMPILER, 'settotalmass="60"'), "settotalmass"),
    "tilted gravity": (_replace('gravity="0 0 -1.625"', 'gravity="0.3 0 -1.6"'), "gravity"),
    "integrator": (_replace('integrator="Euler"', 'integrator="implicitfast"'), "integrator"),
    "density of a fluid": (_add(OPTION, 'density="1"'), "fluid forces"),
    "viscosity": (_add(OPTION, 'viscosity="0.1"'), "fluid forces"),
    "wind": (_add(OPTION, 'wind="1 0 0"'), "fluid forces"),
    "gravity off": (_add(FLAG, 'gravity="disable"'), "mjDSBL_GRAVITY"),
    "springs off": (_add(FLAG, 'spring="disable"'), "mjDSBL_SPRING"),
    "dampers off": (_add(FLAG, 'damper="disable"'), "mjDSBL_DAMPER"),
    "actuation off": (_add(FLAG, 'actuation="disable"'), "mjDSBL_ACTUATION"),
    "explicit damping": (_add(FLAG, 'eulerdamp="disable"'), "mjDSBL_EULERDAMP"),
    "gear": (_add(MOTOR, 'gear="2"'), "gear of the motor"),
    "ctrlrange": (_add(MOTOR, 'ctrllimited="true" ctrlrange="-1 1"'), "ctrlrange"),
    "forcerange": (_add(MOTOR, 'forcelimited="true" forcerange="-1 1"'), "forcerange"),
    "position actuator": (_replace('<motor name="lf_drive"', '<position name="lf_drive"'), "gain, bias"),
    "damping of a motor": (_add(MOTOR, 'damping="1"'), "actuator_damping"),
    "weld": (_before(END, '<equality><weld body1="lf_arm" body2="chassis"/></equality>'), "equality"),
    "bent joint equality": (
        _before(END, '<equality><joint joint1="lf_steer" joint2="rf_steer" polycoef="0 1 1 0 0"/></equality>'),
        "joint equality",
    ),
    "tendon": (
        _before(END, '<tendon><fixed stiffness="9"><joint joint="lf_steer" coef="1"/></fixed></tendon>'),
        "tendons",
    ),
    "mocap": (_before(WORLD, '<body mocap="true" pos="9 9 9"><site name="spot"/></body>'), "mocap"),
    "slide joint": (_add(DRIVE, 'type="slide"'), "slide"),
    "second free body": (_before(WORLD, OUTSIDE.format(1, "<freejoint/>")), "mass was lost"),
}
"""Fields that are refused, or leave the rover to MJX with a warning, and what the sentence names."""


def _variant(folder: Path, change: tuple[str, str, str]) -> Path:
    rover = Path(shutil.copytree(shipped("models") / "luvmi_x", folder / "rover"))
    path, (old, new, without) = rover / "luvmi_x.xml", change
    lines = path.read_text().splitlines(keepends=True)
    found = next(i for i, line in enumerate(lines) if old in line)
    lines[found] = lines[found].replace(without, "", 1).replace(old, new, 1)
    path.write_text("".join(lines))
    return rover


def test_there_are_fifty():
    assert len(SAME) + len(REFUSED) >= 50


@pytest.mark.parametrize("name", SAME)
def test_a_field_is_honoured(name, tmp_path):
    """One step of three rovers in any pose and motion, against a model that MuJoCo alone has read."""
    folder = _variant(tmp_path, SAME[name])
    rover = load_rover(folder)
    native = mujoco.MjModel.from_xml_path(str(folder / "luvmi_x.xml"))
    with jax.enable_x64(True):
        reference = Reference(rover, rover.timestep)
        qpos, qvel, forces = reference.random(3)
        new_qpos, new_qvel = (np.asarray(a) for a in reference.step(qpos, qvel, forces)[1])
        reference.model, reference.data = native, mujoco.MjData(native)
        for i in range(3):
            q, v, _ = reference.native(qpos[i], qvel[i], {k: f[i] for k, f in forces.items()})
            assert np.abs(new_qpos[i] - q).max() < 1e-9 * max(1.0, np.abs(q).max())
            assert np.abs(new_qvel[i] - v).max() < 1e-9 * max(1.0, np.abs(v).max())


@pytest.mark.parametrize("name", REFUSED)
def test_a_field_is_refused_or_told(name, tmp_path, caplog):
    change, said = REFUSED[name]
    folder = _variant(tmp_path, change)
    try:
        with caplog.at_level(logging.WARNING):
            assert make_engine(load_rover(folder)).name == "mjx"
    except UserError as error:
        assert said in str(error) and str(folder) in str(error)
    else:
        assert said in caplog.text
