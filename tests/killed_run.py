"""Runs the command, and kills it just before it touches a file in a folder for the N-th time.

    python -m tests.killed_run FOLDER N ARGUMENTS...

With N = 0 it runs to its end and prints, last, how often it touched one.
"""

from __future__ import annotations

import os
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


def main() -> None:
    """See the module's docstring."""
    touched = die_at_file(Path(sys.argv[1]).resolve(), int(sys.argv[2]))
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
