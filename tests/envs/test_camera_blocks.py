"""Pictures as observations of the navigation task."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.cameras import Pinhole, front_mount, pictures
from lunar_mjx.cameras.texture import SOIL_TEXTURE
from lunar_mjx.dynamics import build
from lunar_mjx.effects.soil.ruts import tile_of
from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model

pytestmark = pytest.mark.slow

SIZE = {"camera_width": 16, "camera_height": 12}


def test_pictures_are_blocks_of_the_observation() -> None:
    blocks = ("goal_body", "camera/rgb", "camera/depth", "camera/labels")
    env = make_navigation("consistent", terrain="lunar_plain", decimation=1, places=8, observations=blocks, **SIZE)
    pixels = 16 * 12
    assert env.observation_size == 4 + 5 * pixels
    state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), 2))
    obs = np.asarray(state.obs)
    assert np.isfinite(obs).all()
    rgb, depth, label = (
        obs[:, 4 : 4 + 3 * pixels],
        obs[:, 4 + 3 * pixels : 4 + 4 * pixels].reshape(2, 12, 16),
        obs[:, 4 + 4 * pixels :].reshape(2, 12, 16),
    )
    assert 0.0 <= rgb.min() < rgb.max() <= 1.0
    assert depth.max() == 1.0 and 0.0 < depth.min() < 0.2
    assert set(np.unique(label)) <= {0.0, 1.0, 2.0, 3.0} and {0.0, 1.0} <= set(np.unique(label))
    # the sky is far, dark and above
    assert (depth[label == 0] == 1.0).all() and label[:, 0].max() == 0.0 and (label[:, -1] > 0).all()
    after = jax.jit(env.step)(env.params, state, jnp.ones((2, env.action_size)))
    assert after.obs.shape == state.obs.shape and np.isfinite(np.asarray(after.obs)).all()


def test_a_camera_that_looks_down_by_45_deg_sees_the_ground_at_the_root_of_two_times_its_height() -> None:
    blocks, options = ("goal_body", "camera/depth"), {"camera_pitch_deg": 45.0, "camera_fovy_deg": 20.0}
    env = make_navigation("consistent", terrain="flat", decimation=1, places=8, observations=blocks, **SIZE, **options)
    state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), 1))
    eye = front_mount(env.model.rover).position
    depth = 60.0 * np.asarray(state.obs[0, 4:]).reshape(12, 16)
    # the rover stands level, so that rows are at one depth, and the middle lies between the sixth and the seventh
    height = eye[2] + float(state.inner.physics.qpos[0, 2])
    assert depth[5:7].mean() == pytest.approx(np.sqrt(2.0) * height, rel=0.01)
    assert np.ptp(depth, axis=1).max() < 0.01 and (np.diff(depth[:, 0]) < 0.0).all()


def test_a_lens_bends_the_pictures() -> None:
    """Depth of level ground along the rays of the lens; a cushion's corners look less far aside."""
    blocks, options = ("goal_body", "camera/depth"), {"camera_pitch_deg": 45.0, "camera_fovy_deg": 50.0}
    depths = []
    for lens in ((), (0.3, 0.0, 0.0, 0.0, 0.0)):
        env = make_navigation(
            "consistent",
            terrain="flat",
            decimation=1,
            places=8,
            observations=blocks,
            camera_lens=lens,
            **SIZE,
            **options,
        )
        state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), 1))
        down = -(env.config.camera.rays() @ front_mount(env.model.rover, 45.0).rotation.T)[..., 2]
        eye = front_mount(env.model.rover).position[2] + float(state.inner.physics.qpos[0, 2])
        depth = 60.0 * np.asarray(state.obs[0, 4:]).reshape(12, 16)
        assert depth == pytest.approx(eye / down, rel=0.02)
        depths.append(depth)
    assert np.abs(depths[1] / depths[0] - 1.0).max() > 0.05


