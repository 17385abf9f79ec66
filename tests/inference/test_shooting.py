"""Windows of a log that begin at the measured state, and fits of them before whole rollouts."""

from __future__ import annotations

import contextlib
import dataclasses
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.measured_states import begin_at, measured_states
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.quaternions import rotation
from lunar_mjx.dynamics.system import default_params
from lunar_mjx.inference.descent import descend
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.shooting import shoot
from lunar_mjx.model import make_model
from tests.inference.toy_problem import coordinate

TIME = np.arange(0.0, 10.0, 0.1)
SLOPE = np.radians(8.0)


def log(**channels: np.ndarray) -> Any:
    return SimpleNamespace(channel=lambda name: (TIME, channels[name]) if name in channels else None)


def test_states_are_those_of_lines_through_the_samples() -> None:
    turning = np.degrees(np.angle(np.exp(1j * (3.0 + 0.2 * TIME))))  # jumps at 180 deg
    mine = log(position_x_m=1.0 + 0.3 * TIME, yaw_deg=turning, winding_a_temperature_degC=20.0 + TIME)
    found = measured_states(mine, ["a", "b"], np.array([0.73, 5.0]))
    np.testing.assert_allclose(found["pose"][:, 0], [1.219, 2.5], rtol=1e-12)
    assert np.isnan(found["pose"][:, 1]).all() and np.isnan(found["housing"]).all()
    np.testing.assert_allclose(np.exp(1j * found["pose"][:, 2]), np.exp(1j * (3.0 + 0.2 * np.array([0.73, 5.0]))))
    np.testing.assert_allclose(found["winding"][:, 0], 273.15 + np.array([20.73, 25.0]))
    assert np.isnan(found["winding"][:, 1]).all()


def test_nothing_is_known_in_a_gap_or_beyond_the_ends() -> None:
    keep = (TIME < 4.0) | (TIME > 6.0)
    gap = SimpleNamespace(channel=lambda name: (TIME[keep], TIME[keep]) if name == "position_x_m" else None)
    found = measured_states(gap, [], np.array([2.0, 5.0, 5.9, 11.0]))["pose"][:, 0]  # type: ignore[arg-type]
    assert found[0] == pytest.approx(2.0) and np.isnan(found[1:]).all()


@pytest.fixture(scope="module")
def climbing() -> tuple[Any, Any]:
    """Parameters and a state of a rover on a slope, on the move."""
    with jax.enable_x64(True):
        model = make_model("luvmi_x", terrain="slope:8deg")
        system, params = build(model), default_params(model)
        state = jax.jit(lambda: system.reset(params, 0.4, 0.2, 0.3))()
        return params, dataclasses.replace(state, qvel=state.qvel.at[:3].set(jnp.array([0.2, 0.1, 0.03])))


def moved(climbing: tuple[Any, Any], pose: tuple[float, float, float], winding: float = np.nan) -> tuple[Any, Any]:
    params, state = climbing
    joints = state.temperature.winding.shape
    measured = {"pose": np.array(pose), "winding": np.full(joints, winding), "housing": np.full(joints, np.nan)}
    with jax.enable_x64(True):
        return jax.device_get((state, jax.jit(begin_at)(params, state, measured)))


def axes(state: Any) -> Any:
    return np.array(rotation([float(q) for q in state.qpos[3:7]]))  # rows: the body's x, y, z in the world


def test_a_state_begins_at_the_measured_pose(climbing: tuple[Any, Any]) -> None:
    """It turns about the ground's normal and keeps its height over the ground."""
    state, new = moved(climbing, (1.1, -0.5, 0.8), 320.0)
    np.testing.assert_allclose(new.qpos[:2], [1.1, -0.5])
    before, after = axes(state), axes(new)
    # between two headings on a slope the angle about the normal is not quite that on the map
    assert np.arctan2(after[0, 1], after[0, 0]) == pytest.approx(0.8, abs=6e-3)
    normal = before[2]
    assert float(normal[2]) == pytest.approx(np.cos(SLOPE), abs=1e-3)
    np.testing.assert_allclose(after[2], normal, atol=2e-3)
    over = [float(s.qpos[:3] @ normal) for s in (state, new)]
    assert over[1] == pytest.approx(over[0], abs=2e-3)
    turn = 0.8 - np.arctan2(before[0, 1], before[0, 0])
    forward = [float(a[0, :2] @ s.qvel[:2]) for a, s in ((before, state), (after, new))]
    assert abs(turn) > 0.4 and forward[1] == pytest.approx(forward[0], abs=2e-3)
    np.testing.assert_allclose(new.temperature.winding, 320.0 - 298.15)
    np.testing.assert_array_equal(new.temperature.housing, state.temperature.housing)


def test_what_is_not_measured_stays(climbing: tuple[Any, Any]) -> None:
    state, new = moved(climbing, (np.nan, np.nan, np.nan))
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15), new, state)


class Turning(Problem):
    """y = cos of an angle that grows at a rate w + c |w| w: after many turns chi-square has a minimum per turn."""

    has_windows = True
    TRUTH = 3.0

    def __init__(self, start: float):
        time = np.arange(0.0, 20.0, 0.05)
        self.time, self.start, self.windows = time, start, 0
        self.coordinates, self.baseline, self.candidates = (coordinate("base", "w"),), np.arange(1), {}
        value = np.cos(self.TRUTH * time) + 0.01 * np.sin(71.0 * time)
        self.observations = Observations(
            value,
            (Series(0, "y", 0, len(time), time, 0.01),),
            ("log",),
            ("fit",),
            np.zeros(len(time), int),
            ("fit",),
            ("log",),
        )
        self.effects, self.not_tested, self._within = {}, (), False

    def origin(self) -> np.ndarray:
        return np.array([self.start])

    @contextlib.contextmanager
    def in_windows(self):
        self._within = True
        self.windows += 1
        yield
        self._within = False

    def _angle(self, w: Any) -> Any:
        edge = np.floor(self.time) if self._within else 0.0 * self.time
        return self.TRUTH * edge + w * (self.time - edge), self.time - edge

    def predict(self, u):
        return np.cos(self._angle(np.atleast_2d(u)[:, :1])[0])

    def jacobian(self, u, which):
        angle, since = self._angle(u[0])
        return (-since * np.sin(angle))[:, None][:, which]


def test_windows_lead_where_whole_rollouts_go_astray() -> None:
    problem = Turning(2.0)
    free, fitted = problem.free(), problem.observations.in_split("fit")
    goal = Objective(problem, free, fitted)
    assert descend(goal, problem.origin()).u[0] != pytest.approx(Turning.TRUTH, abs=0.1)
    start = shoot(problem, free, problem.origin())
    assert descend(goal, start).u[0] == pytest.approx(Turning.TRUTH, abs=1e-3)


def test_a_near_start_needs_no_windows() -> None:
    problem = Turning(3.002)
    assert shoot(problem, problem.free(), problem.origin())[0] == 3.002 and problem.windows == 0
    far = Turning(2.0)
    far.has_windows = False
    assert shoot(far, far.free(), far.origin())[0] == 2.0 and far.windows == 0
