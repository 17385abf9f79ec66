"""`lunar-mjx bed`: simulated test beds with a soil of particles, for one wheel or a rover."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from lunar_mjx.commands.options import MOST_SEED, check_folder, make_folder, select_device
from lunar_mjx.errors import UserError, bad_input, require_finite, require_within

if TYPE_CHECKING:
    from lunar_mjx.wheel_bed.particles.settings import Point
    from lunar_mjx.wheel_bed.table import SteadyStateTable

GRAVITIES = {"earth": 9.80665, "moon": 1.625}
"""Names that --gravity takes, m/s2."""
VOXELS = 8.0
"""Voxels per radius where --voxel is left out."""


def register(app: typer.Typer) -> None:
    """Adds the command `bed` to the application."""
    bed_app = typer.Typer(help="Simulated test beds: a wheel or a rover in particle sand.", no_args_is_help=True)
    bed_app.command("simulate")(simulate)
    bed_app.command("drive")(drive)
    app.add_typer(bed_app, name="bed")


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder to write to; one that holds runs is gone on with.")],
    soil: Annotated[
        str, typer.Option(help="particles: sand by Newton's implicit material point method.")
    ] = "particles",
    rover: Annotated[str | None, typer.Option(help="Wheel of a shipped rover, or of a rover's folder.")] = None,
    like: Annotated[
        str | None, typer.Option(help="Wheel and points of a steady-state log's folder, or cmu_smooth_wheel.")
    ] = None,
    radius: Annotated[float | None, typer.Option(help="of the wheel, m")] = None,
    width: Annotated[float | None, typer.Option(help="of the wheel, m")] = None,
    grouser_count: Annotated[int, typer.Option(help="around the wheel")] = 0,
    grouser_height: Annotated[float, typer.Option(help="m")] = 0.0,
    slips: Annotated[str | None, typer.Option(help="Slip ratios in the wheel's frame, as --slips=-0.2,0,0.3.")] = None,
    slip_angles: Annotated[str | None, typer.Option(help="deg, as 0,15,30")] = None,
    loads: Annotated[str | None, typer.Option(help="N, as 40,80")] = None,
    every: Annotated[int, typer.Option(min=1, help="Take each n-th point alone.")] = 1,
    load_share: Annotated[
        float, typer.Option(help="Factor on all loads: 0.1657 for what a mass weighs on the Moon.")
    ] = 1.0,
    gravity: Annotated[str, typer.Option(help="earth, moon, or m/s2")] = "earth",
    friction_angle: Annotated[float, typer.Option(help="of the sand, deg")] = 35.0,
    cohesion: Annotated[float, typer.Option(help="of the sand, Pa")] = 0.0,
    density: Annotated[float, typer.Option(help="of the sand, kg/m3")] = 1600.0,
    wheel_friction: Annotated[float, typer.Option(help="coefficient between wheel and sand")] = 0.5,
    voxel: Annotated[float | None, typer.Option(help="m; an eighth of the radius if left out")] = None,
    contact: Annotated[str, typer.Option(help="S2 (nodes of the grid) or pic8 (particles)")] = "S2",
    froude: Annotated[float, typer.Option(help="square of the faster of rim and travel speed over g R")] = 0.1,
    step_share: Annotated[float, typer.Option(help="voxels that the faster of them moves in a time step")] = 0.15,
    path: Annotated[float, typer.Option(help="radii that the faster of them moves")] = 4.0,
    controls: Annotated[
        int | None,
        typer.Option(
            help="points that are computed again to learn the numerical error; 4 if left out, or all of fewer"
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of the places of the particles.")] = 0,
    seconds: Annotated[float | None, typer.Option(help="Time limit; the same command goes on later.")] = None,
    together: Annotated[int | None, typer.Option(min=1, help="Particles computed together; by the device.")] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
) -> None:
    """Drive a wheel through simulated sand and write a steady-state table, with its numerical error as the noise."""
    if soil != "particles":
        raise bad_input("lunar-mjx bed simulate", "--soil", soil, "does not exist", "use particles")
    check_folder(out, "log.toml")
    select_device("cpu")  # JAX only reads tables here, and must not take the GPU's memory
    from lunar_mjx.logs.recorder.particle_bed import write_particle_log
    from lunar_mjx.report.progress import console_progress
    from lunar_mjx.wheel_bed.particles import campaign
    from lunar_mjx.wheel_bed.particles.sand_box import open_device
    from lunar_mjx.wheel_bed.particles.settings import Numerics, ParticleWheel, Sand

    limit = float("inf") if seconds is None else require_within("bed simulate", "--seconds", seconds, 0.0, above=True)
    factor = require_within("bed simulate", "--load-share", load_share, 0.0, above=True)
    table = _table(like) if like else None
    wheel = ParticleWheel(*_wheel(rover, table, radius, width), grouser_count, grouser_height)
    points = _points(table, slips, slip_angles, loads, factor)[::every]
    sand = Sand(friction_angle, cohesion, density, wheel_friction)
    numerics = Numerics(
        voxel=wheel.radius / VOXELS if voxel is None else voxel,
        contact=contact,
        froude=froude,
        step_share=step_share,
        path=path,
        seed=seed,
    )
    g = _gravity(gravity, "bed simulate")
    # The whole plan first: what the folder lacks of it is what there is to do, after a stop as well.
    runs = campaign.plan(wheel, sand, g, points, numerics, min(4, len(points)) if controls is None else controls)
    if campaign.missing(runs, out):
        open_device(device)  # before anything is written
    # Points of a table keep its definition of slip, so that both tables can be laid side by side.
    definition = table.slip_definition if table else "wheel_frame"
    folder = make_folder(out, "log.toml")

    def keep(results: list[dict[str, Any]]) -> None:
        if any(r["variant"] == "table" and r["usable"] for r in results):
            write_particle_log(folder, results, definition)

    with console_progress() as progress:
        outcome = campaign.compute(runs, folder, device, limit, together, progress, keep)
    _tell(outcome, folder, len(points))
    if outcome.results:
        print(write_particle_log(folder, outcome.results, definition))


def drive(
    out: Annotated[
        Path,
        typer.Argument(
            help="New folder, for log/, drive.json and surface.csv; one that keeps a drive is gone on with."
        ),
    ],
    rover: Annotated[str, typer.Option(help="Name of a shipped rover, or folder of one.")] = "luvmi_x",
    manoeuvre: Annotated[str, typer.Option(help="Canned manoeuvre, or TOML file of one.")] = "speed_staircase",
    terrain: Annotated[
        str | None, typer.Option(help="flat or slope:5deg, in place of the manoeuvre's terrain.")
    ] = None,
    duration: Annotated[
        float | None, typer.Option(help="Length of the drive, s; the manoeuvre's own if left out.")
    ] = None,
    gravity: Annotated[str, typer.Option(help="earth, moon, or m/s2")] = "moon",
    friction_angle: Annotated[
        float | None, typer.Option(help="of the sand, deg; the model's soil's if left out")
    ] = None,
    cohesion: Annotated[float | None, typer.Option(help="of the sand, Pa; the model's soil's if left out")] = None,
    density: Annotated[float, typer.Option(help="of the sand, kg/m3")] = 1600.0,
    wheel_friction: Annotated[float, typer.Option(help="coefficient between wheel and sand")] = 0.5,
    voxel: Annotated[float | None, typer.Option(help="m; an eighth of the radius if left out")] = None,
    contact: Annotated[str, typer.Option(help="S2 (nodes of the grid) or pic8 (particles)")] = "S2",
    step_share: Annotated[float, typer.Option(help="voxels that a rim moves in a time step, at most")] = 0.15,
    control: Annotated[
        bool, typer.Option(help="Drive again with voxels 1.5 times as large, to learn the numerical error.")
    ] = True,
    noise: Annotated[str, typer.Option(help="Of the instruments: datasheet, none or scale:5.")] = "datasheet",
    forces: Annotated[bool, typer.Option(help="With force and torque sensors.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Of particles' places and of noise.")] = 0,
    seconds: Annotated[
        float | None, typer.Option(help="Time limit; what was driven is written, and the same command goes on.")
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda")] = "auto",
) -> None:
    """Drive a rover through simulated sand and write a log of it, with its numerical error in the noise."""
    check_folder(out)
    select_device("cpu")  # JAX only makes the model here, and must not take the GPU's memory
    import dataclasses

    import numpy as np

    from lunar_mjx.backends.in_sand import plane_of
    from lunar_mjx.backends.sand_drive import require_shown, smooth_wheels
    from lunar_mjx.logs.recorder.instruments import Recording, parse_noise
    from lunar_mjx.logs.recorder.particle_drive import record_sand_drive, refuse_other
    from lunar_mjx.manoeuvres import commands, load_manoeuvre
    from lunar_mjx.model import make_model
    from lunar_mjx.report.progress import console_progress
    from lunar_mjx.wheel_bed.particles.sand_box import open_device
    from lunar_mjx.wheel_bed.particles.settings import Numerics, Sand

    limit = float("inf") if seconds is None else require_within("bed drive", "--seconds", seconds, 0.0, above=True)
    recording = Recording(parse_noise(noise), forces=forces)
    plan = load_manoeuvre(manoeuvre)
    spec = terrain or plan.terrain
    plan = dataclasses.replace(plan, terrain=spec)
    scale = 1.0 if duration is None else require_within("bed drive", "--duration", duration, 0.5, 1e5) / plan.duration_s
    model = make_model(rover, spec, "consistent").replace(gravity=_gravity(gravity, "bed drive"))
    model = model.replace(modes={"drive": plan.drive_mode})
    soil = model.parameters["soil"]
    sand = Sand(
        math.degrees(float(np.asarray(soil["friction_angle"]))) if friction_angle is None else friction_angle,
        float(np.asarray(soil["cohesion"])) if cohesion is None else cohesion,
        density,
        wheel_friction,
    )
    wheels = smooth_wheels(model)
    size = min(w.radius for w in wheels) / VOXELS if voxel is None else voxel
    numerics = Numerics(voxel=size, contact=contact, step_share=step_share, seed=seed)
    require_shown(wheels, size)
    moves = commands(plan, model, scale)
    plane_of(model.terrain, plan.start[0], plan.start[1])  # refuses hills
    refuse_other(out)
    name = open_device(device)  # before anything is written
    with console_progress() as progress:
        told = record_sand_drive(
            make_folder(out), model, rover, plan, moves, sand, numerics, name, limit, progress, control, recording
        )
    for line in told:
        print(line)


def _gravity(text: str, command: str) -> float:
    """Gravity by name, or as a number in m/s2."""
    named = GRAVITIES.get(text)
    return require_within(command, "--gravity", text, 0.0, 100.0, above=True) if named is None else named


def _table(like: str) -> SteadyStateTable:
    from lunar_mjx.logs import SteadyLog, read_log
    from lunar_mjx.wheel_bed.data_files import load_figures

    if not Path(like).exists():
        return load_figures(like)
    log = read_log(like)
    if not isinstance(log, SteadyLog):
        raise bad_input("bed simulate", "--like", like, "is a drive", "name a steady-state log")
    return log.table


def _wheel(
    rover: str | None, table: SteadyStateTable | None, radius: float | None, width: float | None
) -> tuple[float, float]:
    """Radius and width in m: as given, else of the table, else of the rover's first wheel."""
    found = (table.radius, table.width) if table else (None, None)
    if rover is not None:
        from lunar_mjx.rover import load_rover

        first = load_rover(rover).wheels[0]
        found = (first.radius, first.width)
    size = [own if own is not None else other for own, other in zip((radius, width), found, strict=True)]
    if size[0] is None or size[1] is None:
        raise UserError("lunar-mjx bed simulate: no wheel is named; give --rover, --like, or --radius and --width.")
    return size[0], size[1]


