"""The rocker-bogie: its differential in every engine, what it is for, and joints that mimic others."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from lunar_mjx.backends import NativeBackend
from lunar_mjx.backends.parity.cases import cases
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.structured.suitability import UnsuitableError
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert, load_rover

pytestmark = pytest.mark.slow

SOURCES = ("rocker_bogie.urdf", "rocker_bogie.rover.toml")


def _sources(folder: Path) -> Path:
    for name in SOURCES:
        shutil.copy(shipped("models") / "rocker_bogie" / name, folder)
    return folder / SOURCES[0]


def _control(rover, drive: float, steer: float) -> np.ndarray:
    front = {w.steer for w in rover.wheels if w.corner in ("lf", "rf")}
    return np.array([drive if g.name == "drive" else steer * (j in front) for g in rover.groups for j in g.joints])


def test_folder_is_in_order(tmp_path: Path) -> None:
    """Six wheels, ten motors, 176 kg; the committed files are what the conversion writes; a third of it in front."""
    rover = load_rover("rocker_bogie")
    assert [w.corner for w in rover.wheels] == ["lf", "rf", "lm", "rm", "lr", "rr"]
    assert (len(rover.joints), rover.mass) == (10, pytest.approx(176.0))
    again = convert(_sources(tmp_path), tmp_path / "out")
    for name in ("rocker_bogie.xml", "rover.toml", "scene.xml"):
        assert (again.folder / name).read_bytes() == (rover.folder / name).read_bytes(), name
    readme = (rover.folder / "README.md").read_text()
    assert "176 kg" in readme and (rover.folder / "LICENSE").is_file()


@pytest.mark.parametrize(
    ("engine", "tolerance"), [("structured", 1e-7), pytest.param("mjx", 1e-10, marks=pytest.mark.slow)]
)
def test_engines_agree_over_a_crater(engine: str, tolerance: float) -> None:
    """4 s with steering over a crater's rim: against native MuJoCo, whose equality gives way.

    The rockers turn by more than a degree on the way, one up as the other goes down, and so do not add up.
    """
    with jax.enable_x64(True):
        model = make_model("rocker_bogie", "flat")
        model = model.replace(terrain=cases(model.rover, ("crater, soft",))[0].terrain)
        control, intervals, every = _control(model.rover, 0.35, 0.1), 40, 50
        native = NativeBackend(model)
        native.reset()
        for _ in range(intervals * every):
            native.step(control)
        reference = native.state().qpos[0]
        system = build(model, engine)
        held = jnp.tile(jnp.asarray(control), (intervals, 1))
        run = jax.jit(lambda s: system.rollout(system.params, s, held, every))
        end, seen = jax.device_get(run(jax.jit(system.reset)(system.params)))
        np.testing.assert_allclose(end.qpos, reference, atol=tolerance)
        compiled = system.engine.mj_model
        left, right = (end.qpos[compiled.joint(f"{side}_rocker_pivot").qposadr[0]] for side in "lr")
        assert abs(left) > np.deg2rad(0.5) and abs(left + right) < 1e-6
        assert abs(seen.euler.y[-1]) < np.deg2rad(3.0)


def test_stands_level_with_equal_loads() -> None:
    """After 2 s on level soil: no pitch, and six wheels that carry alike, which is what rockers and bogies are for."""
    rover = load_rover("rocker_bogie")
    with jax.enable_x64(True):
        model = make_model("rocker_bogie", "flat")
        system = build(model, "structured")
        still = jnp.zeros((20, len(system.joint_names)))
        seen = jax.device_get(jax.jit(lambda p: system.rollout(p, system.reset(p), still, 50)[1])(system.params))
        assert abs(seen.euler.y[-1]) < np.deg2rad(1.0)
        loads = seen.wheel_force.z[-1]
        assert loads.sum() == pytest.approx(rover.mass * model.gravity, rel=1e-2)
        assert loads.min() > 0.8 * loads.max()


MIMIC = '<axis xyz="0 1 0"/><mimic joint="left_bogie_pivot" multiplier="-0.5" offset="0.1"/>'


def _with_mimic(data: Path, tmp_path: Path, mimic: str) -> Path:
    text = (data / "rocker_bogie.urdf").read_text()
    place = text.index('<joint name="right_bogie_pivot"')
    after = text[place:].replace('<axis xyz="0 1 0"/>', mimic, 1)
    path = tmp_path / "mimic.urdf"
    path.write_text(text[:place] + after)
    return path


def test_mimic_becomes_an_equality(data: Path, tmp_path: Path) -> None:
    """q = -0.5 q' + 0.1 holds in native MuJoCo; an offset is beyond the structured engine, which says so."""
    rover = convert(_with_mimic(data, tmp_path, MIMIC), tmp_path / "out")
    compiled = rover.compile()
    assert compiled.neq == 1
    state = mujoco.MjData(compiled)
    state.qpos[compiled.joint("right_bogie_pivot").qposadr[0]] = 0.1
    mujoco.mj_step(compiled, state, 500)
    follower, leader = (state.joint(f"{side}_bogie_pivot").qpos[0] for side in ("right", "left"))
    assert follower == pytest.approx(-0.5 * leader + 0.1, abs=1e-4)
    with pytest.raises(UnsuitableError, match="no fixed ratio of two angles"):
        build(make_model(rover, "flat"), "structured")


