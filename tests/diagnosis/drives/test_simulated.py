"""Rows of drives are simulated once, and anew as soon as anything has changed that they depend on."""

from __future__ import annotations

import dataclasses

import numpy as np
import pandas as pd
import pytest

from lunar_mjx.diagnosis.drives import problem as drive_problem
from lunar_mjx.diagnosis.drives.nuisances import STEP_ERROR
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.simulation.rollouts import Bench
from lunar_mjx.diagnosis.drives.simulation.simulated_rows import Simulated
from lunar_mjx.effects import catalogue
from lunar_mjx.logs import read_log, write_log
from lunar_mjx.logs.log import Noise
from lunar_mjx.model import make_model
from lunar_mjx.simulate import command_channels

CANDIDATES = {n: catalogue.get(n) for n in ("coulomb_friction", "viscous_friction")}


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("still")
    model = make_model("luvmi_x", terrain="flat")
    time = 0.1 * np.arange(20)
    found = []
    for number in range(2):
        still = dict.fromkeys((*command_channels(model), "position_x_m"), np.zeros(20))
        tables = {"drive": pd.DataFrame({"time_s": time, **still})}
        log = write_log(
            folder / f"log{number}",
            tables,
            rover="luvmi_x",
            noise={"position_x_m": Noise(0.01, "rest")},
            manoeuvre=f"still{number}",
            gravity_m_s2=model.gravity,
            terrain="flat",
        )
        found.append(read_log(log))
    return found


@pytest.fixture
def runs(monkeypatch):
    """What is simulated: (effects, time step, rows) of every call; predictions are a sum over what acts."""
    calls = []

    def run(self, rows, values, observations, progress):
        acting = {**dict.fromkeys(self.model.effect_names, 1.0), "initial": 1.0}
        total = sum(np.asarray(v) * acting.get(k[0], 0.0) for k, v in values.items())
        given = sum(float(np.sum(p.effects["motor"]["resistance"])) for p in self.params)
        calls.append((len(self.model.effect_names), self.model.timestep, rows))
        for number in range(len(self.runs)):
            part = observations.of_log[number]
            rising = np.arange(part.stop - part.start)
            error = self.model.timestep
            yield number, slice(0, rows), (total + given + error)[:, None] + rising

    monkeypatch.setattr(Bench, "run", run)
    monkeypatch.setattr(drive_problem, "SIMULATED", Simulated())
    return calls


def _problem(logs, model=None):
    return DriveProblem(logs, model or make_model("luvmi_x", terrain="flat"), CANDIDATES)


def test_a_row_is_simulated_once_and_a_changed_one_anew(logs, runs):
    problem = _problem(logs)
    origin = problem.origin()
    first = problem.predict(origin[None])
    assert np.array_equal(problem.predict(np.stack([origin, origin])), np.concatenate([first, first]))
    assert [c[2] for c in runs] == [1]
    moved = origin.copy()
    moved[problem.baseline[0]] += 1e-7
    both = problem.predict(np.stack([origin, moved]))
    assert [c[2] for c in runs] == [1, 1]
    assert np.array_equal(both[:1], first)
    assert not np.array_equal(both[1:], first)
    assert np.array_equal(_problem(logs).predict(origin[None]), first)
    assert len(runs) == 2


def test_another_model_or_bench_or_time_step_is_not_answered_from_what_is_known(logs, runs):
    problem = _problem(logs)
    origin = problem.origin()[None]
    first = problem.predict(origin)
    model = make_model("luvmi_x", terrain="flat")
    other = _problem(logs, model.set("motor", resistance=2.0))
    assert not np.array_equal(other.predict(origin), first)
    assert len(runs) == 2
    rubbing = origin.copy()
    rubbing[0, problem.candidates["coulomb_friction"]] = 0.3
    problem.predict(np.concatenate([origin, rubbing]))
    assert runs[-1][0] == runs[0][0] + 1  # with the candidate that moves, and no other
    assert runs[-1][2] == 2  # and the origin anew, since differences are taken within one program
    assert problem.step_error == pytest.approx(-model.timestep)
    assert runs[-1][1:] == (0.5 * model.timestep, 1)
    assert len(runs) == 4


