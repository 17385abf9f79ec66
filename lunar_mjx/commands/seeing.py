"""The commands `lunar-mjx view`, `plot`, `render` and `terrain preview`."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lunar_mjx.commands.compiled import keep_compiled
from lunar_mjx.commands.options import MOST_SEED, PresetOption
from lunar_mjx.errors import bad_input, plain_digits, require_within

if TYPE_CHECKING:
    from lunar_mjx.viewer.policy_drive import PolicyDrive
    from lunar_mjx.viewer.server import Viewer

ModelOption = Annotated[Path | None, typer.Option(help="model.toml; overrides --rover, --terrain and --preset.")]
SUN = "azimuth,elevation of the Sun, deg; the model's own, or 135,15, if left out"
RunArgument = Annotated[Path, typer.Argument(help="Folder that `simulate` wrote.")]


def plot(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Picture; RUN/summary.png if left out.")] = None,
    dark: Annotated[bool, typer.Option(help="Also as NAME_dark, for dark pages.")] = False,
) -> None:
    """Plot a drive: path on shaded relief, slope, slip, sinkage, temperature and power over time."""
    path = out or run / "summary.png"
    # Before the imports, which take seconds.
    _require_drive(run)
    _check_file(path, (".png", ".svg", ".pdf"))
    from lunar_mjx.visual.plots import drive_summary, save
    from lunar_mjx.visual.recorded import read_drive

    for file in save(drive_summary(read_drive(run)), path, dark):
        print(file)


def preview(
    spec: Annotated[str, typer.Argument(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Picture to write.")] = Path("terrain.png"),
    dem: Annotated[Path | None, typer.Option(help="DEM file that takes the place of the configuration's.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=MOST_SEED, help="Seed instead of the configuration's.")] = None,
) -> None:
    """Plot a terrain: shaded relief with rocks, and its slopes."""
    _check_file(out, (".png", ".svg", ".pdf"))
    import jax

    from lunar_mjx.commands.options import open_terrain
    from lunar_mjx.visual.plots import save, terrain_preview

    for file in save(terrain_preview(jax.device_get(open_terrain(spec, dem, seed))), out):
        print(file)


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
    sun: Annotated[str | None, typer.Option(help=SUN)] = None,
) -> None:
    """Make a video of a drive, with path, slip and temperature."""
    from lunar_mjx.commands.options import check_finite

    path = out or run / "drive.mp4"
    # Before the drive is read and its pictures drawn.
    _require_drive(run)
    _check_file(path, (".mp4", ".webp", ".gif"))
    check_finite(speed=speed)
    if speed < 0:
        raise bad_input("lunar-mjx render", "--speed", speed, "is negative", "give 0 or more")
    width, height = _numbers("--size", size, "x", int)
    from lunar_mjx.model.sun import camera_sun
    from lunar_mjx.report import console_progress
    from lunar_mjx.visual.recorded import read_drive
    from lunar_mjx.visual.video import render_video

    given = None if sun is None else _sun(sun)
    # After the options are checked: reading a long drive takes seconds.
    drive = read_drive(run)
    light = given or camera_sun(drive.model.sun, float(drive.time[0]))
    with console_progress() as report:
        print(render_video(drive, path, view, (width, height), fps, speed, light, report))


def view(
    rover: Annotated[str, typer.Option(help="Name of a shipped rover, or folder that `convert` wrote.")] = "viper",
    terrain: Annotated[
        str, typer.Option(help="Shipped terrain, flat, slope:10deg, DEM file or terrain.toml.")
    ] = "lunar_plain",
    preset: PresetOption = None,
    model: ModelOption = None,
    effects: Annotated[
        list[str] | None, typer.Option(help="Effect to add: catalogue name, my_effects.py or my_effects.py:name.")
    ] = None,
    speed: Annotated[float, typer.Option(help="top speed of the wheels' rims, m/s")] = 0.5,
    x: Annotated[float, typer.Option(help="start, m")] = 0.0,
    y: Annotated[float, typer.Option(help="start, m")] = 0.0,
    yaw_deg: Annotated[float, typer.Option(help="start heading, deg")] = 0.0,
    web: Annotated[bool, typer.Option("--web", help="A web page on this machine although there is a screen.")] = False,
    port: Annotated[int, typer.Option(help="Of the web page; 0 for any that is free.")] = 8600,
    sun: Annotated[str | None, typer.Option(help=SUN)] = None,
    policy: Annotated[
        str | None, typer.Option(help="Look on while a policy drives: a rover that ships one, or a policy.npz.")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(help="Run folder of a drive: the measured rover beside the model's, as a ghost.")
    ] = None,
    log: Annotated[
        str, typer.Option(help="Which of the run's logs to replay; by default the first, or all windows.")
    ] = "",
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of a policy's episodes.")] = 0,
    engine: Annotated[
        str, typer.Option(help="native (starts at once), structured, mjx; auto: native where it has every effect.")
    ] = "auto",
) -> None:
    """Drive a rover by keyboard: in a window, or without a screen on a web page that only this machine can open.

    On such a page a policy can drive instead, or a measured drive be played back beside a model's prediction.
    """
    from lunar_mjx.commands.options import check_finite

    check_finite(speed=speed, x=x, y=y, yaw_deg=yaw_deg)
    from lunar_mjx.effects.presets import DEFAULT_PRESET
    from lunar_mjx.model import make_model
    from lunar_mjx.model.file import load_model
    from lunar_mjx.model.sun import camera_sun
    from lunar_mjx.viewer.drive import LiveDrive
    from lunar_mjx.viewer.server import Viewer, check_port
    from lunar_mjx.viewer.window import has_screen, show_window

    given = None if sun is None else _sun(sun)
    check_port(port)
    keep_compiled()
    if log and replay is None:
        raise bad_input("lunar-mjx view", "--log", log, "is one of a run's logs", "give --replay RUN as well")
    if policy is not None and replay is not None:
        raise bad_input("lunar-mjx view", "--replay", str(replay), "does not go with --policy", "give one of the two")
    if policy is not None:
        watched = _policy_drive(policy, seed)
        _serve(Viewer(watched, port, given or camera_sun(watched.model.sun)))
        return
    if replay is not None:
        from lunar_mjx.diagnosis.report.driven import replayed

        shown = replayed(replay, log)
        _serve(Viewer(shown, port, given or camera_sun(shown.model.sun)))
        return
    built = load_model(model) if model else make_model(rover, terrain, DEFAULT_PRESET if preset is None else preset)
    for effect in effects or []:
        built = built.add(effect, "--effects")
    light = given or camera_sun(built.sun)
    drive = LiveDrive(built, engine, speed, x, y, math.radians(yaw_deg))
    if has_screen() and not web:
        show_window(drive, light)
    else:
        _serve(Viewer(drive, port, light))
    print(f"{built.rover.name} drove {drive.path:.1f} m in {drive.time:.1f} s")


def _sun(text: str) -> Any:
    from lunar_mjx.cameras import Sun

    azimuth, elevation = _numbers("--sun", text, ",", float)
    # A turn to either side, since both 350 and -10 are in use for one place.
    require_within("lunar-mjx", "--sun", azimuth, -360.0, 360.0)
    return Sun(azimuth, elevation)


def _serve(server: Viewer) -> None:
    """Serves the page until Control-C."""
    try:
        print(f"{server.address}  (Ctrl-C ends the drive)", flush=True)
        server.run()
    except KeyboardInterrupt:  # before or after it could be caught there
        server.close()


def _policy_drive(name: str, seed: int) -> PolicyDrive:
    """A policy's drive on the ground that it was not trained on."""
    from lunar_mjx.agents.play import open_agent
    from lunar_mjx.agents.run import unseen_params
    from lunar_mjx.viewer.policy_drive import PolicyDrive

    env, agent, unseen = open_agent(name)
    # On standard error, since standard output carries the address for scripts.
    print("view: compiling, which can take some minutes the first time", file=sys.stderr)
    # A file by its name, a shipped policy by its rover: what stands in the page's corner.
    shown = Path(name).stem if name.endswith(".npz") else f"{name}'s policy"
    drive = PolicyDrive(env, agent, shown, unseen_params(env, unseen), seed)
    if unseen:
        drive.scene["terrain"] = "unseen ground"
    return drive


