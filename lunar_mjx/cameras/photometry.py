"""How bright regolith, rocks and paint look: the radiance factor I/F of a surface under one distant light.

I/F is the brightness over that of a white, diffusing plate that faces the light. Angles enter as cosines: `mu0` between
normal and light, `mu` between normal and viewer, `cos_phase` between light and viewer, which is 1 with the light behind
the viewer. The Moon brightens towards that place: the opposition surge.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.errors import bad_input, require_finite

LAWS = ("hapke", "lommel_seeliger", "lambert")
ROCK_BRIGHTNESS = 1.5
"""Of rocks over that of soil: their surfaces are less dusty. A choice."""


@dataclasses.dataclass(frozen=True)
class Regolith:
    """Photometric parameters of soil: B. Hapke, Theory of Reflectance and Emittance Spectroscopy (2012), without
    macroscopic roughness, which the terrain's own relief stands for down to its grid.

    The values are a choice: they give I/F = 0.031 at incidence and phase 60 deg with the viewer above, where maps of
    the Moon are normalised (Sato et al. 2014), and 0.15 at opposition.

    Attributes:
      albedo: single-scattering albedo w.
      lobe: width b of the double Henyey-Greenstein lobes. back: share c, positive for more light thrown back.
      surge: amplitude B_S0 of the opposition surge. surge_width: its angular width h_S, rad.
      law: "hapke"; "lommel_seeliger" leaves out multiple scattering; "lambert" is a white board of the same brightness
        at incidence 60 deg.
    """

    albedo: float = 0.26
    lobe: float = 0.25
    back: float = 0.3
    surge: float = 1.8
    surge_width: float = 0.07
    law: str = "hapke"

    def __post_init__(self) -> None:
        if self.law not in LAWS:
            raise bad_input("regolith", "law", self.law, "is no law of reflection", f"use one of {', '.join(LAWS)}")
        for name, low, high in (("albedo", 0.0, 1.0), ("lobe", 0.0, 0.99), ("back", -1.0, 1.0), ("surge", 0.0, 10.0)):
            if not low <= require_finite("regolith", name, getattr(self, name)) <= high:
                raise bad_input("regolith", name, getattr(self, name), f"is outside [{low:g}, {high:g}]", "give less")
        if not require_finite("regolith", "surge_width", self.surge_width) > 0.0:
            raise bad_input("regolith", "surge_width", self.surge_width, "is not positive", "give about 0.07 rad")

    def radiance_factor(self, mu0: Any, mu: Any, cos_phase: Any) -> Any:
        """I/F, of any shape; 0 where light or viewer is below the surface."""
        # A viewer in the surface's plane divides by zero where the Sun is there, too.
        mu0, mu = jnp.maximum(mu0, 0.0), jnp.maximum(mu, 1e-3)
        if self.law == "lambert":
            return _lambert_albedo(self) * mu0
        single = self._phase(cos_phase) * self._surge(cos_phase)
        many = 0.0
        if self.law == "hapke":
            many = self._h(mu0) * self._h(mu) - 1.0
        # r = (w / 4 pi) mu0 / (mu0 + mu) [p (1 + B) + H H - 1], and I/F = pi r
        return 0.25 * self.albedo * mu0 / (mu0 + mu) * (single + many)

    def cloud(self, cos_phase: Any) -> Any:
        """I/F of a thick cloud of the soil's grains that scatter light once, of any shape: w p(g) / 4.

        Grains that fly do not shade each other, so that they have no opposition surge.
        """
        return 0.25 * self.albedo * self._phase(cos_phase)

    def _phase(self, cos_phase: Any) -> Any:
        """Double Henyey-Greenstein phase function p(g)."""
        b2, two_b = self.lobe**2, 2.0 * self.lobe
        backward = (1.0 - b2) / (1.0 + b2 - two_b * cos_phase) ** 1.5
        forward = (1.0 - b2) / (1.0 + b2 + two_b * cos_phase) ** 1.5
        return 0.5 * (1.0 + self.back) * backward + 0.5 * (1.0 - self.back) * forward

    def _surge(self, cos_phase: Any) -> Any:
        """1 + B_S(g), B_S = B_S0 / (1 + tan(g/2) / h_S)."""
        # tan^2(g/2) = (1 - cos g) / (1 + cos g)
        # By cosines, so that no angle has to be taken.
        tangent = jnp.sqrt(jnp.maximum(1.0 - cos_phase, 0.0) / jnp.maximum(1.0 + cos_phase, 1e-9))
        return 1.0 + self.surge / (1.0 + tangent / self.surge_width)

    def _h(self, cosine: Any) -> Any:
        """Hapke's approximation of Chandrasekhar's H."""
        return (1.0 + 2.0 * cosine) / (1.0 + 2.0 * cosine * math.sqrt(1.0 - self.albedo))


def _lambert_albedo(soil: Regolith) -> float:
    """Albedo of a white board as bright as the soil, seen from above at incidence and phase 60 deg."""
    seen = float(dataclasses.replace(soil, law="hapke").radiance_factor(0.5, 1.0, 0.5))
    return seen / 0.5


@dataclasses.dataclass(frozen=True)
class Film:
    """How a camera turns brightness into numbers.

    Attributes:
      exposure: display value (0 to 1, before gamma) of I/F = 1. If None, sunlit level soil comes out at `mid`, seen
        20 deg from above and across the light, down to a Sun 2 deg high.
      mid: see `exposure`.
      gamma: display = value ** (1 / gamma).
      full_well: electrons at display value 1, for shot noise; 0 for a camera without noise.
      read_noise: electrons.
      vignetting: whether brightness falls as cos^4 towards the corners.
      dust: share of the light that dust on the lens spreads over the whole picture.
    """

    exposure: float | None = None
    mid: float = 0.16
    gamma: float = 2.2
    full_well: float = 0.0
    read_noise: float = 0.0
    vignetting: bool = False
    dust: float = 0.0

    def __post_init__(self) -> None:
        for name in ("mid", "gamma"):
            if not require_finite("film", name, getattr(self, name)) > 0.0:
                raise bad_input("film", name, getattr(self, name), "is not positive", "give a number above zero")
        for name in ("full_well", "read_noise"):
            if require_finite("film", name, getattr(self, name)) < 0.0:
                raise bad_input("film", name, getattr(self, name), "is negative", "give electrons, 0 for none")
        if not 0.0 <= require_finite("film", "dust", self.dust) < 1.0:
            raise bad_input("film", "dust", self.dust, "is outside [0, 1)", "give a share, such as 0.05")
        if self.exposure is not None and not require_finite("film", "exposure", self.exposure) > 0.0:
            raise bad_input("film", "exposure", self.exposure, "is not positive", "give about 3, or leave it out")

    @property
    def plain(self) -> bool:
        """Whether the camera adds nothing to what light says: as MuJoCo's renderer draws."""
        return self == Film()

    def developed(self, value: Any, rays: Any, chance: Any = None) -> Any:
        """What a screen shows of light, 0 to 1: through optics and dust on the lens, onto a sensor with noise.

        Args:
          value: (..., height, width, 3) light on the sensor, of which 1 saturates it; see `gain`.
          rays: (height, width, 3) of the pixels, of length 1 along the optical axis; see `Pinhole.rays`.
          chance: normal numbers of the shape of `value`, by which noise falls; no noise if None.
        """
        if self.vignetting:
            # cos^4 of the angle to the optical axis
            value = value * jnp.asarray(1.0 / np.sum(rays**2, axis=-1, keepdims=True) ** 2, value.dtype)
        if self.dust > 0.0:
            # Dust on the lens spreads light over the whole picture: a veil of the picture's own mean.
            veil = jnp.mean(value, axis=(-3, -2), keepdims=True)
            value = (1.0 - self.dust) * value + self.dust * veil
        if chance is not None and self.full_well > 0.0:
            electrons = self.full_well * jnp.maximum(value, 0.0)
            # Shot noise is the root of the electrons; read noise adds by its square.
            value = value + jnp.sqrt(electrons + self.read_noise**2) / self.full_well * chance
        # Clipped before gamma, as a sensor saturates in light and not on the screen.
        return jnp.clip(value, 0.0, 1.0) ** (1.0 / self.gamma)

    def gain(self, soil: Regolith, sun_height: Any) -> Any:
        """Display value of I/F = 1; `sun_height` is the sine of the Sun's elevation."""
        if self.exposure is not None:
            return self.exposure
        # A camera that exposed for a set Sun would show noise.
        mu0 = jnp.maximum(sun_height, LOWEST_SUN)
        # across the light, the cosine between viewer and light is the product of their heights
        return self.mid / soil.radiance_factor(mu0, METERED, mu0 * METERED)

    def shown(self, soil: Regolith, mu0: Any, mu: Any, sun_height: Any) -> Any:
        """What a screen shows of sunlit soil on faces that are not level, 0 and more.

        Args:
          soil: how it reflects. mu0, mu: cosines between their normals and the Sun, and the viewer, of any shape.
          sun_height: sine of the Sun's elevation. Across the light stands the viewer, as `gain` has it.
        """
        metered = soil.radiance_factor(mu0, mu, jnp.maximum(sun_height, LOWEST_SUN) * METERED)
        return (self.gain(soil, sun_height) * metered) ** (1.0 / self.gamma)


LOWEST_SUN = math.sin(math.radians(2.0))
"""Sine of the elevation below which no exposure makes up for the Sun."""
METERED = math.sin(math.radians(20.0))
"""Cosine between level ground's normal and the viewer for whom `Film` exposes."""
