"""Logs from recordings: tiny bags and MCAP files are written here, imported, and read back as logs."""

from __future__ import annotations

import json
import random
import sqlite3
import struct
import types
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lunar_mjx.errors import UserError
from lunar_mjx.logs import import_log, read_log
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.readers import bags
from lunar_mjx.logs.readers.bags import field, stamp
from tests.cli_harness import Run

MAP = """
[log]
rover = "luvmi_x"
gravity_m_s2 = 1.625
[log.environment]
ambient_temperature_degC = -20.0
[log.noise."joint_*"]
std = 0.001
source = "datasheet"
correlation_time_s = 2.0
correlated_share = 0.3

[tables.drive]
topic = "/joint_states"
[tables.drive.channels]
joint_lf_drive_angle_rad = "position[lf_drive]"
joint_rf_drive_speed_rad_s = "velocity[1]"
motor_rf_drive_current_A = { field = "effort[rf_drive]", scale = 2.0, offset = 0.5 }

[tables.odometry]
topic = "/odom"
time = "recorded"
[tables.odometry.channels]
position_x_mm = "pose.position.x"
"""
START = 1_700_000_000
COUNT = 12


def angle(k: int) -> float:
    return 0.1 * k


@pytest.fixture
def map_file(tmp_path: Path) -> Path:
    path = tmp_path / "map.toml"
    path.write_text(MAP, encoding="utf-8")
    return path


def expect(folder: Path) -> None:
    """What every recording below holds."""
    log = read_log(folder)
    assert log.rover == "luvmi_x" and log.noise["joint_lf_drive_angle_rad"] == Noise(0.001, "datasheet", 2.0, 0.3)
    drive, odometry = log.tables["drive"], log.tables["odometry"]
    k = np.arange(COUNT)
    np.testing.assert_allclose(drive.time_s, 0.05 * k, atol=1e-9)
    np.testing.assert_allclose(drive.channels["joint_lf_drive_angle_rad"], 0.1 * k, rtol=1e-6)
    np.testing.assert_allclose(drive.channels["joint_rf_drive_speed_rad_s"], 2.0 + 0.0 * k, rtol=1e-6)
    current = drive.channels["motor_rf_drive_current_A"]
    assert np.isnan(current[3]) and np.isfinite(np.delete(current, 3)).all()
    np.testing.assert_allclose(np.delete(current, 3), 2.0 * 0.7 + 0.5, rtol=1e-6)
    # the recorder's clock is 10 ms late; millimetres are converted by the column's name
    np.testing.assert_allclose(odometry.time_s, 0.05 * k + 0.01, atol=1e-9)
    np.testing.assert_allclose(odometry.channels["position_x_m"], 1e-3 * (5.0 + k), rtol=1e-6)


def times(k: int) -> tuple[int, int]:
    """Nanoseconds of the header's stamp and of the recorder."""
    stamped = START * 10**9 + k * 50_000_000
    return stamped, stamped + 10_000_000


def joints(k: int, stamp: Any) -> dict[str, Any]:
    return {
        "header": {"stamp": stamp, "frame_id": ""},
        "name": ["lf_drive", "rf_drive"],
        "position": [angle(k), 0.0],
        "velocity": [1.0, 2.0],
        "effort": [0.0, float("nan") if k == 3 else 0.7],
    }


