"""`lunar-mjx log`: template, import, check, recording from the simulator, and sealed answers."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

from lunar_mjx.commands.options import MOST_SEED
from lunar_mjx.errors import UserError, bad_input, plain_digits, require_within

# Not 1 or 2, which a script could not tell from a crash or a mistake in the call.
BAD_DATA_STATUS = 10


def register(app: typer.Typer) -> None:
    """Adds the command `log` to the application."""
    log_app = typer.Typer(help="Measurement logs: make, import, check, simulate, unseal.", no_args_is_help=True)
    log_app.command("new")(new)
    log_app.command("import")(import_)
    log_app.command("check")(check)
    log_app.command("simulate")(simulate)
    log_app.command("unseal")(unseal)
    log_app.command("manoeuvres")(manoeuvres)
    log_app.command("channels")(channels)
    log_app.command("noise")(noise)
    log_app.command("example")(example)
    app.add_typer(log_app, name="log")


def new(
    folder: Annotated[Path, typer.Argument(help="Folder to make; must not exist or be empty.")],
    rover: Annotated[str, typer.Option(help="Name of a shipped rover, or folder of one.")] = "viper",
    manoeuvre: Annotated[str, typer.Option(help="Canned manoeuvre or free text.")] = "speed_staircase",
    steady: Annotated[bool, typer.Option(help="For a single-wheel test bed.")] = False,
) -> None:
    """Write a commented template of a log: fill in its tables, then check it."""
    from lunar_mjx.logs import new_log

    print(new_log(folder, rover, manoeuvre, steady))


def import_(
    recordings: Annotated[
        list[Path],
        typer.Argument(help="CSV, TXT, Parquet or MATLAB files or folders of them; or bags of ROS and MCAP files."),
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder of the log; must not exist or be empty.")],
    mapping: Annotated[
        str, typer.Option("--map", help="TOML file: which column or field is which channel; or a shipped map's name.")
    ],
    change: Annotated[
        list[str] | None,
        typer.Option("--set", help="Key of log.toml over the map's, as ground=snow or imu.attitude=true."),
    ] = None,
    split_at_gaps: Annotated[
        float | None, typer.Option(min=0.0, help="Begin a new drive where nothing is recorded for so many seconds.")
    ] = None,
    split_at_rest: Annotated[
        float | None, typer.Option(min=0.0, help="Begin a new drive within rests that last so many seconds.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print folders and notes as JSON.")] = False,
) -> None:
    """Make a log, or a campaign of logs, from recordings; check it next."""
    from lunar_mjx.logs import import_drives

    found = import_drives(
        recordings,
        out,
        mapping,
        changes=_settings(change),
        split_at_gaps_s=split_at_gaps,
        split_at_rest_s=split_at_rest,
    )
    if as_json:
        drives = [{"log": str(f), "seconds": s} for f, s in zip(found.logs, found.seconds, strict=True)]
        notes = [{"drive": name, "note": note} for name, note in found.notes]
        copies = list(found.copies)
        print(json.dumps({"folder": str(found.folder), "drives": drives, "copies": copies, "notes": notes}, indent=2))
        return
    for name, note in found.notes:
        print(f"{name}: {note}")
    for note in found.copies:
        print(note)
    print(f"{len(found.logs)} drive{'s' if len(found.logs) > 1 else ''}, {sum(found.seconds):.0f} s")
    print(found.folder)


def _settings(changes: list[str] | None) -> dict[str, Any]:
    """KEY=VALUE pairs as a tree of settings; a value that is not TOML is a text."""
    # TOML's own reader, so that numbers, booleans and lists mean here what they mean in a map; bare words are spared
    # the quotes, which a shell would eat.
    tree: dict[str, Any] = {}
    for pair in changes or []:
        key, equals, text = pair.partition("=")
        if not equals or not re.fullmatch(r"[\w*]+(\.[\w*]+)*", key.strip()):
            raise bad_input("lunar-mjx log import", "--set", pair, "is not key=value", "write it as ground=snow")
        *parents, last = key.strip().split(".")
        place = tree
        for parent in parents:
            place = place.setdefault(parent, {})
            if not isinstance(place, dict):
                break
        if not isinstance(place, dict) or last in place:
            raise bad_input("lunar-mjx log import", "--set", pair, "is given a value twice", "give one of them")
        place[last] = _toml_value(pair, text.strip())
    return tree


def _toml_value(pair: str, text: str) -> Any:
    try:
        read = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return text
    except (ValueError, RecursionError):  # thousands of digits, thousands of brackets
        raise bad_input(
            "lunar-mjx log import", "--set", pair, "is no value of TOML", "write it as ground=snow"
        ) from None
    # A value of several lines may hold keys of its own.
    return read["value"] if len(read) == 1 else text


def channels() -> None:
    """List every channel of a log: name, unit, physical range."""
    from lunar_mjx.logs.schema import CHANNELS, CORNERS, KINDS, SIDES
    from lunar_mjx.model.describe import make_console, make_table

    table = make_table("channel", "unit", "family", "from", "to")
    for channel in CHANNELS:
        name = channel.stem + (f"_{channel.suffix}" if channel.suffix else "")
        table.add_row(name, channel.unit, channel.family, f"{channel.low:g}", f"{channel.high:g}")
    console = make_console()
    console.print(table)
    console.print(f"{{c}} a corner: {', '.join(CORNERS)}; before _drive also a side: {', '.join(SIDES)}")
    console.print(f"{{j}} a joint: {', '.join(KINDS)}. {{x}} an axis: x, y, z. {{q}} w, x, y, z of a quaternion")


def example(folder: Annotated[Path, typer.Argument(help="Folder to make; must not exist or be empty.")]) -> None:
    """Copy recordings of a real rover, a Husky on a floor and on sandy loam, to import and try."""
    from lunar_mjx.logs.example import copy_example

    print(copy_example(folder))
    print(f"next: lunar-mjx log import {shlex.quote(str(folder))} --map husky_borealtc -o runs/husky")


def noise(
    logs: Annotated[list[Path], typer.Argument(help="Logs of drives, or folders of such logs.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print the numbers as JSON.")] = False,
) -> None:
    """Tell the noise of every channel: as stated, while the rover drives, and at rest."""
    import dataclasses

    from lunar_mjx.logs import Log, read_campaign
    from lunar_mjx.logs.noise import noise_table
    from lunar_mjx.model.describe import make_console, make_table

    read = [log for log in read_campaign(logs) if isinstance(log, Log)]
    if not read:
        raise bad_input("log noise", "logs", ", ".join(map(str, logs)), "hold no drive", "name logs of drives")
    found = noise_table(read)
    if as_json:
        plain = {
            c: {k: {**dataclasses.asdict(n), "log_std": n.log_std} for k, n in v.items()} for c, v in found.items()
        }
        print(json.dumps(plain, indent=2))
        return
    table = make_table("channel, and what tells", "std", "coloured", "time, s", "log std", names=5)
    for channel, kinds in found.items():
        table.add_row(channel, style="bold")
        for kind, n in kinds.items():
            # what a drive itself shows needs no more than its own word
            shows = kind == "drive" and n.source in ("vibration", "ripple", "estimate")
            label = n.source if shows else kind if kind in (n.source, "rest") else f"{kind}: {n.source}"
            numbers = (f"{n.std:.3g}", f"{n.share:.2g}", f"{n.correlation_time_s:.2g}", f"{n.log_std:.2g}")
            table.add_row(f"  {label}", *numbers)
    make_console().print(table)


def check(
    logs: Annotated[list[Path], typer.Argument(help="Logs, or folders of logs.")],
    slowest: Annotated[
        list[str] | None, typer.Option(help="Effect that will be asked about and its time constant, as name=600 (s).")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print findings as JSON.")] = False,
) -> None:
    """Check logs before anything else uses them; exit status 10 where data are unusable."""
    from lunar_mjx.logs import check as check_logs
    from lunar_mjx.logs import read_campaign
    from lunar_mjx.logs.checks.gate import require_named
    from lunar_mjx.logs.findings import is_bad

    # All before any is checked: whether a campaign is long enough is told by its longest log.
    read = read_campaign(logs)
    constants = _numbers("--slowest", slowest)
    for name, seconds in constants.items():
        require_within("log check", f"--slowest {name}", seconds, 0.0, above=True)
    require_named(read, constants)
    found = check_logs(read, constants)
    if as_json:
        print(
            json.dumps(
                {
                    "logs": [log.name for log in read],
                    "bad_data": is_bad(found),
                    "findings": [f.to_dict() for f in found],
                },
                indent=2,
            )
        )
    else:
        _print_findings(read, found)
    if is_bad(found):
        raise typer.Exit(BAD_DATA_STATUS)


MOST_NAMED = 12
"""Logs that are named one by one though nothing is found in them: a screen of them hides the others."""


def _print_findings(logs: list[Any], found: list[Any]) -> None:
    from rich.markup import escape

    from lunar_mjx.logs import SteadyLog
    from lunar_mjx.model.describe import make_console, make_table

    console = make_console()
    quiet = [log for log in logs if all(f.log != log.name for f in found)]
    if len(quiet) <= MOST_NAMED:
        quiet = []
    for log in logs:
        if any(log is other for other in quiet):
            continue
        mine = [f for f in found if f.log == log.name]
        if isinstance(log, SteadyLog):
            what = f"{len(log.table)} points"
        else:
            what = ", ".join(f"{t.name} {len(t)} rows x {len(t.channels)}" for t in log.tables.values())
        bad = sum(f.severity == "bad_data" for f in mine)
        console.print(f"{escape(log.name)} ({what}): {f'BAD_DATA, {bad} findings' if bad else 'fit to be used'}")
        if not mine:
            continue
        table = make_table("", "table", "line", "column", "kind", "finding")
        for f in mine:
            mark = "BAD" if f.severity == "bad_data" else "note"
            line = "" if f.line is None else str(f.line)
            table.add_row(mark, escape(f.table), line, escape(_short(f.column)), f.kind, escape(f.message))
        console.print(table)
    if quiet:
        which = "all" if len(quiet) == len(logs) else "the others"
        console.print(f"{len(quiet)} of {len(logs)} logs ({which}): nothing found, fit to be used")


def simulate(
    out: Annotated[Path, typer.Argument(help="Folder of the log; the answer goes to OUT.answer.toml.")],
    rover: Annotated[str, typer.Option(help="Name of a shipped rover, or folder of one.")] = "viper",
    manoeuvre: Annotated[str, typer.Option(help="Canned manoeuvre, or TOML file of one.")] = "speed_staircase",
    effect: Annotated[
        list[str] | None,
        typer.Option(
            help="Hidden effect, as NAME or NAME:parameter=value,parameter=value; NAME may be my_effects.py:name."
        ),
    ] = None,
    effects: Annotated[
        list[str] | None, typer.Option(help="Hidden effect from your own file, as my_effects.py:name.")
    ] = None,
    preset: Annotated[str, typer.Option(help="consistent, field or paper.")] = "consistent",
    model: Annotated[Path | None, typer.Option(help="model.toml; overrides --rover and --preset.")] = None,
    terrain: Annotated[str | None, typer.Option(help="In place of the manoeuvre's terrain.")] = None,
    gravity: Annotated[float | None, typer.Option(help="m/s2")] = None,
    noise: Annotated[str, typer.Option(help="datasheet, none or scale:5.")] = "datasheet",
    coloured: Annotated[bool, typer.Option(help="Autoregressive noise instead of white.")] = False,
    quantise: Annotated[bool, typer.Option(help="Round to the instruments' steps.")] = False,
    dropouts: Annotated[float, typer.Option(help="Share of samples lost.")] = 0.0,
    bias: Annotated[list[str] | None, typer.Option(help="Constant added to a channel, as gyro_z_rad_s=0.01.")] = None,
    forces: Annotated[bool, typer.Option(help="With force and torque sensors.")] = False,
    bus_current: Annotated[bool, typer.Option(help="With the current of all motors together.")] = False,
    seconds: Annotated[float | None, typer.Option(help="Length of the drive; the manoeuvre's own if left out.")] = None,
    seed: Annotated[int | None, typer.Option(min=0, max=MOST_SEED, help="Of the noise; drawn if left out.")] = None,
    split: Annotated[str | None, typer.Option(help="fit, select or test.")] = None,
    seal: Annotated[bool, typer.Option(help="Commit to the answer, so that it can be shown later.")] = False,
) -> None:
    """Record a log from the simulator, with any hidden effect and any noise."""
    from lunar_mjx.logs import Recording, simulate_log
    from lunar_mjx.logs.recorder.instruments import parse_noise
    from lunar_mjx.logs.seal import answer_path
    from lunar_mjx.model.file import load_model

    recording = Recording(
        parse_noise(noise),
        coloured,
        quantise=quantise,
        dropouts=dropouts,
        bias=_numbers("--bias", bias),
        forces=forces,
        bus_current=bus_current,
    )
    hidden = [_effect(text) for text in effect or []] + [(text, {}) for text in effects or []]
    folder = simulate_log(
        out,
        rover,
        manoeuvre,
        hidden,
        preset=preset,
        model=load_model(model) if model else None,
        terrain=terrain,
        gravity_m_s2=gravity,
        recording=recording,
        seconds=seconds,
        seed=seed,
        seal=seal,
        split=split,
    )
    print(folder)
    print(f"answer (keep it): {answer_path(out)}" if seal else f"answer: {answer_path(out)}")


def _effect(text: str) -> tuple[str, dict[str, float]]:
    """NAME:parameter=value,... or my_effects.py:name:parameter=value,... as a name and its values."""
    # A file's effect has a colon of its own, before the one that begins its values.
    own = re.fullmatch(r"(.+\.py:\w+)(?::(.*))?", text)
    name, rest = (own[1], own[2] or "") if own else text.partition(":")[::2]
    return name, _numbers("--effect", rest.split(",") if rest else [])


def _short(name: str) -> str:
    # A vendor's column may be a whole path; the table must not be torn by it.
    return name if len(name) <= 80 else name[:77] + "..."


def _numbers(option: str, pairs: list[str] | None) -> dict[str, float]:
    values = {}
    for pair in pairs or []:
        name, equals, number = pair.partition("=")
        try:
            values[name.strip()] = float(plain_digits(number))
        except ValueError:
            equals = ""
        if not equals or not name.strip():
            raise bad_input("lunar-mjx log", option, pair, "is not name=number", "write it as in stiffness=0.5")
    return values


def unseal(
    answer: Annotated[Path, typer.Argument(help="OUT.answer.toml that the sender kept.")],
    log: Annotated[Path, typer.Argument(help="The sealed log.")],
    verdict: Annotated[Path | None, typer.Option(help="The colleague's verdict.json, or its folder.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Open the answer to a sealed log, and compare it with a verdict."""
    from lunar_mjx.logs import unseal as open_answer

    result = open_answer(answer, log, verdict)
    if as_json:
        print(json.dumps(result, indent=2))
        return
    print(f"the answer is the one that {log} was sealed with, and its tables are unchanged")
    for hidden in result["effects"]:
        values = ", ".join(f"{k} = {v}" for k, v in hidden["parameters"].items())
        print(f"{'hidden' if hidden['added'] else 'changed'}: {hidden['name']}{f' ({values})' if values else ''}")
    if not result["effects"]:
        print("hidden: nothing")
    if verdict is not None:
        print(f"verdict: {result['verdict']} {', '.join(result['named'])}".rstrip())
        print(f"score: {result['score']}")


def manoeuvres() -> None:
    """List the canned manoeuvres: what each is and which effects it tells apart."""
    from lunar_mjx.manoeuvres import MANOEUVRES, load_manoeuvre
    from lunar_mjx.model.describe import make_console, make_table

    table = make_table("manoeuvre", "s", "what, and what it tells apart", names=2)
    for name in MANOEUVRES:
        plan = load_manoeuvre(name)
        told = f"{plan.description}\nTells apart: {', '.join(plan.separates)}."
        table.add_row(name, f"{plan.duration_s:g}", told)
    # The TOML files are package data, which a broken build leaves out.
    if not MANOEUVRES:
        raise UserError("manoeuvres: none ships with this installation; reinstall the package.")
    make_console().print(table)
