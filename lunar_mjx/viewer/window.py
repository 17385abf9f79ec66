"""The drive in MuJoCo's own window."""

from __future__ import annotations

import dataclasses
import math
import os
import sys
import threading
import time
import warnings
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.dust.veil import sunlit
from lunar_mjx.cameras.scene import Sun, build_scene, shadow_light
from lunar_mjx.cameras.texture import ALBEDO
from lunar_mjx.errors import UserError
from lunar_mjx.viewer.drive import PACE, LiveDrive, Pace

_KEYS = {265: "forward", 264: "back", 263: "left", 262: "right", 32: "brake"}
"""GLFW's codes of the arrow keys and space."""


@dataclasses.dataclass(frozen=True)
class ViewSettings:
    """The window of MuJoCo's viewer."""

    reset_key: int = 259
    """Backspace, with which MuJoCo's viewer resets too."""
    margin: float = 25.0
    """How far the ground is drawn finely around the start, m."""
    ball: float = 1.5
    """Radius of the ball that stands for a grain, over the spread of what it stands for."""
    shade: float = 0.1
    """Brightness of grains in shadow, over that of those in the Sun."""


WINDOW = ViewSettings()


def has_screen() -> bool:
    """Whether a window with OpenGL opens here: tried out, because MuJoCo's viewer would wait for ever if not."""
    if sys.platform == "darwin":  # where the window needs MuJoCo's own launcher
        import mujoco.viewer

        return getattr(mujoco.viewer, "_MJPYTHON", None) is not None
    if sys.platform != "win32" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of glfw, which warns of what it returns
        import glfw

        if not glfw.init():
            return False
        glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
        window = glfw.create_window(64, 64, "lunar-mjx", None, None)
        glfw.default_window_hints()
        if window:
            glfw.destroy_window(window)
        return bool(window)


def show_window(drive: LiveDrive, sun: Sun) -> None:
    """Drives in a window until it is closed, or Control-C.

    Each press of an arrow key asks for a notch more speed or steering, space for none, and backspace puts the rover
    back: MuJoCo's window hears presses only, and its letters are taken.

    Raises:
      UserError: the window cannot be opened.
    """
    import jax
    import mujoco.viewer

    terrain = jax.device_get(drive.model.terrain)
    model, _ = build_scene(drive.model.rover, terrain, drive.qpos[None, :2], sun, margin=WINDOW.margin)
    data = mujoco.MjData(model)
    pace = Pace(drive, lambda: None)

    def press(code: int) -> None:
        with pace.lock:
            if code == WINDOW.reset_key:
                drive.reset()
            elif code in _KEYS:
                drive.pilot.press(_KEYS[code])

    data.qpos[:] = drive.qpos
    mujoco.mj_forward(model, data)
    # MuJoCo keeps its thread to itself; it is told from the others by having come later.
    before = set(threading.enumerate())
    try:
        window = mujoco.viewer.launch_passive(model, data, key_callback=press, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:  # macOS without mjpython
        raise UserError(f"view: the window does not open ({error}); add --web for a web page.") from None
    with window:
        _look(window, model, drive)
        pace.start()
        try:
            _show(window, model, data, drive, pace, sun)
        except KeyboardInterrupt:
            pass
        finally:
            pace.stop()
    # the window's thread must end before the interpreter does
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=5.0)
    if pace.failure is not None:
        raise pace.failure


def _look(window: Any, model: mujoco.MjModel, drive: LiveDrive) -> None:
    """Follows the chassis from behind and aside."""
    rover = drive.model.rover
    with window.lock():
        window.cam.type = mujoco.mjtCamera.mjCAMERA_TRACKING
        window.cam.trackbodyid = model.body(rover.chassis).id
        window.cam.distance = 4.0 * float(np.abs(rover.chassis_points).max()) + 1.0
        # From behind and aside, so that wheels of both sides and the ground ahead are seen.
        window.cam.azimuth, window.cam.elevation = 35.0, -18.0
        window.opt.flags[mujoco.mjtVisFlag.mjVIS_CAMERA] = False


def _show(window: Any, model: mujoco.MjModel, data: mujoco.MjData, drive: LiveDrive, pace: Pace, sun: Sun) -> None:
    font, corner = mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtGridPos.mjGRID_TOPLEFT
    while window.is_running() and pace.failure is None:
        begin = time.monotonic()
        with pace.lock:
            qpos, (names, values), dust = drive.qpos, captions(drive), drive.dust()
        with window.lock():
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            data.light_xpos[0] = shadow_light(qpos[:3], sun)  # shadows are drawn around the light
            _add_dust(window.user_scn, dust, sunlit(model, data, dust.position, sun.direction))
        window.set_texts((font, corner, names, values))
        window.sync()
        time.sleep(max(0.0, PACE.tick - (time.monotonic() - begin)))


def _add_dust(scene: Any, grains: Grains, lit: np.ndarray) -> None:
    """Fills the window's own scene with grains in flight, as balls that let light through; `lit` is (grain,)."""
    count = min(len(grains.position), scene.maxgeom)
    ball, turn = mujoco.mjtGeom.mjGEOM_SPHERE.value, np.eye(3).ravel()
    for geom, place, spread, area, shines in zip(
        scene.geoms[:count], grains.position, grains.spread, grains.area, lit, strict=False
    ):
        # As much light is taken as by the grain's cross-section, spread over the ball's.
        radius = WINDOW.ball * spread
        opaque = 1.0 - math.exp(-area / (math.pi * radius**2))
        colour = np.array([*(ALBEDO * (1.0 if shines else WINDOW.shade)), opaque], np.float32)
        mujoco.mjv_initGeom(geom, ball, np.full(3, radius), place, turn, colour)
    scene.ngeom = count


def captions(drive: LiveDrive) -> tuple[str, str]:
    """Names and values of the readings, line by line."""
    readings = drive.readings()
    rows = [
        (
            "arrows, space, backspace",
            f"asked {readings['asked_m_s']:.2f} m/s, steering {100 * readings['asked_turn']:.0f} %",
        ),
        ("speed", f"{readings['speed_m_s']:.2f} m/s"),
        ("driven", f"{readings['path_m']:.1f} m in {readings['time_s']:.0f} s"),
        ("nose up, left side up", f"{-readings['pitch_deg']:.1f}, {readings['roll_deg']:.1f} deg"),
        ("power", f"{readings['power_W']:.0f} W"),
        ("hottest winding", f"{readings['hottest']} {readings['hottest_degC']:.1f} degC"),
    ]
    for wheel, slip, sinkage in zip(drive.model.rover.wheels, readings["slip"], readings["sinkage_mm"], strict=True):
        shown = "at rest" if slip is None else f"{slip:5.2f}"
        rows.append((f"{wheel.corner} slip, sinkage", f"{shown}, {sinkage:.1f} mm"))
    if readings["note"]:
        rows.append(("", readings["note"]))
    return "\n".join(name for name, _ in rows), "\n".join(value for _, value in rows)
