"""Dust in JAX: the same grains veil a picture as on the host, and a batch's grains fly as those of a recorded drive."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from camera_scene import bumpy
from test_dust import END, GRAVITY, GROUND, coordinates, thrown, viper

from benchmarks.camera_reference import CENTRE, RADIUS, boulder
from lunar_mjx.cameras import Lens, Pinhole, Regolith, Sun, look_at, pictures, steady_dust, wheel_motion
from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.dust.steady import _rate
from lunar_mjx.cameras.dust.veil import veil, veiled
from lunar_mjx.cameras.rays.trace import sunlit
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain.soil.maps import SoilMap

SUN = Sun(150.0, 20.0)


def velocities(rim: float, speed: float) -> np.ndarray:
    """Of a VIPER whose rims turn at a speed while it goes along x at another, m/s."""
    model = viper().compile()
    qvel = np.zeros(model.nv)
    qvel[0] = speed
    for wheel in viper().wheels:
        qvel[int(model.joint(wheel.drive).dofadr[0])] = rim / wheel.radius
    return qvel


@pytest.fixture(scope="module")
def throw():
    """Grains of a VIPER in JAX, 400 of each wheel."""
    program = jax.jit(lambda ground, q, v, g: steady_dust(ground, viper(), q, v, g, 400))

    def call(rim: float, speed: float, lift: float = -0.02, ground=GROUND, gravity: float = GRAVITY) -> Grains:
        given = (coordinates(rim, speed, lift)[-1], velocities(rim, speed))
        found = program(ground, *(jnp.asarray(v, jnp.float32) for v in given), gravity)
        return jax.tree.map(np.asarray, found)

    return call


@pytest.mark.parametrize(("rim", "speed"), [(0.8, 0.3), (0.5, 0.0), (-0.6, -0.2)])
def test_a_steady_drive_throws_what_its_record_throws(throw, rim: float, speed: float) -> None:
    """As much soil, as far, as high, as fast; each grain of its own."""
    steady, record = throw(rim, speed), thrown(rim, speed).at(END)
    assert steady.area.sum() == pytest.approx(record.area.sum(), rel=0.05)
    wheels, means = wheel_motion(viper(), coordinates(rim, speed)[-1:]).centre[0], []
    for grains in (steady, record):
        share, away = grains.area / grains.area.sum(), grains.position - wheels[grains.wheel]
        middle = share @ away
        means.append([*middle, *np.sqrt(share @ (away - middle) ** 2), *(share @ grains.velocity)])
    np.testing.assert_allclose(means[0], means[1], atol=0.02)
    assert len(np.unique(steady.position[:, 0])) > 0.99 * len(steady.area)


def test_a_grain_flies_on_from_picture_to_picture(throw) -> None:
    """A steady wheel's grains a little later are the same ones, farther on their parabolas, but for those landed."""
    rim, speed, wait = 0.6, 0.2, 0.02
    qpos = coordinates(rim, speed)[-1]
    later = qpos + wait * np.asarray(_rate(viper().compile(), jnp.asarray(qpos), jnp.asarray(velocities(rim, speed))))
    program = jax.jit(lambda q: steady_dust(GROUND, viper(), q, jnp.asarray(velocities(rim, speed)), GRAVITY, 100))
    before, after = (jax.tree.map(np.asarray, program(jnp.asarray(q, jnp.float32))) for q in (qpos, later))
    expected = before.position + wait * before.velocity - [0.0, 0.0, 0.5 * GRAVITY * wait**2]
    both = (before.area > 0.0) & (after.area > 0.0) & (expected[:, 2] > 0.0)
    apart = np.linalg.norm(after.position - expected, axis=-1)[both]
    assert both.mean() > 0.8 and (apart < 2e-3).mean() > 0.9


@pytest.mark.parametrize(
    "options",
    [
        {"rim": 0.3, "speed": 0.3},
        {"rim": 0.0, "speed": 0.5},
        {"rim": 0.6, "speed": 0.0, "lift": 0.05},
        {"rim": 0.6, "speed": 0.0, "gravity": 9.81},
        {
            "rim": 0.6,
            "speed": 0.0,
            "ground": dataclasses.replace(
                GROUND, soil=SoilMap(jnp.ones((4, 4)), *(jnp.asarray(v) for v in (-20.0, -20.0, 10.0)))
            ),
        },
        {"rim": np.nan, "speed": 0.0},
    ],
    ids=["rolls", "skids", "hangs", "in air", "on rock", "diverged"],
)
def test_nothing_is_thrown_by_a_wheel_that(throw, options: dict) -> None:
    found = throw(**options)
    assert (found.area == 0.0).all() and np.isfinite(found.position).all()


def test_coordinates_change_as_mujoco_integrates_them() -> None:
    model = viper().compile()
    random = np.random.default_rng(0)
    qpos, qvel = model.qpos0.copy(), random.normal(size=model.nv)
    qpos[3:7] = random.normal(size=4)
    qpos[3:7] /= np.linalg.norm(qpos[3:7])
    later = qpos.copy()
    mujoco.mj_integratePos(model, later, qvel, 1e-3)
    rate = np.asarray(_rate(model, jnp.asarray(qpos, jnp.float32), jnp.asarray(qvel, jnp.float32)))
    np.testing.assert_allclose(rate, (later - qpos) / 1e-3, atol=5e-3)


