"""Whole-rover campaigns with hidden effects: native MuJoCo in float64 under NumPy forces, at another step size.

A campaign is a folder of log folders, with the sealed answer beside it (`answers/NAME.json`): logs can be made on one
machine and scored on another. Cases of one number are the same for the same seed.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import shutil
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.backends import NativeBackend
from lunar_mjx.logs import write_log
from lunar_mjx.logs.log import Noise
from lunar_mjx.model import Model, make_model
from lunar_mjx.simulate import Commands, joint_channels

from . import drive_effects
from .noise import NOISES, Recipe, ar1, rounded, smooth

GROUPS: Mapping[str, int] = {"nulls": 34, "singles": 44, "pairs": 12, "outside": 10}
"""Groups of campaigns and their number in the whole benchmark."""
ROVER, STEP, INTERVAL = "luvmi_x", 1e-3, 0.05
SETTLE, LENGTH = 1.5, 10.0
"""s: at rest before the log begins, and the log."""
GRAVITY, AMBIENT_degC = 1.625, 25.0
PAYLOAD_kg, PAYLOAD_AT = 15.0, (0.0, 0.0, 0.2)

SIGMA = {
    "position": 0.005,
    "world_velocity": 0.005,
    "roll": 0.1,
    "pitch": 0.1,
    "yaw": 0.2,
    "joint": 0.005,
    "winding": 0.3,
    "housing": 0.3,
}
"""Datasheet noise by the beginning of a channel's name, in its unit."""
_ELECTRICAL = {"A": 0.01, "V": 0.05}


@dataclasses.dataclass(frozen=True)
class Manoeuvre:
    """What is driven: name, terrain, whether with the payload, split, and the courses of drive (rad/s) and steering."""

    name: str
    terrain: str
    payload: bool
    split: str
    drive: tuple[tuple[float, float], ...]
    steer: tuple[tuple[float, float], ...] = ((0.0, 0.0),)


MANOEUVRES = (
    Manoeuvre(
        "speed_steps",
        "flat",
        False,
        "fit",
        ((0, 0), (1, 0), (1.2, 1), (3, 1), (3.2, 2.5), (6, 2.5), (6.2, 4), (8.5, 4), (9, 0)),
    ),
    Manoeuvre(
        "reversals",
        "flat",
        False,
        "fit",
        ((0, 0), (1, 0), (1.3, 2), (3, 2), (3.5, -2), (5.5, -2), (6, 3), (8, 3), (8.5, -1), (10, -1)),
    ),
    Manoeuvre(
        "steering",
        "flat",
        False,
        "select",
        ((0, 0), (1, 0), (1.5, 2), (9, 2), (9.5, 0)),
        ((0, 0), (2, 0), (3, 0.15), (5, 0.15), (6, -0.15), (8, -0.15), (9, 0)),
    ),
    Manoeuvre("climb", "slope:8deg", False, "fit", ((0, 0), (1, 0), (1.5, 1.5), (5, 1.5), (5.5, 3), (9, 3), (9.5, 0))),
    Manoeuvre(
        "descent",
        "slope:8deg",
        False,
        "select",
        ((0, 0), (1, 0), (1.5, -1.5), (5, -1.5), (6, 0), (7, 0), (7.5, -2.5), (10, -2.5)),
    ),
    Manoeuvre(
        "loaded", "flat", True, "fit", ((0, 0), (1, 0), (1.3, 1), (4, 1), (4.3, 3), (7, 3), (7.5, -1.5), (10, -1.5))
    ),
)


