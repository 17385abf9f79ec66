"""A full disk at any byte leaves the old file as it was, and is told in one sentence."""

from __future__ import annotations

import ast
import contextlib
import errno
import importlib.util
import itertools
import json
import os
import random
import re
import resource
import shutil
import types
from collections.abc import Callable, Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from matplotlib.figure import Figure as Drawing

from lunar_mjx.agents.checkpoint import Checkpoints
from lunar_mjx.agents.curves import plot_progress
from lunar_mjx.agents.policy import Policy, save_policy
from lunar_mjx.agents.record import Record
from lunar_mjx.diagnosis.runs import save_json
from lunar_mjx.errors import UserError, require_file
from lunar_mjx.files import appending, replacing, write_text
from lunar_mjx.logs.recorder.particle_bed import write_particle_log
from lunar_mjx.logs.seal import Answer, write_answer
from lunar_mjx.logs.write import write_frame, write_log
from lunar_mjx.model import make_model
from lunar_mjx.model.file import save_model
from lunar_mjx.report import Figure, Section, write_page
from lunar_mjx.rover import convert
from lunar_mjx.terrain import export_mesh, inclined
from lunar_mjx.visual.encode import writer
from lunar_mjx.visual.plots import save
from lunar_mjx.wheel_bed.particles import campaign
from lunar_mjx.wheel_bed.particles.settings import Point
from tests.wheel_bed.particles.fakes import NUMERICS, POINT, RUN, SAND, WHEEL, fake_result, series

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "lunar_mjx"
LIMITS = 50
"""Sizes at which the disk is full, for each kind of output."""


@contextlib.contextmanager
def disk_for(size: int) -> Iterator[None]:
    """No file of this process may grow beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def _frame() -> pd.DataFrame:
    return pd.DataFrame(np.random.default_rng(0).normal(size=(200, 4)), columns=list("abcd"))


def _video(path: Path) -> None:
    with writer(path, 10) as put:
        for i in range(6):
            put(np.random.default_rng(i).integers(0, 255, (64, 64, 3), np.uint8))


def _drawing(path: Path) -> None:
    drawing = Drawing()
    drawing.subplots().plot([1, 2])
    save(drawing, path)


def _policy(path: Path) -> None:
    network = {"kind": "actor", "layers": [8]}
    weights = {"w": np.random.default_rng(0).normal(size=(40, 40))}
    save_policy(Policy(weights, None, None, network, {"name": "point", "options": {}}, {}), path)


def _page(path: Path) -> None:
    write_page(path, "page", ["all is well"], [Section("one", [Figure(go.Figure(go.Scatter(y=[1, 2])), "a line")])])


def _progress(path: Path) -> None:
    record = {"seed": 0, "rows": [{"steps": 1, "episode_return": 1.0, "success": 0.5}], "unseen": []}
    plot_progress([record], path, "title")


SMALL_MODEL = make_model("luvmi_x", "flat")
OUTPUTS: dict[str, Callable[[Path], object]] = {
    "model.toml": lambda p: save_model(SMALL_MODEL, p),
    "drive.csv": lambda p: write_frame(_frame(), p),
    "drive.parquet": lambda p: write_frame(_frame(), p),
    "run.json": lambda p: save_json(p, {"numbers": list(range(500))}),
    "x.answer.toml": lambda p: write_answer(
        Answer("log", "0" * 64, 0, "paper", "slope", 1.0, [], {}, "0" * 64, "0" * 64), p
    ),
    "policy.npz": _policy,
    "report.html": _page,
    "plane.stl": lambda p: export_mesh(inclined(0.1, extent=8.0), p),
    "plane.obj": lambda p: export_mesh(inclined(0.1, extent=8.0), p),
    "plane.ply": lambda p: export_mesh(inclined(0.1, extent=8.0), p),
    "plot.png": _drawing,
    "plot.svg": _drawing,
    "curve.png": _progress,
    "drive.webp": _video,
    "drive.gif": _video,
    "drive.mp4": _video,
}


PARQUET = pytest.param(
    "drive.parquet",
    marks=pytest.mark.skipif(importlib.util.find_spec("pyarrow") is None, reason="pyarrow is not installed"),
)
LONG_TO_MAKE = [n for n in OUTPUTS if Path(n).suffix in (".png", ".svg", ".gif", ".html")]
"""A tenth of a second each: every fifth size in each run, the others in the slow proofs."""


@pytest.mark.parametrize("name", [PARQUET if n == "drive.parquet" else n for n in OUTPUTS])
def test_a_disk_that_is_full_keeps_the_old_file(name, tmp_path):
    _full_disk(name, tmp_path, 5 if name in LONG_TO_MAKE else 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", LONG_TO_MAKE)
def test_a_disk_that_is_full_at_fifty_sizes_keeps_the_old_file(name, tmp_path):
    _full_disk(name, tmp_path, 1)


def _full_disk(name: str, tmp_path: Path, every: int) -> None:
    path = tmp_path / name
    OUTPUTS[name](path)
    size, old = path.stat().st_size, b"the old file"
    path.write_bytes(old)
    for limit in _limits(name, size, every):
        with disk_for(limit), pytest.raises(UserError, match=r"cannot be written \(.*\); name a folder") as error:
            OUTPUTS[name](path)
        assert str(path) in str(error.value)
        assert path.read_bytes() == old and [p.name for p in tmp_path.iterdir()] == [name], limit
    OUTPUTS[name](path)
    assert path.stat().st_size >= 0.9 * size


def _limits(name: str, size: int, every: int = 1) -> list[int]:
    """Sizes at which the disk is full: of nothing, of all but the last byte, and between."""
    draw = random.Random(name)
    return sorted({0, size - 1, *(draw.randrange(size) for _ in range(LIMITS))})[::every]


def _held(folder: Path) -> dict[str, bytes]:
    """Contents of all files of a folder, by name."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def _bed_results(pull: float) -> list[dict]:
    points = [Point(s, a, 50.0, 1.0, 1.0 - s) for s in (0.1, 0.3) for a in (0.0, 20.0)]
    runs = campaign.plan(WHEEL, SAND, 9.81, points, NUMERICS, controls=1)
    return [fake_result(r, drawbar_pull=pull + r.point.slip_ratio + 0.1 * len(r.variant)) for r in runs]


