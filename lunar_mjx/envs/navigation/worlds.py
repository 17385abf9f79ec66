"""Large rough terrains on which many rovers train side by side, and others, never trained on, to test them."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

from lunar_mjx.errors import bad_input
from lunar_mjx.terrain import Terrain, load_terrain
from lunar_mjx.terrain.rocks import padded

PREFIX = "world:"
_ROCKS = 512
"""Numbers of rocks are filled up to a multiple of this, so that worlds of like abundance share one program."""


_ROVER_SIZED = {"abundance": 0.035, "smallest": 0.25, "largest": 1.2, "gap": 1.6}
_BOULDERS = {"abundance": 0.07, "smallest": 0.5, "largest": 2.4, "gap": 3.2}
"""Rocks for a small rover, and rocks of twice the size for one twice as large, with the share of ground that they
cover about the same (0.8 and 0.9 %)."""


def _world(
    seed: int,
    deviation: float,
    density: float,
    deepest: float,
    abundance: float,
    extent: float,
    rocks: dict[str, float] = _ROVER_SIZED,
) -> Any:
    return {
        "seed": seed,
        "surface": {
            "width": extent,
            "height": extent,
            "cell": 0.1,
            "roughness": {"hurst": 0.8, "deviation": deviation, "baseline": 1.0},
            "craters": {"smallest": 0.5, "largest": 20.0, "density": density, "shallowest": 0.02, "deepest": deepest},
        },
        "rocks": {**rocks, "abundance": abundance},
    }


WORLDS: dict[str, dict[str, Any]] = {
    "train": _world(101, 0.022, 0.05, 0.10, 0.035, 160.0),
    "heldout": _world(977, 0.025, 0.06, 0.11, 0.035, 160.0),
    "mild": _world(31, 0.015, 0.02, 0.06, 0.01, 80.0),
    "train_boulders": _world(101, 0.022, 0.05, 0.10, 0.07, 160.0, _BOULDERS),
    "heldout_boulders": _world(977, 0.025, 0.06, 0.11, 0.07, 160.0, _BOULDERS),
}
"""Tables as of a `terrain.toml`. `train` and `heldout` share their size, so that one compiled program runs on both;
the held-out ground is another draw, rougher and with more and deeper craters, and has rocks in other places. The two
with boulders are the same grounds with rocks of twice the size at twice the distance, obstacles for VIPER too."""


@functools.cache
def world(name: str) -> Terrain:
    """The world called `name`; made on the host, once per process.

    Raises:
      UserError: there is no such world.
    """
    if name not in WORLDS:
        known = ", ".join(PREFIX + w for w in WORLDS)
        raise bad_input("navigation", "terrain", PREFIX + name, "does not exist", f"use one of {known}, or a terrain")
    terrain = load_terrain(WORLDS[name])
    rocks = terrain.rocks
    if rocks is None:
        return terrain
    # Shapes decide what is compiled.
    return dataclasses.replace(terrain, rocks=padded(rocks, -len(rocks.radii) % _ROCKS))
