"""Ground that a whole rim feels: planes exactly, ledges when the rim reaches them, facet edges without a step."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.backends.physics.contact import rim_plane
from lunar_mjx.backends.physics.ground import Grid
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.ports import Pipeline, initial_normal, nominal_geometry, wheel_contact, wheel_ports
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain.heightfield import HeightField
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

RADIUS, WIDTH = 0.25, 0.2
NAMES = ("soil", "pressure_sinkage", "closed_form_shear", "rim_contact")


def _field(heights: Any, cell: float = 0.02) -> HeightField:
    """Heights, a function of x and y, on a square grid of 4 m around the origin."""
    at = np.arange(-2.0, 2.0 + cell / 2, cell)
    grid = np.vectorize(heights)(*np.meshgrid(at, at))
    return HeightField(*(jnp.asarray(v) for v in (grid, at[0], at[0], cell)))


def _wheels(field: HeightField, x: Any, z: Any, share: float = 1.0, y: Any = 0.0, axle: Any = (0.0, 1.0, 0.0)) -> Any:
    """Contact, load and force in the world of standing wheels with their centres at x, y, z."""
    places = np.broadcast_arrays(*(np.asarray(v, float) for v in (x, y, z)))
    contact, load, force = _compiled(field, *places, share, axle)
    return contact, np.asarray(load), force


@jax.jit
def _compiled(field: HeightField, x: Any, y: Any, z: Any, share: Any, axle: Any) -> Any:
    """See `_wheels`; compiled once for a shape of the field and a number of wheels."""
    zero = jnp.zeros(x.shape)
    still = Vec3(zero, zero, zero)
    pipeline = Pipeline(effects_named(NAMES))
    geometry = nominal_geometry(rover_info(RADIUS + zero, WIDTH + zero))
    given = parameters(pipeline.effects, {})
    ctx = bare_context(
        terrain=SimpleNamespace(field=field),
        wheel_position=Vec3(x, y, z),
        wheel_axle=Vec3(*(zero + a for a in axle)),
        wheel_velocity=still,
        wheel_angular_velocity=still,
        geometry=geometry,
        parameters=given,
    )
    p = SimpleNamespace(share=share)
    ctx = dataclasses.replace(ctx, geometry=CATALOGUE["rim_contact"].ports["geometry"](ctx, p, None, geometry))
    ctx = dataclasses.replace(ctx, contact=wheel_contact(ctx))
    contact: Any = ctx.contact
    wheel: Any = wheel_ports(pipeline, ctx, {})[0].wheel
    force = contact.forward * wheel.force.x + contact.left * wheel.force.y + contact.normal * wheel.force.z
    return contact, wheel.force.z, force


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def test_a_plane_is_met_exactly():
    """Sinkage and normal are those of the tangent plane, whichever way the ground leans, touching or not."""
    slope_x, slope_y = np.tan(0.3), np.tan(-0.2)
    field = _field(lambda x, y: slope_x * x + slope_y * y)
    z = np.array([0.2, 0.24, 0.26, 0.29, 0.4])
    fitted, plain = _wheels(field, 0.03, z)[0], _wheels(field, 0.03, z, share=0.0)[0]
    np.testing.assert_allclose(fitted.sinkage, plain.sinkage, atol=1e-12)
    for a, b in zip(fitted.normal, plain.normal, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_ledge_of_half_a_radius_is_felt_when_the_rim_reaches_it():
    """Before, nothing; from the touch of its edge on, a growing force that pushes back, never a jump.

    The tangent plane below the axle does not feel it until the axle stands above it.
    """
    edge, cell = 1.0, 0.005
    field = _field(lambda x, y: 0.5 * RADIUS if x >= edge else 0.0, cell)
    center = 0.9 * RADIUS
    reach = np.sqrt(RADIUS**2 - (center - 0.5 * RADIUS) ** 2)
    before = edge - cell - reach - (0.02 * RADIUS + 0.09 * RADIUS) - np.array([0.1, 0.01, 1e-3])
    flat = _wheels(field, [-1.0], center)[1][0]
    _, load, force = _wheels(field, before, center)
    np.testing.assert_allclose(load, flat, rtol=1e-9)
    np.testing.assert_allclose(force.x, 0.0, atol=1e-9)
    # the samples lie 0.18 radii apart: within that of the touch the push must have begun
    into = edge - reach + np.linspace(0.0, 0.4 * RADIUS, 400)
    _, load, force = _wheels(field, into, center)
    felt = np.asarray(force.x)
    first = into[np.argmax(felt < -0.05 * flat)]
    assert abs(first - (edge - reach)) < 0.18 * RADIUS
    assert (felt[into > first] < 0.0).all() and felt[-1] < -0.5 * flat
    np.testing.assert_allclose(_wheels(field, into, center, share=0.0)[2].x, 0.0, atol=1e-9)


def test_the_load_does_not_step_at_facet_edges():
    """Across the edge of two facets that differ by 10 deg: under 0.1 % in a micrometre; 12 % or more by the tangent."""
    field = _field(lambda x, y: np.tan(np.deg2rad(10.0)) * max(x, 0.0), 0.1)
    across = np.array([-1e-6, 1e-6])
    z = RADIUS - 0.02
    for share, least, most in ((1.0, 0.0, 1e-3), (0.0, 0.12, 1.0)):
        load = _wheels(field, across, z, share)[1]
        step = abs(load[1] / load[0] - 1.0)
        assert least <= step <= most, share
    normal = _wheels(field, across, z)[0].normal.x
    assert abs(normal[1] - normal[0]) < 1e-4
    sharp = _wheels(field, across, z, share=0.0)[0].normal.x
    assert abs(sharp[1] - sharp[0]) > 0.15


def test_the_sides_tell_the_camber():
    """Ground that rises to the left along one side of the wheel alone leans the plane to the right by half of it."""
    field = _field(lambda x, y: 0.3 * max(y, 0.0))
    contact, _, _ = _wheels(field, [0.0], RADIUS - 0.02)
    assert float(contact.normal.y[0]) == pytest.approx(-np.sin(np.arctan(0.15)), rel=1e-6)
    tangent = _wheels(field, [0.0], RADIUS - 0.02, y=-0.01, share=0.0)[0]
    assert float(tangent.normal.y[0]) == pytest.approx(0.0, abs=1e-9)


def test_engines_meet_the_same_plane():
    """JAX and NumPy on a rough field, wheels turned and leaning: equal to rounding."""
    rng = np.random.default_rng(3)
    rough = rng.normal(0.0, 0.03, (81, 81))
    at = -2.0
    field = HeightField(*(jnp.asarray(v) for v in (rough, at, at, 0.05)))
    n = 200
    x, y, z = *rng.uniform(-1.5, 1.5, (2, n)), rng.uniform(0.15, 0.3, n)
    axle = rng.normal(size=(n, 3)) * [1.0, 1.0, 0.2]
    axle /= np.linalg.norm(axle, axis=1, keepdims=True)
    contact = _wheels(field, x, z, y=jnp.asarray(y), axle=tuple(jnp.asarray(axle.T)))[0]
    c: Any = SimpleNamespace(
        geometry={"radius": np.full((1, n), RADIUS), "width": np.full((1, n), WIDTH)},
        wheel_axle=axle[None],
        wheel_position=np.stack([x, y, z], axis=-1)[None],
    )
    _, slope_x, slope_y = (v[0] for v in rim_plane(c, Grid(rough, at, at, 0.05)))
    up = 1.0 / np.sqrt(1.0 + slope_x**2 + slope_y**2)
    np.testing.assert_allclose(contact.normal.x, -slope_x * up, atol=1e-12)
    np.testing.assert_allclose(contact.normal.y, -slope_y * up, atol=1e-12)
    assert np.abs(slope_x).max() > 0.2


def test_it_has_derivatives():
    """Of the load by the height of the wheel, in the air, touching, and in the ground."""
    field = _field(lambda x, y: 0.02 * np.sin(9.0 * x))
    slope = jax.jit(jax.vmap(jax.grad(lambda z: jnp.sum(initial(field, z)))))(jnp.array([0.2, 0.249, 0.3, 2.0]))
    assert np.isfinite(np.asarray(slope)).all()


def initial(field: HeightField, z: Any) -> Any:
    """Sinkage plus the untouched normal value, of one wheel."""
    zero = jnp.zeros(1)
    still = Vec3(zero, zero, zero)
    geometry = nominal_geometry(rover_info(RADIUS + zero, WIDTH + zero))
    ctx = bare_context(
        terrain=SimpleNamespace(field=field),
        wheel_position=Vec3(zero + 0.1, zero, zero + z),
        wheel_axle=Vec3(zero, zero + 1.0, zero),
        wheel_velocity=still,
        wheel_angular_velocity=still,
        geometry=dataclasses.replace(geometry, rim_share=1.0),
    )
    contact = wheel_contact(ctx)
    return contact.sinkage + contact.normal.x + 0.0 * initial_normal(contact.sinkage).load
