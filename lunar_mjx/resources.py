"""Where the rovers, terrains and trainings that ship lie, in a checkout and in an installed wheel alike."""

from __future__ import annotations

from pathlib import Path

from lunar_mjx.errors import UserError, one_line

_PACKAGE = Path(__file__).resolve().parent


def shipped(kind: str) -> Path:
    """Returns the folder of shipped `models`, `terrain` or `train`.

    Raises:
      UserError: the installation lacks the folder.
    """
    for root in (_PACKAGE / "_data" / kind, _PACKAGE.parent / kind):
        if root.is_dir():
            return root
    raise UserError(f"{_PACKAGE}: the folder '{kind}' that ships with lunar-mjx is missing; reinstall the package.")


def find(kind: str, name: str | Path, marker: str) -> Path:
    """Returns the folder called `name` among the shipped `kind`, or the folder at the path `name`.

    Args:
      kind: "models" or "terrain".
      name: name of a shipped folder, or the path of one.
      marker: file that the folder must hold.

    Raises:
      UserError: no such folder; the sentence lists the shipped names.
    """
    named = isinstance(name, str | Path)
    for folder in (Path(name), shipped(kind) / str(name)) if named else ():
        try:
            if (folder / marker).is_file():
                return folder
        except OSError:  # longer than a file system keeps names
            continue
    known = ", ".join(sorted(p.parent.name for p in shipped(kind).glob(f"*/{marker}")))
    raise UserError(
        f"{one_line(name)[:200]}: no folder of that path or name holds {marker}; "
        f"shipped with the package: {known or 'none'}."
    )
