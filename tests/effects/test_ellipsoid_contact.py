"""Wheels and chassis boxes against ellipsoids: against constrained minimisation, spheres, and NumPy's other way."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from lunar_mjx.backends.parity import compare as parity
from lunar_mjx.backends.parity.cases import PARITY_GRID, Case, cases, drive
from lunar_mjx.backends.parity.record import record
from lunar_mjx.backends.physics.ellipsoids import box_in_ellipsoid, wheel_in_ellipsoid
from lunar_mjx.effects.wheel.ellipsoid_contact import contact_with_box, contact_with_wheel
from lunar_mjx.effects.wheel.rock import _closest_point_to_sphere
from lunar_mjx.model import Model, make_model
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import build_ellipsoids
from lunar_mjx.terrain.rocks import MOST_ELONGATED, Form, forms_of

COUNT = 4000


def _random(count: int, ratio: float, seed: int = 0) -> dict[str, np.ndarray]:
    """Ellipsoids of semi-axes up to `ratio`, wheels and boxes, touching, apart and one within the other."""
    rng = np.random.default_rng(seed)
    axes = 0.3 * np.sort(rng.uniform(1.0 / ratio, 1.0, (count, 3)), axis=1)
    axes[:, 0] = axes[:, 2] / ratio
    return {
        "axes": axes,
        "forms": forms_of(axes, Rotation.random(count, rng=rng).as_matrix()),
        "gap": rng.normal(size=(count, 3)) * 0.3,
        "axle": Rotation.random(count, rng=rng).as_matrix()[:, 0],
        "radius": rng.uniform(0.1, 0.3, count),
        "width": rng.uniform(0.05, 0.3, count),
        "rotation": Rotation.random(count, rng=rng).as_matrix(),
        "half": rng.uniform(0.05, 0.5, (count, 3)),
    }


def _matrices(forms: np.ndarray) -> np.ndarray:
    return forms[:, [[0, 5, 4], [5, 1, 3], [4, 3, 2]]]


def _wheels(d: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    with jax.enable_x64(True):
        given = Form(*d["forms"].T), Vec3(*d["gap"].T), Vec3(*d["axle"].T), d["radius"], d["width"]
        point, toward, depth = jax.jit(contact_with_wheel)(*given)
        return np.stack(point, -1), np.stack(toward, -1), np.asarray(depth)


def _boxes(d: dict[str, np.ndarray]) -> tuple[np.ndarray, ...]:
    with jax.enable_x64(True):
        frame = Frame(*(Vec3(*d["rotation"][:, :, j].T) for j in range(3)))
        given = Form(*d["forms"].T), Vec3(*d["gap"].T), frame, Vec3(*d["half"].T)
        point, toward, depth = jax.jit(contact_with_box)(*given)
        return np.stack(point, -1), np.stack(toward, -1), np.asarray(depth)


def test_the_wheels_deepest_point_is_the_minimum() -> None:
    """Against sequential quadratic programming in the wheel's cylinder, started from its middle."""
    d = _random(60, 3.0)
    point, _, _ = _wheels(d)
    for i, matrix in enumerate(_matrices(d["forms"])):
        axle, gap, r, half = d["axle"][i], d["gap"][i], d["radius"][i], 0.5 * d["width"][i]

        def level(p: np.ndarray, a: np.ndarray = matrix, g: np.ndarray = gap) -> float:
            return float((p - g) @ a @ (p - g))

        within = [
            {"type": "ineq", "fun": lambda p, n=axle, r=r: r * r - p @ p + (p @ n) ** 2},
            {"type": "ineq", "fun": lambda p, n=axle, h=half: h - p @ n},
            {"type": "ineq", "fun": lambda p, n=axle, h=half: h + p @ n},
        ]
        best = minimize(level, np.zeros(3), constraints=within, method="SLSQP", options={"ftol": 1e-13, "maxiter": 300})
        # it keeps its constraints to some 1e-6
        assert level(point[i]) <= best.fun + 1e-5 * max(best.fun, 1.0)
        assert np.abs(point[i] @ axle) <= half + 1e-12
        assert np.linalg.norm(point[i] - axle * (point[i] @ axle)) <= r + 1e-9


@pytest.mark.parametrize("ratio", [1.0, 2.0, MOST_ELONGATED])
def test_two_ways_find_the_same_contact(ratio: float) -> None:
    """Newton's steps and clips against halving in eigenvectors and sweeps over coordinates."""
    d = _random(COUNT, ratio)
    matrices = _matrices(d["forms"])
    for found, other in (
        (_wheels(d), wheel_in_ellipsoid(matrices, d["gap"], d["axle"], d["radius"], d["width"])),
        (_boxes(d), box_in_ellipsoid(matrices, d["gap"], d["rotation"], d["half"])),
    ):
        np.testing.assert_allclose(found[0], other[0], atol=1e-8)
        # with the ellipsoid's centre in the body there is no normal
        clear = np.linalg.norm(found[0] - d["gap"], axis=1) > 1e-3
        for one, two in zip(found[1:], other[1:], strict=True):
            np.testing.assert_allclose(one[clear], two[clear], atol=1e-8)
        assert (found[2] > 0.0).mean() > 0.1 and (found[2] < 0.0).mean() > 0.1


