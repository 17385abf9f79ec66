"""The studio: one offline page on a run, to choose effects, see the error fall, and see where the model fails."""

from __future__ import annotations

import base64
import dataclasses
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import plotly.offline

from lunar_mjx.diagnosis.folder.refits import read_refits
from lunar_mjx.diagnosis.report.explore import broken, cells, covariate_along
from lunar_mjx.diagnosis.report.lead import lead
from lunar_mjx.diagnosis.report.read import Result, Traces, read_result
from lunar_mjx.diagnosis.report.reasons import reason
from lunar_mjx.diagnosis.report.words import SPLIT_NAMES, and_list, channel_label, kind_label, plot_text
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError
from lunar_mjx.files import write_text
from lunar_mjx.report.page import PLOT_CONFIG, packed
from lunar_mjx.report.style import BLUE, DARK_FIGURES, FONT, INK, MUTED, ORANGE, PAPER, RULE, SHADES


@dataclasses.dataclass(frozen=True)
class StudioSizes:
    """How much a studio holds."""

    most_values: int = 2_000_000
    """Numbers in all traces of a page, about a byte each; longer series are thinned."""
    # Steps that a trace is rounded to, within its range and between readings: a reader may zoom in twentyfold.
    levels: int = 10_000
    levels_of_residual: int = 2_000
    levels_of_time: int = 20
    most_rows: int = 24
    """Channels that have a row each in the heat map; more are folded by kind."""
    most_models: int = 14
    """Models to choose from: as many buttons as a reader looks through."""
    most_map: int = 2_000
    """Points of the map."""


STUDIO_SIZES = StudioSizes()

_STYLE = {
    "font": FONT,
    "ink": INK,
    "muted": MUTED,
    "rule": RULE,
    "paper": PAPER,
    "blue": BLUE,
    "orange": ORANGE,
    "dark": DARK_FIGURES,
    "shades": [colour for _, colour in SHADES],
}
"""What the figures of the page look like."""
_MISSING = -(2**40)
"""Stands for no number in a coded trace."""
_LARGEST = 1e200
"""Above it a number is none: differences and steps of what a damaged run may hold would overflow."""
_REST = "others"
"""Name of the hypotheses that are not listed one by one."""


@dataclasses.dataclass(frozen=True, eq=False)
class _Model:
    """A model that the reader may choose.

    Attributes:
      label: for the reader. effects: added to the refitted model. kind: "given", "refit" or "estimate".
      residual: (n,) in sigma, NaN where not known. predicted: (n,), None where not known.
    """

    label: str
    effects: tuple[str, ...]
    kind: str
    residual: np.ndarray
    predicted: np.ndarray | None


def write_studio(run: str | Path, out: str | Path) -> Path:
    """Writes the studio of a run as one HTML file that asks no network for anything.

    Errors with an effect are those of refits that the run folder holds. Where it holds none, they are estimates to
    first order on fitted manoeuvres: what the best amount of the effect's stored signature leaves.

    Args:
      run: the run folder. Nothing in it is run as code, and all text from it is shown as text.
      out: the HTML file.

    Returns:
      Its path.

    Raises:
      UserError: the folder is no run, holds no comparison yet, or one of its files is damaged.
    """
    result = read_result(Path(run))
    if result.traces is None:
        raise UserError(f"{run}: holds no series.npz yet; make it with lunar-mjx compare, then lunar-mjx why.")
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("lunar_mjx.report", "templates"), autoescape=True, undefined=jinja2.StrictUndefined
    )
    program = environment.get_template("studio.js").render()
    plotly = plotly_text()
    html = environment.get_template("studio.html.j2").render(
        title=f"Studio: {result.name}",
        lead=lead([result], result),
        program=program,
        # By their digests, no other script can run in the page, whatever the texts of a run hold.
        allowed=" ".join(f"'sha256-{_digest(text)}'" for text in (program, plotly)),
        data=packed(json.dumps(_page_data(result, result.traces), allow_nan=False, separators=(",", ":"))),
        plotly=packed(plotly),
    )
    path = Path(out)
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_text(path, html)


def plotly_text() -> str:
    """plotly.js as it is put into pages."""
    return plotly.offline.get_plotlyjs()


def _digest(script: str) -> str:
    return base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")


