"""Runs the command, and kills it just before it touches a file in a folder for the N-th time, or in the midst of one.

    python -m tests.killed_run FOLDER N ARGUMENTS...
    python -m tests.killed_run FOLDER SIZEb ARGUMENTS...

With N = 0 it runs to its end and prints, last, how often it touched one. With a size in bytes it dies where a file, of
those that are opened to be written from the first one in the folder on, would grow beyond it.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

FILE_EVENTS = {"open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.truncate"}
"""What Python's audit hooks call the opening, making, renaming, removing and cutting of a file."""


def die() -> None:
    """Sends SIGKILL to this process."""
    os.kill(os.getpid(), signal.SIGKILL)


def die_at_file(folder: Path, count: int) -> Callable[[], int]:
    """Kills this process just before the `count`-th touch of a file in a folder; never if 0.

    Returns:
      A function that says how many there were so far.
    """
    seen = 0

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal seen
        if event not in FILE_EVENTS or isinstance(arguments[0], int):
            return
        if Path(os.path.abspath(os.fsdecode(arguments[0]))).is_relative_to(folder):
            seen += 1
            if seen == count:
                die()

    sys.addaudithook(hook)
    return lambda: seen


def die_at_size(folder: Path, size: int) -> None:
    """Lets the kernel kill this process where a file grows beyond `size` bytes, once one in a folder is written to."""
    limited = False

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        nonlocal limited
        if limited or event != "open" or isinstance(arguments[0], int) or not arguments[2] & (os.O_WRONLY | os.O_RDWR):
            return
        if Path(os.path.abspath(os.fsdecode(arguments[0]))).is_relative_to(folder):
            limited = True
            # Python ignores this signal, and tells a full disk instead
            signal.signal(signal.SIGXFSZ, signal.SIG_DFL)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    sys.addaudithook(hook)


def main() -> None:
    """See the module's docstring."""
    folder, at = Path(sys.argv[1]).resolve(), sys.argv[2]
    touched = die_at_file(folder, 0 if at.endswith("b") else int(at))
    if at.endswith("b"):
        die_at_size(folder, int(at[:-1]))
    sys.argv = ["lunar-mjx", *sys.argv[3:]]
    from lunar_mjx.cli import main as command

    status = 0
    try:
        command()
    except SystemExit as end:
        status = int(end.code or 0)
    print(touched(), flush=True)
    sys.exit(status)


if __name__ == "__main__":
    main()
