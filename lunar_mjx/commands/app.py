"""The command `lunar-mjx`. A user's mistake is one sentence on standard error and exit status 2, never a traceback."""

from __future__ import annotations

import errno
import math
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from lunar_mjx._version import __version__
from lunar_mjx.commands import bed as bed_commands
from lunar_mjx.commands import diagnosis as criticism_commands
from lunar_mjx.commands import effect_test, usage
from lunar_mjx.commands import export as export_commands
from lunar_mjx.commands import log as log_commands
from lunar_mjx.commands import parity as parity_commands
from lunar_mjx.commands import seeing as seeing_commands
from lunar_mjx.commands import train as train_commands
from lunar_mjx.commands.compiled import keep_compiled
from lunar_mjx.commands.options import (
    DemOption,
    DeviceOption,
    OutOption,
    PresetOption,
    RoverOption,
    SeedOption,
    SpecArgument,
    TerrainOption,
    check_finite,
    check_folder,
    make_folder,
    open_terrain,
    select_device,
)
from lunar_mjx.errors import EXIT_STATUS, UserError, bad_input, require_within
from lunar_mjx.files import replacing
from lunar_mjx.trust import trusting

INTERRUPTED = 130
"""Exit status of a command that Ctrl-C ended: 128 and the number of SIGINT, as in shells."""
TRUST = "--trust"
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What a write says to a full disk, a spent quota and a file that may not grow."""


class _Interrupted(BaseException):
    """Control-C, kept from Typer, which would exit without a word."""


class _Commands(TyperGroup):
    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if TRUST in args:  # understood behind the command, too
            args = [TRUST, *(a for a in args if a != TRUST)]
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            # Typer turns KeyboardInterrupt into a line of its own and status 1; a shell expects 130.
            raise _Interrupted from None


app = typer.Typer(
    name="lunar-mjx",
    cls=_Commands,
    help="Lunar rovers on MuJoCo MJX: simulate thousands, hold the model against measurements.",
    no_args_is_help=True,
    # An error of the package's own shows a plain traceback, which can be pasted into a report.
    pretty_exceptions_enable=False,
)
terrain_app = typer.Typer(help="Look at terrains and DEMs, and export them as meshes.", no_args_is_help=True)
app.add_typer(terrain_app, name="terrain")
effect_app = typer.Typer(help="List and explain the physical effects.", no_args_is_help=True)
app.add_typer(effect_app, name="effect")


@app.callback()
def before_every_command(
    ctx: typer.Context,
    trust: Annotated[
        bool, typer.Option(TRUST, help="Run Python code that a received model.toml, run folder or policy names.")
    ] = False,
) -> None:
    # For this command alone: a session in Python that calls commands must not stay trusting.
    ctx.with_resource(trusting(trust))


@app.command()
def demo(out: OutOption = Path("runs/demo"), device: DeviceOption = "auto") -> None:
    """Drive VIPERs and LUVMI-Xs over lunar terrain, and hold the wheel model against a measured wheel."""
    check_folder(out)
    select_device(device)
    from lunar_mjx.demo import run_demo

    page = run_demo(make_folder(out))
    print(page)


@app.command()
def convert(
    urdf: Annotated[Path, typer.Argument(help="URDF of a rover with three wheels or more.")],
    out: OutOption,
    description: Annotated[
        Path | None, typer.Option(help="Description file; <stem>.rover.toml beside the URDF if left out.")
    ] = None,
    name: Annotated[str | None, typer.Option(help="Name of the rover; the URDF's if left out.")] = None,
) -> None:
    """Convert a URDF (and the loop closures that it cannot express) into an MJCF rover folder."""
    check_folder(out)
    from lunar_mjx.rover import convert as convert_urdf

    rover = convert_urdf(urdf, out, description, name)
    print(
        f"{rover.name}: {rover.mass:g} kg, {len(rover.wheels)} wheels, {len(rover.joints)} motors, "
        f"{len(rover.loops)} loops"
    )
    for note in rover.notes:
        print(f"note: {note}")
    print(rover.mjcf)


@app.command()
def simulate(
    out: OutOption = Path("runs/drive"),
    model: Annotated[Path | None, typer.Option(help="model.toml; overrides --rover, --terrain and --preset.")] = None,
    rover: RoverOption = "viper",
    terrain: TerrainOption = "lunar_plain",
    preset: PresetOption = None,
    effects: Annotated[
        list[str] | None, typer.Option(help="Effect to add: catalogue name, my_effects.py or my_effects.py:name.")
    ] = None,
    commands: Annotated[Path | None, typer.Option(help="CSV of commands; overrides --drive and --steer.")] = None,
    drive: Annotated[float, typer.Option(help="Command of every drive joint, in its mode's unit.")] = 0.4,
    steer: Annotated[float, typer.Option(help="Command of every front steering joint, rad.")] = 0.0,
    cmd_vel: Annotated[
        str | None, typer.Option(help="Motion of the chassis v_x,v_y,yaw_rate (m/s, m/s, rad/s); overrides --drive.")
    ] = None,
    duration: Annotated[float, typer.Option(help="s")] = 20.0,
    x: Annotated[float, typer.Option(help="start, m")] = 0.0,
    y: Annotated[float, typer.Option(help="start, m")] = 0.0,
    yaw_deg: Annotated[float, typer.Option(help="start heading, deg")] = 0.0,
    gravity: Annotated[float | None, typer.Option(help="m/s2; the model's own if left out.")] = None,
    device: DeviceOption = "auto",
) -> None:
    """Drive one rover and write its telemetry as a table of log channels."""
    check_folder(out)
    check_finite(drive=drive, steer=steer, duration=duration, x=x, y=y, yaw_deg=yaw_deg)
    select_device(device)
    # Imported here, as everywhere in commands: JAX takes seconds, and --help shall not.
    from lunar_mjx.effects.presets import DEFAULT_PRESET
    from lunar_mjx.manoeuvres.cmd_vel import cmd_vel_commands
    from lunar_mjx.model import make_model
    from lunar_mjx.model.file import load_model, save_model
    from lunar_mjx.simulate import channels, command_channels, constant_commands, front_steering, read_commands
    from lunar_mjx.simulate import simulate as run

    built = load_model(model) if model else make_model(rover, terrain, DEFAULT_PRESET if preset is None else preset)
    if gravity is not None:
        if not 0.0 < gravity < 30.0:
            raise bad_input("simulate", "--gravity", gravity, "is no gravity that a rover meets", "give 0.1 to 29 m/s2")
        built = built.replace(gravity=gravity)
    for effect in effects or []:
        built = built.add(effect, "--effects")
    if commands and cmd_vel is not None:
        raise bad_input("simulate", "--cmd-vel", cmd_vel, "is given beside --commands", "give one of them")
    if commands:
        wanted = read_commands(commands, built)
    elif cmd_vel is not None:
        wanted = cmd_vel_commands(built, cmd_vel, duration)
    else:
        wanted = front_steering(built, constant_commands(built, duration, drive=drive), steer)
    # Before minutes of compilation.
    _require_possible(wanted, command_channels(built), yaw_deg)
    keep_compiled()
    # A pipe or a log wants no progress.
    if sys.stderr.isatty():
        print("compiling and driving; the first time can take a minute", file=sys.stderr)
    system, seen = run(built, wanted, x, y, math.radians(yaw_deg))
    folder = make_folder(out)
    table = channels(system, seen, wanted)
    path = folder / "drive.csv"
    with replacing(path) as part:
        # Nine digits bring every float32 back.
        table.to_csv(part, index=False, float_format="%.9g")
    save_model(built, folder / "model.toml")
    first, last = table.iloc[0], table.iloc[-1]  # on a slope the chassis leans away from where its wheels were put
    way = math.hypot(last.position_x_m - first.position_x_m, last.position_y_m - first.position_y_m)
    print(f"{built.rover.name} drove {way:.3f} m in {last.time_s:.1f} s")
    print(path)


def _require_possible(commands: Any, names: Sequence[str], yaw_deg: float) -> None:
    """Raises `UserError` for a command or heading that no rover takes: what a log's channel of it may hold."""
    from lunar_mjx.logs.schema import limits

    low, high, _ = limits("yaw_deg")
    require_within("simulate", "--yaw-deg", yaw_deg, low, high)
    for name, values in zip(names, commands.values.T, strict=True):
        low, high, why = limits(name)
        beyond = (values < low) | (values > high)
        if beyond.any():
            remedy = f"give {low:.4g} to {high:.4g}"
            raise bad_input("simulate", name, float(values[beyond.argmax()]), f"is out of range ({why})", remedy)


