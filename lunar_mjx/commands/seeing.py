"""The commands `lunar-mjx plot` and `lunar-mjx render`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lunar_mjx.errors import bad_input

RunArgument = Annotated[Path, typer.Argument(help="Folder that `simulate` wrote.")]


def plot(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Picture; RUN/summary.png if left out.")] = None,
) -> None:
    """Plot a drive: path on shaded relief, slope, slip, sinkage, temperature and power over time."""
    path = out or run / "summary.png"
    _check_file(path, (".png", ".svg", ".pdf"))
    from lunar_mjx.visual.plots import drive_summary, save
    from lunar_mjx.visual.recorded import read_drive

    print(save(drive_summary(read_drive(run)), path))


def preview(
    spec: Annotated[str, typer.Argument(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path("terrain.png"),
    dem: Annotated[Path | None, typer.Option(help="DEM file that takes the place of the configuration's.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, help="Seed instead of the configuration's.")] = None,
) -> None:
    """Plot a terrain: shaded relief with rocks, and its slopes."""
    _check_file(out, (".png", ".svg", ".pdf"))
    import jax

    from lunar_mjx.cli import open_terrain
    from lunar_mjx.visual.plots import save, terrain_preview

    print(save(terrain_preview(jax.device_get(open_terrain(spec, dem, seed))), out))


def render(
    run: RunArgument,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help=".mp4, .webp or .gif; RUN/drive.mp4 if left out.")
    ] = None,
    view: Annotated[
        str, typer.Option(help="follow or front (both need OpenGL), top, or auto: follow where it works.")
    ] = "auto",
    size: Annotated[str, typer.Option(help="width x height, pixels")] = "960x540",
    fps: Annotated[int, typer.Option(min=1, max=60, help="pictures per second of the video")] = 20,
    speed: Annotated[float, typer.Option(help="times real time; 0: as fast as keeps the video within 20 s")] = 0.0,
    sun: Annotated[str, typer.Option(help="azimuth,elevation of the Sun, deg")] = "135,15",
) -> None:  # fmt: skip
    """Make a video of a drive, with path, slip and temperature."""
    from lunar_mjx.cli import check_finite

    path = out or run / "drive.mp4"
    _check_file(path, (".mp4", ".webp", ".gif"))
    check_finite(speed=speed)
    if speed < 0:
        raise bad_input("lunar-mjx render", "--speed", speed, "is negative", "give 0 or more")
    width, height = _numbers("--size", size, "x", int)
    azimuth, elevation = _numbers("--sun", sun, ",", float)
    from lunar_mjx.cameras import Sun
    from lunar_mjx.report import console_progress
    from lunar_mjx.visual.recorded import read_drive
    from lunar_mjx.visual.video import render_video

    light = Sun(azimuth, elevation)
    with console_progress() as report:
        print(render_video(read_drive(run), path, view, (width, height), fps, speed, light, report))


def _numbers(option: str, text: str, between: str, kind: type) -> list:
    parts = text.split(between)
    try:
        return [kind(p) for p in parts] if len(parts) == 2 else _refuse(option, text, between)
    except ValueError:
        return _refuse(option, text, between)


def _refuse(option: str, text: str, between: str) -> list:
    raise bad_input("lunar-mjx", option, text, "is not two numbers", f"write it as 960{between}540" if between == "x"
                    else "write it as 135,15")  # fmt: skip


def _check_file(path: Path, endings: tuple[str, ...]) -> None:
    """Refuses, before any work is done, a file of another kind or one that cannot be made."""
    from lunar_mjx.cli import check_folder

    if path.suffix.lower() not in endings:
        raise bad_input("lunar-mjx", "--out", str(path), "is of no known kind", f"end it in {', '.join(endings)}")
    check_folder(path.parent)


def register(app: typer.Typer, terrain_app: typer.Typer) -> None:
    """Adds the commands to the application."""
    app.command()(plot)
    app.command()(render)
    terrain_app.command("preview")(preview)
