"""Tables of the report: effects, parameters, runs, provenance."""

from __future__ import annotations

import platform
from collections import Counter
from collections.abc import Sequence
from importlib import metadata
from typing import Any

from lunar_mjx._version import __version__
from lunar_mjx.diagnosis.report.read import Result
from lunar_mjx.diagnosis.report.steps import Error, Step
from lunar_mjx.diagnosis.report.words import SPLIT_NAMES, channel_label, percent, port_label, shown, sigmas
from lunar_mjx.inference.coordinates import FACTOR_UNIT, NUISANCE
from lunar_mjx.model.describe import by_group
from lunar_mjx.report.page import Block, Facts, Table, Text

_MOST_ROWS = 30
"""Channels and manoeuvres that a page lists at most, the worst first."""


def plus_minus(value: Any, std: Any) -> str:
    """A value with its standard deviation."""
    text = shown(value)
    if std is not None:
        stem, _, power = text.partition("e")
        # both in the same power of ten: 2.00e+05 ± 60000 is hard to read
        text = f"({stem} ± {shown(std / 10.0 ** int(power), 2)})e{power}" if power else f"{text} ± {shown(std, 2)}"
    return text


def error_rows(steps: Sequence[Step], judged: Sequence[Error], fitted: Sequence[Error | None], measure: str) -> Table:
    """Table of every model's error and interval on the judged and the fitted splits, as the waterfall draws them."""
    rows = []
    for i, (step, step_error, fit) in enumerate(zip(steps, judged, fitted, strict=True)):
        change = "" if i == 0 else f"{100.0 * (step_error.value / judged[i - 1].value - 1.0):+.0f} %"
        rows.append(
            [step.label, step.run, _with_interval(step_error), change, _with_interval(fit), str(step_error.blocks)]
        )
    note = (
        "95 % intervals by a bootstrap over blocks of at least five correlation times (of neighbouring points in "
        "tables); the last column counts the blocks."
    )
    header = ["model", "run", f"{measure}, sigma", "change", "fitted, sigma", "blocks"]
    return Table("Error of each model in numbers", header, rows, note, texts=2, folded=True)


def _with_interval(e: Error | None) -> str:
    if e is None:
        return "-"
    return f"{sigmas(e.value)} ({sigmas(e.low)} to {sigmas(e.high)})"


LISTED = 0.001
"""Probability from which a hypothesis has a row of its own."""


def hypotheses(result: Result) -> list[Block]:
    """Probabilities of the hypotheses, and what remains at every port; nothing where hypotheses were not weighed."""
    verdict = result.verdict or {}
    blocks: list[Block] = []
    if listed := verdict.get("probabilities"):
        rows = [[name, percent(p)] for name, p in listed.items() if p >= LISTED]
        # Dozens of hypotheses below a thousandth would bury the few that are weighed against each other.
        rest = sum(p for p in listed.values() if p < LISTED)
        rows += [[f"{len(listed) - len(rows)} others together", percent(rest)]] if len(rows) < len(listed) else []
        note = (
            "Probabilities of all hypotheses that were weighed, together 1. Discrepancy of usual size at every port, "
            "calibration errors of usual size and the noise's uncertain size belong to each of them."
        )
        blocks.append(Table("Hypotheses", ["hypothesis", "probability"], rows, note, texts=1))
    if len(forms := verdict.get("forms") or {}) > 1:
        rows = [[name, percent(p)] for name, p in forms.items()]
        blocks.append(Table("Contact laws", ["law", "probability"], rows, texts=1))
    if remains := verdict.get("discrepancy"):
        rows = [
            [port_label(port), str(d["text"]), f"{100.0 * d['low']:.2g} to {100.0 * d['high']:.2g} %"]
            for port, d in remains.items()
        ]
        note = "Size of the smooth error that remains in the model at each port, with its 68 % range."
        blocks.append(Table("What remains", ["port", "the model is", "range"], rows, note, texts=2))
    held = (verdict.get("details") or {}).get("held_out") or {}
    groups = held.get("manoeuvres")
    if groups and held["gain"]:  # exactly zero where no refit was held against them
        gain = plus_minus(abs(held["gain"]), held["se"] if groups > 1 else None)
        where = "above" if held["gain"] > 0.0 else "below"
        text = (
            f"On {groups} group{'s' if groups > 1 else ''} that chose nothing, the log predictive density of the best "
            f"hypothesis is {gain} {where} that of the model as it is."
        )
        blocks.append(Text([text]))
    return blocks


