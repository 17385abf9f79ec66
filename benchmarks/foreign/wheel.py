"""A wheel on a test bed: sinks until the soil bears its load, and is pulled, pushed aside and braked by it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from .laws import LAWS, Rim
from .misfit import Field, coordinates

NODES = 10
"""Gauss points on either side of theta_m; 40 change no force by 4e-4 of the load and no sinkage by 0.3 %."""
DEEPEST = 0.9
"""Largest sinkage looked at, over the radius."""


class Rows(NamedTuple):
    """What a test bed imposes in truth; one entry per row.

    Attributes:
      slip: 1 - v_x/(r omega) driving, r omega/v_x - 1 braking, with v_x = V cos(angle) and the stated radius.
      angle: slip angle, rad. load: N. travel: V, m/s. gravity: m/s2.
    """

    slip: np.ndarray
    angle: np.ndarray
    load: np.ndarray
    travel: np.ndarray
    gravity: np.ndarray


@dataclasses.dataclass(frozen=True)
class World:
    """A wheel, a soil and what else acts.

    Attributes:
      law: of `LAWS`. radius, width: stated of the wheel, m.
      soil: constants of the law. traits: further choices of the base law, among them theta_m = (c1 + c2 s) theta_1 and
        theta_2 = -(c3 + c4 s) theta_1, `circle` (share of a common shear strength), `skid` (contact time of a braked
        wheel counted in full).
      fields: misfits of pressure, shear forward and shear across.
      middle_load: N, about which misfits and laws of the load are scaled.
      effects: what is hidden: name -> amounts.
    """

    law: str
    radius: float
    width: float
    soil: Mapping[str, float]
    traits: Mapping[str, float]
    fields: tuple[Field, Field, Field] | None
    middle_load: float
    effects: Mapping[str, Mapping[str, float]]

    def has(self, name: str) -> Mapping[str, float] | None:
        """Amounts of a hidden effect, or None."""
        return self.effects.get(name)


class Forces(NamedTuple):
    """What the wheel bears and gives; N and N m, one entry per row. `side` opposes a positive slip angle."""

    lift: np.ndarray
    drawbar: np.ndarray
    side: np.ndarray
    torque: np.ndarray


class Result(NamedTuple):
    """Measurements of a perfect test bed, SI units; `reached` is false where the soil cannot bear the load."""

    drawbar_pull: np.ndarray
    side_force: np.ndarray
    driving_torque: np.ndarray
    sinkage: np.ndarray
    reached: np.ndarray


class Motion(NamedTuple):
    """How a wheel of true size moves: slip, v_x/(r omega), v_y/(r omega), rim and forward speed, radius; SI units."""

    slip: np.ndarray
    turn: np.ndarray
    aside: np.ndarray
    rim: np.ndarray
    along: np.ndarray
    radius: np.ndarray


_SLOWEST = 0.03
"""Least rim speed over travel speed: a locked wheel's contact would have no end."""


def motion(world: World, rows: Rows) -> Motion:
    """Speeds and slip of the wheel as large as it truly is."""
    along, across = rows.travel * np.cos(rows.angle), rows.travel * np.sin(rows.angle)
    rim = np.where(rows.slip >= 0.0, along / np.maximum(1.0 - rows.slip, 0.02), along * (1.0 + rows.slip))
    radius = np.full_like(rim, world.radius)
    if e := world.has("wheel_radius_error"):
        radius = radius + e["offset"]
    if e := world.has("soft_tyre"):
        radius = radius * (1.0 - e["share"] * rows.load / world.middle_load)
    rim = np.maximum(rim * radius / world.radius, _SLOWEST * rows.travel)
    slip = np.where(rim >= along, 1.0 - along / rim, rim / np.maximum(along, 1e-12) - 1.0)
    turn, aside = along / rim, across / rim
    if world.traits.get("skid", 1.0) == 0.0 and not world.has("skid_shear"):
        # Eq. 8 refers the braked wheel's slip to v_x: its soil is under it for the way travelled, not for its turning.
        turn = np.where(slip < 0.0, 1.0 - slip, turn)
        aside = np.where(slip < 0.0, (1.0 - slip) * np.tan(rows.angle), aside)
    return Motion(slip, turn, aside, rim, along, radius)


def sliding(moves: Motion, rows: Rows) -> np.ndarray:
    """Speed at which the rim slides over the soil, over the larger of rim and travel speed."""
    across = rows.travel * np.sin(rows.angle)
    return np.hypot(moves.rim - moves.along, across) / np.maximum(moves.rim, rows.travel)


