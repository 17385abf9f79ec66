"""Hundreds of broken files of every kind that is read: each is refused in one sentence, or loads to finite numbers.

Broken by a generator with a fixed seed from files that are whole: cut, torn, repeated, with numbers out of any range,
names of another kind, other encodings, deep nesting.
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

import jax
import numpy as np
import pytest

from lunar_mjx.agents.play import shipped_policy
from lunar_mjx.agents.policy import FORMAT as POLICY_FORMAT
from lunar_mjx.agents.policy import load_policy
from lunar_mjx.backends.log_channels import command_channels
from lunar_mjx.diagnosis.folder.stored import read_stored
from lunar_mjx.diagnosis.report.read import read_result
from lunar_mjx.diagnosis.runs import FORMAT as RUN_FORMAT
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.resources import shipped
from lunar_mjx.rover import convert, load_rover
from lunar_mjx.simulate import read_commands
from lunar_mjx.terrain import load_terrain, read_dem

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


def finite(*values: object) -> None:
    for value in values:
        assert np.isfinite(np.asarray(value, float)).all()


def _model(path: Path) -> None:
    model = load_model(path)
    finite(model.gravity, model.timestep, model.ambient, *jax.tree.leaves(dict(model.parameters)))


def _rover(path: Path) -> None:
    rover = load_rover(path.parent)
    finite(rover.mass, rover.standing_height, *(w.radius for w in rover.wheels), rover.chassis_points)


def _urdf(path: Path) -> None:
    out = path.parent / "out"
    shutil.rmtree(out, ignore_errors=True)
    rover = convert(path, out)
    finite(rover.mass, rover.standing_height, *(w.radius for w in rover.wheels))


def _terrain(path: Path) -> None:
    finite(load_terrain(str(path)).field.heights)


def _dem(path: Path) -> None:
    dem = read_dem(path, cell=1.0 if path.suffix == ".npy" else None)
    finite(dem.heights, dem.cell)
    assert np.abs(dem.heights).max() < 1e7


def _commands(path: Path) -> None:
    finite(read_commands(path, LUVMI).values)


def _policy(path: Path) -> None:
    policy = load_policy(path)
    finite(policy.act(np.zeros((1, policy.network["obs"]), np.float32)))


def _stored(path: Path) -> None:
    read_stored(path)


def _result(path: Path) -> None:
    read_result(path.parent)


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


KINDS: dict[str, tuple[str, Callable[[Path], bytes], Callable[[Path], None], int]] = {
    "model": ("model.toml", _saved_model, _model, 130),
    "rover": ("rover.toml", _shipped("rover.toml"), _rover, 90),
    "MJCF": ("luvmi_x.xml", _shipped("luvmi_x.xml"), _rover, 90),
    "URDF": ("a.urdf", _of((DATA / "steered.urdf").read_bytes()), _urdf, 110),
    "terrain": ("terrain.toml", _of(TERRAIN), _terrain, 80),
    "ASCII grid": ("a.asc", _of(ASC), _dem, 80),
    "array": ("a.npy", _npy, _dem, 60),
    "commands": ("commands.csv", _csv, _commands, 90),
    "run": ("run.json", _run_folder("run.json", RUN), _result, 40),
    "comparison": ("comparison.json", _run_folder("comparison.json", COMPARISON), _stored, 40),
    "verdict": ("verdict.json", _run_folder("verdict.json", VERDICT), _stored, 40),
    "hypotheses": ("hypotheses.json", _run_folder("hypotheses.json", HYPOTHESES), _stored, 40),
}
"""Name of the file, what makes a whole one, what reads it, and how many broken ones are tried: 890."""


def test_there_are_more_than_800():
    assert sum(kind[3] for kind in KINDS.values()) > 800


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
def test_broken_files_are_refused_or_load_to_finite_numbers(kind, tmp_path, capfd):
    name, make, read, count = KINDS[kind]
    good, path, rng = make(tmp_path), tmp_path / name, random.Random(kind)
    path.write_bytes(good)
    read(path)
    refused, failed = 0, []
    before = _fresh_peak()
    for number in range(count):
        bad = torn(good, rng)
        path.write_bytes(bad)
        began = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                read(path)
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
    assert refused > count // 10
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
    whole = shipped_policy("luvmi_x").read_bytes()
    rng = random.Random(0)
    for _ in range(20):
        at = rng.randrange(len(whole))
        path.write_bytes(rng.choice([whole[:at], whole[:at] + rng.randbytes(40) + whole[at + 40 :]]))
        try:
            _policy(path)
        except UserError as error:
            assert "policy" in str(error)
