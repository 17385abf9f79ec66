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


def looked_up(camera: Pinhole, drawn: Pinhole, light: np.ndarray) -> np.ndarray:
    """Light as `camera` sees it, (height, width, 3), by the means between neighbours.

    Args:
      camera: with a lens. drawn: that took the picture, see `source`. light: (rows, columns, 3) of it.
    """
    places = _places(camera, drawn)
    return np.stack([map_coordinates(light[..., k], places, float, order=1) for k in range(3)], axis=-1)


def depth_and_labels(
    camera: Pinhole, drawn: Pinhole, depth: np.ndarray, labels: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Depth, m, and labels as `camera` sees them, (height, width): labels of the nearest pixel.

    Args:
      camera, drawn: as in `looked_up`. depth: (rows, columns) m, infinite in the sky. labels: of the same pixels.
    """
    row, column = _places(camera, drawn)
    near = np.rint(row).astype(int), np.rint(column).astype(int)
    i, j = np.floor(row).astype(int), np.floor(column).astype(int)
    # Where all neighbours show one thing, between them: over the picture, one over depth is linear on a plane.
    alike = np.ones(row.shape, bool)
    for down, right in ((0, 0), (0, 1), (1, 0), (1, 1)):
        alike &= labels[i + down, j + right] == labels[near]
    with np.errstate(divide="ignore"):
        between = 1.0 / map_coordinates(1.0 / depth, (row, column), float, order=1)
    return np.where(alike, between, depth[near]), labels[near]


def _places(camera: Pinhole, drawn: Pinhole) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the drawn picture, 0 the middle of the first pixel, that each pixel's ray meets."""
    rays = camera.rays()
    return (0.5 * drawn.height - drawn.focal * rays[..., 1] - 0.5, 0.5 * drawn.width + drawn.focal * rays[..., 0] - 0.5)
