"""A drive as a video: MuJoCo's picture of the rover (or a map where there is no OpenGL) with numbers and plots."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from lunar_mjx.cameras import Pinhole, Pose, RoverCamera, Sun, look_at
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.report import Reporter
from lunar_mjx.visual.encode import require_encoder, writer
from lunar_mjx.visual.overlay import MapInset, Overlay
from lunar_mjx.visual.recorded import RecordedDrive

VIEWS = ("auto", "follow", "front", "top")
_BEHIND = 1.2
"""How much better a quarter behind is than one ahead, in the cosine between camera and Sun: as much as decides for it
until the Sun is within about 45 degrees of the heading."""
LONGEST = 20.0
"""Length of a video whose speed is chosen, s."""
MOST_PICTURES = 200_000
"""Pictures of a video: almost an hour of the most that a second takes, days of drawing."""


def frame_rows(drive: RecordedDrive, fps: int, speed: float) -> tuple[np.ndarray, float]:
    """Row of the table for each picture, and the speed-up; `speed` 0 chooses one."""
    length = drive.time[-1] - drive.time[0]
    if speed == 0.0:
        speed = max(1.0, math.ceil(length / LONGEST))
    if (pictures := length * fps / speed) > MOST_PICTURES:
        problem = f"makes {pictures:.3g} pictures, above {MOST_PICTURES}"
        raise bad_input("render", "speed", speed, problem, "give a higher speed")
    at = drive.time[0] + np.arange(0.0, length + 1e-9, speed / fps)
    # A picture at a row's very time shows that row, whatever the last digits are.
    return np.clip(np.searchsorted(drive.time, at + 1e-9) - 1, 0, len(drive.time) - 1), speed


def render_video(
    drive: RecordedDrive,
    path: Path,
    view: str = "auto",
    size: tuple[int, int] = (960, 540),
    fps: int = 20,
    speed: float = 0.0,
    sun: Sun | None = None,
    report: Reporter = lambda what, done: None,
) -> Path:
    """Writes a video of a drive.

    Args:
      drive: shown. path: .mp4, .webp or .gif.
      view: "follow" beside the rover, "front" camera, "top" map, or "auto": follow where OpenGL works, else top.
      size: width and height, pixels, made even. fps: pictures per second. speed: times real time; 0 keeps the video
        within `LONGEST` s.
      sun: where the Sun stands. report: told of the progress.

    Returns:
      The path.

    Raises:
      UserError: unknown view, a size out of range, no OpenGL, or no encoder.
    """
    if view not in VIEWS:
        raise bad_input("render", "view", view, "does not exist", f"use one of {', '.join(VIEWS)}")
    # Even, since yuv420p has one colour for two by two pixels.
    width, height = (int(v) // 2 * 2 for v in size)
    if not (160 <= width <= 3840 and 120 <= height <= 2160):
        raise bad_input("render", "size", f"{size[0]}x{size[1]}", "is outside 160x120 to 3840x2160", "use 960x540")
    require_encoder(path)
    rows, factor = frame_rows(drive, fps, speed)
    report("placing the rover", 0.0)
    with _pictures(drive, view, (width, height), sun or Sun()) as (picture, kind), writer(path, fps) as put:
        overlay = Overlay(drive, (width, height), with_map=kind != "top")
        for k, row in enumerate(rows):
            report(f"{kind} view, {factor:g} times real time", k / len(rows))
            put(overlay.draw(picture(int(row)), int(row)))
    report("done", 1.0)
    return path


@contextlib.contextmanager
def _pictures(drive: RecordedDrive, view: str, size: tuple[int, int], sun: Sun) -> Iterator[tuple[Any, str]]:
    """A function from a row to its picture, and which view it is."""
    if view != "top":
        try:
            camera = RoverCamera(
                drive.model.rover,
                drive.terrain,
                drive.position[:, :2],
                Pinhole(*size, fovy_deg=60.0),
                sun=sun,
                tracks=drive.tracks(),
                largest=size,
                untrodden=True,
            )
        except UserError:
            if view != "auto":
                raise
        else:
            with camera:
                yield _Follow(drive, camera, view), "front" if view == "front" else "follow"
            return
    yield _Top(drive, size), "top"


class _Follow:
    """MuJoCo's picture, from a quarter of the rover or from its front camera."""

    def __init__(self, drive: RecordedDrive, camera: RoverCamera, view: str) -> None:
        self._camera, self._qpos, self._front = camera, drive.qpos, view == "front"
        self._optics = Pinhole(camera.camera.width, camera.camera.height, 42.0)
        reach = float(np.abs(drive.model.rover.chassis_points).max())
        self._away, self._up = 5.5 * reach, 1.9 * reach
        self._time, self._dust = drive.time, drive.dust()
        # Unwrapped, since a mean across 180 degrees would turn the camera around.
        yaw = np.unwrap(np.radians(drive.columns(["yaw_deg"])[:, 0]))
        interval = float(np.median(np.diff(drive.time)))
        # The camera follows slowly: at the rover's own pace every rock would shake the picture.
        self._yaw = smooth(yaw, 2.0 / interval)
        self._side = brightest_side(float(np.mean(yaw)), camera.sun.direction)
        self._at = np.stack([smooth(p, 0.5 / interval) for p in drive.position.T], axis=-1)

    def __call__(self, row: int) -> np.ndarray:
        camera = self._camera
        camera.place(self._qpos[row])
        camera.roll(row + 1)
        grains = self._dust.at(float(self._time[row]))
        if self._front:
            return camera.picture(camera.front_pose, dust=grains)
        return camera.picture(self._pose(row), self._optics, dust=grains)

    def _pose(self, row: int) -> Pose:
        at, angle = self._at[row], self._yaw[row] + self._side
        aside = np.array([math.cos(angle), math.sin(angle), 0.0])
        return look_at(at + self._away * aside + np.array([0.0, 0.0, self._up]), at)


def brightest_side(yaw: float, sun: np.ndarray) -> float:
    """Direction from the rover to the camera, rad from its heading: the quarter from which its sunlit faces show.

    It is one behind, where the tracks are, unless the Sun stands nearly ahead, and all that one sees there is dark.
    """
    quarters = np.array([math.pi - 0.6, math.pi + 0.6, 0.7, -0.7])
    towards = np.cos(yaw + quarters) * sun[0] + np.sin(yaw + quarters) * sun[1]
    return float(quarters[int(np.argmax(towards + _BEHIND * np.array([1.0, 1.0, 0.0, 0.0])))])


class _Top:
    """The map alone, enlarged."""

    def __init__(self, drive: RecordedDrive, size: tuple[int, int]) -> None:
        self._size = size
        self._map = MapInset(drive, round(0.8 * size[1]))

    def __call__(self, row: int) -> np.ndarray:
        image = Image.new("RGB", self._size, (16, 18, 22))
        drawn = self._map.draw(row)
        image.paste(drawn.convert("RGB"), (self._size[0] - drawn.width - 8, 0))
        return np.asarray(image)


def smooth(values: np.ndarray, width: float) -> np.ndarray:
    """Gaussian mean over about `width` entries, the ends held."""
    from scipy.ndimage import gaussian_filter1d

    return gaussian_filter1d(values, max(width, 1e-3), mode="nearest")
