"""Digital elevation models on the host: float64 heights and their place on the map, cropped, resampled, sampled."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy import interpolate, ndimage

from lunar_mjx.errors import bad_input, require_finite
from lunar_mjx.terrain.heightfield import HeightField


@dataclasses.dataclass(frozen=True)
class DemLimits:
    """What a file of heights may hold."""

    most_nodata: float = 0.5
    """A DEM that misses more than this share of its heights is refused."""
    usual_nodata: tuple[float, ...] = (-9999.0, -99999.0, -32768.0, -32767.0, 32767.0, 9999.0, 99999.0)
    """What programs write where they have no height."""
    nodata_gap: float = 100.0
    """A mark of nodata that is as near as this to real heights, in the file's numbers, may be one itself."""
    highest: float = 1e7
    """m; radii of the Moon (1.7e6 m) pass for heights, marks of nodata such as -3.4e38 do not."""
    most_relief: float = 35e3
    """m between the lowest and the highest height: Mars has 30 km from Hellas to Olympus Mons, and no body that a rover
    drives on has more."""
    largest: float = 1e12
    """Numbers other than heights that are larger count as marks of nodata; the stiffest soil has 1e9."""
    farthest: float = 1e12
    """Metres that no projection of a map exceeds, nor a count of its cells."""
    most_cells: int = 50_000_000
    """A grid of more nodes than this is refused before memory runs out."""


DEM_LIMITS = DemLimits()


