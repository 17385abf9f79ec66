"""The seed paper's Fig. 5: constant torque drives straight on hard ground, and deviates on soft soil.

On a symmetric rover and flat ground nothing makes it deviate, so the asymmetry is stated: soil that grows softer to one
side (effect `soil_gradient`). On hard ground it does not act at all; on soft soil the wheels on the softer side sink
deeper and drag.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import build
from lunar_mjx.model import make_model

TORQUE = 15.0
"""N m at every drive joint, the seed paper's."""
GRADIENT = 0.5
"""1/m: the soil's moduli fall to one side by exp(-0.5) a metre; 26 % below their mean under VIPER's wheels there."""


@dataclasses.dataclass(frozen=True)
class SoftGround:
    """One run: path and heading over time.

    Attributes:
      preset, ground: physics and "hard" or "soft". side: +1 where the soft side is the left, -1 the right.
      time: s. x, y: of the chassis frame, m. yaw: rad. sinkage: (time, wheel), m.
    """

    preset: str
    ground: str
    side: int
    time: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    sinkage: np.ndarray


def soft_ground(preset: str, duration: float = 6.0, rover: str = "viper", torque: float = TORQUE) -> list[SoftGround]:
    """Runs the experiment on hard and soft ground, with the soft side on the left and, mirrored, on the right.

    In float64: the preset `paper` carries a wheel on 0.2 mm of penetration, of which float32 loses 1e-4. The load is so
    uncertain by 0.02 N, as much as the soil's forces, and the paths missed their mirror images by 2.3 % of the drift.

    Args:
      preset: "paper" or "consistent".
      duration: s of constant torque, after 3 s in which the rover settles.
      rover: name or folder of a rover.
      torque: N m at every drive joint.

    Returns:
      Four runs: hard and soft, left and right.
    """
    with jax.enable_x64(True):
        return _soft_ground(preset, duration, rover, torque)


def _soft_ground(preset: str, duration: float, rover: str, torque: float) -> list[SoftGround]:
    model = make_model(rover, "flat", preset, modes={"drive": "torque"})
    model = model.add("hard_surface").add("soil_gradient")
    system = build(model)
    # Twenty rows a second: paths are smooth.
    every, drives = 25, len(model.rover.wheels)
    per_second = round(1.0 / (every * model.timestep))
    push = jnp.zeros(len(system.joint_names)).at[:drives].set(torque)
    # Three seconds without torque first, in which the wheels sink in: else the drop would be part of the path.
    controls = jnp.concatenate(
        [jnp.zeros((3 * per_second, push.size)), jnp.tile(push, (round(duration * per_second), 1))]
    )

    def run(hard: jax.Array, north: jax.Array):
        # Ground and soft side are parameters, so that all four runs are one program.
        effects = dict(system.params.effects)
        effects["hard_surface"] = {"fraction": hard}
        effects["soil_gradient"] = {**effects["soil_gradient"], "north": north}
        params = dataclasses.replace(system.params, effects=effects)
        return system.rollout(params, system.reset(params), controls, every=every)[1]

    cases = [("hard", 1), ("hard", -1), ("soft", 1), ("soft", -1)]
    hard = jnp.array([1.0 if ground == "hard" else 0.0 for ground, _ in cases])
    north = jnp.array([-side * GRADIENT for _, side in cases])
    seen = jax.device_get(jax.jit(jax.vmap(run))(hard, north))
    start = 3 * per_second
    return [
        SoftGround(
            preset=preset,
            ground=ground,
            side=side,
            time=np.asarray(seen.time)[i, start:] - np.asarray(seen.time)[i, start],
            x=np.asarray(seen.position.x)[i, start:],
            y=np.asarray(seen.position.y)[i, start:],
            yaw=np.asarray(seen.euler.z)[i, start:],
            sinkage=np.asarray(seen.sinkage)[i, start:],
        )
        for i, (ground, side) in enumerate(cases)
    ]
