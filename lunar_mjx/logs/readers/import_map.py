"""Map files of `lunar-mjx log import`: which column or field of a recording is which channel of a log."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lunar_mjx.errors import UserError, bad_input, require_within
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.readers.clocks import FASTEST_HZ, UNITS, TimeColumn
from lunar_mjx.logs.readers.folder import FARTHEST_M, TOP
from lunar_mjx.logs.readers.table_files import SEPARATORS, Layout
from lunar_mjx.logs.schema import NOISE_KEYS, NOISE_SOURCES, is_quantity, parse_column
from lunar_mjx.toml_fields import Fields

SHIPPED = Path(__file__).resolve().parent / "maps"
"""Folder of the maps that ship with the package."""
DRIVE = "{drive}"
"""Stands in a file's pattern for the text by which files of one drive belong together."""
FOLDER = "{folder}"
"""What `log.ground` may be: the name of the folder that a drive's files lie in."""
PROJECTIONS = ("tangent", "utm")
HELD = ("auto", "never")
MOST_SKIPPED = 100_000
"""Rows before a header: pandas keeps a list of those that it skips."""


@dataclasses.dataclass(frozen=True)
class Term:
    """One summand of a channel: `scale` times a field of the message or a column of the file."""

    field: str
    scale: float = 1.0


@dataclasses.dataclass(frozen=True)
class Source:
    """Where a channel comes from: the sum of its terms plus `offset`; `missing` are cells that mean a gap."""

    terms: tuple[Term, ...]
    offset: float = 0.0
    missing: tuple[float, ...] = ()

    @property
    def fields(self) -> tuple[str, ...]:
        """Fields or columns that the terms name."""
        return tuple(t.field for t in self.terms)


