"""Which commit a benchmark measured, also on a machine that holds a copy without git's history."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

VARIABLE = "LUNAR_MJX_COMMIT"
"""Of the environment: the commit of a copy without history, with "+" where its files differ from it."""
ROOT = Path(__file__).resolve().parents[1]
COUNTED = ("lunar_mjx", "models", "terrain", "train", ":(glob)benchmarks/**/*.py", ":(glob)benchmarks/**/*.toml")
"""What a measurement depends on; records and pages are written by it."""


def _git(*words: str) -> str:
    """What git says, without the space around it.

    Raises:
      OSError: there is no git. subprocess.CalledProcessError: there is no history, or git fails.
    """
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()


def checkout() -> tuple[str, bool]:
    """The commit, and whether files that count differ from it.

    `LUNAR_MJX_COMMIT` goes before what git says; ("", False) where neither tells.
    """
    if told := os.environ.get(VARIABLE):
        return told.removesuffix("+"), told.endswith("+")
    try:
        return _git("rev-parse", "HEAD"), bool(_git("status", "--porcelain", "--", *COUNTED))
    except (OSError, subprocess.CalledProcessError):
        return "", False


def commit() -> str:
    """The commit's first seven digits, with "+" where files that count differ from it; "unknown" if nothing tells."""
    head, changed = checkout()
    return (head[:7] or "unknown") + "+" * changed


def tree() -> str:
    """Git's hash of the package as it lies there, "" without git.

    `git rev-parse COMMIT:lunar_mjx` gives it where nothing differs, so that a copy is known whose commit is not.
    """
    with tempfile.TemporaryDirectory() as folder:
        at = (f"--git-dir={folder}/git", f"--work-tree={ROOT}")
        try:
            _git("init", "--quiet", "--bare", f"{folder}/git")
            _git(*at, "add", "lunar_mjx")
            return _git(*at, "write-tree", "--prefix=lunar_mjx/")
        except (OSError, subprocess.CalledProcessError):
            return ""
