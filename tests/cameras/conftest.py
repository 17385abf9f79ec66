"""One small scene with OpenGL for all tests, skipped where there is none."""

from __future__ import annotations

import numpy as np
import pytest
from camera_scene import EYE, bumpy

from lunar_mjx.cameras import RoverCamera, Sun
from lunar_mjx.cameras.gl import BACKENDS, context_class
from lunar_mjx.errors import UserError
from lunar_mjx.rover import load_rover


@pytest.fixture(scope="session")
def opengl() -> tuple[str, ...]:
    try:
        context_class(BACKENDS)
    except UserError as missing:
        pytest.skip(str(missing))
    return BACKENDS


@pytest.fixture(scope="session")
def scene(opengl: tuple[str, ...]):
    """A LUVMI-X that looks along x, its chassis level at (-1, 0, 0.3)."""
    rover = load_rover("luvmi_x")
    with RoverCamera(
        rover, bumpy(), np.zeros((1, 2)), EYE, sun=Sun(90.0, 30.0), largest=(160, 120), backends=opengl
    ) as camera:
        qpos = camera.model.qpos0.copy()
        qpos[:3] = -1.0, 0.0, 0.3
        camera.place(qpos)
        yield camera, qpos
