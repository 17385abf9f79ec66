"""The documentation says what the code does: tables from the catalogue, commands that exist, a site that builds."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import click
import pytest
import typer.main

from lunar_mjx.cli import app
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import FLAWS, PRESETS
from lunar_mjx.terrain.soil.named import SOILS

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs").rglob("*.md"))


@pytest.fixture(scope="module")
def hooks():
    spec = importlib.util.spec_from_file_location("site_hooks", ROOT / "docs" / "hooks" / "site.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_effect_parameter_and_source_is_on_the_physics_page(hooks):
    page = hooks.on_page_markdown((ROOT / "docs" / "physics.md").read_text(encoding="utf-8"))
    assert "<!-- table" not in page
    for effect in CATALOGUE.values():
        part = page.split(f"\n### {effect.name}\n")[1].split("\n### ")[0]
        assert hooks.cell(effect.doc) in part
        for name, parameter in effect.parameters.items():
            row = next(line for line in part.splitlines() if line.startswith(f"| `{name}` |"))
            assert f"| {parameter.nominal:.6g} |" in row and hooks.cell(parameter.source) in row
    assert all(f"`{name}`" in page for names in PRESETS.values() for name in names)
    assert all(hooks.cell(flaw.consistent) in page for flaw in FLAWS) and all(f"`{s}`" in page for s in SOILS)


def test_tables_are_well_formed(hooks):
    """A stray bar in a docstring would shift the columns."""
    for make in hooks.TABLES.values():
        for block in re.findall(r"(?:^\|.*\n?)+", make(), flags=re.MULTILINE):
            bars = {len(re.findall(r"(?<!\\)\|", line)) for line in block.strip().splitlines()}
            assert len(bars) == 1, block


def test_navigation_holds_the_pages_there_are(hooks, tmp_path):
    (tmp_path / "a.md").touch()
    config = SimpleNamespace(docs_dir=str(tmp_path), nav=[{"A": "a.md"}, {"B": [{"C": "c.md"}]}, {"D": "d.md"}])
    assert hooks.on_config(config).nav == [{"A": "a.md"}]


def _commands() -> list[tuple[str, str]]:
    found = []
    for page in PAGES:
        for line in page.read_text(encoding="utf-8").splitlines():
            match = re.match(r"(?: {4}|\| `)(lunar-mjx [^`#|]+)", line)
            if match:
                found.append((page.name, match.group(1).strip()))
        # within a sentence, and what a tutorial's cell runs
        for inline in re.findall(r'[`"](lunar-mjx\s[^`"]+)[`"]', page.read_text(encoding="utf-8")):
            found.append((page.name, " ".join(inline.split())))
    return found


def test_commands_and_options_on_the_pages_exist():
    assert len(_commands()) > 100
    for page, line in _commands():
        command, context = typer.main.get_command(app), click.Context(click.Command("lunar-mjx"))
        words = line.split()[1:]
        while words and hasattr(command, "get_command"):
            inner = command.get_command(context, words.pop(0))
            assert inner is not None, f"{page}: {line}"
            command = inner
        known = {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}
        for word in words:
            assert not re.match(r"--?[a-z]", word) or word.split("=")[0] in known, f"{page}: {line}: {word}"


def test_pictures_and_links_are_there():
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            if not target.startswith("http"):
                missing_page = target.endswith(".md") and target in ("criticism.md", "real_wheel.md")
                assert (page.parent / target).is_file() or missing_page, f"{page.name}: {target}"


@pytest.mark.slow
def test_site_builds_strictly_and_asks_nobody(tmp_path):
    pytest.importorskip("mkdocs")
    subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    pages = list(tmp_path.rglob("*.html"))
    assert len(pages) > 8
    for page in pages:
        fetched = r'<(?:script|link|img|iframe)[^>]+(?:src|href)="?(https?:)?//'
        assert not re.search(fetched, page.read_text(encoding="utf-8")), page.name
