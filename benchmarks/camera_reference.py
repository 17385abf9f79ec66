"""One boulder on level ground as formulas say that it looks: rays against a plane and a sphere, shadows, photometry.

What the cameras in JAX draw is held against it, in `tests/cameras` and by `cameras.py`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from lunar_mjx.cameras import Light, Pinhole, Pose, Sun, look_at, picture
from lunar_mjx.cameras.batch import BATCH_VIEW, TINT
from lunar_mjx.cameras.photometry import ROCK_BRIGHTNESS
from lunar_mjx.terrain import Terrain, build_rocks, flat

SUN = Sun(110.0, 25.0)
CENTRE, RADIUS = np.array([4.0, 0.3, 0.35]), 0.6
FROM, TOWARDS = (0.0, -1.0, 1.5), (4.0, 0.3, 0.3)
"""Where the boulder is looked at from, and where to, m."""


def boulder() -> Terrain:
    """Level ground with one boulder."""
    ground = flat(100.0)
    rocks = build_rocks(CENTRE[None], np.array([RADIUS]), (-20.0, -20.0, 20.0, 20.0))
    return Terrain(ground.field, rocks, None, jnp.zeros(3), "boulder")


def analytic(pose: Pose, light: Light, camera: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """The boulder's picture (rows, columns, 3) in [0, 1] and its labels (rows, columns), by formulas."""
    soil, to_sun = light.soil, light.sun.direction
    ray = camera.rays() @ pose.rotation.T
    unit = ray / np.linalg.norm(ray, axis=-1, keepdims=True)

    def sphere(origin, direction):
        away = origin - CENTRE
        b, c = (away * direction).sum(-1), (away**2).sum(-1) - RADIUS**2
        root = b * b - c
        entry = -b - np.sqrt(np.maximum(root, 0.0))
        return np.where((root > 0) & (entry > 0), entry, np.inf)

    plane = np.where(unit[..., 2] < 0, -pose.position[2] / np.minimum(unit[..., 2], -1e-9), np.inf)
    ball = sphere(pose.position, unit)
    label = np.where(ball < plane, 2, np.where(plane < np.inf, 1, 0))
    point = pose.position + np.minimum(np.minimum(ball, plane), 1e6)[..., None] * unit
    face = np.where((label == 2)[..., None], (point - CENTRE) / RADIUS, np.array([0.0, 0.0, 1.0]))
    mu0, mu = face @ to_sun, -(face * unit).sum(-1)
    phase = -(unit @ to_sun)
    shadow = np.isfinite(sphere(point + 1e-6 * face, np.broadcast_to(to_sun, point.shape))) & (label == 1)
    earth = np.asarray(light.earth) / np.linalg.norm(light.earth)

    def under(m0, g):
        bright = np.asarray(soil.radiance_factor(jnp.asarray(m0), jnp.asarray(mu), jnp.asarray(g)))
        return bright * np.where(label == 2, ROCK_BRIGHTNESS, 1.0)

    value = under(mu0, phase) * ~shadow + light.earthshine * under(face @ earth, -(unit @ earth))
    diffuse = float(soil.radiance_factor(0.5, 1.0, 0.5)) / 0.5
    value = value + (0.5 * (1 - face[..., 2]) + BATCH_VIEW.horizon) * BATCH_VIEW.lit_ground * to_sun[2] * diffuse
    value = np.where(label == 0, 0.0, value)[..., None] * TINT * float(light.film.gain(soil, to_sun[2]))
    return np.clip(value, 0, 1) ** (1 / light.film.gamma), label


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Mean structural similarity of two grey pictures in [0, 1] (Wang et al. 2004, a 7 x 7 window)."""
    mean = lambda v: ndimage.uniform_filter(v, 7)  # noqa: E731
    ma, mb = mean(a), mean(b)
    va, vb, cov = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return float(np.mean((2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))))


def likeness(camera: Pinhole) -> float:
    """Structural similarity of the boulder's picture in JAX with the one by formulas.

    Ground beyond the farthest distance counts as sky in JAX; there is nothing to compare.
    """
    pose, light = look_at(FROM, TOWARDS), Light(sun=SUN)
    position, rotation = (jnp.asarray(v, jnp.float32) for v in (pose.position, pose.rotation))
    found = jax.jit(lambda terrain, p, r: picture(terrain, p, r, camera, light))(boulder(), position, rotation)
    rgb, label = analytic(pose, light, camera)
    near = np.isfinite(np.asarray(found.depth)) | (label == 0)
    return ssim(np.where(near[..., None], np.asarray(found.rgb), rgb)[..., 0], rgb[..., 0])
