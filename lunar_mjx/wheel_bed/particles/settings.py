"""What a run of the particle bed is: wheel, sand, point, numerics; and the bed and the time that follow from them.

Lengths are scaled by the wheel's radius R and times by sqrt(R/g): without cohesion a slow rigid-plastic sand knows no
other scale, so that one setting serves every wheel and every gravity.
"""

from __future__ import annotations

import dataclasses
import json
import math
from typing import Any

from lunar_mjx.errors import bad_input, require_within

CONTACTS = ("S2", "pic8")
"""Where the wheel touches the sand: at nodes of the grid, which act from a quarter of a voxel outside the wheel, or at
particles, which come closer. Their difference is part of the numerical error."""


@dataclasses.dataclass(frozen=True)
class BoxSize:
    """How large a box a wheel needs."""

    slowest: float = 0.05
    """Least travel speed over the larger of rim and travel speed: below it a wheel digs on the spot, and no steady
    state comes."""
    fewest_voxels: float = 3.0
    """Least voxels across the wheel's width and radius: fewer do not show a wheel."""
    margin: float = 1.6
    """Sand beside, below, before and behind the wheel, in radii. Slip lines of dry sand reach about one radius."""


BOX_SIZE = BoxSize()
SMALLEST_WHEEL, LARGEST_WHEEL = 1e-3, 5.0
"""m: what a log of a test bed may state, and a millimetre."""


@dataclasses.dataclass(frozen=True)
class ParticleWheel:
    """A rigid wheel: radius (without grousers) and width in m, number of grousers and their height in m."""

    radius: float
    width: float
    grouser_count: int = 0
    grouser_height: float = 0.0

    def __post_init__(self) -> None:
        for name in ("radius", "width"):
            require_within("wheel", name, getattr(self, name), SMALLEST_WHEEL, LARGEST_WHEEL)
        require_within("wheel", "grouser_height", self.grouser_height, 0.0, self.radius)
        require_within("wheel", "grouser_count", self.grouser_count, 0, 100)
        # A count without a height would run as a smooth wheel, and its result be kept as one of a wheel with grousers.
        if (self.grouser_count > 0) != (self.grouser_height > 0.0):
            raise bad_input(
                "wheel", "grouser_count", self.grouser_count, "and grouser_height do not agree", "give both or neither"
            )


@dataclasses.dataclass(frozen=True)
class Sand:
    """A cohesive-frictional soil that yields by Drucker and Prager without dilatancy or tension.

    Attributes:
      friction_angle: deg, in plane strain: sqrt(J2) = p sin(phi) + c cos(phi).
      cohesion: c, Pa.
      density: kg/m3.
      wheel_friction: coefficient between wheel and sand.
    """

    friction_angle: float = 35.0
    cohesion: float = 0.0
    density: float = 1600.0
    wheel_friction: float = 0.5

    def __post_init__(self) -> None:
        require_within("sand", "friction_angle", self.friction_angle, 1.0, 60.0)
        require_within("sand", "cohesion", self.cohesion, 0.0, 1e5)
        require_within("sand", "density", self.density, 100.0, 5000.0)
        require_within("sand", "wheel_friction", self.wheel_friction, 0.0, 2.0)

    @property
    def friction(self) -> float:
        """Slope of the yield surface, sqrt(J2) over pressure."""
        return math.sin(math.radians(self.friction_angle))

    @property
    def strength(self) -> float:
        """sqrt(J2) that is borne without pressure, Pa."""
        return self.cohesion * math.cos(math.radians(self.friction_angle))


@dataclasses.dataclass(frozen=True)
class Point:
    """What is imposed: slip ratio as the table defines it, slip angle in deg, load in N, and the two speeds over the
    larger of them."""

    slip_ratio: float
    slip_angle: float
    load: float
    rim: float
    travel: float

    def __post_init__(self) -> None:
        require_within("point", "normal_load_N", self.load, 1e-3, 1e5)
        require_within("point", "slip_angle_deg", self.slip_angle, -90.0, 90.0)
        # Refused and not clipped: the digging wheel sinks as long as it is computed, and any number could come out.
        if self.travel < BOX_SIZE.slowest:
            raise bad_input(
                "point",
                "slip_ratio",
                self.slip_ratio,
                f"leaves a travel speed below {BOX_SIZE.slowest:g} of the rim speed, and no steady state comes",
                "give less slip",
            )


@dataclasses.dataclass(frozen=True)
class Numerics:
    """How finely a run is computed.

    Attributes:
      voxel: edge of a cell of the grid, m.
      per_edge: particles along a voxel's edge.
      contact: one of `CONTACTS`.
      step_share: voxels by which the faster of rim and wheel moves in one time step.
      froude: V^2/(g R) of the faster of rim and travel speed: inertia over weight.
      path: radii by which the faster of rim and wheel moves; least_travel: by which the wheel moves.
      settle: time that the wheel stands under its load before it moves, in sqrt(R/g).
      iterations, tolerance: of the solver in each step.
      seed: of the places of the particles.
    """

    voxel: float
    per_edge: int = 2
    contact: str = "S2"
    step_share: float = 0.15
    froude: float = 0.1
    path: float = 4.0
    least_travel: float = 1.2
    settle: float = 4.0
    iterations: int = 100
    tolerance: float = 1e-5
    seed: int = 0

    def __post_init__(self) -> None:
        require_within("numerics", "voxel", self.voxel, 0.0, above=True)
        # Below, a run takes years, or ends before the wheel has moved.
        require_within("numerics", "step_share", self.step_share, 1e-4, 1.0)
        require_within("numerics", "froude", self.froude, 1e-8, 1.0)
        require_within("numerics", "path", self.path, 0.01, 100.0)
        if self.contact not in CONTACTS:
            raise bad_input("numerics", "contact", self.contact, "does not exist", f"use {' or '.join(CONTACTS)}")