def effects(result: Result) -> list[Block]:
    """What the logs say for and against every effect of the catalogue; nothing where no hypotheses were weighed."""
    verdict = result.verdict or {}
    rows = []
    for e in verdict.get("evidence") or []:
        near = e.get("nearest") or ("", 0.0)
        values = "; ".join(
            f"{k} {plus_minus(v, (e.get('std') or {}).get(k))}" for k, v in (e.get("values") or {}).items()
        )
        untested = e.get("status") == "not tested"
        rows.append(
            [
                e["effect"],
                "not testable" if untested else percent(e.get("probability") or 0.0),
                shown(e.get("separable_sigma")),
                "-" if untested else values or "-",
                f"{near[0]} ({near[1]:.2f})" if near[0] else "-",
            ]
        )
    if not rows:
        return []
    note = (
        "Probability: that the effect is missing, whatever else is. Would show: length of its signature at its usual "
        "size that a refit of the model cannot absorb. Not testable: these logs hold no trace of it. Parameters with "
        "one standard deviation, SI units."
    )
    header = ["effect", "probability", "would show, sigma", "parameters, SI", "nearest confounder (|cos|)"]
    return [Table("Every effect of the catalogue", header, rows, note, texts=2, folded=True)]


def parameters(first: Result, last: Result) -> list[Block]:
    """Baseline parameters before and after, with the bias that the missing effects had caused; then the instruments'.

    Of a single run that proposes nothing there is no after.
    """
    before = (first.comparison or {}).get("parameters") or {}
    proposed = ((last.verdict or {}).get("details") or {}).get("parameters")
    after = proposed or (last.comparison or {}).get("parameters") or {}
    rows: list[list[str]] = []
    instruments: list[list[str]] = []
    still: list[str] = []
    for effect, parameters_of in {**before, **after}.items():
        old, new = before.get(effect) or {}, after.get(effect) or {}
        for name in parameters_of.get("value") or {}:
            a, b = ((t.get("value") or {}).get(name) for t in (old, new))
            sa, sb = ((t.get("std") or {}).get(name) for t in (old, new))
            unit = (parameters_of.get("unit") or {}).get(name, "")
            given = (old.get("given") or {}).get(name)
            # Dozens of parameters that no fit has moved would hide those that took up what was missing.
            if given is not None and a is not None and b is not None and all(_alike(given, v) for v in (a, b)):
                still.append(f"{effect}.{name}")
                continue
            strength = shown(abs(a - b) / sa, 2) if a is not None and b is not None and a != b and sa else "-"
            for label, own, last_size in _sizes(first, last, effect, name, unit):
                # values before are in units of the first run's model, values after in those of the last one's
                (g, a_, sa_), (b_, sb_) = _scaled(own, given, a, sa), _scaled(last_size, b, sb)
                bias = "-"
                if a_ is not None and b_ is not None and a != b:
                    bias = shown(a_ - b_) + (f" ({100.0 * (a_ / b_ - 1.0):+.0f} %)" if b_ else "")
                unit_ = _unit(first, last, effect, name, unit)
                table = instruments if effect == NUISANCE else rows
                table.append([label, unit_, shown(g), plus_minus(a_, sa_), plus_minus(b_, sb_), bias, strength])
    unmoved = [Text([f"Left as given by both fits: {', '.join(still)}."])] if still else []
    blocks: list[Block] = []
    note = (
        "Bias: the refitted value before less the value with the effects named, that is, what the parameter had taken "
        "up for the missing physics; the last column is its size in standard deviations of the value before. "
        + _DEVIATIONS
    )
    header = ["parameter", "unit", "as given", "refitted, before", "with the effects", "bias before", "bias, std"]
    title, width = "Parameters before and after", len(header)
    if first is last and not proposed:
        header, title, note, width = ["parameter", "unit", "as given", "refitted"], "Parameters", _DEVIATIONS, 4
    if rows:
        blocks.append(Table(title, header, [row[:width] for row in rows], note, texts=2))
    blocks += unmoved
    if instruments:
        title = "Starts of the logs and errors of their instruments, fitted with the parameters, in SI units"
        blocks.append(Table(title, header, [row[:width] for row in instruments], texts=2, folded=True))
    return blocks


