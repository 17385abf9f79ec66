"""The engines agree, and the comparison catches planted faults and names the stage."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from backends_faults import FAULTS
from backends_recorded import Recorded

from lunar_mjx.backends import NativeBackend
from lunar_mjx.backends.parity import compare as parity
from lunar_mjx.backends.parity.page import verdict, write_parity_page
from lunar_mjx.backends.parity.record import evaluate
from lunar_mjx.backends.parity.study import kind_of, make_runner, run_study
from lunar_mjx.backends.physics import soil
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model


def _failed(results):
    return [f"{r.case} {r.stage} {r.quantity} {r.where}: {r.error:.3g}" for r in results if not r.passed]


def test_structured_engine_agrees_with_native(luvmi, structured):
    """Float64, from the same states: every stage and the state after one step."""
    results = luvmi.judge(structured, "float64")
    assert len(results) == 3 * 20
    assert not _failed(results)


def test_the_drive_moves_every_stage(luvmi):
    """A comparison of rovers that stand still would prove nothing."""
    samples = luvmi.of["slope, hard"][0]
    assert samples.state.qpos[-1, 0] > 0.1
    least = {
        "wheel_velocity": 0.05,
        "slip": 0.01,
        "slip_angle": 1e-3,
        "sinkage": 1e-4,
        "wheel_force": 10.0,
        "wheel_moment": 0.1,
        "joint_torque": 1.0,
        "winding_heat": 0.01,
        "acceleration": 1.0,
    }
    for name, value in least.items():
        assert np.abs(samples.stages[name]).max() > value, name
    assert np.abs(luvmi.of["flat, soft"][0].stages["housing_heat"]).max() > 1e-3


def test_soil_too_stiff_for_a_drive_damps_alike_and_creeps_alike(luvmi, monkeypatch):
    """Little inertia and a short relaxation length: both engines cut the damping time, and by the same; soil creeps."""
    rotor = np.asarray(luvmi.model.parameters["motor"]["rotor_inertia"])
    model = luvmi.model.set("motor", rotor_inertia=tuple(0.1 * rotor)).set("shear_state", relaxation=0.05, creep=0.05)
    case = luvmi.cases[0]
    samples = luvmi.of[case.name][0]
    native, structured = (
        runner.step_from(case, samples)[0]["wheel_force"]
        for runner in (parity.native_runner(model, []), parity.JaxRunner("structured", model))
    )
    assert structured == pytest.approx(native, rel=1e-9, abs=1e-9)
    monkeypatch.setattr(soil, "CLOSED_FORM", dataclasses.replace(soil.CLOSED_FORM, damped=1e9))
    uncut = parity.native_runner(model, []).step_from(case, samples)[0]["wheel_force"]
    assert np.abs(uncut - native).max() > 0.1


@pytest.mark.parametrize("fault", FAULTS)
def test_planted_faults_fail_at_level_1_and_name_the_stage(fault, luvmi, structured):
    """The fault is in the reference: the JAX engine that is compiled already must tell."""
    hook, stages, where = FAULTS[fault]
    case = luvmi.cases[0]
    samples = luvmi.of[case.name][0]
    wrong = parity.native_runner(luvmi.model, [hook]).step_from(case, samples)
    faulty = dataclasses.replace(samples, stages=wrong[0], after=wrong[1])
    right = structured.step_from(case, samples)
    results = parity.judge(case, faulty, right, parity.tolerances("float64"), luvmi.model)
    first = parity.first_failure(results)
    assert first is not None and first.stage == stages[0]
    assert {r.stage for r in results if r.level == 1 and not r.passed} == set(stages)
    assert all(r.where.endswith(where) for r in results if r.stage == stages[0] and not r.passed)


@pytest.mark.parametrize("fault", FAULTS)
def test_faults_are_told_at_the_loosest_tolerance_too(fault, luvmi):
    hook, stages, _ = FAULTS[fault]
    case = luvmi.cases[0]
    samples = luvmi.of[case.name][0]
    wrong = parity.native_runner(luvmi.model, [hook]).step_from(case, samples)
    for kind in ("float32, soft loop", "pybullet, soft loop"):
        first = parity.first_failure(parity.judge(case, samples, wrong, parity.tolerances(kind), luvmi.model))
        assert first is not None and first.stage in stages, kind


def test_a_drive_stays_within_tolerance_and_noise(luvmi):
    """The reference against itself, started from float32 coordinates: told by a drive only beyond the floor."""
    case = luvmi.cases[0]
    _, run, perturbed = luvmi.of[case.name]
    noise = perturbed.floor(single=False, soft_loop=False)
    wanted = parity.tolerances("float64", drive=True)
    same = parity.judge_drive(case, run, noise, run, wanted, luvmi.model)
    assert all(r.error == 0.0 and r.floor > 0.0 for r in same if r.quantity in ("position", "sinkage", "slip"))
    assert not _failed(parity.judge_drive(case, run, noise, perturbed.double, wanted, luvmi.model))
    hook = FAULTS["wheel radius"][0]
    wrong = parity.native_runner(luvmi.model, [hook]).drive(case, luvmi.commands)
    assert "position" in {
        r.quantity for r in parity.judge_drive(case, run, noise, wrong, wanted, luvmi.model) if not r.passed
    }


@pytest.mark.slow
def test_every_effect_of_field_agrees_with_native():
    """Ruts, slip-sinkage, skidding, bulldozing, boulders that hold, voltage and gear: JAX against NumPy, to rounding.

    Six states and a drive of 3 s on soft ground with boulders, which the front wheels run over.
    """
    study = run_study("luvmi_x", "field", ["structured"], 3.0, 6, grounds=("boulders, soft",))
    assert [p.failed for p in study.pairs] == [[]]
    samples = study.runs["native"].steps["boulders, soft"][0]
    assert np.abs(samples["wheel_force"]).max() > 10.0


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
def test_field_drives_agree_for_twenty_seconds(rover):
    """Craters, soft and hard."""
    study = run_study(rover, "field", ["structured"], 20.0, 6, grounds=("crater, soft", "crater, hard"))
    assert [p.failed for p in study.pairs] == [[]]


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["consistent", "paper"])
@pytest.mark.parametrize("engine", ["structured", "mjx", "structured:float32"])
def test_drives_agree(engine, preset):
    study = run_study("luvmi_x", preset, [engine], 5.0, 8)
    assert [p.failed for p in study.pairs] == [[]]


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["structured", "mjx"])
def test_viper_agrees(engine):
    study = run_study("viper", "consistent", [engine], 4.0, 6, grounds=("flat, soft", "slope, hard"))
    assert [p.failed for p in study.pairs] == [[]]


@pytest.mark.slow
def test_what_sets_viper_apart_from_native_mujoco():
    """The two causes behind the tolerances of a soft loop, one after the other: dampers, and the loops' compliance.

    Within 0.05 rad/s2 of an acceleration of 200, where MuJoCo damps within the loops and these are ten times stiffer.
    """
    viper = Recorded("viper", "consistent", grounds=("slope, hard",))
    case = viper.cases[0]
    samples = viper.of[case.name][0]
    exact = parity.JaxRunner("structured", viper.model).step_from(case, samples)[0]
    gaps = []
    for within, compliance in ((False, 1.0), (True, 1.0), (True, 0.1)):
        backend = NativeBackend(
            viper.model.replace(terrain=case.terrain), rovers=len(samples.control), damped_within=within
        )
        for rover in range(len(samples.control)):
            backend.soften_loops(rover, compliance)
        seen, _ = evaluate(backend, samples.state, samples.control)
        apart = {k: np.abs(seen[k] - exact[k])[samples.closed].max() for k in ("wheel_force", "acceleration")}
        assert apart["wheel_force"] < 1e-9
        gaps.append(apart["acceleration"])
    assert np.abs(samples.stages["acceleration"]).max() > 200.0
    assert gaps[1] < 0.2 * gaps[0] and gaps[2] < 0.11 * gaps[1] and gaps[2] < 0.05


def test_page_says_where_engines_part(tmp_path, luvmi, monkeypatch):
    from lunar_mjx.backends.parity import study as parity_study

    hook = FAULTS["lateral force"][0]
    monkeypatch.setattr(
        parity_study, "make_runner", lambda engine, model: parity.native_runner(model, [hook], "faulty")
    )
    study = parity_study.run_study("luvmi_x", "consistent", ["structured"], 1.0, 4, grounds=("slope, soft",))
    assert "first in the stage soil wrench (wheel_force, " in verdict(study, study.pairs[0])
    page = write_parity_page(tmp_path / "parity.html", [study])
    assert "first in the stage soil wrench" in page.read_text()
    numbers = json.loads((tmp_path / "parity.json").read_text())
    assert len(numbers[0]["results"]) == 28 and not all(r["passed"] for r in numbers[0]["results"])


def test_kinds_of_tolerance(luvmi):
    assert kind_of(("native", "structured"), luvmi.model) == "float64"
    assert kind_of(("native", "structured, float32"), luvmi.model) == "float32"
    assert kind_of(("native", "pybullet"), luvmi.model) == "pybullet"
    viper = make_model("viper", "flat")
    assert kind_of(("native", "structured"), viper) == kind_of(("structured", "mjx"), viper) == "float64, soft loop"
    assert kind_of(("native", "structured, float32"), viper) == "float32, soft loop"
    assert kind_of(("native", "mjx"), viper) == "float64"


def test_refuses_unknown_engines_and_grounds(luvmi):
    with pytest.raises(UserError, match="engine = 'ode' does not exist; use some of structured"):
        make_runner("ode", luvmi.model)
    with pytest.raises(UserError, match="ground = 'lava' does not exist; use some of flat, soft"):
        run_study("luvmi_x", "consistent", [], 1.0, 2, grounds=("lava",))