def _numbers(option: str, text: str, between: str, kind: type) -> list:
    parts = text.split(between)
    try:
        return [kind(plain_digits(p)) for p in parts] if len(parts) == 2 else _refuse(option, text, between)
    except ValueError:
        return _refuse(option, text, between)


def _refuse(option: str, text: str, between: str) -> list:
    raise bad_input(
        "lunar-mjx",
        option,
        text,
        "is not two numbers",
        f"write it as 960{between}540" if between == "x" else "write it as 135,15",
    )


def _require_drive(run: Path) -> None:
    """Refuses what is no folder before its default output, which lies in it, is looked at."""
    if not run.is_dir():
        raise bad_input("drive", "RUN", str(run), "is not a folder", "give the folder that lunar-mjx simulate wrote")


def _check_file(path: Path, endings: tuple[str, ...]) -> None:
    """Refuses, before any work is done, a file of another kind or one that cannot be made."""
    from lunar_mjx.commands.options import check_place

    if path.suffix.lower() not in endings:
        raise bad_input("lunar-mjx", "--out", str(path), "is of no known kind", f"end it in {', '.join(endings)}")
    check_place(path.parent)


def register(app: typer.Typer, terrain_app: typer.Typer) -> None:
    """Adds the commands to the application."""
    app.command()(view)
    app.command()(plot)
    app.command()(render)
    terrain_app.command("preview")(preview)
