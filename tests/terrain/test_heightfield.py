"""The sampler: exact on bilinear patches, differentiable, defined at the edge, elementwise."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lunar_mjx.terrain import HeightField, gradient, height, inside, normal, sample, slope


def make(seed=0, rows=9, cols=12, cell=0.5, x0=-2.0, y0=1.0, dtype=np.float64):
    heights = np.random.default_rng(seed).normal(size=(rows, cols))
    return HeightField(*(jnp.asarray(v, dtype) for v in (heights, x0, y0, cell)))


@pytest.fixture
def x64():
    with jax.enable_x64(True):
        yield


def test_nodes_are_met(x64):
    field = make()
    x, y = np.meshgrid(-2.0 + 0.5 * np.arange(12), 1.0 + 0.5 * np.arange(9))
    np.testing.assert_allclose(height(field, x, y), field.heights, rtol=0, atol=4e-16)


def test_agrees_with_scipy_at_random_points(x64):
    from scipy.interpolate import RegularGridInterpolator

    field, rng = make(), np.random.default_rng(1)
    x, y = rng.uniform(-2, 3.5, 500), rng.uniform(1, 5, 500)
    nodes = (1 + 0.5 * np.arange(9), -2 + 0.5 * np.arange(12))
    expected = RegularGridInterpolator(nodes, np.asarray(field.heights))(np.stack([y, x], -1))
    np.testing.assert_allclose(height(field, x, y), expected, rtol=1e-12, atol=1e-12)


@settings(max_examples=30)
@given(st.floats(-1.9, 3.4), st.floats(1.1, 4.9))
def test_derivatives_match_finite_differences(x, y):
    with jax.enable_x64(True):
        field, step = make(), 1e-7
        u, v = (x + 2) / 0.5, (y - 1) / 0.5
        if min(abs(u - round(u)), abs(v - round(v))) < 1e-5:
            return  # a crease between patches has no derivative
        _, dzdx, dzdy = sample(field, x, y)
        auto = jax.grad(lambda p: height(field, p[0], p[1]))(jnp.array([x, y]))
        numeric = [
            (height(field, x + step, y) - height(field, x - step, y)) / (2 * step),
            (height(field, x, y + step) - height(field, x, y - step)) / (2 * step),
        ]
        np.testing.assert_allclose([dzdx, dzdy], numeric, rtol=1e-5, atol=1e-6)
        np.testing.assert_allclose(auto, [dzdx, dzdy], rtol=1e-10, atol=1e-12)


def test_derivative_by_heights_matches_finite_differences(x64):
    field, x, y = make(), jnp.array([0.13, 1.71]), jnp.array([2.2, 4.9])

    def total(heights):
        return height(HeightField(heights, field.x0, field.y0, field.cell), x, y).sum()

    auto = jax.grad(total)(field.heights)
    nudge = jnp.asarray(np.random.default_rng(2).normal(size=field.heights.shape))
    numeric = (total(field.heights + 1e-6 * nudge) - total(field.heights - 1e-6 * nudge)) / 2e-6
    np.testing.assert_allclose((auto * nudge).sum(), numeric, rtol=1e-7)
    assert float(auto.sum()) == pytest.approx(2.0)  # the weights of each point sum to one


def test_plane_has_its_normal_and_slope(x64):
    x = np.arange(5.0)
    field = HeightField(*(jnp.asarray(v) for v in (0.3 * x[None, :] - 0.4 * x[:, None], 0.0, 0.0, 1.0)))
    nx, ny, nz = normal(field, 1.3, 2.6)
    length = np.sqrt(1.25)
    np.testing.assert_allclose([nx, ny, nz], [-0.3 / length, 0.4 / length, 1 / length], rtol=1e-12)
    assert float(slope(field, 1.3, 2.6)) == pytest.approx(np.arctan(0.5))
    assert not bool(
        jnp.isnan(
            jax.grad(lambda h: slope(HeightField(h, *(jnp.zeros(()),) * 2, jnp.ones(())), 1.2, 1.3))(jnp.zeros((3, 3)))
        ).any()
    )


def test_edge_is_flat_continuation(x64):
    field = make()
    far_x = jnp.array([-2.0, 3.5, -50.0, 1e30, jnp.inf])
    y = jnp.full(5, 2.3)
    z, dzdx, dzdy = sample(field, far_x, y)
    np.testing.assert_array_equal(z[2:], z[jnp.array([0, 1, 1])])
    np.testing.assert_array_equal(dzdx[2:], 0)
    np.testing.assert_array_equal(dzdy[2:], dzdy[jnp.array([0, 1, 1])])
    np.testing.assert_array_equal(inside(field, far_x, y), [True, True, False, False, False])
    z, dzdx, dzdy = sample(field, 0.3, -7.0)
    assert dzdy == 0 and dzdx != 0 and z == height(field, 0.3, 1.0)


def test_nan_position_gives_nan_and_is_outside():
    field = make(dtype=np.float32)
    x = jnp.array([jnp.nan, 0.0])
    z = jax.jit(height)(field, x, jnp.full(2, 2.0, jnp.float32))
    assert bool(jnp.isnan(z[0])) and bool(jnp.isfinite(z[1]))
    np.testing.assert_array_equal(inside(field, x, jnp.full(2, 2.0)), [False, True])


@pytest.mark.parametrize("shape", [(), (3,), (2, 3, 4)])
def test_any_shape_and_dtype_of_the_heights(shape):
    field = make(dtype=np.float32)
    z, dzdx, dzdy = sample(field, jnp.zeros(shape), jnp.full(shape, 2.0))
    assert z.shape == dzdx.shape == dzdy.shape == shape and z.dtype == jnp.float32


def test_vmap_over_a_batch_of_fields():
    fields = [make(seed, dtype=np.float32) for seed in range(4)]
    batch = jax.tree.map(lambda *leaves: jnp.stack(leaves), *fields)
    x, y = jnp.linspace(-1, 3, 5), jnp.linspace(1, 5, 5)
    together = jax.jit(jax.vmap(sample, in_axes=(0, None, None)))(batch, x, y)
    for k, field in enumerate(fields):
        for a, b in zip(together, sample(field, x, y), strict=True):
            np.testing.assert_allclose(a[k], b, rtol=1e-6, atol=1e-6)
    # The batch axis last, as the physics has it, over one shared field.
    last = jax.vmap(lambda a: sample(fields[0], a, y), in_axes=-1, out_axes=-1)(jnp.stack([x, x + 0.1], -1))
    np.testing.assert_allclose(last[0][:, 0], together[0][0], rtol=1e-6, atol=1e-6)


def test_compiles_to_gathers_and_elementwise_code_only():
    field = make(dtype=np.float32)
    text = jax.jit(sample).lower(field, jnp.zeros(64), jnp.zeros(64)).as_text()
    assert text.count('"stablehlo.gather"') == 4
    for banned in ("dot_general", "scatter", "while", "custom_call"):
        assert banned not in text


def test_kilometres_of_altitude_do_not_eat_millimetres():
    from lunar_mjx.terrain import Dem

    rng = np.random.default_rng(3)
    heights = -2875.0 + rng.normal(0, 1, (41, 41))
    field, origin = Dem(heights, 0.2, x0=-37000.0, y0=15000.0).to_heightfield()
    x, y = -37000 + 0.2 * 17 - origin[0], 15000 + 0.2 * 30 - origin[1]
    assert float(height(field, x, y)) + origin[2] == pytest.approx(heights[30, 17], abs=2e-5)
    assert origin.dtype == np.float64 and (origin == np.round(origin)).all()


def test_shapes_are_those_of_the_annotations():
    from beartype import BeartypeConf, beartype
    from jaxtyping import TypeCheckError, jaxtyped

    field = make(dtype=np.float32)
    for function in (sample, height, gradient, normal, slope, inside):
        checked = jaxtyped(function, typechecker=beartype(conf=BeartypeConf(is_pep484_tower=True)))
        checked(field, jnp.zeros((2, 3)), jnp.ones((2, 3)))
        with pytest.raises(TypeCheckError):
            checked(field, jnp.zeros(3), jnp.zeros(4))
