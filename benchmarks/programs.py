"""Rover-steps per second of every program that a user may run, each held against native MuJoCo by the drive it timed.

    python benchmarks/programs.py --out benchmarks/programs_gpu.json
    python benchmarks/programs.py --batches 64 --steps 10 --out build/programs.json     # a trial on a CPU

Programs: the presets `field`, `consistent` and `paper`, `consistent` with the stress integral and without any effect,
`field` with ruts or without one of its dearer effects, a map of its own for every rover, MJX with the effects of
`consistent`, and `mjx.step` of the rover alone; all on `lunar_plain` with its boulders.
Gate: of the first call of the timed program, some rovers are driven again by native MuJoCo with the NumPy effects
(float64, the same start and commands). `parity_gap` is the largest difference of positions and velocities, each over
the largest change that the drive made. `parity` is false beyond the tolerance, and null where the reference lacks an
effect, and for `mjx.step` alone, which is only a floor.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import mujoco
import numpy as np
from provenance import commit
from speed import _terrain_axes, bare_mjx, control, per_rover_maps, rollout, starts, timed
from timing import LOCK, cpu_name

from lunar_mjx.backends import NativeBackend
from lunar_mjx.backends.physics import SUPPORTED
from lunar_mjx.dynamics import Params, System, build
from lunar_mjx.model import Model, make_model

TOLERANCE = {False: 2e-3, True: 2e-2}
"""Largest gap without and with closed loops, which native MuJoCo holds by soft constraints (4 to 5 % of a step's change
of velocity, less over a drive)."""
REFERENCES = 4
"""Rovers that the reference drives again."""


BARE = "bare mjx.step"
"""Name of the row without effects, terrain and gate."""


@dataclasses.dataclass(frozen=True)
class Program:
    """What is timed: a model, its engine, and whether every rover has a map of its own."""

    name: str
    model: Model
    own_maps: bool = False
    engine: str = "structured"


def programs(rover: str) -> Iterator[Program]:
    """All programs of a rover, those that most users run first."""
    field = make_model(rover, preset="field")
    plain = make_model(rover, preset="consistent")
    bare = plain
    for effect in plain.effect_names:
        bare = bare.remove(effect)
    yield Program("field", field)
    yield Program("consistent", plain)
    yield Program("consistent, stress integral", plain.add("stress_integral"))
    yield Program("field, map per rover", field, own_maps=True)
    yield Program("consistent, map per rover", plain, own_maps=True)
    yield Program("field without multipass", field.remove("multipass"))
    yield Program("no effects", bare)
    yield Program("paper", make_model(rover, preset="paper"))
    yield Program("consistent, MJX", plain, engine="mjx")
    yield Program(BARE, bare, engine="mjx")
    yield Program("field, ruts", field.add("ruts"))
    yield Program("field without rim_contact", field.remove("rim_contact"))


def gate(model: Model, start: Any, steps: int, terrains: Callable[[int], Any] | None) -> Callable[[Any], dict]:
    """Compares the state after the timed program's first call with native MuJoCo's."""

    def compare(end: Any) -> dict[str, Any]:
        if any(e.name not in SUPPORTED for e in model.effects):
            return {"parity": None, "parity_gap": None}
        batch = end.qpos.shape[0]
        # from the middle of the plain outwards: at its start the whole batch lies on one line through the origin
        rows = np.unique(np.linspace(0, batch - 1, REFERENCES).astype(int))
        gaps = []
        for row in rows:
            ground = model if terrains is None else model.replace(terrain=terrains(int(row)))
            backend = NativeBackend(ground, rovers=1)
            spread = np.linspace(-5.0, 5.0, batch, dtype=np.float32)[row]
            backend.reset(spread, 0.6 * spread)
            begin = backend.state()
            for _ in range(steps):
                backend.step(control(model).astype(float))
            there = backend.state()
            for name in ("qpos", "qvel"):
                # the base: closed loops hold their own joints differently
                base = slice(0, 3) if name == "qpos" else slice(0, 6)
                a, b, c = (np.asarray(getattr(s, name), float) for s in (there, begin, end))
                moved = np.abs(a[0, base] - b[0, base]).max()
                gaps.append(float(np.abs(a[0, base] - c[row, base]).max() / max(moved, 1e-6)))
        gap = max(gaps)
        return {"parity": gap < TOLERANCE[bool(model.rover.loops)], "parity_gap": gap}

    return compare


def row(program: Program, batch: int, steps: int) -> dict[str, Any]:
    """One program: its rate and its gate."""
    model, own_maps = program.model, program.own_maps
    if program.name == BARE:
        return {"program": BARE, "batch": batch, "parity": None, "parity_gap": None} | bare_mjx(model, steps, batch)
    system: System = build(model, program.engine)
    state = starts(system, batch)
    if not own_maps:
        run, argument, terrains = rollout(system, steps, None), state, None
    else:
        maps = per_rover_maps(system, batch)

        def run(both: tuple[Params, Any]) -> Any:
            return both[0], rollout(system, steps, None, both[0], _terrain_axes(both[0]))(both[1])

        def terrains(at: int) -> Any:
            heights = maps.terrain.field.heights[at]
            return dataclasses.replace(maps.terrain, field=dataclasses.replace(maps.terrain.field, heights=heights))

        place = np.linspace(-5.0, 5.0, batch, dtype=np.float32)
        grounded = jax.vmap(
            lambda x, h: system.reset(
                dataclasses.replace(
                    maps,
                    terrain=dataclasses.replace(maps.terrain, field=dataclasses.replace(maps.terrain.field, heights=h)),
                ),
                x,
                0.6 * x,
            )
        )
        argument = (maps, jax.jit(grounded)(place, maps.terrain.field.heights))
    check = gate(model, argument, steps, terrains)
    inspect = check if not own_maps else lambda both: check(both[1])
    held = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(state)) / batch
    about = {"program": program.name, "batch": batch, "state_bytes": held}
    return about | timed(run, argument, steps, batch, inspect=inspect)


def main() -> None:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rovers", default="luvmi_x,viper")
    parser.add_argument("--batches", type=lambda text: [int(n) for n in text.split(",")], default=[65536, 8192])
    parser.add_argument("--only", help="programs, by semicolon; all if left out")
    parser.add_argument("--steps", type=int, default=50)
    parser.add_argument("--lock", type=Path, help="file that is locked while a row is timed, for runs side by side")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/programs_gpu.json"))
    options = parser.parse_args()
    LOCK[:] = [options.lock] if options.lock else []
    about = {
        "commit": commit(),
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "mujoco": mujoco.__version__,
        "cpu": cpu_name(),
        "steps": options.steps,
    }
    rows: list[dict[str, Any]] = []
    wanted = options.only.split(";") if options.only else None
    for rover in options.rovers.split(","):
        every = [p for p in programs(rover) if wanted is None or p.name in wanted]
        for batch in options.batches:
            for program in every:
                found = {"rover": rover} | row(program, batch, options.steps)
                rows.append(found)
                rate = f"{found['steps_per_s']:14,.0f} steps/s"
                told = f"gap {found['parity_gap']}, {found['compile_s']:.1f} s"
                print(f"{rover:8s} {program.name:28s} {batch:8d} {rate}  {told}", flush=True)
                options.out.parent.mkdir(parents=True, exist_ok=True)
                options.out.write_text(json.dumps({"about": about, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
