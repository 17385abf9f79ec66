"""Frozen dataclasses as pytrees: arrays are leaves, fields marked `static()` are part of the tree's structure."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, TypeVar, dataclass_transform

import jax
import numpy as np

T = TypeVar("T")

AnyArray = jax.Array | np.ndarray
"""On the device or on the host: what pytrees hold that are made by hand, or fetched with `jax.device_get`."""


def static(**kwargs: Any) -> Any:
    """A dataclass field that is compile-time metadata: hashable, and never traced."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field, static))
def pytree(cls: type[T]) -> type[T]:
    """Makes `cls` a frozen dataclass that JAX transformations accept; change a field with `dataclasses.replace`."""
    frozen = dataclasses.dataclass(frozen=True)(cls)
    return jax.tree_util.register_dataclass(frozen)


def tree_of(cls: Callable[..., T], **leaves: Any) -> T:
    """A tree of class `cls` that holds no values but something about each: axes of `vmap`, how devices share it."""
    # JAX reads such trees where it reads values, so that one class serves both; the fields' types speak of values.
    return cls(**leaves)
