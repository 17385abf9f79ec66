"""Lens distortion: against OpenCV's formula written anew, and what pictures through a lens must obey."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scene import EYE, bumpy

from lunar_mjx.cameras import (
    Film,
    Lens,
    Light,
    Pinhole,
    Pose,
    RoverCamera,
    Sun,
    depth_image,
    facing,
    lens_of,
    look_at,
    picture,
    pictures,
    placed,
    project,
    rover_shapes,
    stereo,
)
from lunar_mjx.cameras.rays import trace
from lunar_mjx.envs.navigation.config import NavigationConfig
from lunar_mjx.errors import UserError
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import flat

BARREL = Lens(-0.28, 0.09, 4e-4, -1e-3, -0.01)
WIDE = Pinhole(80, 60, lens=BARREL)
HEIGHT = 1.5


def opencv(points: np.ndarray, camera: np.ndarray, coefficients: tuple[float, ...]) -> np.ndarray:
    """cv2.projectPoints without a pose: points (n, 3), z ahead and y down; pixels (n, 2), 0 the first one's centre."""
    k1, k2, p1, p2, k3 = coefficients
    a, b = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
    r2 = a**2 + b**2
    cdist = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = a * cdist + p1 * (2 * a * b) + p2 * (r2 + 2 * a**2)
    yd = b * cdist + p1 * (r2 + 2 * b**2) + p2 * (2 * a * b)
    return (np.column_stack([xd, yd, np.ones_like(xd)]) @ camera.T)[:, :2]


def matrix(camera: Pinhole) -> np.ndarray:
    """OpenCV's camera matrix, whose pixels have their centres at whole numbers."""
    f = camera.focal
    return np.array([[f, 0, 0.5 * camera.width - 0.5], [0, f, 0.5 * camera.height - 0.5], [0, 0, 1.0]])


@functools.cache
def ground_depth():
    """Level ground seen by a camera that looks along x from `HEIGHT`, its depth up to 20 m."""
    ground = flat(60.0)
    return jax.jit(lambda p, t, camera: depth_image(ground, p, t, camera, 20.0), static_argnums=2)


@pytest.mark.parametrize(
    "given", [(-0.28, 0.09, 4e-4, -1e-3, -0.01), (0.12, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.02, -0.03, 0.0)]
)
def test_every_pixels_ray_is_seen_at_that_pixel_by_opencvs_formula(given) -> None:
    camera = Pinhole(160, 120, 70.0, lens=lens_of(given))
    rays = camera.rays()
    assert (rays[..., 2] == -1.0).all()
    found = opencv(3.0 * rays.reshape(-1, 3) * [1, -1, -1], matrix(camera), given).reshape(120, 160, 2)
    columns, rows = np.meshgrid(np.arange(160), np.arange(120))
    assert np.abs(found - np.stack([columns, rows], axis=-1)).max() < 1e-6


def test_points_are_projected_as_opencv_does() -> None:
    rng = np.random.default_rng(1)
    pose = look_at((1.0, 2.0, 1.0), (4.0, 1.0, 0.5))
    seen = np.column_stack([rng.uniform(-0.7, 0.7, 50), rng.uniform(-0.5, 0.5, 50), np.ones(50)]) * rng.uniform(
        1, 9, (50, 1)
    )
    points = pose.position + (seen * [1, -1, -1]) @ pose.rotation.T
    found = project(pose, WIDE, points)
    np.testing.assert_allclose(found[:, :2] - 0.5, opencv(seen, matrix(WIDE), dataclasses.astuple(BARREL)), atol=1e-9)
    np.testing.assert_allclose(found[:, 2], seen[:, 2])


@pytest.mark.parametrize(("k1", "bends"), [(-0.15, 1.0), (0.0, 0.0), (0.15, -1.0)])
def test_a_barrel_draws_the_ends_of_a_straight_line_inwards(k1: float, bends: float) -> None:
    """A line above the middle of the picture: rows grow downwards, so that the ends of a barrel's line lie lower."""
    camera = Pinhole(200, 120, 45.0, lens=Lens(k1) if k1 else None)
    line = np.column_stack([np.full(3, 4.0), [2.5, 0.0, -2.5], np.full(3, 1.2)])
    left, middle, right = project(Pose(np.zeros(3), facing(0.0)), camera, line)[:, 1]
    assert left == pytest.approx(right) and middle < 60
    assert np.sign(round(left - middle, 9)) == bends and (not bends or abs(left - middle) > 2.0)


