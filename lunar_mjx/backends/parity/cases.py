"""What the engines are compared on: grounds of one grid, a drive, and a tolerance for every quantity."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import jax
import numpy as np

from lunar_mjx.dynamics.kinematics import wheel_feet
from lunar_mjx.model import Model
from lunar_mjx.pytree import tree_of
from lunar_mjx.rover import Rover
from lunar_mjx.simulate import Commands, constant_commands
from lunar_mjx.terrain import HeightField, SoilMap, Terrain, stack
from lunar_mjx.terrain.rocks import build_rocks


@dataclasses.dataclass(frozen=True)
class ParityGrid:
    """The grid of the terrain on which engines are compared."""

    half: float = 20.0
    """Half its side, m."""
    cell: float = 0.25
    """Spacing of its nodes, m."""


PARITY_GRID = ParityGrid()


@dataclasses.dataclass(frozen=True)
class Case:
    """One terrain of the parity study, and how it is driven on."""

    name: str
    terrain: Terrain


@dataclasses.dataclass(frozen=True)
class Tolerance:
    """An error counts as |a - b|/(absolute + relative |a|); above 1 the engines disagree."""

    absolute: float
    relative: float


def cases(rover: Rover, names: Collection[str] | None = None) -> list[Case]:
    """Grounds of the parity study, all with the same grids, so that an engine compiles once for all of them.

    Args:
      rover: boulders lie in front of its front wheels, and one that its chassis strikes.
      names: of those to keep, all if None.
    """
    half = round(PARITY_GRID.half / PARITY_GRID.cell)
    at = np.arange(-half, half + 1) * PARITY_GRID.cell
    x, y = at[None, :], at[:, None]
    level = np.zeros((len(at), len(at)))
    slope = np.tan(np.deg2rad(8.0)) * (0.8 * x + 0.6 * y)
    distance = np.hypot(x - 3.0, y + 0.3) / 2.5
    bowl = np.where(distance < 1.0, -0.45 * (1.0 - distance**2) ** 2, 0.0)
    crater = bowl + 0.06 * np.exp(-(((distance - 1.0) / 0.15) ** 2))
    grounds = {
        "flat, soft": (level, 0.0, None),
        "flat, hard": (level, 1.0, None),
        "slope, soft": (slope, 0.0, None),
        "slope, hard": (slope, 1.0, None),
        "crater, soft": (crater, 0.0, None),
        "crater, hard": (crater, 1.0, None),
        "boulders, soft": (level, 0.0, _stones(rover)),
    }
    made = [_terrain(name, at, *ground) for name, ground in grounds.items()]
    alike = stack(made)
    out = [
        Case(name, dataclasses.replace(jax.tree.map(lambda a, i=i: a[i], alike), name=name))
        for i, name in enumerate(grounds)
    ]
    return [case for case in out if names is None or case.name in names]


def _stones(rover: Rover) -> np.ndarray:
    """Centre and radius of boulders: one for each front wheel, and one a little higher than the chassis' belly."""
    compiled = rover.compile()
    feet = wheel_feet(
        compiled, np.array([compiled.body(w.body).id for w in rover.wheels]), compiled.body(rover.chassis).id
    )
    size = rover.wheels[0].radius
    front = [(*feet[i, :2], w.corner) for i, w in enumerate(rover.wheels) if w.row == "front"]
    stones = [[x + 1.7 * size + (0.2 if corner == "rf" else 0.0), y, -0.1 * size, 0.4 * size] for x, y, corner in front]
    belly = rover.standing_height + float(rover.chassis_points[:, 2].min())
    nose = float(rover.chassis_points[rover.chassis_points[:, 2].argmin(), 0])
    return np.array([*stones, [abs(nose) + 0.8 + belly, 0.05, -0.1 * belly, 1.15 * belly]])


def _terrain(name: str, at: np.ndarray, heights: np.ndarray, hard: float, stones: np.ndarray | None) -> Terrain:
    x0, cell, wide = (np.asarray(v, np.float32) for v in (at[0], PARITY_GRID.cell, PARITY_GRID.half))
    placed = np.zeros((0, 4)) if stones is None else stones
    rocks = build_rocks(
        placed[:, :3], placed[:, 3], (-PARITY_GRID.half, -PARITY_GRID.half, PARITY_GRID.half, PARITY_GRID.half)
    )
    field = tree_of(HeightField, heights=np.asarray(heights, np.float32), x0=x0, y0=x0, cell=cell)
    soil = tree_of(SoilMap, rock=np.full((3, 3), hard, np.float32), x0=x0, y0=x0, cell=wide)
    return tree_of(Terrain, field=field, rocks=rocks, soil=soil, origin=np.zeros(3, np.float32), name=name)