def test_a_run_on_a_full_disk_is_told_to_make_room(tmp_path, monkeypatch):
    """Not to name another folder: `why` has none to name."""
    path = tmp_path / "verdict.json"
    save_json(path, {"verdict": "KNOWN"})

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match=r"verdict\.json: cannot be written \(.*\); make room there and run it again"):
        save_json(path, {"verdict": "UNKNOWN"})
    assert json.loads(path.read_text()) == {"verdict": "KNOWN"} and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_disk_that_is_full_keeps_the_old_table_of_a_bed(tmp_path):
    log = write_particle_log(tmp_path, _bed_results(5.0), "wheel_frame")
    old = _held(tmp_path)
    for limit in _limits("table", max(map(len, old.values()))):
        with disk_for(limit), pytest.raises(UserError, match=r"cannot be written \(.*\); name a folder"):
            write_particle_log(tmp_path, _bed_results(7.0), "wheel_frame")
        assert _held(tmp_path) == old and [p.name for p in tmp_path.iterdir()] == [log.name], limit
    write_particle_log(tmp_path, _bed_results(7.0), "wheel_frame")
    assert _held(tmp_path) != old


def test_a_disk_that_is_full_keeps_the_runs_of_a_bed(tmp_path, monkeypatch):
    class Boxes:
        def __init__(self, batch, device):
            self.batch = batch

        def run(self, going_on):
            return [series(r) for r in self.batch]

    monkeypatch.setattr(campaign, "open_device", lambda device: "cpu")
    monkeypatch.setattr(campaign, "SandBoxes", Boxes)
    ticks = itertools.count()
    # what is written tells how long it took: with a clock of its own it is as long each time
    monkeypatch.setattr(campaign, "time", types.SimpleNamespace(perf_counter=lambda: 0.25 * next(ticks)))
    path = tmp_path / campaign.RUNS_FILE
    path.write_text(json.dumps(fake_result(RUN)) + "\n")
    runs, old = campaign.plan(WHEEL, SAND, 9.81, [POINT], NUMERICS, controls=1), path.read_bytes()
    campaign.compute(runs, tmp_path)
    size = path.stat().st_size
    for limit in _limits("runs", size):
        path.write_bytes(old)
        with disk_for(limit), pytest.raises(UserError, match=r"runs\.jsonl: cannot be written"):
            campaign.compute(runs, tmp_path)
        kept = path.read_bytes()  # with the batches that still had room
        assert kept.startswith(old) and kept.endswith(b"\n"), limit
        assert all(json.loads(line)["key"] for line in kept.splitlines())


