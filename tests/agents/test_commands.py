"""`lunar-mjx train`, `evaluate` and `play`, and what they say to mistakes."""

from __future__ import annotations

import json

import jax
import numpy as np
import pytest
from PIL import Image

from lunar_mjx.agents.networks import make_actor
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.policy import Policy, load_policy, save_policy

SHORT = [
    f"--env={text}"
    for text in (
        "terrain=flat",
        "goal_distance=[1.0, 1.5]",
        "places=64",
        "decimation=25",
        "episode_time=15.0",
        "action=velocity",
        "start_yaw=0.3",
    )
]
"""A goal at most 1 m away, which the motors' 0.28 m/s (48 V) and soft soil leave some seconds for."""


@pytest.mark.slow
def test_trains_resumes_and_evaluates_without_physics(run, tmp_path):
    line = ("train", "point", "-o", tmp_path, "--set", "epoch_steps=20", "--eval-every", 1, "--eval-episodes", 32)
    first = run(*line, "--steps", 1280)
    assert first.status == 0 and "success on unseen ground" in first.out and str(tmp_path / "policy.npz") in first.out
    assert "1,280 steps" in first.err
    second = run(*line, "--steps", 2560)
    assert second.status == 0 and "2,560 steps" in second.err and "\n640 steps" not in second.err
    rows = (tmp_path / "progress.csv").read_text().splitlines()
    assert [r.split(",")[0] for r in rows] == ["steps", "640", "1280", "1920", "2560"]
    record = json.loads((tmp_path / "curve.json").read_text())
    assert record["finished"] and record["final"]["episodes"] == 32
    for picture in ("curve.png", "episodes.png"):
        assert np.ptp(np.asarray(Image.open(tmp_path / picture))) > 100
    scored = run("evaluate", tmp_path / "policy.npz", "--episodes", 16, "-o", tmp_path / "score.json")
    assert scored.status == 0 and "of 16 episodes" in scored.out
    assert json.loads((tmp_path / "score.json").read_text())["episodes"] == 16


@pytest.mark.slow
def test_plays_an_agent_as_video_picture_and_table(run, tmp_path):
    found = run("play", "--agent", "scripted", "--task", "consistent", "--view", "top", "-o", tmp_path, *SHORT)
    assert found.status == 0, found.err
    assert found.out.startswith("goal reached after")
    with Image.open(tmp_path / "episode.webp") as video:
        assert video.n_frames > 5
        first = np.asarray(video.convert("RGB"))
        video.seek(video.n_frames - 1)
        assert (np.asarray(video.convert("RGB")) != first).any()
    table = np.genfromtxt(tmp_path / "episode.csv", delimiter=",", names=True)
    assert {"time_s", "position_x_m", "action_drive", "action_steer"} <= set(table.dtype.names)
    assert table["reward"][-1] > 400.0, "the goal pays 500"


@pytest.mark.slow
def test_plays_a_policy_of_the_ladder_in_its_unseen_worlds(run, tmp_path):
    few = ("--env=worlds=4", "--env=episode_time=3.0")
    found = run("play", "luvmi_x/ladder-3", "--view", "top", "-o", tmp_path, *few)
    assert found.status == 0, found.err
    assert found.out.startswith("time is up after 3.0 s")
    table = np.genfromtxt(tmp_path / "episode.csv", delimiter=",", names=True)
    assert np.hypot(np.ptp(table["position_x_m"]), np.ptp(table["position_y_m"])) > 0.5


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("train", "fast"), "does not exist"),
        (("train", "point", "--set", "speed=1"), "is no setting"),
        (("train", "point", "--set", "envs"), "is not name=value"),
        (("train", "point", "--environment", "nowhere"), "navigation, point"),
        (("train", "point", "--processes", 2), "--coordinator"),
        (("train", "point", "--coordinator", "here"), "is not HOST:PORT"),
        (("train", "point", "--coordinator", "localhost:99999", "--processes", "2"), "is not HOST:PORT"),
        (("evaluate", "zero", "--agent", "random"), "is given beside 'zero'"),
        (("play", "zero", "--view", "nope"), "view = 'nope' does not exist"),
        (("train", "point", "--coordinator", "h:1"), "--processes = 1 is below 2"),
        (("train", "point", "--coordinator", "h:1", "--processes", 2, "--process", 2), "is not one of 0 to 1"),
        (("evaluate", "clever"), "is no rover with a trained policy"),
        (("play", "clever"), "one that ships (luvmi_x, luvmi_x/escape, luvmi_x/ladder-3, viper)"),
        (("evaluate", "missing.npz"), "missing.npz"),
        (("play", "zero", "--task", "easy"), "paper, consistent, large"),
    ],
)
def test_mistakes_are_one_sentence(run, tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    found = run(*arguments)
    assert found.status == 2 and said in found.err and "Traceback" not in found.err


def test_a_policy_of_an_environment_without_a_name_is_read_and_not_played(run, tmp_path):
    layers = {"obs": 2, "actions": 1, "layers": [3], "activation": "relu", "layer_norm": False}
    params = make_actor(**layers).init(jax.random.PRNGKey(0))
    path = save_policy(Policy(params, None, None, layers, {}, {}), tmp_path / "policy.npz")
    assert load_policy(path).act(np.zeros((4, 2), np.float32)).shape == (4, 1)
    found = run("evaluate", path)
    assert found.status == 2 and "says of no environment how it is made" in found.err


def test_lists_the_trainings(run):
    assert "large-td3" in run("train", "--list").out


def test_a_policy_whose_observations_lie_in_another_order_is_not_driven(run, tmp_path):
    layers = {"obs": 6, "actions": 6, "layers": [3], "activation": "relu", "layer_norm": False}
    params = make_actor(**layers).init(jax.random.PRNGKey(0))
    made = {"terrain": "flat", "places": 8, "observations": ["body_velocity", "body_rates"]}
    policy = Policy(params, None, None, layers, {"name": "navigation", "options": made}, {})
    path = str(save_policy(policy, tmp_path / "policy.npz"))
    assert open_agent(path)[0].config.observations == ("body_velocity", "body_rates")
    found = run("play", path, "--env", 'observations=["body_rates", "body_velocity"]', "-o", tmp_path / "out")
    assert found.status == 2
    assert "trained on the observations body_velocity, body_rates, and" in found.err
    assert "the environment has body_rates, body_velocity; change no observations" in found.err
