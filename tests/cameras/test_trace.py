"""The rays' walk over the ground, as one kernel and on arrays, against a march in small steps."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from camera_scene import bumpy
from scipy.spatial.transform import Rotation

from lunar_mjx.cameras import Pinhole, look_at, pictures
from lunar_mjx.cameras.rays import ground, solids, trace
from lunar_mjx.cameras.rays.trace import Bodies
from lunar_mjx.rover import load_rover
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import surface

EYE = Pinhole(20, 15)
TO_SUN = np.array([0.8, 0.3, 0.25]) / np.linalg.norm([0.8, 0.3, 0.25])


def one_of_each() -> Bodies:
    """A box, a cylinder, a capsule and an ellipsoid side by side above the waves."""
    place = jnp.array([[1.0, 0.9, 0.5], [1.0, 0.3, 0.5], [1.0, -0.3, 0.5], [1.0, -0.9, 0.5]])
    turn = jnp.asarray(Rotation.from_rotvec([0.4, 0.7, 0.2]).as_matrix(), jnp.float32)
    size = jnp.array([[0.2, 0.15, 0.1], [0.15, 0.2, 0.0], [0.1, 0.15, 0.0], [0.25, 0.15, 0.1]])
    return Bodies((1, 1, 1, 1), solids.table(np.arange(4), place, jnp.tile(turn, (4, 1, 1)), size))


@pytest.fixture(scope="module")
def seen():
    """One view of shapes among rocks, by the kernel's code and on arrays, not a whole number of tiles wide or high."""
    pose = look_at((-1.5, -2.0, 1.0), (1.0, 0.2, 0.2))
    place, turn, sun = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation, TO_SUN))
    look = functools.partial(trace.trace, bumpy(), place, turn, EYE, 40.0, sun, one_of_each())
    return [jax.device_get(jax.jit(functools.partial(look, kernel=k))()) for k in ("arrays", "interpreted")]


def test_the_kernel_and_the_arrays_see_the_same(seen) -> None:
    arrays, kernel = seen
    assert set(np.unique(arrays.label)) >= {trace.SKY, trace.GROUND, trace.ROVER}
    assert set(np.unique(arrays.which[arrays.label == trace.ROVER])) == {0, 1, 2, 3}
    assert 0.1 < arrays.lit.mean() < 0.95
    np.testing.assert_array_equal(arrays.label, kernel.label)
    np.testing.assert_array_equal(arrays.which, kernel.which)
    np.testing.assert_array_equal(arrays.lit, kernel.lit)
    np.testing.assert_allclose(arrays.depth, kernel.depth, rtol=1e-4)
    np.testing.assert_allclose(arrays.face, kernel.face, atol=1e-3)


def test_pictures_can_be_built_for_a_gpu(monkeypatch) -> None:
    """What Triton does not know would fail here, without a GPU."""
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    rover = load_rover("luvmi_x")
    look = jax.jit(lambda t, q: pictures(t, rover, q, EYE))
    program = look.trace(bumpy(), jnp.zeros((3, rover.compile().nq)))
    try:
        lowered = program.lower(lowering_platforms=("cuda",))
    except RuntimeError as missing:  # JAX 0.11 asks for the kind of GPU
        pytest.skip(str(missing))
    assert "triton" in lowered.as_text()


def test_rays_meet_ground_and_rocks_where_small_steps_do() -> None:
    terrain = bumpy()
    grid, table = ground.tables(terrain)
    rng = np.random.default_rng(3)
    count = 400
    origin = np.column_stack([rng.uniform(-4, 4, (count, 2)), rng.uniform(0.6, 2.5, count)])
    direction = np.column_stack([rng.standard_normal((count, 2)), rng.uniform(-1.0, 0.1, count)])
    direction[:3] = [[0.0, 0.0, -1.0], [1.0, 0.0, -0.1], [0.0, -1.0, -0.1]]  # along the axes
    start, way = (Vec3(*jnp.asarray(a.T, jnp.float32)) for a in (origin, direction))
    end = jnp.full(count, 12.0)
    found = jax.jit(lambda: ground.meet(grid, table, ground.take, start, way, jnp.zeros(count), end, 5))()
    steps = np.arange(0.0, 12.0, 2e-3)
    point = origin[:, None] + steps[:, None] * direction[:, None]
    below = point[..., 2] <= np.asarray(surface(terrain, point[..., 0], point[..., 1]))
    field = terrain.field
    far = [float(o) + (n - 1) * float(field.cell) for o, n in ((field.x0, grid.cols), (field.y0, grid.rows))]
    low = np.array([float(field.x0), float(field.y0)])
    below &= ((point[..., :2] >= low) & (point[..., :2] <= far)).all(-1)
    true = np.where(below.any(axis=1), steps[below.argmax(axis=1)], np.inf)
    met = np.asarray(found.t) < ground.FAR
    assert 0.2 < met.mean() < 0.95 and (np.asarray(found.rock)[met] >= 0).sum() > 3
    assert (met == np.isfinite(true)).mean() > 0.995  # but for rays that graze
    both = met & np.isfinite(true)
    error = np.abs(np.asarray(found.t)[both] - true[both])
    assert np.quantile(error, 0.99) < 3e-3 and np.all(np.asarray(found.t)[both] < true[both] + 2e-3)
