"""Files that are whole or not there: written beside their place and renamed, so that a failure keeps the old one."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from lunar_mjx.errors import UserError

_FULL = (errno.ENOSPC, errno.EDQUOT)
"""What the operating system says of a full disk: another folder would often be no remedy, such as for a run."""


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Gives a path to write to, which takes the place of `path` when the block has ended well.

    It lies in the same folder and has the same suffix, from which libraries take the format. A block that fails, or a
    process that is killed, leaves `path` as it was. A link stays one: the file that it leads to is replaced.

    Raises:
      UserError: the operating system refuses: no such folder, no permission, disk full; `path` is a folder by its name
        alone, such as / or nothing; or there is something else than a file, such as a device.
    """
    path = Path(path)
    if not path.name:
        raise UserError(f"{path}: is a folder and no file; name a file in it, as in {path / 'out'}.")
    try:
        path = _place(path)
        part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
        try:
            yield part
            with part.open("rb+") as file:
                os.fsync(file.fileno())  # else a power cut may leave the new name with old or no contents
            part.replace(path)
        finally:
            with suppress(OSError):
                part.unlink(missing_ok=True)
    except OSError as error:
        raise _refused(path, error) from error


def _place(path: Path) -> Path:
    """Where a file lies that `path` names; links are followed."""
    if path.is_symlink():
        with suppress(RuntimeError):  # of links in a circle, before Python 3.13
            path = path.resolve()
        if path.is_symlink():
            raise UserError(f"{path}: is a link that leads to itself; name a file.")
    try:
        kind = path.stat().st_mode
    except OSError:  # nothing is there, or it is told when it is written
        return path
    if not (stat.S_ISREG(kind) or stat.S_ISDIR(kind)):
        # To be renamed over would end a device (/dev/null) or a pipe for all other processes.
        raise UserError(f"{path}: is a device, a pipe or a socket and no file; name a file.")
    return path


@contextmanager
def appending(path: str | Path) -> Iterator[Path]:
    """Gives `path` back to append to; cuts off what a block that fails has appended.

    Raises:
      UserError: see `replacing`.
    """
    path = Path(path)
    try:
        size = path.stat().st_size if path.exists() else 0
        try:
            yield path
        except OSError:
            os.truncate(path, size)
            raise
    except OSError as error:
        raise _refused(path, error) from error


def only_writer(folder: Path, name: str, what: str) -> IO[str]:
    """An open file that keeps others out of a folder until it is closed or its process ends.

    Args:
      folder: which is made. name: of the file, which stays. what: writes there, for the sentence that refuses a second.

    Raises:
      UserError: another one writes there, or the operating system refuses.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        file = (folder / name).open("a+", encoding="utf-8")
    except OSError as error:
        raise _refused(folder / name, error) from error
    try:
        import fcntl

        # A lock of the open file: it falls with the process, where a file that is merely there would stay.
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:  # Windows refuses to rename over open files instead
        pass
    except OSError:
        file.close()
        raise UserError(
            f"{folder}: another {what} writes there; wait for it, end it, or name another folder."
        ) from None
    return file


def _refused(path: Path, error: OSError) -> UserError:
    if error.errno in _FULL:
        return UserError(f"{path}: cannot be written ({error.strerror or error}); make room there and run it again.")
    return UserError(
        f"{path}: cannot be written ({error.strerror or error}); name a folder that exists, with room and permission "
        "to write."
    )


def no_key_twice(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON as a dict; for `object_pairs_hook` of `json.loads`, which else keeps the last of two alike.

    Raises:
      ValueError: a key stands there twice.
    """
    found: dict[str, Any] = {}
    for key, value in pairs:
        if key in found:
            raise ValueError(f"the key {key[:60]!r} stands there twice")
        found[key] = value
    return found


def write_text(path: str | Path, text: str) -> Path:
    """Writes UTF-8 text as a whole; returns the path.

    Raises:
      UserError: see `replacing`.
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)
