"""The current of all motors together as evidence: from the simulator through the gate to the comparison."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from lunar_mjx.diagnosis.drives.instruments import USUAL_SCALE, usual_kind
from lunar_mjx.diagnosis.drives.nuisances import is_linear
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.simulation.log_run import log_run
from lunar_mjx.effects import catalogue
from lunar_mjx.logs import Log, Recording, check, read_log, simulate_log
from lunar_mjx.model import Model, make_model

BUS, VOLTAGE = "bus_current_A", "bus_voltage_V"
ELECTRONICS = 1.7
"""A; what the log's bus gives beside the motors."""
MOTORS = [f"motor_{c}_drive_current_A" for c in ("lf", "rf", "lr", "rr")]


@pytest.fixture(scope="module")
def model() -> Model:
    return make_model("luvmi_x", terrain="flat", timestep=0.0025)


@pytest.fixture(scope="module")
def log(model: Model, tmp_path_factory: pytest.TempPathFactory) -> Log:
    """A drive that was recorded without noise by a rover with electronics."""
    recording = Recording(scale=0.0, bias={BUS: ELECTRONICS}, bus_current=True)
    out = tmp_path_factory.mktemp("bus") / "drive"
    found = read_log(
        simulate_log(out, "luvmi_x", "speed_staircase", model=model, seconds=5.0, seed=0, recording=recording)
    )
    assert isinstance(found, Log)
    return found


def without(log: Log, *names: str) -> Log:
    tables = {
        k: dataclasses.replace(t, channels={c: v for c, v in t.channels.items() if c not in names})
        for k, t in log.tables.items()
    }
    return dataclasses.replace(log, tables=tables)


def residual(problem: DriveProblem, u: np.ndarray) -> dict[str, np.ndarray]:
    left = problem.observations.value - problem.predict(u[None])[0]
    return {s.channel: left[s.start : s.stop] for s in problem.observations.series}


def test_what_is_simulated_is_fit_to_be_used_and_balances_power(log: Log) -> None:
    assert not [f for f in check(log) if f.column == BUS]
    drawn = np.asarray(log.channel(BUS)[1]) - ELECTRONICS
    motors = [c for c in log.channel_names if c.startswith("motor_") and c.endswith("_current_A")]
    power = sum(log.channel(c)[1] * log.channel(c.replace("current_A", "voltage_V"))[1] for c in motors)
    assert drawn.max() > 0.1, "the rover drove"
    np.testing.assert_allclose(drawn, power / 48.0, atol=0.02 * drawn.max())
    assert drawn.max() < 0.8 * max(np.abs(log.channel(c)[1]).sum() for c in motors)


def test_it_is_compared_beside_the_motors_and_without_them(log: Log, model: Model) -> None:
    both, alone = DriveProblem([log], model, {}), DriveProblem([without(log, *MOTORS)], model, {})
    compared = [{s.channel for s in p.observations.series} for p in (both, alone)]
    assert compared[0] >= {BUS, *MOTORS} and BUS in compared[1] and not compared[1] & set(MOTORS)
    assert all(VOLTAGE not in p.unused and BUS not in p.unused for p in (both, alone))
    u = alone.origin()
    (place,) = [i for i, c in enumerate(alone.coordinates) if c.nuisance and c.name == BUS]
    c = alone.coordinates[place]
    assert is_linear(c) and place in alone.baseline and c.unit == "A"
    u[place] = (ELECTRONICS - c.start) / c.scale
    assert abs(u[place]) < 1.0, "far within its prior"
    left = residual(alone, u)[BUS]
    assert np.abs(left).max() < 0.05 * np.ptp(log.channel(BUS)[1]), "but for how a step's start differs"
    u[place] += 0.2 / c.scale
    np.testing.assert_allclose(residual(alone, u)[BUS], left - 0.2, atol=1e-9)
    (scale,) = [i for i, c in enumerate(alone.coordinates) if usual_kind(c) == "bus A"]
    u[scale] = 1.0
    added, motors = left - 0.2 - residual(alone, u)[BUS], log.channel(BUS)[1] - ELECTRONICS
    assert np.abs(left).max() < 0.1 * np.abs(motors).max()
    np.testing.assert_allclose(added / USUAL_SCALE["bus A"], motors - left, atol=1e-6)


def test_the_model_s_own_supply_comes_first_and_a_suspected_one_changes_nothing(log: Log, model: Model) -> None:
    assert np.all(log_run(log, model).bus_voltage == 48.0)
    assert log_run(log, model.add("bus_droop")).bus_voltage is None
    problem = DriveProblem([without(log, *MOTORS)], model, {"bus_droop": catalogue.get("bus_droop")})
    u = problem.origin()
    plain = residual(problem, u)[BUS]
    u[problem.candidates["bus_droop"]] = 1e-9
    np.testing.assert_allclose(residual(problem, u)[BUS], plain, atol=1e-6)


def begun(table: Any, seconds: float) -> Any:
    """The first seconds of a table of a log."""
    kept = table.time_s < table.time_s[0] + seconds
    return dataclasses.replace(
        table, time_s=table.time_s[kept], channels={c: v[kept] for c, v in table.channels.items()}
    )


def test_without_a_voltage_it_is_not_used_and_told_once(log: Log, model: Model) -> None:
    lost = without(log, VOLTAGE)
    problem = DriveProblem([lost], model, {})
    assert BUS not in {s.channel for s in problem.observations.series}
    assert problem.unused.count("voltage of the bus") == 1 and "log bus_voltage_V, or add bus_droop" in problem.unused
    dead = {
        k: dataclasses.replace(t, channels={c: v * (c != VOLTAGE) for c, v in t.channels.items()})
        for k, t in log.tables.items()
    }
    assert log_run(dataclasses.replace(log, tables=dead), model).bus_voltage is None
    mixed = DriveProblem([lost, log], model, {})
    assert [s.log for s in mixed.observations.series if s.channel == BUS] == [1]
    assert np.isfinite(mixed.predict(mixed.origin()[None])).all()
    # of another length, so that they share a program and no stack of logs
    short = dataclasses.replace(lost, tables={k: begun(t, 2.0) for k, t in lost.tables.items()})
    uneven = DriveProblem([short, log], model, {})
    assert len(uneven.bench._groups()) == 2 and np.isfinite(uneven.predict(uneven.origin()[None])).all()
    supplied = DriveProblem([lost, log], model.add("bus_droop"), {})
    assert all(BUS in supplied.bench.channels(n) for n in (0, 1)) and "voltage" not in supplied.unused
