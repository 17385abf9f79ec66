"""CMU's wheel in particle sand on a GPU: runs planned where the package is whole, computed where little is installed.

    python benchmarks/particle_tables.py plan                         # writes benchmarks/particles/plan.json
    python benchmarks/particle_tables.py run --out OUT --seconds 270  # needs numpy, newton and warp-lang alone

Campaigns: `check`, two points with coarse voxels; `cmu_earth`, the slips, slip angles (0 to 75 degrees) and loads of
the measured wheel under Earth gravity, with control runs for the numerical error; `cmu_moon`, a fifth of these points
with the loads that the wheel's mass has on the Moon; `loads`, one point under 5 to 80 N (static sinkage, too);
`convergence`, three points with four sizes of voxels beside the table's. They are computed in stages, so that what an
early end leaves is of use: some points of all slip angles, their errors, the Moon, and then the rest.
OUT/NAME/runs.jsonl holds the results line by line; the same command goes on with what is missing, also from a copy of
an earlier OUT. Then

    lunar-mjx bed simulate OUT/cmu_earth --like cmu_smooth_wheel --slip-angles 0,15,30,45,60,75 --controls 4

finds all runs done and writes the table. `python benchmarks/particle_tables.py report --out OUT` holds the results
against the measured wheel, Moon against Earth, sinkage at rest against the bearing capacity of a footing, and voxel
against voxel, and writes benchmarks/particle_tables.json. A quick check on a processor: run --device cpu --voxels 4.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lunar_mjx.wheel_bed.particles.settings import BedRun

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))
PLAN = ROOT / "benchmarks" / "particles" / "plan.json"
RESULT = ROOT / "benchmarks" / "particle_tables.json"
ANGLES = (0, 15, 30, 45, 60, 75)
CONVERGENCE = ((0.0, 0.23), (30.0, 0.5), (0.0, -0.2))
"""Slip angle in degrees and slip ratio of the points whose voxels are varied."""
CONTROLS, EVERY = 4, 5
"""Points that are computed again for the numerical error; stride of the points that the Moon gets, too."""
FIRST = 20
"""Points of the first stage."""
LOADS = (5.0, 10.0, 20.0, 40.0, 80.0)
"""N"""
EARTH, MOON = 9.80665, 1.625
TOGETHER = 2_000_000
"""Particles in one batch: ten boxes or so."""


def make_plan() -> dict[str, list[dict]]:
    """Campaigns by name, each a list of runs as plain data."""
    from lunar_mjx.wheel_bed.data_files import load_figures
    from lunar_mjx.wheel_bed.particles.campaign import plan
    from lunar_mjx.wheel_bed.particles.points import points_of_table
    from lunar_mjx.wheel_bed.particles.settings import Numerics, ParticleWheel, Sand

    table = load_figures()
    wheel, numerics = ParticleWheel(table.radius, table.width), Numerics(table.radius / 8.0)
    points = [p for p in points_of_table(table) if round(p.slip_angle) in ANGLES]
    on_moon = [dataclasses.replace(p, load=(MOON / EARTH) * p.load) for p in points[::EVERY]]
    chosen = [next(p for p in points if (p.slip_angle, round(p.slip_ratio, 2)) == at) for at in CONVERGENCE]
    sizes = [Numerics(table.radius / n) for n in (5.0, 6.5, 10.0, 12.5)]
    runs = {
        "check": plan(wheel, Sand(), EARTH, chosen[:2], Numerics(table.radius / 5.0), controls=0),
        "cmu_earth": plan(wheel, Sand(), EARTH, points, numerics, controls=CONTROLS),
        "cmu_moon": plan(wheel, Sand(), MOON, on_moon, numerics, controls=0),
        "loads": plan(wheel, Sand(), EARTH, [dataclasses.replace(chosen[0], load=w) for w in LOADS], numerics, 0),
        "convergence": [r for n in sizes for r in plan(wheel, Sand(), EARTH, chosen, n, controls=0)],
    }
    return {name: [{**r.inputs(), "variant": r.variant} for r in listed] for name, listed in runs.items()}


def stages(runs: dict[str, list[BedRun]]) -> list[tuple[str, list[BedRun]]]:
    """Names of campaigns and parts of their runs, in the order in which they are computed."""
    earth = runs["cmu_earth"]
    table, controls = [r for r in earth if r.variant == "table"], [r for r in earth if r.variant != "table"]
    varied = {r.point for r in controls}
    shortest = min(r.steps for r in table)
    spread = [r for start in range(EVERY) for r in table[start::EVERY]]
    first = sorted((r for r in spread if r.steps == shortest), key=lambda r: r.point not in varied)[:FIRST]
    order = [("check", runs["check"]), ("cmu_earth", first), ("cmu_earth", controls)]
    return [*order, *((name, runs[name]) for name in ("cmu_moon", "loads", "cmu_earth", "convergence"))]


def run(out: Path, device: str, seconds: float, voxels: float | None) -> None:
    """Computes what is missing of each stage until time is up; `voxels` per radius takes the plan's place."""
    from lunar_mjx.wheel_bed.particles.campaign import compute, read_plan

    begun = time.perf_counter()
    plans = {name: read_plan(listed) for name, listed in json.loads(PLAN.read_text(encoding="utf-8")).items()}
    for name, runs in stages(plans):
        if voxels is not None:
            coarse = [dataclasses.replace(r.numerics, voxel=r.wheel.radius / voxels) for r in runs]
            runs = [dataclasses.replace(r, numerics=n) for r, n in zip(runs, coarse, strict=True)]
        folder = out / name
        folder.mkdir(parents=True, exist_ok=True)
        left = seconds - (time.perf_counter() - begun)
        done = compute(runs, folder, device, left, TOGETHER, teller(name))
        usable = [r for r in done.results if r["usable"]]
        spent = sum(r["seconds"] for r in done.results) / max(sum(r["wheel_seconds"] for r in done.results), 1e-9)
        print(
            f"{time.perf_counter() - begun:.0f} s  {name}: {len(done.results)} of {len(runs)} runs, "
            f"{len(usable)} usable, {spent:.2f} s per wheel-second, "
            f"momentum to {max((r['momentum_error'] for r in done.results), default=0.0):.1e} {done.stopped}",
            flush=True,
        )
        if done.stopped:
            return