def test_depth_and_labels_need_no_light() -> None:
    model = make_model("luvmi_x", "lunar_plain")
    system = build(model)
    place = jax.jit(lambda x: system.reset(system.params, x, 5.0, 1.0).qpos)
    qpos = jnp.stack([place(x) for x in (-3.0, 4.0)])

    def look(lit: bool):
        return jax.jit(lambda q: pictures(model.terrain, model.rover, q, Pinhole(16, 12), lit=lit))(qpos)

    seen, dark = look(True), look(False)
    assert dark.rgb is None and seen.rgb.shape == (2, 12, 16, 3)
    assert (seen.label == dark.label).all() and {0, 1} <= set(np.unique(dark.label))
    assert np.asarray(dark.depth) == pytest.approx(np.asarray(seen.depth), rel=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"camera_width": 0}, ("width", "0")),
        ({"camera_far": -1.0}, ("camera_far", "not positive")),
        ({"camera_pitch_deg": 91.0}, ("camera_pitch_deg", "-90 to 90")),
        ({"sun_elevation_deg": 120.0}, ("elevation", "120")),
        ({"observations": ("camera/infrared",)}, ("camera/infrared", "camera/rgb")),
        ({"camera_tracks": True}, ("camera_tracks", "effect ruts", "leave it out")),
        ({"camera_dust": 1}, ("camera_dust", "neither true nor false")),
    ],
)
def test_nonsense_is_refused(options: dict, words: tuple[str, ...]) -> None:
    with pytest.raises(UserError) as refused:
        make_navigation("consistent", terrain="flat", **options)
    assert all(word in str(refused.value) for word in words)


def test_wheels_that_spin_throw_dust_into_colour_alone() -> None:
    """By a camera that looks steeply down past the front wheels, with dust and as it is when nobody asks for dust."""
    blocks, options = ("goal_body", "camera/rgb", "camera/depth"), {"camera_pitch_deg": 70.0, "camera_fovy_deg": 100.0}
    seen = []
    for dust in ({"camera_dust": True}, {}):
        env = make_navigation(
            "consistent", terrain="flat", decimation=1, places=8, observations=blocks, **SIZE, **options, **dust
        )
        state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), 1))
        model, inner = env.model, state.inner
        qvel = np.array(inner.physics.qvel)
        for wheel in model.rover.wheels:
            # rims at 1.5 m/s backwards, which throw soil ahead and into view
            qvel[:, int(model.rover.compile().joint(wheel.drive).dofadr[0])] = -1.5 / wheel.radius
        inner = dataclasses.replace(inner, physics=dataclasses.replace(inner.physics, qvel=jnp.asarray(qvel)))
        obs = jax.jit(lambda p, i, env=env: env._observe(p, i, env._view(p, i))[0])(env.params, inner)
        seen.append(np.asarray(obs[0, 4:]))
    colours = 3 * 16 * 12
    assert np.abs(seen[0] - seen[1])[:colours].max() > 0.02
    np.testing.assert_allclose(seen[0][colours:], seen[1][colours:], rtol=1e-5)


def test_soil_that_wheels_pressed_is_darker_in_colour_alone() -> None:
    """A rover before and after all of its patch was pressed, by a camera that looks steeply down."""
    blocks = ("goal_body", "camera/rgb", "camera/depth", "camera/labels")
    options = {"camera_pitch_deg": 75.0, "camera_fovy_deg": 20.0, "camera_tracks": True}
    env = make_navigation(
        "consistent",
        model=make_model("luvmi_x", "flat", preset="consistent").add("rim_contact").add("ruts"),
        decimation=1,
        places=8,
        observations=blocks,
        **SIZE,
        **options,
    )
    state = jax.jit(env.reset)(env.params, split_keys(jax.random.PRNGKey(0), 1))
    inner = state.inner
    kept = inner.physics.effects["ruts"]
    x, y = (float(v) for v in inner.physics.qpos[0, :2])
    cell = float(env.params.system.effects["ruts"]["cell"]) * np.mean([w.width for w in env.model.rover.wheels])
    middle = [jnp.asarray([v / cell]) for v in (x, y)]
    pressed = {"moved": kept["moved"], "pressed": jnp.full_like(kept["pressed"], 0.01), "tile": tile_of(*middle)}
    effects = {**inner.physics.effects, "ruts": pressed}
    trodden = dataclasses.replace(inner, physics=dataclasses.replace(inner.physics, effects=effects))
    look = jax.jit(lambda p, i: env._observe(p, i, env._view(p, i))[0])
    before, after = (np.asarray(look(env.params, i)[0, 4:]) for i in (inner, trodden))
    pixels = 16 * 12
    np.testing.assert_array_equal(after[3 * pixels :], before[3 * pixels :])
    colours = [seen[: 3 * pixels].reshape(pixels, 3) for seen in (before, after)]
    ground = (before[4 * pixels :] == 1) & (colours[0].min(axis=-1) > 0.05)
    assert ground.mean() > 0.3
    # as dark as OpenGL's tracks, and nothing else is any darker
    share = colours[1][ground] / colours[0][ground]
    assert np.median(share) == pytest.approx(SOIL_TEXTURE.rut / 255.0, rel=0.01)
    np.testing.assert_array_equal(colours[1][before[4 * pixels :] != 1], colours[0][before[4 * pixels :] != 1])
