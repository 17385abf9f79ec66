"""Counterparts of the seed paper's figures that show rather than measure."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.figures import FIGURES, available_figures, make_figures


def test_all_figures_but_the_learning_curves_have_a_counterpart(monkeypatch, capsys):
    assert set("12345") <= set(FIGURES)
    monkeypatch.setenv("MUJOCO_GL", "disable")
    assert set(available_figures()) == set(FIGURES) - {"1", "4"}
    assert "Figs. 1 and 4 are left out: cameras: MUJOCO_GL=disable" in capsys.readouterr().err


def test_workflow(tmp_path):
    picture, numbers = make_figures(["2"], tmp_path)
    assert picture.name == "fig2_workflow.png" and picture.stat().st_size > 10_000
    assert "step on MJX" in numbers.read_text()


def test_display_shows_what_the_front_camera_sees(opengl):
    figure, numbers = FIGURES["1"]()
    assert numbers["size"] == [320, 240]
    assert sum(numbers["share_of_pixels"].values()) == pytest.approx(1.0)
    assert numbers["share_of_pixels"]["terrain"] > 0.5 and numbers["share_of_pixels"]["sky"] > 0.1
    assert 1.0 < numbers["nearest_m"] < numbers["median_m"] < 30.0
    view = np.array(numbers["view_matrix"])
    position = np.linalg.inv(view)[:3, 3]
    assert position == pytest.approx(numbers["camera_position_m"])
    assert len(figure.axes) >= 4