def report(out: Path) -> dict:
    """What the results say; every part by its campaign, quantities in SI units."""
    from benchmarks.provenance import commit
    from lunar_mjx.wheel_bed.particles.campaign import read_results
    from lunar_mjx.wheel_bed.particles.results import numerical_error

    kept = {name: read_results(out / name) for name in json.loads(PLAN.read_text(encoding="utf-8"))}
    found: dict = {"commit": commit(), "settings": {}}
    for name, results in kept.items():
        if not results:
            continue
        table = [r for r in results if r["variant"] == "table"]
        found["settings"][name] = {
            "runs": len(results),
            "usable": sum(r["usable"] for r in results),
            "device": table[0]["device"],
            "voxels_per_radius": sorted({round(r["wheel"]["radius"] / r["numerics"]["voxel"], 2) for r in results}),
            "particles_in_a_box": max(r["particles"] for r in results),
            "seconds": sum(r["seconds"] for r in results),
            "wheel_seconds": sum(r["wheel_seconds"] for r in results),
            "momentum_error": max(r["momentum_error"] for r in results),
        }
    usable = {n: [r for r in rs if r["usable"] and r["variant"] == "table"] for n, rs in kept.items()}
    if usable["cmu_earth"]:
        found["numerical_error"] = numerical_error(kept["cmu_earth"])
        found["drift"] = {
            q: _rms([r["drift"][q] for r in usable["cmu_earth"]]) for q in usable["cmu_earth"][0]["drift"]
        }
        found["against_the_measured_wheel"] = against_measured(usable["cmu_earth"])
    if usable["cmu_moon"]:
        found["moon_against_earth"] = moon_against_earth(usable["cmu_earth"], usable["cmu_moon"])
    if still := usable["loads"] or usable["cmu_earth"]:
        found["sinkage_at_rest"] = [
            {
                "load_N": r["point"]["load"],
                "sinkage_m": r["static_sinkage"],
                "footing_m": [footing_sinkage(r, angle) for angle in (35.0, math.degrees(math.atan(flow_friction(r))))],
            }
            for r in still
        ]
    if usable["convergence"]:
        where = {(round(r["point"]["slip_angle"]), round(r["point"]["slip_ratio"], 2)) for r in usable["convergence"]}
        all_sizes = usable["convergence"] + usable["cmu_earth"]
        found["convergence"] = [
            {
                "slip_angle_deg": r["point"]["slip_angle"],
                "slip_ratio": r["point"]["slip_ratio"],
                "voxels_per_radius": r["wheel"]["radius"] / r["numerics"]["voxel"],
                **r["values"],
            }
            for r in sorted(
                all_sizes, key=lambda r: (r["point"]["slip_angle"], r["point"]["slip_ratio"], r["particles"])
            )
            if (round(r["point"]["slip_angle"]), round(r["point"]["slip_ratio"], 2)) in where
        ]
    return found


