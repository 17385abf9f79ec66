"""A log of a rover's drive through particle sand, with the numerical error in its stated noise."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import shutil
import time
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from lunar_mjx._version import __version__
from lunar_mjx.backends.log_channels import log_channels
from lunar_mjx.backends.sand_drive import SandDrive, SandRun, moving_bed
from lunar_mjx.effects.joint.electrical import BUS_VOLTAGE
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.files import replacing, write_text
from lunar_mjx.logs.log import Noise
from lunar_mjx.logs.recorder.instruments import Recording, record
from lunar_mjx.logs.schema import is_command
from lunar_mjx.logs.write import refuse_used, write_frame, write_log
from lunar_mjx.manoeuvres import Manoeuvre
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands
from lunar_mjx.wheel_bed.particles.results import error_share, variant_numerics
from lunar_mjx.wheel_bed.particles.settings import Numerics, Sand

LOG_FOLDER = "log"
"""Folder of the log within the folder of a drive."""
STATES = {"drive": "drive.npz", "control": "control.npz"}
"""Files that keep drives that are not at their end."""
KEEP_EVERY = 120.0
"""Seconds between keepings: what a kill costs at most."""


def numerical_error(tables: Mapping[str, Any], control: Mapping[str, Any] | None) -> dict[str, tuple[float, float]]:
    """Numerical error of each channel: standard deviation, in its unit, and correlation time, s.

    The error is that of voxels 1.5 times as large, to first order twice the difference, root mean square over what both
    drives have. It errs to one side for long: the correlation time is that of a first-order process whose neighbouring
    samples are correlated as those of the difference.

    Args:
      tables: frames of the drive by name. control: those of the drive with larger voxels.
    """
    found: dict[str, tuple[float, float]] = {}
    for name, frame in tables.items():
        other = None if control is None else control.get(name)
        if other is None:
            continue
        rows = min(len(frame), len(other))
        step = float(np.median(np.diff(frame["time_s"])))
        for channel in frame.columns:
            if channel == "time_s" or is_command(channel):
                continue
            away = np.asarray(other[channel][:rows] - frame[channel][:rows], float)
            if channel.endswith("_deg"):
                away = (away + 180.0) % 360.0 - 180.0
            power = float(away @ away)
            std = error_share("voxel") * float(np.sqrt(power / rows))
            correlation = float(away[1:] @ away[:-1]) / power if power > 0.0 else 0.0
            # No longer than the drive, in which nothing slower shows.
            slow = -step / np.log(correlation) if 0.0 < correlation < 1.0 else (rows * step if correlation else 0.0)
            found[channel] = (std, float(min(slow, rows * step)))
    return found


def write_drive_log(
    folder: str | Path,
    model: Model,
    plan: Manoeuvre,
    driven: SandDrive,
    control: SandDrive | None,
    settings: Mapping[str, Any],
    recording: Recording,
    seed: int = 0,
) -> Path:
    """Writes the log `folder/log` with the channels of `lunar-mjx log simulate`, as its instruments read them.

    A channel's stated noise has two parts: white noise of the instrument, and the numerical error as a first-order
    process of the size and correlation time that `numerical_error` finds. Two drives tell the error's size and memory
    to first order, and no more of its shape: where it is one-sided for all of a drive, it counts as one error of that
    size, not as an offset. Errors of different channels count as independent.

    Args:
      folder: must exist, without `log` in it.
      model: that drove. plan: its manoeuvre.
      driven: the drive. control: the same with larger voxels, for the numerical error, see above.
      settings: of sand and numerics, plain data for the log's [source]; `rover` names it, `terrain` the plane.
      recording: noise of the instruments and its like. seed: of the noise.

    Returns:
      Folder of the log.

    Raises:
      UserError: the drive is too short for a table.
    """
    clean = dataclasses.replace(recording, scale=0.0, dropouts=0.0)
    tables = _tables(model, driven, recording, seed)
    if "drive" not in tables:
        raise UserError(
            f"{folder}: the rover drove {driven.facts['driven_s']:.2g} s, too short for a log; give more time."
        )
    error = {}
    if control is not None:
        error = numerical_error(_tables(model, driven, clean), _tables(model, control, clean))
    noise = recording.noise([c for t in tables.values() for c in t.columns if c != "time_s"])
    for channel, (std, slow) in error.items():
        if std > 0.0:
            instrument = noise[channel].std if channel in noise else 0.0
            both = float(np.hypot(instrument, std))
            # Two parts: one process of this size with the error's memory would expect of every reading that it goes on
            # where the last one was, and call white noise of the instruments many sigma.
            noise[channel] = Noise(both, "datasheet", slow, (std / both) ** 2 if slow > 0.0 else 1.0)
    rounded = {c: [float(f"{v:.3g}") for v in e] for c, e in error.items()}
    source = {
        "who": f"lunar-mjx {__version__}, rover in a soil of particles",
        "licence": "CC0-1.0",
        "citation": "simulated with Newton's implicit material point method (newton 1.8, warp-lang) and MuJoCo",
        **{k: json.dumps(v) for k, v in settings.items() if k not in ("rover", "terrain")},
        "numerical_error": json.dumps(rounded) if rounded else "not computed: noise is the instruments' alone",
    }
    return write_log(
        Path(folder) / LOG_FOLDER,
        tables,
        rover=settings["rover"],
        noise=noise,
        manoeuvre=plan.name,
        gravity_m_s2=model.gravity,
        terrain=settings["terrain"],
        environment=dict(plan.environment) or None,
        initial={"position_m": [plan.start[0], plan.start[1], model.rover.standing_height]},
        source=source,
    )


def record_sand_drive(
    folder: Path,
    model: Model,
    rover: str,
    plan: Manoeuvre,
    moves: Commands,
    sand: Sand,
    numerics: Numerics,
    device: str,
    seconds: float = float("inf"),
    progress: Callable[[str, float], None] | None = None,
    control: bool = True,
    recording: Recording | None = None,
    make_bed: Callable[..., Any] = moving_bed,
) -> list[str]:
    """Drives, and writes the log, `drive.json` with settings, balance and cost, and `surface.csv` with the ruts.

    A drive that is not at its end is kept in the folder, too, and the same call goes on with it.

    Args:
      folder: exists; `refuse_other` has passed it.
      rover: name or folder, as the log is to have it.
      moves: of the plan, for the model.
      device: by Warp's name.
      seconds: limit on both drives; what was driven until then is written.
      progress: called with what is done and its share.
      control: whether to drive again with larger voxels; as far as the time goes.
      recording: noise of the instruments and its like; the datasheet's if None. Its seed is that of the numerics.
      make_bed: see `SandRun`.

    Returns:
      Lines that tell what came out.

    Raises:
      UserError: the drive diverged, ended too early, or the folder keeps another one.
    """
    begun = time.perf_counter()
    settings = {
        "rover": rover,
        "terrain": plan.terrain,
        "sand": dataclasses.asdict(sand),
        "numerics": {k: getattr(numerics, k) for k in ("voxel", "per_edge", "contact", "step_share", "seed")},
    }
    driving = [moves.values.tolist(), moves.interval, list(plan.start), model.gravity, model.timestep]
    key = hashlib.sha256(json.dumps([settings, driving], sort_keys=True).encode()).hexdigest()
    larger = variant_numerics(numerics, "voxel")
    # The control has fewer particles, as the cube of the voxel, and about as many steps.
    share = 1.0 / (1.0 + (numerics.voxel / larger.voxel) ** 3) if control else 1.0
    done: dict[str, SandDrive | None] = {"drive": None, "control": None}
    for what, setting in (("drive", numerics), ("control", larger)):
        first = done["drive"]
        if what == "control" and (not control or first is None or not first.whole):
            break

        def going_on(part: float, what: str = what) -> bool:
            if progress is not None:
                progress(what, share * part if what == "drive" else share + (1.0 - share) * part)
            return time.perf_counter() - begun < seconds

        try:
            run = SandRun(model, moves, plan.start, sand, setting, device, make_bed)
            _go_on(run, folder / STATES[what], key, going_on)
            done[what] = run.result()
        except FloatingPointError as error:
            raise UserError(f"particles: {error}; give a smaller --step-share or --voxel.") from error
    driven, checked = done["drive"], done["control"]
    if driven is None:
        raise UserError(
            f"particles: the time limit of {seconds:g} s ended before the rover stood; run the same command again, or "
            "give more --seconds."
        )
    shutil.rmtree(folder / LOG_FOLDER, ignore_errors=True)  # of an earlier part of the same drive
    log = write_drive_log(folder, model, plan, driven, checked, settings, recording or Recording(), numerics.seed)
    facts = {**settings, "device": device, **driven.facts, "control": None if checked is None else checked.facts}
    write_text(folder / "drive.json", json.dumps(facts, indent=1) + "\n")
    write_frame(pd.DataFrame(driven.surface, columns=["x_m", "y_m", "height_m"]), folder / "surface.csv")
    if driven.whole and (not control or (checked is not None and checked.whole)):
        for name in STATES.values():
            (folder / name).unlink(missing_ok=True)
    return [*_told(driven, checked, moves), str(log)]


def refuse_other(folder: Path) -> None:
    """Raises `UserError` for a folder that holds anything, unless it keeps a drive that is not at its end."""
    if not any((folder / name).exists() for name in STATES.values()):
        refuse_used(folder)


def _go_on(run: SandRun, path: Path, key: str, going_on: Callable[[float], bool]) -> None:
    """Drives on from what `path` keeps, if it is there, and keeps there how far it came."""
    if path.exists():
        run.restore(_kept_state(path, key))
    kept = time.perf_counter()

    def keep() -> None:
        arrays: dict[str, Any] = {**run.state(), "key": np.array(key)}
        with replacing(path) as part:
            np.savez(part, **arrays)

    def and_keep(share: float) -> bool:
        nonlocal kept
        if time.perf_counter() - kept > KEEP_EVERY:
            keep()
            kept = time.perf_counter()
        return going_on(share)

    if run.done < run.rounds:
        run.run(and_keep)
        keep()


def _kept_state(path: Path, key: str) -> dict[str, np.ndarray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            state = {name: file[name] for name in file.files}
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise bad_input(path, "contents", str(error)[:60], "are no state of a drive", "remove the file") from error
    if str(state.pop("key", "")) != key:
        raise bad_input(path, "settings", "kept", "are those of another drive", "name a new folder")
    return state


def _told(driven: SandDrive, control: SandDrive | None, moves: Commands) -> list[str]:
    facts, seen = driven.facts, driven.seen
    way = float(np.sum(np.hypot(np.diff(seen.position.x[0]), np.diff(seen.position.y[0]))))
    lines = [
        f"drove {way:.3f} m in {facts['driven_s']:.2f} s; {facts['particles']} particles, "
        f"{facts['seconds_per_rover_second']:.3g} s per rover-second",
        f"standing, the sand bears {facts['standing'].get('force_over_weight', math.nan):.4f} of the weight; momentum "
        f"closes to {facts['momentum_error']:.1e} of gravity's impulse; wheels of sand and rover differ by "
        f"{1e3 * facts['disagreement_m_s']:.2g} mm/s",
    ]
    if not driven.whole:
        planned = len(moves.values) * moves.interval
        lines.append(
            f"stopped: time limit; {planned - facts['driven_s']:.2f} s of {planned:.2f} s are not driven, the same "
            "command goes on with them"
        )
    if control is None:
        lines.append("numerical error not computed: the log's noise is the instruments' alone")
    elif not control.whole:
        lines.append(f"numerical error from the first {control.facts['driven_s']:.2f} s alone: time limit")
    return lines


def _tables(model: Model, driven: SandDrive, recording: Recording, seed: int = 0) -> dict[str, Any]:
    frame = log_channels(model, driven.seen, driven.commands)
    signals = {c: np.asarray(frame[c], float) for c in frame.columns if c != "time_s"}
    # A bus that never sags, as a rover without electrical effects has in the simulator's logs.
    signals["bus_voltage_V"] = np.full(len(frame), BUS_VOLTAGE)
    when = np.asarray(frame["time_s"], float)
    return record(when - when[0], signals, recording, np.random.default_rng(seed))
