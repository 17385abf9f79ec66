"""Counterparts of the seed paper's figures that show rather than measure."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from lunar_mjx.paper import pictures, training_figure
from lunar_mjx.paper.figures import FIGURES, available_figures, make_figures
from lunar_mjx.paper.training_figure import figure_6
from lunar_mjx.report.style import DARK, PAPER, darkened, styled


def test_all_figures_have_a_counterpart(monkeypatch, capsys, tmp_path):
    assert set("123456") <= set(FIGURES)
    monkeypatch.setenv("MUJOCO_GL", "disable")
    monkeypatch.setattr(training_figure, "RECORDS", tmp_path)  # an installed wheel has no records
    assert set(available_figures()) == set(FIGURES) - {"6"}
    assert "Fig. 6 is left out" in capsys.readouterr().err
    assert set(available_figures([Path("runs/td3")])) == set(FIGURES)
    assert capsys.readouterr().err == ""


def _record(seed, episodes=True):
    rows = [{"steps": 0, "episode_return": None, "success": None}]
    rows += [{"steps": 100 * i, "episode_return": float(i - seed), "success": 0.1 * i} for i in range(1, 8)]
    kept = {"episode_return": [float(i + seed) for i in range(30 - seed)]} if episodes else None
    return {
        "training": "paper-td3",
        "seed": seed,
        "rows": rows,
        "episodes": kept,
        "final": {"success": 0.7},
        "unseen": [{"steps": 300, "success": 0.5}],
    }


def test_learning_curves_are_those_of_the_trainings(tmp_path):
    folders = [tmp_path / f"seed{seed}" for seed in (0, 1)]
    for seed, folder in enumerate(folders):
        folder.mkdir()
        (folder / "curve.json").write_text(json.dumps(_record(seed)))
    picture, file = make_figures(["6"], tmp_path, folders)
    assert picture.name == "fig6_training.png" and picture.stat().st_size > 10_000
    numbers = json.loads(file.read_text())
    assert numbers["axis"] == "episode" and [r["seed"] for r in numbers["trainings"]["paper-td3"]] == [0, 1]
    assert numbers["trainings"]["paper-td3"][1]["last_return"] == 6.0

    figure, _ = figure_6(folders)
    at, mean = figure.axes[0].lines[0].get_data()
    assert len(at) == 29  # as far as both seeds have episodes
    assert mean[0] == pytest.approx(0.5) and mean[-1] == pytest.approx(np.mean(np.arange(9, 29)) + 0.5)


def test_kept_trainings_are_drawn_when_none_is_given(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(training_figure, "RECORDS", tmp_path)
    many = {"rover": "viper", "train": {"envs": 8192}, "seeds": [_record(0, False)]}
    (tmp_path / "large_viper.json").write_text(json.dumps(many))
    assert "6" in available_figures()
    assert json.loads(make_figures(["6"], tmp_path)[1].read_text())["axis"] == "steps"
    assert "kept in benchmarks/rl/large_viper.json" in capsys.readouterr().err

    episodes = {"episode_return": [float(i) for i in range(60)], "success": [i >= 30 for i in range(60)]}
    runs = {"paper-td3": [{"seed": s, "episodes": episodes, "steps": 900} for s in (0, 1)]}
    (tmp_path / "paper.json").write_text(json.dumps({"runs": runs}))
    numbers = json.loads(make_figures(["6"], tmp_path)[1].read_text())
    assert numbers["axis"] == "episode" and list(numbers["trainings"]) == ["paper-td3"]
    assert numbers["trainings"]["paper-td3"][0]["mean_of_last_50_episodes"] == {"episode_return": 34.5, "success": 0.6}
    figure, _ = figure_6([tmp_path / "paper.json"])
    assert figure.axes[1].get_xlabel() == "episode" and figure.axes[1].lines[0].get_ydata()[-1] == 100.0


def test_learning_curves_of_many_rovers_are_by_step(tmp_path):
    many = {"rover": "viper", "train": {"envs": 8192}, "seeds": [_record(0, False), _record(1, False)]}
    (tmp_path / "many.json").write_text(json.dumps(many))
    figure, numbers = figure_6([tmp_path / "many.json"])
    assert numbers["axis"] == "steps" and list(numbers["trainings"]) == ["TD3, viper, 8,192 at once"]
    assert [len(line.get_xdata()) for line in figure.axes[0].lines] == [7, 7]
    assert figure.axes[1].lines[1].get_ydata().tolist() == [50.0]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "is not there"),
        ("{", "holds no record"),
        ("[]", "holds no record"),
        ('{"training": "x"}', "holds no record"),
        ('{"seeds": []}', "holds no record"),
    ],
)
def test_what_is_no_training_is_one_sentence(run, tmp_path, monkeypatch, content, message):
    file = tmp_path / "curve.json"
    if content is not None:
        file.write_text(content)
    result = run("figures", "--only", "6", "--training", file, "-o", tmp_path / "out")
    assert result.status == 2 and message in result.err
    monkeypatch.setattr(training_figure, "RECORDS", tmp_path / "none")
    assert run("figures", "--only", "6").status == 2


def test_workflow(tmp_path):
    picture, numbers = make_figures(["2"], tmp_path)
    assert picture.name == "fig2_workflow.png" and picture.stat().st_size > 10_000
    assert "step on MJX" in numbers.read_text()


@pytest.mark.slow
def test_display_shows_what_the_front_camera_sees():
    figure, numbers = FIGURES["1"]()
    assert numbers["size"] == [320, 240]
    assert sum(numbers["share_of_pixels"].values()) == pytest.approx(1.0)
    assert numbers["share_of_pixels"]["terrain"] > 0.5 and numbers["share_of_pixels"]["sky"] > 0.1
    assert 1.0 < numbers["nearest_m"] < numbers["median_m"] < 30.0
    view = np.array(numbers["view_matrix"])
    position = np.linalg.inv(view)[:3, 3]
    assert position == pytest.approx(numbers["camera_position_m"])
    assert len(figure.axes) >= 4


def test_a_figure_for_dark_pages_comes_beside_the_light_one(tmp_path):
    light, dark, numbers = make_figures(["2"], tmp_path, dark=True)
    assert [p.name for p in (light, dark, numbers)] == [
        "fig2_workflow.png",
        "fig2_workflow_dark.png",
        "fig2_workflow.json",
    ]
    corners = []
    for path in (light, dark):
        with Image.open(path) as picture:
            corners.append("#{:02x}{:02x}{:02x}".format(*picture.convert("RGB").getpixel((0, 0))))
    assert corners == [PAPER, DARK[PAPER]]


@pytest.mark.slow
def test_the_ground_in_space_stands_on_the_page_itself(monkeypatch):
    monkeypatch.setattr(pictures, "_portrait", lambda *_: (np.zeros((2, 2, 3)), {"title": ""}))
    with styled():
        figure, _ = pictures.figure_4()
    canvas = FigureCanvasAgg(darkened(figure))
    canvas.draw()
    seen = np.asarray(canvas.buffer_rgba())[..., :3].astype(int)
    high, wide = seen.shape[0] // 2, seen.shape[1] // 2
    surface = seen[high:, wide:]  # the last of four fields
    page = [int(DARK[PAPER][i : i + 2], 16) for i in (1, 3, 5)]
    assert (np.abs(surface - page).max(axis=-1) < 3).mean() > 0.88  # it is 0.91, and with panes behind the ground 0.85
