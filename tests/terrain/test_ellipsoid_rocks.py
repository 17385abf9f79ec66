"""Ellipsoids as rocks: their shape, how they are found, scattered, joined, exported; spheres stay what they were."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from lunar_mjx.errors import UserError
from lunar_mjx.terrain import (
    RockField,
    Terrain,
    build_ellipsoids,
    build_rocks,
    flat,
    nearest_rock,
    stack,
    surface,
    to_mesh,
)
from lunar_mjx.terrain.rock_field import place_rocks
from lunar_mjx.terrain.rocks import Form, form_at, forms_of, principal_axes, semi_axes, with_forms

BOUNDS = (-30.0, -20.0, 30.0, 20.0)
AXES, TURN = np.array([0.6, 0.4, 0.25]), Rotation.from_euler("zyx", [0.7, 0.3, -0.4]).as_matrix()


def lone(dtype: type = np.float64) -> Terrain:
    """One tilted ellipsoid on level ground."""
    rocks = build_ellipsoids(np.array([[1.0, 2.0, 0.1]]), AXES[None], TURN[None], BOUNDS, dtype=dtype)
    return dataclasses.replace(flat(50.0, dtype=dtype), rocks=rocks)


def points_on(axes: np.ndarray, turn: np.ndarray, count: int) -> np.ndarray:
    """Points on an ellipsoid about the origin, by stretching and turning those of a sphere."""
    unit = np.random.default_rng(0).normal(size=(count, 3))
    return unit / np.linalg.norm(unit, axis=1, keepdims=True) * axes @ turn.T


def test_the_form_is_one_on_the_surface_and_gives_back_the_axes() -> None:
    forms = forms_of(AXES[None], TURN[None])
    form, p = Form(*forms[0]), points_on(AXES, TURN, 200)
    level = [p @ np.array([[form.xx, form.xy, form.xz], [form.xy, form.yy, form.yz], [form.xz, form.yz, form.zz]])]
    np.testing.assert_allclose((level[0] * p).sum(-1), 1.0, rtol=1e-12)
    axes, turns = principal_axes(forms)
    np.testing.assert_allclose(axes[0], AXES, rtol=1e-12)
    assert np.linalg.det(turns[0]) == pytest.approx(1.0)
    np.testing.assert_allclose(np.abs((turns[0] * TURN).sum(axis=0)), 1.0, rtol=1e-12)


def test_height_outline_and_apex_are_those_of_the_stretched_sphere() -> None:
    with jax.enable_x64(True):
        form = Form(*forms_of(AXES[None], TURN[None])[0])
        p = points_on(AXES, TURN, 2000)
        high = np.asarray(form.height(p[:, 0], p[:, 1]))
        on_top = np.abs(high - p[:, 2]) < 1e-9
        assert 0.4 < on_top.mean() < 0.6 and (high > p[:, 2] - 1e-9).all()
        outline = np.asarray(form.outline(p[:, 0], p[:, 1]))
        assert (outline <= 1.0 + 1e-12).all()
        for angle in np.linspace(0.0, 6.0, 7):
            # the farthest point along a direction of the plane lies on the outline
            way = np.array([np.cos(angle), np.sin(angle), 0.0])
            far = TURN @ (AXES**2 * (TURN.T @ way)) / np.linalg.norm(AXES * (TURN.T @ way))
            assert float(form.outline(far[0], far[1])) == pytest.approx(1.0, rel=1e-12)
        apex = form.apex()
        best = minimize(lambda q: -float(form.height(*q)), [0.0, 0.0], tol=1e-12)
        assert float(apex.z) == pytest.approx(-best.fun, rel=1e-9)
        np.testing.assert_allclose([apex.x, apex.y], best.x, atol=1e-5)


def test_the_surface_is_ground_or_rock() -> None:
    with jax.enable_x64(True):
        terrain = lone()
        p = points_on(AXES, TURN, 2000) + np.array([1.0, 2.0, 0.1])
        seen = np.asarray(surface(terrain, p[:, 0], p[:, 1]))
        assert (seen >= np.maximum(p[:, 2], 0.0) - 1e-9).all()
        assert (np.abs(seen - np.maximum(p[:, 2], 0.0)) < 1e-9).mean() > 0.5
        x, y = np.random.default_rng(1).uniform(-2, 5, (2, 2000))
        assert (np.asarray(surface(terrain, x, y, 0.2)) >= np.asarray(surface(terrain, x, y)) - 1e-12).all()
        # within reach of the top the top counts
        assert terrain.rocks is not None
        apex = form_at(terrain.rocks, 1.0, 2.0).apex()
        found = surface(terrain, 1.0 + apex.x + 0.1, 2.0 + apex.y, 0.2)
        assert float(found) == pytest.approx(0.1 + float(apex.z), rel=1e-12)


@pytest.mark.parametrize("reach", [0.0, 0.15])
def test_three_equal_axes_are_a_sphere(reach: float) -> None:
    with jax.enable_x64(True):
        rocks = build_rocks(np.array([[1.0, 2.0, 0.1], [4.0, 0.0, 0.0]]), np.array([0.3, 0.5]), BOUNDS, dtype=float)
        ground = flat(50.0, dtype=float)
        x, y = np.random.default_rng(1).uniform(-1, 6, (2, 4000))
        ball, form = (dataclasses.replace(ground, rocks=r) for r in (rocks, with_forms(rocks)))
        expected = np.asarray(surface(ball, x, y, reach))
        assert (expected > 0.0).sum() > 50
        # on the very outline rounding decides
        np.testing.assert_allclose(surface(form, x, y, reach), expected, atol=1e-7)
        np.testing.assert_allclose(semi_axes(with_forms(rocks))[0], semi_axes(rocks)[0], rtol=1e-12)


def test_spheres_alone_carry_no_forms() -> None:
    """Terrain without ellipsoids has the arrays it had."""
    rocks = build_rocks(np.array([[1.0, 2.0, 0.1]]), np.array([0.3]), BOUNDS)
    assert rocks.forms is None and len(jax.tree.leaves(rocks)) == 6
    scattered = place_rocks(RockField(abundance=0.02), BOUNDS, lambda x, y: 0.0 * x, np.random.default_rng(0))
    assert scattered.forms is None


def test_scattered_ellipsoids_cover_what_spheres_do_and_lie_flat() -> None:
    field = RockField(abundance=0.03, largest=2.0, width=0.7, height=0.5, clear=0.0, gap=0.5)
    rocks = place_rocks(field, BOUNDS, lambda x, y: 0.1 * x, np.random.default_rng(2), float)
    real = np.asarray(rocks.radii) > 0
    axes, turns = semi_axes(rocks)
    axes, turns, centers = axes[real], turns[real], np.asarray(rocks.centers)[real]
    assert len(axes) > 50
    np.testing.assert_allclose(axes / axes[:, :1], np.tile([1.0, 0.7, 0.5], (len(axes), 1)), rtol=1e-4)
    np.testing.assert_allclose(np.abs(turns[:, 2, 2]), 1.0, atol=1e-5)
    yaw = np.arctan2(turns[:, 1, 0], turns[:, 0, 0]) % np.pi
    assert np.ptp(yaw) > 2.5
    # outlines hold as much ground as discs of the drawn diameters, which the law bounds
    diameters = 2.0 * np.sqrt(axes[:, 0] * axes[:, 1])
    assert diameters.min() >= 0.2 - 1e-4 and diameters.max() <= 2.0 + 1e-4
    above = centers[:, 2] + axes[:, 2] - 0.1 * centers[:, 0]
    np.testing.assert_allclose(above / (2 * axes[:, 2]), 0.6, rtol=1e-4)


def test_stacked_with_spheres_and_bare_ground_each_stays_what_it_is() -> None:
    with jax.enable_x64(True):
        ball = build_rocks(np.array([[0.0, 2.0, 0.1], [4.0, 0.0, 0.0]]), np.array([0.3, 0.5]), BOUNDS, dtype=float)
        ground = flat(50.0, dtype=float)
        alone = [lone(), dataclasses.replace(ground, rocks=ball), ground]
        x, y = np.random.default_rng(1).uniform(-1, 6, (2, 4000))
        together = jax.vmap(lambda t: surface(t, x, y))(stack(alone))
        for one, seen in zip(alone, together, strict=True):
            np.testing.assert_allclose(seen, surface(one, x, y), atol=1e-7)


def test_exported_rocks_have_the_volume() -> None:
    bare = to_mesh(lone(np.float32), rocks=False, solid=True).volume
    mesh = to_mesh(lone(np.float32), solid=True)
    assert mesh.is_watertight and mesh.body_count == 2
    # an icosphere of 320 faces has 96 % of the sphere's volume
    assert mesh.volume - bare == pytest.approx(4 / 3 * np.pi * AXES.prod(), rel=0.05)


def test_dummies_and_nothing_near() -> None:
    terrain = lone(np.float32)
    assert terrain.rocks is not None
    x = jnp.array([20.0, jnp.nan, 1e30])
    assert (nearest_rock(terrain.rocks, x, x)[3] == 0).all()
    assert float(surface(terrain, 20.0, 10.0)) == 0.0


@pytest.mark.parametrize(
    ("axes", "turns", "words"),
    [
        ([[0.3, 0.3, 0.0]], np.eye(3), ["axes", "not positive"]),
        ([[0.3, 0.3, 0.01]], np.eye(3), ["axes", "too unequal"]),
        ([[0.3, 0.3, 0.2]], 2.0 * np.eye(3), ["turns", "no rotation"]),
        ([[0.3, 0.3, np.nan]], np.eye(3), ["axes", "not positive"]),
        ([[0.3, 0.3, 0.3]] * 2, np.eye(3), ["turns", "do not match"]),
    ],
)
def test_bad_ellipsoids_are_refused(axes: list, turns: np.ndarray, words: list[str]) -> None:
    with pytest.raises(UserError) as error:
        build_ellipsoids(np.zeros((len(axes), 3)), np.array(axes), turns[None], BOUNDS)
    assert all(word in str(error.value) for word in words)


@pytest.mark.parametrize(("name", "value"), [("width", 0.1), ("height", 1.2), ("height", float("nan"))])
def test_bad_shapes_of_a_field_are_refused(name: str, value: float) -> None:
    with pytest.raises(UserError, match=name):
        RockField(**{name: value})
