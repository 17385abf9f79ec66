"""MuJoCo's window on a screen that exists in memory only."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys

import pytest

from tests.cli_harness import MAIN

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb is installed: apt install xvfb"),
]


@pytest.fixture
def screen():
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "800x600x24"], pass_fds=(write,), stderr=subprocess.DEVNULL
    )
    os.close(write)
    with os.fdopen(read) as number:
        display = f":{number.readline().strip()}"
    yield {
        **{k: v for k, v in os.environ.items() if k != "MUJOCO_GL"},
        "DISPLAY": display,
        "LIBGL_ALWAYS_SOFTWARE": "1",
    }
    server.terminate()
    server.wait()


TELLS = """
from lunar_mjx.viewer.drive import LiveDrive
advance = LiveDrive.advance
def told(self, duration):
    driven = advance(self, duration)
    if self.time > 0.5:
        print("driving", flush=True)
        LiveDrive.advance = advance
    return driven
LiveDrive.advance = told
"""


def test_opens_drives_and_ends_with_control_c(screen):
    # a job in the background ignores the interrupt, and its children inherit that
    main = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n{TELLS}\n{MAIN}"
    command = [sys.executable, "-c", main, "view", "--rover", "luvmi_x", "--terrain", "flat"]
    process = subprocess.Popen(command, env=screen, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "driving\n", process.communicate()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    assert process.returncode == 0 and "Traceback" not in err
    assert "luvmi_x drove 0.0 m in" in out and "http" not in out  # a window, not the page
    assert float(out.split(" in ")[1].split()[0]) >= 0.5  # told to one decimal: 0.51 s is "0.5 s"