def test_depth_is_along_the_axis_and_the_farthest_ground_bends() -> None:
    pose = Pose(np.array([-15.0, 0.0, HEIGHT]), facing(15.0))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    straight, bent = (np.asarray(ground_depth()(*given, camera)) for camera in (EYE, WIDE))
    down = -(WIDE.rays() @ pose.rotation.T)[..., 2]
    with np.errstate(divide="ignore"):
        expected = np.where((down > 0.0) & (HEIGHT / down < 20.0), HEIGHT / down, np.inf)
    sure = np.abs(expected - 20.0) > 0.3
    np.testing.assert_allclose(bent[sure], expected[sure], rtol=2e-3)
    # one depth is one row without a lens; above the middle a barrel's line sinks towards its ends
    for depth, sag in ((straight, 0), (bent, 2)):
        first = np.isfinite(depth).argmax(axis=0)
        assert first[0] - first[40] == pytest.approx(sag, abs=0.5 + sag / 2) and (first[0] > first[40]) == (sag > 0)


def test_a_stereo_pair_sees_one_point_at_one_depth() -> None:
    """Through two lenses: where the left picture's depth puts a point, the right one shows it."""
    terrain = bumpy()
    left, right = stereo(look_at((-2.0, 0.3, 1.5), (3.0, 0.3, 0.0)), 0.25)
    look = jax.jit(lambda p, t: depth_image(terrain, p, t, WIDE, 40.0))
    depths = [np.asarray(look(*(jnp.asarray(v, jnp.float32) for v in (s.position, s.rotation)))) for s in (left, right)]
    near = np.isfinite(depths[0])
    points = left.position + depths[0][near][:, None] * (WIDE.rays()[near] @ left.rotation.T)
    u, v, depth = project(right, WIDE, points).T
    inside = (u > 0) & (u < 80) & (v > 0) & (v < 60)
    assert inside.mean() > 0.8
    there = depths[1][v[inside].astype(int), u[inside].astype(int)]
    apart = np.abs(there / depth[inside] - 1.0)
    assert np.median(apart) < 0.01 and (apart < 0.05).mean() > 0.9  # within a pixel, but where a rock hides ground


