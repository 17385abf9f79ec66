"""What is drawn over a video: numbers, a map with the path, and slip and temperature over time."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lunar_mjx.cameras.ground_map import MAP_COLOURS, GroundMap
from lunar_mjx.report.style import MUTED
from lunar_mjx.rover.description import CORNER_WORDS
from lunar_mjx.visual.plots import WHEEL_STYLES, bounds
from lunar_mjx.visual.recorded import RecordedDrive


@dataclasses.dataclass(frozen=True)
class OverlayColours:
    """Colours of the overlay, red, green, blue and opacity."""

    glass: tuple[int, ...] = (10, 12, 16, 225)
    """So dark that no bright rock behind it passes for a minus sign."""
    text: tuple[int, int, int] = (240, 240, 240)
    faint: tuple[int, int, int] = (150, 155, 160)
    path: tuple[int, int, int] = (120, 190, 255)
    hot: tuple[int, int, int] = (255, 140, 70)


COLOURS = OverlayColours()


def wheel_colour(corner: str) -> tuple[int, int, int]:
    """RGB of a wheel's line on a dark ground: sides differ in colour as in the plots, rear wheels are dimmer."""
    colour = WHEEL_STYLES.get(corner, (MUTED,))[0]
    # Wheels of one side share a colour; how bright it is tells front from rear.
    bright = 0.62 if corner in ("lr", "rr") else 1.0
    # Brighter than in the plots, whose colours are made for white paper.
    red, green, blue = (round(bright * min(255, int(colour[i : i + 2], 16) + 60)) for i in (1, 3, 5))
    return red, green, blue


