"""Puts fitted coordinates back into a model, and how far the measurements leave them open."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.model import Model
from lunar_mjx.model.posterior import Posterior

TOLD = 0.99
"""Posterior over prior standard deviation from which measurements say nothing of a parameter; rounding and weak ties to
others leave it a little below one."""


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
        value = c.value_within(u[i])
        old = model.parameters[c.effect][c.name]
        low, high = next(e for e in model.effects if e.name == c.effect).parameters[c.name].bounds
        # A factor keeps the differences between wheels that the model holds; a plain value is one for all of them.
        # At a bound rounding may lie beyond it, of the factor and again of what it multiplies.
        each = [min(max(float(v) * value if c.factor else value, low), high) for v in np.atleast_1d(old)]
        new: Any = tuple(each) if isinstance(old, tuple) else each[0]
        model = model.set(c.effect, "fit", **{c.name: new})
    return model


def posterior_of(
    coordinates: Sequence[Coordinate],
    covariance: np.ndarray,
    prior: np.ndarray,
    places: Sequence[int] | np.ndarray,
    model: Model,
    names: Mapping[int, str] | None = None,
) -> Posterior | None:
    """How far a fit leaves the parameters of a model open; None if it told of none of them.

    Parameters that are as open as before the fit are left out: some of their priors only say that nothing is known.

    Args:
      coordinates: of the fit. covariance: (k, k) of the coordinates at `places` (k,); places beyond them are skipped.
      prior: (k,) standard deviation of these coordinates before the fit.
      model: whose parameters they are; instruments and initial poses are none of them.
      names: `effect.parameter` by place, where a coordinate's own name is another.
    """
    rows: dict[str, np.ndarray] = {}
    log: dict[str, bool] = {}
    for k, i in enumerate(places):
        if i >= len(coordinates) or coordinates[i].nuisance:
            continue
        c = coordinates[i]
        name = (names or {}).get(int(i), f"{c.effect}.{c.name}")
        effect, _, parameter = name.partition(".")
        if parameter in model.parameters.get(effect, {}):
            # Coordinates of one parameter add up: the steps of an effect beyond what is usual, say.
            row = rows.setdefault(name, np.zeros(len(places)))
            row[k] = c.scale
            log[name] = c.log
    if not rows:
        return None
    to_values = np.array(list(rows.values()))
    spread, before = to_values @ covariance @ to_values.T, to_values**2 @ np.asarray(prior) ** 2
    told = np.flatnonzero(np.diag(spread) < TOLD**2 * before)
    named = [list(rows)[k] for k in told]
    return Posterior.of(named, [log[n] for n in named], spread[np.ix_(told, told)]) if named else None
