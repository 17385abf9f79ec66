"""Runs the tutorials (`*.py` with `# %%` cells) and writes them as notebooks with their outputs, and as pages.

    python docs/tutorials/notebooks.py            # all
    python docs/tutorials/notebooks.py drive_a_rover

A cell's output is what it prints, and the figure or table that its last line names.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Any

from lunar_mjx.report.style import styled

HERE = Path(__file__).parent
NAMES = (
    "drive_a_rover",
    "own_terrain",
    "own_rover",
    "find_missing_effect",
    "your_rovers_log",
    "train_td3",
    "see_and_drive",
)


def cells(name: str) -> list[tuple[str, str]]:
    """Kind ("markdown" or "code") and text of every cell of a tutorial."""
    out = []
    for block in (HERE / f"{name}.py").read_text(encoding="utf-8").split("# %%")[1:]:
        head, _, body = block.partition("\n")
        if "[markdown]" in head:
            lines = [line.removeprefix("#").removeprefix(" ") for line in body.strip().splitlines()]
            out.append(("markdown", "\n".join(lines)))
        else:
            out.append(("code", body.strip()))
    return out


def run(name: str) -> list[dict[str, Any]]:
    """Runs a tutorial in an empty folder; returns the notebook's cells.

    Raises:
      Exception: whatever a cell raises.
    """
    scope: dict[str, Any] = {"__name__": "__tutorial__"}
    made, before = [], os.getcwd()
    with tempfile.TemporaryDirectory() as folder, styled():
        os.chdir(folder)
        try:
            for count, (kind, text) in enumerate(cells(name)):
                cell: dict[str, Any] = {"cell_type": kind, "id": f"cell-{count}", "metadata": {}, "source": text}
                if kind == "code":
                    cell |= {"execution_count": count + 1, "outputs": _outputs(text, scope, count + 1)}
                made.append(cell)
        finally:
            os.chdir(before)
    return made


def _outputs(text: str, scope: dict[str, Any], count: int) -> list[dict[str, Any]]:
    tree = ast.parse(text)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed, value = io.StringIO(), None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "<tutorial>", "exec"), scope)
        if last is not None:
            value = eval(compile(ast.Expression(last.value), "<tutorial>", "eval"), scope)
    out: list[dict[str, Any]] = []
    if printed.getvalue():
        out.append({"output_type": "stream", "name": "stdout", "text": printed.getvalue()})
    if value is not None:
        out.append({"output_type": "execute_result", "execution_count": count, "metadata": {}, "data": _shown(value)})
    return out


def _shown(value: Any) -> dict[str, str]:
    if hasattr(value, "savefig"):
        from matplotlib.backends.backend_agg import FigureCanvasAgg

        FigureCanvasAgg(value)
        file = io.BytesIO()
        value.savefig(file, dpi=110)
        return {"image/png": base64.b64encode(file.getvalue()).decode("ascii"), "text/plain": "<Figure>"}
    return {"text/plain": str(value)}


def notebook(made: list[dict[str, Any]]) -> dict[str, Any]:
    """A notebook of format 4.5."""
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    return {
        "cells": made,
        "metadata": {"kernelspec": kernel, "language_info": {"name": "python"}},
        "nbformat": 4,
        "nbformat_minor": 5,
    }


def page(name: str, made: list[dict[str, Any]], pictures: Path) -> str:
    """The tutorial as Markdown, its pictures beside it."""
    parts = []
    for cell in made:
        if cell["cell_type"] == "markdown":
            parts.append(cell["source"])
            continue
        parts.append(f"```python\n{cell['source']}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {"text/plain": output.get("text", "")})
            if "image/png" in data:
                file = pictures / f"{name}_{cell['execution_count']}.png"
                file.write_bytes(base64.b64decode(data["image/png"]))
                parts.append(f"![Output of the cell above]({file.name})")
            else:
                parts.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    return "\n\n".join(parts) + f"\n\nThis page as a [notebook]({name}.ipynb).\n"


def main() -> None:
    """Writes `.ipynb` and `.md` of the named tutorials, or of all."""
    for name in sys.argv[1:] or NAMES:
        made = run(name)
        text = json.dumps(notebook(made), indent=1, ensure_ascii=False)
        (HERE / f"{name}.ipynb").write_text(text + "\n", encoding="utf-8")
        (HERE / f"{name}.md").write_text(page(name, made, HERE), encoding="utf-8")
        print(HERE / f"{name}.ipynb")


if __name__ == "__main__":
    main()