def _points(
    table: SteadyStateTable | None, slips: str | None, slip_angles: str | None, loads: str | None, factor: float
) -> list[Point]:
    """The table's points, or every combination of slips, slip angles and loads."""
    import dataclasses

    import numpy as np

    from lunar_mjx.wheel_bed.particles.points import points_of_table
    from lunar_mjx.wheel_bed.particles.settings import BOX_SIZE
    from lunar_mjx.wheel_bed.table import SteadyStateTable as Table

    if table is not None:
        if slips or loads:
            raise UserError("lunar-mjx bed simulate: --like brings its own points; leave out --slips and --loads.")
        points = points_of_table(table)
        if slip_angles:
            wanted = _numbers("--slip-angles", slip_angles)
            # A hundredth of a degree, since a table's angles have been in radians and back.
            points = [p for p in points if any(abs(p.slip_angle - w) < 0.01 for w in wanted)]
        if not points:
            raise bad_input("bed simulate", "--slip-angles", slip_angles, "are not in the table", "name some that are")
    else:
        if not (slips and loads):
            raise UserError("lunar-mjx bed simulate: no points are named; give --slips and --loads, or --like.")
        grid = np.meshgrid(
            _numbers("--slips", slips),
            _numbers("--slip-angles", slip_angles or "0"),
            _numbers("--loads", loads),
            indexing="ij",
        )
        slip, angle, load = (a.reshape(-1) for a in grid)
        # A wheel that hardly travels never leaves its own pit, which deepens as long as it turns.
        if slip.max() > 1.0 - BOX_SIZE.slowest:
            raise bad_input(
                "bed simulate",
                "--slips",
                float(slip.max()),
                "has no steady state",
                f"give {1 - BOX_SIZE.slowest:g} at most",
            )
        if slip.min() < -1.0 or np.abs(angle).max() > 85.0 or load.min() <= 0.0 or load.max() > 1e5:
            raise UserError(
                "lunar-mjx bed simulate: --slips lie within [-1, 0.95], --slip-angles within [-85, 85] deg, and "
                "--loads are positive, 100000 N at most; correct them."
            )
        test = {"slip_ratio": slip, "slip_angle_deg": angle, "normal_load_N": load}
        points = points_of_table(Table("", test, {}, np.ones(len(slip), int), {}, 1.0, 1.0, "wheel_frame"))
    return [dataclasses.replace(p, load=factor * p.load) for p in points]


