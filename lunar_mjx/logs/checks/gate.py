"""The gate: is a log fit to be used? Nothing else runs before it.

Every threshold is far from what an honest log shows (the reason stands beside each), so that good logs pass: what is
found here is wrong by its own channels, before any model of the rover is asked.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lunar_mjx.effects.body.chassis import payload_refusal
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.checks.bus import check_bus
from lunar_mjx.logs.checks.clock import check_clock
from lunar_mjx.logs.checks.frames import check_frames
from lunar_mjx.logs.checks.motors import check_motors
from lunar_mjx.logs.checks.noise import check_noise
from lunar_mjx.logs.checks.steady import check_steady
from lunar_mjx.logs.checks.values import check_values
from lunar_mjx.logs.findings import BAD_DATA, WARNING, Finding, is_bad
from lunar_mjx.logs.log import Log, SteadyLog
from lunar_mjx.logs.readers.folder import LOG_FILE
from lunar_mjx.resources import find
from lunar_mjx.rover import load_rover
from lunar_mjx.terrain import load_terrain

Slowest = Mapping[str, float]

RARE = 0.1
"""Share of the pieces of one recording that could tell up to which a frame, a unit or a swap that does not fit is no
mistake of the recording: one map reads all pieces, so that its mistakes are in every piece in which the rover moves
enough. A pose that jumps, or a rover that is pushed, is in a few (3 of 90 drives of 2.7 s with poses by lidar)."""
OF_THE_MAP = ("frame", "unit", "swap")
"""Kinds of findings that a map's mistake would bring into all pieces."""


def check(logs: Log | SteadyLog | Sequence[Log | SteadyLog], slowest_s: Slowest | None = None) -> list[Finding]:
    """Checks logs before anything else looks at them.

    Args:
      logs: one log or several.
      slowest_s: time constants of the effects that will be asked about, s, by effect; a campaign whose longest log is
        shorter than one of them cannot show it.

    Returns:
      Findings in the order of the logs; those of severity `BAD_DATA` make a log unusable. Empty for a good log.
    """
    log_list = [logs] if isinstance(logs, Log | SteadyLog) else list(logs)
    found = [
        list(log.problems) + (check_steady(log) if isinstance(log, SteadyLog) else _check_drive(log))
        for log in log_list
    ]
    return _of_pieces(found, log_list) + _check_length(log_list, slowest_s or {})


def _of_pieces(found: Sequence[Sequence[Finding]], logs: Sequence[Log | SteadyLog]) -> list[Finding]:
    """The findings of all logs, of which those that only few pieces of a recording show are warnings.

    Args:
      found: of each log. logs: as they are numbered there; names may repeat from campaign to campaign.
    """
    recording = [(log.folder.resolve().parent, log.source.get("files", number)) for number, log in enumerate(logs)]
    showing: dict[tuple[Any, ...], set[int]] = {}
    for number, findings in enumerate(found):
        for f in findings:
            if f.kind in OF_THE_MAP and f.severity == BAD_DATA:
                showing.setdefault((recording[number], f.kind, f.table, f.column), set()).add(number)
    told: dict[tuple[Any, ...], str] = {}
    for key, seen in showing.items():
        others = [k for k, r in enumerate(recording) if r == key[0] and k not in seen]
        # Without enough pieces, none of them need be asked.
        if len(seen) <= RARE * (len(seen) + len(others)):
            told_by = len(seen) + sum(_could_tell(logs[k], key[2], key[3], found[k]) for k in others)
            if len(seen) <= RARE * told_by:
                told[key] = f"{len(seen)} of the {told_by} pieces of its recording that could show it do, and are used"
    out = []
    for number, findings in enumerate(found):
        for f in findings:
            why = told.get((recording[number], f.kind, f.table, f.column))
            out.append(f if why is None else dataclasses.replace(f, message=f"{f.message}; {why}", severity=WARNING))
    return out


def _could_tell(log: Log | SteadyLog, table: str, column: str, found: Sequence[Finding]) -> bool:
    """Whether a log in which a column is right would have shown it, had its sign been wrong: else it is no witness."""
    if not isinstance(log, Log) or table not in log.tables or is_bad(list(found)):
        return False
    own = log.tables[table]
    channel = next((c for c in own.channels if own.columns.get(c, c) == column), None)
    if channel is None:
        return False
    mirrored = dataclasses.replace(own, channels={**own.channels, channel: -own.channels[channel]})
    other = dataclasses.replace(log, tables={**log.tables, table: mirrored})
    return any(f.kind in OF_THE_MAP and f.severity == BAD_DATA for f in _check_drive(other))


def require_named(logs: Sequence[Log | SteadyLog], slowest_s: Slowest) -> None:
    """Raises `UserError` where a log or a question names what is not there, or a payload that its rover cannot carry.

    A rover or a terrain that is neither shipped nor where the log says, or an effect that the catalogue does not hold.
    """
    for log in logs:
        if not isinstance(log, Log):
            continue
        for field, kind, marker, spec in (
            ("rover", "models", "rover.toml", log.rover),
            ("terrain", "terrain", "terrain.toml", log.terrain),
        ):
            if field == "terrain" and spec.startswith("slope"):
                load_terrain(spec)
            elif not Path(spec).is_file():  # a DEM, or a terrain.toml of another name
                try:
                    find(kind, spec, marker)
                except UserError:
                    remedy = f"name a shipped one, or a folder with a {marker}, counted from the log's"
                    raise bad_input(log.folder / LOG_FILE, field, spec, "is not there", remedy) from None
        mass = log.rover_changes.get("payload_kg", 0.0)
        if mass and (refusal := payload_refusal({"mass": mass}, load_rover(log.rover))) is not None:
            field = "rover_changes.payload_kg"
            raise bad_input(log.folder / LOG_FILE, field, mass, refusal.problem, refusal.remedy)
    for name, seconds in slowest_s.items():
        # One's own effect is named by its file, which nothing here needs to run.
        if name not in CATALOGUE and ".py:" not in name:
            remedy = "use a name of lunar-mjx effect list, or my_effects.py:name"
            raise bad_input("log check", "--slowest", f"{name}={seconds:g}", "names no effect", remedy)


def _check_drive(log: Log) -> list[Finding]:
    findings = check_clock(log)
    if is_bad(findings):
        return findings  # everything below reads channels by their time
    findings = check_values(log)
    bad = {f.column for f in findings if f.severity == "bad_data"}
    for part in (check_frames, check_motors, check_bus, check_noise):
        # A column that is broken already would fail every comparison with others; one finding is enough.
        findings += [f for f in part(log) if f.column not in bad]
    return findings


def _check_length(logs: Sequence[Log | SteadyLog], slowest_s: Slowest) -> list[Finding]:
    drives = [(log.span_s[1] - log.span_s[0], log) for log in logs if isinstance(log, Log) and _timed(log)]
    if not drives:
        return []
    # The longest decides: one log that shows a slow effect is enough for a campaign.
    longest, log = max(drives, key=lambda pair: pair[0])
    return [
        Finding(
            log.name,
            "",
            None,
            "time_s",
            "short",
            f"lasts {longest:g} s, the longest of its campaign, but "
            f"{effect} "
            f"acts over {seconds:g} s; record at least that long or do not ask for {effect}",
        )
        for effect, seconds in slowest_s.items()
        if longest < seconds
    ]


def _timed(log: Log) -> bool:
    return any(len(t) for t in log.tables.values())
