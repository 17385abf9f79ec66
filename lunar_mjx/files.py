"""Files that are whole or not there: written beside their place and renamed, so that a failure keeps the old one."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from lunar_mjx.errors import UserError


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Gives a path to write to, which takes the place of `path` when the block has ended well.

    It lies in the same folder and has the same suffix, from which libraries take the format. A block that fails, or a
    process that is killed, leaves `path` as it was.

    Raises:
      UserError: the operating system refuses: no such folder, no permission, disk full; or `path` is a folder by its
        name alone, such as / or nothing.
    """
    path = Path(path)
    if not path.name:
        raise UserError(f"{path}: is a folder and no file; name a file in it, as in {path / 'out'}.")
    part = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
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


def _refused(path: Path, error: OSError) -> UserError:
    return UserError(
        f"{path}: cannot be written ({error.strerror or error}); name a folder that exists, with room and permission "
        "to write."
    )


def write_text(path: str | Path, text: str) -> Path:
    """Writes UTF-8 text as a whole; returns the path.

    Raises:
      UserError: see `replacing`.
    """
    with replacing(path) as part:
        part.write_text(text, encoding="utf-8")
    return Path(path)
