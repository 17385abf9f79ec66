"""The tutorials run as they stand, and the committed notebooks are theirs."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from types import ModuleType

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "tutorials"


def _tool() -> ModuleType:
    spec = importlib.util.spec_from_file_location("notebooks", FOLDER / "notebooks.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TOOL = _tool()


@pytest.mark.slow
@pytest.mark.parametrize("name", TOOL.NAMES)
def test_tutorial_runs(name):
    """Its own assertions hold; what it shows is of the kinds that the notebook shows."""
    made = TOOL.run(name)
    committed = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    kinds = [[o["output_type"] + "".join(sorted(o.get("data", ()))) for o in c.get("outputs", ())] for c in made]
    assert kinds == [
        [o["output_type"] + "".join(sorted(o.get("data", ()))) for o in c.get("outputs", ())]
        for c in committed["cells"]
    ]
    assert any(kinds)


@pytest.mark.parametrize("name", TOOL.NAMES)
def test_notebook_and_page_belong_to_the_script(name):
    """Run `python docs/tutorials/notebooks.py` after a change."""
    committed = json.loads((FOLDER / f"{name}.ipynb").read_text(encoding="utf-8"))
    assert committed["nbformat"] == 4
    assert [(c["cell_type"], c["source"]) for c in committed["cells"]] == TOOL.cells(name)
    text = (FOLDER / f"{name}.md").read_text(encoding="utf-8")
    assert all(source in text for _, source in TOOL.cells(name))


def test_an_error_in_a_cell_is_raised(tmp_path, monkeypatch):
    (tmp_path / "wrong.py").write_text("# %% [markdown]\n# # Wrong\n# %%\nx = 2\n# %%\nassert x == 3\n")
    monkeypatch.setattr(TOOL, "HERE", tmp_path)
    with pytest.raises(AssertionError):
        TOOL.run("wrong")