_DEVIATIONS = (
    "Standard deviations are those of the noise alone: while the residual is above the noise they are too small."
)


_STILL = 1e-9
"""Relative change of a parameter up to which a fit has not moved it: what rounding leaves."""


def _alike(given: float, fitted: float) -> bool:
    return abs(fitted - given) <= _STILL * abs(given)


def _scaled(own: float, *values: float | None) -> list[float | None]:
    return [None if v is None else own * v for v in values]


def _unit(first: Result, last: Result, effect: str, name: str, unit: str) -> str:
    """Unit of a parameter; of one that is fitted as a common factor, the unit of the values that it multiplies."""
    if unit != FACTOR_UNIT:
        return "" if unit == "1" else unit
    model = last.model or first.model
    known = {e.name: e for e in model.effects} if model else {}
    if effect not in known:
        return "times the model's own"
    found = known[effect].parameters[name].unit
    return "" if found == "1" else found


def _sizes(first: Result, last: Result, effect: str, name: str, unit: str) -> list[tuple[str, float, float]]:
    """Rows of a parameter: label, and what its values in the first and in the last run are to be multiplied with.

    A factor on values that differ between wheels or joints gives a row for each group of them that agree.
    """
    label = f"{effect}.{name}"
    if unit != FACTOR_UNIT:
        return [(label, 1.0, 1.0)]
    owns = []
    for result in (first, last):
        model = result.model
        value = (model.parameters.get(effect) or {}).get(name) if model else None
        owns.append(None if value is None else value if isinstance(value, tuple) else (value,))
    before, after = (own or other for own, other in ((owns[0], owns[1]), (owns[1], owns[0])))
    model = last.model or first.model
    if model is None or not before or not after or len(before) != len(after):
        return [(label, 1.0, 1.0)]
    groups = by_group(list(zip(before, after, strict=True)), model)
    return [(f"{label} ({group})" if group else label, *pair) for group, pair in groups]


def by_channel(result: Result) -> list[Block]:
    """The worst channels and manoeuvres in numbers."""
    rows = (result.comparison or {}).get("by_channel") or []
    worst = sorted(rows, key=lambda r: -(r.get("refitted") or 0.0))[:_MOST_ROWS]
    if not worst:
        return []
    return [
        Table(
            f"Worst channels and manoeuvres of {result.name}, root mean square residual in sigma",
            ["manoeuvre", "split", "channel", "samples", "as given", "refitted"],
            [
                [
                    str(r["manoeuvre"]),
                    str(SPLIT_NAMES.get(r["split"], r["split"])),
                    channel_label(r["channel"]),
                    str(r["samples"]),
                    sigmas(r["as_given"]),
                    sigmas(r["refitted"]),
                ]
                for r in worst
            ],
            f"The {len(worst)} worst of {len(rows)}." if len(rows) > len(worst) else "",
            texts=3,
            folded=True,
        )
    ]


def findings(result: Result) -> list[Block]:
    """What is wrong with the logs."""
    found = ((result.verdict or {}).get("details") or {}).get("findings") or []
    rows = [[str(f.get("severity", "")), str(f.get("where", "")), str(f.get("message", ""))] for f in found]
    return [Table("Findings of the gate", ["severity", "where", "finding"], rows, texts=3)] if rows else []