def test_what_only_adds_to_the_predictions_is_not_simulated(logs, runs):
    problem = _problem(logs)
    origin = problem.origin()
    late = origin.copy()
    late[[i for i, c in enumerate(problem.coordinates) if c.name == STEP_ERROR]] = 1.0
    error = problem.step_error
    before = len(runs)
    plain, added = problem.predict(np.stack([origin, late]))
    assert len(runs) == before
    assert added - plain == pytest.approx(error)


def test_all_logs_share_one_amount_of_the_steps_error_and_half_of_it_is_expected(logs, runs):
    """Either every log was measured, or every one was recorded by steps of the same length."""
    problem = _problem(logs)
    (place,) = [i for i, c in enumerate(problem.coordinates) if c.name == STEP_ERROR]
    assert place in problem.baseline
    u = problem.origin()
    assert problem.coordinates[place].value(u[place]) == 0.0
    u[place] = 1.0
    moved = problem.predict(np.stack([problem.origin(), u]))
    assert moved[1] - moved[0] == pytest.approx(problem.step_error)
    assert len(problem.observations.of_log) == 2
    assert all(np.any(problem.step_error[part]) for part in problem.observations.of_log.values())
    assert (problem.coordinates[place].centre, problem.coordinates[place].prior) == (0.5, 0.5)


def test_how_long_a_rover_had_stood_is_asked_once(logs, runs, monkeypatch):
    monkeypatch.setattr(drive_problem, "standing_shows", lambda change, number, observations: False)
    slope = make_model("luvmi_x", terrain="slope:10deg")
    inclined = [dataclasses.replace(log, terrain="slope:10deg") for log in logs]
    _problem(inclined, slope)
    assert [c[2] for c in runs] == [2]
    _problem(inclined, slope)
    assert len(runs) == 1


def test_old_rows_go_first_when_memory_is_spent():
    known = Simulated(most=3 * 8)
    for k in range(3):
        known.keep((k,), np.array([float(k)]))
    assert known.get((0,)) is not None
    known.keep((3,), np.zeros(1))
    assert [k for k in range(4) if (k,) in known] == [0, 2, 3]


def test_a_program_holds_what_moves_and_what_that_needs(logs, runs):
    model = make_model("luvmi_x", terrain="flat")
    plain = [n for n in ("rim_contact", "ruts") if n in model.effect_names]
    assert not plain
    problem = DriveProblem(logs, model, {n: catalogue.get(n) for n in (*CANDIDATES, "rim_contact", "ruts")})
    origin = problem.origin()

    def held(*names):
        rows = origin[None].copy()
        for name in names:
            rows[0, problem.candidates[name]] = 0.1
        return set(problem._bench_for(rows).model.effect_names) - set(model.effect_names)

    assert held() == set()
    assert held("ruts") == {"ruts", "rim_contact"}
    assert held("coulomb_friction", "viscous_friction") == {"coulomb_friction", "viscous_friction"}
    assert held("viscous_friction") == {"coulomb_friction", "viscous_friction"}, "the smallest that is there already"
    problem.devote(frozenset({"viscous_friction"}))
    assert held("viscous_friction") == {"viscous_friction"}, "simulated often enough for a program of its own"
    assert held("coulomb_friction") == {"coulomb_friction", "viscous_friction"}
    problem.devote(frozenset({"ruts"}))
    assert held("ruts") == {"ruts", "rim_contact"}
    alone = DriveProblem(logs, model, {"ruts": catalogue.get("ruts")})
    assert [n.reason for n in alone.not_tested] == ["needs rim_contact, which the model lacks"]