@dataclasses.dataclass(frozen=True)
class Geodetic:
    """Columns of latitude and longitude in degrees that become `position_x_m` (east) and `position_y_m` (north).

    Attributes:
      latitude, longitude: columns or fields. projection: tangent (a plane at the origin) or utm (grid of the zone).
      origin_deg: latitude and longitude that become (0, 0); None for the drive's first fix.
      origin_m: easting and northing on the grid that become (0, 0), in place of `origin_deg`.
      missing: numbers that mean a gap.
    """

    latitude: str
    longitude: str
    projection: str = "tangent"
    origin_deg: tuple[float, float] | None = None
    origin_m: tuple[float, float] | None = None
    missing: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class TableMap:
    """Where one table of the log comes from.

    Attributes:
      topic: of a bag or MCAP file; "" for files.
      file: pattern of the file's name; `{drive}` is what names the drive, `*` anything. "" for a topic.
      time: of a topic (a field, "recorded", or "" for the header's stamp where there is one). clock: of a file.
      own_start: each file counts from its own first row; else all tables share a clock.
      layout: of a text file. missing: numbers that mean a gap in every column.
      group: column whose changes begin a new drive, or "".
      held: "auto" (copies of a slower sensor's readings are left out) or "never".
      clock_offset_s, clock_offset_std_s: of the table, as in `log.toml`.
      channels: by name. geodetic: positions from latitude and longitude, or None.
    """

    topic: str
    file: str
    time: str
    clock: TimeColumn
    own_start: bool
    layout: Layout
    missing: tuple[float, ...]
    group: str
    held: str
    clock_offset_s: float
    clock_offset_std_s: float
    channels: Mapping[str, Source]
    geodetic: Geodetic | None = None

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns or fields that the table reads."""
        names = [f for s in self.channels.values() for f in s.fields]
        names += [self.geodetic.latitude, self.geodetic.longitude] if self.geodetic else []
        names += [n for n in (self.clock.column, self.group) if n]
        return tuple(dict.fromkeys(names))


@dataclasses.dataclass(frozen=True)
class ImportMap:
    """The contents of a map file: which column or field is which channel.

    Attributes:
      path: of the file. tables: by name. settings: keys of `log.toml`. rover: name or path. noise: by channel.
    """

    path: Path
    tables: Mapping[str, TableMap]
    rover: str
    settings: Mapping[str, Any]
    noise: Mapping[str, Noise]

    @property
    def reads_topics(self) -> bool:
        """Whether the map is for bags and MCAP files, not for tables."""
        return any(t.topic for t in self.tables.values())


def shipped_maps() -> tuple[str, ...]:
    """Names of the maps that ship with the package."""
    return tuple(sorted(p.stem for p in SHIPPED.glob("*.toml")))


def find_map(name: str | Path) -> Path:
    """Path of a map file, or of a shipped map by its name.

    Raises:
      UserError: neither is there; the sentence lists the shipped ones.
    """
    path = Path(name)
    if path.is_file():
        return path
    shipped = SHIPPED / f"{name}.toml"
    if path.parent == Path() and shipped.is_file():
        return shipped
    raise UserError(f"{name}: is neither a map file nor a shipped map; shipped are {', '.join(shipped_maps())}.")


def read_map(path: str | Path) -> ImportMap:
    """Reads a map file: `[log]` with keys of `log.toml`, and `[tables.NAME]` with `topic` or `file` and `channels`.

    Args:
      path: of the file, or the name of a shipped map.

    Raises:
      UserError: the file, a key or a value is missing, unknown or of the wrong kind.
    """
    path = find_map(path)
    top = Fields.read(path, "the map")
    top.known(("log", "tables"))
    log, stated = top.table("log"), top.table("tables")
    _check_settings(log)
    if not stated.values:
        raise UserError(f"{path}: the table [tables.NAME] is missing; name a topic or a file, and the channels in it.")
    tables = {name: _table(stated.table(name)) for name in stated.values}
    # A bag and a folder of files have no clock in common that a map could state.
    if len({bool(t.topic) for t in tables.values()}) > 1:
        raise bad_input(
            path,
            "tables",
            ", ".join(tables),
            "name topics as well as files",
            "write one map for the bag and one for the files",
        )
    if log.values.get("ground") == FOLDER and any(t.topic for t in tables.values()):
        raise bad_input(path, "log.ground", FOLDER, "is for files, and the map names topics", "name the ground itself")
    # Rows without a group could belong to any drive.
    if 0 < sum(bool(t.group) for t in tables.values()) < len(tables):
        lacking = next(name for name, t in tables.items() if not t.group)
        raise bad_input(
            path,
            f"tables.{lacking}.group",
            None,
            "is missing where another table has one",
            "state the grouping column of every table",
        )
    return ImportMap(path, tables, log.text("rover"), _others(log), _noises(log))


def changed(mapping: ImportMap, changes: Mapping[str, Any], source: str = "log import: --set") -> ImportMap:
    """The map with keys of `log.toml` over its own.

    Args:
      changes: tree of keys. source: whose they are, for a sentence that refuses one.

    Raises:
      UserError: a key is unknown, or a value of the wrong kind.
    """
    log = Fields(Path(source), changes)
    _check_settings(log)
    return dataclasses.replace(
        mapping,
        rover=log.text("rover", mapping.rover),
        settings=merged(mapping.settings, _others(log)),
        noise={**mapping.noise, **_noises(log)},
    )


def merged(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Two trees of settings as one; the second's values count."""
    out = dict(first)
    for key, value in second.items():
        old = out.get(key)
        out[key] = merged(old, value) if isinstance(old, Mapping) and isinstance(value, Mapping) else value
    return out


def _check_settings(log: Fields) -> None:
    """Refuses keys that are not for a map, and what no reader of `log.toml` could tell by the file that is to come."""
    log.known([k for k in TOP if k not in ("format", "kind", "tables", "commitment")])
    log.table("source")
    magnitudes = log.values.get("magnitudes", [])
    if not isinstance(magnitudes, Mapping | list) or not all(isinstance(name, str) for name in magnitudes):
        remedy = 'write magnitudes = ["motor_left_drive_current_A"]'
        raise bad_input(log.path, log.field("magnitudes"), magnitudes, "is no list of channels", remedy)


def _noises(log: Fields) -> dict[str, Noise]:
    stated = log.table("noise")
    return {name: _noise(stated.table(name)) for name in stated.values}


def _others(log: Fields) -> dict[str, Any]:
    return {k: v for k, v in log.values.items() if k not in ("rover", "noise")}


_OF_FILES = ("file", "header", "separator", "decimal", "skip_rows", "comment", "missing", "start", "group")


