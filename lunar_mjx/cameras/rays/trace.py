"""All pixels of a camera at once: what each ray meets, the surface's normal there, and whether the Sun reaches it.

On a GPU of NVIDIA's one kernel does it all for a few pixels at a time, with everything in registers (Pallas by Triton);
elsewhere the same code runs on arrays. Pixels are taken in small tiles, whose rays go much the same way.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lunar_mjx.cameras.pinhole import Pinhole
from lunar_mjx.cameras.rays import ground, solids
from lunar_mjx.cameras.rays.ground import FAR, Grid, Load, Tables
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import Terrain

SKY, GROUND, ROCK, ROVER = range(4)
"""Labels, as `LABELS` names them."""


@dataclasses.dataclass(frozen=True)
class TraceSettings:
    """Where rays begin, and how many of them run together."""

    skin: float = 0.012
    """How far before a surface its shadow ray begins, m: bilinear patches and the smooth normals on them differ by
    less."""
    shadow_start: float = 0.03
    """Way after which a shadow ray may meet ground, m."""
    above: int = 5
    """Level of the squares with which rays from a camera begin: far above the ground most squares are missed."""
    upon: int = 1
    """Level with which shadow rays begin, upon the ground."""
    tile: tuple[int, int] = (8, 4)
    """Pixels of a kernel's program, across and down; powers of two."""
    warps: int = 1
    """Warps of 32 threads that share a program's pixels."""
    most_pictures: int = 65_535
    """Most pictures that one start of the kernel draws: a CUDA grid is no longer along its second axis."""
    rays_at_once: int = 128
    """Pixels that arrays hold at once away from a GPU: few enough that one slow ray keeps few others waiting."""


TRACE = TraceSettings()


class Traced(NamedTuple):
    """What the rays of one picture met.

    Attributes:
      depth: m along the optical axis, infinite in the sky. label: SKY, GROUND, ROCK or ROVER.
      which: shape of the rovers, 0 where none is seen. face: unit normal, (..., 3). lit: whether the Sun shines there.
    """

    depth: Float[Array, "height width"]
    label: Int[Array, "height width"]
    which: Int[Array, "height width"]
    face: Float[Array, "height width 3"]
    lit: Any


class Bodies(NamedTuple):
    """Rovers' shapes: how many of each kind, in the table's order, and the flat table of `rays.solids`."""

    counts: tuple[int, ...]
    table: Any


class _Plan(NamedTuple):
    """What is known when the program is built."""

    grid: Grid
    counts: tuple[int, ...]
    width: int
    height: int
    focal: float
    near: float
    shaded: bool
    bent: bool


def trace(
    terrain: Terrain,
    position: Float[Array, "3"],
    turn: Float[Array, "3 3"],
    camera: Pinhole,
    far: Any,
    to_sun: Any = None,
    bodies: Bodies | None = None,
    kernel: str = "auto",
) -> Traced:
    """What one camera's pixels see.

    Args:
      terrain: ground and rocks. position, turn: of the camera. camera: optics. far: largest depth, m.
      to_sun: (3,) unit vector; if None, `face` and `lit` are not sought. bodies: of rovers.
      kernel: "auto", one kernel on a GPU and arrays elsewhere; "arrays"; "interpreted", the kernel on any device,
        for tests.
    """
    grid, table = ground.tables(terrain)
    dtype = position.dtype
    counts = (0,) * 4 if bodies is None else bodies.counts
    size = camera.width, camera.height
    bent = camera.lens is not None
    plan = _Plan(grid, counts, *size, float(camera.focal), float(camera.near), to_sun is not None, bent)
    sun = jnp.zeros(3, dtype) if to_sun is None else jnp.asarray(to_sun, dtype)
    # One short array: a kernel takes arrays only, and each has a cost of its own.
    view = jnp.concatenate([position, turn.reshape(-1), sun, jnp.asarray(far, dtype)[None]])
    shapes = jnp.zeros(solids.WIDTH, dtype) if bodies is None else bodies.table
    given = [table, view, shapes]
    if bent:
        # Right and up over the depth, pixel after pixel: what a lens bends is no formula of column and row.
        given.append(jnp.asarray(np.moveaxis(camera.rays()[..., :2], -1, 0).reshape(-1), dtype))
    found = _dispatched(kernel, functools.partial(_by_arrays, plan), functools.partial(_by_kernel, plan), given)
    depth, label, which, *face, lit = (f.reshape(camera.height, camera.width) for f in found)
    return Traced(depth, label, which, jnp.stack(face, axis=-1), lit)


