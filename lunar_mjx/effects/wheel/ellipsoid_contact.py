"""Where wheels and boxes are deepest in an ellipsoid: the point of them nearest to its centre in its scaled space.

With A the ellipsoid's form and q the vector from its centre, s^2 = q' A q is 1 on the surface. The point of a convex
body where s is least is the point of contact when they just touch, and for spheres the nearest point at any depth. Its
depth along the normal A q is (1 - s) s/|A q| to first order, which is exact for spheres.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain.rocks import Form

_NEWTON = 5
"""Steps of Newton's method on a disc: for semi-axes of `MOST_ELONGATED` they leave 1e-9 of its radius."""


def contact_with_wheel(form: Form, gap: Vec3, axle: Vec3, radius: Any, width: Any) -> tuple[Vec3, Vec3, Any]:
    """A wheel, which is a cylinder, and an ellipsoid.

    Args:
      form: the ellipsoid's, world frame. gap: its centre from the wheel's, m.
      axle: unit vector. radius, width: of the wheel, m.

    Returns:
      The wheel's deepest point from its centre, m; unit vector from there into the ellipsoid; depth, m, negative
      where they are apart.
    """
    e_1, e_2 = _across(axle)
    m_1, m_2, m_3 = (form.times(e) for e in (e_1, e_2, axle))
    m_11, m_12, m_22, m_13, m_23, m_33 = (
        a.dot(b) for a, b in ((m_1, e_1), (m_1, e_2), (m_2, e_2), (m_1, axle), (m_2, axle), (m_3, axle))
    )
    b_1, b_2, b_3 = (m.dot(gap) for m in (m_1, m_2, m_3))
    # The least value over the disc at a given place along the axle is convex in that place. So the best place of an
    # endless cylinder, clipped to the wheel's width, is the best place of the wheel.
    u, v = _least_on_disc(
        m_11 - m_13 * m_13 / m_33,
        m_12 - m_13 * m_23 / m_33,
        m_22 - m_23 * m_23 / m_33,
        b_1 - m_13 * b_3 / m_33,
        b_2 - m_23 * b_3 / m_33,
        radius,
    )
    t = jnp.clip((b_3 - m_13 * u - m_23 * v) / m_33, -0.5 * width, 0.5 * width)
    u, v = _least_on_disc(m_11, m_12, m_22, b_1 - m_13 * t, b_2 - m_23 * t, radius)
    point = e_1 * u + e_2 * v + axle * t
    return point, *_normal_and_depth(form, point - gap)


def contact_with_box(form: Form, gap: Vec3, frame: Frame, half: Vec3) -> tuple[Vec3, Vec3, Any]:
    """A box and an ellipsoid.

    Args:
      form: the ellipsoid's, world frame. gap: its centre from the box's, m, box frame.
      frame: the box's. half: half its sides, m.

    Returns:
      The box's deepest point from its centre, m, box frame; unit vector from there into the ellipsoid, world frame,
      which is the box's downward axis where the ellipsoid's centre is within the box; depth, m.
    """
    x, y, z = frame
    m = Form(*(form.between(a, b) for a, b in ((x, x), (y, y), (z, z), (y, z), (x, z), (x, y))))
    b = m.times(gap)
    # as for wheels: first as if the box were endless in z, then at the best z
    over = Form(m.xx - m.xz * m.xz / m.zz, m.yy - m.yz * m.yz / m.zz, m.zz, m.yz, m.xz, m.xy - m.xz * m.yz / m.zz)
    px, py = _least_on_rectangle(over, b.x - m.xz * b.z / m.zz, b.y - m.yz * b.z / m.zz, half)
    pz = jnp.clip((b.z - m.xz * px - m.yz * py) / m.zz, -half.z, half.z)
    point = Vec3(*_least_on_rectangle(m, b.x - m.xz * pz, b.y - m.yz * pz, half), pz)
    apart = point - gap
    inside = apart.norm(1e-9) < 1e-6
    toward, depth = _normal_and_depth(form, frame.to_world(apart))
    return point, (-z).where(inside, toward), jnp.where(inside, 1.0 / jnp.sqrt(m.zz), depth)


# First order in the depth is enough: penalties go millimetres deep into stones of decimetres.
def _normal_and_depth(form: Form, q: Vec3) -> tuple[Vec3, Any]:
    outward = form.times(q)
    steep = outward.norm(1e-9)
    level = jnp.sqrt(jnp.maximum(q.dot(outward), 1e-18))
    return outward * (-1.0 / steep), (1.0 - level) * level / steep


def _across(axle: Vec3) -> tuple[Vec3, Vec3]:
    """Two unit vectors square to the axle and to each other (Duff et al. 2017); which ones does not matter."""
    sign = jnp.where(axle.z < 0.0, -1.0, 1.0)
    # Duff's formula is exact but where axle.z = -sign, which the choice of the sign excludes.
    a = -1.0 / (sign + axle.z)
    b = axle.x * axle.y * a
    first = Vec3(1.0 + sign * axle.x * axle.x * a, sign * b, -sign * axle.x)
    return first, Vec3(b, sign + axle.y * axle.y * a, -axle.y)


def _least_on_disc(m_11: Any, m_12: Any, m_22: Any, b_1: Any, b_2: Any, radius: Any) -> tuple[Any, Any]:
    """(u, v) with u^2 + v^2 <= radius^2 where m/2 - b is least: (m + lambda) (u, v) = b, lambda >= 0.

    Newton's method on 1/|(u, v)| - 1/radius, concave in lambda, rises from 0 without overshooting (Reinsch 1971).
    """

    def solved(more: Any) -> tuple[Any, Any, Any]:
        a, d = m_11 + more, m_22 + more
        inverse = 1.0 / (a * d - m_12 * m_12)
        u, v = (d * b_1 - m_12 * b_2) * inverse, (a * b_2 - m_12 * b_1) * inverse
        return u, v, (d * u * u - 2.0 * m_12 * u * v + a * v * v) * inverse

    more = jnp.zeros_like(b_1)
    for _ in range(_NEWTON):
        u, v, bent = solved(more)
        squared = jnp.maximum(u * u + v * v, 1e-18)
        # With a multiplier of 0 a minimum within the disc stays where it is.
        more = jnp.maximum(more + squared / jnp.maximum(bent, 1e-18) * (jnp.sqrt(squared) / radius - 1.0), 0.0)
    u, v, _ = solved(more)
    return u, v


def _least_on_rectangle(m: Form, b_x: Any, b_y: Any, half: Vec3) -> tuple[Any, Any]:
    """(x, y) within half sides where m/2 - b is least, of the xx, yy and xy of m."""
    # First x as if y were free, then y at that x, then x again: exact for a convex form, as for the box's z.
    x = jnp.clip((b_x - m.xy * b_y / m.yy) / (m.xx - m.xy * m.xy / m.yy), -half.x, half.x)
    y = jnp.clip((b_y - m.xy * x) / m.yy, -half.y, half.y)
    return jnp.clip((b_x - m.xy * y) / m.xx, -half.x, half.x), y