def drive(model: Model, duration: float) -> Commands:
    """A drive with changes: off, ahead, a turn to the left and to the right, suspension moved, braking."""
    commands = constant_commands(model, duration)
    time = np.arange(len(commands.values)) * commands.interval / duration
    values = np.zeros_like(commands.values)
    for joint, (group, name) in enumerate((g, j) for g in model.rover.groups for j in g.joints):
        wheel = next((w for w in model.rover.wheels if name in (w.drive, w.steer, w.suspension)), None)
        front = wheel is not None and wheel.row == "front"
        if group.name == "drive":
            radius = model.rover.wheels[0].radius
            values[:, joint] = 0.1 / radius * np.clip(8.0 * (time - 0.05), 0.0, 1.0) * (time < 0.9)
        elif group.name == "steer":
            turn = 0.25 * np.sin(2.0 * np.pi * np.clip((time - 0.25) / 0.6, 0.0, 1.0))
            values[:, joint] = turn if front else -0.5 * turn
        elif front:
            values[:, joint] = 0.06 * np.sin(2.0 * np.pi * np.clip((time - 0.4) / 0.3, 0.0, 1.0))
    return Commands(values, commands.interval)


QUANTITIES: dict[str, tuple[str, float]] = {
    "wheel_position": ("m", 1.0),
    "wheel_velocity": ("m/s", 0.1),
    "slip": ("1", 1.0),
    "slip_angle": ("rad", 1.0),
    "sinkage": ("m", 0.01),
    "wheel_force": ("N", 10.0),
    "wheel_moment": ("N m", 1.0),
    "joint_torque": ("N m", 10.0),
    "current": ("A", 1.0),
    "winding_heat": ("W", 1.0),
    "housing_heat": ("W", 0.1),
    "acceleration": ("m/s2, rad/s2", 10.0),
    "position": ("m", 1.0),
    "orientation": ("rad", 1.0),
    "joint_angle": ("rad", 1.0),
    "velocity": ("m/s, rad/s", 0.1),
    "joint_speed": ("rad/s", 1.0),
    "winding_temperature": ("K", 1.0),
    "housing_temperature": ("K", 1.0),
    "shear_state": ("1", 1.0),
}
"""Unit and typical size of every compared quantity."""

SOFT_LOOP = "soft loop"

RELATIVE = {"float64": 1e-9, "pybullet": 5e-6, "float32": 5e-4, SOFT_LOOP: 1e-5}
"""Relative tolerance by what separates two engines: float64 rounding through the equations; PyBullet, which integrates
about the chassis' centre of mass, so that its frame is off by omega^2 r dt^2/2 after a step (1.6e-8 m at 0.3 rad/s;
poses, slip and forces of one state agree to rounding); float32; and in drives MuJoCo's loops, which give way, against
loops closed exactly."""

SOFT_STEP = {
    "acceleration": 0.1,
    "velocity": 1e-3,
    "joint_speed": 0.02,
    "position": 1e-6,
    "orientation": 1e-6,
    "joint_angle": 1e-4,
}
"""Relative tolerances of the quantities that a soft loop changes within a step that starts with closed loops; all
others must agree as if there were no loop.

Two causes, measured on VIPER apart from each other: MuJoCo damps the joints implicitly after it has solved for the
loops' forces, the other engines within (2.9, 1.5 and 0.74 rad/s2 at time steps of 2, 1 and 0.5 ms, of a light pivot's
66 rad/s2), and its constraint gives way (see `COMPLIANCE` in parity_record.py)."""

EXCEPTIONS: dict[str, dict[str, float]] = {
    # omega^2 r dt^2/2 as a speed: 3e-4 m/s2 and 5e-7 m/s where a rover that sets off jerks (drives of 1 s)
    "pybullet": {"acceleration": 2e-4, "velocity": 4e-5},
    # a height of some metres in float32 is off by 2e-7 m: 0.05 N on rock of 2e5 N/m
    "float32": {"wheel_force": 5e-3, "wheel_moment": 5e-3, "acceleration": 1e-2, "slip": 2e-3},
}
"""Quantities with another relative tolerance."""

DRIVE_EXCEPTIONS: dict[str, dict[str, float]] = {
    # omega^2 r dt^2/2 as a speed: 3e-4 m/s2 and 5e-7 m/s where a rover that sets off jerks (drives of 1 s)
    "pybullet": {"acceleration": 2e-4, "velocity": 4e-5},
    # VIPER chatters on a slope of rock until it drives and PyBullet's comes to rest elsewhere, 6e-5 m away: slip then
    # differs by up to 0.022 and a drive's torque by up to 0.8 N m of 278. Started from the reference's state after
    # that, its slip stays within 8e-6 of the reference with stiff loops damped within.
    f"pybullet, {SOFT_LOOP}": {"slip": 2e-3, "joint_torque": 4e-3},
}
"""Quantities with another relative tolerance in drives, by all that separates two engines."""
