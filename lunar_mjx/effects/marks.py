"""Marks on parts of a step, by which a batch on a GPU knows what it may compute as one kernel.

Marks are made only where a step is traced for them, inside `marking`. Everywhere else a part is called as it stands: a
jitted function in a step would be compiled by itself where the step is not, and round otherwise than its operations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import jax

BY_WHEEL = "by_wheel_"
"""How the names of marked functions begin; the number of wheels follows."""

_marks: ContextVar[bool] = ContextVar("marks", default=False)


@contextmanager
def marking() -> Iterator[None]:
    """Within it, `by_wheel` marks: for tracing a step whose parts become kernels."""
    token = _marks.set(True)
    try:
        yield
    finally:
        _marks.reset(token)


def by_wheel(function: Callable[[], Any], wheels: int) -> Any:
    """The result of a function without arguments that treats so many wheels alike, arrays over which end with them."""
    if not _marks.get():
        return function()

    def marked() -> Any:
        return function()

    # The name is all that a jaxpr keeps of a mark.
    marked.__name__ = marked.__qualname__ = f"{BY_WHEEL}{wheels}"
    return jax.jit(marked)()
