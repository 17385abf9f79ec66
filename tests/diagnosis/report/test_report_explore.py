"""What the report lets one look at: panels for every channel and manoeuvre, bins of a covariate, shapes of effects."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest

from lunar_mjx.diagnosis.report import explore, figures
from lunar_mjx.diagnosis.report.read import Result, Traces
from lunar_mjx.diagnosis.report.steps import chain
from lunar_mjx.inference.observations import Observations, Series

TIME = np.arange(60) * 0.5
CHANNELS = ("pitch_deg", "motor_lf_drive_current_A")


@pytest.fixture(scope="module")
def result():
    """Two logs of two channels; the second channel of the second log misfits, and one effect has just that shape."""
    series = tuple(
        Series(log, c, n * 60, (n + 1) * 60, TIME, 0.1)
        for n, (log, c) in enumerate((log, c) for log in range(2) for c in CHANNELS)
    )
    unit = np.repeat([0, 1], 120)
    o = Observations(np.zeros(240), series, ("a", "b"), ("fit", "fit"), unit, ("fit", "fit"), ("flat", "climb"))
    rng = np.random.default_rng(0)
    noise = rng.standard_normal((3, 240))
    shape = np.zeros(240)
    shape[180:] = 8.0 * np.sin(TIME)
    residual = noise + np.array([[2.0], [1.0], [0.0]]) * shape
    residual[0, 3] = np.nan
    traces = Traces(o, ("as given", "refitted", "with drag"), -0.1 * residual, residual, np.tile(TIME, 4), residual)
    evidence = [{"effect": "drag", "status": "accepted"}, {"effect": "faint", "status": "not tested"}]
    return Result(
        "run", {}, None, {"evidence": evidence}, None, None, None, traces, {"drag": shape, "faint": 0.0 * shape}
    )


def test_every_channel_of_every_manoeuvre_has_a_panel_and_the_worst_comes_first(result):
    (block,) = explore.panels(chain([result]))
    assert len(block.panels) == 4
    first = next(iter(block.panels.values()))
    assert first["label"] == "motor left front drive current, A: climb"
    measured, refitted, improved, left, less = first["y"]
    np.testing.assert_allclose(measured, 0.0)
    np.testing.assert_allclose(left, result.traces.residual[1, 180:], rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(less, result.traces.residual[2, 180:], rtol=1e-4, atol=1e-4)
    assert len(refitted) == len(improved) == len(first["x"]) == 60
    maps = block.figure.data
    assert len(maps) == 3  # as given, refitted, with drag: one for each model of the chain
    for heat, residual in zip(maps, result.traces.residual, strict=True):
        assert {str(k) for row in heat.customdata for k in row} == set(block.panels)
        worst = float(np.log10(np.sqrt(np.nanmean(residual[180:] ** 2))))
        assert heat.z[1][1] == pytest.approx(max(worst, np.log10(0.3)))
    json.dumps(block.panels, allow_nan=False)


def test_the_title_of_a_map_names_all_that_was_added(result):
    names = "stress_integral, exit_angle, side_entry, side_wall, slide_softening"
    traces = dataclasses.replace(result.traces, labels=("as given", "refitted", f"with {names}"))
    (block,) = explore.panels(chain([dataclasses.replace(result, traces=traces)]))
    assert block.figure.layout.annotations[-1].text == f"3. + {names} (proposed)"


def test_names_from_files_are_no_markup_in_figures(result):
    """Plotly reads a few tags, links among them, in whatever it draws as text."""
    link = '<a href="x">climb</a>'
    o = dataclasses.replace(result.traces.observations, unit_names=("flat", link))
    labels = ("as given", "refitted", f"with {link}")
    traces = dataclasses.replace(result.traces, observations=o, labels=labels)
    (block,) = explore.panels(chain([dataclasses.replace(result, traces=traces)]))
    drawn = [block.figure, figures.bars({link: 0.5}, "probability, %"), figures.isolability({link: {link: 1.0}})]
    for figure in drawn:
        words = str(json.loads(figure.to_json()))  # JSON itself spells "<" otherwise
        assert "&lt;a" in words and "<a" not in words


def test_of_many_channels_the_worst_have_rows_and_all_are_in_the_list(result, monkeypatch):
    monkeypatch.setattr(explore, "EXPLORE", dataclasses.replace(explore.EXPLORE, channels=1))
    (block,) = explore.panels(chain([result]))
    assert [list(heat.y) for heat in block.figure.data] == [["motor left front drive current, A"]] * 3
    assert len(block.panels) == 4 and "Of 2 channels" in block.caption


def test_residuals_are_averaged_over_what_they_may_follow(result):
    (block,) = explore.dependence(result)
    titles = [a.title.text for a in block.figure.select_xaxes() if a.title.text]
    assert titles == ["time, s"]  # the measured pitch is the same throughout
    x = np.linspace(0.0, 1.0, 200)
    centre, mean, error = explore._binned(x, 3.0 * x)
    np.testing.assert_allclose(mean, 3.0 * np.array(centre))
    assert len(mean) == len(error) == 16


def test_the_gallery_shows_an_effect_where_it_shows_most(result):
    (block,) = explore.gallery(result)
    dots, line = block.figure.data
    np.testing.assert_allclose(dots.y, result.traces.residual[1, 180:])
    np.testing.assert_allclose(line.y, 8.0 * np.sin(TIME))
    assert "climb" in block.figure.layout.annotations[0].text


def test_no_line_is_drawn_across_a_gap():
    x = np.array([0.0, 0.1, 0.2, 5.0, 5.1])
    broken, (y, z) = explore.broken(x, 10.0 * x, -x)
    assert list(broken) == pytest.approx([0.0, 0.1, 0.2, 2.6, 5.0, 5.1])
    assert np.isnan(y[3]) and np.isnan(z[3]) and np.isfinite(np.delete(y, 3)).all()
    for whole in (np.arange(5.0), np.array([0.0, 0.0, 0.0, 1.0]), np.array([2.0]), np.zeros(0)):
        same, (values,) = explore.broken(whole, whole)
        np.testing.assert_array_equal(same, whole)
        np.testing.assert_array_equal(values, whole)
