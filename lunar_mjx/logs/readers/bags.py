"""Messages of recorded robots: bags of ROS (`rosbags`) and MCAP files (`mcap`, with JSON or ROS 2 messages)."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, TypeVar

from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.schema import LATEST

T = TypeVar("T", int, float)
Message = tuple[str, int, Any]
"""Topic, time of recording in ns, and the message: an object with fields, or a mapping."""


def messages(path: Path, topics: Collection[str]) -> Iterator[Message]:
    """Messages of some topics in the order of the recording.

    Args:
      path: a `.mcap` file, a `.db3` file, a folder of ROS 2 with `metadata.yaml`, or a `.bag` file of ROS 1.
      topics: that are wanted.

    Raises:
      UserError: nothing readable is there, the package that reads it is missing, or a topic does not exist.
    """
    if not path.exists():
        raise UserError(f"{path}: the recording is not there; check the path or its spelling.")
    if path.suffix == ".mcap" and path.is_file():
        yield from _mcap(path, topics)
    elif path.is_dir() or path.suffix in (".db3", ".bag"):
        yield from _rosbag(path, topics)
    else:
        raise UserError(
            f"{path}: is no recording that is known here; give an .mcap, .db3 or .bag file, or the folder "
            "of a ROS 2 bag."
        )


def _need(package: str, path: Path, what: str) -> None:
    if importlib.util.find_spec(package) is None:
        raise UserError(
            f"{path}: {what} needs the package {package.replace('_', '-')}; install the extra lunar-mjx[ros]."
        )


def _need_topics(path: Path, wanted: Collection[str], there: Collection[str]) -> None:
    for topic in wanted:
        if topic not in there:
            shown = ", ".join(sorted(there)) or "none at all"
            raise bad_input(path, "topic", topic, "is not in the recording", f"use one of {shown}")


def _rosbag(path: Path, topics: Collection[str]) -> Iterator[Message]:
    _need("rosbags", path, "a bag of ROS")
    from rosbags.highlevel import AnyReader  # pyright: ignore[reportMissingImports]
    from rosbags.typesys import Stores, get_typestore  # pyright: ignore[reportMissingImports]

    try:
        # bags of older recorders do not bring the definitions of their messages
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            _need_topics(path, topics, {c.topic for c in reader.connections})
            wanted = [c for c in reader.connections if c.topic in topics]
            for connection, time, raw in reader.messages(wanted):
                yield connection.topic, time, reader.deserialize(raw, connection.msgtype)
    except UserError:
        raise
    except Exception as error:  # SQLite, YAML, unpacking and decoding raise a dozen kinds at damaged bytes
        raise UserError(f"{path}: is not a readable bag ({_first(error)}); record or copy it again.") from None


def _mcap(path: Path, topics: Collection[str]) -> Iterator[Message]:
    _need("mcap", path, "an MCAP file")
    from mcap.reader import make_reader  # pyright: ignore[reportMissingImports]

    with path.open("rb") as stream:
        try:
            reader = make_reader(stream)
            summary = reader.get_summary()
            if summary is not None:
                _need_topics(path, topics, {c.topic for c in summary.channels.values()})
            decoders = _Decoders(path)
            for schema, channel, record in reader.iter_messages(topics=list(topics)):
                decode = decoders.of(channel, schema)
                yield channel.topic, record.log_time, decode(record.data)
        except UserError:
            raise
        except Exception as error:  # records, their compression and decoders raise a dozen kinds at damaged bytes
            raise UserError(
                f"{path}: is not a readable MCAP file ({_first(error)}); record or copy it again."
            ) from None


class _Decoders:
    """Functions from bytes to messages, by channel."""

    def __init__(self, path: Path):
        self.path, self.ros, self.made = path, None, {}

    def of(self, channel: Any, schema: Any) -> Any:
        # Decoders are compiled from the message's definition, once a channel and not once a message.
        if channel.id not in self.made:
            self.made[channel.id] = self._make(channel, schema)
        return self.made[channel.id]

    def _make(self, channel: Any, schema: Any) -> Any:
        if channel.message_encoding == "json":
            return json.loads
        if channel.message_encoding == "cdr":
            _need("mcap_ros2", self.path, "ROS 2 messages in MCAP")
            from mcap_ros2.decoder import DecoderFactory  # pyright: ignore[reportMissingImports]

            self.ros = self.ros or DecoderFactory()
            # Its parser prints what it dislikes, and raises it as well.
            with redirect_stdout(None):
                decode = self.ros.decoder_for(channel.message_encoding, schema)
            if decode is not None:
                return decode
        kind = f"{channel.message_encoding} with schema {schema.encoding if schema else 'none'}"
        raise bad_input(
            self.path,
            f"encoding of {channel.topic}",
            kind,
            "is not read here",
            "record JSON or ROS 2 messages with msg definitions",
        )


def _first(error: Exception) -> str:
    return str(error).strip().split("\n")[0].rstrip(".")[:200] or type(error).__name__


_STEP = re.compile(r"(?P<name>[A-Za-z]\w*)(?:\[(?P<key>[^\[\]]+)\])?")


def field(message: Any, path: str) -> Any:
    """A field of a message: `pose.pose.position.x`, `data[3]`, or `velocity[lf_drive]` by the message's `name` list.

    Raises:
      KeyError: the step that is not there, and what is.
    """
    value = message
    for step in _steps(path):
        match = _STEP.fullmatch(step)
        if match is None:
            raise KeyError(f"{step!r} is no field; write it as in pose.position.x, data[3] or velocity[lf_drive]")
        holder, value = value, _get(value, match["name"])
        if match["key"] is not None:
            value = _item(holder, value, match["name"], match["key"])
    return value


def _steps(path: str) -> list[str]:
    """The path at its dots, but for those within brackets."""
    return re.split(r"\.(?![^\[]*\])", path)


def _get(value: Any, name: str) -> Any:
    if isinstance(value, Mapping):
        there = list(value)
        if name in value:
            return value[name]
    else:
        kind = type(value)
        names = getattr(kind, "__dataclass_fields__", None) or getattr(kind, "__slots__", None)
        there = [n for n in names or getattr(value, "__dict__", ()) if not n.startswith("_")]
        if name in there:
            return getattr(value, name)
    raise KeyError(f"there is no field {name!r}; use one of {', '.join(map(str, there)) or 'none, it is a value'}")


def _item(holder: Any, values: Any, name: str, key: str) -> Any:
    if key.isdigit():
        place = int(key)
    else:
        names = [str(n) for n in _get(holder, "name")]
        if key not in names:
            raise KeyError(f"no entry of {name} has the name {key!r}; use one of {', '.join(names)}")
        place = names.index(key)
    if place >= len(values):
        raise KeyError(f"{name} has {len(values)} entries, and no {key}")
    return values[place]


def stamp(value: Any) -> int:
    """Nanoseconds of a time stamp of ROS or JSON (`sec` with `nanosec`, `nsec` or `nsecs`), or of a number of seconds.

    Whole numbers, because seconds since 1970 in float64 are good to a quarter of a microsecond only.

    Raises:
      KeyError: it is none.
    """
    # A plain number means seconds, as JSON writers put it.
    if isinstance(value, int | float) and not isinstance(value, bool) and value == value:
        return round(1e9 * _of_a_clock(value))

    def part(*names: str) -> int | None:
        for name in names:
            found = value.get(name) if isinstance(value, Mapping) else getattr(value, name, None)
            if isinstance(found, int):
                return found
        return None

    whole, rest = part("sec", "secs"), part("nanosec", "nsec", "nsecs")
    if whole is None or rest is None:
        raise KeyError("it is neither a number of seconds nor a stamp of sec and nanosec")
    return _of_a_clock(whole) * 10**9 + _of_a_clock(rest)


def _of_a_clock(seconds: T) -> T:
    # Compared as they are: whole numbers of hundreds of digits have no float.
    if not -LATEST <= seconds <= LATEST:
        raise KeyError("it is thousands of years")
    return seconds
