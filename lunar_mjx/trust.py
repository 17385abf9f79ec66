"""Python code that a received file names runs only if the user says so.

A `model.toml`, a run folder and a `policy.npz` may name Python files: effects, environments. Whoever sends such a
file could so run code on the receiver's machine. A file that the user names himself, on the command line or in a call,
is his own word.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from lunar_mjx.errors import bad_input

_TRUSTING: ContextVar[bool] = ContextVar("trusting", default=False)
_VOUCHED: set[Path] = set()
"""Files that the user has named in this process."""


def file_of(spec: str) -> Path | None:
    """The Python file that `file.py:name` names, or None for a name of something shipped."""
    return Path(spec.partition(":")[0]) if ".py" in spec else None


def vouch(spec: str) -> None:
    """Notes that the user himself has named a Python file, as `file.py:name`."""
    if (file := file_of(spec)) is not None:
        _VOUCHED.add(file.resolve())


@contextmanager
def trusting(trust: bool = True) -> Iterator[None]:
    """Within it, code that files name is run: for files whose author is known."""
    token = _TRUSTING.set(trust)
    try:
        yield
    finally:
        _TRUSTING.reset(token)


def require_trust(source: str | Path, field: str, spec: str) -> None:
    """Refuses code that a file names, unless the user trusts it.

    Args:
      source: the file that names it. field: where in it. spec: as `file.py:name`; other names pass.

    Raises:
      UserError: it would run, and the user has neither named it himself nor said that he trusts it.
    """
    file = file_of(spec)
    if file is None or not file.exists() or _TRUSTING.get() or file.resolve() in _VOUCHED:
        return
    raise bad_input(
        source,
        field,
        spec,
        "is Python code that would run on this machine",
        f"read {file}, and if you know whose it is add --trust (in Python: with lunar_mjx.trust.trusting())",
    )
