"""OpenGL without a window: EGL or OSMesa, whichever is there, and MuJoCo's renderer on it."""

from __future__ import annotations

import atexit
import dataclasses
import importlib
import os
import warnings
import weakref
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.pinhole import Pinhole, Pose
from lunar_mjx.errors import UserError

BACKENDS = ("egl", "osmesa")
OFF = ("disable", "disabled", "off", "false", "0")

_DULL = 0.1
"""Share of a mark's colour that the Sun adds to; the mark shines with the rest."""
_chosen: dict[tuple[str, ...], Any] = {}


def wanted_backends() -> tuple[str, ...]:
    """What the environment variable MUJOCO_GL asks for, else EGL before OSMesa.

    Raises:
      UserError: it turns OpenGL off.
    """
    environment = os.environ.get("MUJOCO_GL", "").lower().strip()
    if environment in OFF:
        raise UserError(f"cameras: MUJOCO_GL={environment} turns OpenGL off; unset it, or set it to egl or osmesa.")
    return (environment,) if environment in BACKENDS else BACKENDS


def context_class(backends: Sequence[str] | None = None) -> Any:
    """The class of OpenGL contexts of the first backend that works here.

    Args:
      backends: some of `BACKENDS` in order of preference; `wanted_backends()` if None.

    Raises:
      UserError: none works.
    """
    names = tuple(backends) if backends is not None else wanted_backends()
    # Tried once: a failing backend takes seconds.
    if names not in _chosen:
        _chosen[names] = _first(names)
    return _chosen[names]


def _first(names: tuple[str, ...]) -> Any:
    kept = os.environ.get("PYOPENGL_PLATFORM")
    for name in names:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of OpenGL libraries that find no device
                context_class = importlib.import_module(f"mujoco.{name}").GLContext
                # Imported is not working: only a context that is made shows it.
                context = context_class(64, 64)
                context.make_current()
                context.free()
        except Exception:
            # the module that failed has set this, and the next one would refuse to load
            if kept is None:
                os.environ.pop("PYOPENGL_PLATFORM", None)
            continue
        return context_class
    raise UserError(
        f"cameras: no OpenGL works here (tried {', '.join(names)}); install EGL (Debian and Ubuntu: apt install "
        "libegl1 libgl1-mesa-dri) or OSMesa (apt install libosmesa6)."
    )


@dataclasses.dataclass(frozen=True)
class Post:
    """A mark in a picture: foot and top (3,) m, radius m, colour red, green and blue of 255."""

    foot: np.ndarray
    top: np.ndarray
    radius: float
    colour: tuple[int, int, int]


