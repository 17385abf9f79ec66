"""Pictures of one rover's episode as it goes on: MuJoCo's camera where there is OpenGL, else a shaded map."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from lunar_mjx.cameras.chase import Chase, tracks_of
from lunar_mjx.cameras.dust.grains import Grains, WheelMotion
from lunar_mjx.cameras.dust.recorded import Dust, wheel_motion
from lunar_mjx.cameras.ground_map import GroundMap
from lunar_mjx.envs.core import State
from lunar_mjx.envs.navigation.env import NavigationEnv
from lunar_mjx.errors import UserError, bad_input

VIEWS = ("auto", "camera", "top")


@dataclasses.dataclass(frozen=True)
class MapMargins:
    """How far the map of an episode reaches: a choice."""

    around: float = 4.0
    """m around what the map must show."""
    beyond: float = 3.0
    """m beyond start and goal that the map shows, since a rover may leave the straight line."""


MAP_MARGINS = MapMargins()


class Picture:
    """Draws the first rover of a batch.

    Args:
      env: with a rover. view: one of `VIEWS`.

    Raises:
      UserError: unknown view.
    """

    def __init__(self, env: Any, view: str = "auto"):
        if view not in VIEWS:
            raise bad_input("render", "view", view, "does not exist", f"use one of {', '.join(VIEWS)}")
        self.env, self._view = env, view
        self._camera: Chase | None = None
        self._top: GroundMap | None = None
        self._qpos = np.zeros(0)
        self._path: list[np.ndarray] = []
        self._poses: list[np.ndarray] = []  # that no picture has shown yet
        self._wheels: WheelMotion | None = None  # their motion until then

    @staticmethod
    def fits(env: Any) -> bool:
        """Whether the environment has a rover to draw."""
        return isinstance(env, NavigationEnv)

    def begin(self, state: State) -> None:
        """Starts the pictures of a new episode."""
        self.close()
        self._qpos = np.asarray(state.inner.physics.qpos[0])
        self._goal = np.asarray(state.inner.goal[0])
        # The ground where the rover starts: cameras and markers count heights from there.
        self._ground = float(self._qpos[2]) - self.env.model.rover.standing_height
        self._path, self._poses, self._wheels = [self._qpos[:2]], [self._qpos], None
        self._top, self._camera, self._tried = None, None, False

    def add(self, state: State, done: bool) -> None:
        """A step later; the pose after the last step is gone with the reset, so the one before stays."""
        if not done:
            self._qpos = np.asarray(state.inner.physics.qpos[0])
            self._path.append(self._qpos[:2])
            self._poses.append(self._qpos)

    def frame(self) -> np.ndarray:
        """The picture now, (height, width, 3) uint8.

        Raises:
          UserError: before the first reset, or view `camera` without OpenGL.
        """
        if not len(self._qpos):
            raise bad_input("render", "frame", "a picture", "comes before the first reset", "call reset first")
        w, x, y, z = self._qpos[3:7]
        yaw = float(np.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z)))
        camera = self._open()
        if camera is not None:
            wheels = self._moved()
            tracks = tracks_of(self.env.model.rover, wheels.centre)
            return camera.frame(self._qpos, yaw, self._goal, self._ground, grown=tracks, dust=self._thrown(wheels))
        if self._top is None:
            places = self._places()
            low, high = places.min(axis=0) - MAP_MARGINS.around, places.max(axis=0) + MAP_MARGINS.around
            self._top = GroundMap(self.env.params.system.terrain, low, high)
        size = 5.0 * self.env.model.rover.standing_height
        return self._top.frame(self._qpos, yaw, self._goal, self.env.config.goal_radius, self._path, size)

    def _moved(self) -> WheelMotion:
        """How the wheels moved so far; poses are turned into places of wheels once."""
        if self._poses:
            new = wheel_motion(self.env.model.rover, np.stack(self._poses))
            kept = self._wheels
            self._wheels = new if kept is None else WheelMotion(*map(np.concatenate, zip(kept, new, strict=True)))
            self._poses = []
        assert self._wheels is not None
        return self._wheels

    def _thrown(self, wheels: WheelMotion) -> Grains:
        """What the wheels throw up now."""
        model, time = self.env.model, self.env.control_interval * np.arange(len(wheels.angle))
        hard = "hard_surface" in model.effect_names
        terrain = self.env.params.system.terrain
        return Dust(model.rover, terrain, time, wheels, model.gravity, hard).at(float(time[-1]))

    def _places(self) -> np.ndarray:
        ends = np.stack([self._path[0], self._goal])
        return np.concatenate([ends - MAP_MARGINS.beyond, ends + MAP_MARGINS.beyond])

    def _open(self) -> Chase | None:
        if self._camera is None and self._view != "top" and not self._tried:
            # Tried once an episode: without OpenGL every further frame would wait for the same failure.
            self._tried = True
            try:
                self._camera = Chase(self.env.model.rover, self.env.params.system.terrain, self._places())
            except UserError:
                if self._view == "camera":
                    raise
        return self._camera

    def close(self) -> None:
        """Frees the renderer."""
        if self._camera is not None:
            self._camera.close()
            self._camera = None
