"""The chain from a log to a training, through files: a wheel table, `compare`, `train` on what the fit left open."""

from __future__ import annotations

import dataclasses
import json

import jax
import numpy as np
import pandas as pd
import pytest
from scipy import stats

from lunar_mjx.agents.policy import load_policy
from lunar_mjx.agents.run import soil_note
from lunar_mjx.envs import make, make_navigation
from lunar_mjx.logs import Noise, write_steady_log
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model
from lunar_mjx.model.posterior import Posterior
from lunar_mjx.wheel_bed.bed import WheelBed, wheel_test

STD = {"drawbar_pull_N": 0.1, "side_force_N": 0.1, "sinkage_m": 1e-4}
TRUTH = {"k_phi": 5e5, "cohesion": 400.0, "friction_angle": 0.55, "shear_modulus_x": 0.024}
"""A soil other than the nominal one, which the fit begins with."""
ENV = ("terrain=flat", "goal_distance=[1.0, 1.5]", "places=64", "episode_time=1.0", "decimation=25")


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bed") / "table"
    slip, angle = (a.ravel() for a in np.meshgrid(np.linspace(-0.2, 0.6, 7), [0.0, 15.0, 30.0, 45.0]))
    load = np.resize([8.0, 20.0, 45.0], len(slip))
    bed = WheelBed.of_preset("consistent").with_values({"soil": TRUTH})
    result = bed.run(wheel_test(slip, np.radians(angle), load, 0.0625, 0.05))
    columns = {"slip_ratio": slip, "slip_angle_deg": angle, "normal_load_N": load}
    rng = np.random.default_rng(2)
    for column, std in STD.items():
        columns[column] = getattr(result, column.rpartition("_")[0]) + std * rng.standard_normal(len(slip))
    noise = {c: Noise(s, "datasheet") for c, s in STD.items()}
    frame, wheel = pd.DataFrame(columns), {"radius_m": 0.0625, "width_m": 0.05}
    write_steady_log(folder, frame, wheel=wheel, slip_definition="wheel_frame", noise=noise)
    return folder


@pytest.mark.slow
def test_a_table_is_fitted_and_trained_on(run, table, tmp_path):
    found = run("compare", table, "-o", tmp_path / "run1")
    assert found.status == 0, found.err
    model = load_model(tmp_path / "run1" / "fitted.toml")
    posterior, soil = model.posterior, model.parameters["soil"]
    # What acts on no wheel in sand is not told: its prior says that nothing is known.
    assert {name.partition(".")[0] for name in posterior.parameters} == {"soil"}
    told = json.loads((tmp_path / "run1" / "comparison.json").read_text())["parameters"]["soil"]
    truth = {**make_model("luvmi_x", "flat", "consistent").parameters["soil"], **TRUTH}
    off = []
    for name, log, std in zip(posterior.parameters, posterior.log, posterior.std, strict=True):
        key = name.partition(".")[2]
        assert soil[key] == pytest.approx(told["value"][key], rel=1e-9)
        assert std * (soil[key] if log else 1.0) == pytest.approx(told["std"][key], rel=1e-6)
        off.append(np.log(truth[key] / soil[key]) if log else truth[key] - soil[key])
    # The hidden soil is a likely draw from what the fit left open.
    assert np.dot(off, np.linalg.solve(posterior.covariance, off)) < stats.chi2(len(off)).ppf(0.999)
    assert posterior.std[posterior.parameters.index("soil.k_phi")] < 0.2 < np.log(8.2e5 / TRUTH["k_phi"])

    line = ["train", "short", "-o", tmp_path / "learnt", "--steps", 64, "--eval-episodes", 2, "--eval-every", 1000]
    line += ["--set", "envs=16", "--set", "epoch_steps=4", "--set", "buffer_steps=8", "--set", "updates=1"]
    options = (*ENV, f"model={tmp_path / 'run1' / 'fitted.toml'}", "posterior=true")
    found = run(*line, *(f"--env={text}" for text in options))
    assert found.status == 0, found.err
    said = "drawn from [posterior] as in training, not unseen: soil."
    assert said in found.out
    policy = load_policy(tmp_path / "learnt" / "policy.npz")
    assert policy.environment["options"]["posterior"] is True
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(policy.params))
    scored = ("evaluate", tmp_path / "learnt" / "policy.npz", "--episodes", 2)
    assert said in run(*scored).out and said not in run(*scored, "--seen").out


def test_soil_that_is_no_posteriors_needs_no_note():
    task = {"model": make_model("luvmi_x", "flat", "consistent"), "places": 8}
    assert soil_note(make_navigation("consistent", **task)) == "" == soil_note(make("point"))
    fitted = dataclasses.replace(task["model"], posterior=Posterior.of(("soil.n",), (True,), np.eye(1) / 100))
    assert "not unseen: soil.n" in soil_note(make_navigation("consistent", **{**task, "model": fitted}, posterior=True))


def test_a_model_that_was_never_fitted_is_refused(run, tmp_path):
    found = run("train", "short", "-o", tmp_path, "--env=posterior=true")
    assert found.status == 2
    assert "[posterior]" in found.err and "fitted.toml" in found.err
