"""`lunar-mjx compare | why | next | add | unknown | report | improve | watch`: criticism by verbs on run folders."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from lunar_mjx.commands.compiled import keep_compiled
from lunar_mjx.commands.options import MOST_SEED, check_folder, check_place
from lunar_mjx.errors import UserError, bad_input, plain_digits
from lunar_mjx.files import only_writer

if TYPE_CHECKING:
    from lunar_mjx.diagnosis.runs import Run
    from lunar_mjx.diagnosis.verdict import Diagnosis
    from lunar_mjx.model import Model

RunArgument = Annotated[Path, typer.Argument(help="Run folder that `compare` or `add` wrote.")]
LogsArgument = Annotated[list[Path], typer.Argument(help="Logs, or folders of logs; all drives or all wheel tables.")]
ModelOption = Annotated[Path | None, typer.Option(help="model.toml; by default the preset on the logs' rover.")]
PresetOption = Annotated[
    str | None,
    typer.Option(
        help="consistent, field or paper, where no --model is given; by default consistent, or a hard floor where the "
        "logs' wheel speeds are imposed."
    ),
]
EffectsOption = Annotated[
    list[str] | None, typer.Option("--effects", help="Your own effects to consider too, as my_effects.py:name.")
]
SplitOption = Annotated[
    list[str] | None, typer.Option("--split", help="Split of a log (or group of points), as NAME=fit|select|test.")
]
SeedOption = Annotated[int, typer.Option(min=0, max=MOST_SEED, help="Seed of all random starts.")]
OutOption = Annotated[Path, typer.Option("--out", "-o", help="Run folder to write.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
AnimationOption = Annotated[Path | None, typer.Option(help="Also write the falling error as .gif, .webp or .mp4.")]
DarkOption = Annotated[bool, typer.Option(help="The animation for a dark page.")]
PriorOption = Annotated[
    list[str] | None,
    typer.Option(
        "--prior",
        help="What is known of a parameter or an instrument, as hard_ground.mu=0.6+-0.05 in its own unit; for logs "
        "with imposed wheel speeds.",
    ),
]
FixOption = Annotated[
    list[str] | None,
    typer.Option("--fix", help="Exact value of a parameter, as motor.gear_efficiency=0.7; it is not fitted."),
]
DiscrepancyOption = Annotated[
    list[str] | None,
    typer.Option(
        "--discrepancy", help="Known unexplained error of the model, as drawbar_pull=2.5 (SI), added to the noise."
    ),
]
SettingOption = Annotated[
    list[str] | None,
    typer.Option("--setting", help="Size, prior or effort for tables, as effect_odds=0.01; run.json lists all."),
]


def register(app: typer.Typer) -> None:
    """Adds the verbs to the application."""
    for name, function in (
        ("compare", compare),
        ("why", why),
        ("next", next_),
        ("add", add),
        ("unknown", unknown),
        ("report", report),
        ("studio", studio),
        ("improve", improve),
        ("watch", watch),
    ):
        app.command(name)(function)


def compare(
    logs: LogsArgument,
    out: OutOption = Path("run1"),
    model: ModelOption = None,
    preset: PresetOption = None,
    effects: EffectsOption = None,
    split: SplitOption = None,
    discrepancy: DiscrepancyOption = None,
    setting: SettingOption = None,
    prior: PriorOption = None,
    fix: FixOption = None,
    seed: SeedOption = 0,
) -> None:
    """Hold a model against logs: where it fails, and by how many sigma."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.report.progress import console_progress

    # Before the model is made and anything compiles: a mistake in an option is told within a second.
    check_folder(out, "run.json")
    _require_imposed("--prior", prior, logs)
    _require_imposed("--fix", fix, logs)
    keep_compiled()
    try:
        with _alone(out), console_progress() as progress:
            run = verbs.compare(
                logs,
                _with_priors(_model(model, preset, logs), prior, fix),
                out,
                effects or (),
                _pairs("--split", split),
                seed,
                _numbers("--discrepancy", discrepancy),
                progress,
                _pairs("--setting", setting),
            )
    # Bad data is an answer with an exit status of its own, and no mistake of the command line's.
    except verbs.BadData as bad:
        _finish(bad.diagnosis, False)
    _print_comparison(run)
    _write_report([out], out / "report.html")


