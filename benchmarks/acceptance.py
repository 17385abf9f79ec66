"""Acceptance proofs of the preset that drives run by default, with their numbers: the table "Checked" is made of them.

    python benchmarks/acceptance.py --out benchmarks/acceptance.json            # all, minutes on 16 cores
    python benchmarks/acceptance.py --proofs parked --rovers luvmi_x --processes 1 --out build/acceptance.json

Rows that the file holds already and that are not asked for stay; each tells the commit that it was measured at.
Each proof has a number, its limit and the words that say what was measured:
  parked   a braked rover on 10 deg of soft soil, facing four ways: way from 10 s to 70 s after it was set down
  energy   a rover dropped from 0.3 m with free joints: largest gain of its energy with springs and soil, over the fall
  halving  20 s of driving with steering on a slope: the end moves by this share of the way when the time step is halved
  drives   20 s drives in a hard and a soft crater, structured engine (float64) and PyBullet against native MuJoCo:
           largest error over its tolerance (floor of roundings included)
  parity   1,001 states (twice as many for a rover with loops) along 7.5 s drives on all grounds, structured engine and
           MJX against native MuJoCo, likewise
"""

from __future__ import annotations

import argparse
import concurrent.futures
import dataclasses
import json
import multiprocessing
import os
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

PRESET = "field"
GRAVITY = 1.625
HOLD = 50
"""Steps per command: 0.1 s."""


def _rollout(system: Any, terrains: list[Any], commands: np.ndarray, every: int, keep: Callable) -> Any:
    """What `keep` keeps of drives over several grounds, leading axes (rover, time)."""
    import jax
    import jax.numpy as jnp

    from lunar_mjx.dynamics import Params
    from lunar_mjx.terrain import stack

    ground = jax.tree.map(jnp.asarray, stack([dataclasses.replace(t, name="plane") for t in terrains]))
    params = dataclasses.replace(system.params, terrain=ground)
    each = Params(gravity=None, ambient=None, effects=None, terrain=0)
    start = jax.vmap(lambda g: system.reset(dataclasses.replace(system.params, terrain=g)))(ground)
    run = jax.jit(lambda p, s, c: system.rollout_batch(p, s, c, every, each, report=keep, one_body=True)[1])
    return jax.device_get(run(params, start, jnp.asarray(commands)))


def _control(model: Any, drive: float = 0.0, steer: float = 0.0) -> np.ndarray:
    """Rim speed of all drives, rad/s, and the angle of the front wheels, rad."""
    front = {w.steer for w in model.rover.wheels if w.steer and w.corner in ("lf", "rf")}
    values = [
        drive if g.name == "drive" else steer if j in front else 0.0 for g in model.rover.groups for j in g.joints
    ]
    return np.array(values, np.float32)


def parked(rover: str) -> dict[str, Any]:
    """Way of a braked rover, m."""
    from lunar_mjx.dynamics import build
    from lunar_mjx.model import make_model
    from lunar_mjx.terrain import inclined

    model = make_model(rover, "flat", PRESET).add("parking_brake", engaged=1.0)
    grounds = [inclined(np.deg2rad(10.0), 200.0, np.deg2rad(d)) for d in (0.0, 90.0, 45.0, 180.0)]
    commands = np.tile(_control(model), (701, 1))
    position = _rollout(build(model), grounds, commands, HOLD, lambda seen: seen.position)
    moved = np.sqrt(sum((p[:, 700] - p[:, 100]) ** 2 for p in position))
    return {"value": float(moved.max()), "limit": 1e-3, "unit": "m", "each": moved.tolist()}


def halving(rover: str) -> dict[str, Any]:
    """Distance of the ends of a drive with the time step and with half of it, over the way."""
    from lunar_mjx.dynamics import build
    from lunar_mjx.model import make_model
    from lunar_mjx.terrain import inclined

    paths = []
    for parts in (1, 2):
        model = make_model(rover, "flat", PRESET)
        model = model.replace(timestep=model.timestep / parts)
        commands = np.tile(_control(model, 0.8, 0.1), (201, 1))
        grounds = [inclined(np.deg2rad(4.0), 200.0, np.deg2rad(30.0))]
        paths.append(
            np.stack(_rollout(build(model), grounds, commands, parts * HOLD, lambda seen: seen.position))[:, 0]
        )
    way = np.linalg.norm(np.diff(paths[0], axis=1), axis=0).sum()
    return {"value": float(np.linalg.norm(paths[0][:, -1] - paths[1][:, -1]) / way), "limit": 0.01, "unit": "1"}


def soil_energy(model: Any, sinkage: np.ndarray, steps: int = 200) -> np.ndarray:
    """Work done on the soil by the normal stress of every wheel that has sunk in, J: its load over the sinkage."""
    soil = model.parameters["soil"]
    nodes, weights = np.polynomial.legendre.leggauss(12)
    total = np.zeros(sinkage.shape[:-1])
    for i, wheel in enumerate(model.rover.wheels):
        r, b = wheel.radius, wheel.width
        depth = np.linspace(0.0, max(float(sinkage[..., i].max()), 1e-6), steps)
        theta_1 = np.arccos(1.0 - np.minimum(depth / r, 1.5))[:, None]
        theta = 0.5 * theta_1 * (1.0 + nodes)
        front = np.maximum(theta, theta_1 - theta)
        sigma = (soil["k_c"] / b + soil["k_phi"]) * np.maximum(r * (np.cos(front) - np.cos(theta_1)), 0.0) ** soil["n"]
        load = r * b * np.sum(0.5 * theta_1 * weights * sigma * np.cos(theta), axis=1)
        work = np.concatenate([[0.0], np.cumsum(0.5 * (load[1:] + load[:-1]) * np.diff(depth))])
        total += np.interp(sinkage[..., i], depth, work)
    return total


