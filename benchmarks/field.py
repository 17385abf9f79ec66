"""What each effect of `field` does to VIPER's slope stall, stopping distance, dig-in and drift; other presets beside.

    python benchmarks/field.py --out benchmarks/field.json

Rows: the three presets, `field` with the closed form in place of the stress integral, and `field` with one effect at
its null value. Columns, in lunar nominal soil with 0.2 m/s asked of the rims:
  stall     slope at which the rover's slip reaches 0.95, by interpolation between slopes 2 deg apart, over the last 3 s
            of 10 s; the slope at 40 % slip likewise
  stop      way within 4 s of the command to stop, 15 deg downhill, wheels held at rest by their motors; and the speed
            that is left then
  dig-in    deepest wheel after 10 s of spinning on a slope of 25 deg, which no preset climbs
  housing   how much the warmest drive's housing warms in these 10 s
  drift     way down per way ahead, across a slope of 10 deg, in the last 3 s
  fastest   speed on the level where 3 m/s are asked, and the motors' largest voltage
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from provenance import commit

from lunar_mjx.dynamics import Params, build
from lunar_mjx.model import Model, make_model
from lunar_mjx.terrain import inclined, stack

CLIMBS_DEG = tuple(range(2, 25, 2))
DOWNHILL_DEG, TOO_STEEP_DEG, ACROSS_DEG, FAST = -15.0, 25.0, 10.0, 3.0
LAST = 30
"""Commands over which the end of a drive is averaged: 3 s."""
RIM_SPEED = 0.2
EVERY, INTERVALS = 50, 100
"""Steps per command and commands: 10 s."""
BRAKE_AT, BRAKED_FOR = 40, 40
"""Commands before the one to stop, and until the way is read: 4 s each."""
STALL_SLIP = 0.95

NULLS: dict[str, dict[str, float]] = {
    "voltage_saturation": {"limit": 0.0},
    "directional_gear_efficiency": {"asymmetry": 0.0},
    "slip_sinkage": {"driving": 0.0, "skid": 0.0},
    "multipass": {"plastic": 0.0},
    "skid_shear": {"share": 0.0, "reversal": 0.0},
    "friction_circle": {"share": 0.0},
    "bulldozing": {"front": 0.0, "side": 0.0},
    "rolling_resistance": {"coefficient": 0.0},
    "gear_friction_heat": {"share": 0.0},
}


def drive(model: Model, variants: list[dict[str, dict[str, float]]]) -> Any:
    """Telemetry of every variant on every slope, leading axes (variant, slope, time)."""
    system = build(model, "structured")
    kinds = [*CLIMBS_DEG, "down", "steep", "across", "level"]
    rows = [(v, kind) for v in variants for kind in kinds]
    slopes = {"down": DOWNHILL_DEG, "steep": TOO_STEEP_DEG, "across": ACROSS_DEG, "level": 0.0}
    planes = {k: inclined(np.deg2rad(slopes.get(k, k)), 200.0, np.pi / 2 if k == "across" else 0.0) for k in kinds}
    ground = jax.tree.map(jnp.asarray, stack([dataclasses.replace(planes[k], name="plane") for _, k in rows]))
    changed = {(effect, name) for v in variants for effect, values in v.items() for name in values}
    effects = {name: dict(values) for name, values in system.params.effects.items()}
    axes: Any = {name: dict.fromkeys(values) for name, values in effects.items()}
    for effect, name in changed:
        own = effects[effect][name]
        effects[effect][name] = jnp.stack([own * 0.0 + v.get(effect, {}).get(name, own) for v, _ in rows])
        axes[effect][name] = 0
    params = dataclasses.replace(system.params, effects=effects, terrain=ground)
    each = Params(gravity=None, ambient=None, effects=axes, terrain=0)
    drives = np.array([1.0 if g.name == "drive" else 0.0 for g in model.rover.groups for _ in g.joints])
    go = np.tile(drives * RIM_SPEED / model.rover.wheels[0].radius, (len(rows), INTERVALS, 1))
    for i, (_, kind) in enumerate(rows):
        if kind == "down":
            go[i, BRAKE_AT:] = 0.0
        if kind == "level":
            go[i] *= FAST / RIM_SPEED
    start = [jax.vmap(lambda g: system.reset(dataclasses.replace(system.params, terrain=g)))(ground)]

    def kept(seen: Any) -> Any:
        return (seen.position, seen.velocity, seen.joint_speed, seen.sinkage, seen.housing_temperature, seen.voltage)

    _, seen = jax.jit(lambda p, s, c: system.rollout_batch(p, s, c, EVERY, each, report=kept, one_body=True))(
        params, start[0], jnp.asarray(go, jnp.result_type(float))
    )
    shape = (len(variants), len(kinds))
    return jax.tree.map(lambda a: np.asarray(a).reshape(*shape, *a.shape[1:]), seen)


def crossing(x: np.ndarray, y: np.ndarray, level: float) -> float | None:
    """Where y first rises through `level`; None where it does not within x."""
    above = np.flatnonzero(y >= level)
    if not above.size or above[0] == 0:
        return None
    i = above[0]
    return float(x[i - 1] + (level - y[i - 1]) / (y[i] - y[i - 1]) * (x[i] - x[i - 1]))


def judge(model: Model, variants: list[dict[str, dict[str, float]]]) -> list[dict[str, Any]]:
    """The columns, one row per variant."""
    position, velocity, joint_speed, sinkage, housing, voltage = drive(model, variants)
    wheels, radius = len(model.rover.wheels), model.rover.wheels[0].radius
    climbs = len(CLIMBS_DEG)
    down, steep, across, level = range(climbs, climbs + 4)
    out = []
    for i in range(len(variants)):
        speed = np.hypot(velocity.x[i], velocity.z[i]) * np.sign(velocity.x[i])
        rims = joint_speed[i][..., :wheels].mean(-1) * radius
        slip = 1.0 - speed[:climbs, -LAST:].mean(-1) / rims[:climbs, -LAST:].mean(-1)
        braked, read = BRAKE_AT, BRAKE_AT + BRAKED_FOR
        way = np.hypot(*(axis[i, down, read] - axis[i, down, braked] for axis in (position.x, position.z)))
        drifted = position.y[i, across, -LAST] - position.y[i, across, -1]
        ahead = position.x[i, across, -1] - position.x[i, across, -LAST]
        out.append(
            {
                "slope_at_40_percent_slip_deg": crossing(np.array(CLIMBS_DEG), slip, 0.40),
                "stall_slope_deg": crossing(np.array(CLIMBS_DEG), slip, STALL_SLIP),
                "slip_by_slope": dict(zip(map(str, CLIMBS_DEG), slip.round(4).tolist(), strict=True)),
                "stopping_distance_m": float(way),
                "speed_left_m_s": float(abs(speed[down, read])),
                "dig_in_m": float(sinkage[i, steep, -1].max()),
                "sinkage_on_2_deg_m": sinkage[i, 0, -1].round(5).tolist(),
                "housing_rise_K": float((housing[i, steep, -1] - housing[i, steep, 0])[:wheels].max()),
                "drift_across_10_deg": float(drifted / ahead / np.cos(np.deg2rad(ACROSS_DEG))),
                "fastest_m_s": float(speed[level, -1]),
                "largest_voltage_V": float(np.abs(voltage[i, level, -LAST:, :wheels]).max()),
            }
        )
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rover", default="viper")
    parser.add_argument("--out", type=Path, default=Path("benchmarks/field.json"))
    arguments = parser.parse_args()
    rows: dict[str, Any] = {}
    for preset in ("paper", "consistent"):
        rows[preset] = judge(make_model(arguments.rover, "flat", preset), [{}])[0]
    field = make_model(arguments.rover, "flat", "field")
    closed = field.remove("stress_integral").add("pressure_sinkage").add("closed_form_shear")
    rows["field, closed form"] = judge(closed, [{}])[0]
    without = [{effect: values} for effect, values in NULLS.items()]
    names = ["field", *(f"field without {effect}" for effect in NULLS)]
    rows |= dict(zip(names, judge(field, [{}, *without]), strict=True))
    for name, row in rows.items():
        print(name, {k: v for k, v in row.items() if k != "slip_by_slope"}, flush=True)
    arguments.out.write_text(json.dumps({"commit": commit(), "rover": arguments.rover, "rows": rows}, indent=1) + "\n")


if __name__ == "__main__":
    main()
