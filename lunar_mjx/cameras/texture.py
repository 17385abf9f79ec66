"""What the ground looks like from near: regolith's mottling, and the tracks of wheels, painted on a square picture."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

ALBEDO = np.array([0.60, 0.585, 0.565])
"""Colour of sunlit regolith on screen. The Moon reflects 12 %; a camera exposes for that."""

CONTRAST = 0.10
"""Deviation of the mottling, of the brightness."""

_OCTAVES = 7


@dataclasses.dataclass(frozen=True)
class Track:
    """Where one wheel rolled.

    Attributes:
      places: (n, 2) m in the order of rolling. width: of the wheel, m.
      pitch: distance between grouser prints, m; 0 for a smooth wheel.
    """

    places: np.ndarray
    width: float
    pitch: float = 0.06


def regolith(size: int, metres: float, seed: int = 0) -> np.ndarray:
    """Mottled ground of `metres` x `metres`, (size, size, 3) uint8: noise of octaves down to some millimetres."""
    random = np.random.default_rng(seed)
    grey = np.zeros((size, size), np.float32)
    for k in range(_OCTAVES):
        cells = max(2, round(metres / 2.0 * 2.6**k))
        if cells > 2 * size:
            break
        small = random.standard_normal((min(cells, size), min(cells, size))).astype(np.float32)
        image = Image.fromarray(small).resize((size, size), Image.Resampling.BICUBIC)
        grey += np.asarray(image) * (0.55 if k < 2 else 1.0)
    grey *= CONTRAST / grey.std()
    return np.clip(255.0 * ALBEDO * (1.0 + grey[..., None]), 0, 255).astype(np.uint8)


def paint_tracks(
    picture: np.ndarray, low: Sequence[float], metres: Sequence[float], tracks: Sequence[Track]
) -> np.ndarray:
    """The picture with wheel tracks.

    Args:
      picture: (rows, cols, 3) uint8, north up.
      low: west and south edge, m. metres: extent east and north, m.
      tracks: wheels' paths.

    Returns:
      A new picture: compacted soil a little darker, bars where grousers pressed.
    """
    rows, cols = picture.shape[:2]
    scale = np.array([cols / metres[0], rows / metres[1]])
    shade = Image.new("L", (cols, rows), 255)
    draw = ImageDraw.Draw(shade)
    for track in tracks:
        for a, b in _pieces(track.places):
            draw.polygon(_bar(a, b, track.width, low, scale, rows), fill=205)
    for track in tracks:
        for middle, along in _prints(track.places, track.pitch):
            a, b = middle - 0.12 * track.pitch * along, middle + 0.12 * track.pitch * along
            draw.polygon(_bar(a, b, 0.94 * track.width, low, scale, rows), fill=140)
    return (picture * (np.asarray(shade, np.float32)[..., None] / 255.0)).astype(np.uint8)


def _pieces(places: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    return list(itertools.pairwise(thinned(places, 0.02)))


def thinned(places: np.ndarray, step: float) -> np.ndarray:
    """Every place that lies at least `step` m of path after the one before."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
    _, first = np.unique((length / step).astype(int), return_index=True)
    return places[first]


def _bar(a: np.ndarray, b: np.ndarray, width: float, low: Sequence[float], scale: np.ndarray, rows: int) -> list:
    """Corners in pixels of the bar from a to b."""
    along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
    aside = 0.5 * width * np.array([-along[1], along[0]])
    corners = (np.array([a + aside, b + aside, b - aside, a - aside]) - np.asarray(low)) * scale
    return [(float(u), float(rows - v)) for u, v in corners]


def _prints(places: np.ndarray, pitch: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and directions every `pitch` m of path."""
    if pitch <= 0.0 or len(places) < 2:
        return []
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(step)])
    at = np.arange(0.0, length[-1], pitch)
    keep = np.concatenate([[True], step > 1e-9])
    x, y = (np.interp(at, length[keep], places[keep, i]) for i in range(2))
    middle = np.stack([x, y], axis=-1)
    if len(middle) < 2:
        return []
    along = np.gradient(middle, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)
    return list(zip(middle, along, strict=True))
