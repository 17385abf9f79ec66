"""Hundreds of broken files of every kind that is read: each is refused in one sentence, or loads to what it says.

Loaded numbers are finite, and those that a second reader can tell (`second_readers`) are the same. They are broken by a
generator with a fixed seed from files that are whole: cut, torn, repeated, with numbers out of any range, names of
another kind, other bytes, other encodings, deep nesting.
"""

from __future__ import annotations

import contextlib
import json
import random
import re
import shutil
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pandas as pd
import pytest
import rasterio
from PIL import Image

from lunar_mjx.agents.policy import FORMAT as POLICY_FORMAT
from lunar_mjx.agents.policy import load_policy, shipped_policy
from lunar_mjx.backends.log_channels import command_channels
from lunar_mjx.diagnosis.folder.stored import read_stored
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.runs import FORMAT as RUN_FORMAT
from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, read_log
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert, load_rover
from lunar_mjx.simulate import read_commands
from lunar_mjx.terrain import load_terrain, read_dem
from tests import second_readers
from tests.second_readers import Said

DATA = Path(__file__).parent / "rover" / "data"
LONGEST = 1500
"""Characters of a refusal."""
LONGEST_S, LARGEST = 5.0, 2 * 10**9
"""Seconds of the processor for one file, and bytes for any."""
NUMBER = re.compile(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])")
WORD = re.compile(rb"[A-Za-z_]{3,}")
NUMBERS = [
    b"nan",
    b"inf",
    b"-inf",
    b"-1",
    b"0",
    b"1e400",
    b"1e308",
    b"-1e-300",
    b"1_0",
    b"x",
    b"",
    b"true",
    b"[]",
    b"9" * 400,
    b"9" * 5000,
    b"0x10",
    b"1,5",
    b"\xc3\xa9",
    b"'",
    b"1e99",
    b"-32768",
    b"99999999999",
]
WORDS = [
    b"",
    b"nobody",
    b"../../etc/passwd",
    b"\xff\xfe",
    b"a" * 40_000,
    b"\x00",
    b"a\\nb",
    b"<!--",
    b"None",
    b'"',
    b"[",
]


def torn(good: bytes, rng: random.Random) -> bytes:
    """One way to break a text."""
    lines = good.split(b"\n")
    way = rng.randrange(12)
    if way < 5 and (found := list(NUMBER.finditer(good))):
        m = rng.choice(found)
        return good[: m.start()] + rng.choice(NUMBERS) + good[m.end() :]
    if way < 7 and (found := list(WORD.finditer(good))):
        m = rng.choice(found)
        return good[: m.start()] + rng.choice(WORDS) + good[m.end() :]
    at = rng.randrange(len(good))
    if way == 7:
        return good[:at]
    if way == 8:
        return good[:at] + bytes(rng.randrange(256) for _ in range(rng.randrange(1, 9))) + good[at + 3 :]
    if way == 9:
        del lines[rng.randrange(len(lines))]
        return b"\n".join(lines)
    if way == 10:
        return b"\n".join([*lines, rng.choice(lines)])
    return rng.choice(
        [
            b"",
            b"\xef\xbb\xbf" + good,
            good.decode("latin-1").encode("utf-16"),
            b"\x00" * 100,
            b"[" * 5000,
            b"a = " + b"[" * 3000,
            b"<a>" * 3000,
            b"{" * 3000,
            good * 2,
        ]
    )


def flipped(good: bytes, rng: random.Random) -> bytes:
    """One way to break a file of bytes: some of them are others, in every second file; else as a text is broken."""
    if rng.randrange(2):
        return torn(good, rng)
    at, count = rng.randrange(len(good)), rng.randrange(1, 9)
    return good[:at] + rng.randbytes(count)[: len(good) - at] + good[at + count :]


def finite(*values: object) -> None:
    for value in values:
        assert np.isfinite(np.asarray(value, float)).all()


