"""The seed paper's Kalman filter for the linear acceleration: state (p, v, a), measurement (p, v), section V.

The three axes do not couple and share one covariance, which does not depend on the data: the gain is a 3 x 2 matrix
that depends only on how many measurements there were. The gains are computed once on the host in float64 (the Riccati
recursion of the textbook filter) and looked up, so that a step costs a few multiplications and agrees with the
nine-state filter.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from lunar_mjx.errors import bad_input, require_finite
from lunar_mjx.pytree import pytree


@dataclasses.dataclass(frozen=True)
class KalmanConfig:
    """Tuning of the filter; the paper gives none of these.

    Attributes:
      jerk: spectral density of the white jerk that moves the acceleration, m/s^2.5. Together with the next two it
        gives the acceleration a time constant of about 0.1 s at a control rate of 10 Hz.
      position_deviation: standard deviation of a measured position, m.
      velocity_deviation: standard deviation of a measured velocity, m/s.
      acceleration_deviation: standard deviation of the acceleration before the first measurement, m/s2.
    """

    jerk: float = 3.0
    position_deviation: float = 0.01
    velocity_deviation: float = 0.02
    acceleration_deviation: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if require_finite("KalmanConfig", field.name, getattr(self, field.name)) <= 0.0:
                raise bad_input(
                    "KalmanConfig",
                    field.name,
                    getattr(self, field.name),
                    "is not positive",
                    "give a standard deviation above zero",
                )


@pytree
class KalmanState:
    """Estimates along the three world axes and the number of measurements taken since the first."""

    position: Float[Array, "*env 3"]
    velocity: Float[Array, "*env 3"]
    acceleration: Float[Array, "*env 3"]
    count: Int[Array, "*env"]


def transition(dt: float) -> np.ndarray:
    """Constant acceleration over `dt`, for one axis (p, v, a)."""
    return np.array([[1.0, dt, 0.5 * dt * dt], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])


def process_noise(dt: float, jerk: float) -> np.ndarray:
    """Covariance that white jerk of spectral density `jerk`^2 adds over `dt` (Bar-Shalom 2001, eq. 6.2.3-7)."""
    return jerk**2 * np.array(
        [[dt**5 / 20, dt**4 / 8, dt**3 / 6], [dt**4 / 8, dt**3 / 3, dt**2 / 2], [dt**3 / 6, dt**2 / 2, dt]]
    )


def gains(config: KalmanConfig, dt: float, most: int = 4096) -> np.ndarray:
    """Gains of the first, second, ... measurement until they no longer change, shape (n, 3, 2), float64."""
    f, q = transition(dt), process_noise(dt, config.jerk)
    h = np.eye(2, 3)
    r = np.diag([config.position_deviation**2, config.velocity_deviation**2])
    # the first measurement is the estimate, so that its errors are the first covariance
    covariance = np.diag([*np.diag(r), config.acceleration_deviation**2])
    table: list[np.ndarray] = []
    for _ in range(most):
        # Gains depend on the count of measurements alone, not on what was measured: a table serves all rovers.
        covariance = f @ covariance @ f.T + q
        gain = np.linalg.solve(h @ covariance @ h.T + r, h @ covariance).T
        # Joseph's form: it stays symmetric and positive under rounding, which (I - K H) P does not
        keep = np.eye(3) - gain @ h
        covariance = keep @ covariance @ keep.T + gain @ r @ gain.T
        table.append(gain)
        # From there on the last row serves for ever.
        if len(table) > 1 and np.abs(table[-1] - table[-2]).max() < 1e-12 * np.abs(gain).max():
            break
    return np.stack(table)


def start(position: Float[Array, "*env 3"], velocity: Float[Array, "*env 3"]) -> KalmanState:
    """The filter after the first measurement, with no acceleration known yet."""
    count = jnp.zeros(position.shape[:-1], jnp.int32)
    # At rest before the first step, so zero is the best guess.
    return KalmanState(position, velocity, jnp.zeros_like(position), count)


def update(
    table: Float[Array, "n 3 2"],
    dt: float,
    state: KalmanState,
    position: Float[Array, "*env 3"],
    velocity: Float[Array, "*env 3"],
) -> KalmanState:
    """Predicts over `dt` and takes one measurement.

    Args:
      table: from `gains`, as an array of the device.
      dt: s since the last measurement; the one that the table was made for.
      state: before.
      position, velocity: measured, m and m/s.

    Returns:
      The state after the measurement.
    """
    step: Any = jnp.asarray(dt, position.dtype)
    p = state.position + step * (state.velocity + 0.5 * step * state.acceleration)
    v = state.velocity + step * state.acceleration
    # the gains depend on the number of measurements alone, so that no rover carries a covariance
    gain = table[jnp.minimum(state.count, table.shape[0] - 1)].astype(position.dtype)
    error_p, error_v = position - p, velocity - v

    def corrected(value: Any, row: int) -> Any:
        return value + gain[..., row, 0, None] * error_p + gain[..., row, 1, None] * error_v

    return KalmanState(corrected(p, 0), corrected(v, 1), corrected(state.acceleration, 2), state.count + 1)
