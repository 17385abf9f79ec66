"""Worlds of a rung as pure JAX functions: heights, boulders and their look-up grid, from one random key each.

Everything is an array operation of fixed shape, so that many worlds are made in one compiled program on the device;
nothing here is traced into the environment's step.
"""

from __future__ import annotations

import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.envs.ladder.rungs import BURIAL, Rung
from lunar_mjx.pytree import pytree
from lunar_mjx.terrain import Craters
from lunar_mjx.terrain.craters import CRATER_SHAPE, profile
from lunar_mjx.terrain.rocks import CELL

RIM = 3.0
"""m at the edge of a world over which the relief goes to zero, so that worlds join; without boulders."""
HURST = 0.9
"""Exponent of the relief, between the 0.95 of the highlands and the maria (Rosenburg et al. 2011)."""


@pytree
class World:
    """One world; coordinates in m from its middle, x east and y north.

    Attributes:
      heights: (row, column) of the grid of spacing `Rung.cell`, nodes at the cells' middles.
      centers: (boulder, 3) of spheres. radii: (boulder,); 0 where a square of the lattice holds none.
      index: (row, column) the boulder whose surface is nearest, by squares of `CELL`.
    """

    heights: Any
    centers: Any
    radii: Any
    index: Any


def nodes(size: float, cell: float) -> Any:
    """Middles of the cells along one side, m from the world's middle."""
    count = round(size / cell)
    return (jnp.arange(count) + 0.5) * cell - 0.5 * size


def make_world(rung: Rung, key: Any, hardness: Any = 1.0) -> World:
    """One random world of a rung of the ladder.

    Args:
      rung: which, static.
      key: random key.
      hardness: by which slopes, depths of craters, ridges and boulders are multiplied; may be traced. Below 1 for a
        curriculum, above it for worlds that are harder than the training's.
    """
    k_relief, k_rough, k_craters, k_rocks = jax.random.split(key, 4)
    # Roughness is left as it is: it shakes a rover but blocks no way.
    heights = relief(rung, k_relief) * hardness + rough(rung, k_rough)
    x = nodes(rung.size, rung.cell)
    # All worlds end at height 0, so that neighbours on one map join without a cliff.
    window = jnp.clip((0.5 * rung.size - jnp.abs(x)) / RIM, 0.0, 1.0)
    heights = add_craters(rung, heights, k_craters, hardness) * window[:, None] * window[None, :]
    centers, radii = boulders(rung, heights, k_rocks, hardness)
    return World(heights, centers, radii, nearest_index(rung, centers, radii))


def _fractal(rung: Rung, key: Any, hurst: float, shortest: float) -> Any:
    """A self-affine surface on a torus of the world's size without waves shorter than `shortest` m; any scale."""
    count = round(rung.size / rung.cell)
    k = np.hypot(np.fft.fftfreq(count)[:, None], np.fft.rfftfreq(count)[None, :]) / rung.cell
    # The mean's frequency, whose gain is set to zero below, must not divide by zero.
    k[0, 0] = 1.0
    # Amplitudes of a surface in the plane fall as k^-(H+1), its spectrum as k^-(2H+2).
    gain = np.where(k * shortest > 1.0, 0.0, k ** -(hurst + 1.0))
    gain[0, 0] = 0.0
    noise = jnp.fft.rfft2(jax.random.normal(key, (count, count)))
    return jnp.fft.irfft2(noise * jnp.asarray(gain, jnp.float32), s=(count, count))


def steepness(heights: Any, cell: float) -> Any:
    """Tangent of the slope at every node."""
    north, east = jnp.gradient(heights, cell)
    return jnp.sqrt(north * north + east * east)