def _model(path: Path) -> Said:
    model = load_model(path)
    finite(model.gravity, model.timestep, model.ambient, *jax.tree.leaves(dict(model.parameters)))
    gains = {f"control.{g}.position_gain_Nm_rad": v[0] for g, v in model.gains.items()}
    gains |= {f"control.{g}.velocity_gain_Nms_rad": v[1] for g, v in model.gains.items()}
    values = {f"effects.{e}.{k}": v for e, parameters in model.parameters.items() for k, v in parameters.items()}
    rest = {"gravity_m_s2": model.gravity, "timestep_s": model.timestep, "ambient.temperature_degC": model.ambient[0]}
    return {**rest, **gains, **values}


def _rover(path: Path) -> Said:
    rover = load_rover(path.parent)
    finite(rover.mass, rover.standing_height, *(w.radius for w in rover.wheels), rover.chassis_points)
    names = ("position_gain", "velocity_gain", "gear_ratio", "gear_efficiency", "rotor_inertia")
    groups = {f"groups.{g.name}.{n}": getattr(g, n) for g in rover.groups for n in names}
    wheels = {f"wheels.{i}.{n}": getattr(w, n) for i, w in enumerate(rover.wheels) for n in ("radius", "width")}
    whole = {n: getattr(rover, n) for n in ("mass", "standing_height", "gravity", "chassis_points")}
    return {**{k: v for k, v in whole.items() if v is not None}, **groups, **wheels}


def _urdf(path: Path) -> Said:
    out = path.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    rover = convert(path, out)
    finite(rover.mass, rover.standing_height, *(w.radius for w in rover.wheels))
    return {"mass": rover.mass, "radii": sorted(w.radius for w in rover.wheels)}


def _terrain(path: Path) -> Said:
    field = load_terrain(str(path)).field
    finite(field.heights)
    return {"surface.cell": field.cell}


def _dem(path: Path) -> Said:
    given = {".npy": {"cell": 1.0}, ".png": {"cell": 1.0, "height_scale": WHITE_M, "dequantise": False}}
    dem = read_dem(path, **given.get(path.suffix, {}))
    finite(dem.heights, dem.cell)
    assert np.abs(dem.heights).max() < 1e7
    return {"heights": dem.heights, "cell": dem.cell, "x0": dem.x0, "y0": dem.y0}


def _commands(path: Path) -> Said:
    values = read_commands(path, LUVMI).values
    finite(values)
    return dict(zip(command_channels(LUVMI), values.T, strict=True))


def _policy(path: Path) -> np.ndarray:
    policy = load_policy(path)
    acted = np.asarray(policy.act(np.ones((1, policy.network["obs"]), np.float32)))
    finite(acted)
    return acted


def _stored(path: Path) -> Said:
    return dict(second_readers._named(read_stored(path)))


def _result(path: Path) -> Said:
    return dict(second_readers._named(read_result(path.parent).run))


def _log(path: Path) -> Said:
    log = read_log(path.parent)
    assert isinstance(log, Log)
    return {"time_s": log.tables["drive"].time_s, **log.tables["drive"].channels}


LUVMI = make_model("luvmi_x", "flat")
TERRAIN = b"""[surface]
width = 12.0
height = 8.0
cell = 0.5
[surface.roughness]
hurst = 0.7
[rocks]
abundance = 0.03
[soil]
rock_fraction = 0.3
patch = 2.0
"""
ASC = b"ncols 4\nnrows 3\nxllcorner 10\nyllcorner 20\ncellsize 2.0\nNODATA_value -9999\n1 2 3 4\n5 6 7 8\n9 1 2 3\n"
RUN = {
    "format": RUN_FORMAT,
    "version": "0.1.0",
    "logs": ["a"],
    "hashes": {"a": "0" * 64},
    "candidates": [],
    "splits": {},
    "added": [],
    "parent": None,
    "seed": 3,
    "discrepancy": {"x": 1.5},
    "test_opened": [],
}
COMPARISON = {
    "as_given": {"fit": 3.0, "test": None},
    "refitted": {"fit": 1.0, "test": 1.1},
    "by_channel": [{"manoeuvre": "a", "split": "fit", "channel": "c", "as_given": 2.0, "refitted": 1.0}],
    "certificate": {"chi2": 5.0, "gradient": 1e-3, "starts": [], "at_bound": [], "problems": []},
    "parameters": {},
    "observations": 4,
    "logs": ["a"],
}
VERDICT = {
    "verdict": "NOISE_ONLY",
    "sentence": "at the noise",
    "effects": [],
    "evidence": [],
    "details": {},
    "ports": {},
    "probabilities": {"nothing": 0.97},
}
HYPOTHESES = {"the model": {"u": {"soil.n": 0.5}, "log_posterior": -4.0}, "the model + slip": {"u": {"soil.n": 0.1}}}


