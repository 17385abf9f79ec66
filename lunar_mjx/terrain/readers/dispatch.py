"""Chooses the reader by the file's suffix."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.terrain.dem import Dem
from lunar_mjx.terrain.readers.arrays import read_asc, read_npy
from lunar_mjx.terrain.readers.geotiff import read_geotiff
from lunar_mjx.terrain.readers.image import read_image
from lunar_mjx.terrain.readers.options import ReadOptions, Window
from lunar_mjx.terrain.readers.pds import read_pds

_READERS: dict[str, Callable[[Path, ReadOptions], Dem]] = {
    ".tif": read_geotiff,
    ".tiff": read_geotiff,
    ".xml": read_geotiff,  # PDS4 label, through the same library
    ".img": read_pds,
    ".lbl": read_pds,
    ".png": read_image,
    ".npy": read_npy,
    ".asc": read_asc,
}
SUFFIXES = tuple(_READERS)
BANDED = (".tif", ".tiff", ".xml")
"""Suffixes of files that may hold several bands."""
GRIDS = (".tif", ".tiff", ".npy", ".asc")
"""Suffixes of files that may hold other numbers than heights."""
_LOG = logging.getLogger(__name__)


def read_dem(
    path: str | Path,
    *,
    cell: float | None = None,
    height_scale: float | None = None,
    dequantise: bool = True,
    band: int = 1,
    crop: Window | tuple[float, float, float, float] | None = None,
) -> Dem:
    """Reads a digital elevation model.

    Args:
      path: GeoTIFF (.tif), PDS3 (.img with .lbl beside it, or the .lbl), PDS4 (.xml), PNG, npy or ESRI ASCII (.asc).
      cell: spacing of the grid in m, for formats that do not say it (PNG, npy, a GeoTIFF without georeference).
      height_scale: height of full white above black in m, for PNG.
      dequantise: for PNG, removes the steps of the grey levels, staying within half a level of the data.
      band: of a GeoTIFF, from 1.
      crop: x, y of the centre, width and height in m of the part to read.

    Returns:
      The DEM; its notes say what was done, such as how many nodata cells were filled.

    Raises:
      UserError: the file is missing, broken, of an unknown kind, not in metres, or without usable heights.
    """
    path = Path(path)
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        raise UserError(
            f"{path}: suffix = '{path.suffix}' is not a DEM format that is known; convert it to one of "
            f"{', '.join(SUFFIXES)}."
        )
    require_file(path, "the DEM")
    _require_band(path, band)
    if height_scale is not None and path.suffix.lower() != ".png":
        raise bad_input(
            path, "height_scale", height_scale, "is for PNG: this format holds heights in m", "leave it out"
        )
    window = crop if crop is None or isinstance(crop, Window) else Window(*crop)
    dem = reader(path, ReadOptions(cell, height_scale, dequantise, band, window))
    if window is not None:
        dem = dem.crop(window.x, window.y, window.width, window.height)
    for note in dem.notes:
        _LOG.info("%s: %s", path, note)
    return dem


def read_plain(path: Path, *, cell: float | None = None, band: int = 1, fill: bool = True) -> Dem:
    """Reads a grid of numbers that are no heights, of any unit.

    Args:
      path: GeoTIFF, npy or ESRI ASCII.
      cell: spacing of the grid in m, for formats that do not say it.
      band: of a GeoTIFF, from 1.
      fill: whether holes are filled by interpolation; else they are refused.

    Returns:
      The grid; its `heights` are the numbers.

    Raises:
      UserError: the file is missing, broken or of another kind, or its numbers are not usable.
    """
    if path.suffix.lower() not in GRIDS:
        raise bad_input(path, "suffix", path.suffix, "is no grid that is known", f"use one of {', '.join(GRIDS)}")
    require_file(path, "the grid")
    _require_band(path, band)
    return _READERS[path.suffix.lower()](path, ReadOptions(cell, band=band, heights=False, fill=fill))


def _require_band(path: Path, band: int) -> None:
    # A reader of one band would take that for any, and a second layer would be the first once more.
    if path.suffix.lower() not in BANDED and band != 1:
        raise bad_input(path, "band", band, "does not exist: this format holds one", "leave it out, or give a GeoTIFF")
