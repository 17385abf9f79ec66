"""Wheels that share a motor: conversion, motors and both engines."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import Wheel, convert, load_rover


def test_sides_of_the_husky():
    rover = load_rover("husky")
    assert [(g.name, g.joints) for g in rover.drive_groups] == [
        ("left", ("lf_drive", "lr_drive")),
        ("right", ("rf_drive", "rr_drive")),
    ]
    assert make_model("husky", "flat").gravity == rover.gravity == 9.81
    assert make_model("viper", "flat").gravity == 1.625


def test_a_shared_motor_is_split_evenly():
    """Two half motors side by side: stall torque, reflected inertia and dissipation of a side are the motor's."""
    rover, model = load_rover("husky"), make_model("husky", "flat")
    motor, limit = model.parameters["motor"], model.parameters["joint_control"]["current_limit"]
    left = [0, 2]
    assert sum(limit[i] for i in left) == pytest.approx(40.0)
    assert sum(motor["rotor_inertia"][i] for i in left) == pytest.approx(rover.groups[0].rotor_inertia)
    current = 10.0
    assert sum((current / 2) ** 2 * motor["resistance"][i] for i in left) == pytest.approx(0.46 * current**2)
    armature = rover.compile().dof_armature[6:]
    np.testing.assert_allclose(armature, np.array(motor["rotor_inertia"]) * 78.71**2)


@pytest.mark.slow
def test_engines_agree_on_tied_wheels():
    """A skid turn with different targets within a side, whose mean the motor drives: both engines agree."""
    model = make_model("husky", "flat").replace(gains={"drive": (0.0, 60.0)})
    command = jnp.tile(jnp.array([-1.0, 2.5, -2.0, 1.5]), (40, 1))
    ends = []
    with jax.enable_x64(True):
        for engine in ("structured", "mjx"):
            system = build(model, engine)
            state, _ = jax.jit(lambda s, system=system: system.rollout(system.params, s, command, 5))(
                jax.jit(system.reset)(system.params)
            )
            ends.append((np.array(state.qpos), np.array(state.qvel)))
    (q, v), (q_mjx, v_mjx) = ends
    assert v[6] == v[8] and v[7] == v[9]
    np.testing.assert_allclose(q, q_mjx, atol=1e-5)
    np.testing.assert_allclose(v, v_mjx, atol=2e-5)
    assert v[5] > 0.05  # it turns to the left


def test_refusals(tmp_path):
    for name in ("husky.urdf", "husky.rover.toml"):
        shutil.copy(shipped("models") / "husky" / name, tmp_path)
    told = tmp_path / "husky.rover.toml"
    text = told.read_text()
    told.write_text(text.replace('["rf", "rr"]', '["rf", "lr"]'))
    with pytest.raises(UserError, match=r"drive_groups\[1\].wheels = 'lr' is in two groups"):
        convert(tmp_path / "husky.urdf", tmp_path / "out")
    told.write_text(text.replace('["rf", "rr"]', '["rf"]'))
    with pytest.raises(UserError, match="are not two or more corners"):
        convert(tmp_path / "husky.urdf", tmp_path / "out")


def test_convert_says_which_motor_it_assumed(tmp_path):
    shutil.copy(shipped("models") / "husky" / "husky.urdf", tmp_path)
    rover = convert(tmp_path / "husky.urdf", tmp_path / "out")
    assert any("assumed the motor" in note and "243" in note for note in rover.notes)
    told = tmp_path / "husky.rover.toml"
    told.write_text("[joints.drive]\nvelocity_gain = 8.0\ngear_ratio = 78.0\n")
    rover = convert(tmp_path / "husky.urdf", tmp_path / "gear")
    assert [n for n in rover.notes if "assumed the motor" in n and "torque_constant_Nm_A" in n and "243" not in n]
    told.write_text("[joints.drive]\ntorque_constant_Nm_A = 0.044\n")
    rover = convert(tmp_path / "husky.urdf", tmp_path / "motor")
    assert [n for n in rover.notes if "assumed a gear of 243" in n and "gear_ratio" in n and "motor" not in n]
    assert not any("assumed" in note for note in load_rover("husky").notes)
    assert rover.gravity == 1.625


@pytest.mark.parametrize("name", ["husky", "cuadriga", "warthog"])
def test_rovers_with_sides_are_as_converted(name, tmp_path):
    folder = shipped("models") / name
    convert(folder / f"{name}.urdf", tmp_path)
    for file in (f"{name}.xml", "scene.xml", "rover.toml"):
        assert (tmp_path / file).read_text() == (folder / file).read_text(), f"convert {name} again"


def test_a_warthog_is_sized_as_published():
    """Sources and ranges: `models/warthog/README.md`. Its motor is not published, and so known badly."""
    rover = load_rover("warthog")
    assert rover.mass == pytest.approx(280.0)
    assert {(w.radius, w.width) for w in rover.wheels} == {(0.3, 0.25)}
    assert [g.joints for g in rover.drive_groups] == [("lf_drive", "lr_drive"), ("rf_drive", "rr_drive")]
    assert [note for note in rover.notes if note.startswith("drive: assumed the motor")]


@pytest.mark.parametrize(
    ("corner", "side", "row"),
    [("lf", "left", "front"), ("rr", "right", "rear"), ("lm2", "left", "middle"), ("cf", "", "front"), ("x", "", "")],
)
def test_a_corner_tells_side_and_row(corner, side, row):
    wheel = Wheel(corner, "wheel", 0.1, 0.1, "drive", None, None)
    assert (wheel.side, wheel.row) == (side, row)