@pytest.mark.parametrize("lens", [None, Lens(-0.25, 0.05)], ids=["pinhole", "barrel"])
def test_grains_veil_in_jax_what_they_veil_on_the_host(lens: Lens | None) -> None:
    """Before a picture of many greys and depths; some grains lie behind what it shows, some outside it."""
    random, camera, gain = np.random.default_rng(1), Pinhole(40, 30, 50.0, lens=lens), 5.0
    grains = Grains(
        np.column_stack([random.uniform(-1.0, 5.0, 300), *random.normal(0.0, 0.8, (2, 300))]),
        random.normal(0.0, 1.0, (300, 3)),
        random.uniform(0.005, 0.06, 300),
        random.uniform(0.0, 4e-3, 300),
        np.zeros(300, int),
    )
    lit, soil = (random.random(300) > 0.5).astype(float), Regolith()
    light, depth = random.uniform(0.0, 1.0, (30, 40, 3)), random.uniform(1.0, 6.0, (30, 40))
    pose = look_at((-1.0, 0.2, 0.3), (1.0, 0.0, 0.0))
    host = veiled(light, depth, pose, camera, grains, lit, SUN.direction, gain, soil)
    given = [jnp.asarray(v, jnp.float32) for v in (light / gain, depth, pose.position, pose.rotation)]
    found = veil(*given[:4], camera, grains, jnp.asarray(lit), jnp.asarray(SUN.direction, jnp.float32), soil)
    assert (np.abs(host - light).max(axis=-1) > 0.02).mean() > 0.2
    # the host leaves off a grain's faint edge, beyond two and a half times its spread
    assert np.abs(gain * np.asarray(found) - host).max() < 0.03
    assert np.abs(gain * np.asarray(found) - host).mean() < 0.003


def test_the_sun_reaches_what_no_boulder_hides() -> None:
    """Places about a boulder's shadow, by arrays and by the kernel."""
    sun = Sun(90.0, 30.0)  # from the east
    line = CENTRE[0] + np.linspace(-6.0, 4.0, 300)
    places = np.stack([line, np.full(300, CENTRE[1]), np.full(300, 0.1)], axis=-1)
    outside = np.linalg.norm(places - CENTRE, axis=-1) > RADIUS + 0.05
    from_axis = np.linalg.norm(np.cross(places - CENTRE, sun.direction), axis=-1)
    hidden = (from_axis < RADIUS) & ((CENTRE - places) @ sun.direction > 0.0)
    sure = outside & (np.abs(from_axis - RADIUS) > 0.03)
    given = [jnp.asarray(v, jnp.float32) for v in (places, sun.direction)]
    for kernel in ("arrays", "interpreted"):
        lit = np.asarray(jax.jit(lambda p, s, k=kernel: sunlit(boulder(), p, s, kernel=k))(*given))
        assert ((lit == 1.0) == ~hidden)[sure].all() and 20 < hidden[sure].sum() < 150
    assert not np.asarray(sunlit(boulder(), given[0], jnp.asarray([0.9, 0.0, -0.1]))).any()


def test_pictures_of_a_batch_show_dust_of_others_and_neither_depth_nor_labels_do() -> None:
    """A VIPER looks at another, whose wheels spin or stand."""
    eye, ground = Pinhole(48, 36, 40.0), GROUND
    own, other = (np.array(coordinates(0.0, 0.0)[-1]) for _ in range(2))
    other[:2] = 4.0, 0.5
    given = [jnp.asarray(v, jnp.float32) for v in (own, other)]
    draw = jax.jit(
        lambda q, o, v: pictures(
            ground, viper(), q[None], eye, others=o[None, None], qvel=0.0 * v[None], others_qvel=v[None, None]
        )
    )
    still, dusty = (jax.tree.map(np.asarray, draw(*given, jnp.asarray(velocities(r, 0.0)))) for r in (0.0, 0.9))
    for a, b in ((still.depth, dusty.depth), (still.label, dusty.label)):
        np.testing.assert_array_equal(a, b)
    changed = np.abs(dusty.rgb - still.rgb).max(axis=-1)[0] > 0.02
    assert 5 < changed.sum() < 0.2 * changed.size
    rows = np.nonzero(changed)[0]
    assert rows.min() > np.nonzero((still.label[0] == 3).any(axis=1))[0].min()  # low down, and not at its head


def test_pictures_with_dust_can_be_built_for_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    rover = load_rover("luvmi_x")
    m = rover.compile()
    program = jax.jit(lambda t, q, v: pictures(t, rover, q, Pinhole(16, 12), qvel=v))
    try:
        traced = program.trace(bumpy(), jnp.zeros((3, m.nq)), jnp.zeros((3, m.nv)))
        lowered = traced.lower(lowering_platforms=("cuda",))
    except RuntimeError as missing:  # JAX 0.11 asks for the kind of GPU
        pytest.skip(str(missing))
    assert lowered.as_text().count("triton") >= 2
