"""The public interface: what `lunar_mjx` exports is there, and the page of the API names all of it."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

import lunar_mjx

PAGE = (Path(__file__).parents[1] / "docs" / "api.md").read_text(encoding="utf-8")


@pytest.mark.parametrize("name", lunar_mjx.__all__)
def test_every_public_name_is_there(name: str) -> None:
    assert getattr(lunar_mjx, name) is not None
    assert name in dir(lunar_mjx)


def test_the_page_imports_all_of_them() -> None:
    block = re.search(r"```python\n(from lunar_mjx import .*?)```", PAGE, re.DOTALL)
    assert block is not None
    imported = {a.name for a in ast.parse(block[1]).body[0].names}
    assert imported == set(lunar_mjx.__all__) - {"__version__"}


def test_other_names_are_refused() -> None:
    with pytest.raises(AttributeError, match="has no attribute 'moonbuggy'"):
        lunar_mjx.moonbuggy  # noqa: B018
