"""MuJoCo's renderer and the cameras in JAX look at one scene: rocks far away, shadows, brightness, tracks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.cameras import (
    Light,
    Pictures,
    Pinhole,
    Pose,
    RoverCamera,
    Sun,
    Track,
    look_at,
    picture,
    project,
    trodden,
)
from lunar_mjx.cameras.camera import Images
from lunar_mjx.cameras.chase import Chase
from lunar_mjx.cameras.ground_map import MAP_COLOURS
from lunar_mjx.cameras.scene import near_and_far
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import HeightField, Terrain, build_rocks, flat

GROUND, ROCK = 1, 2
EYE = Pinhole(160, 120, 45.0)
SUN = Sun(180.0, 12.0)
ROCKS = np.array([[18.0, 3.0], [28.0, -4.0], [42.0, 6.0], [54.0, -3.0]])
RADIUS = 0.9


@pytest.fixture(scope="module")
def plain() -> Terrain:
    """Level ground with four boulders 18 to 54 m away along x, half in the ground."""
    ground = flat(160.0)
    centres = np.column_stack([ROCKS, np.full(len(ROCKS), 0.2)])
    rocks = build_rocks(centres, np.full(len(ROCKS), RADIUS), (-80.0, -80.0, 80.0, 80.0))
    return Terrain(ground.field, rocks, None, jnp.zeros(3), "plain")


def in_jax(terrain: Terrain, pose: Pose, sun: Sun, **more: object) -> Pictures:
    given = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation))
    draw = jax.jit(lambda p, t: picture(terrain, p, t, EYE, Light(sun=sun), far=90.0, **more))
    return jax.tree.map(np.asarray, draw(*given))


def seen_by_both(
    opengl: tuple[str, ...], plain: Terrain, sun: Sun, to: tuple[float, float, float] = (30.0, 0.0, 0.0)
) -> tuple[Pose, Images, Pictures]:
    pose = look_at((0.0, 0.0, 5.0), to)
    with RoverCamera(load_rover("luvmi_x"), plain, camera=EYE, sun=sun, largest=(160, 120), backends=opengl) as camera:
        qpos = camera.model.qpos0.copy()
        qpos[:3] = -3.0, 0.0, 0.3
        camera.place(qpos)
        images = camera.take(pose)
    return pose, images, in_jax(plain, pose, sun)


@pytest.fixture(scope="module")
def both(opengl: tuple[str, ...], plain: Terrain) -> tuple[Pose, Images, Pictures]:
    return seen_by_both(opengl, plain, SUN)


@pytest.fixture
def allowed(opengl: tuple[str, ...], monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets `Chase` use OpenGL, which the tests' settings turn off."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)


def test_both_see_the_same_rocks_up_to_54_m(both) -> None:
    pose, drawn, found = both
    assert (drawn.segmentation == found.label).mean() > 0.995
    alike = (drawn.segmentation == found.label) & np.isfinite(drawn.depth) & np.isfinite(found.depth)
    assert np.median(np.abs(drawn.depth[alike] / found.depth[alike] - 1.0)) < 0.002
    for place in ROCKS:
        u, v, depth = project(pose, EYE, np.array([[*place, 0.4]]))[0]
        for label, seen in ((drawn.segmentation, drawn.depth), (found.label, found.depth)):
            assert label[int(v), int(u)] == ROCK
            assert depth - 1.0 < seen[int(v), int(u)] < depth + 0.5


def test_both_see_the_shadows_of_rocks_up_to_28_m(both) -> None:
    """The Sun is in the south: shadows lie north of the rocks. MuJoCo's map of shadows ends 40 m from the rover."""
    pose, drawn, found = both
    for place in ROCKS[:2]:
        u, v, _ = project(pose, EYE, np.array([[place[0], place[1] + 2.0, 0.0]]))[0]
        for colours, label in ((drawn.rgba[..., 0] / 255.0, drawn.segmentation), (found.rgb[..., 0], found.label)):
            assert label[int(v), int(u)] == GROUND
            assert colours[int(v), int(u)] < 0.5 * np.median(colours[label == GROUND])


def test_ground_and_rocks_are_as_bright_in_both(both) -> None:
    _, drawn, found = both
    for kind in (GROUND, ROCK):
        a = np.median(drawn.rgba[..., 0][drawn.segmentation == kind]) / 255.0
        b = np.median(found.rgb[..., 0][found.label == kind])
        assert a == pytest.approx(b, rel=0.2)


