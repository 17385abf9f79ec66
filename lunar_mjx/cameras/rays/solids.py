"""Where rays meet boxes, cylinders, capsules and ellipsoids, and the normals there, component by component.

Solids lie in one flat table, sixteen numbers each: centre, rotation row by row, three sizes, and the radius of the
sphere about the centre that holds them; sorted by kind. Behind them comes a sphere that holds all: centre and radius.
`load` reads the table, see `rays.ground`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.cameras.rays.ground import FAR, Load, over
from lunar_mjx.spatial import Vec3

BOX, CYLINDER, CAPSULE, ELLIPSOID = range(4)
WIDTH = 16
"""Numbers of one solid."""


def table(kind: np.ndarray, place: Any, turn: Any, size: Any) -> Any:
    """The flat table of solids.

    Args:
      kind: (n,) of each, on the host, in rising order.
      place: (n, 3) m. turn: (n, 3, 3). size: (n, 3) half sizes, m; the radius first for round ones.
    """
    x, y, z = size[:, 0], size[:, 1], size[:, 2]
    box, cylinder = jnp.sqrt(x * x + y * y + z * z), jnp.sqrt(x * x + y * y)
    rest = jnp.where(kind == CAPSULE, x + y, jnp.max(size, axis=1))
    # Radius of the sphere that holds each, which sorts out most rays by a few products.
    held = jnp.where(kind == BOX, box, jnp.where(kind == CYLINDER, cylinder, rest))
    middle = jnp.mean(place, axis=0)
    reach = jnp.max(jnp.sqrt(jnp.sum((place - middle) ** 2, axis=1)) + held)
    rows = jnp.concatenate([place, turn.reshape(-1, 9), size, held[:, None]], axis=1)
    return jnp.concatenate([rows.reshape(-1), middle, reach[None]])


def meet(counts: tuple[int, ...], table: Any, load: Load, origin: Vec3, direction: Vec3, end: Any) -> tuple[Any, Any]:
    """Where rays first enter a solid before `end`.

    Args:
      counts: of each kind, in the order of the table. table, load: the solids.
      origin: m. direction: of any length. end: of one shape with both; with no way before it nothing is looked for.

    Returns:
      Multiple of the direction, `FAR` where nothing is met; and which solid, -1 for none.
    """
    squared = direction.dot(direction)
    inverse = 1.0 / jnp.maximum(squared, 1e-12)

    def near(centre: Vec3, held: Any, before: Any) -> Any:
        """1 where a ray passes a sphere's inside ahead of it and before what it has met, else 0."""
        away = centre - origin
        along = away.dot(direction)
        passes = away.dot(away) - along * along * inverse <= held * held
        reaches = along + held * jnp.sqrt(squared) >= 0.0
        # What begins behind the nearest hit cannot be seen.
        begins = along - held * jnp.sqrt(squared) <= before * squared
        return (passes & reaches & begins & (before > 0.0)).astype(jnp.int32)

    def some(centre: Vec3, held: Any, before: Any) -> Any:
        return jnp.max(near(centre, held, before)) > 0

    def each(carry: tuple) -> tuple:
        first = 0
        # Sorted by kind, so that each loop has one formula and no choice within.
        for kind, count in enumerate(counts):

            def body(k: Any, carry: tuple, kind: int = kind) -> tuple:
                values = [load(table, WIDTH * k + i) for i in range(WIDTH)]

                def enter(carry: tuple) -> tuple:
                    best, which = carry
                    entry = _ENTRY[kind](values[12:15], *_local(values, origin, direction))
                    nearer = entry < best
                    return jnp.where(nearer, entry, best), jnp.where(nearer, k, which)

                return jax.lax.cond(some(Vec3(*values[:3]), values[15], carry[0]), enter, lambda c: c, carry)

            if count:
                carry = jax.lax.fori_loop(first, first + count, body, carry)
            first += count
        return carry

    whole = [load(table, WIDTH * sum(counts) + i) for i in range(4)]
    carry = (end, jnp.full(end.shape, -1, jnp.int32))
    # Most tiles miss the whole rover, and skip all of its parts.
    best, which = jax.lax.cond(some(Vec3(*whole[:3]), whole[3], end), each, lambda c: c, carry)
    return jnp.where(which >= 0, best, FAR), which


def _local(values: list, origin: Vec3, direction: Vec3) -> tuple[Vec3, Vec3]:
    """Origin and direction in a solid's own frame."""
    away = origin - Vec3(*values[:3])
    columns = [Vec3(values[3 + k], values[6 + k], values[9 + k]) for k in range(3)]
    return Vec3(*(c.dot(away) for c in columns)), Vec3(*(c.dot(direction) for c in columns))