def softening(world: World, rows: Rows, moves: Motion) -> tuple[np.ndarray, np.ndarray]:
    """Growth of the sinkage exponent and divisor of the stiffness, shape (row, 1)."""
    growth, softer = np.zeros_like(moves.slip), np.ones_like(moves.slip)
    if e := world.has("slip_sinkage"):
        if "driving" in e:  # Ding et al. 2010
            growth = growth + np.where(moves.slip >= 0.0, e["driving"] * moves.slip, -e["skid"] * moves.slip)
        else:  # Lyasko 2010: sinkage grows by (1 + s)/(1 - s/2)
            s = np.abs(moves.slip)
            softer = softer * ((1.0 + s) / (1.0 - 0.5 * s)) ** e["lyasko"]
    if e := world.has("angle_sinkage"):
        across = np.abs(rows.travel * np.sin(rows.angle)) / np.maximum(moves.rim, rows.travel)
        growth = growth + e["lateral"] * (np.hypot(moves.slip, across) - np.abs(moves.slip))
    if e := world.has("slide_softening"):
        softer = softer * (1.0 + e["softening"] * sliding(moves, rows))
    if e := world.has("creep_stiffness"):
        softer = softer / (1.0 + e["per_decade"] * np.log10(rows.travel / 0.02))
    if world.law == "granular":
        softer = softer * 9.80665 / rows.gravity  # stress of grains is proportional to gravity
    return growth[:, None], softer[:, None]


def soil_of(world: World, rows: Rows, moves: Motion) -> dict[str, Any]:
    """Constants of the soil, those that effects change as (row, 1)."""
    soil: dict[str, Any] = dict(world.soil)
    if e := world.has("rate_friction"):
        slides = np.maximum(sliding(moves, rows) * np.maximum(moves.rim, rows.travel), 1e-4)
        more = 1.0 + e["per_decade"] * np.log10(slides / 0.02)
        soil["friction_angle"] = np.arctan(np.tan(soil["friction_angle"]) * np.maximum(more, 0.1))[:, None]
    if e := world.has("gravity_soil"):
        less = rows.gravity / 9.80665
        if "reece_phi" in soil:
            soil["reece_phi"] = (soil["reece_phi"] * less ** e["stiffness"])[:, None]
            soil["reece_c"] = (soil["reece_c"] * less ** e["cohesion"])[:, None]
            soil["cohesion"] = (soil["cohesion"] * less ** e["cohesion"])[:, None]
    if e := world.has("curved_envelope"):
        soil |= {"envelope": e["power"], "envelope_pressure": e["pressure"]}
    if e := world.has("hard_layer"):
        soil |= {"hard_modulus": e["modulus"], "hard_depth": e["depth"] * world.radius}
    if e := world.has("peak_shear"):
        soil["peak"] = e["height"]
    if e := world.has("cohesion_lost"):
        soil["cohesion_way"] = e["ways"] * soil["shear_x"]
    return soil


_GAUSS, _GAUSS_WEIGHT = np.polynomial.legendre.leggauss(NODES)


_LONG, _LONG_WEIGHT = np.polynomial.legendre.leggauss(2 * NODES)


class Settled(NamedTuple):
    """What does not change while a wheel sinks.

    Attributes:
      rows: as imposed. moves: how the wheel moves. soil: constants. growth, softer: see `softening`.
      lowest, leave: where pressure is largest and where contact ends, over the entry angle. place, weight: nodes and
        their weights, over the entry angle. misfit: factors of pressure, shear forward and across at each node.
    """

    rows: Rows
    moves: Motion
    soil: dict[str, Any]
    growth: np.ndarray
    softer: np.ndarray
    lowest: np.ndarray
    leave: np.ndarray
    place: np.ndarray
    weight: np.ndarray
    misfit: tuple[np.ndarray | float, ...]


def settle(world: World, rows: Rows) -> Settled:
    """Everything about `rows` that is the same at every sinkage."""
    moves = motion(world, rows)
    slip, t = moves.slip[:, None], dict(world.traits)
    if e := world.has("exit_angle"):
        t |= e
    lowest = np.clip(t.get("c1", 0.5) + t.get("c2", 0.0) * slip, 0.05, 0.95)
    leave = -np.clip(t.get("c3", 0.0) + t.get("c4", 0.0) * slip, 0.0, 0.95)
    spans = [(leave, lowest), (lowest, np.ones_like(slip))]
    place = np.concatenate([0.5 * (a + b) + 0.5 * (b - a) * _GAUSS for a, b in spans], axis=1)
    weight = np.concatenate([0.5 * (b - a) * _GAUSS_WEIGHT for a, b in spans], axis=1)
    if world.law == "granular":
        # Faces behind the lowest point recede.
        lowest, leave = np.full_like(slip, 0.02), np.zeros_like(slip)
        place, weight = 0.5 * (1.0 + _LONG) + 0.0 * slip, 0.5 * _LONG_WEIGHT + 0.0 * slip
    misfit: tuple[np.ndarray | float, ...] = (1.0, 1.0, 1.0)
    if world.fields is not None:
        x = coordinates(slip, rows.angle[:, None], (rows.load / world.middle_load)[:, None], place)
        misfit = tuple(1.0 + f(x) for f in world.fields)
    return Settled(
        rows, moves, soil_of(world, rows, moves), *softening(world, rows, moves), lowest, leave, place, weight, misfit
    )


