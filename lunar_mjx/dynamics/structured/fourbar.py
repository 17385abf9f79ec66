"""A planar four-bar closed exactly: the two dependent joints of a leg from the independent one.

The loop turns in a plane of normal n. A1 and B1 are the pivots on the loop's ground, d = A1A2 the first link, e = A2P
the coupler from its joint on the first link to the pin P, f = B1P the third link, b = B1 - A1:

    R(phi_1) d + R(phi_1 + phi_2) e = b + R(phi_3) f.

One angle given, one link has a known direction; the triangle that remains gives a second angle from
a cos(x) + b sin(x) = c (Freudenstein's equation) and the third from the closing vector. Rates and accelerations follow
from the loop's first and second derivatives, a 2 x 2 solve. A parallelogram (d = f, e = b) needs none of it:
phi_3 = phi_1 and phi_2 = -phi_1.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.spatial_algebra import uniform
from lunar_mjx.dynamics.structured.links import Link
from lunar_mjx.dynamics.structured.suitability import UnsuitableError
from lunar_mjx.spatial import Frame, Vec3, add, mul, neg, sub

Plane = tuple[Any, Any]


class LoopNumbers(NamedTuple):
    """Numbers of the loop over the legs: senses of the three joints about n, the vectors, the branch of assembly."""

    senses: tuple[Any, Any, Any]
    d: Plane
    e: Plane
    f: Plane
    b: Plane
    branch: Any


@dataclasses.dataclass(frozen=True, eq=False)
class FourBar:
    """The closed loop of four bars in a leg.

    Attributes:
      links: the first link, the coupler that hangs on it, and the third link.
      given: which of the three joints is the independent one (0, 1, 2).
      parallelogram: whether opposite sides are equal.
    """

    links: tuple[int, int, int]
    given: int
    parallelogram: bool
    numbers: LoopNumbers

    @property
    def independent(self) -> int:
        """Number of the link whose angle gives the other two."""
        return self.links[self.given]

    @property
    def dependent(self) -> tuple[int, int]:
        """Numbers of the two links whose angles follow."""
        return self._dependent(self.links)

    def angles(self, n: LoopNumbers, angle: Any) -> tuple[Any, Any]:
        """Angles of the dependent joints, rad, in (-pi, pi]."""
        phi = self._solve(n, mul(n.senses[self.given], angle))
        return self._dependent(mul(s, p) for s, p in zip(n.senses, phi, strict=True))

    def rates(self, n: LoopNumbers, angle: Any, speed: Any) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
        """Dependent speeds per independent speed, and the dependent accelerations at zero independent acceleration.

        Both for the joints in the order of `dependent`: 1, and rad/s2.
        """
        own = n.senses[self.given]
        if self.parallelogram:
            ratio = _PARALLELOGRAM[self.given]
            return self._dependent(mul(mul(s, own), r) for s, r in zip(n.senses, ratio, strict=True)), (0.0, 0.0)
        phi = self._solve(n, mul(own, angle))
        # the closure r_1 + r_2 - r_3 = const is linear in the rates, so that no further trigonometry is needed
        r = _turn(n.d, phi[0]), _turn(n.e, add(phi[0], phi[1])), _turn(n.f, phi[2])
        # in the absolute angles x = (phi_1, phi_1 + phi_2, phi_3): r_1 x_1' + r_2 x_2' - r_3 x_3' = 0 (turned by J)
        columns = (add(r[0][0], r[1][0]), add(r[0][1], r[1][1])), r[1], (neg(r[2][0]), neg(r[2][1]))
        known = columns[self.given]
        p, q = self._dependent(columns)
        # Zero at a dead point, where the dependent links are parallel; `read_fourbar` refuses rovers that are assembled
        # there.
        determinant = 1.0 / _cross(p, q)
        gain = mul(neg(_cross(known, q)), determinant), mul(neg(_cross(p, known)), determinant)
        rate = self._all(gain, 1.0)
        turning = rate[0], add(rate[0], rate[1]), rate[2]
        # J(sum r_k x_k'') = sum r_k x_k'^2 with J the turn by 90 degrees: x'' = solve(p, q; -J sum)
        squares = [mul(mul(w, w), mul(speed, speed)) for w in turning]
        along = tuple(
            sub(add(mul(r[0][k], squares[0]), mul(r[1][k], squares[1])), mul(r[2][k], squares[2])) for k in (0, 1)
        )
        perpendicular = (neg(along[1]), along[0])
        bias = mul(neg(_cross(perpendicular, q)), determinant), mul(neg(_cross(p, perpendicular)), determinant)
        first, second = self._dependent(n.senses)
        return (
            (mul(mul(first, own), gain[0]), mul(mul(second, own), gain[1])),
            (mul(first, bias[0]), mul(second, bias[1])),
        )

    def _dependent(self, all_three: Iterable[Any]) -> tuple[Any, Any]:
        """What of the three joints belongs to the two whose angles follow."""
        first, second = (value for i, value in enumerate(all_three) if i != self.given)
        return first, second

    def _all(self, pair: tuple[Any, Any], given: Any) -> tuple[Any, Any, Any]:
        values = list(pair)
        values.insert(self.given, given)
        first, second, third = values
        return first, second, third

    def _solve(self, n: LoopNumbers, phi: Any) -> tuple[Any, Any, Any]:
        """All three angles about n."""
        if self.parallelogram:
            first, second, third = _PARALLELOGRAM[self.given]
            return mul(first, phi), mul(second, phi), mul(third, phi)
        if self.given == 0:
            # With the first link's direction known, coupler and third link close a triangle on its end.
            known = _minus(_turn(n.d, phi), n.b)
            coupler = _freudenstein(known, n.e, n.f, n.branch)
            third = _between(n.f, _plus(known, _turn(n.e, coupler)))
            return phi, _wrap(coupler - phi), third
        if self.given == 1:
            # With the coupler's angle known, first link and coupler are one rigid bar.
            link = _plus(n.d, _turn(n.e, phi))
            first = _freudenstein((neg(n.b[0]), neg(n.b[1])), link, n.f, n.branch)
            return first, phi, _between(n.f, _minus(_turn(link, first), n.b))
        known = _plus(n.b, _turn(n.f, phi))
        first = _freudenstein((neg(known[0]), neg(known[1])), n.d, n.e, n.branch)
        coupler = _between(n.e, _minus(known, _turn(n.d, first)))
        return first, _wrap(coupler - first), phi


_PARALLELOGRAM = ((1.0, -1.0, 1.0), (-1.0, 1.0, -1.0), (1.0, -1.0, 1.0))
"""Rates of the three joints per rate of the given one: opposite sides stay parallel, angles differ by sign alone."""


def _plus(p: Plane, q: Plane) -> Plane:
    return add(p[0], q[0]), add(p[1], q[1])


def _minus(p: Plane, q: Plane) -> Plane:
    return sub(p[0], q[0]), sub(p[1], q[1])


def _cross(p: Plane, q: Plane) -> Any:
    return sub(mul(p[0], q[1]), mul(p[1], q[0]))


def _dot(p: Plane, q: Plane) -> Any:
    return add(mul(p[0], q[0]), mul(p[1], q[1]))


def _turn(v: Plane, angle: Any) -> Plane:
    cos, sin = jnp.cos(angle), jnp.sin(angle)
    return sub(mul(cos, v[0]), mul(sin, v[1])), add(mul(sin, v[0]), mul(cos, v[1]))


def _between(v: Plane, w: Plane) -> Any:
    """Angle from the vector v to the vector w, rad."""
    return jnp.arctan2(_cross(v, w), _dot(v, w))


def _wrap(angle: Any) -> Any:
    """An angle that is at most one turn away from (-pi, pi], brought there."""
    angle = jnp.where(angle > np.pi, angle - 2.0 * np.pi, angle)
    return jnp.where(angle <= -np.pi, angle + 2.0 * np.pi, angle)


def _freudenstein(known: Plane, link: Plane, length: Plane, branch: Any) -> Any:
    """Angle x for which |known + R(x) link| = |length|, on the branch of assembly.

    Where the loop cannot close, the angle at which it comes nearest.
    """
    # The cosine rule in vectors: |known + R(x) link|^2 = |length|^2 is a cos x + b sin x = c.
    a, b = _dot(known, link), _cross(link, known)
    c = 0.5 * (_dot(length, length) - _dot(known, known) - _dot(link, link))
    rest = a * a + b * b - c * c
    # a floor keeps the derivative finite at the dead points
    root = jnp.sqrt(jnp.maximum(rest, 1e-12 * (a * a + b * b)))
    return _wrap(jnp.arctan2(b, a) + branch * jnp.arctan2(root, c))


def read_fourbar(
    links: list[Link], count: int, pinned: tuple[int, int], anchors: Sequence[tuple[np.ndarray, ...]], name: str
) -> FourBar:
    """Reads a loop that a pin closes between two links of a leg.

    Args:
      links: the leg's links.
      count: number of legs in the group.
      pinned: the two links that the pin ties.
      anchors: for each leg, the pin in the frames of the two links, m.
      name: what to name in errors.

    Raises:
      UnsuitableError: the loop is no planar four-bar, or is assembled at a dead point.
    """
    chains = [_chain(links, i) for i in pinned]
    # Links above the place where the two chains part carry the loop and are no part of it.
    common = {*chains[0]} & {*chains[1]}
    sides = [[i for i in chain if i not in common] for chain in chains]
    swap = len(sides[0]) < len(sides[1])
    long, short = (sides[1], sides[0]) if swap else (sides[0], sides[1])
    # Longer loops have no closed form; MJX runs such rovers.
    if (len(long), len(short)) != (2, 1):
        raise UnsuitableError(f"{name} runs over {len(long)} + {len(short)} joints; a four-bar has 2 + 1.")
    chosen = (long[0], long[1], short[0])
    legs = [_measure(links, chosen, leg, anchors[leg][:: -1 if swap else 1], name) for leg in range(count)]
    # an actuated joint is the independent one: its friction and limits then act on a coordinate of its own
    given = next((i for i in (0, 2, 1) if links[chosen[i]].actuated is not None), 0)
    if sum(links[i].actuated is not None for i in chosen) > 1:
        raise UnsuitableError(f"{name} has more than one actuated joint.")

    def sense(joint: int) -> Any:
        return uniform([leg.senses[joint] for leg in legs])

    numbers = LoopNumbers(
        senses=(sense(0), sense(1), sense(2)),
        **{k: tuple(uniform(c) for c in np.array([getattr(leg, k) for leg in legs]).T) for k in "defb"},
        branch=1.0,
    )
    side = [np.linalg.norm(leg.e) + np.linalg.norm(leg.d) for leg in legs]
    parallel = all(
        np.linalg.norm(leg.d - leg.f) + np.linalg.norm(leg.e - leg.b) < 1e-9 * s
        for leg, s in zip(legs, side, strict=True)
    )
    loop = FourBar(chosen, given, parallel, numbers)
    return loop if parallel else dataclasses.replace(loop, numbers=_branch(loop, legs, name))


class _Measured(NamedTuple):
    senses: tuple[float, float, float]
    d: np.ndarray
    e: np.ndarray
    f: np.ndarray
    b: np.ndarray


def _chain(links: list[Link], i: int) -> list[int]:
    chain = []
    while i >= 0:
        chain.insert(0, i)
        i = links[i].parent
    return chain


def _leg_value(number: Any, leg: int) -> float:
    return float(number) if np.ndim(number) == 0 else float(np.asarray(number)[leg])


def _pose(links: list[Link], i: int, leg: int) -> tuple[np.ndarray, np.ndarray]:
    """Turn and origin of a link's frame in the chassis frame at zero angles."""
    turn, origin = np.eye(3), np.zeros(3)
    for k in _chain(links, i):
        place: Vec3 = links[k].numbers.origin
        columns: Frame = links[k].numbers.turn
        origin = origin + turn @ [_leg_value(c, leg) for c in place]
        turn = turn @ np.column_stack([[_leg_value(c, leg) for c in column] for column in columns])
    return turn, origin


