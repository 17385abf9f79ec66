"""Effects that pages show as examples keep the contract that `lunar-mjx effect test` checks."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from lunar_mjx.effect_contract.promises import check_effect
from lunar_mjx.effects.catalogue import load_file

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SHOWN = [
    (page.relative_to(ROOT).as_posix(), code)
    for page in PAGES
    for code in re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    if "@effect(" in code
]


@pytest.mark.slow
@pytest.mark.parametrize("code", [c for _, c in SHOWN], ids=[p for p, _ in SHOWN])
def test_shown_effects_keep_the_contract(code: str, tmp_path: Path) -> None:
    file = tmp_path / "my_effects.py"
    file.write_text(code, encoding="utf-8")
    for effect in load_file(file).values():
        broken = [c for c in check_effect(effect, overhead=False) if c.passed is False]
        assert not broken, "\n".join(f"{c.name}: {c.detail}" for c in broken)


def test_the_readme_and_the_guide_show_effects() -> None:
    assert {p for p, _ in SHOWN} >= {"README.md", "docs/criticism.md"}