def _numbers(option: str, text: str) -> list[float]:
    return [require_finite("bed simulate", option, part.strip()) for part in text.split(",")]


def _tell(outcome: Any, folder: Path, points: int) -> None:
    """Prints what is done, what it cost and how large the numerical error is."""
    from lunar_mjx.wheel_bed.particles.results import numerical_error
    from lunar_mjx.wheel_bed.table import QUANTITIES

    table = [r for r in outcome.results if r["variant"] == "table"]
    usable = [r for r in table if r["usable"]]
    varied = len(outcome.results) - len(table)
    print(f"{len(table)} of {points} points ({len(usable)} usable) and {varied} control runs")
    if table:
        # Over all runs, as a mean of their quotients would favour short ones.
        spent = sum(r["seconds"] for r in outcome.results) / sum(r["wheel_seconds"] for r in outcome.results)
        worst = max(r["momentum_error"] for r in outcome.results)
        print(
            f"{spent:.3g} s per wheel-second on {table[0]['device']}; momentum closes to {worst:.1e} of gravity's "
            "impulse"
        )
    for quantity, parts in numerical_error(outcome.results).items():
        amounts = ", ".join(f"{k} {v:.2g}" for k, v in parts.items())
        if amounts:
            print(f"numerical error of {QUANTITIES[quantity][0]}: {amounts}")
    if outcome.stopped:
        print(f"stopped: {outcome.stopped}; {outcome.left} runs are left, the same command goes on with them")
