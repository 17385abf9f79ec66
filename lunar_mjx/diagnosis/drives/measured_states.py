"""What a log tells of the rover's state in the middle of a drive, and simulations that begin anew there."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.quaternions import integrate, rotation
from lunar_mjx.dynamics.spatial_algebra import Vector
from lunar_mjx.dynamics.state import Params
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.model import ZERO_CELSIUS
from lunar_mjx.terrain.heightfield import height, normal

if TYPE_CHECKING:
    from lunar_mjx.logs import Log

_NEAR = 0.25
"""Time about a moment in which samples tell the state then, s."""
_FEWEST = 3
"""Samples that do so; there are some on both sides."""


def measured_states(log: Log, joints: Sequence[str], times: np.ndarray) -> dict[str, np.ndarray]:
    """What a log tells of the rover's state at some times, by lines through the samples about them.

    Args:
      log: of a drive. joints: channels' names of the actuated joints. times: (k,) common times, s.

    Returns:
      `pose` (k, 3) x m, y m, yaw rad; `winding` and `housing` (k, joints) K; NaN where it is not measured.
    """
    out = {"pose": np.full((len(times), 3), np.nan)}
    for i, (channel, scale) in enumerate((("position_x_m", 1.0), ("position_y_m", 1.0), ("yaw_deg", np.pi / 180.0))):
        found = log.channel(channel)
        if found is not None:
            values = np.unwrap(found[1] * scale) if channel == "yaw_deg" else found[1]
            out["pose"][:, i] = _lines(found[0], values, times)
    for part in ("winding", "housing"):
        out[part] = np.full((len(times), len(joints)), np.nan)
        for i, joint in enumerate(joints):
            found = log.channel(f"{part}_{joint}_temperature_degC")
            if found is not None:
                out[part][:, i] = _lines(*found, times) + ZERO_CELSIUS
    return out


def _lines(time: np.ndarray, value: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """(k,) values at times of straight lines through the samples about them; NaN where there are too few."""
    out = np.full(len(wanted), np.nan)
    for k, at in enumerate(wanted):
        near = np.abs(time - at) <= _NEAR
        t = time[near] - at
        if len(t) >= _FEWEST and t[0] <= 0.0 <= t[-1] and t[0] < t[-1]:
            out[k] = np.polynomial.polynomial.polyfit(t, value[near], 1)[0]
    return out


def begin_at(params: Params, state: Any, measured: Mapping[str, Any]) -> Any:
    """A rover's state with pose and temperatures as measured, where they are; else as it is.

    It keeps its height over the ground and its attitude to it: a turn is about the normal.
    """
    x, y = state.qpos[0], state.qpos[1]
    field = params.terrain.field
    pose = measured["pose"]
    to_x, to_y = jnp.where(jnp.isnan(pose[0]), x, pose[0]), jnp.where(jnp.isnan(pose[1]), y, pose[1])
    z = state.qpos[2] + height(field, to_x, to_y) - height(field, x, y)
    q = [state.qpos[i] for i in range(3, 7)]
    yaw = jnp.arctan2(2.0 * (q[0] * q[3] + q[1] * q[2]), 1.0 - 2.0 * (q[2] ** 2 + q[3] ** 2))
    turn = jnp.where(jnp.isnan(pose[2]), 0.0, jnp.arctan2(jnp.sin(pose[2] - yaw), jnp.cos(pose[2] - yaw)))
    # about the normal of the ground, in coordinates of the body
    spin = rotation(q).undo(Vector(*(turn * n for n in normal(field, to_x, to_y))))
    velocity = [
        state.qvel[0] * jnp.cos(turn) - state.qvel[1] * jnp.sin(turn),
        state.qvel[0] * jnp.sin(turn) + state.qvel[1] * jnp.cos(turn),
    ]
    qpos = state.qpos.at[:7].set(jnp.stack([to_x, to_y, z, *integrate(q, spin, 1.0)]))
    heat, offset = {}, {}
    for part in ("winding", "housing"):
        known = jnp.logical_not(jnp.isnan(measured[part]))
        heat[part] = jnp.where(known, measured[part] - REFERENCE_TEMPERATURE, getattr(state.temperature, part))
        offset[f"{part}_lost"] = jnp.where(known, 0.0, getattr(state.temperature, f"{part}_lost"))
    return dataclasses.replace(
        state,
        qpos=qpos,
        qvel=state.qvel.at[:2].set(jnp.stack(velocity)),
        temperature=dataclasses.replace(state.temperature, **heat, **offset),
    )