def contact(settled: Settled, sinkage: np.ndarray) -> Rim:
    """Nodes along the contact of a wheel that has sunk."""
    moves = settled.moves
    entry = np.arccos(np.clip(1.0 - sinkage / moves.radius, -0.99, 1.0))[:, None]
    return Rim(
        moves.radius[:, None],
        entry,
        settled.lowest * entry,
        settled.leave * entry,
        settled.place * entry,
        settled.weight * entry,
        moves.turn[:, None],
        moves.aside[:, None],
        moves.slip[:, None],
        moves.rim[:, None],
        settled.rows.angle[:, None],
    )


def forces(world: World, settled: Settled, sinkage: np.ndarray) -> Forces:
    """What soil, misfit and hidden effects do to a wheel that has sunk by `sinkage` (m)."""
    rows, moves, soil = settled.rows, settled.moves, settled.soil
    rim = contact(settled, sinkage)
    grousers = world.has("grousers") or {"height": 0.0, "count": 0.0}
    shear_radius = 1.0 + grousers["height"] / world.radius
    stronger = min(1.0 + grousers["count"] * grousers["height"] / (2.0 * np.pi * world.radius), 1.5)
    circle = world.traits.get("circle", 0.0) if not (e := world.has("friction_circle")) else e["share"]
    loss = e["loss"] if (e := world.has("shear_softening")) else 0.0
    pressure, ahead, left = LAWS[world.law](
        rim, world.width, soil, settled.growth, settled.softer, circle, shear_radius, loss
    )
    if e := world.has("side_entry"):
        pressure = pressure * _from_the_side(rim, world.width, soil["exponent"], e["kept"])
    if e := world.has("side_exit"):
        aside = np.abs(rows.travel * np.sin(rows.angle)) / np.maximum(moves.rim, rows.travel)
        pressure = pressure * np.where(rim.theta < 0.0, 1.0 - e["lost"] * aside[:, None], 1.0)
    pressure = pressure * settled.misfit[0]
    ahead, left = ahead * stronger * settled.misfit[1], left * stronger * settled.misfit[2]
    area = (moves.radius * world.width)[:, None] * rim.weight
    sine, cosine = np.sin(rim.theta), np.cos(rim.theta)
    lift = np.sum(area * (pressure * cosine + ahead * shear_radius * sine), axis=1)
    pull = np.sum(area * (-pressure * sine + ahead * shear_radius * cosine), axis=1)
    side = -np.sum(area * left, axis=1)
    torque = np.sum(area * ahead * shear_radius**2 * moves.radius[:, None], axis=1)
    return _more(world, rows, moves, rim, soil, sinkage, Forces(lift, pull, side, torque))


def _from_the_side(rim: Rim, width: float, exponent: float, kept: float) -> np.ndarray:
    """Factor of the pressure, mean over the width: soil that entered below the surface is pressed only since."""
    x = rim.radius * np.sin(rim.theta)
    depth = np.maximum(rim.radius * (np.cos(rim.theta) - np.cos(rim.entry)), 1e-12)
    front = rim.radius * np.sin(rim.entry)
    tangent = np.maximum(np.abs(np.tan(rim.angle)), 1e-9)
    total = np.zeros_like(x)
    places = (np.arange(5) + 0.5) / 5.0
    for y in places * width:
        enters = np.minimum(x + y / tangent, front)
        inside = np.sqrt(np.maximum(rim.radius**2 - enters**2, 0.0)) - rim.radius * np.cos(rim.entry)
        fresh = depth - (1.0 - kept) * np.maximum(inside, 0.0)
        total = total + np.maximum(fresh / depth, 0.0) ** exponent
    return total / len(places)


