"""Puts fitted coordinates back into a model."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from lunar_mjx.model import Model

if TYPE_CHECKING:
    from lunar_mjx.inference.fitting import Fit
    from lunar_mjx.inference.problem import Problem


def fitted_model(problem: Problem, fitted: Fit, model: Model, held: Mapping[str, float] | None = None) -> Model:
    """A model with the fitted values of everything that moved."""
    for i in fitted.free:
        c = problem.coordinates[i]
        if c.nuisance or c.effect not in model.effect_names or c.name in (held or {}):
            continue
        value = float(c.value(fitted.u[i]))
        old = model.parameters[c.effect][c.name]
        if c.factor:
            new: Any = tuple(v * value for v in old) if isinstance(old, tuple) else float(old) * value
        else:
            new = tuple(value for _ in old) if isinstance(old, tuple) else value
        model = model.set(c.effect, "fit", **{c.name: new})
    return model