def draw(group: str, number: int, seed: int) -> tuple[dict[str, Any], np.random.Generator]:
    """What is hidden in a campaign: effects, the true soil, and the noise."""
    rng = np.random.default_rng([seed % 2**63, 100 + list(GROUPS).index(group), number])
    known, outside = list(drive_effects.KNOWN), list(drive_effects.OUTSIDE)
    names = {
        "nulls": list,
        "singles": lambda: [known[number % len(known)]],
        "pairs": lambda: sorted(str(n) for n in rng.choice(known, 2, replace=False)),
        "outside": lambda: [outside[number % len(outside)]],
    }[group]()
    kinds = {**drive_effects.KNOWN, **drive_effects.OUTSIDE}
    recipe = Recipe(NOISES[(number + number // len(known)) % len(NOISES)])
    soil = {
        "k_phi": 8.2e5 * float(np.exp(rng.normal(0.0, 0.25))),
        "cohesion": float(rng.uniform(100.0, 300.0)),
        "friction_angle": float(np.radians(rng.uniform(32.0, 38.0))),
    }
    answer = {
        "case": f"{group}-{number:03d}",
        "group": group,
        "nonce": rng.bytes(32).hex(),
        "sabotage": "",
        "effects": {n: kinds[n].draw(rng) for n in names},
        "soil": soil,
        "recipe": dataclasses.asdict(recipe),
    }
    return answer, rng


def commitment(answer: Mapping[str, Any]) -> str:
    """SHA-256 of an answer in one canonical spelling."""
    text = json.dumps(answer, sort_keys=True, separators=(",", ":"))
    return "sha256:" + hashlib.sha256(text.encode()).hexdigest()


def generate(
    group: str, number: int, seed: int, out: Path, manoeuvres: Sequence[Manoeuvre] = MANOEUVRES
) -> dict[str, Any]:
    """Makes one campaign: log folders under `out/logs/NAME`, the answer as `out/answers/NAME.json`.

    Returns:
      A row for the screen.
    """
    began = time.monotonic()
    answer, rng = draw(group, number, seed)
    name = answer["case"]
    folder = out / "logs" / name
    if folder.exists():
        shutil.rmtree(folder)
    recipe = Recipe(**answer["recipe"])
    seal = commitment(answer)
    for terrain, payload in dict.fromkeys((m.terrain, m.payload) for m in manoeuvres):
        mine = [m for m in manoeuvres if (m.terrain, m.payload) == (terrain, payload)]
        for manoeuvre, frame in zip(mine, _drive(answer, terrain, payload, mine), strict=True):
            _write(folder / manoeuvre.name, manoeuvre, _spoil(frame, recipe, rng), recipe, seal)
    path = out / "answers" / f"{name}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        json.dumps({"answer": answer, "commitment": seal, "seed": str(seed)}, indent=1) + "\n", encoding="utf-8"
    )
    return {"case": name, "seconds": round(time.monotonic() - began, 1)}


def _drive(answer: Mapping[str, Any], terrain: str, payload: bool, manoeuvres: list[Manoeuvre]) -> list[pd.DataFrame]:
    """Clean channels of manoeuvres that share a terrain, driven side by side."""
    model = make_model(ROVER, terrain=terrain, timestep=STEP).set("soil", **answer["soil"])
    if payload:
        model = model.add("payload", mass=PAYLOAD_kg, **dict(zip("xyz", PAYLOAD_AT, strict=True)))
    kinds = {**drive_effects.KNOWN, **drive_effects.OUTSIDE}
    driven = np.array(["drive" in j for j in joint_channels(model.rover)], float)
    hooks = [hook(p, driven) for n, p in answer["effects"].items() if (hook := kinds[n].hook) is not None]
    backend = NativeBackend(model, hooks, rovers=len(manoeuvres))
    backend.reset()
    joints = len(model.rover.joints)
    for _ in range(round(SETTLE / STEP)):
        backend.step(np.zeros((len(manoeuvres), joints)))
    state = backend.state()
    state.step = 0
    state.winding_temperature[:] = state.housing_temperature[:] = AMBIENT_degC + 273.15
    backend.set_state(state)
    commands = Commands(np.stack([_commands(model, m) for m in manoeuvres]), INTERVAL)
    seen = backend.run(commands)
    frames = [backend.channels(seen, commands, i) for i in range(len(manoeuvres))]
    backend.close()
    for n, p in answer["effects"].items():
        sensor = kinds[n].sensor
        frames = [sensor(f, p) for f in frames] if sensor is not None else frames
    return frames


def _commands(model: Model, manoeuvre: Manoeuvre) -> np.ndarray:
    """(time, joint) courses; the rear wheels steer against the front ones."""
    t = np.arange(round(LENGTH / INTERVAL)) * INTERVAL
    drive, steer = (np.interp(t, *zip(*course, strict=True)) for course in (manoeuvre.drive, manoeuvre.steer))
    columns = []
    for joint in joint_channels(model.rover):
        side = 1.0 if joint[1] == "f" else -1.0
        columns.append(drive if "drive" in joint else side * steer if "steer" in joint else 0.0 * t)
    return np.stack(columns, axis=1)


def sigma_of(channel: str) -> float | None:
    """Datasheet noise of a channel; None where no instrument measures it."""
    if channel.startswith("motor_"):
        return _ELECTRICAL.get(channel.rsplit("_", 1)[-1]) if "drive" in channel else None
    if channel.startswith(("joint_", "winding_", "housing_")) and "drive" not in channel:
        return None
    if channel.startswith("joint_") and not channel.endswith("speed_rad_s"):
        return None
    if channel.startswith("wheel_"):
        return {"m": 0.002, "ratio": 0.02}.get(channel.rsplit("_", 1)[-1])
    return next((s for begin, s in SIGMA.items() if channel.startswith(begin)), None)


def _spoil(frame: pd.DataFrame, recipe: Recipe, rng: np.random.Generator) -> pd.DataFrame:
    """What the instruments write of the clean channels: noise, dirt, resolution, lost samples."""
    time_s = frame["time_s"].to_numpy()
    out = {"time_s": time_s}
    for channel in frame.columns[1:]:
        values, sigma = frame[channel].to_numpy(float), sigma_of(channel)
        if channel.startswith("command_"):
            out[channel] = values
        elif sigma is not None:
            white = rng.normal(size=len(values))
            noise = 0.8 * ar1(rng, len(values), 0.9) + 0.6 * white if recipe.kind == "coloured" else white
            seen = values + sigma * (recipe.scale * noise + recipe.dirt * smooth(rng, time_s[:, None] / 2.0))
            if recipe.kind == "quantised":
                seen = rounded(seen, 0.7 * sigma)
                seen[rng.random(len(seen)) < 0.03] = np.nan
            out[channel] = seen
    return pd.DataFrame(out)


def _write(folder: Path, m: Manoeuvre, frame: pd.DataFrame, recipe: Recipe, seal: str) -> None:
    slow = [c for c in frame if c.endswith("temperature_degC")]
    every = round(1.0 / INTERVAL)
    tables = {"drive": frame.drop(columns=slow), "thermal": frame[["time_s", *slow]].iloc[::every]}
    noise = {c: Noise(recipe.scale * s, "datasheet") for c in frame if (s := sigma_of(c))}
    changes = {"payload_kg": PAYLOAD_kg, "payload_position_m": list(PAYLOAD_AT)} if m.payload else None
    write_log(
        folder,
        tables,
        rover=ROVER,
        noise=noise,
        manoeuvre=m.name,
        gravity_m_s2=GRAVITY,
        terrain=m.terrain,
        split=m.split,
        environment={"ambient_temperature_degC": AMBIENT_degC},
        rover_changes=changes,
        commitment=seal,
    )


def waiting(folder: Path) -> list[tuple[str, int]]:
    """Campaigns that lie in a folder, nulls first."""
    names = sorted(p.stem for p in (folder / "answers").glob("*.json"))
    jobs = [(n.rpartition("-")[0], int(n.rpartition("-")[2])) for n in names]
    return sorted(jobs, key=lambda job: ((job[1] + 0.5) / GROUPS[job[0]], list(GROUPS).index(job[0])))