@dataclasses.dataclass(frozen=True)
class Dem:
    """Heights of a square grid in float64, row 0 in the south.

    Attributes:
      heights: m, shape (rows, cols); finite.
      cell: spacing of the grid, m.
      x0: map coordinate (easting) of `heights[0, 0]`, the centre of the south-western pixel, m.
      y0: map coordinate (northing) of the same, m.
      source: file or generator that the heights came from.
      reference: what a height of zero means.
      notes: what was done to the data, one sentence each.
      highest: magnitude beyond which a number counts as a mark of nodata, m.
    """

    heights: np.ndarray
    cell: float
    x0: float = 0.0
    y0: float = 0.0
    source: str = "array"
    reference: str = "as in the source"
    notes: tuple[str, ...] = ()
    highest: float = DEM_LIMITS.highest

    def __post_init__(self) -> None:
        heights = np.asarray(self.heights, np.float64)
        # Frozen, yet always float64: map heights of kilometres need its digits.
        object.__setattr__(self, "heights", heights)
        require_cell(self.source, "cell", self.cell)
        if heights.ndim != 2 or min(heights.shape) < 2:
            raise bad_input(
                self.source, "heights", f"shape {heights.shape}", "is not a grid of at least 2 x 2", "give more heights"
            )
        if (np.abs(heights) > self.highest).any():
            worst = heights.flat[np.nanargmax(np.abs(heights))]
            raise bad_input(
                self.source,
                "heights",
                f"{worst:g} m",
                "is no height but a mark of nodata, or not in m",
                "declare it as nodata in the file, or correct the scale",
            )
        relief = float(np.nanmax(heights) - np.nanmin(heights)) if np.isfinite(heights).any() else 0.0
        if np.isfinite(self.highest) and relief > DEM_LIMITS.most_relief:
            extremes = f"{np.nanmin(heights):g} to {np.nanmax(heights):g} m"
            raise bad_input(
                self.source,
                "heights",
                extremes,
                f"differ by more than {DEM_LIMITS.most_relief / 1e3:g} km, as on no planet",
                "declare what is nodata in the file, or correct the scale",
            )
        if not np.isfinite(heights).all():
            count = int((~np.isfinite(heights)).sum())
            raise bad_input(
                self.source, "heights", f"{count} of {heights.size}", "are not finite", "fill or crop away the holes"
            )

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """West, south, east and north node of the grid, m."""
        rows, cols = self.heights.shape
        return self.x0, self.y0, self.x0 + (cols - 1) * self.cell, self.y0 + (rows - 1) * self.cell

    def crop(self, x: float, y: float, width: float, height: float) -> Dem:
        """Cuts out the nodes within a rectangle.

        Args:
          x: easting of the rectangle's centre, m.
          y: northing of the rectangle's centre, m.
          width: extent to the east, m.
          height: extent to the north, m.

        Raises:
          UserError: the rectangle leaves the grid, or holds fewer than 2 x 2 nodes.
        """
        for field, value in (("width", width), ("height", height)):
            if require_finite(self.source, f"crop {field}", value) <= 0:
                raise bad_input(self.source, f"crop {field}", value, "is not positive", "give it in m above zero")
        west, south, east, north = self.bounds
        # Beyond half a cell more than rounding is missing; up to there a pixel's own area covers the rectangle.
        slack = 1e-6 * self.cell
        spans = []
        for axis, middle, extent, low, high in (("x", x, width, west, east), ("y", y, height, south, north)):
            start, stop = require_finite(self.source, f"crop {axis}", middle) - extent / 2, middle + extent / 2
            if start < low - self.cell / 2 - slack or stop > high + self.cell / 2 + slack:
                raise bad_input(
                    self.source,
                    f"crop {axis}",
                    f"{start:g} .. {stop:g} m",
                    "leaves the DEM",
                    f"stay within {low:g} .. {high:g} m",
                )
            # The slack keeps a node on the rectangle's edge from falling out by rounding.
            first = max(0, int(np.ceil((start - low - slack) / self.cell)))
            last = min(round((high - low) / self.cell), int(np.floor((stop - low + slack) / self.cell)))
            spans.append((first, last + 1))
        (c0, c1), (r0, r1) = spans
        if c1 - c0 < 2 or r1 - r0 < 2:
            raise bad_input(
                self.source,
                "crop",
                f"{width:g} x {height:g} m",
                f"holds fewer than 2 x 2 nodes {self.cell:g} m apart",
                "crop a larger rectangle",
            )
        return dataclasses.replace(
            self, heights=self.heights[r0:r1, c0:c1], x0=west + c0 * self.cell, y0=south + r0 * self.cell
        )

    def resample(self, cell: float) -> Dem:
        """Puts the heights on a grid of another spacing that starts at the same south-western node.

        A finer grid is interpolated by bicubic splines; a coarser one is first low-pass filtered, so that
        roughness below the new spacing does not alias.

        Args:
          cell: new spacing, m.

        Raises:
          UserError: the spacing is not positive, or leaves fewer than 2 x 2 or too many nodes.
        """
        require_cell(self.source, "cell", cell)
        # The same corner and never beyond the old grid: a spline continued outside would be an invention.
        rows, cols = (int(np.floor((n - 1) * self.cell / cell + 1e-9)) + 1 for n in self.heights.shape)
        if min(rows, cols) < 2:
            raise bad_input(self.source, "cell", cell, "leaves fewer than 2 x 2 nodes", "give a smaller spacing")
        require_size(self.source, rows, cols)
        heights = self.heights
        ratio = cell / self.cell
        if ratio > 1:
            # A Gaussian of half the new spacing leaves 1 % of a wave at the new Nyquist limit's double. The odd
            # reflection at the edges keeps a slope straight there.
            sigma = 0.5 * np.sqrt(ratio**2 - 1)
            # As far as scipy's filter reaches (its default truncation of 4 sigma).
            rim = int(4 * sigma + 0.5)
            padded = np.pad(heights, rim, mode="reflect", reflect_type="odd")
            heights = ndimage.gaussian_filter(padded, sigma)[rim : rim + heights.shape[0], rim : rim + heights.shape[1]]
        note = f"resampled from {self.cell:g} m to {cell:g} m"
        return dataclasses.replace(
            self, heights=spline(heights, rows, cols, ratio), cell=float(cell), notes=(*self.notes, note)
        )

    def to_heightfield(self, dtype: np.dtype | type = np.float32) -> tuple[HeightField, np.ndarray]:
        """Makes the field that simulations sample, about an origin in the middle of the grid.

        Map coordinates and altitudes are tens of kilometres; in float32 they would leave millimetres and less for the
        rover. So the origin is taken off here, in float64. It is made of whole metres, which float32 holds exactly.

        Returns:
          The field, and the origin: easting, northing and altitude (m) of its point (0, 0, 0).
        """
        west, south, east, north = self.bounds
        rows, cols = self.heights.shape
        # A node near the middle, not the mean: it is a height of the ground, and local heights begin near 0 there.
        middle = self.heights[(rows - 1) // 2, (cols - 1) // 2]
        origin = np.round(np.array([(west + east) / 2, (south + north) / 2, middle]))
        field = HeightField(
            # Subtracted before the conversion: after it the digits would be gone.
            heights=jnp.asarray(self.heights - origin[2], dtype),
            x0=jnp.asarray(west - origin[0], dtype),
            y0=jnp.asarray(south - origin[1], dtype),
            cell=jnp.asarray(self.cell, dtype),
        )
        return field, origin


def require_cell(source: str, field: str, value: float) -> float:
    """Returns a grid spacing, or raises `UserError` if it is not a positive number."""
    if require_finite(source, field, value) <= 0:
        raise bad_input(source, field, value, "is not positive", "give the grid spacing in m")
    if not 1e-6 <= value <= 1e6:  # slopes between heights would overflow
        raise bad_input(source, field, value, "is no spacing of heights", "give the grid spacing in m")
    return float(value)


def require_size(source: str, rows: int, cols: int) -> None:
    """Raises `UserError` for a grid too large to hold."""
    if rows * cols > DEM_LIMITS.most_cells:
        raise bad_input(
            source,
            "grid",
            f"{rows} x {cols}",
            f"has more than {DEM_LIMITS.most_cells} nodes",
            "crop it or use a larger cell",
        )


def spline(heights: np.ndarray, rows: int, cols: int, ratio: float) -> np.ndarray:
    """Bicubic spline through `heights`, at rows x cols nodes that lie `ratio` of a cell apart."""
    y, x = np.arange(heights.shape[0]), np.arange(heights.shape[1])
    # A cubic needs four nodes; a strip of two or three takes what it can.
    degrees = [min(3, n - 1) for n in heights.shape]
    patch = interpolate.RectBivariateSpline(y, x, heights, kx=degrees[0], ky=degrees[1])
    return patch(np.minimum(np.arange(rows) * ratio, y[-1]), np.minimum(np.arange(cols) * ratio, x[-1]))


def fill_holes(heights: np.ndarray, source: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Fills nodes without data (NaN) by linear interpolation between the rims of their holes, along rows and columns.

    A million nodes take a tenth of a second; triangles between the rims took 107 s where 30 % were missing.

    Args:
      heights: m, with NaN where there is no data.
      source: file that they came from, for the message.

    Returns:
      The heights without holes, and a note that says how many were filled.

    Raises:
      UserError: more than half of the heights are missing.
    """
    hole = ~np.isfinite(heights)
    count = int(hole.sum())
    if count == 0:
        return heights, ()
    if count == heights.size:
        raise bad_input(source, "heights", "only nodata", "leave nothing to drive on", "give a DEM with heights in it")
    # Beyond half, what one drives on would be interpolation and not data.
    if count > DEM_LIMITS.most_nodata * heights.size:
        raise bad_input(
            source, "heights", f"{count} of {heights.size} nodata", "are more than half", "crop to the part with data"
        )
    filled = _across(heights, hole)
    result = heights.copy()
    result[hole] = filled
    return result, (f"{count} of {heights.size} nodata cells filled by interpolation",)


def _across(heights: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Heights at the holes, in the order of `heights[hole]`.

    The lines along a row and a column are weighted by the inverse of their spans, so that a plane stays one. What
    neither encloses, at the edges of the grid, takes the nearest height.
    """
    value, weight = np.zeros(int(hole.sum())), np.zeros(int(hole.sum()))
    # Numbers of the holes, transposed with the grid, so that rows and columns add to the same sums.
    number = np.zeros(heights.shape, np.int32)
    number[hole] = np.arange(len(value), dtype=np.int32)
    for line, gap, at in ((heights, hole, number), (heights.T, hole.T, number.T)):
        for i in np.flatnonzero(gap.any(axis=1)):
            missing, known = np.flatnonzero(gap[i]), np.flatnonzero(~gap[i])
            after = np.searchsorted(known, missing)
            inside = (after > 0) & (after < len(known))
            missing, after = missing[inside], after[inside]
            left, right = known[after - 1], known[after]
            share = (missing - left) / (right - left)
            missing_at = at[i, missing]
            value[missing_at] += ((1.0 - share) * line[i, left] + share * line[i, right]) / (right - left)
            weight[missing_at] += 1.0 / (right - left)
    enclosed = weight > 0.0
    value[enclosed] /= weight[enclosed]
    if not enclosed.all():
        # Holes at the grid's edge have data on one side only; a straight continuation would run away.
        nearest: Any = ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True)
        value[~enclosed] = heights[tuple(axis[hole][~enclosed] for axis in nearest)]
    return value


def undeclared_nodata(raw: np.ndarray, source: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Takes the usual marks of nodata out of heights whose file declares none.

    Args:
      raw: numbers as they stand in the file, before any scale.
      source: file that they came from.

    Returns:
      The numbers with NaN at the marks, and a note that says how many there were.
    """
    notes: tuple[str, ...] = ()
    usual = np.isin(raw, DEM_LIMITS.usual_nodata)
    if usual.any():
        # Compared in the file's own numbers: after a scale a mark would no longer be one of the usual ones.
        valid = raw[~usual & np.isfinite(raw)]
        for mark in DEM_LIMITS.usual_nodata:
            marked = raw == mark
            # A number amid the real heights may be a height; one far from all of them is a mark.
            alone = (
                valid.size == 0 or not valid.min() - DEM_LIMITS.nodata_gap < mark < valid.max() + DEM_LIMITS.nodata_gap
            )
            if alone and marked.any():
                raw = np.where(marked, np.nan, raw)
                note = f"taken for nodata, which {Path(source).name} does not declare"
                notes += (f"{int(marked.sum())} cells of {mark:g} {note}",)
    return raw, notes
