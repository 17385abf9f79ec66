"""GeoTIFF (and, through the same library, PDS4): LOLA south-pole products and their like."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.errors import NotGeoreferencedWarning, RasterioError
from rasterio.windows import Window as PixelWindow

from lunar_mjx.errors import UserError, bad_input, one_line
from lunar_mjx.terrain.dem import Dem, require_cell, require_size, undeclared_nodata
from lunar_mjx.terrain.readers.arrays import grid
from lunar_mjx.terrain.readers.options import WHERE, ReadOptions, Window

_SQUARE = 1e-4
"""Relative difference of pixel width and height that counts as square: a metre over a map of ten kilometres."""


def read_geotiff(path: Path, options: ReadOptions) -> Dem:
    """Reads one band of a projected raster; see `read_dem`."""
    try:
        with warnings.catch_warnings():
            # A raster without georeference is answered below, with what to do about it.
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            # One driver only: others that GDAL would try (VRT, WMS) let a file name further files and hosts.
            with rasterio.open(path, driver="PDS4" if path.suffix.lower() == ".xml" else "GTiff") as raster:
                return _read(path, raster, options)
    except (RasterioError, OSError, UnicodeDecodeError) as error:  # the last of damaged names of units and projections
        reason = one_line(error)[:200]
        raise UserError(f"{path}: the raster cannot be read ({reason}); fetch the file again.") from None


def _read(path: Path, raster: rasterio.DatasetReader, options: ReadOptions) -> Dem:
    if not 1 <= options.band <= raster.count:
        raise bad_input(path, "band", options.band, "is not in the file", f"choose 1 to {raster.count}")
    west, north, cell = _grid(path, raster, options)
    window = _pixels(raster, options.crop, west, north, cell)
    require_size(str(path), int(window.height), int(window.width))
    band = options.band
    data = raster.read(band, window=window, masked=True)
    if not np.issubdtype(data.dtype, np.number) or np.issubdtype(data.dtype, np.complexfloating):
        raise bad_input(path, "data type", data.dtype, "is not a real number", "give a raster of heights")
    with np.errstate(invalid="ignore"):  # of a mark of nodata that is no number
        known = np.ma.filled(data.astype(np.float64), np.nan)
    heights, undeclared = undeclared_nodata(known, str(path))
    # Scale and offset after the marks of nodata were taken out: marks are written unscaled.
    heights = heights * raster.scales[band - 1] + raster.offsets[band - 1]
    if options.heights:
        heights = heights * _unit(path, raster.units[band - 1])
    if raster.count > 1:
        undeclared = (*undeclared, f"band {band} of {raster.count} used")
    # The transform speaks of a pixel's edge, a Dem of its centre.
    x0 = west + (window.col_off + 0.5) * cell
    y0 = north - (window.row_off + window.height - 0.5) * cell
    return grid(heights, cell, x0, y0, str(path), undeclared, options)


def _grid(path: Path, raster: rasterio.DatasetReader, options: ReadOptions) -> tuple[float, float, float]:
    """West and north edge and the pixel's size, all in metres."""
    transform, crs = raster.transform, raster.crs
    if crs is None and transform.is_identity:
        if options.cell is None:
            raise bad_input(path, "cell", None, "is missing, and the file has no georeference", f"{WHERE}, in m")
        cell = require_cell(str(path), "cell", options.cell)
        return 0.0, raster.height * cell, cell
    if crs is not None and crs.is_geographic:
        raise bad_input(
            path,
            "projection",
            "geographic (degrees)",
            "has no metres",
            "reproject it to a projection in metres, such as lunar polar stereographic, with gdalwarp",
        )
    # Rotated rasters could be resampled here, but how (and with what loss) is the user's to decide.
    if transform.b or transform.d:
        raise bad_input(path, "transform", "rotated", "is not north up", "resample it with gdalwarp")
    if transform.a <= 0 or transform.e >= 0:
        raise bad_input(path, "transform", "mirrored", "is not north up", "rewrite it with gdalwarp")
    if abs(transform.a + transform.e) > _SQUARE * transform.a:
        raise bad_input(
            path, "pixel size", f"{transform.a:g} x {-transform.e:g}", "is not square", "resample it with gdalwarp -tr"
        )
    metres = 1.0
    if crs is not None and crs.is_projected:
        # Some projections count in feet.
        metres = float(crs.linear_units_factor[1])
    return transform.c * metres, transform.f * metres, transform.a * metres


def _pixels(raster: rasterio.DatasetReader, crop: Window | None, west: float, north: float, cell: float) -> PixelWindow:
    """The pixels around a crop, so that a mosaic of gigabytes is not read whole; the exact crop follows later."""
    if crop is None or not (crop.width > 0 and crop.height > 0):
        return PixelWindow.from_slices((0, raster.height), (0, raster.width))
    c0, c1 = ((crop.x + s * crop.width / 2 - west) / cell for s in (-1, 1))
    r0, r1 = ((north - crop.y + s * crop.height / 2) / cell for s in (-1, 1))
    if not (c0 >= -1 and r0 >= -1 and c1 <= raster.width + 1 and r1 <= raster.height + 1):
        raise bad_input(
            raster.name,
            "crop",
            f"x {crop.x:g}, y {crop.y:g}, {crop.width:g} x {crop.height:g} m",
            "leaves the DEM",
            f"stay within x {west:g} .. {west + raster.width * cell:g} m, "
            f"y {north - raster.height * cell:g} .. {north:g} m",
        )
    # A pixel more on every side, for the exact crop by nodes that follows.
    c0, r0 = max(0, int(c0) - 1), max(0, int(r0) - 1)
    c1, r1 = min(raster.width, int(np.ceil(c1)) + 1), min(raster.height, int(np.ceil(r1)) + 1)
    return PixelWindow.from_slices((r0, r1), (c0, c1))


def _unit(path: Path, unit: str | None) -> float:
    factors = {"": 1.0, "m": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0, "km": 1e3, "kilometer": 1e3}
    try:
        return factors[(unit or "").strip().lower()]
    except KeyError:
        raise bad_input(path, "unit", unit, "is not known", "give heights in m or km") from None