@pytest.mark.parametrize("elevation_deg", [6.0, 2.0])
def test_both_expose_a_low_sun_alike(opengl: tuple[str, ...], plain: Terrain, elevation_deg: float) -> None:
    _, drawn, found = seen_by_both(opengl, plain, Sun(180.0, elevation_deg))
    red, levels = drawn.rgba[..., 0] / 255.0, {}
    for name, colour, label in (("gl", red, drawn.segmentation), ("jax", found.rgb[..., 0], found.label)):
        # of a rock half is dark at any exposure, and its Sun's side burns out
        lit = colour[(label == ROCK) & (colour > 0.3)]
        levels[name] = np.median(colour[label == GROUND]), np.mean(colour[label == ROCK] > 0.3), np.median(lit)
    assert levels["gl"][0] == pytest.approx(levels["jax"][0], rel=0.15)
    assert levels["gl"][1] == pytest.approx(levels["jax"][1], abs=0.1)
    assert levels["gl"][2] == pytest.approx(levels["jax"][2], rel=0.15)


@pytest.mark.parametrize("elevation_deg", [6.0, 2.0])
def test_rough_ground_in_a_low_sun_looks_alike_in_both(opengl: tuple[str, ...], elevation_deg: float) -> None:
    """By all quarters of its brightness at 6 degrees; at 2 half of the ground is dark."""
    at = np.arange(-24.0, 24.05, 0.2)
    x, y = np.meshgrid(at, at)
    heights = 0.15 * np.sin(0.9 * x) * np.cos(0.7 * y) + 0.02 * np.sin(5.0 * x + 3.0 * y)
    field = HeightField(*(jnp.asarray(v, jnp.float32) for v in (heights, -24.0, -24.0, 0.2)))
    rough, sun = Terrain(field, None, None, jnp.zeros(3), "rough"), Sun(180.0, elevation_deg)
    _, drawn, found = seen_by_both(opengl, rough, sun, to=(14.0, 0.0, 0.0))
    ground = (drawn.segmentation == GROUND) & (found.label == GROUND) & (found.depth < 25.0)
    drawn, found = drawn.rgba[..., 0][ground] / 255.0, found.rgb[..., 0][ground]
    assert np.mean(drawn > 0.2) == pytest.approx(np.mean(found > 0.2), abs=0.05)
    for share in (0.25, 0.5, 0.75, 0.9):
        levels = [np.quantile(v[v > 0.2], share) for v in (drawn, found)]
        assert levels[0] == pytest.approx(levels[1], rel=0.2), share


def test_fine_and_coarse_ground_meet_without_a_shadow(opengl: tuple[str, ...]) -> None:
    """Fine ground ends 15 m away; a coarse one 5 cm lower lay in its shadow."""
    with RoverCamera(
        load_rover("luvmi_x"), flat(160.0), camera=EYE, sun=Sun(250.0, 6.0), largest=(160, 120), backends=opengl
    ) as camera:
        away = camera.model.qpos0.copy()
        away[:3] = -3.0, -5.0, 0.3
        camera.place(away)
        images = camera.take(look_at((0.0, 0.0, 5.0), (30.0, 0.0, 0.0)))
    ground = images.rgba[..., 0][images.segmentation == GROUND].astype(float)
    assert ground.min() > 0.6 * np.median(ground)


def test_fine_ground_lies_on_the_edges_of_the_coarse_one() -> None:
    """Also where the grid is no multiple of the coarse cells, and in its corner."""
    at = 0.1 * np.arange(807)
    x, y = np.meshgrid(at, at[:640])
    field = HeightField(np.sin(x) * np.cos(0.8 * y), 0.0, 0.0, 0.1)
    terrain = Terrain(field, None, None, np.zeros(3), "hills")
    for low, high in (((20.0, 20.0), (50.0, 50.0)), ((0.0, 40.0), (30.0, 63.9)), ((70.0, 50.0), (80.6, 63.9))):
        near, far = near_and_far(terrain, np.array(low), np.array(high))
        assert far is not None
        assert (np.array(near.low) <= np.array(low) + 1e-9).all()
        assert (np.array(near.high) >= np.array(high) - 0.1 * np.ceil(807 / 159) * np.ones(2) - 1e-9).all()
        rows, cols = near.heights.shape
        east, north = (np.linspace(a, b, n) for a, b, n in zip(near.low, near.high, (cols, rows), strict=True))
        far_east, far_north = (
            np.linspace(a, b, n) for a, b, n in zip(far.low, far.high, far.heights.shape[::-1], strict=True)
        )
        for edge in (0, -1):
            if 0.0 < east[edge] < far_east[-1] - 1e-6:
                column = np.abs(far_east - east[edge]).argmin()
                assert abs(far_east[column] - east[edge]) < 1e-6
                covered = north <= far_north[-1] + 1e-6
                coarse = np.interp(north[covered], far_north, far.heights[:, column])
                np.testing.assert_allclose(near.heights[covered, edge], coarse, atol=1e-6)
            if 0.0 < north[edge] < far_north[-1] - 1e-6:
                row = np.abs(far_north - north[edge]).argmin()
                assert abs(far_north[row] - north[edge]) < 1e-6
                covered = east <= far_east[-1] + 1e-6
                coarse = np.interp(east[covered], far_east, far.heights[row])
                np.testing.assert_allclose(near.heights[edge, covered], coarse, atol=1e-6)
        # within, the ground that wheels touch
        assert near.heights[5, 5] == pytest.approx(np.sin(east[5]) * np.cos(0.8 * north[5]), abs=1e-6)


