"""Pictures through a lens, from a renderer that knows pinholes only: drawn wider, and looked up ray by ray."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
from scipy.ndimage import map_coordinates

from lunar_mjx.cameras.pinhole import Pinhole


@dataclasses.dataclass(frozen=True)
class Resampling:
    """How finely the wider picture is drawn."""

    finer: float = 2.0
    """Its pixels for each pixel of the picture, where the lens shrinks it least: half a pixel off is a quarter then."""
    border: int = 1
    """Pixels around what is looked up, for the means between neighbours."""


RESAMPLING = Resampling()


def source(camera: Pinhole, most: tuple[int, int]) -> Pinhole:
    """The pinhole camera whose picture holds all that `camera` sees through its lens.

    Args:
      camera: with a lens. most: largest width and height of a picture, pixels; a wider view is drawn less finely.
    """
    rays = camera.rays()
    right, up = (float(np.abs(rays[..., i]).max()) for i in range(2))
    # Between neighbours, along rows and columns: the smallest step sets how fine the picture must be.
    steps = [np.linalg.norm(np.diff(rays, axis=i), axis=-1) for i in range(2) if rays.shape[i] > 1]
    finest = min((float(s.min()) for s in steps), default=1.0 / camera.focal)
    room = [0.5 * (m - 1) - RESAMPLING.border for m in most]
    focal = min(RESAMPLING.finer / finest, room[0] / max(right, 1e-9), room[1] / max(up, 1e-9))
    width, height = (2 * (math.ceil(focal * v) + RESAMPLING.border) for v in (right, up))
    fovy = 2.0 * math.degrees(math.atan(0.5 * height / focal))
    return dataclasses.replace(camera, width=width, height=height, fovy_deg=fovy, lens=None)


def looked_up(camera: Pinhole, drawn: Pinhole, picture: np.ndarray, between: bool) -> np.ndarray:
    """A picture as `camera` sees it, (height, width, ...) float64 or the picture's own type.

    Args:
      camera: with a lens. drawn: that took the picture, see `source`. picture: (rows, columns) or with colours.
      between: whether neighbours are averaged, as for light; else the nearest pixel is taken, as for labels.
    """
    rays = camera.rays()
    row = 0.5 * drawn.height - drawn.focal * rays[..., 1] - 0.5
    column = 0.5 * drawn.width + drawn.focal * rays[..., 0] - 0.5
    if not between:
        return picture[np.rint(row).astype(int), np.rint(column).astype(int)]
    colours = [map_coordinates(picture[..., k], [row, column], float, order=1) for k in range(picture.shape[-1])]
    return np.stack(colours, axis=-1)
