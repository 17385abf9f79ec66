"""Guides stay short, and sentences are such as one reads without turning back."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
GUIDES = {"criticism.md": 1500, "reinforcement_learning.md": 1500}
LONG = 40
"""Words; no sentence has as many."""


def prose(text: str) -> list[str]:
    """Paragraphs, list items and cells of a page of Markdown, without code, headings and the targets of links."""
    text = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    text = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    text = re.sub(r"!\[[^\]]*\]\([^)]*\)", "", text)
    text = re.sub(r"<picture>.*?</picture>", "", text, flags=re.DOTALL)
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)
    blocks: list[list[str]] = [[]]
    for line in text.splitlines():
        stripped = line.lstrip("> ").strip()
        if stripped.startswith("|"):
            blocks += [[cell.strip()] for cell in re.split(r"(?<!\\)\|", stripped)] + [[]]
        elif (
            not stripped
            or stripped.startswith(("#", ":::", "options:"))
            or (line.startswith("    ") and not blocks[-1])
        ):
            blocks.append([])
        elif re.match(r"([-*]|\d+\.) ", stripped):
            blocks.append([stripped])
        else:
            blocks[-1].append(stripped)
    return [" ".join(b) for b in blocks if b]


def sentences(text: str) -> list[str]:
    """Sentences of a page; a full stop, question mark or exclamation mark ends one."""
    ends = r"(?<=[.?!])[\"')*_]*\s+"
    return [s for block in prose(text) for s in re.split(ends, block) if s]


def words(sentence: str) -> int:
    """Words of a sentence; what stands between back quotes is one."""
    return len(re.findall(r"[^\s]*\w[^\s]*", re.sub(r"`[^`]*`", "x", sentence)))


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_no_sentence_is_long(page: Path) -> None:
    found = [f"{words(s)}: {s}" for s in sentences(page.read_text(encoding="utf-8")) if words(s) >= LONG]
    assert not found, "\n".join(found)


@pytest.mark.parametrize("name", GUIDES)
def test_guides_are_short(name: str) -> None:
    """All that stands on the page counts: tables and code, too."""
    assert len((ROOT / "docs" / name).read_text(encoding="utf-8").split()) <= GUIDES[name]


def test_the_readme_is_short_and_opens_in_plain_words() -> None:
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) < 150
    first = " ".join(lines[:45]).lower()
    assert not re.search(r"terramechanic|bekker|janosi|residual|covariance|pytree|likelihood", first)


def test_sentences_are_counted() -> None:
    page = (
        "# Title\n\nOne two three. Four\nfive `a b c` six? [Seven](x.md) eight.\n\n    a b\n\n| a |\n\n- nine ten\n- 11"
    )
    assert [words(s) for s in sentences(page)] == [3, 4, 2, 1, 2, 1]
    assert [s for s in sentences("A " + "word " * 40 + "end.") if words(s) >= LONG]


def test_every_picture_is_there_and_none_lies_about() -> None:
    shown = set()
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        targets = re.findall(r"!\[[^\]]*\]\(([^)#\s]+)|(?:src|srcset)=\"([^\"]+)\"", text)
        local = [name for pair in targets for name in pair if name and "://" not in name]
        shown |= {(page.parent / name).resolve() for name in local}
    assert [p for p in shown if not p.is_file()] == []
    kept = {p for p in (ROOT / "docs" / "figures").iterdir() if p.suffix in (".png", ".svg", ".gif")}
    assert kept - shown == set()


LIGHT_ALONE = frozenset(
    {
        # pictures of the Moon, which is dark by itself
        "view_web.png",
        # a film that is light, of the README's own runs
        "error_falls.gif",
        # SVG that holds both
        "rooms.svg",
    }
)
"""Pictures of `docs/figures` without one for dark pages."""


def test_figures_follow_the_page_into_the_dark() -> None:
    folder = ROOT / "docs" / "figures"
    names = {p.name for p in folder.iterdir() if p.suffix in (".png", ".svg", ".gif")}
    light = {name for name in names if "_dark." not in name}
    without = {name for name in light if str(Path(name).with_stem(f"{Path(name).stem}_dark")) not in names}
    assert without == LIGHT_ALONE
    for page in PAGES:
        for name in light - without:
            shown = re.findall(rf"[(\"](?:[\w/.]*/)?{re.escape(name)}[)\"]", page.read_text(encoding="utf-8"))
            dark = str(Path(name).with_stem(f"{Path(name).stem}_dark"))
            assert len(shown) == len(re.findall(rf'srcset="[^"]*{re.escape(dark)}"', page.read_text("utf-8"))), page
    for drawn in (folder / "rooms.svg", ROOT / "docs" / "structured_engine.svg"):
        assert "prefers-color-scheme: dark" in drawn.read_text(encoding="utf-8")
