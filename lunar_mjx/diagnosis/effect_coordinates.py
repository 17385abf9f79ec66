"""Coordinates of an effect's parameters: of candidates from their null, of the model's own from where it stands."""

from __future__ import annotations

import math
from collections.abc import Mapping

from lunar_mjx.effects.base import Effect, Parameter
from lunar_mjx.inference.coordinates import Coordinate


def of_candidate(effect: Effect, values: Mapping[str, float] | None = None) -> tuple[Coordinate, ...]:
    """Coordinates of an effect that is not in the model yet, from its null.

    Parameters with a null are amplitudes: they start there, on the scale of the nominal value, and only the data and
    the bounds hold them. Parameters without one are shapes: they start at the nominal value and keep a prior of a
    third of it, because they mean nothing while the amplitudes are zero.
    """
    coordinates = []
    for name, p in effect.parameters.items():
        start = (values or {}).get(name)
        if p.null is not None:
            coordinates.append(_amplitude(effect.name, name, p))
        # Shapes move by their logarithm: one that may have either sign stays at its nominal value.
        elif p.nominal > 0.0 and p.bounds[0] >= 0.0:
            coordinates.append(
                Coordinate(effect.name, name, start or p.nominal, 0.3, *p.bounds, log=True, prior=1.0, unit=p.unit)
            )
    return tuple(coordinates)


def _amplitude(effect: str, name: str, p: Parameter) -> Coordinate:
    assert p.null is not None
    low, high = p.bounds
    # An effect whose nominal value is its null (the user's measurement) still needs a size to be tried at.
    size = abs(p.nominal - p.null) or 0.1 * min(abs(high - p.null) or math.inf, abs(p.null - low) or math.inf)
    if not math.isfinite(size):
        size = 1.0
    return Coordinate(effect, name, p.null, size, low, high, unit=p.unit, amplitude=True)


def default_coordinate(effect: Effect, name: str, value: float, relative: float, prior: float) -> Coordinate:
    """A baseline parameter: its logarithm where it is positive by nature, else itself.

    Args:
      effect: whose parameter it is.
      name: of the parameter.
      value: where the model stands.
      relative: scale as a share of the value.
      prior: standard deviation in scales.
    """
    p = effect.parameters[name]
    low, high = p.bounds
    if low >= 0.0 and value > 0.0:
        return Coordinate(effect.name, name, value, relative, low, high, True, prior, unit=p.unit)
    # A value of zero has no share by which it could be moved.
    scale = relative * (abs(value) or 0.1 * (high - low))
    return Coordinate(effect.name, name, value, scale, low, high, False, prior, unit=p.unit)
