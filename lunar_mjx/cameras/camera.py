"""Pictures of a rover on its terrain: the front camera and any free camera, in colour, depth and segmentation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.dust import Grains, sunlit, veiled
from lunar_mjx.cameras.gl import Offscreen, Post
from lunar_mjx.cameras.mount import carried, front_mount
from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.cameras.scene import FAR_GROUND, GROUND, ROCK, Sun, build_scene, shadow_light
from lunar_mjx.cameras.texture import Track
from lunar_mjx.errors import bad_input
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import Terrain

LABELS = ("sky", "terrain", "rock", "rover")
"""What the numbers of a segmentation mean."""


@dataclasses.dataclass(frozen=True, eq=False)
class Images:
    """One view, as the seed paper's III-E defines it, and the matrices that it was taken with.

    Attributes:
      rgba: (height, width, 4) uint8; alpha is 255 everywhere.
      depth: (height, width) m along the optical axis, infinite in the sky.
      segmentation: (height, width) index into `LABELS`.
      view, projection: (4, 4), world to camera and camera to clip coordinates (OpenGL's conventions).
    """

    rgba: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray
    view: np.ndarray
    projection: np.ndarray


class RoverCamera:
    """Renders a rover on its terrain; the picture is made by OpenGL, on one rover at a time.

    For depth and heights of thousands of rovers without OpenGL see `raymarch`.

    Args:
      rover: the rover. terrain: the ground.
      places: (n, 2) m where the rover will be, so that the ground around is drawn finely; the origin if None.
      camera: optics of the front camera. mount: its pose in the chassis frame; on the rover's highest part if None.
      sun: where the Sun stands. tracks: of wheels, drawn into the ground. untrodden: begin without them; see `roll`.
      margin: how far the finely drawn ground reaches beyond `places`, m.
      largest: width and height of the largest picture to come, pixels.
      backends: of OpenGL; EGL or else OSMesa if None.

    Raises:
      UserError: no OpenGL works here; or optics with a lens, here or for a free camera, which OpenGL does not draw.
    """

    def __init__(
        self,
        rover: Rover,
        terrain: Terrain,
        places: Any = None,
        camera: Pinhole | None = None,
        mount: Pose | None = None,
        sun: Sun | None = None,
        tracks: Sequence[Track] = (),
        margin: float = 15.0,
        largest: tuple[int, int] = (1280, 960),
        backends: Sequence[str] | None = None,
        untrodden: bool = False,
    ) -> None:
        self.camera, self.sun = _plain(camera or Pinhole()), sun or Sun()
        self.mount = mount or front_mount(rover)
        around = np.zeros((1, 2)) if places is None else np.asarray(places, float)
        self.model, self._painter = build_scene(
            rover, terrain, around, self.sun, tracks, margin, self.mount, self.camera.fovy_deg
        )
        self.data = mujoco.MjData(self.model)
        self._chassis = self.model.body(rover.chassis).id
        # The last entry is the sky: geom -1 picks it.
        # Looked up once: a segmentation is then one indexing.
        self._labels = np.array([_label(self.model.geom(i).name) for i in range(self.model.ngeom)] + [0])
        self._offscreen = Offscreen(
            self.model, max(largest[0], self.camera.width), max(largest[1], self.camera.height), backends
        )
        self.place(self.model.qpos0)
        if tracks and not untrodden:
            self.roll(max(len(t.places) for t in tracks))

    def roll(self, rows: int) -> None:
        """Shows the wheel tracks up to a row of their places; call it with rising rows for a video."""
        texture = self.model.texture(GROUND).id
        start = self.model.tex_adr[texture]
        picture = self._painter.paint(rows)
        self.model.tex_data[start : start + picture.size] = picture.ravel()
        self._offscreen.upload(texture)

    def tread(self, tracks: Sequence[Track]) -> None:
        """Shows wheel tracks that have grown since they were last shown, whole; for pictures while a rover drives."""
        self._painter.follow(tracks)
        self.roll(max(len(t.places) for t in tracks))

    def place(self, qpos: Any) -> None:
        """Puts the rover into the coordinates of its MJCF."""
        wanted = np.asarray(qpos, float)
        if wanted.shape != (self.model.nq,):
            raise bad_input("camera", "qpos", wanted.shape, "has another shape", f"give ({self.model.nq},)")
        self.data.qpos[:] = wanted
        # Poses alone; dynamics do not show in a picture.
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)

    @property
    def front_pose(self) -> Pose:
        """Pose of the front camera in the world."""
        return carried(
            self.mount, self.data.xpos[self._chassis].copy(), self.data.xmat[self._chassis].reshape(3, 3).copy()
        )

    def front(self) -> Images:
        """What the front camera sees."""
        return self.take(self.front_pose, self.camera)

    def take(self, pose: Pose, camera: Pinhole | None = None) -> Images:
        """What a camera sees from anywhere."""
        optics = camera or self.camera
        colours = self.picture(pose, optics)
        depth, geoms = self._offscreen.depth_and_geoms()
        rgba = np.concatenate([colours, np.full((*colours.shape[:2], 1), 255, np.uint8)], axis=-1)
        return Images(rgba, depth, self._labels[geoms], pose.view_matrix(), optics.projection_matrix())

    def picture(
        self, pose: Pose, camera: Pinhole | None = None, post: Post | None = None, dust: Grains | None = None
    ) -> np.ndarray:
        """The colours alone, (height, width, 3) uint8: half the work of `take`.

        Args:
          pose, camera: where from, and by which optics. post: a mark, if there is one. dust: grains in flight.
        """
        optics = _plain(camera or self.camera)
        at = self.data.xpos[self._chassis]
        # The shadows' light follows the rover: its shadow map covers some metres only.
        self._offscreen.look(self.data, pose, optics, shadow_light(at, self.sun), post)
        if dust is None or not len(dust.position):
            return self._offscreen.colours()
        colours, depth = self._offscreen.colours_and_depth()
        towards = self.sun.direction
        return veiled(
            colours, depth, pose, optics, dust, sunlit(self.model, self.data, dust.position, towards), towards
        )

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._offscreen.close()

    def __enter__(self) -> RoverCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _plain(camera: Pinhole) -> Pinhole:
    """The optics, if OpenGL can draw them."""
    if camera.lens is not None:
        raise bad_input(
            "camera",
            "lens",
            camera.lens,
            "is not drawn by OpenGL",
            "leave it out here, or take the picture by the cameras in JAX (cameras.pictures)",
        )
    return camera


def _label(name: str) -> int:
    if name in (GROUND, FAR_GROUND):
        return 1
    return 2 if name.startswith(f"{ROCK}_") else 3
