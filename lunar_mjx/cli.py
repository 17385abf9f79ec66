"""The command `lunar-mjx`. A user's mistake is one sentence on standard error and exit status 2, never a traceback."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from lunar_mjx import __version__
from lunar_mjx.errors import EXIT_STATUS, UserError, bad_input

app = typer.Typer(
    name="lunar-mjx",
    help="Lunar rovers on MuJoCo MJX: simulate thousands, hold the model against measurements.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
terrain_app = typer.Typer(help="Look at terrains and DEMs, and export them as meshes.", no_args_is_help=True)
app.add_typer(terrain_app, name="terrain")
effect_app = typer.Typer(help="List and explain the physical effects.", no_args_is_help=True)
app.add_typer(effect_app, name="effect")

RoverOption = Annotated[str, typer.Option(help="Name of a shipped rover, or folder that `convert` wrote.")]
TerrainOption = Annotated[str, typer.Option(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")]
PresetOption = Annotated[str, typer.Option(help="consistent or paper.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Folder to write to.")]
DeviceOption = Annotated[str, typer.Option(help="auto, cpu or cuda.")]


def select_device(device: str) -> None:
    """Makes JAX use `device`.

    Raises:
      UserError: unknown name, or CUDA asked for where JAX sees none.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise bad_input("lunar-mjx", "--device", device, "does not exist", "use auto, cpu or cuda")
    if device == "auto":
        return
    import jax

    if device == "cpu":
        jax.config.update("jax_platforms", "cpu")
        return
    try:
        found = jax.devices("cuda")
    except RuntimeError:
        found = []
    if not found:
        raise bad_input(
            "lunar-mjx", "--device", device, "is not here: JAX sees no CUDA device",
            "install the extra lunar-mjx[gpu] on a machine with an NVIDIA GPU, or use --device cpu",
        )  # fmt: skip


def make_folder(out: Path) -> Path:
    """Makes the output folder; refuses a path that is a file."""
    if out.exists() and not out.is_dir():
        raise bad_input("lunar-mjx", "--out", str(out), "is a file", "name a folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise bad_input(
            "lunar-mjx", "--out", str(out), f"cannot be made ({error.strerror})", "name another folder"
        ) from error
    return out


@app.command()
def demo(out: OutOption = Path("runs/demo"), device: DeviceOption = "auto") -> None:
    """Drive VIPERs and LUVMI-Xs over lunar terrain, and hold the wheel model against a measured wheel."""
    select_device(device)
    from lunar_mjx.demo import run_demo

    page = run_demo(make_folder(out))
    print(page)


@app.command()
def convert(
    urdf: Annotated[Path, typer.Argument(help="URDF of a four-wheeled rover.")],
    out: OutOption,
    description: Annotated[
        Path | None, typer.Option(help="Description file; <stem>.rover.toml beside the URDF if left out.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the rover; the URDF's if left out.")] = None,
) -> None:
    """Convert a URDF (and the loop closures that it cannot express) into an MJCF rover folder."""
    from lunar_mjx.rover import convert as convert_urdf

    rover = convert_urdf(urdf, out, description, name)
    console = Console()
    console.print(f"{rover.name}: {rover.mass:g} kg, {len(rover.wheels)} wheels, {len(rover.joints)} motors, "
                  f"{len(rover.loops)} loops", highlight=False)  # fmt: skip
    for note in rover.notes:
        console.print(f"note: {note}", highlight=False)
    print(rover.mjcf)


