"""Images per second: depth and height images in JAX by batch and size, and MuJoCo's renderer beside them.

    python benchmarks/cameras.py --batches 256,1024,4096 --out benchmarks/cameras_gpu.json
    python benchmarks/cameras.py --batches 4,16 --sizes 32x24 --repeats 1 --out cameras_cpu.json

A row of the JAX cameras counts only where `median_error` is there: the depth of one picture of the same size against
MuJoCo's renderer in the same process. Without OpenGL that column is null, and there is no row of the renderer.
"""

from __future__ import annotations

import argparse
import json
import platform
import time
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.cameras import Pinhole, RoverCamera, depth_image, depth_images, front_mount, height_scan, mounted
from lunar_mjx.dynamics import build
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model

TOLERANCE = 0.01
"""Largest median error of a depth image against the renderer's."""


def seconds(function: Any, repeats: int) -> tuple[float, float]:
    """Time of the first call, and mean time of those that follow."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    first = time.perf_counter() - start
    start = time.perf_counter()
    for _ in range(repeats):
        jax.block_until_ready(function())
    return first, (time.perf_counter() - start) / repeats


def spread(model: Model, count: int) -> jax.Array:
    """Coordinates of rovers on a spiral over the middle of the terrain."""
    system = build(model)
    turn = jnp.arange(count) * 2.4
    reach = 15.0 * jnp.sqrt((jnp.arange(count) + 0.5) / count)
    reset = jax.jit(jax.vmap(lambda x, y, yaw: system.reset(system.params, x, y, yaw).qpos))
    return reset(reach * jnp.cos(turn), reach * jnp.sin(turn), turn)


def renderer_rows(model: Model, sizes: list[Pinhole], qpos: np.ndarray, repeats: int) -> list[dict]:
    """MuJoCo's renderer, one rover at a time: pictures per second, and the depth images for comparison."""
    rows = []
    for camera in sizes:
        try:
            with RoverCamera(model.rover, model.terrain, qpos[None, :2], camera) as eye:
                eye.place(qpos)
                _, each = seconds(eye.front, max(3, repeats))
                rows.append(
                    {
                        "kind": "renderer: rgba, depth, segmentation",
                        "size": [camera.width, camera.height],
                        "batch": 1,
                        "images_per_s": 1.0 / each,
                        "depth": eye.front().depth,
                    }
                )
        except UserError as missing:
            print(missing)
            return []
    return rows


def main() -> None:
    """Prints a row each and writes them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rover", default="viper")
    parser.add_argument("--terrain", default="lunar_plain")
    parser.add_argument("--batches", default="256,1024,4096")
    parser.add_argument("--sizes", default="64x48,160x120,320x240")
    parser.add_argument("--scan", default="32x32", help="rows and columns of the height images")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--pixels", type=int, default=80_000_000, help="largest number of pixels at once")
    parser.add_argument("--out", type=Path, default=Path("cameras.json"))
    given = parser.parse_args()
    model = make_model(given.rover, given.terrain)
    sizes = [Pinhole(*map(int, s.split("x"))) for s in given.sizes.split(",")]
    batches = [int(b) for b in given.batches.split(",")]
    qpos = spread(model, max(batches))
    drawn = renderer_rows(model, sizes, np.asarray(qpos[0], float), given.repeats)
    position, rotation = jax.jit(partial(mounted, front_mount(model.rover)))(qpos)
    terrain = jax.device_put(model.terrain)
    rows: list[dict] = [{k: v for k, v in row.items() if k != "depth"} for row in drawn]
    for k, camera in enumerate(sizes):
        error = None
        if drawn:
            one = np.asarray(jax.jit(partial(depth_image, camera=camera))(terrain, position[0], rotation[0]))
            both = np.isfinite(one) & np.isfinite(drawn[k]["depth"])
            error = float(np.median(np.abs(one[both] / drawn[k]["depth"][both] - 1.0)))
            if error > TOLERANCE:
                raise SystemExit(f"{camera.width} x {camera.height}: median error {error:.3g} is above {TOLERANCE}")
        for batch in batches:
            at_once = max(1, min(batch, given.pixels // (camera.width * camera.height)))
            look = jax.jit(partial(depth_images, camera=camera, at_once=at_once if at_once < batch else None))
            first, each = seconds(partial(look, terrain, position[:batch], rotation[:batch]), given.repeats)
            rows.append(
                {
                    "kind": "depth, JAX",
                    "size": [camera.width, camera.height],
                    "batch": batch,
                    "images_per_s": batch / each,
                    "first_call_s": first,
                    "median_error": error,
                }
            )
    shape = tuple(int(n) for n in given.scan.split("x"))
    for batch in batches:
        scan = jax.jit(partial(height_scan, shape=shape))
        yaw = jnp.zeros(batch)
        first, each = seconds(partial(scan, terrain, qpos[:batch, :3], yaw), given.repeats)
        rows.append(
            {
                "kind": "height scan, JAX",
                "size": list(shape[::-1]),
                "batch": batch,
                "images_per_s": batch / each,
                "first_call_s": first,
            }
        )
    device = jax.devices()[0]
    about = {
        "rover": given.rover,
        "terrain": given.terrain,
        "device": device.device_kind,
        "jax": jax.__version__,
        "processor": platform.processor() or platform.machine(),
        "repeats": given.repeats,
    }
    for row in rows:
        print(
            f"{row['kind']:36} {row['size'][0]:4} x {row['size'][1]:<4} batch {row['batch']:6}: "
            f"{row['images_per_s']:12,.1f} images/s"
        )
    given.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
