"""How long a rover had stood before its log: a nuisance where the ground is inclined."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from lunar_mjx.diagnosis.drives.nuisances import standing_shows
from lunar_mjx.diagnosis.drives.problem import SIMULATED, DriveProblem
from lunar_mjx.diagnosis.drives.simulation.log_run import LOG_START, STOOD
from lunar_mjx.diagnosis.drives.simulation.program import PIECE, Program, _between
from lunar_mjx.diagnosis.drives.simulation.rollouts import Bench
from lunar_mjx.logs import read_log, simulate_log, write_log
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.recorder.instruments import Recording
from lunar_mjx.logs.recorder.simulate import SIMULATED_DRIVE
from lunar_mjx.model import make_model
from lunar_mjx.simulate import command_channels
from tests.inference.toy_problem import manoeuvres


def test_rovers_between_two_pieces_lie_between_their_states():
    before, after, kept = (
        {"qpos": jnp.full((4, 2), v), "step": jnp.full(4, int(v), jnp.int32)} for v in (1.0, 3.0, 7.0)
    )
    after["qpos"] = after["qpos"].at[3].set(jnp.nan)
    out = _between(kept, before, after, np.array([0.0, 0.25, 1.0, 0.0]))
    assert np.asarray(out["qpos"]).tolist() == [[7.0, 7.0], [1.5, 1.5], [3.0, 3.0], [7.0, 7.0]]
    assert np.asarray(out["step"]).tolist() == [7, 3, 3, 7]


def test_standing_takes_as_many_pieces_as_the_rover_that_stood_longest():
    program = object.__new__(Program)
    program.segment, program.every = 50, 5
    program.system = type("System", (), {"dt": PIECE / 250})()  # type: ignore[assignment]
    drives = []

    def drive(params, state, commands, shared):
        drives.append(commands.shape)
        return {"time": state["time"] + PIECE}, None

    program._drive = drive  # type: ignore[assignment]
    stood = np.array([LOG_START.settle, 1.3, 2.0, 1.75])
    out = program._stand(None, {"time": jnp.zeros(4)}, np.zeros((4, 50, 3)), stood, True)  # type: ignore[arg-type]
    assert np.allclose(out["time"], stood)
    assert drives == [(4, 50, 3)] * 4


@pytest.mark.parametrize(("terrain", "asked"), [("flat", False), ("slope:10deg", True)])
@pytest.mark.parametrize("shows", [False, True])
def test_it_is_a_nuisance_where_the_ground_is_inclined_and_it_shows(tmp_path, monkeypatch, terrain, asked, shows):
    model = make_model("luvmi_x", terrain=terrain)
    time = 0.1 * np.arange(20)
    still = dict.fromkeys((*command_channels(model), "position_x_m"), np.zeros(20))
    tables, noise = {"drive": pd.DataFrame({"time_s": time, **still})}, {"position_x_m": Noise(0.01, "rest")}
    log = write_log(
        tmp_path / "log",
        tables,
        rover="luvmi_x",
        noise=noise,
        manoeuvre="still",
        gravity_m_s2=model.gravity,
        terrain=terrain,
    )
    runs = []

    def run(self, rows, values, observations, progress):
        runs.append(values)
        change = (0.0, 10.0 if shows else 0.001)
        yield 0, slice(0, rows), np.outer(change, np.arange(len(observations)))

    monkeypatch.setattr(Bench, "run", run)
    SIMULATED.clear()
    problem = DriveProblem([read_log(log)], model, {})
    assert any(c.name == STOOD for c in problem.coordinates) is (asked and shows)
    assert len(runs) == asked


def test_what_another_pose_at_the_start_does_is_not_counted():
    level, ramp = np.full(100, 50.0), np.linspace(0.0, 10.0, 100)
    seen = manoeuvres(1, 100)
    position = dataclasses.replace(seen, series=(dataclasses.replace(seen.series[0], channel="position_x_m"),))
    current = dataclasses.replace(seen, series=(dataclasses.replace(seen.series[0], channel="motor_lf_current_A"),))
    assert standing_shows(level, 0, current)
    assert not standing_shows(level, 0, position)
    assert standing_shows(ramp, 0, position)
    assert not standing_shows(0.1 * ramp, 0, position)


@pytest.mark.slow
def test_a_log_on_a_slope_tells_how_long_its_rover_had_stood(tmp_path):
    folder = simulate_log(tmp_path / "log", "viper", "slope", seconds=3.0, seed=0, recording=Recording(scale=0.1))
    log = read_log(folder)
    problem = DriveProblem([log], make_model("viper", terrain=log.terrain), {})
    place = next(i for i, c in enumerate(problem.coordinates) if c.name == STOOD)
    c = problem.coordinates[place]
    stood = np.array([LOG_START.settle, 1.5, SIMULATED_DRIVE.settle, 3.0])
    rows = np.repeat(problem.origin()[None], len(stood), axis=0)
    rows[:, place] = (stood - c.start) / c.scale
    currents = np.concatenate([np.r_[s.start : s.stop] for s in problem.observations.series if "current" in s.channel])
    error = (problem.predict(rows) - problem.observations.value)[:, currents] / problem.observations.sigma()[currents]
    rms = np.sqrt(np.mean(error**2, axis=1))
    assert np.argmin(rms) == 2
    assert rms[2] < 1.2
    assert rms[0] > 2.0