def _page_data(result: Result, traces: Traces) -> dict[str, Any]:
    o = traces.observations
    models = _models(result, traces)
    shown_cells = {(c, u): at for c, u, at in cells(o) if np.isfinite(models[0].residual[at]).any()}
    channels = list(dict.fromkeys(c for c, _ in shown_cells))
    units = sorted({u for _, u in shown_cells})
    # Every model draws a prediction and a residual beside the measurement: the page grows with their number.
    said = [i for i, m in enumerate(models) if m.predicted is not None]
    most = _share([len(at) for at in shown_cells.values()], STUDIO_SIZES.most_values // (2 + len(said) + len(models)))
    held = o.in_split("select", "test")
    fitted = o.in_split("fit")
    verdict = result.verdict or {}
    # Effects are judged against the refitted model: against the one as given they would earn what a refit gives for
    # nothing.
    base = next((i for i, m in enumerate(models) if m.kind == "refit"), 0)
    grid = [[shown_cells.get((c, u)) for u in units] for c in channels]
    residual = models[base].residual
    remains = [(k, d) for k, d in (verdict.get("discrepancy") or {}).items() if isinstance(d, Mapping)]
    return {
        "table": traces.is_table,
        "style": _STYLE,
        "config": PLOT_CONFIG,
        "channels": [channel_label(c)[:60] for c in channels],
        "many": len(channels) > STUDIO_SIZES.most_rows,
        "kinds": _kinds(channels, [[0.0 if at is None else _rms(residual[at]) or 0.0 for at in line] for line in grid]),
        "units": [_unit(o.unit_names[u], o.unit_split[u]) for u in units],
        "missing": _MISSING,
        "base": base,
        "models": [
            {
                "label": m.label[:160],
                "kind": m.kind,
                # Row of its prediction in the values of a panel, below what was measured.
                "line": said.index(i) + 1 if i in said else None,
                "fit": _rms(m.residual[fitted]),
                "held": _rms(m.residual[held]),
                "cells": [[None if at is None else _rms(m.residual[at]) for at in line] for line in grid],
            }
            for i, m in enumerate(models)
        ],
        "panels": [
            [None if at is None else _panel(traces, models, base, at, most, c) for at in line]
            for c, line in zip(channels, grid, strict=True)
        ],
        "map": _map(traces, models),
        "hypotheses": _hypotheses(verdict),
        "effects": _effects(verdict, models, base, fitted, held),
        "next": _next(result),
        "remains": [[str(port)[:60], str(d.get("text", ""))[:120]] for port, d in remains],
    }


def _unit(name: str, split: str) -> dict[str, str]:
    return {"name": name.replace("_", " ")[:60], "split": SPLIT_NAMES.get(split, split)[:60]}


def _models(result: Result, traces: Traces) -> list[_Model]:
    """Models to draw: as given, refitted, and with each effect that the folder tells of, best first of each kind."""
    o = traces.observations
    models = []
    for row, label in enumerate(traces.labels):
        effects = () if label in ("as given", "refitted") else tuple(re.split(r", | \+ ", label.removeprefix("with ")))
        words = {"as given": "the model as given", "refitted": "the model, refitted"}.get(label, "+ " + _words(effects))
        kind = "given" if label == "as given" else "refit"
        models.append(_Model(words, effects, kind, traces.residual[row], traces.predicted[row]))
    row = next((i for i, m in enumerate(models) if m.kind == "refit"), len(models) - 1)
    base, white = models[row], traces.whitened[row]
    # A set has no order: `drag + toe` of one file is `toe + drag` of another.
    known = {frozenset(m.effects) for m in models}
    refits = read_refits(result.folder, len(o)) if result.folder is not None else {}
    more = [
        _Model("+ " + _words(names), names, "refit", left.residual, left.predicted)
        for names, left in refits.items()
        if frozenset(names) not in known
    ]
    known |= {frozenset(m.effects) for m in more}
    fitted = np.flatnonzero(o.in_split("fit"))
    # An estimate says by which share the whitened error falls; it is shown in the measure of all other errors.
    measure = (_rms(base.residual[fitted]) or 0.0) / (_rms(white[fitted]) or 1.0)
    for name, signature in result.signatures.items():
        if frozenset((name,)) not in known and (left := _estimate(white[fitted], signature)) is not None:
            # Signatures are kept of fitted observations alone; what was held out is not estimated but left open.
            residual = np.full(len(o), np.nan)
            residual[fitted] = measure * left
            more.append(_Model("+ " + _words((name,)), (name,), "estimate", residual, None))
    # Refits before estimates, which are to first order and would win where they are too good to be true.
    more.sort(key=lambda m: (m.kind != "refit", _rms(m.residual[fitted]) or np.inf))
    return [*models, *more][: STUDIO_SIZES.most_models]


def _estimate(residual: np.ndarray, signature: np.ndarray) -> np.ndarray | None:
    """Residual less the best amount of a signature's columns; None for one of other observations or without length."""
    columns = np.asarray(signature, float)
    if columns.ndim != 1 or len(columns) != len(residual):
        return None
    keep = np.isfinite(residual) & np.isfinite(columns)
    length = float(np.sum(columns[keep] ** 2))
    if length <= 0.0:
        return None
    # Not below zero: most effects exist with one sign only.
    amount = max(float(np.sum(columns[keep] * residual[keep])) / length, 0.0)
    return residual - amount * columns


def _words(effects: Sequence[str]) -> str:
    return and_list([e.replace("_", " ") for e in effects])


def _rms(residual: np.ndarray) -> float | None:
    known = residual[np.isfinite(residual)]
    return _short(float(np.sqrt(np.mean(known**2)))) if known.size else None


def _short(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None


def _list(values: np.ndarray) -> list[float | None]:
    return [_short(v) for v in values.tolist()]


def _kinds(channels: Sequence[str], error: Sequence[Sequence[float]]) -> list[dict[str, Any]]:
    """Kinds of channels with the rows of their channels; of many channels the worst kind and channel first.

    Args:
      channels: of the rows. error: of each row in every manoeuvre, in sigma.
    """
    if len(channels) <= STUDIO_SIZES.most_rows:
        return [{"name": channel_label(c)[:60], "rows": [i]} for i, c in enumerate(channels)]
    rows: dict[str, list[int]] = {}
    for i in sorted(range(len(channels)), key=lambda i: -max(error[i])):
        rows.setdefault(kind_label(channels[i]), []).append(i)
    return [{"name": kind[:60], "rows": found} for kind, found in rows.items()]


def _share(counts: Sequence[int], most: int) -> int:
    """Readings of each series that are drawn, `most` in all at the utmost: short series leave theirs to long ones."""
    left = most
    for place, count in enumerate(sorted(counts)):
        others = len(counts) - place
        if count * others > left:
            return max(left // others, 2)
        left -= count
    return max(counts, default=0)


def _kept(residual: np.ndarray, most: int) -> np.ndarray:
    """Places of at most `most` readings of a series: the lowest and the highest residual of each stretch.

    A screen shows no more of a longer series, and nothing that sticks out is left out, as every tenth reading would.
    """
    count = len(residual)
    if count <= most:
        return np.arange(count)
    ends = np.linspace(0, count, most // 2 + 1).astype(int)
    stretch = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
    # Sorted within stretches, so that each of them has its lowest first and its highest last.
    order = np.lexsort((np.nan_to_num(residual), stretch))
    return np.union1d(order[ends[:-1]], order[ends[1:] - 1])


def _coded(rows: np.ndarray, ruler: int, steps: int) -> list[Any]:
    """Rows of numbers in whole steps, less the row above, less the number before; with the number and size of step 0.

    Models share the noise of what was measured, and what they differ by changes slowly: such differences pack into a
    quarter of what the numbers do.

    Args:
      rows: (rows, n), NaN for no number. ruler: the row whose range is cut into `steps`.
    """
    known = np.abs(rows) < _LARGEST
    ruled = rows[ruler][known[ruler]]
    if not ruled.size or not np.ptp(ruled):
        ruled = rows[known]
    low, step = (float(ruled.min()), float(np.ptp(ruled)) / steps) if ruled.size else (0.0, 1.0)
    step = step or 1.0
    levels = np.clip(np.round((np.where(known, rows, low) - low) / step), _MISSING + 1, -_MISSING)
    levels = np.where(known, levels, _MISSING).astype(np.int64)
    return [low, step, np.diff(np.diff(levels, axis=0, prepend=0), axis=1, prepend=0).tolist()]


def _panel(
    traces: Traces, models: Sequence[_Model], base: int, at: np.ndarray, most: int, channel: str
) -> dict[str, Any]:
    """Abscissa, measurements, and predictions and residuals by model, of one channel of one manoeuvre."""
    o = traces.observations
    x = o.place[at, 0] if o.place is not None else traces.time[at]
    order = np.argsort(x, kind="stable")
    # Gaps are found before thinning, whose own steps differ.
    x, (places,) = broken(x[order], at[order])
    gap = np.isnan(places)
    at = np.where(gap, at[0], places).astype(int)
    keep = np.union1d(_kept(np.where(gap, np.nan, models[base].residual[at]), most), np.flatnonzero(gap))
    x, at, gap = x[keep], at[keep], gap[keep]
    values = [o.value[at], *(m.predicted[at] for m in models if m.predicted is not None)]
    residual, sizes = [m.residual[at] for m in models], STUDIO_SIZES
    return {
        "x": _coded(x[None], 0, sizes.levels_of_time * len(order)),
        "x_title": "slip ratio" if traces.is_table else "time, s",
        "y_title": plot_text(channel_label(channel)),
        "values": _coded(np.where(gap, np.nan, values), 0, sizes.levels),
        "residual": _coded(np.where(gap, np.nan, residual), base, sizes.levels_of_residual),
        "drawn": [int((~gap).sum()), len(order)],
    }


def _map(traces: Traces, models: Sequence[_Model]) -> dict[str, Any] | None:
    """Where the error happens: place of every observation, and the error there over all channels, by model.

    Places of drives are the measured ones; those of tables are slip ratio and slip angle.
    """
    o = traces.observations
    if o.place is not None:
        slip_and_angle, titles = np.column_stack([o.place[:, 0], o.place[:, 1]]), ("slip ratio", "slip angle, deg")
    else:
        parts = [covariate_along(o, "position", axis=axis) for axis in "xy"]
        slip_and_angle, titles = np.column_stack(parts), ("east x, m", "north y, m")
    known = np.isfinite(slip_and_angle).all(axis=1)
    if not known.any():
        return None
    # Places of a drive never repeat and are gathered in cells; those of a table do repeat.
    cell = 0.02 * max(float(np.ptp(slip_and_angle[known], axis=0).max()), 1e-9)
    grid = np.round(slip_and_angle[known] / (cell if o.place is None else 1e-9)).astype(np.int64)
    _, first, number = np.unique(np.column_stack([grid, o.unit[known]]), axis=0, return_index=True, return_inverse=True)
    number = np.ravel(number)
    units = sorted(set(o.unit.tolist()))
    keep = np.arange(len(first))[:: max(1, int(np.ceil(len(first) / STUDIO_SIZES.most_map)))]
    shown_points = slip_and_angle[known][first][keep]

    def errors(residual: np.ndarray) -> list[float | None]:
        fine = np.isfinite(residual)
        squares = np.bincount(number[fine], residual[fine] ** 2, len(first))
        count = np.bincount(number[fine], minlength=len(first))
        with np.errstate(invalid="ignore", divide="ignore"):
            return _list(np.sqrt(squares / count)[keep])

    return {
        "x": _list(shown_points[:, 0]),
        "y": _list(shown_points[:, 1]),
        "unit": [units.index(int(u)) for u in o.unit[known][first][keep]],
        "x_title": titles[0],
        "y_title": titles[1],
        "equal": o.place is None,
        "error": [errors(m.residual[known]) for m in models],
    }


def _hypotheses(verdict: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Probabilities of hypotheses, most probable first."""
    listed = verdict.get("probabilities")
    if not isinstance(listed, Mapping):
        return []
    rows = [(str(n)[:120], float(p)) for n, p in listed.items() if isinstance(p, int | float) and 0.0 <= p <= 1.0]
    # The rest stands last however probable it is: it is no hypothesis.
    rows.sort(key=lambda row: (row[0] == _REST, -row[1]))
    return [{"name": n.replace("_", " "), "p": _short(p)} for n, p in rows]


def _effects(
    verdict: Mapping[str, Any], models: Sequence[_Model], base: int, fitted: np.ndarray, held: np.ndarray
) -> list[dict[str, Any]]:
    """Every effect with its probability, what it is, why or why not, and the model that has it."""
    evidence = [e for e in verdict.get("evidence") or [] if isinstance(e, Mapping) and isinstance(e.get("effect"), str)]
    named = [str(n) for n in verdict.get("effects") or []]
    index = {m.effects: i for i, m in enumerate(models) if m.effects}
    sets = {frozenset(k): i for k, i in index.items()}
    whole = sets.get(frozenset(named), -1) if named else -1
    # One measure for all effects, or the table would compare held-out errors with fitted ones.
    on_held = bool(held.any()) and all(_rms(models[i].residual[held]) is not None for i in [base, *index.values()])
    part, measure = (held, "held-out") if on_held else (fitted, "fitted")
    errors: dict[str, float] = {}
    for names, i in index.items():
        value = _rms(models[i].residual[part])
        if value is not None and len(names) == 1:
            errors[names[0]] = value
        if value is not None and i == whole and len(named) > 1:
            errors[""] = value
    before = _rms(models[base].residual[part])
    rows = []
    for e in evidence:
        name = e["effect"]
        p = e.get("probability")
        rows.append(
            {
                "name": name.replace("_", " ")[:120],
                "p": _short(p) if isinstance(p, int | float) and not isinstance(p, bool) else None,
                "status": "named" if name in named else str(e.get("status", ""))[:40],
                "what": CATALOGUE[name].doc.strip().splitlines()[0] if name in CATALOGUE else "",
                "why": reason(e, named, errors, before, measure),
                "model": sets.get(frozenset((name,)), whole if name in named and whole >= 0 else None),
            }
        )
    rows.sort(key=lambda row: (row["status"] != "named", row["status"] == "not tested", -(row["p"] or 0.0)))
    return rows


def _next(result: Result) -> list[str]:
    """Sentences on what to do next: the measurements that `next` ranked, else the steps of the report."""
    planned = (result.next or {}).get("sentence")
    steps = [str(line) for line in lead([result], result).next]
    return [str(planned)[:600], *steps] if planned else steps
