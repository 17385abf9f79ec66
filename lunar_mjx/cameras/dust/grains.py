"""What wheels throw, how it leaves them, and the grains in flight: formulas for a recorded drive and for a batch."""

from __future__ import annotations

import dataclasses
import math
from typing import Any, NamedTuple

from jaxtyping import Float


@dataclasses.dataclass(frozen=True)
class Spray:
    """What wheels throw, and how it is drawn: a choice, but for the size of grains."""

    layer: float = 1e-4
    """Thickness of the soil that is thrown, over the way that the rim slips, m."""
    soil_density: float = 1500.0
    grain_density: float = 3100.0
    grain_radius: float = 35e-6
    """kg/m3, and half of the mean size of lunar soils, m: 60 to 80 um (McKay et al. 1991 in the Lunar Sourcebook)."""
    per_metre: float = 10000.0
    """Drawn grains for each metre of slip. Each stands for many, by their cross-section."""
    most: int = 3000
    """Drawn grains in flight of one wheel; where there would be more, each stands for twice as many, and so on."""
    quiet: float = 0.01
    """Slip up to which soil is sheared and not thrown, m/s."""
    sweep: float = math.radians(50.0)
    """Angle of the rim over which soil leaves it, behind the place where the rim leaves the ground."""
    slowest: float = 0.3
    """Share of the rim's velocity that the slowest grain has; the fastest has all of it."""
    aside: float = 0.15
    """Most of a grain's velocity that goes sideways, as a share."""
    size: float = 0.002
    growth: float = 0.03
    """Spread of what a drawn grain stands for: at first, m, and how much of its way is added to it."""
    shutter: float = 0.02
    """Time over which a picture is exposed, so that grains are drawn as short streaks, s."""
    smear: int = 4
    """Places along a streak."""
    at_once: int = 2000
    """Such places that are drawn together."""
    upright: float = 0.3
    """Least height of the unit vector across the axle and upwards of a wheel that throws."""
    touch: float = 0.01
    """Distance from the ground within which a wheel touches it, m: grids of pictures and of physics differ by less."""
    gravity: float = 1.625
    """Of the Moon, under which grains fly unless told otherwise, m/s2."""
    heaviest: float = 2.0
    """Gravity from which on there is taken to be air, and no dust is drawn, m/s2."""

    @property
    def cover(self) -> float:
        """Cross-section of the grains from a square metre of slipped ground."""
        return self.layer * self.soil_density * 3.0 / (4.0 * self.grain_density * self.grain_radius)


SPRAY = Spray()


class WheelMotion(NamedTuple):
    """Wheels at each time of a drive.

    Attributes:
      centre: m. axle: unit vector to the left of a wheel that rolls forward. angle: of the drive, rad; forward is
        positive.
    """

    centre: Float[Any, "time wheel 3"]
    axle: Float[Any, "time wheel 3"]
    angle: Float[Any, "time wheel"]


class Grains(NamedTuple):
    """Grains in flight at one time.

    Attributes:
      position: m. velocity: m/s. spread: deviation of the soil that a drawn grain stands for, m. area: its
        cross-section, m2. wheel: that threw it.
    """

    position: Float[Any, "grain 3"]
    velocity: Float[Any, "grain 3"]
    spread: Float[Any, "grain"]
    area: Float[Any, "grain"]
    wheel: Any


class Throw(NamedTuple):
    """What wheels throw at some times, whatever the leading axes; `vector` is (..., 3).

    Attributes:
      centre: of the wheel, m. ahead, up, axle: unit vectors along its way, across way and axle, and to its left.
      along: its velocity along the ground, m/s. rim: speed of its rim, m/s.
      leave: angle of the rim at which it leaves the ground, rad. thrown: slip whose soil is thrown, m/s.
    """

    centre: Any
    ahead: Any
    up: Any
    axle: Any
    along: Any
    rim: Any
    leave: Any
    thrown: Any


def judged(
    xp: Any,
    centre: Float[Any, "*time wheel 3"],
    axle: Float[Any, "*time wheel 3"],
    velocity: Float[Any, "*time wheel 3"],
    turning: Float[Any, "*time wheel"],
    height: Float[Any, "*time wheel"],
    normal: Float[Any, "*time wheel 3"],
    radius: Float[Any, "wheel"],
    quiet: float = SPRAY.quiet,
) -> Throw:
    """What wheels throw, from how they move over the ground.

    Args:
      xp: `numpy` or `jax.numpy`, which all the rest are arrays of.
      centre, axle, velocity: of the wheels, m, unit vectors and m/s. turning: of their drives, rad/s.
      height, normal: of the ground below them, m and unit vectors. radius: of the wheels, m.
      quiet: slip up to which nothing is thrown, m/s.
    """
    sign = xp.where(turning < 0.0, -1.0, 1.0)[..., None]
    ahead = unit(xp, xp.cross(sign * axle, normal))
    up = xp.cross(ahead, sign * axle)
    rim = xp.abs(turning) * radius
    along = velocity - xp.sum(velocity * normal, axis=-1, keepdims=True) * normal
    slip = xp.linalg.norm(along - rim[..., None] * ahead, axis=-1)
    # By the distance to the plane of the ground, which on a slope is less than the height.
    clear = (centre[..., 2] - height) * normal[..., 2]
    # A rim that does not turn carries nothing up, however fast it skids; nor does a wheel that lies on its side.
    carried = xp.minimum(slip, rim) - quiet
    throws = (clear < radius + SPRAY.touch) & (up[..., 2] > SPRAY.upright) & (carried > 0.0)
    leave = xp.arccos(xp.clip(clear / radius, 0.5, 1.0))
    return Throw(centre, ahead, up, axle, along, rim, leave, xp.where(throws, carried, 0.0))


def released(
    xp: Any, throw: Throw, radius: Any, width: Any, chances: tuple[Any, ...]
) -> tuple[Float[Any, "grain 3"], Float[Any, "grain 3"]]:
    """Place, m, and velocity, m/s, of grains as they leave the rim.

    Args:
      xp: `numpy` or `jax.numpy`. throw: of each grain's wheel at that time.
      radius, width: of the wheels, m. chances: four numbers from 0 to 1 of each grain: of the angle at which it leaves,
        of its slowness, of its place across the wheel, and of how far it turns aside.
    """
    angle, slowness, place, side = chances
    # Most soil leaves soon: by the square of what chance says.
    angle = throw.leave + SPRAY.sweep * angle**2
    cos, sin = xp.cos(angle)[..., None], xp.sin(angle)[..., None]
    start = throw.centre - xp.asarray(radius)[..., None] * (sin * throw.ahead + cos * throw.up)
    start = start + ((place - 0.5) * width)[..., None] * throw.axle
    # The rim's own velocity over the ground there, some of it turned aside.
    launch = throw.along + throw.rim[..., None] * (sin * throw.up - cos * throw.ahead)
    speed = xp.linalg.norm(launch, axis=-1, keepdims=True)
    aside = (SPRAY.aside * (2.0 * side - 1.0))[..., None]
    launch = xp.sqrt(1.0 - aside**2) * launch + aside * speed * throw.axle
    launch = launch * speed / xp.maximum(xp.linalg.norm(launch, axis=-1, keepdims=True), 1e-9)
    return start, launch * (1.0 - (1.0 - SPRAY.slowest) * slowness)[..., None]


def unit(xp: Any, vectors: Float[Any, "*any 3"]) -> Float[Any, "*any 3"]:
    """Vectors made as long as one; those of no length stay."""
    return vectors / xp.maximum(xp.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
