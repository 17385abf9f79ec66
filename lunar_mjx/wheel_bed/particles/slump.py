"""Sand without a wheel: how far it settles under its own weight, and the slope on which it comes to rest."""

# pyright: reportMissingImports=false
# (the extra `particles` need not be installed where types are checked)

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from lunar_mjx.wheel_bed.particles.sand_box import add_sand, add_walls, open_device, particle_places, set_sand
from lunar_mjx.wheel_bed.particles.settings import Layout, Sand


@dataclasses.dataclass(frozen=True)
class Slump:
    """How a heap is made and measured."""

    free_falls: float = 8.0
    """Time computed, in sqrt(height/g): the flow of a low column ends after about three (Lajeunesse et al. 2005)."""
    settled: float = 3.0
    """Time computed until sand has settled, in sqrt(depth/g)."""
    step: float = 0.25
    """Voxels that sand in free fall from the surface moves in a step."""
    trim: float = 0.15
    """Share of the height at the slope's foot and at its crest that is left out: both are round."""


SLUMP = Slump()


def settlement(
    sand: Sand, gravity: float, voxel: float, time_step: float, depth: int = 12, device: str = "auto"
) -> float:
    """Depth, m, by which the surface sinks when sand that was strewn at random takes up its weight.

    Wheels are set on the surface as it was strewn: their sinkage reads high by that much.

    Args:
      voxel: m. time_step: s. depth: of the sand in voxels.
      device: as for `open_device`.
    """
    box = Layout((6, 6, depth), voxel, 2, 0.0)
    strewn = particle_places(box, 0)
    after = _left_alone(strewn, box, sand, gravity, open_device(device), SLUMP.settled, time_step)
    # The top layer of voxels: below it sand settles less.
    top = strewn[:, 2] > box.size[2] - voxel
    return float((strewn - after)[top, 2].mean())


def slump_angle(sand: Sand, gravity: float, voxel: float, height: int = 8, device: str = "auto") -> float:
    """Slope, deg, on which a wide column of sand comes to rest after one of its walls is gone, in plane strain.

    Args:
      voxel: m. height: of the column in voxels; it is 1.5 times as long.
      device: as for `open_device`.

    Returns:
      Angle of the straight line through the surface between foot and crest.
    """
    box = Layout((5 * height, 3, height), voxel, 2, 0.0)
    places = particle_places(box, 0)
    column = places[places[:, 0] < 1.5 * height * voxel]
    # By the speed of a fall from the column's height: nothing moves faster.
    time_step = SLUMP.step * voxel / math.sqrt(2.0 * gravity * box.size[2])
    return surface_angle(
        _left_alone(column, box, sand, gravity, open_device(device), SLUMP.free_falls, time_step), voxel
    )


def _left_alone(
    places: np.ndarray, box: Layout, sand: Sand, gravity: float, name: str, duration: float, dt: float
) -> np.ndarray:
    """Places (n, 3), m, of sand after `duration`, in sqrt(depth/g)."""
    import newton
    from newton.solvers import SolverImplicitMPM

    builder = newton.ModelBuilder()
    SolverImplicitMPM.register_custom_attributes(builder)
    add_sand(builder, box, sand, len(places))
    add_walls(builder, box, 1)
    # Newton declares arrays of a model as possibly missing: after `finalize` they are there
    model: Any = builder.finalize(device=name)
    set_sand(model, sand, gravity)
    model.particle_q.assign(places)
    state = model.state()
    config = SolverImplicitMPM.Config()
    config.voxel_size, config.max_iterations, config.tolerance = box.voxel, 100, 1e-5
    solver: Any = SolverImplicitMPM(model, config=config)
    for _ in range(math.ceil(duration * math.sqrt(box.size[2] / gravity) / dt)):
        solver.step(state, state, None, None, dt)
    return state.particle_q.numpy().astype(float)


def surface_angle(places: np.ndarray, voxel: float) -> float:
    """Slope, deg, of a heap that falls along x: a line through the tops of columns one voxel wide.

    Args:
      places: of its particles (n, 3), m.
      voxel: width of a column, m.
    """
    column = np.floor(places[:, 0] / voxel).astype(int)
    top = np.array([places[column == k, 2].max() if (column == k).any() else 0.0 for k in range(column.max() + 1)])
    # Tops of columns and not a cloud's outline: single grains that rolled off do not count as slope.
    middle = (np.arange(len(top)) + 0.5) * voxel
    crest = top.max()
    slope = (top > SLUMP.trim * crest) & (top < (1.0 - SLUMP.trim) * crest)
    return float(np.degrees(np.arctan(-np.polyfit(middle[slope], top[slope], 1)[0])))
