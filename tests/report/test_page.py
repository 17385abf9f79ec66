"""Report pages: self-contained, escaped, small."""

from __future__ import annotations

import io
import math
import re

import plotly.graph_objects as go
from rich.console import Console

from lunar_mjx.report import Facts, Figure, Lead, Pair, Section, Table, Text, console_progress, write_page
from lunar_mjx.report.style import finish

HOSTILE = '</script><script>alert("x")</script>&<b>'


def page(tmp_path) -> str:
    figure = finish(go.Figure(go.Scatter(x=[1, 2], y=[3, 4], name=HOSTILE)), 300, title=HOSTILE)
    blocks = [
        Text([HOSTILE]),
        Figure(figure, HOSTILE),
        Facts([(HOSTILE, HOSTILE)]),
        Table(HOSTILE, [HOSTILE], [[HOSTILE]], HOSTILE),
        Pair(Figure(figure), Figure(figure, HOSTILE)),
        Table(HOSTILE, [HOSTILE], [[HOSTILE]], HOSTILE, folded=True),
    ]
    lead = Lead(HOSTILE, "good", HOSTILE, [HOSTILE])
    path = write_page(tmp_path / "sub" / "page.html", HOSTILE, [HOSTILE], [Section(HOSTILE, blocks)], lead)
    return path.read_text(encoding="utf-8")


def test_nothing_is_loaded_from_elsewhere(tmp_path):
    html = page(tmp_path)
    assert not re.search(r"https?:|//[a-z]+\.[a-z]", html)
    assert not re.search(r"(src|href|action)\s*=|@import|url\(", html)
    assert len(html.encode()) < 3_000_000


def test_text_from_outside_is_escaped(tmp_path):
    html = page(tmp_path)
    assert "alert(" in html
    assert HOSTILE not in html and "<script>alert" not in html and "<b>" not in html
    assert html.count("<script") == html.count("</script>") == 5  # plotly, three figures, and what draws them
    assert html.count("<details>") == 1


def test_progress_without_a_terminal_is_plain_lines():
    out = io.StringIO()
    with console_progress(Console(file=out, force_terminal=False, width=100)) as report:
        report("first", 0.0)
        report("first", 0.1)
        report("second", 0.5)
        report("done", 1.0)
    lines = out.getvalue().splitlines()
    assert [line.split("%")[0].strip() for line in lines] == ["0", "50", "100"]
    assert "\x1b" not in out.getvalue()


def test_progress_whose_share_nobody_knows_promises_no_time():
    out = io.StringIO()
    with console_progress(Console(file=out, force_terminal=False, width=100)) as report:
        report("compiling", math.nan)
    assert "compiling" in out.getvalue() and "left" not in out.getvalue() and "nan" not in out.getvalue()
    with console_progress(Console(file=out, force_terminal=True, width=100)) as report:
        report("half", 0.5)
        report("fitting", math.nan)
    assert "fitting" in out.getvalue() and "%" not in out.getvalue().rpartition("fitting")[2]


def test_progress_on_a_terminal_shows_a_bar():
    out = io.StringIO()
    with console_progress(Console(file=out, force_terminal=True, width=100)) as report:
        report("half", 0.5)
    assert "half" in out.getvalue() and "left" in out.getvalue()
