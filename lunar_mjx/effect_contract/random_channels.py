"""Random log channels on which an effect at the port `sensor` is probed (`contract`)."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effect_contract import random_rovers as probe
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.sensor.channels import SensorContext, Signals

WHEELS = ("lf", "rf", "lr", "rr")
KINDS = ("drive", "steer", "sus")
_SAMPLES = 24
"""Samples of a random drive."""
_RATE = 20.0
"""Samples a second: a drive lasts 1.15 s."""


def _channels() -> dict[str, float]:
    """Names of all channels of a rover, and how large they are."""
    sizes = {f"quaternion_{a}": 1.0 for a in "wxyz"} | {f"{a}_deg": 20.0 for a in ("roll", "pitch", "yaw")}
    for axis in "xyz":
        sizes |= {f"position_{axis}_m": 2.0, f"world_velocity_{axis}_m_s": 0.2, f"body_velocity_{axis}_m_s": 0.2}
        sizes |= {f"gyro_{axis}_rad_s": 0.2, f"accelerometer_{axis}_m_s2": 2.0}
    for joint in (f"{w}_{k}" for w in WHEELS for k in KINDS):
        sizes |= {f"joint_{joint}_angle_rad": 1.0, f"joint_{joint}_speed_rad_s": 1.0}
        sizes |= {f"motor_{joint}_torque_Nm": 10.0, f"motor_{joint}_current_A": 1.0, f"motor_{joint}_voltage_V": 12.0}
        sizes |= {f"{node}_{joint}_temperature_degC": 40.0 for node in ("winding", "housing")}
    for wheel in WHEELS:
        sizes |= {
            f"wheel_{wheel}_sinkage_m": 0.02,
            f"wheel_{wheel}_slip_ratio": 0.5,
            f"wheel_{wheel}_slip_angle_deg": 9,
        }
        sizes |= {f"wheel_{wheel}_force_{a}_N": 100.0 for a in "xyz"}
        sizes |= {f"wheel_{wheel}_moment_{a}_Nm": 10.0 for a in "xyz"}
    return sizes


def channel_states(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random smooth channels of shape (count, time); the first drive stands still, all its channels zero."""
    rng = np.random.default_rng(seed)
    time = np.arange(_SAMPLES) / _RATE
    out = {}
    for name, size in _channels().items():
        waves = rng.normal(size=(3, count, 1)), rng.uniform(0.5, 4.0, (3, count, 1)), rng.uniform(0, 7, (3, count, 1))
        out[name] = size * np.sum(waves[0] * np.sin(waves[1] * time + waves[2]), axis=0)
        # At rest roots and quotients lose their derivatives, as on rovers.
        out[name][0] = 0.0
    # Attitudes are unit quaternions; the drive at rest has the one without a turn.
    length = np.sqrt(sum(out[f"quaternion_{a}"] ** 2 for a in "wxyz"))
    for a in "wxyz":
        out[f"quaternion_{a}"] = np.where(
            length > 0.0, out[f"quaternion_{a}"] / np.maximum(length, 1e-9), float(a == "w")
        )
    return out


def act_on_channels(effect: Effect, values: Mapping[str, Any] | None, channels: Mapping[str, Any]) -> dict[str, Any]:
    """The channels of one drive as the effect lets them be measured; `values` None: the true ones."""
    if values is None:
        return dict(channels)
    time = jnp.arange(_SAMPLES) / _RATE
    ctx = SensorContext(
        time=time,
        gravity=jnp.asarray(probe.RANDOM_ROVERS.gravity),
        ambient_temperature=jnp.full_like(time, probe.RANDOM_ROVERS.ambient),
        rover=probe.rover(len(WHEELS)),
        parameters={effect.name: SimpleNamespace(**values)},
        joints=tuple(f"{w}_{k}" for w in WHEELS for k in KINDS),
        wheels=WHEELS,
    )
    memory = SimpleNamespace(**{k: v.initial for k, v in effect.state.items()})
    out = effect.ports["sensor"](ctx, SimpleNamespace(**values), memory, Signals(time, dict(channels)))
    signals = out[0] if isinstance(out, tuple) else out
    return dict(signals.channels)
