"""The command `lunar-mjx parity`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def parity(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")] = Path("runs/parity"),
    rover: Annotated[str, typer.Option(help="Name of a shipped rover, or folder that `convert` wrote.")] = "luvmi_x",
    preset: Annotated[str, typer.Option(help="consistent, field, paper, or both: consistent and paper.")] = "both",
    engines: Annotated[
        str,
        typer.Option(
            help="Comma-separated: structured, mjx, structured:float32, mjx:float32, pybullet, "
            "pybullet:engine; default is all that are installed, but mjx:float32."
        ),
    ] = "",
    duration: Annotated[float, typer.Option(help="of the drives, s")] = 5.0,
    samples: Annotated[int, typer.Option(help="states per ground for the comparison of single steps")] = 16,
) -> None:
    """Compare the engines with native MuJoCo: one state stage by stage, single steps, and drives; write a page."""
    from lunar_mjx.commands.options import check_finite, check_folder, make_folder
    from lunar_mjx.errors import bad_input

    check_folder(out)
    check_finite(duration=duration)
    if not 1 <= samples <= 1000:
        raise bad_input("lunar-mjx parity", "--samples", samples, "is outside [1, 1000]", "give about 16")
    from lunar_mjx.backends.parity.page import verdict, write_parity_page
    from lunar_mjx.backends.parity.study import DEFAULT_ENGINES, available, run_study
    from lunar_mjx.report import console_progress

    named = [e.strip() for e in engines.split(",") if e.strip()]
    # An empty list would run the default engines, which is not what was asked for.
    if engines and not named:
        raise bad_input("parity", "--engines", engines, "names no engine", "leave it out for all that are installed")
    used, note = (named, "") if named else available(DEFAULT_ENGINES)
    presets = ("consistent", "paper") if preset == "both" else (preset,)
    with console_progress() as report:
        studies = [
            run_study(
                rover,
                name,
                used,
                duration,
                samples,
                report=lambda what, done, i=i: report(what, (i + done) / len(presets)),
            )
            for i, name in enumerate(presets)
        ]
    path = write_parity_page(make_folder(out) / "parity.html", studies, note)
    for study in studies:
        for pair in study.pairs:
            print(verdict(study, pair))
    if note:
        print(note)
    print(path)
    if any(pair.failed for study in studies for pair in study.pairs):
        # For scripts: the page has been written all the same.
        raise typer.Exit(1)


def register(app: typer.Typer) -> None:
    """Adds the command to the application."""
    app.command()(parity)