def against_measured(results: list[dict]) -> dict:
    """Root mean square and mean error of particles less measurement, and the size of what was measured, by quantity."""
    from lunar_mjx.wheel_bed.data_files import load_figures

    table = load_figures()
    test = zip(table.test["slip_angle_deg"], table.test["slip_ratio"], strict=True)
    row = {(round(a, 3), round(s, 6)): k for k, (a, s) in enumerate(test)}
    at = [row[round(r["point"]["slip_angle"], 3), round(r["point"]["slip_ratio"], 6)] for r in results]
    out = {}
    for quantity, measured in table.measured.items():
        away = [r["values"][quantity] - measured[k] for r, k in zip(results, at, strict=True)]
        out[quantity] = {
            "rms_error": _rms(away),
            "mean_error": sum(away) / len(away),
            "rms_measured": _rms([measured[k] for k in at]),
            "replicates": table.sigma[quantity],
        }
    driven = [(r, k) for r, k in zip(results, at, strict=True) if r["point"]["slip_ratio"] > -0.1]
    out["rolling_and_driven"] = {q: _rms([r["values"][q] - m[k] for r, k in driven]) for q, m in table.measured.items()}
    return out | {"points": len(at)}


def moon_against_earth(earth: list[dict], moon: list[dict]) -> dict:
    """Root mean square difference of the Moon's results, scaled to the Earth's weight, from the Earth's own."""
    at = {(r["point"]["slip_angle"], r["point"]["slip_ratio"]): r for r in earth}
    pairs = [(at[key], r) for r in moon if (key := (r["point"]["slip_angle"], r["point"]["slip_ratio"])) in at]
    out: dict = {"points": len(pairs)}
    for quantity in moon[0]["values"]:
        scale = 1.0 if quantity == "sinkage" else EARTH / MOON
        out[quantity] = _rms([scale * m["values"][quantity] - e["values"][quantity] for e, m in pairs])
    return out


def flow_friction(result: dict) -> float:
    """Sine of the friction angle: the friction that counts for flow without dilatancy (Davis 1968)."""
    return math.sin(math.radians(result["sand"]["friction_angle"]))


def footing_sinkage(result: dict, friction_deg: float) -> float:
    """Sinkage at which a footing as large as the wheel's chord bears the load, m (Vesic 1973, no overburden)."""
    wheel, phi = result["wheel"], math.radians(friction_deg)
    n_q = math.exp(math.pi * math.tan(phi)) * math.tan(math.pi / 4.0 + phi / 2.0) ** 2
    n_gamma = 2.0 * (n_q + 1.0) * math.tan(phi)
    weight = result["sand"]["density"] * result["gravity"]

    def borne(sinkage: float) -> float:
        chord = 2.0 * math.sqrt(sinkage * (2.0 * wheel["radius"] - sinkage))
        short, long = sorted((chord, wheel["width"]))
        return chord * wheel["width"] * 0.5 * weight * short * n_gamma * (1.0 - 0.4 * short / long)

    low, high = 0.0, wheel["radius"]
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if borne(middle) < result["point"]["load"] else (low, middle)
    return high


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))


def teller(name: str) -> Callable[[str, float], None]:
    """Prints progress every five seconds."""
    begun = last = time.perf_counter()

    def tell(what: str, done: float) -> None:
        nonlocal last
        if time.perf_counter() - last > 5.0:
            last = time.perf_counter()
            print(f"{last - begun:6.1f} s  {name}: {100 * done:.1f} %, {what}", flush=True)

    return tell


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    verbs = parser.add_subparsers(dest="verb", required=True)
    verbs.add_parser("plan")
    running = verbs.add_parser("run")
    running.add_argument("--out", type=Path, required=True)
    running.add_argument("--device", default="cuda")
    running.add_argument("--seconds", type=float, default=270.0)
    running.add_argument("--voxels", type=float)
    reporting = verbs.add_parser("report")
    reporting.add_argument("--out", type=Path, required=True)
    given = parser.parse_args()
    if given.verb == "plan":
        PLAN.parent.mkdir(exist_ok=True)
        PLAN.write_text(json.dumps(make_plan(), indent=1) + "\n", encoding="utf-8")
        print(PLAN)
    elif given.verb == "report":
        RESULT.write_text(json.dumps(report(given.out), indent=1) + "\n", encoding="utf-8")
        print(RESULT)
    else:
        run(given.out, given.device, given.seconds, given.voxels)


if __name__ == "__main__":
    main()
