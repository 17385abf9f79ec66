"""Bounds of the procedural parameters, refused by name."""

from __future__ import annotations

from typing import Any

from lunar_mjx.errors import bad_input, require_finite


def require_between(owner: Any, field: str, low: float, high: float, remedy: str) -> None:
    """Raises `UserError` unless low < owner.field < high; the bounds themselves are out."""
    _require(owner, field, remedy, f"is not between {low:g} and {high:g}", lambda value: low < value < high)


def require_at_least(owner: Any, field: str, low: float, remedy: str) -> None:
    """Raises `UserError` unless owner.field >= low."""
    _require(owner, field, remedy, f"is below {low:g}", lambda value: value >= low)


def require_positive(owner: Any, field: str, remedy: str) -> None:
    """Raises `UserError` unless owner.field > 0."""
    _require(owner, field, remedy, "is not positive", lambda value: value > 0)


def _require(owner: Any, field: str, remedy: str, problem: str, good: Any) -> None:
    name = type(owner).__name__
    if not good(require_finite(name, field, getattr(owner, field))):
        raise bad_input(name, field, getattr(owner, field), problem, remedy)
