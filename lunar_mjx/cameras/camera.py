"""Pictures of a rover on its terrain: the front camera and any free camera, in colour, depth and segmentation."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.dust.veil import sunlit, veiled
from lunar_mjx.cameras.gl import Offscreen, Post
from lunar_mjx.cameras.mount import carried, front_mount
from lunar_mjx.cameras.photometry import Film, Regolith
from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.cameras.resample import depth_and_labels, looked_up, source
from lunar_mjx.cameras.scene import FAR_GROUND, GROUND, ROCK, Sun, build_scene, shadow_light
from lunar_mjx.cameras.texture import Track
from lunar_mjx.errors import bad_input
from lunar_mjx.rover import Rover
from lunar_mjx.terrain import Terrain

_LIGHT = (np.arange(256) / 255.0) ** Film().gamma
"""Light on the sensor, of which 1 saturates it, of what a screen is told."""

LABELS = ("sky", "terrain", "rock", "rover")
"""What the numbers of a segmentation mean."""
MOST = (4096, 4096)
"""Largest picture that OpenGL is asked for, pixels: as large as a `Pinhole` may be."""


@dataclasses.dataclass(frozen=True, eq=False)
class Images:
    """One view, as the seed paper's III-E defines it, and the matrices that it was taken with.

    Attributes:
      rgba: (height, width, 4) uint8; alpha is 255 everywhere.
      depth: (height, width) m along the optical axis, infinite in the sky.
      segmentation: (height, width) index into `LABELS`.
      view, projection: (4, 4), world to camera and camera to clip coordinates (OpenGL's conventions), of the pinhole:
        where a lens shows a point, `project` tells.
    """

    rgba: np.ndarray
    depth: np.ndarray
    segmentation: np.ndarray
    view: np.ndarray
    projection: np.ndarray


class RoverCamera:
    """Renders a rover on its terrain; the picture is made by OpenGL, on one rover at a time.

    OpenGL draws pinholes. Through a lens the picture is drawn wider and looked up ray by ray, so that a lens and a film
    show what they show in the cameras in JAX. For pictures of thousands of rovers without OpenGL see `pictures`.

    Args:
      rover: the rover. terrain: the ground.
      places: (n, 2) m where the rover will be, so that the ground around is drawn finely; the origin if None.
      camera: optics of the front camera. mount: its pose in the chassis frame; on the rover's highest part if None.
      sun: where the Sun stands. tracks: of wheels, drawn into the ground. untrodden: begin without them; see `roll`.
      film: how light becomes a picture. OpenGL's eight bits end at six times the light of level soil, so that a darker
        exposure finds no more in what is burnt out.
      margin: how far the finely drawn ground reaches beyond `places`, m.
      largest: width and height of the largest picture to come, pixels.
      backends: of OpenGL; EGL or else OSMesa if None.

    Raises:
      UserError: no OpenGL works here.
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
        film: Film | None = None,
    ) -> None:
        self.camera, self.sun, self.film = camera or Pinhole(), sun or Sun(), film or Film()
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
        sizes = [largest, *((c.width, c.height) for c in (self.camera, _drawn(self.camera, MOST)))]
        self._size = max(s[0] for s in sizes), max(s[1] for s in sizes)
        self._offscreen = Offscreen(self.model, *self._size, backends)
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

    def front(self, random: np.random.Generator | None = None) -> Images:
        """What the front camera sees; see `take`."""
        return self.take(self.front_pose, self.camera, random=random)

    def take(
        self,
        pose: Pose,
        camera: Pinhole | None = None,
        dust: Grains | None = None,
        random: np.random.Generator | None = None,
    ) -> Images:
        """What a camera sees from anywhere.

        Args:
          pose, camera: where from, and by which optics. dust: grains in flight, which depth does not see.
          random: of the film's noise; no noise if None.
        """
        optics = camera or self.camera
        colours = self.picture(pose, optics, dust=dust, random=random)
        depth, geoms = self._offscreen.depth_and_geoms()
        rgba = np.concatenate([colours, np.full((*colours.shape[:2], 1), 255, np.uint8)], axis=-1)
        labels = self._labels[geoms]
        if optics.lens is not None:
            depth, labels = depth_and_labels(optics, _drawn(optics, self._size), depth, labels)
        return Images(rgba, depth, labels, pose.view_matrix(), optics.projection_matrix())

    def picture(
        self,
        pose: Pose,
        camera: Pinhole | None = None,
        post: Post | None = None,
        dust: Grains | None = None,
        random: np.random.Generator | None = None,
    ) -> np.ndarray:
        """The colours alone, (height, width, 3) uint8: half the work of `take`.

        Args:
          pose, camera: where from, and by which optics. post: a mark, if there is one. dust: grains in flight.
          random: of the film's noise; no noise if None.
        """
        optics = camera or self.camera
        drawn = _drawn(optics, self._size)
        at = self.data.xpos[self._chassis]
        # The shadows' light follows the rover: its shadow map covers some metres only.
        self._offscreen.look(self.data, pose, drawn, shadow_light(at, self.sun), post)
        flies = dust is not None and len(dust.position) > 0
        if drawn is optics and not flies and self.film.plain:
            return self._offscreen.colours()
        colours, depth = self._offscreen.colours_and_depth()
        light = _LIGHT[colours]
        if drawn is not optics:
            light = looked_up(optics, drawn, light)
            depth, _ = depth_and_labels(optics, drawn, depth, np.isfinite(depth))
        towards = self.sun.direction
        gain = float(Film().gain(Regolith(), towards[2]))
        if dust is not None and flies:
            lit = sunlit(self.model, self.data, dust.position, towards)
            light = veiled(light, depth, pose, optics, dust, lit, towards, gain)
        light = (light * (float(self.film.gain(Regolith(), towards[2])) / gain)).astype(np.float32)
        chance = None if random is None else random.standard_normal(light.shape, np.float32)
        return np.rint(255.0 * np.asarray(self.film.developed(light, optics.rays(), chance))).astype(np.uint8)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._offscreen.close()

    def __enter__(self) -> RoverCamera:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _drawn(camera: Pinhole, most: tuple[int, int]) -> Pinhole:
    """The optics that OpenGL draws: the camera's own, or wider ones to look up what its lens shows."""
    return camera if camera.lens is None else source(camera, most)


def _label(name: str) -> int:
    if name in (GROUND, FAR_GROUND):
        return 1
    return 2 if name.startswith(f"{ROCK}_") else 3