def _saved_model(folder: Path) -> bytes:
    return save_model(LUVMI, folder / "good.toml").read_bytes()


def _shipped(name: str) -> Callable[[Path], bytes]:
    def copied(folder: Path) -> bytes:
        for file in (shipped("models") / "luvmi_x").iterdir():
            if file.suffix in (".xml", ".toml"):
                shutil.copy(file, folder)
        return (folder / name).read_bytes()

    return copied


def _csv(folder: Path) -> bytes:
    names = ["time_s", *command_channels(LUVMI)]
    rows = [",".join([f"{0.05 * i:g}", *["0.1"] * (len(names) - 1)]) for i in range(6)]
    return "\n".join([",".join(names), *rows, ""]).encode()


def _run_folder(name: str, content: object) -> Callable[[Path], bytes]:
    def made(folder: Path) -> bytes:
        (folder / "run.json").write_text(json.dumps(RUN))
        return json.dumps(content, indent=1).encode()

    return made


def _of(data: bytes) -> Callable[[Path], bytes]:
    return lambda _: data


def _npy(folder: Path) -> bytes:
    np.save(folder / "good.npy", np.arange(12.0).reshape(3, 4))
    return (folder / "good.npy").read_bytes()


WHITE_M = 100.0
"""Height of white in the image."""


def _geotiff(folder: Path) -> bytes:
    heights = np.linspace(-40.0, 90.0, 48, dtype=np.float32).reshape(6, 8)
    place = {"transform": rasterio.Affine(2.0, 0.0, 1000.0, 0.0, -2.0, 2000.0), "crs": SOUTH}
    shape = {"height": 6, "width": 8, "count": 1, "dtype": "float32"}
    with rasterio.open(folder / "good.tif", "w", driver="GTiff", nodata=-9.0, **shape, **place) as raster:
        raster.write(heights, 1)
    return (folder / "good.tif").read_bytes()


def _png(folder: Path) -> bytes:
    levels = np.random.default_rng(0).integers(0, 65536, (9, 12), np.uint16)
    Image.fromarray(levels).save(folder / "good.png")
    return (folder / "good.png").read_bytes()


SOUTH = "+proj=stere +lat_0=-90 +lon_0=0 +R=1737400 +units=m +no_defs"
"""Polar stereographic about the Moon's south pole, in metres."""
COLUMNS = {"time_s": 0.05 * np.arange(40), "gyro_z_rad_s": np.sin(np.arange(40.0)), "roll_deg": np.cos(np.arange(40.0))}
LOG = """format = "lunar-mjx-log/1"
rover = "luvmi_x"
[tables.drive]
file = "drive.parquet"
"""


def _parquet(folder: Path) -> bytes:
    (folder / "log.toml").write_text(LOG)
    frame = pd.DataFrame(COLUMNS)
    frame.to_parquet(folder / "good.parquet", index=False, engine="pyarrow", compression=None, use_dictionary=False)
    return (folder / "good.parquet").read_bytes()


def _second_of_parquet(good: bytes) -> Callable[[Path], Said]:
    return second_readers.plain_columns(good, COLUMNS)


def _always(read: Callable[[Path], Said]) -> Callable[[bytes], Callable[[Path], Said]]:
    return lambda _: read


class Kind(NamedTuple):
    """A kind of file.

    Attributes:
      file: its name. make: makes a whole one in a folder. read: reads it, as the package does, to numbers by name.
      second: makes a second reader of it, given the whole one. count: broken ones that are tried.
      spoil: breaks it.
    """

    file: str
    make: Callable[[Path], bytes]
    read: Callable[[Path], Said]
    second: Callable[[bytes], Callable[[Path], Said]]
    count: int
    spoil: Callable[[bytes, random.Random], bytes] = torn