def _first(enter: Any, leave: Any) -> Any:
    """The entry if it lies ahead and before the exit."""
    return jnp.where((enter < leave) & (enter > 0.0), enter, FAR)


def _slab(half: Any, o: Any, d: Any) -> tuple[Any, Any]:
    inverse = over(d)
    a, b = (-half - o) * inverse, (half - o) * inverse
    return jnp.minimum(a, b), jnp.maximum(a, b)


def _box(size: list, o: Vec3, d: Vec3) -> Any:
    enter, leave = zip(*(_slab(*axis) for axis in zip(size, o, d, strict=True)), strict=True)
    return _first(jnp.maximum(jnp.maximum(*enter[:2]), enter[2]), jnp.minimum(jnp.minimum(*leave[:2]), leave[2]))


def _round(a: Any, b: Any, c: Any) -> tuple[Any, Any]:
    """Interval (from, to) of t in which a t^2 + 2 b t + c is negative; empty where it never is."""
    root = b * b - a * c
    some = root > 0.0
    root, inverse = jnp.sqrt(jnp.where(some, root, 0.0)), over(a)
    # along the axis nothing changes: all of the ray is within, or nothing
    along = a < 1e-12
    never, always = jnp.where(along & (c < 0.0), -FAR, FAR), jnp.where(along & (c < 0.0), FAR, -FAR)
    some = some & ~along
    return jnp.where(some, (-b - root) * inverse, never), jnp.where(some, (-b + root) * inverse, always)


def _cylinder(size: list, o: Vec3, d: Vec3) -> Any:
    r, half = size[:2]
    enter, leave = _round(d.x * d.x + d.y * d.y, o.x * d.x + o.y * d.y, o.x * o.x + o.y * o.y - r * r)
    a, b = _slab(half, o.z, d.z)
    return _first(jnp.maximum(enter, a), jnp.minimum(leave, b))


def _sphere(o: Vec3, d: Vec3, r: Any, lift: Any) -> Any:
    o = Vec3(o.x, o.y, o.z - lift)
    return _first(*_round(d.dot(d), o.dot(d), o.dot(o) - r * r))


def _capsule(size: list, o: Vec3, d: Vec3) -> Any:
    r, half = size[:2]
    return jnp.minimum(_cylinder(size, o, d), jnp.minimum(_sphere(o, d, r, half), _sphere(o, d, r, -half)))


def _ellipsoid(size: list, o: Vec3, d: Vec3) -> Any:
    o, d = (Vec3(v.x / size[0], v.y / size[1], v.z / size[2]) for v in (o, d))
    return _sphere(o, d, 1.0, 0.0)


_ENTRY = {BOX: _box, CYLINDER: _cylinder, CAPSULE: _capsule, ELLIPSOID: _ellipsoid}


def normal(counts: tuple[int, ...], table: Any, load: Load, which: Any, point: Vec3) -> Vec3:
    """Outward unit normals of the solids `which` (0 or more) at points on their surfaces."""
    values = [load(table, WIDTH * which + i) for i in range(WIDTH)]
    (sx, sy, sz), (own, _) = values[12:15], _local(values, point, point)
    x, y, z = own
    # a box's face is the one that the point is nearest to, as a share of the half size
    ax, ay, az = jnp.abs(x) / sx, jnp.abs(y) / sy, jnp.abs(z) / sz
    on_x, on_y = (ax >= ay) & (ax >= az), (ay > ax) & (ay >= az)
    zero = jnp.zeros_like(x)
    box = Vec3(jnp.where(on_x, _sign(x), zero), jnp.where(on_y, _sign(y), zero), jnp.where(on_x | on_y, zero, _sign(z)))
    found, last = box, counts[BOX]
    on_cap = jnp.abs(z) / sy > jnp.sqrt(x * x + y * y) / sx
    cylinder = Vec3(jnp.where(on_cap, zero, x), jnp.where(on_cap, zero, y), jnp.where(on_cap, _sign(z), zero))
    capsule = Vec3(x, y, z - jnp.minimum(jnp.maximum(z, -sy), sy))
    ellipsoid = Vec3(x / (sx * sx), y / (sy * sy), z / (sz * sz))
    for kind, other in ((CYLINDER, cylinder), (CAPSULE, capsule), (ELLIPSOID, ellipsoid)):
        if counts[kind]:
            found = other.where(which >= last, found)
        last += counts[kind]
    found = found.unit()
    rows = [Vec3(*values[3 + 3 * i : 6 + 3 * i]) for i in range(3)]
    return Vec3(*(row.dot(found) for row in rows))


def _sign(value: Any) -> Any:
    return jnp.where(value < 0.0, -1.0, 1.0)