@pytest.mark.parametrize("parquet", [False, pytest.param(True, marks=PARQUET.marks)])
def test_a_log_without_room_leaves_nothing_that_stands_in_its_way(parquet, tmp_path):
    frame = pd.DataFrame({"time_s": np.arange(200) * 0.05, "gyro_z_rad_s": np.sin(np.arange(200.0))})
    tables = {"imu": frame, "late": frame.rename(columns={"gyro_z_rad_s": "gyro_x_rad_s"})}
    write_log(tmp_path / "log", tables, rover="luvmi_x", parquet=parquet)
    size = max(map(len, _held(tmp_path).values()))
    for limit in _limits("log", size, 10):
        shutil.rmtree(tmp_path / "log")
        with disk_for(limit), pytest.raises(UserError, match="cannot be written"):
            write_log(tmp_path / "log", tables, rover="luvmi_x", parquet=parquet)
        assert not list(tmp_path.iterdir()), limit
        write_log(tmp_path / "log", tables, rover="luvmi_x", parquet=parquet)


STATE = {"w": jnp.zeros(2000), "b": jnp.zeros(7)}
"""8 kB: larger than what orbax writes beside it."""
VARIES = 100
"""Bytes by which two checkpoints of one state may differ: orbax compresses names that it draws (7,647 to 7,685)."""


def _full_disk_of_checkpoints(folder: Path, every: int) -> None:
    like = {k: jax.ShapeDtypeStruct(v.shape, v.dtype) for k, v in STATE.items()}
    value = np.random.default_rng(0).normal(size=2000).astype(np.float32)
    checkpoints = Checkpoints(folder)
    checkpoints.save(1, {**STATE, "w": jnp.asarray(value)}, {"epochs": 1})
    old = _held(folder)
    size, step = max(map(len, old.values())) - VARIES, 2
    for limit in _limits("checkpoint", size, every):
        with disk_for(limit), pytest.raises(UserError, match=f"checkpoint {step} cannot be written .*; make room"):
            checkpoints.save(step, {**STATE, "w": jnp.asarray(value[::-1])}, {"epochs": step})
        assert {k: v for k, v in _held(folder).items() if k.startswith("1/")} == old, limit
        checkpoints.close()
        checkpoints = Checkpoints(folder)
        found, notes = checkpoints.newest(like)
        assert notes["epochs"] == 1 and (np.asarray(found["w"]) == value).all(), limit
    checkpoints.save(step, STATE, {"epochs": step})
    assert checkpoints.newest(like)[1]["epochs"] == step
    checkpoints.close()


def test_a_disk_that_is_full_keeps_the_old_checkpoint(tmp_path):
    _full_disk_of_checkpoints(tmp_path, 10)


@pytest.mark.slow
def test_a_disk_that_is_full_at_fifty_sizes_keeps_the_old_checkpoint(tmp_path):
    _full_disk_of_checkpoints(tmp_path, 1)


def test_a_rover_is_written_with_all_its_files_or_with_none(tmp_path):
    urdf = ROOT / "tests" / "rover" / "data" / "steered.urdf"
    out = tmp_path / "rover"
    convert(urdf, out)
    old = {p.name: p.read_bytes() for p in out.iterdir()}
    for limit in (0, 500, max(map(len, old.values())) - 1):
        with disk_for(limit), pytest.raises(UserError, match="cannot be written"):
            convert(urdf, out)
        assert {p.name: p.read_bytes() for p in out.iterdir()} == old


def test_progress_keeps_whole_rows(tmp_path):
    record = Record(tmp_path)
    row = {"steps": 1, "episode_return": 0.123456789}
    for i in range(20):
        record.add({**row, "steps": i})
    record.close()
    path = tmp_path / "progress.csv"
    whole = path.read_bytes()
    with disk_for(len(whole) + 5), pytest.raises(UserError, match=r"progress\.csv: cannot be written"):
        record._append({**row, "steps": 20})
    assert path.read_bytes() == whole