@app.command()
def simulate(
    out: OutOption = Path("runs/drive"),
    model: Annotated[Path | None, typer.Option(help="model.toml; overrides --rover, --terrain and --preset.")] = None,
    rover: RoverOption = "viper",
    terrain: TerrainOption = "lunar_plain",
    preset: PresetOption = "consistent",
    commands: Annotated[Path | None, typer.Option(help="CSV of commands; overrides --drive and --steer.")] = None,
    drive: Annotated[float, typer.Option(help="Command of every drive joint, in its mode's unit.")] = 0.4,
    steer: Annotated[float, typer.Option(help="Command of every front steering joint, rad.")] = 0.0,
    duration: Annotated[float, typer.Option(help="s")] = 20.0,
    x: Annotated[float, typer.Option(help="start, m")] = 0.0,
    y: Annotated[float, typer.Option(help="start, m")] = 0.0,
    yaw_deg: Annotated[float, typer.Option(help="start heading, deg")] = 0.0,
    device: DeviceOption = "auto",
) -> None:
    """Drive one rover and write its telemetry as a table of log channels."""
    select_device(device)
    import math

    from lunar_mjx.model import make_model
    from lunar_mjx.model_file import load_model, save_model
    from lunar_mjx.simulate import channels, constant_commands, front_steering, read_commands
    from lunar_mjx.simulate import simulate as run

    built = load_model(model) if model else make_model(rover, terrain, preset)
    if commands:
        wanted = read_commands(commands, built)
    else:
        wanted = front_steering(built, constant_commands(built, duration, drive=drive), steer)
    for name, value in (("--x", x), ("--y", y), ("--yaw-deg", yaw_deg)):
        if not math.isfinite(value):
            raise bad_input("simulate", name, value, "is not finite", "give a finite number")
    system, seen = run(built, wanted, x, y, math.radians(yaw_deg))
    folder = make_folder(out)
    table = channels(system, seen, wanted)
    path = folder / "drive.csv"
    table.to_csv(path, index=False, float_format="%.9g")
    save_model(built, folder / "model.toml")
    last = table.iloc[-1]
    print(f"{built.rover.name} drove {math.hypot(last.position_x_m - x, last.position_y_m - y):.3f} m "
          f"in {last.time_s:.1f} s")  # fmt: skip
    print(path)


@app.command()
def preset(
    name: Annotated[str, typer.Argument(help="consistent or paper")],
    rover: RoverOption = "viper",
    save: Annotated[Path | None, typer.Option(help="Write the preset as a model.toml.")] = None,
) -> None:
    """Print a preset: its effects with every value and source, and for `paper` what it leaves unsaid or undefined."""
    from lunar_mjx.describe import print_preset
    from lunar_mjx.model import make_model
    from lunar_mjx.model_file import save_model

    model = make_model(rover, "flat", name)
    print_preset(model, Console())
    if save:
        print(save_model(model, save))


@app.command()
def figures(
    out: OutOption = Path("runs/figures"),
    only: Annotated[str, typer.Option(help="all, or some of 3,5,slope")] = "all",
    device: DeviceOption = "auto",
) -> None:
    """Run the paper's Figs. 3 and 5 and the slope check in both presets, and plot them."""
    select_device(device)
    from lunar_mjx.figures import FIGURES, make_figures

    names = list(FIGURES) if only == "all" else only.split(",")
    for name in names:
        if name not in FIGURES:
            raise bad_input("figures", "--only", name, "does not exist", f"use all or some of {', '.join(FIGURES)}")
    for path in make_figures(names, make_folder(out)):
        print(path)


@terrain_app.command("info")
def terrain_info(
    spec: Annotated[str, typer.Argument(help="Shipped terrain, slope:10deg, DEM file or terrain.toml.")],
) -> None:
    """Print a terrain's extent, heights, slopes and rocks."""
    from lunar_mjx.describe import print_terrain
    from lunar_mjx.terrain import load_terrain

    print_terrain(load_terrain(spec), Console())


@terrain_app.command("export")
def terrain_export(
    spec: Annotated[str, typer.Argument(help="Shipped terrain, slope:10deg, DEM file or terrain.toml.")],
    path: Annotated[Path, typer.Argument(help="Mesh file: .stl, .obj, .ply or .glb.")],
) -> None:
    """Write a terrain with its rocks as a triangle mesh."""
    from lunar_mjx.terrain import export_mesh, load_terrain

    print(export_mesh(load_terrain(spec), path))


@effect_app.command("list")
def effect_list() -> None:
    """List the catalogue of effects."""
    from lunar_mjx.effects.catalogue import CATALOGUE
    from lunar_mjx.effects.presets import PRESETS

    table = Table("effect", "ports", *PRESETS, "what", box=None)
    for effect in CATALOGUE.values():
        marks = ["x" if effect.name in names else "" for names in PRESETS.values()]
        table.add_row(effect.name, ", ".join(effect.ports), *marks, effect.doc.split("\n")[0])
    Console().print(table)


@effect_app.command("show")
def effect_show(name: Annotated[str, typer.Argument(help="Catalogue name, or my_effects.py:name.")]) -> None:
    """Print an effect's equation, parameters, bounds and sources."""
    from lunar_mjx.describe import print_effect
    from lunar_mjx.effects.catalogue import get

    print_effect(get(name), Console())


@app.command()
def version() -> None:
    """Print the version."""
    print(__version__)


def main() -> None:
    """Entry point of the command."""
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        app()
    except UserError as error:
        print(f"lunar-mjx: {error}", file=sys.stderr)
        sys.exit(EXIT_STATUS)
    except KeyboardInterrupt:
        print("lunar-mjx: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    main()
