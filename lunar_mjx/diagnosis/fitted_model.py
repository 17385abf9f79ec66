"""Puts fitted coordinates back into a model."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.model import Model


def fitted_model(
    coordinates: Sequence[Coordinate],
    u: np.ndarray,
    moved: Iterable[int],
    model: Model,
    held: Mapping[str, float] | None = None,
) -> Model:
    """A model with the fitted values of everything that moved.

    Args:
      coordinates: of the fit. u: (coordinates,) where it stands. moved: places of those that moved.
      model: with all effects. held: parameters that stay as they are in the model.
    """
    for i in moved:
        c = coordinates[i]
        if c.nuisance or c.effect not in model.effect_names or c.name in (held or {}):
            continue
        value = float(c.value(u[i]))
        old = model.parameters[c.effect][c.name]
        # A factor keeps the differences between wheels that the model holds; a plain value is one for all of them.
        if c.factor:
            new: Any = tuple(v * value for v in old) if isinstance(old, tuple) else float(old) * value
        else:
            new = tuple(value for _ in old) if isinstance(old, tuple) else value
        model = model.set(c.effect, "fit", **{c.name: new})
    return model
