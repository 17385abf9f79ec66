"""The report on particle runs: scales and comparisons, on results that are made up."""

from __future__ import annotations

import dataclasses
import json

import pytest

from benchmarks import particle_tables
from lunar_mjx.wheel_bed.data_files import load_figures
from lunar_mjx.wheel_bed.particles.campaign import read_plan
from tests.wheel_bed.particles.fakes import fake_result


@pytest.fixture(scope="module")
def planned():
    return {name: read_plan(runs) for name, runs in json.loads(particle_tables.PLAN.read_text()).items()}


def result(run, **values):
    return fake_result(run, **values) | {"static_sinkage": 0.004, "particles": 1000}


def test_the_kept_plan_is_that_of_the_script(planned):
    fresh = particle_tables.make_plan()
    assert {n: [r.key for r in runs] for n, runs in planned.items()} == {
        n: [r.key for r in read_plan(runs)] for n, runs in fresh.items()
    }


def test_the_error_is_that_of_the_measured_wheel(planned):
    """Results that are the measurement plus half a newton err by half a newton."""
    table = load_figures()
    at = {
        (round(a, 3), round(s, 6)): k
        for k, (a, s) in enumerate(zip(table.test["slip_angle_deg"], table.test["slip_ratio"], strict=True))
    }
    results = []
    for run in [r for r in planned["cmu_earth"] if r.variant == "table"]:
        k = at[round(run.point.slip_angle, 3), round(run.point.slip_ratio, 6)]
        values = {q: float(v[k]) for q, v in table.measured.items()}
        results.append(result(run, **values | {"drawbar_pull": values["drawbar_pull"] + 0.5}))
    found = particle_tables.against_measured(results)
    assert found["points"] == 54
    assert found["drawbar_pull"]["rms_error"] == pytest.approx(0.5) == found["drawbar_pull"]["mean_error"]
    assert found["side_force"]["rms_error"] == pytest.approx(0.0, abs=1e-12)


def test_forces_on_the_moon_are_scaled_and_sinkage_is_not(planned):
    moon = [result(r, drawbar_pull=1.625, sinkage=0.012) for r in planned["cmu_moon"]]
    earth = [result(r, drawbar_pull=9.80665, sinkage=0.010) for r in planned["cmu_earth"] if r.variant == "table"]
    found = particle_tables.moon_against_earth(earth, moon)
    assert found["points"] == len(moon) == 11
    assert found["drawbar_pull"] == pytest.approx(0.0, abs=1e-9) and found["sinkage"] == pytest.approx(0.002)


def test_a_heavier_wheel_sinks_deeper_and_weaker_sand_bears_less(planned):
    light, heavy = (result(dataclasses.replace(r)) for r in (planned["loads"][0], planned["loads"][-1]))
    assert particle_tables.footing_sinkage(light, 30.0) < particle_tables.footing_sinkage(heavy, 30.0)
    assert particle_tables.footing_sinkage(heavy, 35.0) < particle_tables.footing_sinkage(heavy, 30.0)


def test_stages_hold_every_run_and_spread_the_first(planned):
    staged = particle_tables.stages(planned)
    assert {r.key for _, runs in staged for r in runs} == {r.key for runs in planned.values() for r in runs}
    first, controls = staged[1][1], staged[2][1]
    assert {r.point for r in controls} <= {r.point for r in first}
    assert {round(r.point.slip_angle) for r in first} == set(particle_tables.ANGLES)
