"""Experiments in a loop: plans are read, measured in the same world, and followed until nothing is open."""

from __future__ import annotations

import json

import numpy as np
import pytest

from benchmarks.foreign import bed, cases, experiments, work

PLANS = [
    "slip sweep at 30 deg slip angle, 20 N",
    "slip sweep at 0 deg slip angle, 10 N, measuring torque and sinkage too",
]


@pytest.fixture(scope="module")
def case():
    return cases.draw("tune", 20261123, 2, "single", ("exit_angle",))


def test_a_plan_is_measured_in_the_same_world(case, tmp_path):
    sweep = experiments.sweep_of(case, PLANS[1], 1)
    assert sweep.world is case.world and sweep.errors is case.errors
    assert set(sweep.measured) == {*case.measured, "driving_torque", "sinkage"}
    np.testing.assert_allclose(sweep.rows[0].load, 10.0)
    bed.write(sweep, tmp_path / "log")
    assert len((tmp_path / "log" / "points.csv").read_text().splitlines()) == 1 + 3 * len(experiments.SLIPS)


def test_a_name_that_is_no_plan_is_refused(case):
    with pytest.raises(ValueError, match="no sweep"):
        experiments.sweep_of(case, "drive in a circle", 1)


def test_information_grows_with_what_is_measured_elsewhere(case):
    """A sweep at an angle and a load that the table lacks tells more of the law than one with what it has."""
    loads = [float(case.rows[0].load.min()), 4.0 * float(case.rows[0].load.max())]
    names = [f"slip sweep at {angle} deg slip angle, {load:.4g} N" for angle, load in ((0, loads[0]), (30, loads[1]))]
    assert experiments.informative(case, [case], names) in names


def test_open_verdicts_are_followed_until_they_are_resolved(case, monkeypatch):
    answers = iter([("UNDECIDABLE", []), ("KNOWN_CLASS", ["exit_angle", "side_exit"]), ("KNOWN", ["exit_angle"])])

    def one(logs, out):
        verdict, effects = next(answers)
        (out / "run").mkdir()
        (out / "run" / "verdict.json").write_text(json.dumps({"verdict": verdict, "effects": effects}))
        assert all((log / "log.toml").is_file() for log in logs.iterdir())
        return {"verdict": verdict, "effects": effects, "seconds": {}}

    monkeypatch.setattr(work, "one", one)
    monkeypatch.setattr(work, "plans", lambda run: PLANS)
    (row,) = experiments.follow(case, ["next"])
    assert [s["sweep"] for s in row["steps"]] == [PLANS[0]] * 2
    assert [s["resolved"] for s in row["steps"]] == [False, True]
    assert "of 1 resolved within one sweep 0, within two 1" in experiments.text([row])