def relief(rung: Rung, key: Any) -> Any:
    """Hills of waves longer than four rovers, scaled to the rung's slope."""
    shape = _fractal(rung, key, HURST, 10.0 * rung.plan_cell)
    # Not the maximum: one steep node would flatten the whole world.
    tall = jnp.percentile(steepness(shape, rung.cell), 99.0)
    return shape * (math.tan(math.radians(rung.slope_deg)) / jnp.maximum(tall, 1e-12))


def rough(rung: Rung, key: Any) -> Any:
    """Roughness of all wavelengths, scaled to the rung's height difference over 1 m."""
    shape = _fractal(rung, key, 0.75, 0.0)
    lag = max(1, round(1.0 / rung.cell))
    difference = jnp.sqrt(jnp.mean((shape[:, lag:] - shape[:, :-lag]) ** 2))
    return shape * (rung.roughness / jnp.maximum(difference, 1e-12))


def add_craters(rung: Rung, heights: Any, key: Any, hardness: Any) -> Any:
    """The heights with craters, octave by octave: all of an octave are stamped on patches of one size."""
    count = heights.shape[0]
    least = max(1.0, 6.0 * rung.cell)
    octaves = [(d, 2.0 * d) for d in least * 2.0 ** np.arange(5) if 2.0 * CRATER_SHAPE.reach * d < rung.size]
    for i, (small, large) in enumerate(octaves):
        population = Craters(small, large, rung.craters, 2.0, 0.02, rung.deepest)
        mean = population.number(small) * rung.size**2
        # Fixed shapes for a compiled program: three sigma over the mean; more are not drawn.
        most = math.ceil(mean + 3.0 * math.sqrt(mean)) + 1
        draws = jax.random.uniform(jax.random.fold_in(key, i), (4, most))
        present = jnp.arange(most) < jax.random.poisson(jax.random.fold_in(key, 100 + i), mean)
        # Inverse of the cumulative power law of exponent 2, cut at the octave's ends.
        diameter = (small**-2 - draws[0] * (small**-2 - large**-2)) ** -0.5
        ratio = 0.02 * (rung.deepest / 0.02) ** draws[1] * hardness
        place = (draws[2:] - 0.5) * rung.size
        patch = min(count, math.ceil(CRATER_SHAPE.reach * large / rung.cell) + 2)

        def stamp(ground: Any, crater: Any, patch: int = patch) -> tuple[Any, None]:
            x, y, diameter, depth = crater
            first = [
                # The patch is pushed inside the world, the crater within it is not.
                jnp.clip(jnp.floor((c + 0.5 * rung.size) / rung.cell - 0.5 * patch), 0, count - patch)
                for c in (y, x)
            ]
            row, column = (f.astype(jnp.int32) for f in first)
            middles = (jnp.arange(patch) + 0.5) * rung.cell - 0.5 * rung.size
            dy, dx = (2.0 * (middles + f * rung.cell - c) / diameter for f, c in zip(first, (y, x), strict=True))
            bowl = profile(jnp.sqrt(dx[None, :] ** 2 + dy[:, None] ** 2), depth, jnp)
            old = jax.lax.dynamic_slice(ground, (row, column), (patch, patch))
            return jax.lax.dynamic_update_slice(ground, old + bowl, (row, column)), None

        # Those that are not there are stamped too, too shallow to be seen; a depth of 0 would divide.
        depth = jnp.where(present, ratio * diameter, 1e-9)
        heights, _ = jax.lax.scan(stamp, heights, (place[0], place[1], diameter, depth))
    return heights