def _more(
    world: World, rows: Rows, moves: Motion, rim: Rim, soil: Mapping[str, Any], sinkage: np.ndarray, f: Forces
) -> Forces:
    """Forces that act beside the stresses on the rim."""
    lift, pull, side, torque = f
    heading = np.sign(rows.angle)
    if e := world.has("bulldozing"):  # Hegedus 1960 by Ishigami et al. 2007
        phi = world.soil["friction_angle"]
        weight, c = e["density"] * rows.gravity, world.soil["cohesion"]
        cut = np.pi / 4.0 - phi / 2.0
        d1 = 1.0 / np.tan(cut) + np.tan(cut + phi)
        d2 = 1.0 / np.tan(cut) + np.tan(phi) / np.tan(cut) ** 2
        rolled = np.clip(moves.along / moves.rim, 0.0, 1.0)
        pull = pull - e["front"] * world.width * rolled * (d1 * c * sinkage + 0.5 * d2 * weight * sinkage**2)
        h, dx = _flank(rim)
        wedge = np.sum((d1 * c * h + 0.5 * d2 * weight[:, None] * h**2) * dx, axis=1)
        side = side + e["side"] * heading * wedge * (1.0 - np.exp(-np.abs(np.tan(rows.angle)) * 5.0))
    if e := world.has("side_wall"):  # Coulomb's passive wedge on the leading flank, rubbed by the wheel's turning
        phi, c = world.soil["friction_angle"], world.soil["cohesion"]
        passive = np.tan(np.pi / 4.0 + phi / 2.0) ** 2
        h, dx = _flank(rim)
        weight = e["density"] * rows.gravity[:, None]
        push = e["pressure"] * (0.5 * passive * weight * h**2 + 2.0 * c * np.sqrt(passive) * h)
        push = np.sum(push * dx, axis=1) * (1.0 - np.exp(-np.abs(np.tan(rows.angle)) * 5.0))
        arm = moves.radius - sinkage / 3.0
        slide = (moves.along - moves.rim * arm / moves.radius) / np.maximum(moves.rim, rows.travel)
        rub = np.tan(2.0 * phi / 3.0) * push * slide / np.sqrt(slide**2 + np.sin(rows.angle) ** 2 + 1e-4)
        side, pull, torque = side + heading * push, pull - rub, torque - rub * arm
    if e := world.has("rolling_resistance"):
        torque = torque + e["coefficient"] * moves.radius * rows.load
    if e := world.has("rear_lift"):  # soil that a spinning rim carries up behind it hangs on it
        carried = e["density"] * rows.gravity * world.width * moves.radius * sinkage * np.maximum(moves.slip, 0.0)
        lift, torque = lift - carried, torque + 0.7 * carried * moves.radius
    if e := world.has("bearing_side_load"):
        torque = torque + e["arm"] * moves.radius * np.abs(side)
    if e := world.has("bed_wall"):  # the far wall of the bed stiffens what is pushed aside
        side = side * (1.0 + e["stiffer"] * np.sin(rows.angle) ** 2 * sinkage / moves.radius / 0.1)
    return Forces(lift, pull, side, torque)


def _flank(rim: Rim) -> tuple[np.ndarray, np.ndarray]:
    """Depth of the leading flank below the surface, m, and length of the ground along it, at 12 places."""
    at, weight = np.polynomial.legendre.leggauss(12)
    half = rim.radius * np.sin(rim.entry)
    h = np.sqrt(np.maximum(rim.radius**2 - (half * at) ** 2, 0.0)) - rim.radius * np.cos(rim.entry)
    return np.maximum(h, 0.0), half * weight


STEPS = 60
"""Steps of the root of the vertical balance, of which bisections alone reach 1e-12 of the radius in 40."""


def run(world: World, rows: Rows) -> Result:
    """What a perfect test bed measures.

    The sinkage is the root of the vertical balance between 1e-6 and 0.9 radii, by bisection with a secant step in
    every second try (regula falsi, Illinois).
    """
    settled = settle(world, rows)
    low, high = 1e-6 * settled.moves.radius, DEEPEST * settled.moves.radius
    at_low = forces(world, settled, low).lift - rows.load
    at_high = forces(world, settled, high).lift - rows.load
    reached = (at_high > 0.0) & (at_low < 0.0)
    root = high
    for step in range(STEPS):
        root = 0.5 * (low + high) if step % 3 == 2 else high - at_high * (high - low) / (at_high - at_low)
        root = np.where(np.isfinite(root), np.clip(root, low, high), 0.5 * (low + high))
        value = forces(world, settled, root).lift - rows.load
        below = value < 0.0
        # Illinois: the end that stays counts half.
        at_high = np.where(below, 0.5 * at_high, value)
        at_low = np.where(below, value, 0.5 * at_low)
        low, high = np.where(below, root, low), np.where(below, high, root)
        if np.all((np.abs(value) <= 1e-9 * rows.load) | (high - low <= 1e-13) | ~reached):
            break
    found = forces(world, settled, root)
    return Result(found.drawbar, found.side, found.torque, root, reached)
