"""What the eye sees of a rover is a matter of its look alone: physics stays as it is, and a broken look is refused."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.rover import load_rover
from lunar_mjx.rover.look import FILE, LOOK, seen_spec

LARGEST = 2_000_000
"""Bytes that the look of a shipped rover may take."""


@pytest.mark.parametrize("name", ["viper", "luvmi_x"])
def test_a_look_changes_nothing_that_moves(name: str) -> None:
    rover = load_rover(name)
    plain, seen = rover.compile(), seen_spec(rover).compile()
    assert seen.ngeom > plain.ngeom + 50
    for field in ("nbody", "nq", "nv", "nu", "neq"):
        assert getattr(plain, field) == getattr(seen, field)
    for field in ("body_mass", "body_inertia", "body_ipos", "body_pos", "jnt_pos", "jnt_axis", "qpos0", "dof_armature"):
        np.testing.assert_array_equal(getattr(plain, field), getattr(seen, field))
    # the plain shapes, which may touch ground, are all there; what was added touches nothing
    touching = seen.geom_conaffinity != 0
    assert touching.sum() == plain.ngeom
    np.testing.assert_array_equal(seen.geom_size[touching], plain.geom_size)
    assert not seen.geom_contype[~touching].any()
    assert (rover.folder / FILE).stat().st_size < LARGEST


@pytest.mark.parametrize("name", ["viper", "luvmi_x"])
def test_it_has_wheels_with_grousers_a_mast_and_panels(name: str) -> None:
    rover = load_rover(name)
    m = seen_spec(rover).compile()
    data = mujoco.MjData(m)
    mujoco.mj_forward(m, data)
    shown = m.geom_group < LOOK.hidden
    for wheel in rover.wheels:
        own = (m.geom_bodyid == m.body(wheel.body).id) & shown
        rims = own & (m.geom_type == mujoco.mjtGeom.mjGEOM_CYLINDER)
        assert m.geom_size[rims, 0].max() == pytest.approx(wheel.radius)
        away = np.linalg.norm(m.geom_pos[own & (m.geom_group == LOOK.detail)], axis=1)
        assert (away > 0.9 * wheel.radius).sum() >= 12
    top = data.geom_xpos[shown, 2].max()
    assert top > 0.85 * (rover.standing_height + rover.chassis_points[:, 2].max())
    blue = shown & (m.geom_rgba[:, 2] > 2.0 * m.geom_rgba[:, 0])
    assert blue.any()


def test_the_front_camera_does_not_look_into_the_head() -> None:
    from lunar_mjx.cameras import front_mount

    for name in ("viper", "luvmi_x"):
        rover = load_rover(name)
        m = seen_spec(rover).compile()
        data = mujoco.MjData(m)
        mujoco.mj_forward(m, data)
        body = m.body(rover.chassis).id
        eye = data.xpos[body] + data.xmat[body].reshape(3, 3) @ front_mount(rover).position
        shown = (m.geom_group < LOOK.hidden) & (m.geom_bodyid == body)
        reach = data.geom_xpos[shown, 0] + np.abs(
            data.geom_xmat[shown].reshape(-1, 3, 3)[:, 0, :] * m.geom_size[shown]
        ).sum(1)
        high = np.abs(data.geom_xpos[shown, 2] - eye[2]) < 0.2
        assert reach[high].max() < eye[0] - 0.005


@pytest.fixture
def broken(tmp_path: Path):
    """A copy of LUVMI-X whose look is another."""
    rover = load_rover("luvmi_x")

    def make(text: str):
        shutil.copy(rover.mjcf, tmp_path / rover.mjcf.name)
        (tmp_path / FILE).write_text(text, encoding="utf-8")
        return dataclasses.replace(rover, folder=tmp_path)

    return make


HEAD = 'format = "lunar-mjx-look/1"\n[colours]\nred = [1.0, 0.0, 0.0]\n'
PART = HEAD + '[[parts]]\nbodies = ["chassis"]\nkind = "box"\nsize = [1.0, 1.0, 1.0]\ncolour = "red"\n'


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ("parts = []", "format"),
        (PART.replace('"chassis"', '"nobody"'), "bodies"),
        (PART.replace("1.0, 1.0, 1.0]\ncol", "1.0, -1.0, 1.0]\ncol"), "size"),
        (PART.replace('"box"', '"cone"'), "kind"),
        (PART.replace('colour = "red"', 'colour = "blue"'), "colour"),
        (PART + "ring = 1000000\n", "ring"),
        (PART + 'script = "x"\n', "script"),
        (PART.replace("red = [1.0", "red = [nan"), "red"),
        (PART.replace("size = [1.0", "size = [1e300"), "size, at = .* is beyond 1000 m"),
        (PART + "at = [1e300, 0.0, 0.0]\n", "size, at = .* is beyond 1000 m"),
        (PART + 'detail = "yes"\n', "detail = 'yes' is neither true nor false"),
    ],
)
def test_a_broken_look_is_one_sentence(broken, text: str, field: str) -> None:
    with pytest.raises(UserError, match=field):
        seen_spec(broken(text))


def test_a_ring_stands_about_the_axle(broken) -> None:
    spec = seen_spec(broken(PART + "at = [0.5, 0.0, 0.0]\nring = 4\n"))
    places = np.array([g.pos for b in spec.bodies if b.name == "chassis" for g in b.geoms][-4:])
    np.testing.assert_allclose(places, [[0.5, 0, 0], [0, 0, -0.5], [-0.5, 0, 0], [0, 0, 0.5]], atol=1e-12)