class Overlay:
    """Draws on pictures of one size.

    Args:
      drive: shown. size: width and height of the pictures, pixels. with_map: whether to inset a map.
    """

    def __init__(self, drive: RecordedDrive, size: tuple[int, int], with_map: bool = True) -> None:
        self._drive, self._size = drive, size
        small = max(10, size[1] // 42)
        self._font = ImageFont.load_default(small)
        self._line = round(1.35 * small)
        self._slip = drive.per_wheel("wheel_{}_slip_ratio")
        self._sinkage = 1e3 * drive.per_wheel("wheel_{}_sinkage_m").max(axis=1)
        self._hot = drive.per_motor("winding_{}_temperature_degC").max(axis=1)
        # Drawn once: only the line that marks the time differs from picture to picture.
        self._strip, self._frames = self._draw_strip()
        self._map = MapInset(drive, round(0.30 * size[1])) if with_map else None

    def draw(self, picture: np.ndarray, row: int) -> np.ndarray:
        """The picture with everything that is known at a row of the drive, (height, width, 3) uint8."""
        image = Image.fromarray(picture).convert("RGBA")
        width, height = self._size
        image.alpha_composite(self._strip, (0, height - self._strip.height))
        draw = ImageDraw.Draw(image)
        share = (self._drive.time[row] - self._drive.time[0]) / (self._drive.time[-1] - self._drive.time[0])
        for left, right, top, bottom in self._frames:
            x = left + share * (right - left)
            draw.line(
                [x, height - self._strip.height + top, x, height - self._strip.height + bottom], fill=COLOURS.text
            )
        self._draw_numbers(image, row)
        if self._map is not None:
            inset = self._map.draw(row)
            image.alpha_composite(inset, (width - inset.width - 8, 8))
        return np.asarray(image.convert("RGB"))

    def _draw_numbers(self, image: Image.Image, row: int) -> None:
        drive = self._drive
        along, across = drive.slope[row].round(1) + 0.0  # no minus before zero
        lines = [
            f"{drive.model.rover.name} on {drive.model.terrain.name}",
            f"time      {drive.time[row]:7.1f} s",
            f"speed     {100 * drive.speed[row]:7.1f} cm/s",
            f"slope     {along:7.1f}° along",
            f"          {across:7.1f}° across",
            f"slip      {np.nanmean(self._slip[row]):7.2f} mean",
            f"sinkage   {self._sinkage[row]:7.1f} mm deepest",
            f"winding   {self._hot[row]:7.1f} °C hottest",
        ]
        pad = self._line // 2
        values_at = 4.6 * self._line
        # The same width in every picture, whatever its numbers; without the words behind them in a small picture.
        room = [values_at + self._font.getlength(f"-0000.0 mm{words}") for words in (" deepest", "")]
        brief = room[0] > 0.4 * self._size[0]
        widest = max(self._font.getlength(lines[0]), room[brief])
        glass = Image.new("RGBA", (round(widest) + 2 * pad, len(lines) * self._line + 2 * pad), COLOURS.glass)
        draw = ImageDraw.Draw(glass)
        for i, line in enumerate(lines):
            name, value_text = (line, "") if i == 0 else (line[:10].strip(), line[10:])
            y = pad + i * self._line
            draw.text((pad, y), name, font=self._font, fill=COLOURS.text if i == 0 else COLOURS.faint)
            if value_text:
                shown = value_text.rsplit(" ", 1)[0] if brief else value_text
                draw.text((pad + values_at, y), shown.strip(), font=self._font, fill=COLOURS.text)
        image.alpha_composite(glass, (8, 8))

    def _draw_strip(self) -> tuple[Image.Image, list[tuple[float, float, float, float]]]:
        """Slip of the wheels and the hottest winding over the whole drive, and where the two plots lie."""
        width, height = self._size[0], round(0.2 * self._size[1])
        strip = Image.new("RGBA", (width, height), COLOURS.glass)
        draw = ImageDraw.Draw(strip)
        top, bottom = 1.6 * self._line, height - 0.5 * self._line
        frames = [
            (4.0 * self._line, 0.49 * width, top, bottom),
            (0.49 * width + 5.0 * self._line, width - 14, top, bottom),
        ]
        # Slip of a wheel at rest is not a number, and would break its line.
        slip = np.clip(np.nan_to_num(self._slip), -1.0, 1.0)
        # A few spikes, as at a start, would flatten all else.
        low, high = min(0.0, float(np.percentile(slip, 1))), max(0.5, float(np.percentile(slip, 99)))
        colours = [wheel_colour(c) for c in self._drive.corners]
        dashed = [WHEEL_STYLES.get(c, (MUTED, "-"))[1] != "-" for c in self._drive.corners]
        self._plot(draw, frames[0], slip, low, high, colours, "slip ratio", dashed)
        x = frames[0][0] + 5.5 * self._line
        names = [CORNER_WORDS.get(c, c) for c in self._drive.corners]
        room = frames[0][1] - x - len(names) * self._line
        if sum(self._font.getlength(name) for name in names) > room:
            names = self._drive.corners
        for name, colour in zip(names, colours, strict=True):
            draw.text((x, 0.3 * self._line), name, font=self._font, fill=colour)
            x += self._font.getlength(name) + self._line
        hot = self._hot[:, None]
        self._plot(
            draw,
            frames[1],
            hot,
            float(hot.min()),
            # One degree at least, or a motor at rest would have an axis without a length.
            max(float(hot.max()), float(hot.min()) + 1.0),
            [COLOURS.hot],
            "hottest winding, °C",
        )
        return strip, frames

    def _plot(
        self,
        draw: Any,
        frame: tuple[float, float, float, float],
        values: np.ndarray,
        low: float,
        high: float,
        colours: list[tuple[int, int, int]],
        title: str,
        dashed: Sequence[bool] = (False,),
    ) -> None:
        left, right, top, bottom = frame
        draw.text((left, 0.3 * self._line), title, font=self._font, fill=COLOURS.text)
        for value in (low, high):
            y = bottom - (value - low) / (high - low) * (bottom - top)
            draw.line([left, y, right, y], fill=(90, 95, 100))
            label = f"{value:.3g}"
            draw.text(
                (left - 6 - self._font.getlength(label), y - 0.6 * self._line),
                label,
                font=self._font,
                fill=COLOURS.faint,
            )
        time = self._drive.time
        x = left + (time - time[0]) / (time[-1] - time[0]) * (right - left)
        for column, colour, broken in zip(values.T, colours, dashed, strict=True):
            y = bottom - (np.clip(column, low, high) - low) / (high - low) * (bottom - top)
            for a, b in dashes(left, right, 0.6 * self._line) if broken else [(left, right)]:
                at = np.unique(np.concatenate([[a, b], x[(x > a) & (x < b)]]))
                draw.line(list(zip(at.tolist(), np.interp(at, x, y).tolist(), strict=True)), fill=colour, width=2)


def dashes(left: float, right: float, length: float) -> list[tuple[float, float]]:
    """Stretches of a broken line from left to right, with gaps half as long as the stretches; all in pixels."""
    return [(a, min(a + length, right)) for a in np.arange(left, right, 1.5 * length).tolist()]


class MapInset:
    """A small map of the whole path, north up, with the part driven so far.

    Args:
      drive: shown. size: pixels of a side.
    """

    def __init__(self, drive: RecordedDrive, size: int) -> None:
        self._drive = drive
        self.ground = GroundMap(drive.terrain, *bounds(drive.position[:, :2], 0.25), size)
        self._path = [self.ground.pixel(p) for p in drive.position[:, :2]]
        draw = ImageDraw.Draw(self.ground.base)
        draw.line(self._path, fill=(235, 235, 235), width=1)
        draw.rectangle([0, 0, self.ground.width - 1, self.ground.height - 1], outline=(200, 200, 200))

    def draw(self, row: int) -> Image.Image:
        """The map at a row of the drive."""
        # The ground, the path and the frame are the same in every picture.
        image = self.ground.base.copy()
        draw = ImageDraw.Draw(image)
        if row:
            draw.line(self._path[: row + 1], fill=MAP_COLOURS.path, width=3)
        yaw = np.radians(self._drive.table["yaw_deg"].to_numpy(float)[row])
        self.ground.arrow(draw, self._drive.position[row], float(yaw), max(5.0, 0.035 * self.ground.width))
        return image.convert("RGBA")
