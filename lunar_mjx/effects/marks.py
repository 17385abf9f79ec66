"""Marks on parts of a step, by which a batch on a GPU knows what it may compute as one kernel.

A marked part is an ordinary jitted function: elsewhere, and where no kernel can be made of it, nothing changes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax

BY_WHEEL = "by_wheel_"
"""How the names of marked functions begin; the number of wheels follows."""


def by_wheel(function: Callable[[], Any], wheels: int) -> Any:
    """The result of a function without arguments that treats so many wheels alike, arrays over which end with them."""

    def marked() -> Any:
        return function()

    # The name is all that a jaxpr keeps of a mark.
    marked.__name__ = marked.__qualname__ = f"{BY_WHEEL}{wheels}"
    return jax.jit(marked)()
