"""Colour, depth and labels in JAX: against an analytic picture, against MuJoCo's renderer, and what they must obey."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scene import EYE, bumpy

from benchmarks.camera_reference import CENTRE, FROM, RADIUS, SUN, TOWARDS, analytic, boulder, ssim
from lunar_mjx.cameras import (
    Film,
    Light,
    Pinhole,
    Placed,
    Regolith,
    Sun,
    front_mount,
    look_at,
    mounted,
    painted,
    picture,
    pictures,
    placed,
    rover_shapes,
    stereo,
)
from lunar_mjx.cameras.shapes import BOX
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat


@pytest.fixture(scope="module")
def draw():
    """A compiled camera without rovers."""
    return jax.jit(
        lambda terrain, position, turn, to_sun: picture(terrain, position, turn, EYE, Light(sun=SUN), sun=to_sun)
    )


def seen_by(draw, terrain, pose, sun=SUN):
    given = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation, sun.direction))
    return draw(terrain, *given)


def test_a_boulder_on_level_ground_looks_as_the_formulas_say(draw) -> None:
    pose = look_at(FROM, TOWARDS)
    found = seen_by(draw, boulder(), pose)
    rgb, label = analytic(pose, Light(sun=SUN), EYE)
    near = np.isfinite(np.asarray(found.depth)) | (label == 0)
    assert np.mean((np.asarray(found.label) == label)[near]) > 0.99
    both = np.where(near[..., None], np.asarray(found.rgb), rgb)  # ground beyond the far plane counts as sky
    assert ssim(both[..., 0], rgb[..., 0]) > 0.95
    assert np.median(np.abs(both - rgb)[label == 1]) < 2e-3
    assert (label == 2).sum() > 100 and np.median(np.abs(both - rgb)[label == 2]) < 5e-3


def test_shadows_are_as_long_as_the_sun_is_low(draw) -> None:
    """A boulder's shadow ends where the last ray over it comes down."""
    pose = look_at((4.0, -9.0, 9.0), (4.0, 0.0, 0.0))
    lengths = []
    for elevation in (30.0, 10.0):
        found = seen_by(draw, boulder(), pose, Sun(90.0, elevation))  # light from the east: shadows to the west
        depth, label = np.asarray(found.depth), np.asarray(found.label)
        point = pose.position + np.where(np.isfinite(depth), depth, 0.0)[..., None] * (EYE.rays() @ pose.rotation.T)
        dark = (label == 1) & (np.asarray(found.rgb)[..., 0] < 0.5 * np.median(np.asarray(found.rgb)[label == 1]))
        lengths.append(CENTRE[0] - point[dark][:, 0].min())
    tips = [CENTRE[2] / np.tan(np.radians(e)) + RADIUS / np.sin(np.radians(e)) for e in (30.0, 10.0)]
    assert lengths[0] == pytest.approx(tips[0], abs=0.25)
    assert lengths[1] == pytest.approx(tips[1], abs=0.4)


def test_below_the_horizon_the_sun_lights_nothing(draw) -> None:
    pose = look_at((0.0, 0.0, 1.5), (4.0, 0.3, 0.3))
    down = jnp.asarray([0.9, 0.0, -0.1], jnp.float32)
    given = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation))
    found = draw(boulder(), *given, down)
    assert float(found.rgb.max()) < 0.2  # Earthshine, exposed for a Sun 2 deg high


def test_agrees_with_the_renderer(scene) -> None:
    camera, qpos = scene
    images = camera.front()
    rover = load_rover("luvmi_x")
    shapes = rover_shapes(rover)

    @jax.jit
    def draw_all(q):
        position, turn = mounted(front_mount(rover), q)
        return picture(bumpy(), position, turn, EYE, rovers=placed(shapes, rover, q))

    found = draw_all(jnp.asarray(qpos, jnp.float32))
    depth, label = np.asarray(found.depth), np.asarray(found.label)
    assert (label == images.segmentation).mean() > 0.99
    both = np.isfinite(depth) & np.isfinite(images.depth) & (label == images.segmentation)
    assert np.median(np.abs(depth[both] / images.depth[both] - 1.0)) < 0.002


def test_a_free_camera_sees_the_rover_as_the_renderer_does(scene) -> None:
    camera, qpos = scene
    rover = load_rover("luvmi_x")
    pose = look_at(np.array([-0.5, -1.0, 0.9]), qpos[:3])
    images = camera.take(pose, EYE)
    given = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation, qpos))
    found = jax.jit(lambda p, t, q: picture(bumpy(), p, t, EYE, rovers=placed(rover_shapes(rover), rover, q)))(*given)
    label, depth = np.asarray(found.label), np.asarray(found.depth)
    assert (images.segmentation == 3).sum() > 300
    assert (label == images.segmentation).mean() > 0.985
    body = (label == 3) & (images.segmentation == 3)
    assert np.median(np.abs(depth[body] / images.depth[body] - 1.0)) < 0.002