def write_json_mcap(path: Path) -> None:
    writer_module = pytest.importorskip("mcap.writer")
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream)
        writer.start()
        schema = writer.register_schema("any", "jsonschema", b"{}")
        channels = [writer.register_channel(t, "json", schema) for t in ("/joint_states", "/odom")]
        for k in range(COUNT):
            stamped, recorded = times(k)
            first = joints(k, {"sec": stamped // 10**9, "nsec": stamped % 10**9})
            for channel, message in zip(channels, (first, {"pose": {"position": {"x": 5.0 + k}}}), strict=True):
                writer.add_message(channel, recorded, json.dumps(message).encode(), recorded)
        writer.finish()


JOINT_STATE = """std_msgs/Header header
string[] name
float64[] position
float64[] velocity
float64[] effort
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
POSE = """geometry_msgs/Pose pose
================================================================================
MSG: geometry_msgs/Pose
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
================================================================================
MSG: geometry_msgs/Point
float64 x
float64 y
float64 z
================================================================================
MSG: geometry_msgs/Quaternion
float64 x
float64 y
float64 z
float64 w
"""


def write_ros_mcap(path: Path) -> None:
    writer_module = pytest.importorskip("mcap_ros2.writer")
    with path.open("wb") as stream:
        writer = writer_module.Writer(stream)
        state = writer.register_msgdef("sensor_msgs/msg/JointState", JOINT_STATE)
        pose = writer.register_msgdef("geometry_msgs/msg/PoseStamped", POSE)
        for k in range(COUNT):
            stamped, recorded = times(k)
            first = joints(k, {"sec": stamped // 10**9, "nanosec": stamped % 10**9})
            place = {
                "position": {"x": 5.0 + k, "y": 0.0, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            }
            writer.write_message("/joint_states", state, first, recorded, recorded)
            writer.write_message("/odom", pose, {"pose": place}, recorded, recorded)
        writer.finish()


def write_ros_bag(path: Path) -> None:
    """A folder with metadata.yaml and SQLite, as `ros2 bag record` writes it; or a file of ROS 1."""
    pytest.importorskip("rosbags")
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_typestore

    old = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if old else Stores.ROS2_HUMBLE)
    kinds = {
        n.rpartition("/")[2]: store.types[n]
        for n in (
            "sensor_msgs/msg/JointState",
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/PoseStamped",
            "geometry_msgs/msg/Pose",
            "geometry_msgs/msg/Point",
            "geometry_msgs/msg/Quaternion",
        )
    }
    with rosbag1.Writer(path) if old else rosbag2.Writer(path, version=9) as writer:
        connections = [
            writer.add_connection(t, n, typestore=store)
            for t, n in (("/joint_states", "sensor_msgs/msg/JointState"), ("/odom", "geometry_msgs/msg/PoseStamped"))
        ]
        for k in range(COUNT):
            stamped, recorded = times(k)
            number = (k,) if old else ()
            header = kinds["Header"](*number, kinds["Time"](stamped // 10**9, stamped % 10**9), "")
            d = joints(k, None)
            first = kinds["JointState"](
                header, d["name"], *(np.array(d[n]) for n in ("position", "velocity", "effort"))
            )
            pose = kinds["Pose"](kinds["Point"](5.0 + k, 0.0, 0.0), kinds["Quaternion"](0.0, 0.0, 0.0, 1.0))
            for connection, message in zip(connections, (first, kinds["PoseStamped"](header, pose)), strict=True):
                write = store.serialize_ros1 if old else store.serialize_cdr
                writer.write(connection, recorded, write(message, connection.msgtype))


RECORDINGS: dict[str, Callable[[Path], None]] = {
    "json.mcap": write_json_mcap,
    "ros.mcap": write_ros_mcap,
    "bag": write_ros_bag,
    "ros1.bag": write_ros_bag,
}


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_recording_becomes_a_log(name: str, run: Run, tmp_path: Path, map_file: Path) -> None:
    RECORDINGS[name](tmp_path / name)
    result = run("log", "import", tmp_path / name, "-o", tmp_path / "log", "--map", map_file)
    assert result.status == 0, result.err
    expect(tmp_path / "log")
    # nobody's measurements are overwritten
    again = run("log", "import", tmp_path / name, "-o", tmp_path / "log", "--map", map_file)
    assert again.status == 2 and "exists already" in again.err


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("/odom", "/odometry", ("topic", "/odometry", "/joint_states, /odom")),
        ("pose.position.x", "pose.place.x", ("odometry.channels.position_x_mm", "'place'", "position")),
        ("position[lf_drive]", "position[mast]", ("'mast'", "lf_drive, rf_drive")),
        ("velocity[1]", "velocity[7]", ("velocity has 2 entries",)),
        ('"pose.position.x"', '"pose.position"', ("holds a dict, not a number",)),
        ('time = "recorded"', 'time = "header.stamp"', ("tables.odometry.time", "'header'")),
        ("position_x_mm", "speed_of_light", ("speed_of_light", "no channel")),
        ('topic = "/odom"', 'topic = "/odom"\nfilter = 3', ("tables.odometry.filter", "unknown key")),
        ('rover = "luvmi_x"', "", ("rover",)),
    ],
)
def test_a_map_that_does_not_fit_is_told(
    run: Run, tmp_path: Path, map_file: Path, old: str, new: str, words: tuple[str, ...]
) -> None:
    write_json_mcap(tmp_path / "a.mcap")
    assert old in MAP
    map_file.write_text(MAP.replace(old, new), encoding="utf-8")
    result = run("log", "import", tmp_path / "a.mcap", "-o", tmp_path / "log", "--map", map_file)
    assert result.status == 2 and not (tmp_path / "log").exists()
    told = " ".join(result.err.split())
    assert all(w in told for w in words), told


def test_what_is_no_recording_is_told(tmp_path: Path, map_file: Path) -> None:
    with pytest.raises(UserError, match="not there"):
        import_log(tmp_path / "none.mcap", tmp_path / "log", map_file)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(UserError, match="no recording that is known"):
        import_log(tmp_path / "a.txt", tmp_path / "log", map_file)
    pytest.importorskip("mcap")
    (tmp_path / "a.mcap").write_bytes(b"no MCAP at all")
    with pytest.raises(UserError, match=r"a\.mcap: is not a readable MCAP file"):
        import_log(tmp_path / "a.mcap", tmp_path / "log", map_file)
    write_json_mcap(tmp_path / "b.mcap")
    whole = (tmp_path / "b.mcap").read_bytes()
    (tmp_path / "b.mcap").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"b\.mcap: is not a readable MCAP file"):
        import_log(tmp_path / "b.mcap", tmp_path / "log", map_file)
    pytest.importorskip("rosbags")
    (tmp_path / "bag").mkdir()
    with pytest.raises(UserError, match="bag: is not a readable bag"):
        import_log(tmp_path / "bag", tmp_path / "log", map_file)


@pytest.mark.parametrize("name", ["ros.mcap", "bag", "ros1.bag"])
def test_bags_that_are_damaged_anywhere_are_refused_or_read(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    path, rng, kinds, read = tmp_path / name, random.Random(name), set(), 0
    RECORDINGS[name](path)
    told = bags._first
    monkeypatch.setattr(bags, "_first", lambda error: kinds.add(type(error)) or told(error))
    whole = {f: f.read_bytes() for f in (sorted(path.iterdir()) if path.is_dir() else [path])}
    for number in range(60):
        for file, data in whole.items():
            file.write_bytes(data)
        file = rng.choice(list(whole))
        data, at = whole[file], rng.randrange(len(whole[file]))
        file.write_bytes(data[:at] if number % 4 == 0 else data[:at] + rng.randbytes(4) + data[at + 4 :])
        try:
            read += len(list(bags.messages(path, ["/joint_states", "/odom"]))) > 0
        except UserError as error:
            assert str(path) in str(error) and len(str(error)) < 1500 and "\n" not in str(error), number
    assert read > 5 and len(kinds) >= 2, "damage shows in errors of several kinds"
    assert not capfd.readouterr().out


# What libraries under the readers have raised at damaged bytes, and kinds that others may.
RAISED = (
    AssertionError,
    AttributeError,
    EOFError,
    IndexError,
    KeyError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    OverflowError,
    RecursionError,
    RuntimeError,
    StopIteration,
    TypeError,
    ValueError,
    sqlite3.DatabaseError,
    struct.error,
    zlib.error,
    type("TheirOwnError", (Exception,), {}),
)


@pytest.mark.parametrize("at", ["open", "messages", "decode"])
@pytest.mark.parametrize("name", ["a.mcap", "a.bag"])
def test_whatever_a_reader_raises_is_a_refusal_and_an_interrupt_is_none(
    name: str, at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raised: BaseException

    def fails(place: str, value: object = None) -> object:
        if place == at:
            raise raised
        return value

    channel = types.SimpleNamespace(topic="/a", id=0, message_encoding="json", msgtype="a")

    class Reader:
        connections = (channel,)

        def __init__(self, *_: object, **__: object):
            fails("open")

        def __enter__(self) -> Reader:
            return self

        def __exit__(self, *_: object) -> None: ...

        def get_summary(self) -> None: ...

        def messages(self, _: object) -> Iterator[tuple]:
            yield fails("messages", channel), 0, b""

        def iter_messages(self, topics: object) -> Iterator[tuple]:
            yield None, fails("messages", channel), types.SimpleNamespace(log_time=0, data=b"")

        def deserialize(self, *_: object) -> object:
            return fails("decode", {})

    library = "mcap.reader" if name == "a.mcap" else "rosbags.highlevel"
    module = pytest.importorskip(library, reason="the extra lunar-mjx[ros] is not installed")
    monkeypatch.setattr(module, "make_reader" if name == "a.mcap" else "AnyReader", Reader)
    monkeypatch.setattr(bags, "json", types.SimpleNamespace(loads=lambda _: fails("decode", {})))
    (tmp_path / name).write_bytes(b"")
    for kind in RAISED:
        raised = kind("at byte 7\nand more")
        with pytest.raises(
            UserError, match=r"is not a readable .*(byte 7|RuntimeError|generator).*; record or copy it"
        ):
            list(bags.messages(tmp_path / name, ["/a"]))
    raised = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt):
        list(bags.messages(tmp_path / name, ["/a"]))


@pytest.mark.parametrize(("name", "package"), [("a.mcap", "mcap"), ("a.db3", "rosbags")])
def test_a_missing_package_is_told(
    run: Run, tmp_path: Path, map_file: Path, monkeypatch: pytest.MonkeyPatch, name: str, package: str
) -> None:
    (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr("lunar_mjx.logs.readers.bags.importlib.util.find_spec", lambda n: None)
    result = run("log", "import", tmp_path / name, "-o", tmp_path / "log", "--map", map_file)
    told = " ".join(result.err.split())
    assert result.status == 2 and f"needs the package {package}" in told and "lunar-mjx[ros]" in told


def test_fields_and_stamps() -> None:
    message = {"name": ["a.b", "c"], "position": [1.0, 2.0], "t": {"secs": 3, "nsecs": 5}}
    assert field(message, "position[a.b]") == 1.0 and field(message, "position[1]") == 2.0
    assert stamp(message["t"]) == 3_000_000_005 and stamp(1.5) == 1_500_000_000
    assert stamp(types.SimpleNamespace(sec=START, nanosec=1)) == START * 10**9 + 1
    for path in ("position[2]", "position[d]", "", "position[", "__class__", "name.upper"):
        with pytest.raises(KeyError):
            field(message, path)
    for value in ("now", None, True, {"sec": 3}, float("nan")):
        with pytest.raises(KeyError):
            stamp(value)
    # a message's own Python is out of reach
    with pytest.raises(KeyError):
        field(types.SimpleNamespace(x=1.0), "__dict__")
