"""Images per second: pictures, depth and height images in JAX by batch and size, and MuJoCo's renderer beside them.

    python benchmarks/cameras.py --batches 4,16 --sizes 64x48,320x240 --repeats 2 --out benchmarks/cameras_2cores.json
    python benchmarks/cameras.py --only pictures --batches 8192 --sizes 64x48,320x240 --out benchmarks/cameras_h100.json
    python benchmarks/cameras.py --only pictures --dust --batches 8192,24576 --sizes 64x48 --out dust.json

Pictures are colour, depth and labels with shadows. With `--dust` every wheel throws soil, which colour shows; `--lens`
bends pictures, the renderer's too. A row of the JAX cameras counts only where `median_error` is there: the depth of one
picture of the same size against MuJoCo's renderer; `labels` is the share of pixels whose label agrees.
Where there is OpenGL, what the renderer drew is kept in `cameras_drawn.npz`; where there is none, as on most machines
with a large GPU, pictures are held against that file, and there is no row of the renderer. `mebibytes` is what the
compiled program needs beyond arguments and results. `ssim` is the structural similarity of a boulder's colour with the
same picture by formulas (`camera_reference.py`).
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
from camera_reference import likeness
from provenance import commit
from timing import LOCK, alone

from lunar_mjx.cameras import (
    Pinhole,
    RoverCamera,
    depth_image,
    depth_images,
    front_mount,
    height_scan,
    lens_of,
    mounted,
    pictures,
)
from lunar_mjx.dynamics import build
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model

TOLERANCE = 0.01
"""Largest median error of a depth image against the renderer's."""


LABELS = 0.98
"""Least share of pixels whose label agrees with the renderer's; below 100 pixels a side, edges are 1 % of all."""


LIKENESS = 0.9
"""Least structural similarity of a boulder's picture with the one by formulas."""


