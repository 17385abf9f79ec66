"""Every backend side by side in one run: rover-steps per second, compile time and memory against the batch size.

    python benchmarks/backends.py --platforms cpu --batches 1,1024 --out benchmarks/backends_cpu.json
    python benchmarks/backends.py --cpu-rows 0 --batches 32768 --devices 1,2 --out benchmarks/backends_h200.json

Rows with effects run the preset `consistent` on `lunar_plain`, thermal network included:
  pybullet                 Bullet with forces in NumPy, in one process and in one per core
  native, NumPy effects    native MuJoCo (C, float64) with forces in NumPy, in one process and in one per core
  mjx, structured          the JAX engines, float32
Rows without, as floors:
  native, bare             `mujoco.rollout` of the same rover, on one thread and on all
  mjx, bare                `mjx.step` of the same rover
  mjx, spheres             `mjx.step` with a sphere per wheel on a height field, the usual terrain in MJX
Workers are threads, processes, cores (JAX on CPU) or GPUs. With several GPUs each takes a whole batch of `--batches`.
The load of the machine before the run is kept in the JSON: rows of a busy machine are lower bounds. Two runs may share
a machine: give each its own cores (`taskset`) and both the same `--lock`, which one holds while it times a GPU.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import os
import resource
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from speed import control, native_batch, rollout, starts
from timing import LOCK, alone, cpu_name, sharded

from lunar_mjx._quiet import mjx
from lunar_mjx.backends import NativeBackend
from lunar_mjx.dynamics import build
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model, make_model
from lunar_mjx.report.style import (
    BLUE,
    GREEN,
    INK,
    MUTED,
    ORANGE,
    PAPER,
    PURPLE,
    SKY,
    VERMILION,
    save_light_and_dark,
    styled,
)

ENGINES = ("pybullet", "native", "structured", "mjx", "bare", "spheres")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def time_jax(function: Callable[[Any], Any], state: Any, steps: int, batch: int, repeats: int = 3) -> dict[str, Any]:
    """Compiles `function(state) -> state` of `steps` steps, and times the best of some calls."""
    begin = time.perf_counter()
    compiled = jax.jit(function).lower(state).compile()
    compile_s = time.perf_counter() - begin
    memory = compiled.memory_analysis()
    best = float("inf")
    with alone():
        new = jax.block_until_ready(compiled(state))
        for _ in range(repeats):
            begin = time.perf_counter()
            new = jax.block_until_ready(compiled(new))
            best = min(best, time.perf_counter() - begin)
    used = memory.temp_size_in_bytes + memory.argument_size_in_bytes + memory.output_size_in_bytes if memory else None
    return {
        "steps_per_s": batch * steps / best,
        "compile_s": compile_s,
        "memory_MB": used and used / 1e6,
        "finite": all(bool(np.isfinite(a).all()) for a in jax.tree.leaves(jax.device_get(new))),
    }


def spheres(model: Model, steps: int, batch: int) -> dict[str, Any]:
    """MJX with a sphere for every wheel on a height field, and solver iterations that converge (4, line search 8)."""
    spec = model.rover.spec()
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    field = model.terrain.field
    heights = np.asarray(field.heights)[:128, :128]
    low, high = float(heights.min()), float(heights.max())
    half = 0.5 * (len(heights) - 1) * float(field.cell)
    spec.add_hfield(
        name="ground",
        nrow=len(heights),
        ncol=len(heights),
        size=[half, half, max(high - low, 1e-3), 1.0],
        userdata=((heights - low) / max(high - low, 1e-3)).ravel(),
    )
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", contype=1, conaffinity=1)
    for wheel in model.rover.wheels:
        spec.body(wheel.body).add_geom(
            type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[wheel.radius, 0, 0], contype=1, conaffinity=1, mass=0.0
        )
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    spec.option.iterations, spec.option.ls_iterations = 4, 8
    native = spec.compile()
    native.qpos0[2] += high - low
    return _bare(native, steps, batch)


def _bare(native: mujoco.MjModel, steps: int, batch: int) -> dict[str, Any]:
    m = mjx.put_model(native)
    data = jax.vmap(lambda _: mjx.make_data(m))(jnp.arange(batch))

    def run(data: Any) -> Any:
        return jax.lax.scan(lambda d, _: (jax.vmap(lambda one: mjx.step(m, one))(d), None), data, None, length=steps)[0]

    return time_jax(run, data, steps, batch)


def numpy_steps(job: tuple[str, str, int, float]) -> dict[str, Any]:
    """Steps a NumPy backend for some seconds: (engine, rover, rovers, seconds); runs in its own process too."""
    engine, rover, rovers, seconds = job
    model = make_model(rover)
    if engine == "pybullet":
        from lunar_mjx.backends.pybullet import PyBulletBackend

        backend: Any = PyBulletBackend(model, rovers=rovers)
    else:
        backend = NativeBackend(model, rovers=rovers)
    held = backend.controls(control(model).astype(float))
    backend.reset(x=np.linspace(-5.0, 5.0, rovers), y=np.linspace(-3.0, 3.0, rovers))
    for _ in range(100):
        backend.step(held)
    count, begin = 0, time.perf_counter()
    while time.perf_counter() - begin < seconds:
        for _ in range(20):
            backend.step(held)
        count += 20
    wall = time.perf_counter() - begin
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"steps_per_s": count * rovers / wall, "memory_MB": memory}


def in_processes(engine: str, rover: str, rovers: int, processes: int, seconds: float) -> dict[str, Any]:
    """The same in processes of their own, each on one thread: in one, linear algebra would take every core.

    Memory is that of all.
    """
    os.environ |= dict.fromkeys(THREADS, "1") | {"JAX_PLATFORMS": "cpu"}  # which the processes inherit
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        parts = pool.map(numpy_steps, [(engine, rover, rovers, seconds)] * processes, chunksize=1)
    return {key: sum(p[key] for p in parts) for key in parts[0]}


def rows_of(rover: str, options: argparse.Namespace, add: Callable[..., None]) -> None:
    """All rows of one rover, handed to `add(engine, batch, workers, result)`."""
    model = make_model(rover)
    if options.cpu_rows:
        cores = options.cores
        if "native" in options.engines:
            for threads in dict.fromkeys((1, cores)):
                add("native, bare", 512, threads, native_batch(model, threads, 512, options.native_steps))
            for batch in options.numpy_batches:
                add("native, NumPy effects", batch, 1, in_processes("native", rover, batch, 1, options.seconds))
            largest = max(options.numpy_batches)
            if cores > 1:
                add(
                    "native, NumPy effects",
                    largest * cores,
                    cores,
                    in_processes("native", rover, largest, cores, options.seconds),
                )
        if "pybullet" in options.engines:
            try:
                add("pybullet", 1, 1, in_processes("pybullet", rover, 1, 1, options.seconds))
                if cores > 1:
                    add("pybullet", cores, cores, in_processes("pybullet", rover, 1, cores, options.seconds))
            except UserError as missing:
                print(missing)
    for platform_name in options.platforms:
        found = jax.devices(platform_name)
        for devices in options.devices:
            if devices > len(found):
                print(f"{platform_name}: {len(found)} devices, not {devices}; their rows are left out")
                continue
            with jax.default_device(found[0]):
                jax_rows(model, options, found[:devices], add)


def jax_rows(model: Model, options: argparse.Namespace, devices: list[Any], add: Callable[..., None]) -> None:
    """The rows of the JAX engines on some devices of one kind, each of which takes the whole of a batch."""
    on_cpu = devices[0].platform == "cpu"
    workers = options.cores if on_cpu else len(devices)
    for each in options.batches:
        batch = each * len(devices)
        long = max(1, 256 // batch)  # a few steps of few rovers are over before the clock ticks
        for engine, steps in (("structured", options.steps * long), ("mjx", options.mjx_steps * long)):
            if engine in options.engines:
                system = build(model, engine)
                run, state = sharded(rollout(system, steps, None), starts(system, batch), devices)
                result = time_jax(run, state, steps, batch)
                add(f"{engine}, CPU" if on_cpu else engine, batch, workers, result)
        steps = options.mjx_steps * long
        if len(devices) > 1:  # the floors, once
            continue
        if "bare" in options.engines:
            add("mjx, bare, CPU" if on_cpu else "mjx, bare", batch, workers, _bare(model.rover.compile(), steps, batch))
        if "spheres" in options.engines:
            add("mjx, spheres, CPU" if on_cpu else "mjx, spheres", batch, workers, spheres(model, steps, batch))


LOOKS = {
    "structured": (BLUE, "o"),
    "mjx": (VERMILION, "s"),
    "mjx, bare": (ORANGE, "^"),
    "mjx, spheres": (PURPLE, "v"),
    "native, bare": (GREEN, "P"),
    "native, NumPy effects": (SKY, "X"),
    "pybullet": (INK, "D"),
}
"""Colour and marker of every engine; hollow on a CPU where there is a row of a GPU, too."""


@styled()
def plot(rows: list[dict[str, Any]], path: Path) -> None:
    """Rover-steps per second against the batch, one panel per rover; every row is named beside its marker."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullLocator

    rovers = list(dict.fromkeys(r["rover"] for r in rows))
    figure = Figure(figsize=(6.2 * len(rovers), 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(rovers), sharey=True, squeeze=False)[0]
    for axes, rover in zip(panels, rovers, strict=True):
        lines: dict[tuple[str, int], list[dict[str, Any]]] = {}
        for row in rows:
            if row["rover"] == rover and row.get("finite", True):
                lines.setdefault((row["engine"], row["workers"]), []).append(row)
        for (engine, _), own in lines.items():
            own.sort(key=lambda r: r["batch"])
            colour, marker = LOOKS[engine.removesuffix(", CPU")]
            hollow = engine.endswith(", CPU")
            axes.loglog(
                [r["batch"] for r in own],
                [r["steps_per_s"] for r in own],
                marker=marker,
                color=colour,
                linestyle=":" if hollow else "-",
                linewidth=1.1,
                markersize=6,
                markerfacecolor=PAPER if hollow else colour,
            )
        heights = _spread([own[-1]["steps_per_s"] for own in lines.values()])
        for ((engine, workers), own), height in zip(lines.items(), heights, strict=True):
            # labels stand in a column at the right, so that none lies on a marker or a line
            axes.annotate(
                f"{engine}, {workers} {_unit(engine, workers)}",
                (own[-1]["batch"], own[-1]["steps_per_s"]),
                (_LABELS, height),
                fontsize=8,
                va="center",
                arrowprops={"arrowstyle": "-", "color": MUTED, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 4},
            )
        axes.set_xlim(0.7, _RIGHT)
        axes.set_xticks([10.0**k for k in range(6)])
        axes.xaxis.set_minor_locator(NullLocator())
        axes.set_title(rover)
        axes.set_xlabel("rovers at once")
    panels[0].set_ylabel("rover-steps per second")
    save_light_and_dark(figure, path, dpi=120)


_LABELS, _RIGHT = 3e5, 3e8
"""Abscissa at which the names of the engines begin, and the panel's right end."""


def _spread(values: list[float], least: float = 1.45) -> list[float]:
    """The values, moved up until each is `least` times the one below: labels there do not overlap."""
    out = list(values)
    order = sorted(range(len(values)), key=values.__getitem__)
    for below, i in itertools.pairwise(order):
        out[i] = max(out[i], least * out[below])
    return out


def _unit(engine: str, workers: int) -> str:
    """What the workers of a row are."""
    if engine.endswith(", CPU"):
        return "cores"
    name = {"native, bare": "thread", "native, NumPy effects": "process", "pybullet": "process"}.get(engine, "GPU")
    return name if workers == 1 else f"{name}es" if name.endswith("s") else f"{name}s"


def table(rows: list[dict[str, Any]]) -> str:
    """The rows as a Markdown table."""
    lines = [
        "| rover | engine | rovers | workers | rover-steps/s | us per rover-step | compile s | memory MB |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        compile_s, memory = (f"{r[k]:.1f}" if r.get(k) else "" for k in ("compile_s", "memory_MB"))
        workers, finite = f"{r['workers']} {_unit(r['engine'], r['workers'])}", r.get("finite", True)
        lines.append(
            f"| {r['rover']} | {r['engine']} | {r['batch']:,} | {workers} | "
            f"{r['steps_per_s']:,.0f}{'' if finite else ' (not finite)'} | "
            f"{1e6 / r['steps_per_s']:.3g} | {compile_s} | {memory} |"
        )
    return "\n".join(lines)


def merge(files: list[Path], out: Path) -> None:
    """Puts runs side by side on one machine into one record, with its plot and table."""
    parts = [json.loads(f.read_text()) for f in files]
    rows = [row for part in parts for row in part["rows"]]
    out.write_text(json.dumps({"about": [part["about"] for part in parts], "rows": rows}, indent=1) + "\n")
    plot(rows, out.with_suffix(".png"))
    out.with_suffix(".md").write_text(table(rows) + "\n")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    numbers = lambda text: [int(n) for n in text.split(",")]  # noqa: E731
    parser.add_argument("--rovers", default="luvmi_x,viper")
    parser.add_argument("--engines", default="pybullet,native,structured,mjx,bare", help=",".join(ENGINES))
    parser.add_argument("--batches", type=numbers, default=[1, 256], help="of the JAX engines")
    parser.add_argument("--numpy-batches", type=numbers, default=[1, 16, 128])
    parser.add_argument("--cores", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--platforms", default="", help="of the JAX engines: cpu, cuda; JAX's choice if left out")
    parser.add_argument("--devices", type=numbers, default=[1], help="how many GPUs; each takes a whole batch")
    parser.add_argument("--lock", type=Path, help="file that is locked while a row of the JAX engines is timed")
    parser.add_argument("--cpu-rows", type=int, default=1, help="0: leave PyBullet and native MuJoCo out")
    parser.add_argument("--seconds", type=float, default=5.0, help="per row of PyBullet and of NumPy effects")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--mjx-steps", type=int, default=10)
    parser.add_argument("--native-steps", type=int, default=200)
    parser.add_argument("--out", type=Path, help="JSON; the plot and the table lie beside it")
    parser.add_argument("--merge", type=Path, nargs="+", help="JSON files of runs on one machine, put into one --out")
    options = parser.parse_args()
    if options.merge:
        merge(options.merge, options.out)
        return
    options.engines = options.engines.split(",")
    for engine in options.engines:
        if engine not in ENGINES:
            parser.error(f"--engines: {engine} does not exist; use some of {', '.join(ENGINES)}")
    rows: list[dict[str, Any]] = []
    LOCK[:] = [options.lock] if options.lock else []
    device = jax.devices()[0]
    options.platforms = options.platforms.split(",") if options.platforms else [device.platform]
    about = {
        "device": device.device_kind,
        "devices": options.devices,
        "cores": options.cores,
        "cpu": cpu_name(),
        "load_before": os.getloadavg(),
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
    }

    def add(rover: str, engine: str, batch: int, workers: int, result: dict[str, Any]) -> None:
        rows.append(
            {
                "rover": rover,
                "engine": engine,
                "batch": batch,
                "workers": workers,
                **result,
                "us_per_rover_step": 1e6 / result["steps_per_s"],
                "load": os.getloadavg()[0],
            }
        )
        print(f"{rover:8s} {engine:24s} {batch:8d} x {workers:2d} {result['steps_per_s']:14,.0f} steps/s", flush=True)
        if options.out:
            options.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")

    for rover in options.rovers.split(","):
        rows_of(rover, options, lambda *row, rover=rover: add(rover, *row))
    if options.out:
        plot(rows, options.out.with_suffix(".png"))
        options.out.with_suffix(".md").write_text(table(rows) + "\n")
    print(table(rows))


if __name__ == "__main__":
    main()
