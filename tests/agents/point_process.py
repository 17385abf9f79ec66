"""Starts `point_run.py` as one process or as two that train together, and reads what they print."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def command(*arguments: object, devices: int = 1) -> tuple[list[str], dict[str, str]]:
    """Command line and environment of a training on virtual devices."""
    flags = f"--xla_force_host_platform_device_count={devices} --xla_cpu_multi_thread_eigen=false"
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    line = [sys.executable, "-m", "tests.agents.point_run", *map(str, arguments)]
    return line, {**os.environ, "PYTHONPATH": path, "XLA_FLAGS": flags}


def result(out: str) -> dict:
    """Devices, digest of the parameters, and curve, from what a training printed."""
    return json.loads(out.splitlines()[-1])


def run(*arguments: object, devices: int = 1) -> dict:
    """Trains in one process; see `result`."""
    line, env = command(*arguments, devices=devices)
    done = subprocess.run(line, env=env, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return result(done.stdout)


def free_port() -> int:
    """A port of the loopback address that nobody listens on."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


def run_both(lines: Sequence[Sequence[str]], env: Mapping[str, str], begun: str) -> list[subprocess.CompletedProcess]:
    """Runs command lines side by side, each started when the one before has printed the line `begun`, until all end."""
    running: list[subprocess.Popen] = []
    try:
        for line in lines:
            process = subprocess.Popen(line, env=env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
            running.append(process)
            assert process.stdout is not None
            assert not begun or process.stdout.readline() == f"{begun}\n"
        outputs = [p.communicate() for p in running]
    finally:
        for process in running:
            process.kill()
            process.communicate()
    return [subprocess.CompletedProcess(p.args, p.returncode, *o) for p, o in zip(running, outputs, strict=True)]


def run_two(*arguments: object) -> list[subprocess.CompletedProcess]:
    """Trains in two processes of one device each, the second one started when the first has imported its libraries."""
    own = [
        command(*arguments, "--coordinator", f"127.0.0.1:{port}", "--processes", 2, "--process", i)
        for port in [free_port()]
        for i in (0, 1)
    ]
    return run_both([line for line, _ in own], own[0][1], "started")


def results_of_two(*arguments: object) -> list[dict]:
    """What two processes that both end well printed; see `run_two`."""
    done = run_two(*arguments)
    assert all(p.returncode == 0 for p in done), done[0].stderr[-2000:] + done[1].stderr[-2000:]
    return [result(p.stdout) for p in done]