def sunlit(
    terrain: Terrain,
    places: Float[Array, "n 3"],
    to_sun: Float[Array, "3"],
    bodies: Bodies | None = None,
    kernel: str = "auto",
) -> Float[Array, "n"]:
    """1 for places that the Sun reaches, 0 for those in the shadow of ground, rocks or rovers.

    Args:
      terrain: ground and rocks. places: m, above the ground. to_sun: unit vector. bodies: of rovers.
      kernel: as in `trace`.
    """
    grid, table = ground.tables(terrain)
    dtype = places.dtype
    plan = _Plan(grid, (0,) * 4 if bodies is None else bodies.counts, len(places), 1, 1.0, 0.0, True, False)
    shapes = jnp.zeros(solids.WIDTH, dtype) if bodies is None else bodies.table
    given = [table, jnp.asarray(to_sun, dtype), shapes, places.T.reshape(-1)]
    (lit,) = _dispatched(
        kernel, functools.partial(_places_by_arrays, plan), functools.partial(_places_by_kernel, plan), given
    )
    return lit


def _dispatched(kernel: str, arrays: Callable, one_kernel: Callable, given: list) -> tuple:
    """What one of two programs gives, by the name of the kernel that `trace` takes."""
    if kernel == "arrays" or (kernel == "auto" and jax.default_backend() != "gpu"):
        return arrays(*given)
    if kernel == "interpreted":
        return one_kernel(*given, interpret=True)
    # Chosen when the program is lowered: the same traced function may run on a CPU later.
    return jax.lax.platform_dependent(*given, cuda=one_kernel, default=arrays)


def _pixels(
    plan: _Plan, table: Tables, view: Any, shapes: Any, optics: Any, load: Load, column: Any, row: Any
) -> tuple:
    """What the rays through pixels meet: depth, label, shape, the normal's components, light; entries like `column`.

    Args:
      plan, table, shapes: the scene. view: position, rotation row by row, direction of the Sun, largest depth.
      optics: rays through pixels, all to the right and then all upwards; None without a lens.
      load: reads tables. column, row: of pixels; those beyond the picture look ahead, too, and are not kept.
    """
    position, sun = (Vec3(*(view[k] for k in range(n, n + 3))) for n in (0, 12))
    turn, far = [view[k] for k in range(3, 12)], view[15]
    dtype = far.dtype
    # Through the middle of pixels; rows count downward, the picture's y upward.
    if plan.bent:
        count = plan.width * plan.height
        pixel = jnp.minimum(row * plan.width + column, count - 1)
        px, py = load(optics, pixel), load(optics, pixel + count)
    else:
        px = (column.astype(dtype) + (0.5 - 0.5 * plan.width)) * (1.0 / plan.focal)
        py = ((0.5 * plan.height - 0.5) - row.astype(dtype)) * (1.0 / plan.focal)
    direction = Vec3(*(turn[3 * i] * px + turn[3 * i + 1] * py - turn[3 * i + 2] for i in range(3)))
    zero = jnp.zeros_like(px)
    eye = Vec3(*(p + zero for p in position))
    t, rock = ground.meet(plan.grid, table, load, eye, direction, zero, far + zero, TRACE.above)
    label = jnp.where(rock == -1, GROUND, jnp.where(rock >= 0, ROCK, SKY))
    which = jnp.zeros_like(label)
    if sum(plan.counts):
        # what lies before the near plane is not seen
        step = plan.near
        # Begun at the near plane: the camera sits in the rover's own head.
        near, shape = solids.meet(plan.counts, shapes, load, eye + direction * step, direction, t - step)
        on_rover = shape >= 0
        t, label = jnp.where(on_rover, near + step, t), jnp.where(on_rover, ROVER, label)
        which = jnp.where(on_rover, shape, 0)
    # Directions have length 1 along the optical axis, so that t is the depth.
    depth = jnp.where(label == SKY, jnp.inf, t)
    if not plan.shaded:
        return depth, label, which, zero, zero, zero, zero
    point = eye + direction * jnp.where(label == SKY, 0.0, t)
    face = ground.slope_normal(plan.grid, table, load, point.x, point.y)
    if plan.grid.rock_rows:
        centre, _, form = ground.stone(load, table.stones, jnp.maximum(rock, 0))
        face = form.times(point - centre).unit(1e-9).where(label == ROCK, face)
    if sum(plan.counts):
        face = solids.normal(plan.counts, shapes, load, which, point).where(label == ROVER, face)
    # no ray for what is turned away from the Sun, nor below the horizon
    sought = (label != SKY) & (face.dot(sun) > 0.0) & (sun.z > 0.0)
    # Off the surface along its normal, or rounding would let the surface shade itself.
    lit = _reached(plan, table, shapes, load, point + face * TRACE.skin, sun, sought)
    return depth, label, which, *face, lit


def _reached(plan: _Plan, table: Tables, shapes: Any, load: Load, start: Vec3, sun: Vec3, sought: Any) -> Any:
    """1 where the Sun reaches places and that is `sought`, else 0."""
    zero = jnp.zeros_like(start.x)
    way = Vec3(*(s + zero for s in sun))
    end = jnp.where(sought, FAR, -FAR)
    if sum(plan.counts):
        _, shape = solids.meet(plan.counts, shapes, load, start, way, end)
        sought = sought & (shape < 0)
        end = jnp.where(sought, FAR, -FAR)
    shadow = ground.meet(plan.grid, table, load, start, way, zero + TRACE.shadow_start, end, TRACE.upon)
    return jnp.where(sought & (shadow.rock < -1), 1.0, zero)


