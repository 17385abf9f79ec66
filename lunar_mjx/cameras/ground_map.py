"""A map of the ground for the screen: shaded relief with rocks, north up, and what stands on it."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from PIL import Image, ImageDraw

from lunar_mjx.cameras.relief import relief, ring, rocks_within
from lunar_mjx.terrain import Terrain


@dataclasses.dataclass(frozen=True)
class MapColours:
    """Colours of the map, red, green and blue."""

    # Colours of a rover, its goal and its path, wherever they are drawn upon the ground.
    rover: tuple[int, int, int] = (255, 196, 60)
    goal: tuple[int, int, int] = (90, 255, 120)
    path: tuple[int, int, int] = (86, 180, 233)
    stone: tuple[int, int, int] = (58, 58, 58)
    beyond: tuple[int, int, int] = (30, 30, 30)


MAP_COLOURS = MapColours()


class GroundMap:
    """The ground between two corners as a picture.

    Args:
      terrain: the ground.
      low, high: south-western and north-eastern corner, (2,) m.
      size: of the longer side, pixels.
    """

    def __init__(self, terrain: Terrain, low: Any, high: Any, size: int = 480) -> None:
        terrain = jax.device_get(terrain)
        self.low, high = np.asarray(low, float), np.asarray(high, float)
        extent = high - self.low
        self.scale = size / float(extent.max())
        self.width, self.height = (max(16, 2 * round(0.5 * e * self.scale)) for e in extent)
        ground = relief(terrain, self.low, high)
        grey = Image.fromarray((255 * ground.grey[::-1]).astype(np.uint8))
        west, north = self.pixel((ground.west, ground.north))
        east, south = self.pixel((ground.east, ground.south))
        self.base = Image.new("RGB", (self.width, self.height), MAP_COLOURS.beyond)
        placed = grey.resize((max(1, round(east - west)), max(1, round(south - north))), Image.Resampling.BICUBIC)
        self.base.paste(placed.convert("RGB"), (round(west), round(north)))
        draw = ImageDraw.Draw(self.base)
        for x, y, a, b, angle in rocks_within(terrain, self.low, high):
            u, v = self.pixel((x, y))
            a, b = max(1.0, a * self.scale), max(1.0, b * self.scale)
            if a == b:
                draw.ellipse([u - a, v - a, u + a, v + a], fill=MAP_COLOURS.stone)
            else:  # rows go down the picture
                draw.polygon([tuple(corner) for corner in ring(np.array([u, v, a, b, -angle]))], fill=MAP_COLOURS.stone)

    def pixel(self, place: Any) -> tuple[float, float]:
        """Column and row of a place (2 or more,) m."""
        u, v = (np.asarray(place, float)[:2] - self.low) * self.scale
        return float(u), float(self.height - v)

    def frame(
        self, position: Any, yaw: float, goal: Any, radius: float, path: Sequence[Any] = (), length: float = 1.0
    ) -> np.ndarray:
        """The map with a rover, its path and its goal, (height, width, 3) uint8.

        Args:
          position, yaw: of the rover, m and rad. goal: (2,) m, and its radius, m.
          path: places driven so far. length: of the rover, m.
        """
        image = self.base.copy()
        draw = ImageDraw.Draw(image)
        if len(path) > 1:
            draw.line([self.pixel(p) for p in path], fill=MAP_COLOURS.path, width=3)
        u, v = self.pixel(goal)
        r = max(3.0, radius * self.scale)
        draw.ellipse([u - r, v - r, u + r, v + r], outline=MAP_COLOURS.goal, width=2)
        self.arrow(draw, position, yaw, max(0.5 * length * self.scale, 4.0))
        return np.asarray(image)

    def arrow(self, draw: Any, position: Any, yaw: float, half: float) -> None:
        """Draws a rover's outline with a nose, `half` pixels from its middle to its side."""
        u, v = self.pixel(position)
        forward, left = (np.array([np.cos(yaw + t), -np.sin(yaw + t)]) for t in (0.0, np.pi / 2))
        corners = ((1, 1), (1.4, 0), (1, -1), (-1, -1), (-1, 1))
        nose = [tuple(np.array([u, v]) + half * (a * forward + 0.6 * b * left)) for a, b in corners]
        draw.polygon(nose, fill=MAP_COLOURS.rover, outline=(60, 40, 0))
