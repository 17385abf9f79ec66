"""Recordings of a real rover that ship with the package: a Husky on a hard floor and on sandy loam (CC0)."""

from __future__ import annotations

import shutil
from pathlib import Path

from lunar_mjx.files import replacing
from lunar_mjx.logs.write import new_folder

RECORDINGS = Path(__file__).resolve().parent
"""Folder of the recordings, which the map `husky_borealtc` reads, with their licence."""


def copy_example(folder: str | Path) -> Path:
    """Copies the recordings and their licence to a folder, as a logger would have left them there.

    Args:
      folder: must not exist, or be empty.

    Raises:
      UserError: the folder holds anything.
    """
    folder = Path(folder)
    new_folder(folder)
    for file in (*sorted(RECORDINGS.glob("*.csv")), RECORDINGS / "LICENSE"):
        with replacing(folder / file.name) as part:
            shutil.copyfile(file, part)
    return folder
