"""MuJoCo's window on a screen that exists in memory only."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time

import pytest

from tests.cli_harness import MAIN

pytestmark = [pytest.mark.slow, pytest.mark.skipif(shutil.which("Xvfb") is None, reason="no Xvfb is installed")]


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
    server.wait(timeout=10)


def test_opens_drives_and_ends_with_control_c(screen):
    # a job in the background ignores the interrupt, and its children inherit that
    main = f"import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {MAIN}"
    command = [sys.executable, "-c", main, "view", "--rover", "luvmi_x", "--terrain", "flat"]
    process = subprocess.Popen(command, env=screen, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    time.sleep(12.0)
    assert process.poll() is None, process.communicate()
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=30)
    assert process.returncode == 0 and "Traceback" not in err
    assert "luvmi_x drove 0.0 m in" in out and "http" not in out  # a window, not the page
    assert float(out.split(" in ")[1].split()[0]) > 0.5
