"""Times the stages of pictures in JAX on a GPU, for several tiles of the kernel; a tool for whoever changes the kernel.

python benchmarks/cameras_tune.py --out cameras_tune.json
"""

from __future__ import annotations

import argparse
import json
import os
import time
import traceback
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from cameras import spread
from timing import commit

from lunar_mjx.cameras import Pinhole, front_mount, mounted, pictures, placed, rover_shapes
from lunar_mjx.cameras.rays import trace
from lunar_mjx.cameras.shapes import bodies
from lunar_mjx.model import make_model


def seconds(function: Any, *given: Any, repeats: int = 3) -> tuple[float, float]:
    """Time to compile, and best time of a call."""
    start = time.perf_counter()
    compiled = jax.jit(function).lower(*given).compile()
    compiling = time.perf_counter() - start
    jax.block_until_ready(compiled(*given))
    each = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(compiled(*given))
        each.append(time.perf_counter() - start)
    return compiling, min(each)


def main() -> None:
    """Prints a row each and writes them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("cameras_tune.json"))
    parser.add_argument("--batch", type=int, default=8192)
    parser.add_argument("--limit", type=float, default=150.0, help="seconds after which no new row begins")
    given = parser.parse_args()
    began = time.perf_counter()
    model = make_model("viper", "lunar_plain")
    qpos, terrain = spread(model, given.batch), jax.device_put(model.terrain)
    shapes, mount = rover_shapes(model.rover), front_mount(model.rover)
    sun = jnp.asarray([0.683, -0.683, 0.259], jnp.float32)
    rows: list[dict] = []

    def note(name: str, camera: Pinhole, batch: int, function: Any) -> None:
        if time.perf_counter() - began > given.limit:
            return
        row: dict = {"name": name, "size": [camera.width, camera.height], "batch": batch}
        try:
            row["compile_s"], each = seconds(function, terrain, qpos[:batch])
            row["images_per_s"] = batch / each
        except Exception as broken:
            traceback.print_exc(limit=3)
            row["error"] = str(broken)[:2000]
        rows.append(row)
        print(row, flush=True)
        about = {"device": jax.devices()[0].device_kind, "jax": jax.__version__}
        about["commit"] = os.environ.get("CAMERAS_COMMIT") or commit()
        given.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n", encoding="utf-8")

    def traced(terrain: Any, qpos: Any, camera: Pinhole, sunny: bool, rover: bool, kernel: str = "auto") -> Any:
        def one(q: Any) -> Any:
            place, turn = mounted(mount, q)
            seen = bodies(placed(shapes, model.rover, q)) if rover else None
            return trace.trace(terrain, place, turn, camera, 60.0, sun if sunny else None, seen, kernel)

        return jax.vmap(one)(qpos)

    small, large = Pinhole(64, 48), Pinhole(320, 240)
    look = {c: partial(lambda t, q, c: pictures(t, model.rover, q, c), c=c) for c in (small, large)}
    note("pictures", small, given.batch, look[small])
    found = jax.jit(look[small])(terrain, qpos[:1])
    kept = dict(np.load(Path(__file__).with_name("cameras_drawn.npz")))
    depth, label = (kept[f"viper lunar_plain 64x48 {k}"] for k in ("depth", "labels"))
    both = np.isfinite(depth) & np.isfinite(found.depth[0]) & (np.asarray(found.label[0]) == label)
    error = float(np.median(np.abs(np.asarray(found.depth[0])[both] / depth[both] - 1.0)))
    print("median error", error, "labels", float((np.asarray(found.label[0]) == label).mean()), flush=True)
    note("depth alone", small, given.batch, partial(traced, camera=small, sunny=False, rover=False))
    note("depth, rover", small, given.batch, partial(traced, camera=small, sunny=False, rover=True))
    note("depth, shadows", small, given.batch, partial(traced, camera=small, sunny=True, rover=False))
    note("all rays", small, given.batch, partial(traced, camera=small, sunny=True, rover=True))
    note("pictures", large, given.batch // 8, look[large])
    for tile, warps in (((8, 4), 4), ((8, 8), 2), ((8, 8), 1), ((16, 8), 4), ((16, 2), 1)):
        # a tile may have more pixels than a warp has threads
        trace.TILE, trace.WARPS = tile, warps
        jax.clear_caches()
        note(
            f"all rays, tile {tile}, warps {warps}",
            small,
            given.batch,
            partial(traced, camera=small, sunny=True, rover=True),
        )


if __name__ == "__main__":
    main()
