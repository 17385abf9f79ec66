"""The demonstration at its smallest, one rover of each kind for a fifth of a second, and its page in a real browser."""

from __future__ import annotations

import json
import re
from types import SimpleNamespace
from typing import Any, cast

import pytest

from lunar_mjx.demo import run_demo, sections
from lunar_mjx.demo.figures import ROVERS
from lunar_mjx.errors import UserError
from lunar_mjx.report.page import write_page


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The page, and what was told while it was made."""
    told: list[tuple[str, float]] = []
    folder = tmp_path_factory.mktemp("demo") / "new"
    page = run_demo(folder, lambda what, done: told.append((what, done)), rovers=1, seconds=0.2, starts=1)
    assert page == folder / "demo.html"
    return page, told


@pytest.mark.slow
def test_the_demonstration_writes_its_page_and_its_numbers(made):
    page, told = made
    html = page.read_text(encoding="utf-8")
    assert not re.search(r"https?:", html) and len(html.encode()) < 5_000_000
    assert "MIT" in html and "Pavlov" in html and "replicate" not in html.split("<h2>")[0]
    shares = [done for _, done in told]
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0
    numbers = json.loads((page.parent / "summary.json").read_text(encoding="utf-8"))
    assert [d["rover"] for d in numbers["drives"]] == ["viper", "luvmi_x"]
    assert all(len(d["distance_m"]) == 1 for d in numbers["drives"])
    names = [case["name"] for case in numbers["wheel"]]
    assert names == ["paper", "consistent", "paper, refitted", "consistent, refitted"]
    scores = {case["name"]: case["comparison"]["overall"] for case in numbers["wheel"]}
    assert scores["consistent"] < scores["paper"]
    husky = numbers["husky"]
    assert husky["error_after"]["fit"] < husky["error_before"]["fit"]
    assert "BorealTC" in html or "LaRocque" in html
    assert numbers["wheel"][0]["fit"] is None and numbers["wheel"][3]["fit"]["values"]["soil"]["n"] > 0


@pytest.mark.slow
@pytest.mark.parametrize("dark", [False, True], ids=["light", "dark"])
def test_the_page_by_hand_in_a_browser(made, browser, dark):
    """Mouse, keyboard, words that do not collide, and not one request but for the page itself."""
    page = made[0].as_uri()
    browser.dark(dark)
    browser.open(page)
    browser.wait("document.body?.dataset.ready")
    assert browser.value("document.querySelectorAll('.js-plotly-plot .main-svg').length") > 5
    papers = "[...document.querySelectorAll('.js-plotly-plot')].map(p => p.querySelector('.main-svg').style.background)"
    paper = browser.value("getComputedStyle(document.body).backgroundColor")
    assert paper == ("rgb(13, 17, 23)" if dark else "rgb(255, 255, 255)")
    assert set(browser.value(papers)) == {paper}
    assert browser.collisions() == []
    # a click on the legend hides a model in the headline figure
    mark = "document.querySelector('#figure-0 .legendtoggle')"
    browser.value(f"{mark}.scrollIntoView({{block: 'center'}})")
    box = browser.value(f"(() => {{ const b = {mark}.getBoundingClientRect(); return [b.x + 8, b.y + 8]; }})()")
    browser.click(*box)
    browser.wait("document.getElementById('figure-0').data[0].visible === 'legendonly'")
    # tables open by keyboard
    browser.value("document.querySelector('summary').focus()")
    browser.press("Enter")
    browser.wait("document.querySelector('details').open")
    assert browser.asked() == [page]
    assert not browser.problems


@pytest.mark.slow
def test_the_page_on_a_phone(made, browser):
    browser.resize(360, 740)
    browser.open(made[0].as_uri())
    browser.wait("document.body?.dataset.ready")
    assert browser.value("document.documentElement.scrollWidth") <= 360
    assert browser.collisions() == []
    wide = "[...document.querySelectorAll('.wide')].filter(box => box.scrollWidth > box.clientWidth)"
    assert browser.value(f"{wide}.length > 0 && {wide}.every(box => box.tabIndex === 0)")
    assert not browser.problems


@pytest.mark.parametrize("rover", ROVERS)
def test_no_line_breaks_the_name_of_a_rover(rover, tmp_path, browser):
    name = f"{sections._name(cast(Any, SimpleNamespace(rover=rover)))}s"
    browser.open(write_page(tmp_path / "page.html", "Names", [f"32 rovers drove: 16 {name} 2.1 m"], []).as_uri())
    browser.wait("document.body?.dataset.ready")
    lines = """(name => {
      const line = document.querySelector(".verdict p"), word = document.createRange();
      const start = line.textContent.indexOf(name), found = {name: 0, all: 0};
      word.setStart(line.firstChild, start);
      word.setEnd(line.firstChild, start + name.length);
      for (let width = 120; width < 320; width += 2) {
        line.style.width = `${width}px`;
        found.name = Math.max(found.name, word.getClientRects().length);
        found.all = Math.max(found.all, Math.round(line.clientHeight / parseFloat(getComputedStyle(line).lineHeight)));
      }
      return found;
    })"""
    found = browser.value(f"{lines}({json.dumps(name)})")
    assert found["all"] > 1 and found["name"] == 1


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        run_demo(tmp_path / "file" / "report", lambda what, done: None)