def _by_arrays(plan: _Plan, table: Tables, view: Any, shapes: Any, optics: Any = None) -> tuple:
    """`_pixels` on arrays, some rows of the picture after the other."""
    # A loop over arrays ends with its slowest ray; few rays wait for it here.
    rows = max(1, min(plan.height, TRACE.rays_at_once // plan.width))
    parts = math.ceil(plan.height / rows)

    def some(first: Any) -> tuple:
        row, column = jnp.meshgrid(first + jnp.arange(rows), jnp.arange(plan.width), indexing="ij")
        return _pixels(plan, table, view, shapes, optics, ground.take, column.reshape(-1), row.reshape(-1))

    found = jax.lax.map(some, rows * jnp.arange(parts))
    return tuple(f.reshape(-1)[: plan.height * plan.width] for f in found)


def _by_kernel(
    plan: _Plan, table: Tables, view: Any, shapes: Any, optics: Any = None, interpret: bool = False
) -> tuple:
    """`_pixels` as one kernel, each program with one tile."""
    wide, high = TRACE.tile
    across, down = math.ceil(plan.width / wide), math.ceil(plan.height / high)

    def some(load: Load, number: Any, lane: Any, *given: Any) -> tuple:
        table, (view_, shapes_, *optics_) = Tables(*given[:5]), given[5:]
        # Tiles and not rows: neighbouring rays ask the same squares, which then are in the cache.
        column = (number % across) * wide + lane % wide
        row = (number // across) * high + lane // wide
        found = _pixels(plan, table, view_, shapes_, optics_[0] if plan.bent else None, load, column, row)
        return found, row * plan.width + column, (column < plan.width) & (row < plan.height)

    given = (*table, view, shapes, *(() if optics is None else (optics,)))
    kinds = (view.dtype, jnp.int32, jnp.int32, *(view.dtype,) * 4)
    return _launched(some, across * down, plan.width * plan.height, kinds, given, interpret, "trace")


def _places_by_arrays(plan: _Plan, table: Tables, sun: Any, shapes: Any, places: Any) -> tuple:
    """`_reached` of places, all x and then all y and z, on arrays."""
    start = Vec3(*places.reshape(3, -1))
    sought = jnp.broadcast_to(sun[2] > 0.0, start.x.shape)
    return (_reached(plan, table, shapes, ground.take, start, Vec3(*sun), sought),)


def _places_by_kernel(plan: _Plan, table: Tables, sun: Any, shapes: Any, places: Any, interpret: bool = False) -> tuple:
    """`_reached` of places as one kernel, each program with as many as a tile has pixels."""
    lanes = TRACE.tile[0] * TRACE.tile[1]

    def some(load: Load, number: Any, lane: Any, *given: Any) -> tuple:
        table, (sun_, shapes_, places_) = Tables(*given[:5]), given[5:]
        place = number * lanes + lane
        kept = place < plan.width
        at = jnp.where(kept, place, 0)
        start = Vec3(*(load(places_, at + k * plan.width) for k in range(3)))
        to_sun = Vec3(*(sun_[k] for k in range(3)))
        return (_reached(plan, table, shapes_, load, start, to_sun, kept & (to_sun.z > 0.0)),), place, kept

    given = (*table, sun, shapes, places)
    programs = math.ceil(plan.width / lanes)
    return _launched(some, programs, plan.width, (places.dtype,), given, interpret, "sunlit")


def _launched(
    some: Callable, programs: int, count: int, kinds: Sequence[Any], given: Sequence[Any], interpret: bool, name: str
) -> tuple:
    """Arrays (count,) of `kinds` that a kernel fills, each program a few places.

    Args:
      some: of `load`, the program's number, its lanes and references to `given`: values of its lanes, where they
        belong, and which are kept. programs, count, kinds, given, name: of the kernel. interpret: on any device.
    """
    from jax.experimental import pallas
    from jax.experimental.pallas import triton

    def load(ref: Any, index: Any) -> Any:
        return triton.load(ref.at[index]) if np.ndim(index) else ref[index]

    def program(*refs: Any) -> None:
        lane = jnp.arange(TRACE.tile[0] * TRACE.tile[1], dtype=jnp.int32)
        found, place, kept = some(load, pallas.program_id(0), lane, *refs[: len(given)])
        # Lanes beyond the edge aim at the first place, and the mask keeps them from writing.
        place = jnp.where(kept, place, 0)
        for ref, value in zip(refs[len(given) :], found, strict=True):
            triton.store(ref.at[place], value, mask=kept)

    call: Callable = pallas.pallas_call(
        program,
        out_shape=[jax.ShapeDtypeStruct((count,), k) for k in kinds],
        grid=(programs,),
        compiler_params=None if interpret else triton.CompilerParams(num_warps=TRACE.warps, num_stages=1),
        interpret=interpret,
        name=name,
    )
    return tuple(call(*given))