def boulders(rung: Rung, heights: Any, key: Any, hardness: Any) -> tuple[Any, Any]:
    """Centres and radii of the boulders, one for each square of the lattice."""
    count, side = round(rung.size / rung.lattice), rung.lattice
    k_size, k_there, k_place, k_field, k_ridge = jax.random.split(key, 5)
    ridge = ridges(rung, k_ridge, hardness)
    quantiles = jnp.asarray(rung.diameters(), jnp.float32)
    diameter = quantiles[jax.random.randint(k_size, (count, count), 0, len(quantiles))]
    diameter = jnp.where(ridge, rung.ridge_diameter, diameter)
    # fields of boulders: where a smooth field is high they lie twice as dense as on average, elsewhere hardly any
    dense = jax.image.resize(jax.random.normal(k_field, (max(2, count // 5),) * 2), (count, count), "cubic")
    share = 2.0 * jax.nn.sigmoid(2.0 * dense)
    # A lattice with one place per square: no two boulders meet, and a look-up is arithmetic.
    present = jax.random.uniform(k_there, (count, count)) < rung.presence * hardness * share
    at = nodes(rung.size, side)
    free = jnp.abs(at) < 0.5 * rung.size - RIM
    present = (present | ridge) & free[:, None] & free[None, :]
    # Off the square's middle as far as it fits; less in ridges, which must stay closed.
    room = 0.5 * (side - diameter)[..., None] * jnp.where(ridge, 0.3, 0.9)[..., None]
    shift = room * jax.random.uniform(k_place, (count, count, 2), minval=-1.0, maxval=1.0)
    x, y = at[None, :] + shift[..., 0], at[:, None] + shift[..., 1]
    radius = 0.5 * diameter
    cells = heights.shape[0]
    row, column = (jnp.clip(((c + 0.5 * rung.size) / rung.cell).astype(jnp.int32), 0, cells - 1) for c in (y, x))
    # A share of the height below ground: the centre lies (1 - 2 b) r above it.
    z = heights[row, column] + (1.0 - 2.0 * BURIAL) * radius
    centers = jnp.stack([x, y, z], axis=-1).reshape(-1, 3)
    return centers, jnp.where(present, radius, 0.0).reshape(-1)


def ridges(rung: Rung, key: Any, hardness: Any) -> Any:
    """Which squares of the lattice belong to a ridge: those on the blocks' edges that carry one."""
    count, per = round(rung.size / rung.lattice), round(rung.block / rung.lattice)
    blocks = math.ceil(count / per) + 1
    up, along = (jax.random.uniform(k, (blocks, blocks)) < rung.ridges * hardness for k in jax.random.split(key))
    square = jnp.arange(count)
    block, first = square // per, square % per == 0
    # A ridge stands on a block's edge, a square of the lattice thick.
    on_column = first[None, :] & up[block[:, None], block[None, :]]
    on_row = first[:, None] & along[block[:, None], block[None, :]]
    return on_column | on_row


def near_boulders(rung: Rung, centers: Any, radii: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Distance from points to the nearest boulder's surface in plan, m, and its number; infinite if none is near.

    Args:
      x, y: of one shape, m. Boulders in the point's square of the lattice and the eight around it count.
    """
    count = round(rung.size / rung.lattice)
    row, column = (jnp.floor((c + 0.5 * rung.size) / rung.lattice).astype(jnp.int32) for c in (y, x))
    best, number = jnp.full(x.shape, jnp.inf), jnp.full(x.shape, -1, jnp.int32)
    # A boulder lies within its square, so that nine squares hold every near one.
    for j in (-1, 0, 1):
        for i in (-1, 0, 1):
            k = jnp.clip(row + j, 0, count - 1) * count + jnp.clip(column + i, 0, count - 1)
            far = jnp.hypot(x - centers[k, 0], y - centers[k, 1]) - radii[k]
            far = jnp.where(radii[k] > 0.0, far, jnp.inf)
            number, best = jnp.where(far < best, k, number), jnp.minimum(far, best)
    return best, number


def nearest_index(rung: Rung, centers: Any, radii: Any) -> Any:
    """The look-up grid of `terrain.Rocks`; where no boulder is near, the number of boulders."""
    at = nodes(rung.size, CELL)
    x, y = jnp.meshgrid(at, at)
    _, number = near_boulders(rung, centers, radii, x, y)
    return jnp.where(number < 0, radii.shape[0], number)
