"""The ground that a whole wheel meets: heights along and beside its rim in place of one plane below its axle."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Parameter, effect

ALONG = tuple(np.linspace(-0.9, 0.9, 11).tolist())
"""Where the ground is sampled ahead of and behind the axle, in radii: the rim ends at 1, where it stands upright."""


@dataclasses.dataclass(frozen=True)
class RimSamples:
    """How samples of the ground count along the rim."""

    margin: float = 0.02
    """Clearance below which ground counts as near the rim, in radii: it gives a wheel that only just touches three
    samples and with them a slope."""
    airborne: float = 1e-6
    """Weight, in squared radii, of the samples next to the axle's foot where the rim is far from all ground."""


RIM_SAMPLES = RimSamples()


def fitted_plane(height_at, center, axle, radius, width):
    """The plane through the ground that the rim presses on.

    Samples count by (p + m)^2 where their distance from the axle is less than r + m, p being how far they lie within
    the rim and m the margin. A weighted straight line through those along the wheel gives height and slope, the two at
    its sides the slope across. Ground that is a plane is found exactly, whatever the weights.

    Args:
      height_at: function of x and y, m, to heights, m. center: of the wheels, m. axle: unit vectors.
      radius, width: of the wheels, m.

    Returns:
      Height below the wheels' centres, m, and slopes by x and by y, per wheel.
    """
    # Along and across in the horizontal plane, where heights are sampled; a wheel on its side has neither.
    size = jnp.sqrt(axle.x * axle.x + axle.y * axle.y + 1e-12)
    ahead_x, ahead_y = axle.y / size, -axle.x / size
    share = jnp.reshape(jnp.asarray(ALONG, jnp.result_type(radius)), (-1,) + (1,) * jnp.ndim(radius))
    u, half = share * radius, 0.5 * width
    x = jnp.concatenate([center.x + u * ahead_x, (center.x - half * ahead_y)[None], (center.x + half * ahead_y)[None]])
    y = jnp.concatenate([center.y + u * ahead_y, (center.y + half * ahead_x)[None], (center.y - half * ahead_x)[None]])
    height = height_at(x, y)
    # Heights relative to the foot: on a mountain, metres of height would eat the digits of millimetres of sinkage.
    foot = height[len(ALONG) // 2]
    along, left, right = height[:-2] - foot, height[-2], height[-1]
    clear = center.z - foot - along
    within = radius * (1.0 + RIM_SAMPLES.margin) - jnp.sqrt(u * u + clear * clear)
    # Far above ground no sample lies within the rim; those next to the axle then define a plane all the same.
    near = jnp.where(jnp.abs(share) < 0.3, RIM_SAMPLES.airborne, 0.0)
    # Squared: the weight and its derivative go to zero where the rim leaves the ground.
    weight = jnp.maximum(within / radius, 0.0) ** 2 + near
    total = jnp.sum(weight, axis=0)
    mean_u, mean_h = jnp.sum(weight * u, axis=0) / total, jnp.sum(weight * along, axis=0) / total
    off = u - mean_u
    # The samples next to the foot always weigh something, so that the denominator is never zero.
    slope = jnp.sum(weight * off * along, axis=0) / jnp.sum(weight * off * off, axis=0)
    across = (left - right) / width
    return (foot + mean_h - slope * mean_u, slope * ahead_x - across * ahead_y, slope * ahead_y + across * ahead_x)


@effect(
    "geometry",
    transient=True,
    share=Parameter(
        1.0,
        0.0,
        (0.0, 1.0),
        "1",
        "share of the plane fitted along the rim in the plane that the wheel meets",
        "1: the whole rim; 0: the tangent below the axle, as without this effect",
    ),
)
def rim_contact(ctx, p, x, geometry):
    """A wheel meets the plane fitted to the ground along and beside its rim, not the facet below its axle.

    Ground within the rim counts by the square of its depth there: a ledge is felt when the rim reaches it, the normal
    turns smoothly from facet to facet, and the sides tell the camber. On a plane nothing changes.
    """
    return dataclasses.replace(geometry, rim_share=p.share)