def test_a_rover_throws_a_shadow() -> None:
    ground = flat(60.0)
    box = Placed(
        np.array([BOX]), jnp.array([[0.2, 0.2, 0.5]]), jnp.array([[4.0, 0.0, 0.5]]), jnp.eye(3)[None], jnp.ones((1, 3))
    )
    pose = look_at((4.0, -6.0, 5.0), (4.0, 0.0, 0.0))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    light = Light(sun=Sun(90.0, 30.0))
    alone = picture(ground, *given, EYE, light)
    found = picture(ground, *given, EYE, light, box)
    changed = np.asarray((found.label == 1) & (found.rgb[..., 0] < 0.5 * alone.rgb[..., 0]))
    depth = np.asarray(found.depth)
    point = pose.position + depth[..., None] * (EYE.rays() @ pose.rotation.T)
    assert changed.sum() > 20
    west = 4.0 - 0.2 - point[changed][:, 0]
    assert west.min() > -0.1 and west.max() == pytest.approx(1.0 / np.tan(np.radians(30.0)), abs=0.25)


@pytest.mark.slow
def test_batches_agree_with_one_and_see_each_other() -> None:
    rover, terrain, eye = load_rover("luvmi_x"), bumpy(), Pinhole(24, 18)
    qpos = np.tile(rover.compile().qpos0, (3, 1))
    qpos[:, :3] = [[-3.0, 0.0, 0.4], [-1.5, 0.0, 0.4], [-2.0, 2.0, 0.4]]
    qpos = jnp.asarray(qpos, jnp.float32)
    whole, parts = (jax.jit(lambda q, n=n: pictures(terrain, rover, q, eye, at_once=n))(qpos) for n in (None, 2))
    assert whole.rgb.shape == (3, 18, 24, 3) and whole.label.shape == (3, 18, 24)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-4)
    company = jax.jit(lambda q: pictures(terrain, rover, q[:1], eye, others=q[None, 1:]))(qpos)
    assert int((company.label == 3).sum()) > int((whole.label[0] == 3).sum()) + 3


def test_stereo_shifts_by_the_baseline_over_depth() -> None:
    left, right = stereo(look_at((0.0, 0.0, 1.5), (4.0, 0.3, 0.3)), 0.2)
    np.testing.assert_allclose(right.position - left.position, 0.2 * left.rotation[:, 0])
    np.testing.assert_allclose(right.rotation, left.rotation)


def test_noise_is_as_large_as_its_electrons_say_and_follows_its_key(draw) -> None:
    pose = look_at((0.0, 0.0, 3.0), (0.5, 0.0, 0.0))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    film = Film(full_well=2000.0, read_noise=10.0, gamma=1.0, exposure=3.0)
    light = Light(sun=SUN, film=film)
    clean = np.asarray(picture(flat(60.0), *given, EYE, light).rgb)
    noisy = [np.asarray(picture(flat(60.0), *given, EYE, light, key=jax.random.PRNGKey(k)).rgb) for k in (0, 0, 1)]
    np.testing.assert_array_equal(noisy[0], noisy[1])
    spread = np.sqrt(clean * 2000.0 + 100.0) / 2000.0
    assert np.std((noisy[0] - clean) / spread) == pytest.approx(1.0, abs=0.05)
    assert np.abs(noisy[0] - noisy[2]).max() > 0.01


def test_paint_darkens_where_it_lies() -> None:
    shade = np.ones((40, 40))
    shade[20:, :] = 0.5  # rows run from north to south: the south half
    paint = painted(shade, (-4.0, -4.0), 8.0)
    pose = look_at((0.0, 0.0, 6.0), (0.0, 0.05, 0.0))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    light = Light(sun=SUN, film=Film(gamma=1.0))
    plain, dark = (np.asarray(picture(flat(60.0), *given, EYE, light, paint=p).rgb[..., 0]) for p in (None, paint))
    ratio = dark / plain
    assert ratio[5, 40] == pytest.approx(1.0, abs=1e-3) and ratio[55, 40] == pytest.approx(0.5, abs=1e-3)


def test_dust_and_vignetting() -> None:
    pose = look_at((0.0, 0.0, 1.5), (4.0, 0.3, 0.3))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    plain, veiled, dim = (
        np.asarray(jax.jit(lambda f=film: picture(boulder(), *given, EYE, Light(sun=SUN, film=f)).rgb)())
        for film in (Film(gamma=1.0), Film(gamma=1.0, dust=0.2), Film(gamma=1.0, vignetting=True))
    )
    assert veiled[0, 0].mean() > 0.005 and plain[0, 0].max() == 0.0  # even the sky
    middle, corner = (30, 40), (59, 0)
    assert dim[middle] == pytest.approx(plain[middle], rel=2e-3)
    angle = np.linalg.norm(EYE.rays()[corner])
    assert dim[corner] == pytest.approx(plain[corner] / angle**4, rel=1e-3)


def test_lommel_seeliger_is_flatter_at_the_limb(draw) -> None:
    """Without multiple scattering the soil is darker; both agree within a fifth."""
    a, b = (float(Regolith(law=law).radiance_factor(0.4, 0.3, 0.3)) for law in ("hapke", "lommel_seeliger"))
    assert b < a < 1.25 * b
