"""The report in a real browser: by mouse and keyboard, on a phone, in the dark, without a network."""

from __future__ import annotations

from pathlib import Path

import pytest
from chromium import Browser
from small_run import HOSTILE, complete, write_run

from lunar_mjx.diagnosis.report import write_report
from lunar_mjx.report.style import DARK, DARK_SHADES, PAPER, SHADES

pytestmark = pytest.mark.slow

CHOICE = "document.querySelector('select.explorer')"
DRAWN = "document.getElementById('figure-2')"
"""The traces of what is chosen: the third figure, after the waterfall and the heat maps."""


@pytest.fixture(params=[True, False], ids=["table", "drive"])
def page(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_report([complete(write_run(tmp_path / "run", request.param, HOSTILE))], tmp_path / "report.html")


def colour(text: str) -> str:
    """A colour as the browser tells it."""
    return "rgb({}, {}, {})".format(*(int(text[i : i + 2], 16) for i in (1, 3, 5)))


def test_by_mouse_and_by_keyboard(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    assert browser.value("document.querySelector('.badge').textContent") == "effect named"
    # a click on the first field of the first heat map shows its traces
    names = browser.value(f"[...{CHOICE}.options].map(o => o.value)")
    field = browser.value(
        "(() => { const drawn = document.querySelector('#figure-1 .xy .hm, #figure-1 .plot');"
        "document.getElementById('figure-1').scrollIntoView(); const box = drawn.getBoundingClientRect();"
        "return [box.left + 0.25 * box.width, box.top + 0.25 * box.height]; })()"
    )
    key = browser.value("String(document.getElementById('figure-1').data[0].customdata[0][0])")
    browser.value(f"{CHOICE}.value = {next(i for i in names if i != key)!r}")
    browser.click(*field)
    browser.wait(f"{CHOICE}.value === {key!r}")
    # and marks it in every map
    marked = "document.getElementById('figure-1').layout.shapes.map(s => [s.xref, s.x0, s.y0])"
    assert browser.value(marked) == [["x", -0.5, -0.5], ["x2", -0.5, -0.5], ["x3", -0.5, -0.5]]
    before = browser.value(f"{DRAWN}.data[0].y.length && JSON.stringify({DRAWN}.data[1].y)")
    assert before
    # the list does the same by keyboard
    browser.value(f"{CHOICE}.focus()")
    browser.press("ArrowDown" if names.index(key) + 1 < len(names) else "ArrowUp")
    browser.wait(f"{CHOICE}.value !== {key!r} && JSON.stringify({DRAWN}.data[1].y) !== {before!r}")
    # folded tables open by Enter
    browser.value("document.querySelector('summary').focus()")
    browser.press("Enter")
    browser.wait("document.querySelector('details').open")
    assert browser.value("document.title") != "1" and browser.value("document.images.length") == 0
    assert browser.asked() == [page.as_uri()]
    # nor does a button send a figure anywhere
    buttons = browser.value("[...document.querySelectorAll('.modebar-btn')].map(button => button.dataset.title)")
    assert "Pan" in buttons and not any("hare" in title or "loud" in title for title in buttons)
    assert not browser.problems


def test_words_do_not_collide_and_a_phone_scrolls_no_page_sideways(page: Path, browser: Browser) -> None:
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    assert browser.collisions() == []
    browser.resize(360, 740)
    browser.open(page.as_uri() + "?phone")
    browser.wait("location.search === '?phone' && document.body?.dataset.ready")
    assert browser.value("document.documentElement.scrollWidth") <= 360
    assert browser.collisions() == []
    assert browser.value("document.querySelectorAll('.modebar').length") == 0  # it would lie on the legend
    # what is wider than the phone is reached by keyboard
    wide = "[...document.querySelectorAll('.wide')].filter(box => box.scrollWidth > box.clientWidth)"
    assert browser.value(f"{wide}.length > 0 && {wide}.every(box => box.tabIndex === 0)")
    assert not browser.problems


@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_figures_follow_the_page_into_the_dark(tmp_path: Path, browser: Browser, dark: bool) -> None:
    page = write_report([complete(write_run(tmp_path / "run", True))], tmp_path / "report.html")
    browser.dark(dark)
    browser.open(page.as_uri())
    browser.wait("document.body?.dataset.ready")
    paper = colour(DARK[PAPER] if dark else PAPER)
    assert browser.value("getComputedStyle(document.body).backgroundColor") == paper
    for n in range(3):
        assert browser.value(f"document.querySelector('#figure-{n} .main-svg').style.background") == paper
    shades = browser.value("document.getElementById('figure-1').data[0].colorscale.map(step => step[1])")
    assert shades == list(DARK_SHADES if dark else (c for _, c in SHADES))
    assert not browser.problems


def test_what_never_comes_is_told_by_name(browser: Browser) -> None:
    browser.most_frames = 30
    with pytest.raises(TimeoutError, match=r"within 30 frames.*window\.missing"):
        browser.wait("window.missing")
