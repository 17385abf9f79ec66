"""Ambient temperature of a model: constant, or following the Sun over a lunar day."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp

from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.pytree import pytree

SYNODIC_DAY = 29.530588 * 86400.0
"""From noon to noon on the Moon, s."""
ENVIRONMENT: Mapping[str, tuple[float, float]] = {
    "ambient_temperature_degC": (-273.15, 1000.0),
    "sun_azimuth_deg": (-360.0, 360.0),
    "sun_elevation_deg": (-90.0, 90.0),
}
"""What a log or a manoeuvre may state of its surroundings: from absolute zero to what no rover outlives, and turns."""


def require_environment(source: str | Path, field: str, key: str, value: float) -> float:
    """A value of `ENVIRONMENT`, in the unit of its key.

    Raises:
      UserError: it is none that a rover meets; `source` and `field` say where it stands.
    """
    low, high = ENVIRONMENT[key]
    if key.endswith("_degC") and not low < value < high:
        raise bad_input(source, field, value, "is no temperature in degC", f"give degrees Celsius above {low:g}")
    return require_within(source, field, value, low, high)


@pytree
class Ambient:
    """Ambient temperature: constant, or following the Sun over a lunar day.

    T_A = T_night + (T_noon - T_night) max(0, cos(2 pi (t - t_noon)/P))^(1/4): the equilibrium of a surface under the
    Sun; constant where T_noon = T_night.

    Attributes:
      noon, night: temperatures, K. noon_time: when the Sun culminates, s. period: length of the day, s.
    """

    noon: Any
    night: Any
    noon_time: Any
    period: Any

    def at(self, time: Any) -> Any:
        """Temperature at `time`, s, K."""
        return self.under(jnp.cos(2.0 * jnp.pi * (time - self.noon_time) / self.period))

    def under(self, sun: Any) -> Any:
        """Temperature, K, where the sine of the Sun's elevation is `sun` times its highest."""
        # The inner `where` keeps the root's infinite derivative at sunset out of gradients.
        up = jnp.where(sun > 0.0, jnp.where(sun > 0.0, sun, 1.0) ** 0.25, 0.0)
        return self.night + (self.noon - self.night) * up
