"""A small campaign of drives by native MuJoCo with NumPy forces, which share no code with what is tested."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx.backends import Hook, NativeBackend
from lunar_mjx.logs import write_log
from lunar_mjx.logs.log import Noise
from lunar_mjx.model import make_model
from lunar_mjx.simulate import command_channels
from lunar_mjx.terrain.heightfield import HeightField

SIGMA = {"position": 0.003, "world": 0.005, "joint": 0.01, "motor": 0.02, "yaw": 0.1, "roll": 0.1, "pitch": 0.1}
INTERVAL, STEP = 0.1, 0.0025
Profile = Callable[[float], float]
PROFILES: tuple[Profile, ...] = (
    lambda t: float(np.interp(t, [0.5, 1.0, 3.0], [0.0, 2.0, 2.0])),
    lambda t: float(np.interp(t, [0.5, 1.0, 1.6, 2.2, 3.0], [0.0, 1.0, 3.0, -1.5, -1.5])),
    lambda t: float(np.interp(t, [0.5, 0.8, 1.8, 2.4, 3.0], [0.0, -2.5, -0.4, 0.4, 1.5])),
)


def drive_campaign(
    folder: Path,
    hooks: Sequence[Hook] = (),
    seconds: float = 3.0,
    seed: int = 0,
    noise: float = 1.0,
    forms: Sequence[str] = (),
    encoders_every: int = 1,
    ground: HeightField | None = None,
) -> Path:
    """Writes one log per profile under `folder`: commands, motion, motors, with white noise; returns the folder.

    `forms` names effects that take the place of some of the model's. Wheels are read at every so many rows, in a table
    of their own where that is not each. `ground` is what lies there in truth; the logs say that it is flat, and
    hold roll and pitch.
    """
    rng = np.random.default_rng(seed)
    model = make_model("luvmi_x", terrain="flat", timestep=STEP)
    for form in forms:
        model = model.add(form)
    if ground is not None:
        model = model.replace(terrain=dataclasses.replace(model.terrain, field=ground))
    for number, profile in enumerate(PROFILES):
        frame = _drive(model, hooks, profile, seconds, ground is not None)
        stated = {}
        for channel in [c for c in frame if c != "time_s" and not c.startswith("command")]:
            std = noise * SIGMA[channel.partition("_")[0]]
            stated[channel] = Noise(std, "datasheet")
            frame[channel] += rng.normal(0.0, std, len(frame))
        tables = {"drive": frame}
        if encoders_every > 1:
            joints = [c for c in frame if c.startswith("joint")]
            slow = frame[["time_s", *joints]].iloc[::encoders_every]
            tables = {"drive": frame.drop(columns=joints), "encoders": slow}
        write_log(
            folder / f"drive{number}",
            tables,
            rover="luvmi_x",
            noise=stated,
            manoeuvre=f"drive{number}",
            gravity_m_s2=model.gravity,
            terrain="flat",
            environment={"ambient_temperature_degC": 25.0},
            split="fit",
        )
    return folder


def _drive(model: Any, hooks: Sequence[Hook], profile: Profile, seconds: float, tilt: bool) -> pd.DataFrame:
    backend = NativeBackend(model, hooks=list(hooks))
    backend.reset()
    names = command_channels(model)
    drives = np.array(["drive" in n for n in names])
    still = np.zeros((1, len(names)))
    for _ in range(round(2.0 / STEP)):
        backend.step(still)
    state = backend.state()
    state.step = 0
    state.winding_temperature[:] = state.housing_temperature[:] = 298.15
    backend.set_state(state)
    rows = []
    for i in range(round(seconds / INTERVAL) + 1):
        command = np.where(drives, profile(i * INTERVAL), 0.0)[None]
        for k in range(round(INTERVAL / STEP)):
            backend.step(command)
            if k == 0:
                seen = backend.observe()
                rows.append(_row(model, names, i * INTERVAL, command[0], seen))
                if tilt:
                    rows[-1] |= {
                        f"{a}_deg": float(np.degrees(seen["euler"][0, k])) for k, a in enumerate(("roll", "pitch"))
                    }
    return pd.DataFrame(rows)


def _row(model: Any, names: Sequence[str], time: float, command: np.ndarray, seen: Any) -> dict[str, float]:
    row = {"time_s": time, **dict(zip(names, command, strict=True)), "yaw_deg": float(np.degrees(seen["euler"][0, 2]))}
    for i, axis in enumerate("xyz"):
        row[f"position_{axis}_m"] = seen["position"][0, i]
        row[f"world_velocity_{axis}_m_s"] = seen["velocity"][0, i]
    for i, joint in enumerate(model.rover.joints):
        name = next((f"{w.corner}_drive" for w in model.rover.wheels if w.drive == joint), None)
        if name is not None:
            row[f"joint_{name}_speed_rad_s"] = seen["joint_speed"][0, i]
            row[f"motor_{name}_current_A"] = seen["current"][0, i]
            row[f"motor_{name}_voltage_V"] = seen["voltage"][0, i]
    return row
