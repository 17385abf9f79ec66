"""Procedural ground at true scale: a whole surface, or detail below the resolution of a DEM."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from scipy import ndimage

from lunar_mjx.errors import bad_input, require_finite, require_within
from lunar_mjx.terrain import craters as cratering
from lunar_mjx.terrain.craters import Craters
from lunar_mjx.terrain.dem import DEM_LIMITS, Dem, require_cell, require_size, spline
from lunar_mjx.terrain.roughness import Roughness, fractal
from lunar_mjx.terrain.soil.maps import SoilMap


@dataclasses.dataclass(frozen=True)
class MeansKept:
    """How exactly detail leaves the means of a DEM's cells as they are."""

    tolerance: float = 1e-3
    """Most that `add_detail` changes the mean height of a DEM cell, m."""
    most_rounds: int = 60
    """Corrections of a surface until its means over the coarse cells are within half of `tolerance`."""


MEANS_KEPT = MeansKept()


# Independent random streams, so that changing the craters does not move the rocks.
_ROUGHNESS, _CRATERS, _ROCKS, _SOIL = range(4)


def stream(seed: int, feature: int) -> np.random.Generator:
    """The random stream of one feature of the terrain with this seed."""
    # bool is an int to Python; True would silently be seed 1.
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise bad_input("terrain", "seed", seed, "is not a whole number of at least 0", "give one such as 1")
    # A pair as entropy: NumPy mixes both words, so neighbouring seeds share nothing.
    return np.random.default_rng([int(seed), feature])


def rock_stream(seed: int) -> np.random.Generator:
    """The random stream that places rocks."""
    return stream(seed, _ROCKS)


def make_surface(
    width: float,
    height: float,
    cell: float,
    seed: int,
    *,
    roughness: Roughness | None = None,
    craters: Craters | None = None,
    center: tuple[float, float] = (0.0, 0.0),
) -> Dem:
    """Makes a surface of roughness and craters.

    Args:
      width: extent to the east, m.
      height: extent to the north, m.
      cell: spacing, m.
      seed: the same seed gives the same surface, to the last bit on one machine.
      roughness: statistics of the self-affine part, or None for none.
      craters: statistics of the craters, or None for none.
      center: map coordinates of the middle, m.

    Raises:
      UserError: an extent or spacing that is not positive, or leaves fewer than 2 x 2 or too many nodes.
    """
    require_cell("terrain", "cell", cell)
    for axis, value in zip("xy", center, strict=True):
        require_within("terrain", axis, value, -DEM_LIMITS.farthest, DEM_LIMITS.farthest)
    for field, value in (("width", width), ("height", height)):
        if require_finite("terrain", field, value) < cell:
            raise bad_input("terrain", field, value, f"is less than one cell of {cell:g} m", "make it larger")
        if value > DEM_LIMITS.most_cells * cell:
            problem = f"is more than {DEM_LIMITS.most_cells} cells of {cell:g} m"
            raise bad_input("terrain", field, value, problem, "make it smaller or use a larger cell")
    # One node more than cells: the extent asked for lies between the outermost nodes.
    rows, cols = round(height / cell) + 1, round(width / cell) + 1
    require_size("terrain", rows, cols)
    heights = np.zeros((rows, cols))
    x0, y0 = center[0] - (cols - 1) * cell / 2, center[1] - (rows - 1) * cell / 2
    if roughness is not None:
        heights += fractal(rows, cols, cell, roughness, stream(seed, _ROUGHNESS))
    if craters is not None:
        bounds = (x0, y0, x0 + (cols - 1) * cell, y0 + (rows - 1) * cell)
        cratering.stamp(heights, cell, x0, y0, cratering.draw(craters, bounds, stream(seed, _CRATERS)))
    return Dem(heights, cell, x0, y0, f"procedural, seed {seed}", "mean of the roughness")


