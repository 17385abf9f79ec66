"""Presets, effects and terrains as tables on the terminal."""

from __future__ import annotations

import numpy as np
from rich.console import Console
from rich.table import Table

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.paper import REGULARISATIONS
from lunar_mjx.effects.presets import FLAWS, UNSAID
from lunar_mjx.model import Model, Value
from lunar_mjx.terrain import Terrain


def _shown(value: Value, model: Model) -> str:
    if not isinstance(value, tuple):
        return f"{value:g}"
    groups = {}
    names = [g.name for g in model.rover.groups for _ in g.joints]
    if len(value) != len(names):
        return ", ".join(f"{v:g}" for v in value)
    for name, number in zip(names, value, strict=True):
        groups.setdefault(name, []).append(number)
    if len(set(value)) == 1:
        return f"{value[0]:g}"
    return ", ".join(f"{n} {', '.join(sorted({f'{v:g}' for v in vs}))}" for n, vs in groups.items())


def print_preset(model: Model, console: Console) -> None:
    """Every effect of a model with its values and sources; for the paper, what it leaves unsaid and undefined."""
    table = Table("effect", "parameter", "value", "unit", "source", title=f"preset {model.preset}", box=None)
    for effect in model.effects:
        first = effect.name
        if not effect.parameters:
            table.add_row(first, "", "", "", "")
        for name, parameter in effect.parameters.items():
            value = model.parameters[effect.name][name]
            table.add_row(first, name, _shown(value, model), parameter.unit, parameter.source)
            first = ""
    console.print(table)
    if model.preset == "paper":
        for title, rows in (("left unsaid by the paper: the value taken", UNSAID),
                            ("undefined in print: what is done there", REGULARISATIONS)):  # fmt: skip
            table = Table("what", "choice", title=title, box=None)
            for what, choice in rows.items():
                table.add_row(what, choice)
            console.print(table)
    table = Table("no.", "where", "paper", "consistent", "effect", title="differences between the presets", box=None)
    for flaw in FLAWS:
        table.add_row(str(flaw.number), flaw.where, flaw.paper, flaw.consistent, flaw.mended_by)
    console.print(table)


def print_effect(effect: Effect, console: Console) -> None:
    """An effect's equation, ports, parameters and state."""
    console.print(f"{effect.name}: {', '.join(effect.ports)}", style="bold", highlight=False)
    console.print(effect.doc, highlight=False, markup=False)
    if effect.replaces:
        console.print(f"replaces {', '.join(effect.replaces)}", highlight=False)
    table = Table("parameter", "nominal", "null", "bounds", "unit", "meaning", "source", box=None)
    for name, p in effect.parameters.items():
        null = "" if p.null is None else f"{p.null:g}"
        table.add_row(name, f"{p.nominal:g}", null, f"{p.bounds[0]:g} .. {p.bounds[1]:g}", p.unit, p.meaning, p.source)
    console.print(table)
    for name, s in effect.state.items():
        console.print(f"state {name} ({s.unit}, per {s.axis}): {s.meaning}", highlight=False)


def print_terrain(terrain: Terrain, console: Console) -> None:
    """Extent, heights, slopes and rocks of a terrain."""
    field = terrain.field
    heights, cell = np.asarray(field.heights, float), float(field.cell)
    rows, cols = heights.shape
    gy, gx = np.gradient(heights, cell)
    slope = np.rad2deg(np.arctan(np.hypot(gx, gy)))
    table = Table("quantity", "value", box=None, title=terrain.name)
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
