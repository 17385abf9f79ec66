"""Presets, effects and terrains as tables on the terminal."""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Hashable, Sequence
from typing import TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.presets import FIELD_CHANGES, FLAWS, MEANT_FOR, PRESETS, UNSAID
from lunar_mjx.effects.wheel.paper import REGULARISATIONS
from lunar_mjx.model.model import Model, Value, preset_values, rover_motors
from lunar_mjx.rover.load import MARKER
from lunar_mjx.terrain import Terrain

Entry = TypeVar("Entry", bound=Hashable)


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
    sources, before = [parameter.source] * len(values), (parameter.nominal,) * len(values)
    layers: list[tuple[str, Value]] = [("set in this model", value)]
    names = PRESETS[model.preset]
    if effect.name in names:
        listed = tuple(CATALOGUE[name] for name in names)
        start = dataclasses.replace(model, effects=listed, parameters={e.name: e.nominal() for e in listed})
        made = [(f"{MARKER} of {model.rover.name}", rover_motors(start))]
        made.append((f"preset {model.preset}", preset_values(made[0][1])))
        layers = [(label, layer.parameters[effect.name][key]) for label, layer in made] + layers
    for label, layer_values in layers:
        layer_values = layer_values if isinstance(layer_values, tuple) else (layer_values,) * len(values)
        if len(layer_values) != len(values):  # one value for all where the preset has several
            # NaN equals nothing: several values where there was one count as a change, whatever they are.
            layer_values = (layer_values[0] if len(set(layer_values)) == 1 else float("nan"),) * len(values)
        sources = [
            label if new != old else known for known, new, old in zip(sources, layer_values, before, strict=True)
        ]
        before = layer_values
    return tuple(sources)


def by_group(entries: Sequence[Entry], model: Model) -> list[tuple[str, Entry]]:
    """Entries with the joint groups or wheels that they belong to; one without a name where all are alike."""
    if len(set(entries)) == 1:
        return [("", entries[0])]
    names = [g.name for g in model.rover.groups for _ in g.joints]
    if len(entries) != len(names):
        names = [w.corner for w in model.rover.wheels]
    alike: dict[Entry, list[str]] = {}
    for name, entry in dict.fromkeys(zip(names, entries, strict=True)):
        alike.setdefault(entry, []).append(name)
    return [(", ".join(names_of_group), entry) for entry, names_of_group in alike.items()]


def print_presets(console: Console) -> None:
    """Every preset: its name, how many effects it holds, and what it is for."""
    table = make_table("preset", "effects", "what it is for", names=2)
    for name, text in MEANT_FOR.items():
        table.add_row(name, str(len(PRESETS[name])), text)
    console.print(table)
    console.print("`lunar-mjx preset NAME` gives every value and its source.")


def print_preset(model: Model, console: Console) -> None:
    """Every effect of a model with its values and sources; for the paper, what it leaves unsaid and undefined."""
    table = make_table("effect and parameter", "value", "source", title=f"preset {model.preset}", names=2)
    for effect in model.effects:
        table.add_row(effect.name, "", "")
        for name, parameter in effect.parameters.items():
            value = model.parameters[effect.name][name]
            values = [f"{v:g}" for v in (value if isinstance(value, tuple) else (value,))]
            sources = origins(model, effect, name)
            sources = sources * (len(values) // len(sources))
            unit = "" if parameter.unit == "1" else f" {parameter.unit}"
            groups = by_group(list(zip(values, sources, strict=True)), model)
            if len(groups) > 1:
                table.add_row(f"  {name}", "", "")
            for group, (number, source) in groups:
                table.add_row(f"    {group}" if group else f"  {name}", number + unit, source)
    console.print(table)
    if model.preset == "paper":
        for title, rows in (
            ("left unsaid by the paper: the value taken", UNSAID),
            ("undefined in print: what is done there", REGULARISATIONS),
        ):
            table = make_table("what", "choice", title=title)
            for row_name, choice in rows.items():
                table.add_row(row_name, choice)
            console.print(table)
    console.print("\nwhat the paper has wrong, and consistent right")
    for flaw in FLAWS:
        flaw_lines = (("paper", flaw.paper), ("consistent", flaw.consistent), ("effect", flaw.mended_by))
        _print_difference(f"{flaw.number} {flaw.where}", flaw_lines, console)
    if model.preset == "paper":  # how the paper differs from `field` follows from the two lists
        return
    console.print("\nwhat consistent leaves out, and field has")
    for change in FIELD_CHANGES:
        flaw_lines = (("consistent", change.consistent), ("field", change.field), ("effect", change.mended_by))
        _print_difference(change.where, flaw_lines, console)


def _print_difference(title: str, told: Sequence[tuple[str, str]], console: Console) -> None:
    """A heading, and below it what each preset does."""
    table = make_table("", "", names=1)
    table.show_header = False
    for heading, text in told:
        table.add_row(f"  {heading}", text)
    console.print(title)
    console.print(table)


def print_catalogue(console: Console) -> None:
    """The catalogue of effects by port: name, presets that hold it, and what it does."""
    width = max(map(len, CATALOGUE)) + 2
    table = make_table("effect", "in", "what it does", names=2)
    table.columns[0].min_width = width
    by_ports: dict[str, list[Effect]] = {}
    for effect in CATALOGUE.values():
        by_ports.setdefault(", ".join(effect.ports), []).append(effect)
    for ports, effects in by_ports.items():
        table.add_row(ports, "", "", style="bold")
        for effect in effects:
            presets = " ".join(name[0] for name, listed in PRESETS.items() if effect.name in listed)
            table.add_row(f"  {effect.name}", presets, effect.doc.split("\n")[0])
    console.print(table)
    console.print(
        "In: " + ", ".join(f"{name[0]} preset {name}" for name in PRESETS) + ". Bold: the ports that an "
        "effect acts at. `lunar-mjx effect show NAME` gives equation, bounds and sources."
    )


def print_effect(effect: Effect, console: Console) -> None:
    """An effect's equation, ports, parameters and state."""
    console.print(f"{effect.name}: {', '.join(effect.ports)}", style="bold")
    # paragraphs are wrapped to the terminal, not to the source; what is indented keeps its lines
    paragraphs = inspect.cleandoc(effect.doc).split("\n\n")
    console.print("\n\n".join(p if "\n " in p else " ".join(p.split()) for p in paragraphs))
    if effect.replaces:
        console.print(f"replaces {', '.join(effect.replaces)}")
    for name, p in effect.parameters.items():
        console.print(f"\n{name}: {p.meaning}")
        table = make_table("", "", names=1)
        table.show_header = False
        unit = "" if p.unit == "1" else f" {p.unit}"
        table.add_row("  nominal", f"{p.nominal:g}{unit}")
        table.add_row("  bounds", f"{p.bounds[0]:g} .. {p.bounds[1]:g}{unit}")
        if p.null is not None:
            table.add_row("  no effect at", f"{p.null:g}{unit}")
        table.add_row("  source", p.source)
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
    for key, values in ({} if terrain.grids is None else terrain.grids.layers).items():
        low, high = float(np.min(values)), float(np.max(values))
        table.add_row(f"soil {key}", f"{low:.4g} .. {high:.4g} by place, SI")
    console.print(table)