def test_spheres_touch_as_spheres_do() -> None:
    d = _random(COUNT, 1.0)
    point, toward, depth = _wheels(d)
    with jax.enable_x64(True):
        gap, axle = Vec3(*d["gap"].T), Vec3(*d["axle"].T)
        nil = Vec3.zero(gap.x)
        near, to, distance = _closest_point_to_sphere(gap, nil, axle, d["radius"], d["width"])
    distance = np.asarray(distance)
    clear = distance > 1e-3  # with the centre in the wheel there is no normal
    np.testing.assert_allclose(point[clear], np.stack(near, -1)[clear], atol=1e-12)
    np.testing.assert_allclose(toward[clear], np.stack(to, -1)[clear], atol=1e-10)
    np.testing.assert_allclose(depth[clear], (d["axes"][:, 0] - distance)[clear], atol=1e-12)
    nearest = np.clip(d["gap"], -d["half"], d["half"])
    apart = np.linalg.norm(d["gap"] - nearest, axis=1)
    point, toward, depth = _boxes(d)
    np.testing.assert_allclose(point, nearest, atol=1e-12)
    np.testing.assert_allclose(depth, d["axes"][:, 0] - np.where(apart < 1e-6, 0.0, apart), atol=1e-12)
    within = apart < 1e-6
    assert within.sum() > 50
    np.testing.assert_allclose(toward[within], -d["rotation"][within][:, :, 2], atol=1e-12)


def test_at_small_depths_depth_and_normal_are_the_true_ones() -> None:
    """Moved back by the depth along the normal, the wheel just touches, to second order in the depth."""
    d = _random(COUNT, 3.0)
    _, toward, depth = _wheels(d)
    some = (depth > 0.0) & (depth < 0.3 * d["axes"][:, 0])
    assert some.sum() > 100
    # drawn apart until 2 mm are left, then measured
    for _ in range(30):
        _, toward, depth = _wheels(d)
        d = {**d, "gap": d["gap"] + toward * (depth - 2e-3)[:, None]}
    _, toward, depth = _wheels(d)
    np.testing.assert_allclose(depth[some], 2e-3, rtol=1e-6)
    back = {**d, "gap": d["gap"] + toward * depth[:, None]}
    left = _wheels(back)[2][some]
    # curvature radii go down to c^2/a = 0.033 m: depth^2/(2 c^2/a)
    assert np.abs(left).max() < 2e-3 * 2e-3 / (2.0 * 0.3 / 9.0) * 2.0


@pytest.mark.slow
def test_derivatives_are_finite_everywhere() -> None:
    """In contact, apart, with the centre in the wheel's, with the axle upright and downward, and for spheres."""
    d = _random(400, 2.0)
    d["forms"][:50] = forms_of(np.full((50, 3), 0.2), np.broadcast_to(np.eye(3), (50, 3, 3)))
    d["gap"][:20] = 0.0
    d["axle"][5:60:3], d["axle"][6:60:3] = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]

    def total(form: Form, gap: Vec3, axle: Vec3, radius: jax.Array, width: jax.Array) -> jax.Array:
        point, toward, depth = contact_with_wheel(form, gap, axle, radius, width)
        return jnp.sum(jnp.stack([*point, *toward, depth]))

    for x64 in (True, False):
        with jax.enable_x64(x64):
            given = jax.tree.map(
                jnp.asarray, (Form(*d["forms"].T), Vec3(*d["gap"].T), Vec3(*d["axle"].T), d["radius"], d["width"])
            )
            slopes = jax.jit(jax.grad(total, argnums=(0, 1, 2, 3, 4)))(*given)
            assert all(np.isfinite(v).all() for v in jax.tree.leaves(slopes))


def _case(model: Model) -> Case:
    """The parity study's ground with boulders, stretched and tilted."""
    ground = cases(model.rover, ["boulders, soft"])[0]
    rocks = ground.terrain.rocks
    assert rocks is not None
    radii = np.asarray(rocks.radii, float)
    real = radii > 0
    turns = Rotation.random(real.sum(), rng=np.random.default_rng(3)).as_matrix()
    axes = radii[real, None] * np.array([1.4, 1.1, 0.8])
    half = PARITY_GRID.half
    edge = (-half, -half, half, half)
    made = build_ellipsoids(np.asarray(rocks.centers, float)[real], axes, turns, edge, dtype=float)
    terrain = dataclasses.replace(ground.terrain, rocks=jax.device_get(made))
    return Case("ellipsoids, soft", terrain)


@pytest.mark.slow
def test_a_drive_over_ellipsoids_agrees_with_native() -> None:
    """Every stage of the step and the state after it, from eight states of a drive whose wheels run over ellipsoids."""
    model = make_model("luvmi_x", "flat", "field")
    case = _case(model)
    samples, *_ = record(model, case, drive(model, 3.0), 8)
    bristles = np.abs(np.stack([samples.state.effects["static_boulders"][f"bristle_{a}"] for a in "xyz"]))
    assert bristles.max() > 1e-5
    runner = parity.JaxRunner("structured", model)
    found = runner.step_from(case, samples)
    results = parity.judge(case, samples, found, parity.tolerances("float64"), model)
    assert [f"{r.stage} {r.quantity} {r.where} {r.error:.3g}" for r in results if not r.passed] == []