_table, _document = _always(second_readers.table), _always(second_readers.document)
KINDS: dict[str, Kind] = {
    "model": Kind("model.toml", _saved_model, _model, _always(second_readers.model), 300),
    "rover": Kind("rover.toml", _shipped("rover.toml"), _rover, _table, 300),
    "MJCF": Kind("luvmi_x.xml", _shipped("luvmi_x.xml"), _rover, _always(second_readers.mjcf), 300),
    "URDF": Kind("a.urdf", _of((DATA / "steered.urdf").read_bytes()), _urdf, _always(second_readers.urdf), 300),
    "terrain": Kind("terrain.toml", _of(TERRAIN), _terrain, _table, 300),
    "ASCII grid": Kind("a.asc", _of(ASC), _dem, _always(second_readers.ascii_grid), 300),
    "array": Kind("a.npy", _npy, _dem, _always(second_readers.array), 300, flipped),
    "GeoTIFF": Kind("a.tif", _geotiff, _dem, _always(second_readers.geotiff), 300, flipped),
    "PNG": Kind("a.png", _png, _dem, _always(second_readers.png(WHITE_M)), 300, flipped),
    "Parquet": Kind("drive.parquet", _parquet, _log, _second_of_parquet, 300, flipped),
    "commands": Kind("commands.csv", _csv, _commands, _always(second_readers.commands), 300),
    "run": Kind("run.json", _run_folder("run.json", RUN), _result, _document, 100),
    "comparison": Kind("comparison.json", _run_folder("comparison.json", COMPARISON), _stored, _document, 100),
    "verdict": Kind("verdict.json", _run_folder("verdict.json", VERDICT), _stored, _document, 100),
    "hypotheses": Kind("hypotheses.json", _run_folder("hypotheses.json", HYPOTHESES), _stored, _document, 100),
}
"""3,700 broken files."""


def test_there_are_3700():
    assert sum(kind.count for kind in KINDS.values()) == 3700


def otherwise(loaded: Said, said: Said) -> str:
    """Where loaded numbers are not what a second reader found, in words; empty if they agree."""
    for name in said.keys() & loaded.keys():
        mine, theirs = np.asarray(loaded[name], float), np.asarray(said[name], float)
        if mine.shape != theirs.shape and theirs.size != 1:
            return f"{name} has the shape {mine.shape} for {theirs.shape}"
        # What is a hole to a second reader may be filled; 1e-6 is single precision.
        same = np.isclose(mine, theirs, rtol=1e-6, atol=1e-12) | np.isnan(theirs)
        if not same.all():
            return f"{name} is {mine[~same].flat[0]} for {np.broadcast_to(theirs, mine.shape)[~same].flat[0]}"
    return ""


@pytest.mark.parametrize(
    ("loaded", "said", "wrong"),
    [
        ({"a": 1.0}, {"a": 1.0, "b": 2.0}, ""),
        ({"a": (1.0, 1.0)}, {"a": 1.0}, ""),
        ({"a": [1.0, 7.0]}, {"a": [1.0, np.nan]}, ""),
        ({"a": 1.0}, {"a": 1.001}, "a is 1.0 for 1.001"),
        ({"a": [1.0, 2.0]}, {"a": [1.0, 2.0, 3.0]}, "a has the shape (2,) for (3,)"),
        ({"a": np.nan}, {"a": 1.0}, "a is nan for 1.0"),
    ],
)
def test_what_is_read_otherwise_is_found(loaded, said, wrong):
    assert otherwise(loaded, said) == wrong


def _peak(name: str) -> int:
    """Bytes that this process holds (VmRSS), or has held since `_fresh_peak` (VmHWM); 0 where no kernel tells."""
    status = Path("/proc/self/status")
    found = re.search(rf"{name}:\s+(\d+) kB", status.read_text()) if status.is_file() else None
    return 1024 * int(found[1]) if found else 0


def _fresh_peak() -> int:
    """Forgets the largest memory so far, where the kernel does so; returns what is held now, bytes."""
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")
    return _peak("VmRSS")


