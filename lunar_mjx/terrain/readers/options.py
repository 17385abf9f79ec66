"""What a user may say about a DEM file beyond the file itself."""

from __future__ import annotations

import dataclasses

WHERE = "give it under [dem] of a terrain.toml, or to read_dem"
"""Remedy for what a file does not say; a path alone, as on the command line, cannot say it."""


@dataclasses.dataclass(frozen=True)
class Window:
    """A rectangle of the map, m: its centre and its extent."""

    x: float
    y: float
    width: float
    height: float


@dataclasses.dataclass(frozen=True)
class ReadOptions:
    """Options of `read_dem`.

    Attributes:
      cell: spacing of the grid, m; for files that do not say it themselves (PNG, npy, a raster without georeference).
      height_scale: height of full white above black, m; for images of 8 or 16 bits.
      dequantise: removes the steps of an image's few grey levels.
      band: which band of a GeoTIFF, from 1.
      crop: reads only this part.
      heights: whether the numbers are heights in m; else they are plain numbers of any unit and size.
      fill: whether holes are filled by interpolation; else they are refused.
    """

    cell: float | None = None
    height_scale: float | None = None
    dequantise: bool = True
    band: int = 1
    crop: Window | None = None
    heights: bool = True
    fill: bool = True