def energy(rover: str) -> dict[str, Any]:
    """Largest gain of energy after a drop, over the energy of the fall; and what is left at the end."""
    import jax
    import mujoco

    from lunar_mjx.dynamics import build
    from lunar_mjx.model import make_model

    free = {"drive": "torque", "steer": "torque", "suspension": "torque"}
    model = make_model(rover, "flat", PRESET, modes=free)
    model = model.set("motor", rotor_inertia=9e-7).set("shear_state", damping_time=0.0)
    system = build(model)
    state = system.reset(system.params)
    lean = np.array([0.9994, 0.02, 0.028, 0.0])
    state = dataclasses.replace(state, qpos=state.qpos.at[2].add(0.3).at[3:7].set(lean))
    control = np.zeros(len(system.joint_names))

    def step(s: Any, _: Any) -> Any:
        new, seen = system.step(system.params, s, control)
        return new, (s.qpos, s.qvel, seen.sinkage)

    qpos, qvel, sinkage = jax.device_get(jax.jit(lambda s: jax.lax.scan(step, s, length=2500)[1])(state))
    compiled = model.rover.compile()
    motor = system.params.effects["motor"]
    reflected = np.asarray(motor["rotor_inertia"] * motor["gear_ratio"] ** 2) * np.ones(len(system.joint_names))
    compiled.dof_armature[:] = 0.0
    for joint, value in zip(system.joint_names, reflected, strict=True):
        compiled.dof_armature[compiled.joint(joint).dofadr[0]] = value
    data = mujoco.MjData(compiled)
    whole = soil_energy(model, sinkage)
    for i, (q, v) in enumerate(zip(qpos, qvel, strict=True)):
        data.qpos, data.qvel = q, v
        mujoco.mj_fwdPosition(compiled, data)
        mujoco.mj_fwdVelocity(compiled, data)
        mujoco.mj_energyPos(compiled, data)
        mujoco.mj_energyVel(compiled, data)
        whole[i] += data.energy.sum()
    fall = 0.3 * model.rover.mass * model.gravity
    gain = (whole[1:] - np.minimum.accumulate(whole)[:-1]).max() / fall
    return {"value": float(gain), "limit": 0.02, "unit": "1", "lost": float((whole[0] - whole[-1]) / fall)}


def _worst(study: Any) -> dict[str, Any]:
    """The largest error over its tolerance of all judged pairs, and where it was."""
    judged = [(p, r) for p in study.pairs if p.judged for r in p.results]
    found = [(r.error, f"{p.second}: {r.case}, {r.stage}, {r.quantity}") for p, r in judged]
    worst, where = max(found)
    return {"value": float(worst), "limit": 1.0, "unit": "tolerances", "where": where, "compared": len(found)}


def drives(rover: str) -> dict[str, Any]:
    """Drives of 20 s in craters."""
    from lunar_mjx.backends.parity.study import available, run_study

    engines, missing = available(["structured", "pybullet"])
    study = run_study(rover, PRESET, engines, 20.0, 6, grounds=("crater, soft", "crater, hard"))
    return _worst(study) | {"engines": engines, "left_out": missing}


def parity(rover: str) -> dict[str, Any]:
    """143 states on each of seven grounds, along drives of 7.5 s: every command of 50 ms gives one at most."""
    from lunar_mjx.backends.parity.study import run_study

    study = run_study(rover, PRESET, ["structured", "mjx"], 7.5, 143)
    states = sum(len(run[0]["sinkage"]) for run in study.runs["native"].steps.values())
    return _worst(study) | {"states": states}


PROOFS: Mapping[str, Callable[[str], dict[str, Any]]] = {
    "parked": parked,
    "energy": energy,
    "halving": halving,
    "drives": drives,
    "parity": parity,
}
"""The proofs by name."""


def prove(job: tuple[str, str]) -> dict[str, Any]:
    """One proof of one rover."""
    proof, rover = job
    begun = time.monotonic()
    found = PROOFS[proof](rover)
    passed = None if found["limit"] is None else bool(found["value"] <= found["limit"])
    return {"proof": proof, "rover": rover, "passed": passed, **found, "seconds": round(time.monotonic() - begun, 1)}


def main() -> int:
    """See the module's docstring."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--proofs", default=",".join(PROOFS))
    parser.add_argument("--rovers", default="luvmi_x,viper")
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/acceptance.json"))
    options = parser.parse_args()
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    from provenance import commit
    from timing import cpu_name

    jobs = [(p, r) for p in options.proofs.split(",") for r in options.rovers.split(",")]
    record: dict[str, Any] = {"about": {"preset": PRESET}, "rows": []}
    if options.out.is_file():
        record["rows"] = json.loads(options.out.read_text(encoding="utf-8"))["rows"]
    measured = {"commit": commit(), "cpu": cpu_name()}
    context = multiprocessing.get_context("spawn")
    # a process of its own for every proof: what one has compiled is of no use to the next
    with concurrent.futures.ProcessPoolExecutor(options.processes, context, max_tasks_per_child=1) as pool:
        for done in concurrent.futures.as_completed([pool.submit(prove, job) for job in jobs]):
            row = done.result() | measured
            kept = [r for r in record["rows"] if (r["proof"], r["rover"]) != (row["proof"], row["rover"])]
            record["rows"] = sorted([*kept, row], key=lambda r: (list(PROOFS).index(r["proof"]), r["rover"]))
            print(row, flush=True)
            options.out.parent.mkdir(parents=True, exist_ok=True)
            options.out.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    return int(any(row["passed"] is False for row in record["rows"] if (row["proof"], row["rover"]) in jobs))


if __name__ == "__main__":
    raise SystemExit(main())
