"""What the ground looks like from near: regolith's mottling, and the tracks of wheels, painted on a square picture."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw

ALBEDO = np.array([0.79, 0.77, 0.744])
"""Colour of regolith under MuJoCo's light, 0.55 on level ground (`scene.LEVEL_LIGHT`). So level ground is as bright
on screen as the cameras in JAX expose it: 0.16 ** (1 / 2.2) = 0.435 (`Film`)."""
TINT = ALBEDO / ALBEDO[0]
"""Colour of regolith over that of its red."""


@dataclasses.dataclass(frozen=True)
class SoilTexture:
    """How soil and wheel tracks look."""

    contrast: float = 0.10
    """Deviation of the mottling, of the brightness."""
    octaves: int = 7
    """Layers of the mottling at most, from patches of metres down, each 2.6 times as fine as the one before."""
    # Brightness of a track's bottom and of its bars, of 255.
    rut: int = 205
    print: int = 140


SOIL_TEXTURE = SoilTexture()


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
    for k in range(SOIL_TEXTURE.octaves):
        cells = max(2, round(metres / 2.0 * 2.6**k))
        if cells > 2 * size:
            break
        small = random.standard_normal((min(cells, size), min(cells, size))).astype(np.float32)
        image = Image.fromarray(small).resize((size, size), Image.Resampling.BICUBIC)
        grey += np.asarray(image) * (0.55 if k < 2 else 1.0)
    grey *= SOIL_TEXTURE.contrast / grey.std()
    return np.clip(255.0 * ALBEDO * (1.0 + grey[..., None]), 0, 255).astype(np.uint8)


class TrackPainter:
    """Paints wheel tracks into a picture of the ground, row by row of the drive.

    Args:
      picture: (rows, cols, 3) uint8, north up.
      low: west and south edge, m. metres: extent east and north, m.
      tracks: wheels' paths, all with a place for each row of the drive.
    """

    def __init__(
        self, picture: np.ndarray, low: Sequence[float], metres: Sequence[float], tracks: Sequence[Track]
    ) -> None:
        self._ground, self._low = picture, np.asarray(low, float)
        self._rows, cols = picture.shape[:2]
        self._scale = np.array([cols / metres[0], self._rows / metres[1]])
        self._shade = Image.new("L", (cols, self._rows), 255)
        self._painted = 0
        self.follow(tracks)

    def follow(self, tracks: Sequence[Track]) -> None:
        """Takes tracks that have grown since; rows that are painted stay as they are."""
        bars = [bar for track in tracks for bar in (*self._ruts(track), *self._prints(track))]
        self._todo = sorted((bar for bar in bars if bar[0] >= self._painted), key=lambda bar: bar[0])

    def paint(self, rows: int) -> np.ndarray:
        """The picture after so many rows of the drive: soil a little darker, bars where grousers pressed."""
        draw, count = ImageDraw.Draw(self._shade), 0
        for row, corners, shade in self._todo:
            if row >= rows:
                break
            draw.polygon(corners, fill=shade)
            count += 1
        del self._todo[:count]
        self._painted = max(self._painted, rows)
        return (self._ground * (np.asarray(self._shade, np.float32)[..., None] / 255.0)).astype(np.uint8)

    def _ruts(self, track: Track) -> list[tuple[int, list, int]]:
        kept = thinned(track.places, 0.02)
        return [
            (int(j), self._bar(track.places[i], track.places[j], track.width), SOIL_TEXTURE.rut)
            for i, j in itertools.pairwise(kept)
        ]

    def _prints(self, track: Track) -> list[tuple[int, list, int]]:
        """A bar every `pitch` m of path."""
        places, pitch = track.places, track.pitch
        length = _along(places)
        if pitch <= 0.0 or length[-1] < pitch:
            return []
        keep = np.concatenate([[True], np.diff(length) > 1e-9])

        def place(at: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(at, length[keep], places[keep, i]) for i in range(2)], axis=-1)

        at = np.arange(0.0, length[-1], pitch)
        middle, way = place(at), place(at + 0.5 * pitch) - place(at - 0.5 * pitch)
        way *= 0.12 * pitch / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-9)
        # a little after the rut beneath it, which would else be painted over it
        print_index = np.searchsorted(length, np.minimum(at + 0.03, length[-1]))
        return [
            (int(w) + 1, self._bar(m - d, m + d, 0.94 * track.width), SOIL_TEXTURE.print)
            for w, m, d in zip(print_index, middle, way, strict=True)
        ]

    def _bar(self, a: np.ndarray, b: np.ndarray, width: float) -> list[tuple[float, float]]:
        """Corners in pixels of the bar from a to b."""
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-9)
        aside = 0.5 * width * np.array([-along[1], along[0]])
        corners = (np.array([a + aside, b + aside, b - aside, a - aside]) - self._low) * self._scale
        return [(float(u), float(self._rows - v)) for u, v in corners]


def thinned(places: np.ndarray, step: float) -> np.ndarray:
    """Indices of places that lie at least `step` m of path after the one before."""
    return np.unique((_along(places) / step).astype(int), return_index=True)[1]


def _along(places: np.ndarray) -> np.ndarray:
    """Length of the path up to each place, m."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(places, axis=0), axis=1))])