@app.command()
def preset(
    name: Annotated[str, typer.Argument(help="consistent, field or paper; or list, for what each is for.")],
    rover: RoverOption = "viper",
    save: Annotated[Path | None, typer.Option(help="Write the preset as a model.toml.")] = None,
) -> None:
    """Print a preset: its effects with every value and source, and for `paper` what it leaves unsaid or undefined."""
    from lunar_mjx.model import make_model
    from lunar_mjx.model.describe import make_console, print_preset, print_presets
    from lunar_mjx.model.file import save_model

    if name == "list":
        return print_presets(make_console())
    model = make_model(rover, "flat", name)
    written = save_model(model, save) if save else None
    print_preset(model, make_console())
    if written:
        print(written)


@app.command()
def figures(
    out: OutOption = Path("runs/figures"),
    only: Annotated[str, typer.Option(help="all, or some of 1,2,3,4,5,6,slope")] = "all",
    training: Annotated[
        list[Path] | None,
        typer.Option(help="Folder that `train` wrote, for Fig. 6; may be repeated. Kept records if left out."),
    ] = None,
    dark: Annotated[bool, typer.Option(help="Each also as NAME_dark.png, for dark pages.")] = False,
    device: DeviceOption = "auto",
) -> None:
    """Make the counterparts of the paper's Figs. 1 to 6, and the slope check."""
    check_folder(out)
    select_device(device)
    from lunar_mjx.paper.figures import FIGURES, available_figures, make_figures

    names = available_figures(training or ()) if only == "all" else only.split(",")
    for name in names:
        if name not in FIGURES:
            raise bad_input("figures", "--only", name, "does not exist", f"use all or some of {', '.join(FIGURES)}")
    for path in make_figures(names, make_folder(out), training or (), dark):
        print(path)