def _measure(links: list[Link], chosen: tuple[int, int, int], leg: int, anchors: Any, name: str) -> _Measured:
    """The loop of one leg at zero angles, in a plane basis."""
    poses = [_pose(links, i, leg) for i in chosen]
    axes = [turn[:, links[i].axis] for i, (turn, _) in zip(chosen, poses, strict=True)]
    normal = axes[0]
    first, second, third = (float(np.sign(a @ normal)) for a in axes)
    pins = [poses[1][1] + poses[1][0] @ anchors[0], poses[2][1] + poses[2][0] @ anchors[1]]
    reach = float(np.linalg.norm(pins[0] - poses[0][1])) + 1e-9
    if any(np.linalg.norm(np.cross(a, normal)) > 1e-9 for a in axes):
        raise UnsuitableError(f"{name} is not planar: its axes are not parallel.")
    if np.linalg.norm(pins[0] - pins[1]) > 1e-6 * reach:
        raise UnsuitableError(f"{name} is open by {np.linalg.norm(pins[0] - pins[1]):.2g} m at zero angles.")
    # the axis most across the normal: a product with one nearly along it would lose its digits
    # Any basis of the plane will do.
    u = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    u /= np.linalg.norm(u)
    plane = np.stack([u, np.cross(normal, u)])
    a1, a2, b1 = (plane @ origin for _, origin in poses)
    pin = plane @ pins[0]
    return _Measured((first, second, third), a2 - a1, pin - a2, pin - b1, b1 - a1)


def _branch(loop: FourBar, legs: list[_Measured], name: str) -> LoopNumbers:
    """Chooses the assembly that is closed at zero angles."""
    signs = []
    for leg in legs:
        errors = []
        # The cosine rule has two roots, a loop and its mirror image; the rover is in the one that gives zero angles at
        # its reference pose.
        for sign in (1.0, -1.0):
            vectors: Any = {k: tuple(float(c) for c in getattr(leg, k)) for k in "defb"}
            phi = loop._solve(LoopNumbers(leg.senses, **vectors, branch=sign), np.float64(0.0))
            errors.append(max(abs(float(p)) for p in phi))
        # at a dead point both assemblies meet, and which one a rover is in would be decided by rounding
        if abs(errors[0] - errors[1]) < 1e-2:
            raise UnsuitableError(f"{name} is at a dead point at zero angles.")
        signs.append(1.0 if errors[0] < errors[1] else -1.0)
    return loop.numbers._replace(branch=uniform(signs))