def seconds(function: Any, repeats: int) -> tuple[float, float]:
    """Time of the first call, and mean time of those that follow."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    first = time.perf_counter() - start
    with alone():
        start = time.perf_counter()
        for _ in range(repeats):
            jax.block_until_ready(function())
        return first, (time.perf_counter() - start) / repeats


def spread(model: Model, count: int) -> jax.Array:
    """Coordinates of rovers on a spiral over the middle of the terrain; the first one is always at the same place."""
    system = build(model)
    turn = jnp.arange(count) * 2.4
    reach = 15.0 * jnp.sqrt(jnp.arange(count) / count)
    reset = jax.jit(jax.vmap(lambda x, y, yaw: system.reset(system.params, x, y, yaw).qpos))
    return reset(reach * jnp.cos(turn), reach * jnp.sin(turn), turn)


def spinning(model: Model, count: int) -> jax.Array:
    """Velocities of rovers that drive at 0.2 m/s while the rims of their wheels turn at 0.5: all throw dust."""
    mj = model.rover.compile()
    qvel = np.zeros(mj.nv, np.float32)
    qvel[0] = 0.2
    for wheel in model.rover.wheels:
        qvel[int(mj.joint(wheel.drive).dofadr[0])] = 0.5 / wheel.radius
    return jnp.broadcast_to(qvel, (count, mj.nv))


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
                        "labels": eye.front().segmentation,
                    }
                )
        except UserError as missing:
            print(missing)
            return []
    return rows


DRAWN = Path(__file__).with_name("cameras_drawn.npz")
THINNED = 4
"""Of pictures wider than 100 pixels, every fourth row and column is kept and compared."""


def thinned(picture: np.ndarray) -> np.ndarray:
    """The pixels of a picture that are compared."""
    return picture[::THINNED, ::THINNED] if picture.shape[1] > 100 else picture


def keep_or_recall(rows: list[dict], about: str, sizes: list[Pinhole]) -> list[dict]:
    """What the renderer drew, thinned: kept in `DRAWN` where it drew, read from there where it could not."""
    kept = dict(np.load(DRAWN)) if DRAWN.is_file() else {}
    keys = [f"{about} {c.width}x{c.height}" + (f" {c.lens}" if c.lens else "") for c in sizes]
    for row, key in zip(rows, keys, strict=False):
        kept |= {f"{key} depth": thinned(row["depth"]).astype(np.float32), f"{key} labels": thinned(row["labels"])}
    if rows:
        np.savez_compressed(DRAWN, **kept)
    return [{k: kept[f"{key} {k}"] for k in ("depth", "labels")} for key in keys if f"{key} depth" in kept]


def picture_rows(
    model: Model, camera: Pinhole, qpos: jax.Array, batches: list[int], given: argparse.Namespace, drawn: dict | None
) -> list[dict]:
    """Colour, depth and labels with shadows and the rover itself, in JAX."""
    rows, median, share = [], None, None
    alike = likeness(camera)
    if alike < LIKENESS:
        raise SystemExit(f"{camera.width} x {camera.height}: structural similarity {alike:.4f} is below {LIKENESS}")
    terrain = jax.device_put(model.terrain)
    for batch in batches:
        at_once = max(1, min(batch, given.pixels // (camera.width * camera.height)))
        look = partial(pictures, rover=model.rover, camera=camera, at_once=at_once if at_once < batch else None)
        qvel = spinning(model, batch) if given.dust else None
        program = jax.jit(lambda t, q, look=look, qvel=qvel: look(t, qpos=q, qvel=qvel))
        started = time.perf_counter()
        compiled = program.lower(terrain, qpos[:batch]).compile()
        compiling = time.perf_counter() - started
        if drawn is not None and median is None:
            seen = compiled(terrain, qpos[:batch])
            depth, label = thinned(np.asarray(seen.depth[0])), thinned(np.asarray(seen.label[0]))
            both = np.isfinite(depth) & np.isfinite(drawn["depth"]) & (label == drawn["labels"])
            median = float(np.median(np.abs(depth[both] / drawn["depth"][both] - 1.0)))
            share = float((label == drawn["labels"]).mean())
            if median > TOLERANCE or share < LABELS:
                raise SystemExit(f"{camera.width} x {camera.height}: median error {median:.3g}, labels {share:.4f}")
        _, each = seconds(partial(compiled, terrain, qpos[:batch]), given.repeats)
        needed = compiled.memory_analysis()
        rows.append(
            {
                "kind": "rgb, depth, labels, JAX" + ", lens" * bool(camera.lens) + ", dust" * given.dust,
                "size": [camera.width, camera.height],
                "batch": batch,
                "images_per_s": batch / each,
                "compile_s": compiling,
                "mebibytes": None if needed is None else needed.temp_size_in_bytes / 2**20,
                "median_error": median,
                "labels": share,
                "ssim": alike,
            }
        )
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
    parser.add_argument("--only", choices=("all", "pictures"), default="all", help="leave out depth and height images")
    parser.add_argument("--dust", action="store_true", help="all wheels throw soil, which colour shows")
    parser.add_argument("--lens", default="", help="k1,k2,p1,p2,k3 of the lens; a pinhole if left out")
    parser.add_argument("--lock", type=Path, help="file that is locked while a row is timed, for runs side by side")
    parser.add_argument("--out", type=Path, default=Path("cameras.json"))
    given = parser.parse_args()
    LOCK[:] = [given.lock] if given.lock else []
    model = make_model(given.rover, given.terrain)
    lens = lens_of([float(k) for k in given.lens.split(",") if k], "cameras.py", "--lens")
    sizes = [Pinhole(*map(int, s.split("x")), lens=lens) for s in given.sizes.split(",")]
    batches = [int(b) for b in given.batches.split(",")]
    qpos = spread(model, max(batches))
    drawn = renderer_rows(model, sizes, np.asarray(qpos[0], float), given.repeats)
    position, rotation = jax.jit(partial(mounted, front_mount(model.rover)))(qpos)
    terrain = jax.device_put(model.terrain)
    rows: list[dict] = [{k: v for k, v in row.items() if k not in ("depth", "labels")} for row in drawn]
    drawn = keep_or_recall(drawn, f"{given.rover} {given.terrain}", sizes)
    drawn = drawn if len(drawn) == len(sizes) else []
    others = sizes if given.only == "all" else []
    for k, camera in enumerate(others):
        error = None
        if drawn:
            one = thinned(np.asarray(jax.jit(partial(depth_image, camera=camera))(terrain, position[0], rotation[0])))
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
    for k, camera in enumerate(sizes):
        rows += picture_rows(model, camera, qpos, batches, given, drawn[k] if drawn else None)
        write(given, rows)
    rows_, columns = (int(n) for n in given.scan.split("x"))
    shape = (rows_, columns)
    for batch in batches if given.only == "all" else []:
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
    for row in rows:
        print(
            f"{row['kind']:36} {row['size'][0]:4} x {row['size'][1]:<4} batch {row['batch']:6}: "
            f"{row['images_per_s']:12,.1f} images/s"
        )
    write(given, rows)


def write(given: argparse.Namespace, rows: list[dict]) -> None:
    """Writes the rows so far, with what they were measured on."""
    about = {
        "rover": given.rover,
        "terrain": given.terrain,
        "device": jax.devices()[0].device_kind,
        "commit": commit(),
        "jax": jax.__version__,
        "processor": platform.processor() or platform.machine(),
        "repeats": given.repeats,
    }
    given.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