def provenance(results: Sequence[Result]) -> list[Block]:
    """Hashes, seeds, versions, splits, and how often the test split was opened."""
    blocks: list[Block] = []
    rows = []
    for r in results:
        for path, digest in (r.run.get("hashes") or {}).items():
            rows.append([r.name, path, str(digest)])
    blocks.append(Table("Logs, by SHA-256 over their files", ["run", "log", "SHA-256"], rows, texts=3))
    rows = []
    for r in results:
        test = (r.comparison or {}).get("certificate") or {}
        chosen = ", ".join(f"{k} = {v}" for k, v in (r.run.get("splits") or {}).items()) or "none"
        problems = "; ".join(test.get("problems") or []) or ("complete" if test else "-")
        added = ", ".join(r.run.get("added") or []) or "-"
        rows.append([r.name, str(r.run.get("version")), str(r.run.get("seed")), added, chosen, problems])
    header = ["run", "version", "seed", "effects added", "splits by the user", "certificate of the fit"]
    if all(row[-1] == "-" for row in rows):  # steady tables have none
        header, rows = header[:-1], [row[:-1] for row in rows]
    blocks.append(Table("Runs", header, rows, texts=len(header)))
    blocks += [*_splits(results[-1]), *_openings(results)]
    versions = [(name, metadata.version(name)) for name in ("jax", "mujoco", "numpy", "scipy", "plotly")]
    blocks.append(Facts([("report by lunar-mjx", __version__), *versions, ("Python", platform.python_version())]))
    return blocks


def _splits(result: Result) -> list[Block]:
    if result.traces is None:
        return []
    o = result.traces.observations
    groups: dict[str, list[str]] = {}
    for name, split in zip(o.unit_names, o.unit_split, strict=True):
        groups.setdefault(split, []).append(name)
    rows = [[SPLIT_NAMES.get(k, k), str(int(o.in_split(k).sum())), ", ".join(v)] for k, v in groups.items()]
    header = ["split", "observations", "manoeuvres or groups of points"]
    return [Table("Splits", header, rows, _who_split(result, o.unit_names), texts=3)]


def _who_split(result: Result, units: Sequence[str]) -> str:
    """Who decided which manoeuvres are held out: the user, the logs, or the default rule."""
    own = [u for u in units if u in (result.run.get("splits") or {})]
    stated = (result.comparison or {}).get("log_splits") or {}
    parts = []
    if stated:
        listed = ", ".join(f"{log} ({SPLIT_NAMES.get(split, split)})" for log, split in stated.items())
        parts.append(f"Stated by the logs themselves: {listed}.")
    if own:
        parts.append(f"Chosen by the user with --split: {', '.join(own)}.")
    if not stated and not own:
        parts.append("By the default rule: no log states a split, and none was chosen with --split.")
    elif len(own) < len(units) and result.traces is not None and len(stated) < len(result.traces.observations.logs):
        parts.append("The others by the default rule.")
    return " ".join(parts)


def _openings(results: Sequence[Result]) -> list[Block]:
    rows = []
    for r in results:
        seen: dict[str, Counter[str]] = {}
        for entry in r.run.get("test_opened") or []:
            seen.setdefault(str(entry.get("model")), Counter())[str(entry.get("fit"))] += 1
        for model, fits in seen.items():
            times = len(fits)
            rows.append(
                [
                    r.name,
                    model,
                    str(times),
                    str(sum(fits.values())),
                    "once" if times == 1 else f"reopened {times - 1} time{'s' if times > 2 else ''}",
                ]
            )
    if not rows:
        text = "No error on a test split was computed: these runs keep none, or were made before that was recorded."
        return [Text([text])]
    header = ["run", "model", "fits judged", "times computed", "test split opened"]
    note = "Every further fit of the same model that is judged on the test split reopens it."
    return [Table("Openings of the test split", header, rows, note, texts=2)]
