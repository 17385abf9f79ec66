"""Which slope does a rover climb, and with how much slip? A check against the soil model's plausibility figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import build
from lunar_mjx.model import Model, make_model
from lunar_mjx.terrain import inclined, stack


@dataclasses.dataclass(frozen=True)
class SlopeRun:
    """Steady driving straight up one slope.

    Attributes:
      slope_deg: inclination. speed: up the slope, m/s. rim_speed: mean of the wheels', m/s.
      slip: 1 - speed/rim speed, of the whole rover. wheel_slip: (wheel,) mean slip ratio.
      sinkage: (wheel,) mean, m. torque: (wheel,) mean, N m.
    """

    slope_deg: float
    speed: float
    rim_speed: float
    slip: float
    wheel_slip: np.ndarray
    sinkage: np.ndarray
    torque: np.ndarray


def slope_runs(
    slopes_deg: Sequence[float],
    model: Model | None = None,
    rim_speed: float = 0.2,
    duration: float = 15.0,
    average: float = 5.0,
) -> list[SlopeRun]:
    """Drives up each slope at a commanded rim speed and averages the end of the run.

    Args:
      slopes_deg: inclinations, deg.
      model: model with a velocity-controlled drive; VIPER in lunar nominal soil if None. Its terrain is replaced.
      rim_speed: commanded, m/s.
      duration: of the run, s.
      average: last part of the run that is averaged, s.
    """
    model = make_model("viper", "flat") if model is None else model
    system = build(model)
    radius = model.rover.wheels[0].radius
    # The ground is a parameter, too: all slopes are one batch of one program.
    terrain = stack([inclined(np.deg2rad(s)) for s in slopes_deg])
    terrain = jax.tree.map(jnp.asarray, terrain)
    control = jnp.zeros(len(system.joint_names)).at[: len(model.rover.wheels)].set(rim_speed / radius)
    # Ten rows a second at the usual time step: the mean over seconds needs no more.
    steps_per_record = 50
    samples = round(duration / (steps_per_record * model.timestep))

    def run(ground):
        params = dataclasses.replace(system.params, terrain=ground)
        return system.rollout(params, system.reset(params), jnp.tile(control, (samples, 1)), every=steps_per_record)[1]

    seen = jax.device_get(jax.jit(jax.vmap(run))(terrain))
    # The end alone: from rest, a rover first sinks in and comes up to speed.
    last = slice(samples - round(average / (steps_per_record * model.timestep)), None)

    def mean(values: jax.Array) -> np.ndarray:
        return np.asarray(values)[:, last].mean(axis=1)

    # Along the slope: the horizontal part alone falls short by the cosine.
    speed = np.asarray(np.hypot(seen.velocity.x, seen.velocity.z) * np.sign(seen.velocity.x))[:, last].mean(axis=1)
    wheels = len(model.rover.wheels)
    rims = mean(seen.joint_speed)[:, :wheels] * radius
    slips, sinkage, torque = mean(seen.slip), mean(seen.sinkage), mean(seen.joint_torque)[:, :wheels]
    return [
        SlopeRun(
            slope_deg=float(s),
            speed=float(speed[i]),
            rim_speed=float(rims[i].mean()),
            # Wheels that stand would divide by zero; a rover that slides back has a slip above one.
            slip=float(1.0 - speed[i] / max(rims[i].mean(), 1e-9)),
            wheel_slip=slips[i],
            sinkage=sinkage[i],
            torque=torque[i],
        )
        for i, s in enumerate(slopes_deg)
    ]