@terrain_app.command("info")
def terrain_info(spec: SpecArgument, dem: DemOption = None, seed: SeedOption = None) -> None:
    """Print a terrain's extent, heights, slopes and rocks."""
    from lunar_mjx.model.describe import make_console, print_terrain

    print_terrain(open_terrain(spec, dem, seed), make_console())


@terrain_app.command("export")
def terrain_export(
    spec: SpecArgument,
    path: Annotated[Path, typer.Argument(help="Mesh file: .stl, .obj or .ply.")],
    dem: DemOption = None,
    seed: SeedOption = None,
) -> None:
    """Write a terrain with its rocks as a triangle mesh."""
    from lunar_mjx.terrain import export_mesh

    print(export_mesh(open_terrain(spec, dem, seed), path))


@effect_app.command("list")
def effect_list() -> None:
    """List the catalogue of effects."""
    from lunar_mjx.model.describe import make_console, print_catalogue

    print_catalogue(make_console())


@effect_app.command("show")
def effect_show(name: Annotated[str, typer.Argument(help="Catalogue name, or my_effects.py:name.")]) -> None:
    """Print an effect's equation, parameters, bounds and sources."""
    from lunar_mjx.effects.catalogue import get
    from lunar_mjx.model.describe import make_console, print_effect

    print_effect(get(name), make_console())


train_commands.register(app)
export_commands.register(app)
parity_commands.register(app)
seeing_commands.register(app, terrain_app)
log_commands.register(app)
bed_commands.register(app)
criticism_commands.register(app)
effect_test.register(effect_app)


@app.command()
def version() -> None:
    """Print the version."""
    print(__version__)


def main() -> None:
    """Entry point of the command."""
    # XLA writes of its own affairs to standard error.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")
    try:
        # Not standalone: Click would print its errors in its own way and exit itself.
        status = usage.strict(typer.main.get_command(app)).main(prog_name="lunar-mjx", standalone_mode=False)
    except usage.UsageError as error:
        if type(error).__name__ == "NoArgsIsHelpError":  # Typer has printed the help
            sys.exit(EXIT_STATUS)
        _fail(usage.describe(error, sys.argv[1:]), EXIT_STATUS)
    except UserError as error:
        _fail(str(error), EXIT_STATUS)
    except OSError as error:  # unreadable, unwritable, disk full
        if error.filename is not None:
            _fail(
                f"{str(error.filename)[:200]}: {error.strerror or error}; check the path and its permissions.",
                EXIT_STATUS,
            )
        # An error without a file name is the program's own, unless the disk is full.
        if error.errno not in NO_ROOM:
            raise
        _fail(f"{error.strerror}; free some room where it writes, and run it again.", EXIT_STATUS)
    except (_Interrupted, KeyboardInterrupt):
        _fail("interrupted", INTERRUPTED)
    else:
        sys.exit(status if isinstance(status, int) else 0)


def _fail(sentence: str, status: int) -> None:
    # One line, so that scripts can take the last line of standard error.
    line = " ".join(sentence.splitlines())
    # what no terminal shows as it is: bytes of another encoding, marks that turn the text around, colours
    line = "".join(c if c.isprintable() else c.encode("unicode_escape", "surrogatepass").decode() for c in line)
    line = line.removeprefix("lunar-mjx: ").removeprefix("lunar-mjx ")
    print(f"lunar-mjx: {line}", file=sys.stderr)
    sys.exit(status)