@dataclasses.dataclass(frozen=True)
class BedRun:
    """One wheel in one bed; `variant` says which of the numerics was changed to learn its error."""

    wheel: ParticleWheel
    sand: Sand
    gravity: float
    point: Point
    numerics: Numerics
    variant: str = "table"

    @property
    def key(self) -> str:
        """All that decides the result, as text: equal for equal runs."""
        return json.dumps(self.inputs(), sort_keys=True)

    def inputs(self) -> dict[str, Any]:
        """All that decides the result, as plain data."""
        return {
            # Without `variant`, which is a name: the same numbers under another name are the same run.
            "wheel": dataclasses.asdict(self.wheel),
            "sand": dataclasses.asdict(self.sand),
            "gravity": self.gravity,
            "point": dataclasses.asdict(self.point),
            "numerics": dataclasses.asdict(self.numerics),
        }

    @property
    def speed(self) -> float:
        """The faster of rim and travel speed, m/s."""
        # From Froude's number and not given: slow enough that inertia does not carry the wheel, fast enough to end.
        return math.sqrt(self.numerics.froude * self.gravity * self.wheel.radius)

    @property
    def unit_time(self) -> float:
        """Unit of time sqrt(R/g) of wheel and gravity, s."""
        return math.sqrt(self.wheel.radius / self.gravity)

    @property
    def drive_time(self) -> float:
        """Time for which the wheel moves, s."""
        fast = self.numerics.path * self.wheel.radius / self.speed
        # A slipping wheel moves its rim far and itself little; the sand before it must be fresh all the same.
        return max(fast, self.numerics.least_travel * self.wheel.radius / (self.speed * self.point.travel))

    @property
    def time_step(self) -> float:
        """Time step of the solver, s."""
        # The fastest surface stays within one voxel's neighbourhood a step, or particles would pass through it.
        return self.numerics.step_share * self.numerics.voxel / self.speed

    @property
    def settle_time(self) -> float:
        """Time that the wheel stands, s; half of it the load rises."""
        return self.numerics.settle * self.unit_time

    @property
    def ramp_time(self) -> float:
        """Time in which speeds rise, s."""
        return self.unit_time

    @property
    def steps(self) -> int:
        """Time steps of the run."""
        # Up, so that the last second of driving is whole.
        return math.ceil((self.settle_time + self.ramp_time + self.drive_time) / self.time_step)


@dataclasses.dataclass(frozen=True)
class Layout:
    """A box of sand for each of several runs that are computed together: whole voxels along travel, across and down.

    Attributes:
      cells: number of voxels of one box in x, y, z.
      voxel: m. per_edge: particles along its edge. gap: voxels of wall between boxes.
      start: place of the wheel's centre along the box at the beginning, m.
    """

    cells: tuple[int, int, int]
    voxel: float
    per_edge: int
    start: float
    gap: int = 6

    @property
    def particles(self) -> int:
        """Number of particles in one box."""
        return self.cells[0] * self.cells[1] * self.cells[2] * self.per_edge**3

    @property
    def size(self) -> tuple[float, float, float]:
        """Length, width and depth of the sand, m."""
        return (self.cells[0] * self.voxel, self.cells[1] * self.voxel, self.cells[2] * self.voxel)

    @property
    def pitch(self) -> float:
        """Distance from box to box across, m."""
        return (self.cells[1] + self.gap) * self.voxel


def layout(runs: list[BedRun]) -> Layout:
    """The box that serves every one of these runs.

    Raises:
      UserError: the wheel, or its grousers, are too small for the voxels.
    """
    first = runs[0]
    wheel, voxel = first.wheel, first.numerics.voxel
    least = min(wheel.radius, wheel.width)
    if least < BOX_SIZE.fewest_voxels * voxel:
        raise bad_input(
            "numerics",
            "voxel",
            voxel,
            f"is too coarse for a wheel of radius {wheel.radius:g} m and width {wheel.width:g} m",
            f"give {least / BOX_SIZE.fewest_voxels:.3g} m or less",
        )
    if 0.0 < wheel.grouser_height < voxel:
        raise bad_input(
            "numerics",
            "voxel",
            voxel,
            f"is coarser than the grousers' height of {wheel.grouser_height:g} m, which it does not show",
            f"give {wheel.grouser_height:g} m or less",
        )
    # Grousers shear the sand as far out as they reach: margins count from their tips.
    outer = wheel.radius + wheel.grouser_height
    # The longest way of all: boxes are alike, so that one grid holds them. The ramp's mean speed is half the full one.
    travel = max(r.speed * r.point.travel * (r.drive_time + 0.5 * r.ramp_time) for r in runs)
    length = travel + 2.0 * BOX_SIZE.margin * outer
    width = wheel.width + 2.0 * BOX_SIZE.margin * outer
    # A whole number that rounding has pushed up by a digit gets no voxel more.
    cells = tuple(math.ceil(x / voxel - 1e-9) for x in (length, width, BOX_SIZE.margin * outer))
    return Layout((cells[0], cells[1], cells[2]), voxel, first.numerics.per_edge, BOX_SIZE.margin * outer)


def work(runs: list[BedRun]) -> float:
    """Particles times time steps of runs that are computed together: what they cost, up to a factor."""
    return float(layout(runs).particles * len(runs) * max(r.steps for r in runs))
