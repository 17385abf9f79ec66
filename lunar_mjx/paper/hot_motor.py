"""The seed paper's Fig. 3: 15 N m asked of all drive motors with blocked wheels, until the winding is too hot."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import build
from lunar_mjx.effects.presets import PRESET_PARAMETERS
from lunar_mjx.model import ZERO_CELSIUS, make_model

DESIRED_TORQUE = 15.0
"""N m, the seed paper's."""


@dataclasses.dataclass(frozen=True)
class HotMotor:
    """One run of the experiment, for the motor that starts at the left front; arrays over time.

    Attributes:
      preset: physics of the run. time: s. winding, housing: temperatures, degC. torque: actual, at the joint, N m.
      desired: N m. cutoff_time: when the torque drops to zero, s; NaN if it never does.
    """

    preset: str
    time: np.ndarray
    winding: np.ndarray
    housing: np.ndarray
    torque: np.ndarray
    desired: float
    cutoff_time: float


def hot_motor(preset: str, duration: float = 14.0, rover: str = "luvmi_x") -> HotMotor:
    """Runs the experiment on flat ground with the parking brake set.

    Both presets get the motor that the preset `paper` states (winding, gear), so that they differ in physics only.

    Args:
      preset: "paper" or "consistent".
      duration: s.
      rover: name or folder of a rover.
    """
    # Blocked by the parking brake: the torque is asked for and nothing turns, so that all power becomes heat.
    model = make_model(rover, "flat", preset, modes={"drive": "torque"}).add("parking_brake")
    model = model.set("motor", **PRESET_PARAMETERS["paper"]["motor"])
    model = model.set("joint_control", **PRESET_PARAMETERS["paper"]["joint_control"])
    if preset != "paper":
        # Gains go with the gear, and the gear is the paper's here.
        paper = make_model(rover, "flat", "paper")
        model = model.replace(gains=paper.gains)
    system = build(model)
    drives = len(model.rover.wheels)
    control = jnp.zeros(len(system.joint_names)).at[:drives].set(DESIRED_TORQUE)
    # Every 20 ms at the usual time step: so well is the moment of the cut-off known.
    steps_per_record = 10
    samples = round(duration / (steps_per_record * model.timestep))
    run = jax.jit(lambda p, s: system.rollout(p, s, jnp.tile(control, (samples, 1)), every=steps_per_record)[1])
    seen = jax.device_get(run(system.params, system.reset(system.params)))
    # All motors do the same on level ground: the first one stands for them.
    winding = np.asarray(seen.winding_temperature)[:, 0] - ZERO_CELSIUS
    # The cut-off alone makes a torque that is asked for exactly zero.
    off = np.flatnonzero(np.asarray(seen.joint_torque)[:, 0] == 0.0)
    time = np.asarray(seen.time)
    return HotMotor(
        preset=preset,
        time=time,
        winding=winding,
        housing=np.asarray(seen.housing_temperature)[:, 0] - ZERO_CELSIUS,
        torque=np.asarray(seen.joint_torque)[:, 0],
        desired=DESIRED_TORQUE,
        cutoff_time=float(time[off[0]]) if off.size else float("nan"),
    )
