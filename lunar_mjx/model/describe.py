"""Presets, effects and terrains as tables on the terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from rich.console import Console
from rich.table import Table

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import FLAWS, PRESETS, UNSAID
from lunar_mjx.effects.wheel.paper import REGULARISATIONS
from lunar_mjx.model.model import Model, Value, preset_values, rover_motors
from lunar_mjx.rover.load import MARKER
from lunar_mjx.terrain import Terrain


def make_console() -> Console:
    """A terminal that takes no text for markup: square brackets in names, bounds and docstrings stay as they are."""
    return Console(markup=False, highlight=False)


def make_table(*columns: str, title: str | None = None, names: int = 1) -> Table:
    """A table whose cells fold rather than lose their ends on a narrow terminal, but for the first `names` columns."""
    table = Table(title=title, box=None)
    for i, column in enumerate(columns):
        table.add_column(column, overflow="fold", no_wrap=i < names)
    return table


def origins(model: Model, effect: Effect, key: str) -> tuple[str, ...]:
    """Where a parameter's value comes from: one text, or one for each wheel or joint where the values are several."""
    value = model.parameters[effect.name][key]
    values = value if isinstance(value, tuple) else (value,)
    parameter = effect.parameters[key]
    found, before = [parameter.source] * len(values), (parameter.nominal,) * len(values)
    layers: list[tuple[str, Value]] = [("set in this model", value)]
    names = PRESETS[model.preset]
    if effect.name in names:
        listed = tuple(CATALOGUE[name] for name in names)
        start = dataclasses.replace(model, effects=listed, parameters={e.name: e.nominal() for e in listed})
        made = [(f"{MARKER} of {model.rover.name}", rover_motors(start))]
        made.append((f"preset {model.preset}", preset_values(made[0][1])))
        layers = [(label, layer.parameters[effect.name][key]) for label, layer in made] + layers
    for label, now in layers:
        now = now if isinstance(now, tuple) else (now,) * len(values)
        if len(now) != len(values):  # one value for all where the preset has several
            now = (now[0] if len(set(now)) == 1 else float("nan"),) * len(values)
        found = [label if new != old else known for known, new, old in zip(found, now, before, strict=True)]
        before = now
    return tuple(found)


def _by_group(entries: Sequence[str], model: Model) -> str:
    """One text for entries that are all alike, or else one per joint group or wheel."""
    if len(set(entries)) == 1:
        return entries[0]
    names = [g.name for g in model.rover.groups for _ in g.joints]
    if len(entries) != len(names):
        names = [w.corner for w in model.rover.wheels]
    groups: dict[str, list[str]] = {}
    for name, entry in zip(names, entries, strict=True):
        groups.setdefault(name, []).append(entry)
    alike: dict[str, list[str]] = {}
    for name, found in groups.items():
        alike.setdefault(", ".join(dict.fromkeys(found)), []).append(name)
    return "; ".join(f"{', '.join(names)}: {text}" for text, names in alike.items())


def _shown(value: Value, model: Model) -> str:
    return _by_group([f"{v:g}" for v in (value if isinstance(value, tuple) else (value,))], model)


def print_preset(model: Model, console: Console) -> None:
    """Every effect of a model with its values and sources; for the paper, what it leaves unsaid and undefined."""
    table = make_table("effect", "parameter", "value", "unit", "source", title=f"preset {model.preset}", names=2)
    for effect in model.effects:
        first = effect.name
        if not effect.parameters:
            table.add_row(first, "", "", "", "")
        for name, parameter in effect.parameters.items():
            value = model.parameters[effect.name][name]
            source = _by_group(origins(model, effect, name), model)
            table.add_row(first, name, _shown(value, model), parameter.unit, source)
            first = ""
    console.print(table)
    if model.preset == "paper":
        for title, rows in (
            ("left unsaid by the paper: the value taken", UNSAID),
            ("undefined in print: what is done there", REGULARISATIONS),
        ):
            table = make_table("what", "choice", title=title)
            for what, choice in rows.items():
                table.add_row(what, choice)
            console.print(table)
    table = make_table("no.", "where", "paper", "consistent", "effect", title="differences between the presets")
    for flaw in FLAWS:
        table.add_row(str(flaw.number), flaw.where, flaw.paper, flaw.consistent, flaw.mended_by)
    console.print(table)


def print_effect(effect: Effect, console: Console) -> None:
    """An effect's equation, ports, parameters and state."""
    console.print(f"{effect.name}: {', '.join(effect.ports)}", style="bold")
    console.print(effect.doc)
    if effect.replaces:
        console.print(f"replaces {', '.join(effect.replaces)}")
    table = make_table("parameter", "nominal", "null", "bounds", "unit", "meaning", "source")
    for name, p in effect.parameters.items():
        null = "" if p.null is None else f"{p.null:g}"
        table.add_row(name, f"{p.nominal:g}", null, f"{p.bounds[0]:g} .. {p.bounds[1]:g}", p.unit, p.meaning, p.source)
    console.print(table)
    for name, s in effect.state.items():
        console.print(f"state {name} ({s.unit}, per {s.axis}): {s.meaning}")


def print_terrain(terrain: Terrain, console: Console) -> None:
    """Extent, heights, slopes and rocks of a terrain."""
    field = terrain.field
    heights, cell = np.asarray(field.heights, float), float(field.cell)
    rows, cols = heights.shape
    gy, gx = np.gradient(heights, cell)
    slope = np.rad2deg(np.arctan(np.hypot(gx, gy)))
    table = make_table("quantity", "value", title=terrain.name)
    x0, y0 = float(field.x0), float(field.y0)
    table.add_row("x", f"{x0:g} .. {x0 + (cols - 1) * cell:g} m")
    table.add_row("y", f"{y0:g} .. {y0 + (rows - 1) * cell:g} m")
    table.add_row("grid", f"{rows} x {cols}, cell {cell:g} m")
    table.add_row("height", f"{heights.min():.3f} .. {heights.max():.3f} m above its origin")
    table.add_row("slope", f"median {np.median(slope):.1f}, 95 % below {np.percentile(slope, 95):.1f} deg")
    rocks = 0 if terrain.rocks is None else int((np.asarray(terrain.rocks.radii) > 0).sum())
    table.add_row("rocks", str(rocks))
    table.add_row("soil map", "none: soft everywhere" if terrain.soil is None else "rock and soft soil by place")
    console.print(table)