def test_what_goes_wrong_in_the_block_goes_on(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(ZeroDivisionError), replacing(path) as part:
        part.write_text("half")
        raise ZeroDivisionError
    assert path.read_text() == "old" and len(list(tmp_path.iterdir())) == 1
    with pytest.raises(UserError, match="No such file or directory"), replacing(tmp_path / "no" / "a.txt") as part:
        part.write_text("whole")
    with appending(path) as same:
        same.write_text("new")
    assert path.read_text() == "new"


def test_the_command_tells_a_full_disk_in_one_sentence(run, tmp_path):
    out = tmp_path / "model.toml"
    out.write_text("old")
    with disk_for(1000):
        result = run("preset", "consistent", "--rover", "luvmi_x", "--save", out)
    assert result.status == 2 and "model.toml: cannot be written" in result.err and "Traceback" not in result.err
    assert out.read_text() == "old"


def test_a_link_stays_one_and_its_file_is_replaced(tmp_path):
    file, link, nowhere, loop = (tmp_path / name for name in ("far/a.txt", "a.txt", "b.txt", "loop"))
    file.parent.mkdir()
    file.write_text("old")
    link.symlink_to(file)
    write_text(link, "new")
    assert link.is_symlink() and file.read_text() == "new"
    nowhere.symlink_to(tmp_path / "far" / "b.txt")
    write_text(nowhere, "new")
    assert nowhere.is_symlink() and (tmp_path / "far" / "b.txt").read_text() == "new"
    loop.symlink_to(loop)
    with pytest.raises(UserError, match="leads to itself"):
        write_text(loop, "new")
    with pytest.raises(UserError, match=r"cannot be written \(File name too long\)"):
        write_text(tmp_path / ("x" * 300), "new")


def test_a_pipe_or_a_device_is_never_renamed_over(tmp_path, run):
    """Whoever may write to /dev/null as root would else end it for every process."""
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(UserError, match="is a device, a pipe or a socket and no file"), replacing(tmp_path / "pipe"):
        pytest.fail("nothing is written")
    assert (tmp_path / "pipe").is_fifo()
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    result = run("preset", "consistent", "--rover", "luvmi_x", "--save", tmp_path / "link")
    assert result.status == 2 and "is a device, a pipe or a socket" in result.err
    assert (tmp_path / "pipe").is_fifo() and (tmp_path / "link").is_symlink()


def test_what_is_there_and_is_no_file_is_not_called_missing(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "gone")
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    for name, said in (
        ("pipe", "is a device, a pipe or a socket; give the path of a file"),
        ("link", "is a link that leads to no file"),
        ("loop", "is a link that leads to no file"),
        ("gone", "is not there"),
    ):
        with pytest.raises(UserError, match=said):
            require_file(tmp_path / name, "the table")


@pytest.mark.parametrize("name", ["/", ".", ""])
def test_a_folder_by_its_name_is_refused_in_one_sentence(name):
    told = r"^(/|\.): is a folder and no file; name a file in it, as in /?out\.$"
    with pytest.raises(UserError, match=told), replacing(name):
        pytest.fail("nothing is written")


WRITERS = {
    "write_text",
    "write_bytes",
    "to_csv",
    "to_parquet",
    "savefig",
    "savez",
    "savez_compressed",
    "savetxt",
    "export",
    "copyfile",
    "copytree",
    "tofile",
    "write_image",
}
WHOLE = re.compile(r"\b\w*_?part\b|to_csv\(index=False\)|export\(file_type")
"""A call that names a part of `replacing`, or gives back what it would write."""
OPENED = (
    "open(os.devnull, 'w')",
    "(folder / name).open('a+'",  # holds nothing
    "path.open('a', encoding='utf-8')",  # the path of `appending`
    "av.open(str(path), 'w')",  # the part that `encode.writer` gives
)
"""Files that are opened to be written in other ways."""


def _opens_to_write(node: ast.Call) -> bool:
    name = node.func.id if isinstance(node.func, ast.Name) else getattr(node.func, "attr", "")
    given = [*node.args, *(k.value for k in node.keywords if k.arg == "mode")]
    modes = [a.value for a in given if isinstance(a, ast.Constant) and isinstance(a.value, str)]
    return name == "open" and any(re.fullmatch(r"[rwax]b?\+?b?", m) and re.search(r"[wax+]", m) for m in modes)


def test_nothing_else_in_the_package_writes_files():
    """Every call that writes a file names a `part` of `replacing` or `appending`, or is `files.write_text`."""
    bare = []
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call) or WHOLE.search(ast.unparse(node)):
                continue
            opened = _opens_to_write(node) and not ast.unparse(node).startswith(OPENED)
            if opened or (isinstance(node.func, ast.Attribute) and node.func.attr in WRITERS):
                bare.append(f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)[:80]}")
    assert not bare
