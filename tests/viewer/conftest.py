"""Drives that are served: one whose time a test tells, and one in real time."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from lunar_mjx.model import make_model
from lunar_mjx.viewer.drive import LiveDrive
from lunar_mjx.viewer.server import Viewer
from tests.viewer.viewer_client import Clock


@pytest.fixture(scope="module")
def clock() -> Clock:
    return Clock()


@pytest.fixture(scope="module")
def viewer(clock: Clock) -> Iterator[Viewer]:
    """Stands still until a test moves the clock and calls `viewer.pace.tick`."""
    served = Viewer(LiveDrive(make_model("luvmi_x", "lunar_plain"), "native"), port=0, clock=clock)
    served.repeat = None  # or a page would get one picture twice where the machine is slow
    thread = threading.Thread(target=served.serve_forever, kwargs={"poll_interval": 0.1})
    thread.start()
    yield served
    served.shutdown()
    served.close()
    thread.join()


@pytest.fixture(scope="module")
def live_viewer() -> Iterator[Viewer]:
    """Drives in real time."""
    served = Viewer(LiveDrive(make_model("luvmi_x", "lunar_plain"), "native"), port=0)
    thread = threading.Thread(target=served.run)
    thread.start()
    yield served
    served.shutdown()
    thread.join()
