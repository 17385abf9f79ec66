"""How the report writes numbers, channels and names that came from files."""

from __future__ import annotations

import dataclasses
import html
import math
from typing import Any

from lunar_mjx.diagnosis.unknown_inputs.inputs import PROBES
from lunar_mjx.logs.schema import STEADY_CHANNELS, find_channel, parse_name
from lunar_mjx.rover.description import CORNER_WORDS

SPLIT_NAMES = {
    "fit": "fitted",
    "select": "held out",
    "test": "held out, test",
    "apart": "set apart",
    "held_out": "held out",
}
SURE = 0.95
"""Probability that a statement needs, and from which a rival contact law is to be added: what `why` calls sure, too."""


def shown(value: Any, digits: int = 3) -> str:
    """A number in a few digits; a dash for None and NaN."""
    if not isinstance(value, int | float) or isinstance(value, bool) or math.isnan(value):
        return "-"
    # From here on a power of ten is shorter than the zeros.
    size = abs(value)
    if size and (size >= 1e5 or size < 1e-3):
        return f"{value:.{digits - 1}e}"
    return f"{value:.0f}" if size >= 10 ** (digits - 1) else f"{value:.{digits}g}"


def sigmas(value: Any) -> str:
    """An error in sigma with trailing zeros, as in the studio: 25.0 beside 29.2; a dash for None and NaN."""
    if not isinstance(value, int | float) or isinstance(value, bool) or math.isnan(value):
        return "-"
    return f"{value:.{0 if value >= 100.0 else 1 if value >= 10.0 else 2}f}"


def plot_text(text: str, most: int = 60) -> str:
    """Text for a figure: plotly reads a few tags and entities, which names from a log must not hold."""
    return html.escape(text if len(text) <= most else text[: most - 1] + "…", quote=False)


def channel_label(channel: str) -> str:
    """Name of a channel with its unit, such as "drawbar pull, N"."""
    if channel in STEADY_CHANNELS:
        unit = STEADY_CHANNELS[channel][0]
        stem = channel.removesuffix("_" + unit.replace("/", "_").replace(" ", "")) if unit != "1" else channel
        return f"{stem.replace('_', ' ')}, {unit}"
    channel_entry = find_channel(channel)
    if channel_entry is None:
        return channel.replace("_", " ")
    kind, match = channel_entry
    corner = match.groupdict().get("corner") or ""
    name = match[0].replace(f"_{corner}_", f"_{CORNER_WORDS.get(corner, corner)}_", 1) if corner else match[0]
    return _with_unit(name, kind.unit)


def kind_label(channel: str) -> str:
    """Name of a channel's kind with its unit, such as "motor drive current, A": alike at all corners and axes."""
    channel_entry, parts = find_channel(channel), parse_name(channel)
    if channel in STEADY_CHANNELS or channel_entry is None or parts is None:
        return channel_label(channel)
    return _with_unit(str(dataclasses.replace(parts, corner="", axis="", unit="")), channel_entry[0].unit)


def _with_unit(name: str, unit: str) -> str:
    label = name.replace("_", " ")
    return label if unit == "1" else f"{label}, {unit}"


def port_label(label: str) -> str:
    """Label of an unknown input with the port it enters at and the unit of the input."""
    probe = PROBES.get(label)
    return f"{label}, {probe[3]}" if probe is not None and probe[3] != "1" else label


def and_list(names: list[str] | tuple[str, ...]) -> str:
    """Names in a sentence."""
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)


def percent(p: float) -> str:
    """A probability in words that claim no more digits than it has."""
    if p > 0.999:
        return "more than 99.9 %"
    return "less than 0.1 %" if p < 0.001 else f"{100.0 * p:.3g} %"
