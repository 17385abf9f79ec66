"""A drive that is served."""

from __future__ import annotations

import threading
from collections.abc import Iterator

import pytest

from lunar_mjx.model import make_model
from lunar_mjx.viewer.drive import LiveDrive
from lunar_mjx.viewer.server import Viewer


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    served = Viewer(LiveDrive(make_model("luvmi_x", "lunar_plain"), "native"), port=0)
    thread = threading.Thread(target=served.run)
    thread.start()
    yield served
    served.shutdown()
    thread.join(timeout=10)
    assert not thread.is_alive()
