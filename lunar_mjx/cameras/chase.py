"""A camera that follows a rover from behind, with its goal; and the tracks that its wheels leave."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from lunar_mjx.cameras.camera import RoverCamera
from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.dust.recorded import wheel_motion
from lunar_mjx.cameras.gl import Post
from lunar_mjx.cameras.ground_map import MAP_COLOURS
from lunar_mjx.cameras.pinhole import Pinhole, look_at
from lunar_mjx.cameras.scene import Sun
from lunar_mjx.cameras.texture import Track
from lunar_mjx.rover import Rover, Wheel
from lunar_mjx.terrain import Terrain


@dataclasses.dataclass(frozen=True)
class GoalPost:
    """The post that marks a goal: a choice."""

    height: float = 1.6
    """m."""
    radius: float = 0.03
    """m."""


GOAL_POST = GoalPost()


def wheel_places(rover: Rover, qpos: np.ndarray) -> np.ndarray:
    """Centres of a rover's wheels, (time, wheel, 3) m, for coordinates (time, nq) of its MJCF."""
    return wheel_motion(rover, qpos).centre


def wheel_tracks(rover: Rover, qpos: np.ndarray) -> list[Track]:
    """Where a rover's wheels rolled, a row of places for each row of coordinates (time, nq)."""
    return tracks_of(rover, wheel_places(rover, qpos))


def tracks_of(rover: Rover, places: np.ndarray) -> list[Track]:
    """The tracks of wheels whose centres went through places (time, wheel, 2 or 3) m."""
    return [Track(places[:, i, :2], w.width, print_pitch(w)) for i, w in enumerate(rover.wheels)]


def print_pitch(wheel: Wheel) -> float:
    """Distance between the prints of a wheel's grousers, m."""
    return 0.25 * wheel.radius


class Chase:
    """Pictures of a rover on its way to a goal, by MuJoCo's renderer.

    Args:
      rover, terrain: what drives where.
      places: (n, 2) m around which the ground is drawn finely.
      size: width and height, pixels.
      tracks: of the wheels; see `wheel_tracks`. Rows of them are shown as `frame` is told.
      sun: where the Sun stands.

    Raises:
      UserError: no OpenGL works here.
    """

    def __init__(
        self,
        rover: Rover,
        terrain: Terrain,
        places: Any,
        size: tuple[int, int] = (480, 320),
        tracks: Sequence[Track] = (),
        sun: Sun | None = None,
    ) -> None:
        self._optics = Pinhole(*size, fovy_deg=45.0)
        self._camera = RoverCamera(
            rover, terrain, places, self._optics, sun=sun, tracks=tracks, largest=size, untrodden=True
        )
        self._away, self._up = 8.0 * rover.standing_height + 2.0, 3.0 * rover.standing_height + 0.8
        self._tracks = bool(tracks)

    def frame(
        self,
        qpos: Any,
        yaw: float,
        goal: Any,
        ground: float,
        row: int | None = None,
        grown: Sequence[Track] = (),
        dust: Grains | None = None,
    ) -> np.ndarray:
        """One picture, (height, width, 3) uint8.

        Args:
          qpos: coordinates of the rover's MJCF. yaw: its heading, rad, smoothed if need be.
          goal: (2,) m. ground: height there, m.
          row: wheel tracks are shown up to this row of their places.
          grown: tracks so far, where they are not known beforehand; those of the frame before, and on.
          dust: grains in flight, see `dust.Dust`.
        """
        self._camera.place(qpos)
        if row is not None and self._tracks:
            self._camera.roll(row + 1)
        if grown:
            self._camera.tread(grown)
        at = np.asarray(qpos, float)[:3]
        behind = np.array([-math.cos(yaw), -math.sin(yaw), 0.0])
        pose = look_at(at + self._away * behind + np.array([0.0, 0.0, self._up]), at)
        foot = np.array([*np.asarray(goal, float)[:2], ground])
        depth = float((pose.position - foot) @ pose.rotation[:, 2])
        # From far away it is a pixel wide, or it would come and go.
        radius = max(GOAL_POST.radius, 0.5 * depth / self._optics.focal)
        post = Post(foot, foot + np.array([0.0, 0.0, GOAL_POST.height]), radius, MAP_COLOURS.goal)
        return self._camera.picture(pose, self._optics, post, dust)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._camera.close()
