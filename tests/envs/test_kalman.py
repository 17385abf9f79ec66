"""The filter against the textbook's nine-state recursion, and what it must do with simple motions."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs.navigation import kalman
from lunar_mjx.envs.navigation.kalman import KalmanConfig
from lunar_mjx.errors import UserError

DT = 0.1


def textbook(config: KalmanConfig, measured: np.ndarray) -> np.ndarray:
    """X = (p, v, a), Y = H X with H = [I_6 0], written with 9 x 9 matrices as in the paper; measured (time, 6)."""
    eye = np.eye(3)
    f = np.block([[eye, DT * eye, 0.5 * DT**2 * eye], [0 * eye, eye, DT * eye], [0 * eye, 0 * eye, eye]])
    h = np.hstack([np.eye(6), np.zeros((6, 3))])
    # white jerk: Q is the integral of exp(F s) L L' exp(F s)', by the trapezoidal rule
    s = np.linspace(0.0, DT, 2001)
    columns = np.stack([s**2 / 2, s, np.ones_like(s)])
    q1 = config.jerk**2 * np.trapezoid(columns[:, None] * columns[None], s, axis=-1)
    q, r = np.kron(q1, eye), np.diag([config.position_deviation**2] * 3 + [config.velocity_deviation**2] * 3)
    x = np.concatenate([measured[0], np.zeros(3)])
    p = np.diag([*np.diag(r), *[config.acceleration_deviation**2] * 3])
    out = [x]
    for y in measured[1:]:
        x, p = f @ x, f @ p @ f.T + q
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        x, p = x + gain @ (y - h @ x), (np.eye(9) - gain @ h) @ p
        out.append(x)
    return np.stack(out)


def run(config: KalmanConfig, measured: np.ndarray) -> np.ndarray:
    table = jnp.asarray(kalman.gains(config, DT))
    state = kalman.start(*(jnp.asarray(measured[0, i : i + 3])[None] for i in (0, 3)))
    out = [state]
    for y in measured[1:]:
        state = kalman.update(table, DT, state, jnp.asarray(y[None, :3]), jnp.asarray(y[None, 3:]))
        out.append(state)
    return np.stack([np.concatenate([s.position[0], s.velocity[0], s.acceleration[0]]) for s in out])


def test_agrees_with_the_textbook_filter():
    rng = np.random.default_rng(0)
    measured = np.cumsum(rng.normal(size=(200, 6)), axis=0) * 0.05
    with jax.enable_x64(True):
        found = run(KalmanConfig(), measured)
    np.testing.assert_allclose(found, textbook(KalmanConfig(), measured), rtol=0, atol=2e-6)


def test_finds_a_constant_acceleration():
    t = DT * np.arange(60)[:, None]
    a = np.array([0.3, -0.2, 0.1])
    measured = np.hstack([0.5 * a * t**2, a * t])
    with jax.enable_x64(True):
        found = run(KalmanConfig(), measured)
    np.testing.assert_allclose(found[-1, 6:], a, atol=1e-4)
    assert abs(found[1, 6:] - a).max() > 1e-2, "one measurement cannot tell"


def test_the_gains_settle_and_are_the_riccati_equations():
    table = kalman.gains(KalmanConfig(), DT)
    assert table.shape[1:] == (3, 2) and 5 < len(table) < 200
    np.testing.assert_allclose(table[-1], table[-2], atol=1e-9)
    lag = KalmanConfig(jerk=0.01)
    assert kalman.gains(lag, DT)[-1, 2, 1] < table[-1, 2, 1], "less jerk trusts the measurement less"


@pytest.mark.parametrize("field", ["jerk", "position_deviation", "velocity_deviation", "acceleration_deviation"])
def test_refuses_deviations_that_are_not_positive(field):
    with pytest.raises(UserError, match=field):
        KalmanConfig(**{field: 0.0})
