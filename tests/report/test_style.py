"""One style: colours and maps are named in one place, and are told apart by all eyes and in grey."""

from __future__ import annotations

import ast
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from lunar_mjx.report import style
from lunar_mjx.report.style import DARK, LINES, SERIES, figure_style, styled

ROOT = Path(__file__).parents[2]
STYLE = ROOT / "lunar_mjx" / "report" / "style.py"
FILES = sorted(p for d in ("lunar_mjx", "benchmarks") for p in (ROOT / d).rglob("*.py") if p != STYLE)
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.py"))
HEX = re.compile(r"#(?:[0-9a-fA-F]{3}){1,2}")
OF_COLOUR = re.compile(r"^(colou?rs?|c|cmap|colorscale|(face|edge|fill|label|marker(face|edge))colou?r)$")
NEITHER = frozenset({"none", "face", "auto"})


def named_colours(path: Path) -> list[str]:
    """Colours and colour maps that a file writes out itself, with their lines."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and HEX.fullmatch(node.value):
            found.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.value}")
        if isinstance(node, ast.keyword) and OF_COLOUR.match(node.arg or ""):
            value = node.value
            if isinstance(value, ast.Constant) and isinstance(value.value, str) and value.value not in NEITHER:
                found.append(f"{path.relative_to(ROOT)}:{value.lineno} {node.arg}={value.value}")
    return found


def test_colours_are_named_in_one_place() -> None:
    assert len(FILES) > 100
    assert [c for path in FILES for c in named_colours(path)] == []


def test_tutorials_take_their_colours_from_the_palette() -> None:
    palette = {c.lower() for c, _ in LINES} | {c.lower() for c in DARK}
    used = {c.lower() for path in TUTORIALS for c in HEX.findall(path.read_text(encoding="utf-8"))}
    assert used <= palette


def _linear(colour: str) -> np.ndarray:
    """Linear light (3,) of #rrggbb."""
    value = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def _lab(light: np.ndarray) -> np.ndarray:
    """CIE L*a*b* (3,) of linear light under D65."""
    to_xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    x, y, z = to_xyz @ np.clip(light, 0.0, 1.0) / np.array([0.9505, 1.0, 1.089])
    f = [v ** (1 / 3) if v > 0.008856 else 7.787 * v + 16 / 116 for v in (x, y, z)]
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


# Machado, Oliveira & Fernandes 2009, severity 1: what is left of linear light
DEUTERANOPIA = np.array(
    [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]]
)
PROTANOPIA = np.array(
    [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
)


@pytest.mark.parametrize("eye", [np.eye(3), DEUTERANOPIA, PROTANOPIA], ids=["usual", "no green cones", "no red cones"])
@pytest.mark.parametrize("dark", [False, True])
def test_lines_are_told_apart_by_all_eyes(eye: np.ndarray, dark: bool) -> None:
    """CIE 1976 distances: 2.3 is the least that the eye sees side by side; lines lie apart, so four times that."""
    style = figure_style(dark)
    colours = [d["color"] for d in style["axes.prop_cycle"]][:4]
    paper = _lab(eye @ _linear(style["axes.facecolor"]))
    seen = [_lab(eye @ _linear(c)) for c in colours]
    assert min(np.linalg.norm(a - b) for a, b in itertools.combinations(seen, 2)) > 9.0
    assert min(np.linalg.norm(a - paper) for a in seen) > 30.0


def test_lines_differ_without_colour() -> None:
    assert len({line for _, line in LINES}) == len(LINES) == len({c for c, _ in LINES})
    assert len({(s.dash, s.symbol) for s in SERIES}) == len({s.dash for s in SERIES}) == len(SERIES)


def test_a_dark_page_has_no_light_paper() -> None:
    import matplotlib
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    before = matplotlib.rcParams["axes.facecolor"]
    with styled(dark=True):
        figure = Figure()
        axes = figure.subplots()
        line = axes.plot([0, 1])[0]
    assert matplotlib.rcParams["axes.facecolor"] == before
    assert _lab(_linear(to_hex(axes.get_facecolor())))[0] < 10
    assert _lab(_linear(to_hex(line.get_color())))[0] > 40
    assert not axes.spines["top"].get_visible()


def test_a_figure_is_written_for_light_and_for_dark_pages(tmp_path: Path) -> None:
    from matplotlib.figure import Figure
    from PIL import Image

    with styled():
        figure = Figure(figsize=(1.0, 1.0))
        figure.subplots().plot([0, 1], [0, 1], color=style.INK)
        files = style.save_light_and_dark(figure, tmp_path / "line.png", dpi=50)
    assert [f.name for f in files] == ["line.png", "line_dark.png"]
    light, dark = (np.asarray(Image.open(f).convert("RGB"), int) for f in files)
    for shown, paper in ((light, style.PAPER), (dark, style.DARK[style.PAPER])):
        assert shown[0, 0].tolist() == [int(paper[i : i + 2], 16) for i in (1, 3, 5)]
    # the same lines, bright where they were dark
    assert light.min() < 60 and dark.max() > 200 and light.shape == dark.shape


def test_a_figure_is_darkened_by_the_table_that_pages_use() -> None:
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    from lunar_mjx.paper.pictures import figure_2

    with style.styled():
        figure = Figure()
        axes = figure.subplots()
        (line,) = axes.plot([0, 1], [1, 2], color=style.INK, marker="o", markerfacecolor=style.PAPER)
        (blue,) = axes.plot([0, 1], [2, 1], color=style.BLUE, marker="o")
        (mark,) = axes.plot([0], [0], "s", color=style.LIT)  # on a picture of the ground, which stays as it is
        band = axes.fill_between([0, 1], [0, 1], color=style.PURPLE, alpha=0.2)
        dots = axes.scatter([0, 1], [0, 1], c=[0.0, 1.0], cmap=style.HEIGHTS)
        title = axes.set_title("title")
        before = dots.get_facecolor().tolist()
        assert style.darkened(figure) is figure
        diagram = style.darkened(figure_2()[0])
    assert line.get_color()[:3] == pytest.approx([int(style.DARK[style.INK][i : i + 2], 16) / 255 for i in (1, 3, 5)])
    assert to_hex(line.get_markerfacecolor()) == to_hex(style.DARK[style.PAPER])
    assert to_hex(blue.get_color()) == to_hex(blue.get_markerfacecolor()) == to_hex(style.SKY)
    assert to_hex(mark.get_markerfacecolor()) == style.LIT
    assert to_hex(band.get_facecolor()[0]) == to_hex(style.DARK_SERIES[style.PURPLE])
    assert band.get_facecolor()[0][3] == pytest.approx(0.2)
    assert to_hex(title.get_color()) == to_hex(style.DARK[style.INK])
    assert dots.get_facecolor().tolist() == before
    # nothing of the light page is left in a figure that is shipped
    light = {to_hex(c) for c in style.DARK}
    for artist in diagram.findobj():
        for name in ("color", "facecolor", "edgecolor"):
            found = getattr(artist, f"get_{name}", lambda: "none")()
            assert (isinstance(found, str) and found == "none") or to_hex(found) not in light