def add_detail(
    dem: Dem, cell: float, seed: int, *, roughness: Roughness | None = None, craters: Craters | None = None
) -> Dem:
    """Adds roughness and craters below the resolution of a DEM, and nothing above it.

    The DEM is interpolated by bicubic splines; the detail has a mean of zero over every cell of the DEM (a square about
    each node), to within `MEANS_KEPT.tolerance`. Craters are limited to two cells of the DEM.

    Args:
      dem: the DEM.
      cell: spacing of the result, m; made slightly smaller where it does not divide the DEM's cell.
      seed: the same seed gives the same detail.
      roughness: statistics of the self-affine part, or None for none.
      craters: statistics of the craters, or None for none.

    Returns:
      A DEM on the finer grid.

    Raises:
      UserError: the spacing is not positive, not finer than the DEM's, or leaves too many nodes.
    """
    require_cell(dem.source, "detail cell", cell)
    if cell > 0.75 * dem.cell:
        raise bad_input(
            dem.source, "detail cell", cell, f"is not finer than the DEM's {dem.cell:g} m", "give a smaller one"
        )
    # Whole, so that the DEM's nodes are nodes of the result and its means can be kept.
    ratio = int(np.ceil(dem.cell / cell - 1e-6))
    cell = dem.cell / ratio
    rows, cols = ((n - 1) * ratio + 1 for n in dem.heights.shape)
    require_size(dem.source, rows, cols)
    detail = np.zeros((rows, cols))
    if roughness is not None:
        # Two cells are the shortest wave that the DEM can hold.
        detail += fractal(rows, cols, cell, roughness, stream(seed, _ROUGHNESS), longest=2 * dem.cell)
    # Larger ones the DEM shows itself; drawn again they would be there twice.
    if craters is not None and craters.smallest < 2 * dem.cell:
        craters = dataclasses.replace(craters, largest=min(craters.largest, 2 * dem.cell))
        west, south, east, north = dem.bounds
        population = cratering.draw(craters, (west, south, east, north), stream(seed, _CRATERS))
        cratering.stamp(detail, cell, west, south, population)
    # The DEM's own heights are means over cells: detail with means would move them.
    detail = _without_means(detail, ratio, dem.heights.shape)
    heights = spline(dem.heights, rows, cols, 1 / ratio) + detail
    note = f"procedural detail below {dem.cell:g} m added at {cell:g} m, seed {seed}"
    return dataclasses.replace(dem, heights=heights, cell=cell, notes=(*dem.notes, note))


def cell_means(fine: np.ndarray, ratio: int) -> np.ndarray:
    """Means of a fine grid over the cells of the coarse grid whose nodes are every `ratio`-th of its nodes."""
    # An even ratio has nodes on the border of two cells, half of which belongs to each.
    kernel = np.ones(ratio) if ratio % 2 else np.concatenate([[0.5], np.ones(ratio - 1), [0.5]])
    kernel /= ratio
    half = ndimage.correlate1d(fine, kernel, axis=0, mode="mirror")[::ratio]
    return ndimage.correlate1d(half, kernel, axis=1, mode="mirror")[:, ::ratio]


def _without_means(detail: np.ndarray, ratio: int, coarse: tuple[int, int]) -> np.ndarray:
    """Takes the smooth surface off that carries the means over the coarse cells."""
    rows, cols = detail.shape
    carrier = np.zeros(coarse)
    wanted = residual = cell_means(detail, ratio)
    # The means of a spline through the means are not quite the means: correct by what is left, until little is.
    for _ in range(MEANS_KEPT.most_rounds):
        smooth_part = spline(carrier, rows, cols, 1 / ratio)
        residual = wanted - cell_means(smooth_part, ratio)
        if np.abs(residual).max() < MEANS_KEPT.tolerance / 2:
            return detail - smooth_part
        # Over-relaxed: a spline through the means falls short of them in the same way in every round.
        carrier += 1.3 * residual
    raise bad_input(
        "detail", "mean of a cell", f"{np.abs(residual).max():.2g} m", "does not vanish", "use another seed"
    )


def make_soil_patches(
    dem: Dem, rock_fraction: float, patch: float, seed: int, dtype: np.dtype | type = np.float32
) -> SoilMap:
    """Scatters patches of hard rock over soft soil.

    Args:
      dem: the ground, for its extent.
      rock_fraction: share of the ground that is hard rock, 0 to 1.
      patch: typical extent of a patch, m.
      seed: the same seed gives the same patches.
      dtype: of the result.

    Returns:
      A map in the frame of `dem.to_heightfield()`.
    """
    if not 0 <= require_finite("soil", "rock_fraction", rock_fraction) <= 1:
        raise bad_input("soil", "rock_fraction", rock_fraction, "is not between 0 and 1", "give a share of the ground")
    if require_finite("soil", "patch", patch) <= 0:
        raise bad_input("soil", "patch", patch, "is not positive", "give the extent of a patch in m")
    require_cell("soil", "patch", patch)
    west, south, east, north = dem.bounds
    # Eight cells show the outline of a patch; finer ones than the DEM's would show nothing more.
    cell = max(patch / 8, dem.cell)
    rows, cols = (max(2, int(np.ceil(extent / cell)) + 1) for extent in (north - south, east - west))
    noise = ndimage.gaussian_filter(stream(seed, _SOIL).standard_normal((rows, cols)), patch / cell / 2, mode="wrap")
    # By quantile, so that the share is met exactly, whatever the noise's distribution.
    rock = noise < np.quantile(noise, rock_fraction) if 0 < rock_fraction < 1 else np.full(noise.shape, rock_fraction)
    _, origin = dem.to_heightfield()
    x0, y0, cell = (jnp.asarray(v, dtype) for v in (west - origin[0], south - origin[1], cell))
    return SoilMap(jnp.asarray(rock, dtype), x0, y0, cell)
