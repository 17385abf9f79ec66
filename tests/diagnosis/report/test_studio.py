"""The studio: what a run folder holds, chosen by hand, as text alone, in a real browser."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from small_run import CORNERS, HOSTILE, POINTS, write_many, write_run

from lunar_mjx.diagnosis.folder.refits import read_refits
from lunar_mjx.diagnosis.report import falling, studio
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.report.reasons import reason
from lunar_mjx.diagnosis.report.steps import chain, judged
from lunar_mjx.errors import UserError
from lunar_mjx.report.style import BLUE, DARK_FIGURES, DARK_SHADES, SHADES
from lunar_mjx.rover.description import CORNER_WORDS


def page_data(folder: Path) -> dict:
    result = read_result(folder)
    assert result.traces is not None
    return json.loads(json.dumps(studio._page_data(result, result.traces), allow_nan=False))


def test_refits_and_estimates_are_told_apart_and_each_has_its_error(tmp_path):
    data = page_data(write_run(tmp_path / "run", table=True))
    kinds = {m["label"]: m["kind"] for m in data["models"]}
    assert kinds == {
        "the model as given": "given",
        "the model, refitted": "refit",
        "+ drag": "refit",
        "+ slip sinkage": "refit",
        "+ toe": "estimate",
    }
    given, refitted, drag, half, toe = data["models"]
    assert given["held"] > refitted["held"] > half["held"] > drag["held"]
    assert toe["held"] is None and toe["fit"] <= refitted["fit"]
    with np.load(tmp_path / "run" / "series.npz") as series:
        rows = series["residual"][1][POINTS : 2 * POINTS]
        held = series["residual"][2][series["unit"] == 1]
    assert drag["held"] == pytest.approx(np.sqrt(np.mean(held**2)), rel=1e-4)
    assert refitted["cells"][0][1] == pytest.approx(np.sqrt(np.mean(rows**2)), rel=1e-4)
    assert [e["name"] for e in data["effects"]] == ["drag", "toe", "slip sinkage", "faint"]
    assert [e["model"] for e in data["effects"]] == [2, 4, 3, None]
    assert data["map"]["x_title"] == "slip ratio" and len(data["map"]["x"]) == 2 * POINTS


def test_the_map_of_a_drive_is_where_it_was_measured(tmp_path):
    data = page_data(write_run(tmp_path / "run", table=False))
    assert data["map"]["equal"] and data["map"]["x_title"] == "east x, m"
    assert data["panels"][0][0]["x_title"] == "time, s"
    assert page_data(write_run(tmp_path / "hostile", False, HOSTILE))["map"]["x"] == data["map"]["x"]


def test_refits_of_other_observations_are_left_alone_and_damaged_ones_refused(tmp_path):
    folder = write_run(tmp_path / "run", table=True)
    assert set(read_refits(folder, 4 * POINTS)) == {("slip_sinkage",)}
    assert read_refits(folder, 7) == {}
    np.savez_compressed(folder / "refits.npz", names=np.array(["x"]), residual=np.array(["y"]), predicted=np.zeros(3))
    with pytest.raises(UserError, match=r"refits\.npz"):
        read_refits(folder, 4 * POINTS)


@pytest.mark.parametrize(
    ("evidence", "words"),
    [
        ({"effect": "toe", "status": "not tested", "separable_sigma": 0.4}, "cannot tell"),
        ({"effect": "drag", "status": "accepted", "probability": 0.97}, "falls from 8 to 1 sigma"),
        ({"effect": "toe", "status": "rejected", "probability": 0.001}, "leaves 6 of 8 sigma, where drag leaves 1"),
        ({"effect": "toe", "status": "rejected", "probability": 0.2}, "too much to rule it out (below 5 %)"),
        ({"effect": "toe", "status": "rejected", "nearest": ["drag", 0.97]}, "looks like what drag changes"),
        ({"effect": "toe", "status": "rejected", "probability": "x", "nearest": 3, "separable_sigma": []}, "leaves 6"),
    ],
)
def test_reasons_are_told_in_words(evidence, words):
    assert words in reason(evidence, ["drag"], {"drag": 1.0, "toe": 6.0}, 8.0, "held-out")


def test_no_text_of_a_run_becomes_markup(tmp_path):
    page = studio.write_studio(write_run(tmp_path / "run", True, HOSTILE), tmp_path / "studio.html").read_text("utf-8")
    assert "<img src=x" not in page and page.count("</script>") == 3
    assert "http://" not in page and "https://" not in page


@pytest.mark.slow
def test_the_error_falls_in_an_animation(tmp_path):
    folder = write_run(tmp_path / "run", table=True)
    course = falling._course(3)
    assert course[0] == 0.0 and course[-1] == 2.0 and (np.diff(course) >= 0.0).all()
    path = falling.write_falling(folder, tmp_path / "falling.gif")
    with Image.open(path) as film:
        assert film.n_frames > 2
        film.seek(0)
        first = np.asarray(film.convert("RGB"), int)
        film.seek(film.n_frames - 1)
        last = np.asarray(film.convert("RGB"), int)
    orange = [((p[..., 0] > 200) & (p[..., 2] < 80)).sum() for p in (first, last)]
    assert orange[0] > 1.5 * orange[1] > 0  # the bar of the error
    steps = chain([read_result(folder)])
    splits, _ = judged(steps)
    for _, _, at in falling._worst(steps, splits):  # only what the bar judges
        assert steps[0].observations.in_split(*splits)[at].all()
    with pytest.raises(UserError, match="no known kind"):
        falling.write_falling(folder, tmp_path / "falling.txt")


def test_a_film_ends_where_the_error_stops_falling(tmp_path, monkeypatch):
    folder = write_run(tmp_path / "run", table=True)
    shown = []

    def blank(steps, *rest):  # how many models a film goes through is told by what is drawn; the test above draws
        shown.append(len(steps))
        return np.zeros((24, 32, 3), np.uint8)

    monkeypatch.setattr(falling, "_picture", blank)
    falling.write_falling(folder, tmp_path / "falling.gif")
    with np.load(folder / "series.npz") as kept:
        series = dict(kept)
    for name in ("residual", "predicted"):
        series[name][-1] = series[name][-2]  # what the diagnosis proposes changes nothing
    np.savez(folder / "series.npz", **series)
    falling.write_falling(folder, tmp_path / "still.gif")
    assert shown[0] - 1 == shown[-1] > 1


def test_a_run_without_series_says_what_to_do(tmp_path):
    folder = write_run(tmp_path / "run", table=True)
    (folder / "series.npz").unlink()
    with pytest.raises(UserError, match="lunar-mjx compare"):
        studio.write_studio(folder, tmp_path / "studio.html")


def decoded(coded: list, missing: int) -> np.ndarray:
    low, step, rows = coded
    levels = np.cumsum(np.cumsum(np.array(rows), axis=1), axis=0)
    return np.where(levels == missing, np.nan, low + step * levels)


def test_of_many_channels_every_kind_has_a_row_the_worst_first(tmp_path):
    data = page_data(write_many(tmp_path / "run", samples=40))
    assert len(data["channels"]) == 95 and len(data["units"]) == 8 and data["many"]
    kinds = {k["name"]: k["rows"] for k in data["kinds"]}
    assert len(kinds) == 28 and sorted(r for rows in kinds.values() for r in rows) == list(range(95))
    names = {k: [data["channels"][r] for r in rows] for k, rows in kinds.items()}
    assert set(names["motor drive current, A"]) == {f"motor {CORNER_WORDS[c]} drive current, A" for c in CORNERS}
    assert set(names["gyro, rad/s"]) == {f"gyro {x}, rad/s" for x in "xyz"} and len(names["quaternion"]) == 4
    worst = [max(data["models"][data["base"]]["cells"][r]) for rows in kinds.values() for r in rows[:1]]
    assert worst == sorted(worst, reverse=True) and all(max(line) <= worst[0] for line in data["models"][1]["cells"])
    few = page_data(write_run(tmp_path / "few", table=False))
    assert not few["many"] and [k["rows"] for k in few["kinds"]] == [[0], [1], [2]]


def test_a_thinned_trace_keeps_what_sticks_out_and_the_page_its_size(tmp_path, monkeypatch):
    most = 400_000
    monkeypatch.setattr(studio, "STUDIO_SIZES", dataclasses.replace(studio.STUDIO_SIZES, most_values=most))
    data = page_data(write_many(tmp_path / "run", samples=120))
    panels = [p for line in data["panels"] for p in line]
    rows = 2 + sum(m["line"] is not None for m in data["models"]) + len(data["models"])
    assert 0.9 * most < sum(rows * p["drawn"][0] for p in panels) <= most
    panel = data["panels"][data["channels"].index("gyro x, rad/s")][data["units"].index(unit_of(data, "point turn"))]
    assert panel["drawn"][0] < panel["drawn"][1] == 120
    residual = decoded(panel["residual"], data["missing"])
    assert residual[data["base"]].max() == pytest.approx(80.0, abs=1.5)
    x = decoded(panel["x"], data["missing"])[0]
    assert (np.diff(x) > 0.0).all() and x[0] < 4.0 and x[-1] > 56.0
    # short series are drawn whole, and leave their share to long ones
    assert data["panels"][data["channels"].index("bus voltage, V")][0]["drawn"] == [12, 12]
    for m in data["models"]:
        assert decoded(panel["values"], data["missing"])[m["line"]].shape == residual[0].shape


def unit_of(data: dict, name: str) -> dict:
    return next(u for u in data["units"] if u["name"] == name)


def test_traces_are_coded_to_less_than_a_pixel_whatever_they_hold():
    rng = np.random.default_rng(1)
    rows = np.vstack([rng.standard_normal(50), 1e6 * rng.standard_normal(50), np.full(50, np.nan), np.zeros(50)])
    rows[0, 3], rows[1, 4], rows[1, 5] = np.nan, np.inf, -1e308
    found = decoded(json.loads(json.dumps(studio._coded(rows, 0, 2000), allow_nan=False)), studio._MISSING)
    known = np.abs(rows) < 1e300
    assert (np.isfinite(found) == known).all()
    step = float(np.ptp(rows[0][known[0]])) / 2000
    assert np.abs(found - rows)[known].max() <= 0.501 * step
    for still in (np.full((2, 4), 7.0), np.full((1, 3), np.nan)):
        assert decoded(studio._coded(still, 0, 100), studio._MISSING) == pytest.approx(still, nan_ok=True)


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_all_that_is_drawn_follows_the_page_into_the_dark(tmp_path, browser, dark):
    page = studio.write_studio(write_run(tmp_path / "run", True), tmp_path / "studio.html")
    browser.dark(dark)
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    browser.wait("document.querySelectorAll('#traces .main-svg').length > 0")
    paper = browser.value("getComputedStyle(document.body).backgroundColor")
    assert paper == ("rgb(13, 17, 23)" if dark else "rgb(255, 255, 255)")
    assert browser.value("document.querySelector('#traces .main-svg').style.background") == paper
    models = browser.value("document.getElementById('traces').data.filter(t => t.name !== 'measured')")
    blue = DARK_FIGURES[BLUE] if dark else BLUE
    assert blue in {t["line"]["color"] for t in models}
    shades = browser.value("document.getElementById('place').data[0].marker.colorscale.map(step => step[1])")
    assert shades == list(DARK_SHADES if dark else (c for _, c in SHADES))
    assert browser.collisions() == []
    assert not browser.problems


@pytest.mark.slow
@pytest.mark.parametrize("table", [True, False], ids=["table", "drive"])
def test_by_hand_in_a_browser(tmp_path, browser, table):
    """Mouse, keyboard, phone width, hostile names, and not one request but for the page itself."""
    page = studio.write_studio(write_run(tmp_path / "run", table, HOSTILE), tmp_path / "studio.html")
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    assert browser.value("[0.9995, 0.995, 0.98, 0.0982, 0.004].map(percent)") == [
        "> 99.9 %",
        "99.5 %",
        "98 %",
        "10 %",
        "0.4 %",
    ]
    assert "…." not in browser.value("document.body.textContent")
    corner = 'document.querySelector(\'#heat [data-row="0"][data-column="{}"]\')'
    why = "document.getElementById('why').textContent.includes('{}')"
    assert browser.value("document.querySelectorAll('#heat tbody button').length") == (4 if table else 6)
    # the first field is the worst; another one is chosen by mouse, and by arrow keys from there
    browser.value(corner.format(0) + ".click()")
    browser.wait("document.body.dataset.cell === '0,0'")
    browser.value(corner.format(0) + ".focus()")
    browser.press("ArrowRight")
    browser.press("ArrowDown")
    browser.wait("document.body.dataset.cell === '1,1'")
    assert HOSTILE[:9] in browser.value("document.getElementById('traces').getAttribute('aria-label')")
    # an effect by Enter: its model, its error, its reason
    before = float(browser.value(corner.format(1) + ".textContent"))
    browser.value("document.querySelector('#effects button').focus()")
    browser.press("End")
    browser.wait(why.format("cannot tell"))
    browser.press("Home")
    browser.press("ArrowDown")
    browser.press("ArrowDown")
    browser.wait(why.format("slip sinkage"))
    assert browser.value("document.body.dataset.model") == "3"
    after = float(browser.value(corner.format(1) + ".textContent"))
    assert after != before
    # Plotly draws when it has time to
    browser.wait("document.querySelectorAll('#traces .trace').length > 0")
    browser.wait("document.querySelectorAll('#place .points path').length > 0")
    browser.resize(360, 740)
    browser.wait("innerWidth === 360 && document.documentElement.scrollWidth <= 360")
    assert browser.value("document.title") == "Studio: run" and browser.value("document.images.length") == 0
    buttons = browser.value("[...document.querySelectorAll('.modebar-btn')].map(button => button.dataset.title)")
    assert "Pan" in buttons and not any("hare" in title or "loud" in title for title in buttons)
    assert browser.requests == [page.as_uri()]
    assert not browser.problems


@pytest.mark.slow
def test_95_channels_of_eight_drives_by_hand(tmp_path, browser):
    """Kinds unfold by key, the filter finds corners, every field opens, and all of it fits a phone and 5 MB."""
    page = studio.write_studio(write_many(tmp_path / "run", samples=600), tmp_path / "studio.html")
    assert page.stat().st_size < 5e6
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    shown = "document.querySelectorAll('#heat tbody tr:not([hidden])').length"
    assert browser.value(shown) == 28
    # what was chosen is drawn within a screen of the heat map's first row
    top = "document.getElementById('{}').getBoundingClientRect().top"
    assert browser.value(f"{top.format('h-detail')} - {top.format('heat')}") < 760
    # the worst kind by keys: from its field to its name, unfolded, down to the first of its channels and its field
    browser.value("document.querySelector('#heat tbody td button').focus()")
    browser.press("ArrowLeft")
    assert browser.value("document.activeElement.getAttribute('aria-expanded')") == "false"
    browser.press("Enter")
    browser.wait(f"{shown} === 32 && document.activeElement.getAttribute('aria-expanded') === 'true'")
    browser.press("ArrowRight")
    browser.press("ArrowDown")
    first = browser.value("document.querySelector('#heat .member td button').dataset.row")
    browser.wait(f"document.activeElement.dataset.row === '{first}' && document.body.dataset.cell === '{first},0'")
    assert browser.value("document.querySelectorAll('#heat [aria-pressed=true]').length") == 1
    assert browser.value("document.querySelectorAll('#heat [tabindex=\"0\"]').length") == 1
    browser.value("document.getElementById('unfold').click()")
    assert browser.value(shown) == 28
    # a folded kind opens its worst channel
    spike = browser.value("data.channels.indexOf('gyro x, rad/s')")
    browser.value("lines.find(l => l.name === 'gyro, rad/s').line.querySelectorAll('td button')[3].click()")
    browser.wait(f"document.body.dataset.cell === '{spike},3'")
    assert "of each stretch" in browser.value("document.getElementById('chosen').textContent")
    assert browser.value("Math.max(...document.getElementById('traces').data.at(-2).y)") > 75.0
    box = "document.getElementById('filter')"
    find = f"{box}.value = '{{}}'; {box}.dispatchEvent(new Event('input'))"
    browser.value(find.format("LEFT front current"))
    assert browser.value(shown) == 3 and "3 of 95" in browser.value("document.getElementById('found').textContent")
    browser.value(find.format("no such channel"))
    assert browser.value(shown) == 0
    browser.value(find.format(""))
    # every field of every channel
    opened = """(() => { document.getElementById('unfold').click(); let count = 0;
      for (const b of document.querySelectorAll('#heat button[data-row]')) {
        row = Number(b.dataset.row); column = Number(b.dataset.column); showChoice();
        const panel = data.panels[row][column], rows = [...numbers(panel.values), ...numbers(panel.residual)];
        count += rows.every(r => r.length === numbers(panel.x)[0].length && r.some(Number.isFinite)); }
      return count; })()"""
    assert browser.value(opened) == 95 * 8
    browser.resize(360, 740)
    browser.wait("innerWidth === 360 && document.documentElement.scrollWidth <= 360")
    assert browser.collisions() == []
    assert browser.requests == [page.as_uri()]
    assert not browser.problems


@pytest.mark.slow
def test_a_run_that_nobody_asked_why_offers_no_choice_of_effects(tmp_path, browser):
    folder = write_run(tmp_path / "run", table=True)
    for kept in ("verdict.json", "next.json", "refits.npz", "signatures.npz"):
        (folder / kept).unlink(missing_ok=True)
    browser.open(studio.write_studio(folder, tmp_path / "studio.html").as_uri())
    browser.wait("document.body?.dataset.ready")
    assert "lunar-mjx why finds them" in browser.value("document.getElementById('probabilities').textContent")
    assert browser.value("document.getElementById('how').offsetHeight") == 0
    assert not browser.problems