def test_the_kernel_and_the_arrays_see_the_same_through_a_lens() -> None:
    camera = dataclasses.replace(WIDE, width=20, height=15)
    pose = look_at((-1.5, -2.0, 1.0), (1.0, 0.2, 0.2))
    given = [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    arrays, kernel = (
        np.asarray(jax.jit(lambda p, t, k=k: trace.trace(bumpy(), p, t, camera, 40.0, kernel=k).depth)(*given))
        for k in ("arrays", "interpreted")
    )
    np.testing.assert_allclose(arrays, kernel, rtol=1e-4)
    assert np.isfinite(arrays).mean() > 0.5


def test_pictures_through_a_lens_can_be_built_for_a_gpu(monkeypatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    rover = load_rover("luvmi_x")
    program = jax.jit(lambda t, q: pictures(t, rover, q, WIDE)).trace(bumpy(), jnp.zeros((3, rover.compile().nq)))
    try:
        lowered = program.lower(lowering_platforms=("cuda",))
    except RuntimeError as missing:  # JAX 0.11 asks for the kind of GPU
        pytest.skip(str(missing))
    assert "triton" in lowered.as_text()


def test_a_radial_lens_is_refused_just_where_its_radius_no_longer_grows() -> None:
    """Against the radius alone, which must grow until it reaches the picture's corner."""
    rng, right, down = np.random.default_rng(0), 0.77, 0.58
    r = np.linspace(0.0, 10.0, 20001)
    alike = []
    for k1, k2, k3 in rng.normal(0.0, [0.4, 0.3, 0.2], (60, 3)):
        seen = r * (1 + k1 * r**2 + k2 * r**4 + k3 * r**6)
        falls = np.diff(seen) <= 0
        reaches = seen[: int(falls.argmax()) + 1 if falls.any() else None].max() > np.hypot(right, down)
        alike.append((reaches, Lens(k1, k2, k3=k3).one_to_one(right, down)))
    true, told = np.array(alike).T
    assert 10 < true.sum() < 50 and (true == told).mean() > 0.98


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Pinhole(lens=Lens(-0.5)), ("camera: lens = 'k1 = -0.5' folds", "fovy_deg = 60", "calibration")),
        (lambda: Pinhole(lens=Lens(p1=0.5)), ("p1 = 0.5", "folds")),
        (lambda: Pinhole(lens=(0.1,)), ("lens = (0.1,)", "is no Lens")),
        (lambda: Lens(k2=float("nan")), ("lens: k2", "nan")),
        (lambda: lens_of((0.1, 0.2)), ("coefficients = (0.1, 0.2)", "k1, k2, p1, p2, k3")),
        (lambda: lens_of([0.0] * 8), ("plumb_bob",)),
        (lambda: NavigationConfig(camera_lens=(-0.5, 0, 0, 0, 0)), ("k1 = -0.5", "folds")),
        (lambda: NavigationConfig(camera_lens="wide"), ("navigation: camera_lens = 'wide'", "plumb_bob")),
    ],
)
def test_mistakes_are_one_sentence(make, words: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as refused:
        make()
    assert all(word in str(refused.value) for word in words) and str(refused.value).count("\n") == 0


def test_no_lens_is_none_however_it_is_written() -> None:
    assert Pinhole().lens is None and lens_of(()) is None and lens_of([0.0] * 5) is None
    assert lens_of([0.1, 0.0, 0.0, 0.02]) == Lens(0.1, p2=0.02)
    assert NavigationConfig().camera.lens is None
    assert NavigationConfig(camera_lens=[0.1, 0, 0, 0, 0]).camera.lens == Lens(0.1)


FILM = Film(exposure=4.0, vignetting=True, dust=0.1)


@pytest.mark.parametrize("lens", [BARREL, Lens(0.25, p1=0.02)], ids=["barrel", "cushion"])
def test_opengl_and_jax_show_the_same_through_a_lens(opengl: tuple[str, ...], lens: Lens) -> None:
    """Labels, depth and light of one scene, with a film of its own."""
    rover, camera, sun = load_rover("luvmi_x"), Pinhole(160, 120, lens=lens), Sun(90.0, 30.0)
    qpos = rover.compile().qpos0.copy()
    qpos[:3] = 0.0, 0.0, 0.3
    pose = look_at(np.array([-1.6, -1.8, 1.6]), np.array([0.3, 0.0, 0.3]))
    with RoverCamera(rover, bumpy(), camera=camera, sun=sun, film=FILM, largest=(8, 8), backends=opengl) as eye:
        eye.place(qpos)
        drawn = eye.take(pose)
        straight = eye.take(pose, Pinhole(160, 120))
    light, given = Light(sun=sun, film=FILM), [jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation)]
    shapes = placed(rover_shapes(rover), rover, jnp.asarray(qpos, jnp.float32))
    seen = jax.tree.map(np.asarray, jax.jit(lambda p, t: picture(bumpy(), p, t, camera, light, shapes))(*given))
    alike, unlike = ((seen.label == images.segmentation).mean() for images in (drawn, straight))
    assert alike > 0.985 and 1.0 - unlike > 2.0 * (1.0 - alike)
    both = (seen.label == drawn.segmentation) & np.isfinite(seen.depth) & np.isfinite(drawn.depth)
    assert np.median(np.abs(drawn.depth[both] / seen.depth[both] - 1.0)) < 0.002
    ground = both & (seen.label == 1)
    colours = drawn.rgba[..., :3] / 255.0
    assert np.median(colours[ground]) == pytest.approx(float(np.median(seen.rgb[ground])), rel=0.2)
    # dust on the lens brightens the sky by the picture's own mean, and corners darken, in both
    pictures = (colours, drawn.segmentation), (seen.rgb, seen.label)
    skies = [np.median(a[b == 0], axis=0) for a, b in pictures]
    means = [np.mean(a**FILM.gamma, axis=(0, 1)) ** (1.0 / FILM.gamma) for a, _ in pictures]
    assert skies[0] / means[0] == pytest.approx(skies[1] / means[1], rel=0.05) and skies[1].min() > 0.05


def test_opengls_noise_is_as_large_as_its_electrons_say(scene) -> None:
    camera, qpos = scene
    pose, optics = look_at((2.0, 2.0, 2.0), qpos[:3]), Pinhole(80, 60)
    plain = camera.picture(pose, optics).astype(float) / 255.0
    film = camera.film
    try:
        camera.film = Film(full_well=2000.0, read_noise=10.0)
        noisy = [camera.picture(pose, optics, random=np.random.default_rng(k)).astype(float) / 255.0 for k in (0, 0, 1)]
        assert (camera.picture(pose, optics) == np.rint(255.0 * plain)).all()  # no noise without its numbers
    finally:
        camera.film = film
    assert (noisy[0] == noisy[1]).all() and (noisy[0] != noisy[2]).any()
    light, found = plain**2.2, noisy[0] ** 2.2
    middling = (plain > 0.3) & (plain < 0.9)
    spread = np.sqrt(2000.0 * light + 100.0) / 2000.0
    assert np.std(((found - light) / spread)[middling]) == pytest.approx(1.0, abs=0.1)