def test_tracks_lie_at_the_same_place_in_both(opengl: tuple[str, ...]) -> None:
    at = np.linspace(-2.0, 2.0, 101)
    tracks = [Track(np.stack([at, np.full(101, y)], axis=-1), 0.4, 0.0) for y in (0.6, 1.6)]
    ground, sun = flat(40.0), Sun(180.0, 60.0)
    pose = look_at((0.0, 1.0, 5.0), (0.0, 1.0, 0.0), up=(0.0, 1.0, 0.0))
    pictures = []
    for shown in (tracks, []):
        with RoverCamera(
            load_rover("luvmi_x"), ground, camera=EYE, sun=sun, tracks=shown, largest=(160, 120), backends=opengl
        ) as camera:
            away = camera.model.qpos0.copy()
            away[:3] = -6.0, 0.0, 0.3
            camera.place(away)
            pictures.append(camera.picture(pose).astype(float)[..., 0])
        paint = trodden(shown, np.array([-10.0, -9.0]), 20.0)
        pictures.append(in_jax(ground, pose, sun, paint=paint).rgb[..., 0])
    in_gl, in_jax_ = pictures[0] / pictures[2], pictures[1] / pictures[3]
    drawn, found = in_gl < 0.92, in_jax_ < 0.92
    assert drawn.mean() > 0.1
    assert (drawn == found).mean() > 0.96
    # and they are as dark
    assert np.median(in_jax_[drawn & found]) == pytest.approx(np.median(in_gl[drawn & found]), rel=0.03)


def test_tracks_that_grow_are_those_known_beforehand(allowed: None) -> None:
    """As the pictures of an environment are taken, which does not know where its rover will drive."""
    rover, goal = load_rover("luvmi_x"), np.array([6.0, 0.0])
    at = np.linspace(-3.0, 1.0, 81)
    whole = [Track(np.stack([at, np.full(81, y)], axis=-1), 0.12, 0.05) for y in (-0.3, 0.3)]
    qpos = rover.compile().qpos0.copy()
    qpos[:3] = 1.0, 0.0, 0.3
    ground, places = flat(40.0), np.array([[-3.0, 0.0], goal])
    known = Chase(rover, ground, places, (160, 120), whole, SUN)
    first, last = (known.frame(qpos, 0.0, goal, 0.0, row) for row in (0, 80))
    known.close()
    live = Chase(rover, ground, places, (160, 120), sun=SUN)
    for end in (20, 41, 81):
        grown = live.frame(qpos, 0.0, goal, 0.0, grown=[Track(t.places[:end], t.width, t.pitch) for t in whole])
    live.close()
    trodden_pixels = np.abs(last.astype(int) - first).sum(axis=-1) > 20
    assert trodden_pixels.sum() > 100
    assert np.abs(last.astype(int) - grown).sum(axis=-1)[trodden_pixels].mean() < 3.0


def test_a_goal_behind_the_rover_is_hidden_by_it(allowed: None) -> None:
    rover = load_rover("viper")
    qpos = rover.compile().qpos0.copy()
    qpos[:3] = 0.0, 0.0, rover.standing_height
    chase = Chase(rover, flat(60.0), np.zeros((1, 2)), (160, 120), sun=SUN)
    counts = []
    for goal in ((2.5, 0.0), (-2.5, 0.0), (2.5, 3.0)):
        image = chase.frame(qpos, 0.0, np.array(goal), -1.0).astype(int)
        counts.append(int((np.abs(image - np.array(MAP_COLOURS.goal)).sum(axis=-1) < 120).sum()))
    chase.close()
    ahead, before_it, aside = counts
    assert before_it > aside > 10
    assert ahead < 0.5 * aside
