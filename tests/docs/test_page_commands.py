"""Every command that a page shows is one that the command line reads, with the names that ship."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from lunar_mjx.commands import usage
from lunar_mjx.commands.app import app
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.manoeuvres import MANOEUVRES
from lunar_mjx.resources import shipped

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *(p for d in ("docs", "models", "terrain") for p in sorted((ROOT / d).rglob("*.md")))]
PAGES += [ROOT / "CONTRIBUTING.md", ROOT / "benchmarks" / "foreign" / "README.md"]
PARSER: Any = usage.strict(typer.main.get_command(app))

ROVERS = {p.parent.name for p in shipped("models").glob("*/rover.toml")}
POLICIES = {p.relative_to(shipped("models")) for p in shipped("models").glob("*/*.npz")}
SHIPPED = {
    "rover": {*ROVERS, "scout"},  # which the tutorial of an own rover makes
    "preset": set(PRESETS),
    "effect": set(CATALOGUE),
    "effects": set(CATALOGUE),
    "explain": set(CATALOGUE),
    "manoeuvre": set(MANOEUVRES),
    "training": {p.stem for p in shipped("train").glob("*.toml")},
    "agent": {p.parent.name if p.stem == "policy" else p.with_suffix("").as_posix() for p in POLICIES},
}
"""What ships under the names that an option or argument takes. A name with a dot, or my_..., is the reader's own."""


def shown(page: str) -> tuple[list[str], list[str]]:
    """Commands of a page: those on lines of their own, to be typed, and those that a sentence mentions."""
    page = re.sub(r"\\\n\s*", " ", page)
    typed = re.findall(r"^(?: {4,})?(lunar-mjx .*)$", page, re.MULTILINE)
    sentences = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
    codes = [" ".join(c.split()) for c in re.findall(r"`([^`]+)`", sentences)]
    short = [f"lunar-mjx {c}" for c in codes if c.split(" ")[0] in PARSER.commands and " " in c]
    return typed, [c for c in codes if c.startswith("lunar-mjx ")] + short


def problems(command: str, mentioned: bool = False) -> list[str]:
    """What the command line has against a command; a mention may leave out what the command cannot do without."""
    parser, name, context = PARSER, "lunar-mjx", None
    arguments = shlex.split(command, comments=True)[1:]
    try:
        while True:
            context = parser.make_context(name, arguments, parent=context)
            if not hasattr(parser, "resolve_command"):
                break
            rest = [*getattr(context, "_protected_args", ()), *context.args]
            name, parser, arguments = parser.resolve_command(context, rest)
    except usage.UsageError as error:
        if mentioned and type(error).__name__ == "MissingParameter":
            return []
        return [f"{command}: {usage.describe(error, arguments)}"]
    found = []
    for parameter, names in SHIPPED.items():
        source = context.get_parameter_source(parameter)
        given = context.params[parameter] if source is not None and source.name == "COMMANDLINE" else ()
        for value in [given] if isinstance(given, str) else given:
            own = isinstance(value, Path) or "." in value or value.startswith("my_") or value.isupper()
            if not own and value.split(":")[0] not in names:
                found.append(f"{command}: no {parameter} {value!r} ships")
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.relative_to(ROOT).as_posix())
def test_shown_commands_are_read(page: Path) -> None:
    typed, mentioned = shown(page.read_text(encoding="utf-8"))
    found = [p for c in typed for p in problems(c)] + [p for c in mentioned for p in problems(c, mentioned=True)]
    assert not found, "\n".join(found)


def test_most_pages_show_commands() -> None:
    counts = [sum(map(len, shown(p.read_text(encoding="utf-8")))) for p in PAGES]
    assert sum(counts) > 150 and sum(map(bool, counts)) > 20


@pytest.mark.parametrize(
    "wrong",
    [
        "lunar-mjx fly",
        "lunar-mjx simulate --wings 2",
        "lunar-mjx simulate --duration long",
        "lunar-mjx log improt raw --map map.toml -o logs",
        "lunar-mjx why run1 run2",
        "lunar-mjx simulate --rover viking",
        "lunar-mjx add run1 slip_sinking",
        "lunar-mjx train large-td4",
    ],
)
def test_a_wrong_command_is_found(wrong: str) -> None:
    for page in (
        f"Do this:\n\n    {wrong}  # and wait\n",
        f"So `{wrong}` helps.",
        f"So `{wrong.split(' ', 1)[1]}` helps.",
    ):
        typed, mentioned = shown(page)
        if typed or mentioned:
            assert any(problems(c) for c in typed) or any(problems(c, mentioned=True) for c in mentioned)
        else:
            assert "fly" in page  # no verb: the sentence's own words


def test_what_is_left_out_is_told_where_it_is_typed() -> None:
    assert problems("lunar-mjx convert my_rover.urdf") and not problems(
        "lunar-mjx convert my_rover.urdf", mentioned=True
    )