def test_mimic_follows_an_axis_that_the_conversion_reverses(data: Path, tmp_path: Path) -> None:
    """A steering joint about -z is turned to +z: the ratio changes its sign with it, and it loses its motor."""
    text = (data / "steered.urdf").read_text()

    def with_axis(text: str, joint: str, axis: str) -> str:
        start = text.index(f'<joint name="{joint}"')
        return text[:start] + re.sub(r"<axis [^>]*/>", axis, text[start:], count=1)

    text = with_axis(text, "FrontLeftForkJoint", '<axis xyz="0 0 -1"/>')
    tied = '<axis xyz="0 0 1"/><mimic joint="FrontLeftForkJoint" multiplier="-1"/>'
    path = tmp_path / "steered.urdf"
    path.write_text(with_axis(text, "FrontRightForkJoint", tied))
    rover = convert(path, tmp_path / "out")
    compiled = rover.compile()
    follower, leader = (compiled.joint(int(j[0])).name for j in (compiled.eq_obj1id, compiled.eq_obj2id))
    assert (follower, leader, compiled.eq_data[0, 1]) == ("FrontRightForkJoint", "FrontLeftForkJoint", 1.0)
    assert follower not in rover.joints and leader in rover.joints
    assert any("follows another joint" in note for note in rover.notes)


MISTAKES = {
    "unknown leader": ('<axis xyz="0 1 0"/><mimic joint="nobody"/>', ["right_bogie_pivot", "'nobody'"]),
    "follows itself": ('<axis xyz="0 1 0"/><mimic joint="right_bogie_pivot"/>', ["no other moving joint"]),
    "no leader": ('<axis xyz="0 1 0"/><mimic/>', ["mimic joint", "missing"]),
    "held still": ('<axis xyz="0 1 0"/><mimic joint="left_bogie_pivot" multiplier="0"/>', ["holds the joint still"]),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_are_told(mistake: str, data: Path, tmp_path: Path) -> None:
    mimic, words = MISTAKES[mistake]
    with pytest.raises(UserError) as caught:
        convert(_with_mimic(data, tmp_path, mimic), tmp_path / "out")
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_differentials_must_be_parallel_pivots(tmp_path: Path) -> None:
    urdf = _sources(tmp_path)
    told = tmp_path / SOURCES[1]
    text = told.read_text()
    for other, words in (("lf_steer", "not parallel"), ("nobody", "no moving joint"), ("l_rocker_pivot", "is joint1")):
        told.write_text(text.replace('joint2 = "r_rocker_pivot"', f'joint2 = "{other}"'))
        with pytest.raises(UserError, match=words):
            convert(urdf, tmp_path / "out")
