"""The demonstration at its smallest: one rover of each kind for a fifth of a second."""

from __future__ import annotations

import json
import re

import pytest

from lunar_mjx.demo import run_demo
from lunar_mjx.errors import UserError


@pytest.mark.slow
def test_the_demonstration_writes_its_page_and_its_numbers(tmp_path):
    told: list[tuple[str, float]] = []
    page = run_demo(tmp_path / "new", lambda what, done: told.append((what, done)), rovers=1, seconds=0.2, starts=1)
    assert page == tmp_path / "new" / "demo.html"
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


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be made"):
        run_demo(tmp_path / "file" / "report", lambda what, done: None)