def _table(entry: Fields) -> TableMap:
    entry.known(("topic", "time", "held", "clock_offset_s", "clock_offset_std_s", "channels", "geodetic", *_OF_FILES))
    topic, file = entry.text("topic", ""), entry.text("file", "")
    if bool(topic) == bool(file):
        raise bad_input(
            entry.path,
            entry.prefix,
            topic or "{}",
            "needs either a topic or a file",
            'write topic = "/odom" for a bag, or file = "{drive}.csv" for tables',
        )
    for key in _OF_FILES:
        if topic and key in entry.values:
            raise bad_input(entry.path, entry.field(key), entry.values[key], "does not go with a topic", "leave it out")
    channels, geodetic = _channels(entry.table("channels")), _geodetic(entry.table("geodetic"))
    if not channels and geodetic is None:
        raise bad_input(
            entry.path, entry.field("channels"), {}, "names no channel", 'write it as position_x_m = "pose.x"'
        )
    clash = [n for n in ("position_x_m", "position_y_m") if geodetic is not None and n in channels]
    if clash:
        raise bad_input(entry.path, entry.field("channels"), clash[0], "is also what [geodetic] gives", "keep one")
    return TableMap(
        topic=topic,
        file=file,
        time=entry.text("time", "") if topic else "",
        clock=TimeColumn() if topic else _clock(entry),
        own_start=(entry.choice("start", ("shared", "own")) or "shared") == "own",
        layout=_layout(entry),
        missing=_missing(entry),
        group=_column(entry, "group") if "group" in entry.values else "",
        held=entry.choice("held", HELD) or "auto",
        clock_offset_s=entry.number("clock_offset_s", 0.0),
        clock_offset_std_s=_no_less_than_zero(entry, "clock_offset_std_s"),
        channels=channels,
        geodetic=geodetic,
    )


def _no_less_than_zero(entry: Fields, key: str) -> float:
    return require_within(entry.path, entry.field(key), entry.number(key, 0.0), 0.0)


def _layout(entry: Fields) -> Layout:
    header = entry.values.get("header", True)
    if not isinstance(header, bool):
        raise bad_input(
            entry.path,
            entry.field("header"),
            header,
            "is neither true nor false",
            "write header = false where the first row holds numbers",
        )
    skip = entry.number("skip_rows", 0)
    if not 0 <= skip <= MOST_SKIPPED or skip != int(skip):
        raise bad_input(entry.path, entry.field("skip_rows"), skip, "is no number of rows", f"give 0 to {MOST_SKIPPED}")
    comment = entry.text("comment", "")
    if len(comment) > 1:
        raise bad_input(entry.path, entry.field("comment"), comment, "is more than one sign", 'give one, such as "#"')
    separator = entry.choice("separator", tuple(SEPARATORS)) or ""
    return Layout(header, separator, entry.choice("decimal", (".", ",")) or ".", int(skip), comment)


def _missing(entry: Fields) -> tuple[float, ...]:
    values = entry.values.get("missing", [])
    if not isinstance(values, list):
        raise bad_input(entry.path, entry.field("missing"), values, "is not a list", "write missing = [-1000]")
    return entry.vector("missing", len(values), ())


def _scale(fields: Fields) -> float:
    scale = fields.number("scale", 1.0)
    # A channel of zeros would pass every check but those of its siblings.
    if scale == 0.0:
        raise bad_input(fields.path, fields.field("scale"), scale, "makes every value zero", "give another factor")
    return scale


def _column(entry: Fields, key: str) -> str:
    """A column by its name, or by its place counted from 0 where a file has no header."""
    value = entry.values.get(key)
    if isinstance(value, int) and not isinstance(value, bool) and value >= 0:
        return str(value)
    if not isinstance(value, str) or not value:
        raise bad_input(
            entry.path, entry.field(key), value, "is no column", "give its name in quotes, or its place counted from 0"
        )
    return value


def _clock(entry: Fields) -> TimeColumn:
    value = entry.values.get("time")
    if value is None:
        raise bad_input(
            entry.path,
            entry.field("time"),
            None,
            "is missing",
            'write time = "time", or time = { rate_hz = 10 } for a file without times',
        )
    if not isinstance(value, Mapping):
        return TimeColumn(_column(entry, "time"))
    time = entry.table("time")
    time.known(("column", "unit", "clock", "rate_hz"))
    clock = value.get("clock", False)
    if not isinstance(clock, bool):
        raise bad_input(entry.path, time.field("clock"), clock, "is neither true nor false", "write clock = true")
    if "rate_hz" in value:
        if len(value) > 1:
            raise bad_input(entry.path, time.prefix, dict(value), "states a rate and more", "give one of the two")
        return TimeColumn(rate_hz=time.positive("rate_hz", most=FASTEST_HZ))
    return TimeColumn(_column(time, "column"), time.choice("unit", tuple(UNITS)) or "s", clock)