def why(
    run: RunArgument,
    explain: Annotated[str | None, typer.Option(help="Evidence for and against one effect.")] = None,
    only: Annotated[list[str] | None, typer.Option(help="Consider only these effects.")] = None,
    audit: Annotated[
        float, typer.Option(help="Minutes to spend on simulated logs like these: how often is it wrong?", min=0.0)
    ] = 0,
    seconds: Annotated[
        float | None, typer.Option(help="Answer after this many seconds with what is known by then.", min=1.0)
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Say which effect is missing, where, or that nobody can tell; the exit status is the verdict."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.report.progress import console_progress

    _require_room(run)
    keep_compiled()
    with _alone(run), console_progress() as progress:
        diagnosis = verbs.why(run, only, progress=progress, seconds=seconds, about=explain)
        # The verdict is written by now: an audit that is broken off loses nothing of it.
        if audit > 0:
            from lunar_mjx.diagnosis.audit import audit as run_audit

            run_audit(run, 60.0 * audit, progress=progress)
    _write_report([run], run / "report.html")
    if explain is not None:
        diagnosis = verbs.explain(diagnosis, explain)
    _finish(diagnosis, as_json)


def next_(
    run: RunArgument,
    between: Annotated[
        list[str] | None, typer.Option(help="Effects to tell apart; else those that the verdict leaves open.")
    ] = None,
    seconds: Annotated[float, typer.Option(help="Longest drive to plan, s.", min=1.0)] = 30.0,
    as_json: JsonOption = False,
) -> None:
    """Name the manoeuvre that best separates the effects that survive."""
    from lunar_mjx.diagnosis.next_experiment import next_experiment
    from lunar_mjx.report.progress import console_progress

    _require_room(run)
    keep_compiled()
    with _alone(run), console_progress() as progress:
        found = next_experiment(run, between or (), seconds, progress)
    print(json.dumps(found.to_dict(), indent=2) if as_json else found.sentence)


def add(
    run: RunArgument,
    effect: Annotated[str, typer.Argument(help="Catalogue name, or my_effects.py:name.")],
    out: OutOption = Path("run2"),
) -> None:
    """Add an effect to the model, refit, and compare again."""
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.report.progress import console_progress

    check_folder(out, "run.json")
    keep_compiled()
    try:
        with _alone(out), console_progress() as progress:
            grown = verbs.add(run, effect, out, progress)
    except verbs.BadData as bad:
        _finish(bad.diagnosis, False)
    _print_comparison(grown)
    # Both runs, so that the page shows the error fall from one to the other.
    _write_report([run, out], out / "report.html")


def unknown(
    run: RunArgument,
    port: Annotated[str | None, typer.Option(help="Port to look at; by default where `why` found evidence.")] = None,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="Effect file to write.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Suggest formulas for what no catalogue effect explains, and write the best as an effect file."""
    from lunar_mjx.diagnosis.formulas.discover import discover
    from lunar_mjx.diagnosis.runs import plain
    from lunar_mjx.report.progress import console_progress

    _require_room(run)
    keep_compiled()
    with _alone(run), console_progress() as progress:
        found = discover(run, port, out, progress=progress)
    print(json.dumps(plain(found.to_dict()), indent=2) if as_json else found.text())


def report(
    runs: Annotated[list[Path], typer.Argument(help="Run folders, in the order in which effects were added.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="HTML file to write.")] = Path("report.html"),
    animation: AnimationOption = None,
    dark: DarkOption = False,
) -> None:
    """Write one offline page: the error falls."""
    _check_animation(animation)
    _write_report(runs, out)
    print(out)
    _write_animation(runs, animation, dark)


def studio(
    run: RunArgument,
    out: Annotated[Path | None, typer.Option("--out", "-o", help="HTML file; RUN/studio.html if left out.")] = None,
    refit: Annotated[
        bool, typer.Option(help="Refit wheel tables with each effect, if the run does not hold these refits yet.")
    ] = True,
    animation: AnimationOption = None,
    dark: DarkOption = False,
) -> None:
    """Write an offline page to choose effects, see the error fall, and where the model fails."""
    from lunar_mjx.diagnosis.studio import studio as make
    from lunar_mjx.report.progress import console_progress

    _check_animation(animation)
    keep_compiled()
    with console_progress() as progress:
        path, left_out = make(run, out, refit, progress)
    if left_out:
        print(left_out, file=sys.stderr)
    print(path)
    _write_animation([run], animation, dark)


def improve(
    logs: LogsArgument,
    out: OutOption = Path("runs"),
    model: ModelOption = None,
    preset: PresetOption = None,
    effects: EffectsOption = None,
    split: SplitOption = None,
    discrepancy: DiscrepancyOption = None,
    setting: SettingOption = None,
    seed: SeedOption = 0,
    as_json: JsonOption = False,
) -> None:
    """Run the whole loop unattended; the exit status is the last verdict.

    Each round adds every effect that is more probable than not: that model foresees best. It ends where there is none,
    or where the verdict is neither a name nor UNKNOWN.
    """
    from lunar_mjx.diagnosis import verbs
    from lunar_mjx.report.progress import console_progress

    check_folder(out, "run.json")
    keep_compiled()
    with _alone(out), console_progress() as progress:
        diagnosis, runs = verbs.improve(
            logs,
            _model(model, preset, logs),
            out,
            effects or (),
            _pairs("--split", split),
            seed,
            discrepancy=_numbers("--discrepancy", discrepancy),
            progress=progress,
            settings=_pairs("--setting", setting),
        )
    if runs:
        _write_report([r.folder for r in runs], out / "report.html")
        # JSON stays one document: whoever parses it reads the steps in the run folders.
        if not as_json:
            _print_steps(runs)
    _finish(diagnosis, as_json)


def watch(
    log: Annotated[Path, typer.Argument(help="Log of a drive with imposed wheel speeds; may still be growing.")],
    run: Annotated[Path, typer.Option("--run", help="Run folder of undisturbed drives of the same rover.")],
    once: Annotated[bool, typer.Option("--once", help="The log has ended: read it once and do not wait.")] = False,
    hours: Annotated[
        float, typer.Option(help="Hours of driving from one false alarm to the next, at least, in the mean.")
    ] = 10.0,
    idle: Annotated[float, typer.Option(help="Seconds without growth after which the log has ended.", min=0.0)] = 60.0,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Folder for each alarm's evidence; RUN/watch if left out.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print each event as a line of JSON.")] = False,
) -> None:
    """Follow a growing log and raise an alarm where something begins; the exit status is the last alarm's verdict."""
    from lunar_mjx.diagnosis import watch as watching
    from lunar_mjx.report.progress import console_progress

    if out is not None:
        check_folder(out)
    keep_compiled()
    status = count = 0
    with console_progress() as progress:
        for alarm in watching.watch(log, run, hours, once, out, idle, progress):
            # At once: whoever reads a pipe is to hear of an alarm when it is raised.
            print(json.dumps(alarm.to_dict()) if as_json else alarm.sentence, flush=True)
            count = max(count, alarm.number)
            if alarm.diagnosis is not None:
                status = alarm.diagnosis.verdict.exit_status
    if not count and not as_json:
        print("No alarm: nothing began that is larger than what these drives do anyway.")
    # Of the last alarm, as the verdict of `why` is one: scripts branch on it.
    raise typer.Exit(status)


@contextmanager
def _alone(run: Path) -> Iterator[None]:
    """Keeps other commands out of a run folder that is there: of two at once, files would be of one or the other."""
    if not (run / "run.json").is_file():
        yield
        return
    with only_writer(run, ".writing", "command of lunar-mjx"):
        yield


def _require_room(run: Path) -> None:
    """Refuses, before minutes of work, a run folder that takes no result; what is no run folder is told later."""
    if run.is_dir():
        check_place(run, "RUN")


def _check_animation(animation: Path | None) -> None:
    """Refuses, before a page is written, a file that no animation can be written to."""
    if animation is not None:
        from lunar_mjx.diagnosis.report.falling import require_kind

        require_kind(animation)


def _write_animation(runs: Sequence[Path], animation: Path | None, dark: bool) -> None:
    if animation is not None:
        from lunar_mjx.diagnosis.report.falling import write_falling

        print(write_falling(runs, animation, dark))


def _model(path: Path | None, preset: str | None, logs: Sequence[Path]) -> Model:
    """The model to compare: a file's, or the preset on the rover that the first log names.

    Logs with imposed wheel speeds are of rovers that drove on Earth: they begin with a hard, level floor.
    """
    from lunar_mjx.logs import Log, read_campaign
    from lunar_mjx.model import make_model
    from lunar_mjx.model.file import load_model
    from lunar_mjx.model.hard_floor import hard_floor

    if path is not None:
        return load_model(path)
    # A run compares one model, so that its logs are of one rover: the first speaks for all.
    first = read_campaign(logs)[0]
    if isinstance(first, Log) and first.imposed is not None and preset is None:
        return hard_floor(first.rover, first.gravity_m_s2)
    # A table names a wheel and no rover: any rover's soil and wheel effects serve to compare it.
    rover = first.rover if isinstance(first, Log) else "luvmi_x"
    return make_model(rover, terrain="flat", preset="consistent" if preset is None else preset)


def _require_imposed(option: str, given: Sequence[str] | None, logs: Sequence[Path]) -> None:
    """Raises `UserError` for what only fits of drives with imposed wheel speeds look at."""
    from lunar_mjx.logs import Log, read_campaign

    if given and not any(isinstance(log, Log) and log.imposed is not None for log in read_campaign(logs)):
        remedy = "leave it out, or state imposed in log.toml"
        raise bad_input("compare", option, given[0], "is for logs with imposed wheel speeds", remedy)


def _with_priors(model: Model, prior: Sequence[str] | None, fix: Sequence[str] | None) -> Model:
    """The model with what `--prior` and `--fix` say of its parameters and instruments, in physical units."""
    from lunar_mjx.diagnosis.drives.windows.coordinates import with_knowledge

    known = {}
    for name, text in _pairs("--prior", prior).items():
        value, mark, std = text.partition("+-")
        known[name] = (
            _number("--prior", f"{name}={text}", value),
            _number("--prior", f"{name}={text}", std if mark else ""),
        )
    for name, value in _numbers("--fix", fix).items():
        # Known without error is held: a standard deviation of zero takes it out of the fit.
        known[name] = (value, 0.0)
    return with_knowledge(model, known)


def _number(option: str, given: str, text: str) -> float:
    try:
        return float(plain_digits(text))
    except ValueError:
        raise bad_input("lunar-mjx", option, given, "is not NAME=VALUE+-STD", "give two numbers") from None


def _pairs(option: str, given: Sequence[str] | None) -> dict[str, str]:
    out = {}
    for item in given or ():
        # From the right, since a log's name may hold an equals sign itself.
        name, mark, value = item.rpartition("=")
        if not mark or not name:
            raise bad_input("lunar-mjx", option, item, "is not NAME=VALUE", "give both")
        if name in out:
            raise bad_input("lunar-mjx", option, item, f"gives {name} twice", "give it once")
        out[name] = value
    # Checked here, where the option can be named; a run folder would only say that it holds an unknown split.
    for value in out.values() if option == "--split" else ():
        if value not in ("fit", "select", "test", "apart"):
            raise bad_input("lunar-mjx", option, value, "is no split", "use fit, select, test or apart")
    return out


def _numbers(option: str, given: Sequence[str] | None) -> dict[str, float]:
    out = {}
    for name, value in _pairs(option, given).items():
        try:
            out[name] = float(plain_digits(value))
        except ValueError:
            raise bad_input("lunar-mjx", option, f"{name}={value}", "is not a number", "give a number") from None
    return out


def _print_comparison(run: Any) -> None:
    from lunar_mjx.diagnosis.runs import COMPARISON_FILE
    from lunar_mjx.model.describe import make_console, make_table

    found = run.load(COMPARISON_FILE)
    console = make_console()
    table = make_table("error in sigma", *found["refitted"])
    for label in ("as_given", "refitted"):
        table.add_row(label.replace("_", " "), *(_shown(found[label].get(k)) for k in found["refitted"]))
    console.print(table)
    if found.get("unused"):
        console.print(found["unused"], highlight=False)
    # Eight rows fit a screen; `comparison.json` has all.
    worst = sorted(found["by_channel"], key=lambda row: -(row["refitted"] or 0.0))[:8]
    table = make_table("manoeuvre", "split", "channel", "as given", "refitted")
    for row in worst:
        table.add_row(row["manoeuvre"], row["split"], row["channel"], _shown(row["as_given"]), _shown(row["refitted"]))
    console.print(table)
    if found.get("not_told"):
        console.print(f"These logs hardly tell {', '.join(found['not_told'])}.", highlight=False)
    if "windows" in found:
        used = found["windows"]
        console.print(
            f"{used['used']} of {used['of']} windows of {used['seconds']:g} s were used (windows.json).",
            highlight=False,
        )
    if "certificate" in found:
        problems = found["certificate"]["problems"]
        console.print("Certificate of the fit: " + ("; ".join(problems) if problems else "complete"), highlight=False)
    if remains := found.get("discrepancy"):
        console.print("The model as refitted: " + "; ".join(d["text"] for d in remains.values()), highlight=False)
    console.print(f"{run.folder}", highlight=False)


def _print_steps(runs: Sequence[Run]) -> None:
    """What every round added and how probable that was, the error that it left, and what was said then."""
    from lunar_mjx.diagnosis.runs import COMPARISON_FILE, VERDICT_FILE
    from lunar_mjx.model.describe import make_console

    console, before, foreseen = make_console(), 0, float("inf")
    probability: dict[str, float] = {}
    for run in runs:
        error = (run.load(COMPARISON_FILE) or {}).get("refitted", {})
        said = run.load(VERDICT_FILE) or {}
        left = ", ".join(f"{split} {_shown(value)}" for split, value in error.items())
        new = [f"{n} ({probability[n]:.0%})" if n in probability else n for n in run.added[before:]]
        added = ", ".join(new) or "the model as given"
        # `added` grows from run to run: what stands behind the last run's is what this one added.
        before = len(run.added)
        probability = {**(said.get("inclusion") or {}), **(said.get("forms") or {})}
        console.print(f"{run.folder.name}: {added}; sigma after a refit: {left}", style="bold", highlight=False)
        held_out = error.get("held_out")
        if held_out is not None:
            if held_out > foreseen:
                console.print(
                    "  By itself it foresees what was held out worse than the model before: "
                    f"{_shown(held_out)} in place of {_shown(foreseen)} sigma.",
                    highlight=False,
                )
            # Against the run before and not the best so far: the line tells what the last step did.
            foreseen = held_out
        if said:
            console.print(f"  {said.get('verdict')}: {said.get('sentence')}", highlight=False)
        for refusal in (said.get("details") or {}).get("taken_back") or []:
            # A verdict tells of all laws that were taken back so far; a step only of those tried after it.
            if refusal["run"] == run.folder.name:
                console.print(f"  {refusal['sentence']}", highlight=False)


def _shown(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def _finish(diagnosis: Diagnosis, as_json: bool) -> NoReturn:
    """Prints a diagnosis and ends with its exit status."""
    from lunar_mjx.diagnosis.runs import plain
    from lunar_mjx.model.describe import make_console

    if as_json:
        print(json.dumps(plain(diagnosis.to_dict()), indent=1))
        raise typer.Exit(diagnosis.verdict.exit_status)
    console = make_console()
    effects = f" {', '.join(diagnosis.effects)}" if diagnosis.effects else ""
    console.print(f"{diagnosis.verdict.label}{effects}", style="bold", highlight=False)
    console.print(diagnosis.sentence, highlight=False)
    tested = [e for e in diagnosis.evidence if e.status != "not tested"]
    if diagnosis.probabilities:
        print_probabilities(diagnosis, console)
    for e in tested:
        # Values of what is nearly excluded would be read as findings.
        if e.values and (not diagnosis.probabilities or e.probability >= WORTH_PRINTING):
            fitted = ", ".join(f"{k} {v:.3g} +- {e.std.get(k, 0.0):.1g}" for k, v in e.values.items())
            near = f"; nearest {e.nearest[0]}, cosine {e.nearest[1]:.2f}" if e.nearest[0] else ""
            console.print(f"fitted {e.effect}: {fitted}{near}", highlight=False)
    if untested := [e.effect for e in diagnosis.evidence if e.status == "not tested"]:
        console.print(f"not tested, no separable signal here: {', '.join(untested)}", highlight=False)
    for finding in diagnosis.details.get("findings", [])[:20]:
        console.print(f"  {finding['message']}", highlight=False)
    raise typer.Exit(diagnosis.verdict.exit_status)


WORTH_PRINTING = 0.005
"""Probability below which a hypothesis is left to the JSON."""


def print_probabilities(diagnosis: Diagnosis, console: Any) -> None:
    """Prints hypotheses with their probabilities, what remains by port, and what held-out groups gain."""
    from lunar_mjx.model.describe import make_table

    table = make_table("hypothesis", "probability", names=0)
    for name, p in diagnosis.probabilities.items():
        if p >= WORTH_PRINTING:
            table.add_row(name, f"{p:.3f}")
    console.print(table)
    if len(diagnosis.forms) > 1:
        console.print("Contact law: " + ", ".join(f"{n} {p:.3f}" for n, p in diagnosis.forms.items()), highlight=False)
    for refusal in diagnosis.details.get("taken_back", []):
        console.print(refusal["sentence"], highlight=False)
    remains = "; ".join(
        f"{d['text']} ({100.0 * d['low']:.2g} to {100.0 * d['high']:.2g} %)" for d in diagnosis.discrepancy.values()
    )
    console.print(f"What remains, by port: {remains}", highlight=False)
    held = diagnosis.details.get("held_out", {})
    if count := held.get("manoeuvres"):
        # one group alone has no spread
        spread = f" +- {held['se']:.1f}" if count > 1 else ""
        console.print(
            f"Held out: log predictive density {held['gain']:+.1f}{spread} over the model as it is "
            f"({count} group{'s' if count > 1 else ''} that chose nothing)",
            highlight=False,
        )


def _write_report(runs: Sequence[Path], out: Path) -> None:
    from lunar_mjx.diagnosis.report import write_report
    from lunar_mjx.diagnosis.runs import RUN_FILE

    for run in runs:
        if not (run / RUN_FILE).is_file():
            raise UserError(f"{run}: is no run folder; make one with lunar-mjx compare.")
    write_report(runs, out)
