"""The parity page: tables and plots of every pair of engines."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import plotly.graph_objects as go

from lunar_mjx.backends.parity.cases import DRIVE_EXCEPTIONS, EXCEPTIONS, QUANTITIES, RELATIVE, SOFT_STEP
from lunar_mjx.backends.parity.compare import first_failure, traces
from lunar_mjx.backends.parity.record import RECORDING
from lunar_mjx.backends.parity.study import Pair, Study
from lunar_mjx.files import write_text
from lunar_mjx.report import Figure, Section, Table, Text, write_page
from lunar_mjx.report.style import INK, SERIES, VERMILION, finish

LEVELS = {1: "one state, stage by stage", 2: "one step", 3: "drive"}


def write_parity_page(path: Path, studies: Sequence[Study], note: str = "") -> Path:
    """Writes the page and, beside it, its numbers as JSON.

    Args:
      path: of the HTML file. studies: one per rover and preset. note: a sentence on what was left out.

    Returns:
      The path.
    """
    sections = [Section("What is compared", [Text(_method(studies[0]))])]
    for study in studies:
        for pair in study.pairs:
            title = f"{study.model.rover.name}, {study.model.preset}: {pair.first} and {pair.second}"
            blocks = [
                Text([verdict(study, pair)]),
                Figure(_errors(pair), "Largest normalised error by quantity."),
                Figure(_drift(study, pair), "Distance between the two rovers along the drive."),
                _table(pair),
            ]
            sections.append(Section(title, blocks))
    sentences = [verdict(study, pair) for study in studies for pair in study.pairs] + ([note] if note else [])
    numbers = [
        {
            "rover": s.model.rover.name,
            "preset": s.model.preset,
            "first": p.first,
            "second": p.second,
            "kind": p.kind,
            "judged": p.judged,
            "results": [{**vars(r), "passed": r.passed} for r in p.results],
        }
        for s in studies
        for p in s.pairs
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path.with_suffix(".json"), json.dumps(numbers, indent=1) + "\n")
    return write_page(path, "Parity of the engines", sentences, sections)


def verdict(study: Study, pair: Pair) -> str:
    """One sentence: do they agree, and if not, where they part."""
    who = f"{study.model.rover.name}, {study.model.preset}: {pair.first} and {pair.second}"
    worst = max(pair.results, key=lambda r: r.error)
    apart = max((r for r in pair.results if r.level == 3 and r.quantity == "position"), key=lambda r: r.difference)
    distance = f"{apart.difference:.2g} m apart at most along the drives ({apart.case})"
    if not pair.judged:
        hard = max((r for r in pair.results if r.quantity == "wheel_force"), key=lambda r: r.difference)
        return (
            f"{who} differ by nature where Bullet bears the wheels: up to {hard.difference:.2g} N in the wheel force "
            f"of one state ({hard.case}), {distance}."
        )
    if not pair.failed:
        return (
            f"{who} agree in all {len(pair.results)} checks; the largest error is {worst.error:.2g} of its tolerance "
            f"({worst.quantity}, {worst.case}), {distance}."
        )
    # Stages depend on those before them: the first that fails is where to look, and not the worst.
    first = first_failure(pair.results) or max(pair.failed, key=lambda r: r.error)
    return (
        f"{who} disagree in {len(pair.failed)} of {len(pair.results)} checks, first in the stage {first.stage} "
        f"({first.quantity}, {first.where}, {first.case}: {first.error:.3g} times its tolerance)."
    )


def _method(study: Study) -> list[str]:
    grounds = "; ".join(c.name for c in study.grounds)
    kinds = ", ".join(f"{k} {v:g}" for k, v in RELATIVE.items())
    but = "; ".join(f"{k}: {', '.join(f'{q} {v:g}' for q, v in own.items())}" for k, own in EXCEPTIONS.items())
    apart = "; ".join(f"{k}: {', '.join(f'{q} {v:g}' for q, v in own.items())}" for k, own in DRIVE_EXCEPTIONS.items())
    loops = ", ".join(f"{q} {v:g}" for q, v in SOFT_STEP.items())
    shares = ", ".join(f"{c:g}" for c in RECORDING.compliance)
    return [
        "Native MuJoCo (C, float64) with forces computed in NumPy from the equations is the reference. Level 1 "
        "evaluates one state stage by stage, level 2 makes one step, both from states recorded along the reference's "
        "drive; level 3 lets every engine drive for itself.",
        "An error is |a - b|/(atol + rtol |a|); above 1 the engines disagree. rtol by what separates the engines: "
        f"{kinds} (with exceptions, {but}), ten times that for drives (there {apart}); atol is rtol times the "
        "quantity's typical size.",
        "Drives may also depart by ten times the noise floor. That is the farthest of the reference's own drives, once "
        f"with coordinates rounded to float32 at the start, and {RECORDING.runs_double} times with coordinates and "
        f"speeds moved by chance within {RECORDING.spread:g} units in the last place of float64 after every step; "
        f"where an engine holds coordinates in float32, or is PyBullet, also {RECORDING.runs_single} times in "
        "float32's last place, which makes the "
        "sinkage err as it was measured to err in float32, by 4e-8 m. A slip of 2 and one of -2 are the same.",
        "MuJoCo's loops give way by a micrometre. Engines that close them exactly are compared with it from states "
        "whose loops are closed: there every stage before the acceleration must agree as if there were no loop, and "
        f"then with rtol {loops}. Their drives' noise floor also has the reference with {shares} times its loops' "
        "compliance, and damped within the loops, as the other engines damp.",
        "Errors of every step matter where the rover stands and its law of friction has no rest: with the preset paper "
        "the wheels chatter by some mm/s, and every rounding grows until the drive begins.",
        "PyBullet's poses and forces of one state agree to rounding; it integrates about the chassis' centre of mass, "
        "which moves the chassis' frame by up to 6e-10 m a step.",
        f"Grounds: {grounds}.",
    ]


def _errors(pair: Pair) -> go.Figure:
    figure = go.Figure()
    for k, name in enumerate(dict.fromkeys(r.case for r in pair.results)):
        own = [r for r in pair.results if r.case == name]
        style = SERIES[k % len(SERIES)]
        labels = [f"{r.level}  {r.quantity}" for r in own]
        figure.add_scatter(
            # Engines may agree to the bit, and zero has no place on a logarithmic axis.
            x=[max(r.error, 1e-12) for r in own],
            y=labels,
            mode="markers",
            name=name,
            marker={"color": style.colour, "symbol": style.symbol, "size": 8},
        )
    figure.add_vline(x=1.0, line={"color": VERMILION if pair.judged else INK, "dash": "dash"})
    finish(figure, 720, margin={"l": 190, "r": 16, "t": 60, "b": 52})
    figure.update_xaxes(title_text="largest error over its tolerance", type="log", exponentformat="power")
    figure.update_yaxes(title_text="level and quantity", autorange="reversed")
    return figure


def _drift(study: Study, pair: Pair) -> go.Figure:
    figure = go.Figure()
    for k, case in enumerate(study.grounds):
        a, b = (traces(study.runs[name].drives[case.name]) for name in (pair.first, pair.second))
        floor = study.floor(pair, case.name)
        exact, *perturbed = (traces(floor, i)["position"] for i in range(len(floor.time)))
        style = SERIES[k % len(SERIES)]
        apart = np.linalg.norm(a["position"] - b["position"], axis=-1)
        noise = np.max([np.linalg.norm(exact - n, axis=-1) for n in perturbed], axis=0)
        for name, value, dash in ((case.name, apart, "solid"), ("noise floor", noise, "dot")):
            distance = np.maximum(value, 1e-18)
            figure.add_scatter(
                x=a["time"].round(3),
                y=distance,
                mode="lines",
                legendgroup=case.name,
                name=name if name != "noise floor" else f"{case.name}, noise floor",
                line={"color": style.colour, "dash": dash, "width": 2 if dash == "solid" else 1},
                showlegend=dash == "solid",
            )
    finish(figure, 420, margin={"l": 84, "r": 16, "t": 60, "b": 52})
    figure.update_xaxes(title_text="time, s")
    figure.update_yaxes(title_text="distance, m (dotted: noise floor)", type="log", exponentformat="power")
    return figure


def _table(pair: Pair) -> Table:
    names = list(dict.fromkeys(r.case for r in pair.results))
    by = {(r.case, r.level, r.stage, r.quantity): r for r in pair.results}
    rows = []
    for level, stage, quantity in dict.fromkeys((r.level, r.stage, r.quantity) for r in pair.results):
        own = [by[(name, level, stage, quantity)] for name in names]
        largest = max(own, key=lambda r: r.difference)
        shown = f"{largest.difference:.2g} {QUANTITIES[quantity][0]}"
        rows.append([f"{level}: {LEVELS[level]}", stage, quantity, shown, *(f"{r.error:.2g}" for r in own)])
    return Table(
        "Largest difference, and error over tolerance by ground.",
        ["level", "stage", "quantity", "largest difference", *names],
        rows,
        texts=3,
    )