def _channels(channels: Fields) -> dict[str, Source]:
    found = {}
    for name, value in channels.values.items():
        column = parse_column(name, str(channels.path))
        if column is None or column.problem:
            what, remedy = "is no channel", "list the names with lunar-mjx log channels"
            if column is not None:
                # Speeds of a rim are what many loggers write of a wheel.
                rim = is_quantity(column.name, "joint_speed") and name.endswith("_m_s")
                factor = "one over the wheel's radius in m" if rim else "the factor between the units"
                what = column.problem
                remedy = f'state {factor}, as in {column.name} = {{ column = "v", scale = FACTOR }}'
            raise bad_input(channels.path, channels.prefix, name, what, remedy)
        if not isinstance(value, Mapping):
            found[name] = Source((Term(_column(channels, name)),))
            continue
        found[name] = _source(channels.table(name))
    return found


def _source(source: Fields) -> Source:
    source.known(("field", "column", "scale", "offset", "missing", "sum"))
    offset, missing = source.number("offset", 0.0), _missing(source)
    terms = source.values.get("sum")
    beside = [k for k in ("sum", "field", "column") if k in source.values][1:]
    beside += ["scale"] if terms is not None and "scale" in source.values else []
    if beside:
        # One of them would be left out without a word.
        remedy = "give one column, or a sum whose terms have their own scale"
        raise bad_input(source.path, source.field(beside[0]), source.values[beside[0]], "is one too many", remedy)
    if terms is None:
        key = "field" if "field" in source.values else "column"
        return Source((Term(_column(source, key), _scale(source)),), offset, missing)
    if not isinstance(terms, list) or not terms or not all(isinstance(t, Mapping) for t in terms):
        raise bad_input(
            source.path,
            source.field("sum"),
            terms,
            "is no list of columns",
            "write sum = [{ column = 0, scale = 1.0 }, { column = 1, scale = -1.0 }]",
        )
    parts = []
    for k, term in enumerate(terms):
        one = Fields(source.path, term, source.field(f"sum[{k}]"))
        one.known(("field", "column", "scale"))
        parts.append(Term(_column(one, "field" if "field" in term else "column"), _scale(one)))
    return Source(tuple(parts), offset, missing)


def _geodetic(entry: Fields) -> Geodetic | None:
    if not entry.values:
        return None
    entry.known(("latitude", "longitude", "projection", "origin_deg", "origin_m", "missing"))
    projection = entry.choice("projection", PROJECTIONS) or "tangent"
    if "origin_m" in entry.values and (projection != "utm" or "origin_deg" in entry.values):
        raise bad_input(
            entry.path,
            entry.field("origin_m"),
            entry.values["origin_m"],
            "is a place on a grid",
            'write projection = "utm" and leave origin_deg out',
        )
    degrees, metres = (_pair(entry, key) for key in ("origin_deg", "origin_m"))
    for value, most in zip(degrees or (), (90.0, 360.0), strict=False):
        require_within(entry.path, entry.field("origin_deg"), value, -most, most)
    for value in metres or ():
        require_within(entry.path, entry.field("origin_m"), value, -FARTHEST_M, FARTHEST_M)
    return Geodetic(
        _column(entry, "latitude"), _column(entry, "longitude"), projection, degrees, metres, _missing(entry)
    )


def _pair(entry: Fields, key: str) -> tuple[float, float] | None:
    if key not in entry.values:
        return None
    first, second = entry.vector(key, 2)
    return first, second


def _noise(entry: Fields) -> Noise:
    # values are checked where the log that is written is read back
    entry.known(NOISE_KEYS)
    source = entry.choice("source", NOISE_SOURCES) or "datasheet"
    correlation, share = entry.number("correlation_time_s", 0.0), entry.number("correlated_share", 1.0)
    return Noise(entry.number("std"), source, correlation, share)


def file_pattern(pattern: str) -> re.Pattern[str]:
    """A pattern of file names as a regular expression whose group `drive` names the drive."""
    # Everything but the two signs is literal; names of files hold dots and brackets.
    text = re.escape(pattern).replace(re.escape(DRIVE), "(?P<drive>.+)", 1).replace(re.escape("*"), ".*")
    return re.compile(text, re.IGNORECASE)