class Offscreen:
    """MuJoCo's renderer in memory: colours, and in a second pass depth and what each pixel shows.

    Args:
      model: the scene. width, height: largest picture, pixels. backends: see `context_class`.

    Raises:
      UserError: no OpenGL works here.
    """

    def __init__(self, model: Any, width: int, height: int, backends: Sequence[str] | None = None) -> None:
        made = context_class(backends)
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        self._model = model
        self._scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 1000)
        self._option = mujoco.MjvOption()
        self._context = made(width, height)
        self._context.make_current()
        self._mjr: Any = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._mjr)
        # Freed with the object even if nobody calls close: contexts are few on some drivers.
        self._free = weakref.finalize(self, _free, self._mjr, self._context)
        # At the end of Python, too, and before EGL is ended: what is registered last is called first.
        self._free.atexit = False
        atexit.register(self._free)
        # The reversed buffer keeps digits far away, where the usual one has none.
        self._mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR

    def look(
        self, data: Any, pose: Pose, camera: Pinhole, sun: np.ndarray | None = None, post: Post | None = None
    ) -> None:
        """Places the camera; `sun` is where the shadows' light stands, (3,) m, and `post` stands in this picture."""
        free = mujoco.MjvCamera()
        mujoco.mjv_updateScene(
            self._model, data, self._option, None, free, mujoco.mjtCatBit.mjCAT_ALL.value, self._scene
        )
        tall = camera.near * np.tan(0.5 * np.radians(camera.fovy_deg))
        for eye in self._scene.camera:
            eye.pos, eye.forward, eye.up = pose.position, -pose.rotation[:, 2], pose.rotation[:, 1]
            eye.frustum_near, eye.frustum_far = camera.near, camera.far
            eye.frustum_bottom, eye.frustum_top, eye.frustum_center = -tall, tall, 0.0
            eye.frustum_width = tall * camera.width / camera.height
        if sun is not None and self._scene.nlight:
            for light in self._scene.lights[: self._scene.nlight]:
                if not light.headlight:
                    light.pos = sun
        if post is not None:
            self._set_up(post)
        self._size = camera.width, camera.height
        self._camera = camera

    def _set_up(self, post: Post) -> None:
        geom = self._scene.geoms[self._scene.ngeom]
        colour = np.array([*(_DULL * c for c in post.colour), 255], np.float32) / 255.0
        capsule = mujoco.mjtGeom.mjGEOM_CAPSULE.value
        mujoco.mjv_initGeom(geom, capsule, np.zeros(3), np.zeros(3), np.eye(3).ravel(), colour)
        mujoco.mjv_connector(geom, capsule, post.radius, np.asarray(post.foot, float), np.asarray(post.top, float))
        # It shines by itself, since it is a mark and no thing: the Sun would wash its colour out.
        geom.emission, geom.specular = 0.9 / _DULL, 0.0
        self._scene.ngeom += 1

    def colours(self) -> np.ndarray:
        """The picture, (height, width, 3) uint8."""
        out = np.empty((self._size[1], self._size[0], 3), np.uint8)
        self._render(out, None)
        # OpenGL's rows begin at the bottom.
        return out[::-1].copy()

    def colours_and_depth(self) -> tuple[np.ndarray, np.ndarray]:
        """The picture, (height, width, 3) uint8, and its depth, m (infinite where nothing is), of one pass."""
        shape = (self._size[1], self._size[0])
        colour, buffer = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
        self._render(colour, buffer)
        return colour[::-1].copy(), self._metres(buffer)[::-1]

    def depth_and_geoms(self) -> tuple[np.ndarray, np.ndarray]:
        """Depth, m (infinite where nothing is), and the geom that each pixel shows (-1 for none), (height, width)."""
        # The scene is shared with the pass for colours, which must not see the flags of this one.
        flags = self._scene.flags.copy()
        self._scene.flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = True
        self._scene.flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = True
        shape = (self._size[1], self._size[0])
        colour, buffer = np.empty((*shape, 3), np.uint8), np.empty(shape, np.float32)
        self._render(colour, buffer)
        np.copyto(self._scene.flags, flags)
        # The renderer writes each segment's number into the three bytes of a pixel's colour.
        number = colour.astype(np.int64) @ np.array([1, 256, 65536])
        geoms = np.full(self._scene.ngeom + 1, -1, np.int32)
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                geoms[geom.segid + 1] = geom.objid
        return self._metres(buffer)[::-1].astype(np.float32), geoms[number[::-1]]

    def _metres(self, buffer: np.ndarray) -> np.ndarray:
        near, far = self._camera.near, self._camera.far
        with np.errstate(divide="ignore"):
            # the buffer runs from 1 at the near plane to 0 at the far one, in inverse distance
            depth = near * far / (near + buffer.astype(float) * (far - near))
        depth[buffer <= 0.0] = np.inf
        return depth

    def upload(self, texture: int) -> None:
        """Sends a texture of the model anew."""
        self._context.make_current()
        mujoco.mjr_uploadTexture(self._model, self._mjr, texture)

    def _render(self, colour: np.ndarray, depth: np.ndarray | None) -> None:
        if self._mjr is None:
            raise UserError("cameras: the renderer was closed; make a new one.")
        self._context.make_current()
        rectangle = mujoco.MjrRect(0, 0, *self._size)
        mujoco.mjr_render(rectangle, self._scene, self._mjr)
        mujoco.mjr_readPixels(colour, depth, rectangle, self._mjr)

    def close(self) -> None:
        """Frees the context."""
        self._free()
        atexit.unregister(self._free)
        self._mjr = None


def _free(renderer: Any, context: Any) -> None:
    renderer.free()
    context.free()