@pytest.mark.parametrize("kind", KINDS)
def test_broken_files_are_refused_or_load_to_what_they_say(kind, tmp_path, capfd):
    if kind == "Parquet":
        pytest.importorskip("pyarrow", reason="the extra lunar-mjx[parquet] is not installed")
    name, make, read, made, count, spoil = KINDS[kind]
    good, path, rng = make(tmp_path), tmp_path / name, random.Random(kind)
    second = made(good)
    path.write_bytes(good)
    whole, said = read(path), second(path)
    assert said.keys() & whole.keys() and not otherwise(whole, said)
    refused, compared, failed = 0, 0, []
    before = _fresh_peak()
    for number in range(count):
        bad = spoil(good, rng)
        path.write_bytes(bad)
        began = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                loaded = read(path)
            with contextlib.suppress(second_readers.Unreadable):
                wrong = otherwise(loaded, second(path))
                compared += 1
                if wrong:
                    failed.append((number, f"read otherwise: {wrong}"))
        except second_readers.Damaged:
            failed.append((number, "read although its own checksums say that it is damaged"))
        except UserError as error:
            refused += 1
            text = str(error)
            if len(text) > LONGEST or len(text.splitlines()) != 1 or ";" not in text:
                failed.append((number, f"unclear: {text[:300]!r}"))
        except BaseException as error:
            failed.append((number, f"{type(error).__name__}: {str(error)[:200]}"))
        if (took := time.process_time() - began) > LONGEST_S:
            failed.append((number, f"took {took:.1f} s of the processor"))
    assert not failed, f"{len(failed)} of {count}, such as {failed[:6]}"
    assert refused > count // 10 and compared > count // 30, (refused, compared)
    assert _peak("VmHWM") - before < LARGEST


def _record(changes: dict) -> dict:
    record = {
        "format": POLICY_FORMAT,
        "network": {"obs": 3, "actions": 2, "layers": [4], "activation": "relu", "layer_norm": False},
        "environment": {"name": "point", "options": {}, "unseen": {}},
        "notes": {},
    }
    for place, value in changes.items():
        *path, last = place.split(".")
        inner = record
        for step in path:
            inner = inner[step]
        inner[last] = value
    return record


POLICIES = [
    *(
        {"network." + k: v}
        for k in ("obs", "actions", "layers", "activation", "layer_norm")
        for v in (None, -1, 0, 1e9, "x", [], {}, True, [[]], 10**12)
    ),
    *({k: v} for k in ("format", "network", "environment", "notes") for v in (None, 1, "x", [], "y" * 50_000)),
    *({"environment." + k: v} for k in ("name", "options") for v in (None, 1, [], {"a": "b"})),
]


def test_broken_policies(tmp_path):
    path = tmp_path / "policy.npz"
    path.write_text("text")
    with pytest.raises(UserError, match=r"is no policy \(it is no archive of arrays\)"):
        load_policy(path)
    for changes in POLICIES:
        np.savez(path, record=np.array(json.dumps(_record(changes))))
        with pytest.raises(UserError) as error:
            load_policy(path)
        assert str(path) in str(error.value) and len(str(error.value)) < LONGEST, changes
    good = dict(np.load(shipped_policy("luvmi_x")))
    weight = next(n for n in good if n.startswith("params") and good[n].ndim == 2)
    for name, value, said in (
        (weight, np.full_like(good[weight], np.nan), "no finite numbers"),
        (weight, good[weight][:-1], "do not fit"),
        ("mean", good["mean"][:1], "does not fit"),
        ("mean", np.array(0.5, np.float32), "does not fit"),
        ("deviation", np.zeros_like(good["deviation"]), "does not fit"),
        ("mean", good["mean"].astype(object), "no policy"),
        ("mean", good["mean"].astype(str), "no finite numbers"),
    ):
        np.savez(path, **{**good, name: value})
        with pytest.raises(UserError, match=said):
            load_policy(path)
    whole, acted = shipped_policy("luvmi_x").read_bytes(), _policy(shipped_policy("luvmi_x"))
    rng = random.Random(0)
    for _ in range(20):
        at = rng.randrange(len(whole))
        path.write_bytes(rng.choice([whole[:at], whole[:at] + rng.randbytes(40) + whole[at + 40 :]]))
        try:
            assert (_policy(path) == acted).all(), "an archive has checksums: what is read is what was written"
        except UserError as error:
            assert "policy" in str(error)
