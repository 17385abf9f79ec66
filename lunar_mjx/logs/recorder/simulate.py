"""Records a log from the simulator, with any hidden effect and any noise."""

from __future__ import annotations

import dataclasses
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.dynamics import bus
from lunar_mjx.dynamics.signals import measure, observe
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.joint.electrical import BUS_VOLTAGE
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.logs.apply import log_model
from lunar_mjx.logs.log import Imu, Log, LogTable
from lunar_mjx.logs.recorder.instruments import Recording, record
from lunar_mjx.logs.schema import SPLITS, find_channel
from lunar_mjx.logs.seal import Answer, answer_path, commit, hash_tables, write_answer
from lunar_mjx.logs.write import refuse_used, write_log
from lunar_mjx.manoeuvres import Manoeuvre, commands, load_manoeuvre
from lunar_mjx.model import LUNAR_GRAVITY, Model, make_model
from lunar_mjx.simulate import Commands, command_channels, simulate


@dataclasses.dataclass(frozen=True)
class SimulatedDrive:
    """How a simulated drive begins and is sampled."""

    settle: float = 2.0
    """Seconds for which the rover stands before the log begins, as a real one does."""
    finest: float = 0.0101
    """Longest interval of the telemetry that tables are sampled from, s: 100 Hz for an IMU at 50 Hz."""


SIMULATED_DRIVE = SimulatedDrive()


Hidden = str | Effect | tuple[str | Effect, Mapping[str, float]]
"""An effect by name, as an object, or either with parameter values; an effect of the model is set instead of added."""


def simulate_log(
    out: str | Path,
    rover: str | Path = "viper",
    manoeuvre: str | Path | Manoeuvre = "speed_staircase",
    effects: Sequence[Hidden] = (),
    *,
    preset: str = "consistent",
    model: Model | None = None,
    terrain: str | None = None,
    gravity_m_s2: float | None = None,
    recording: Recording | None = None,
    seconds: float | None = None,
    seed: int | None = None,
    seal: bool = False,
    split: str | None = None,
    engine: str = "auto",
) -> Path:
    """Drives a manoeuvre with hidden effects and writes the log, and the answer beside it.

    Args:
      out: folder of the log; must not exist. The answer goes to `<out>.answer.toml`.
      rover, preset: of the model that the colleague is supposed to have; or `model` itself.
      manoeuvre: canned name, TOML file, or a manoeuvre.
      effects: hidden ones.
      terrain, gravity_m_s2: in place of the manoeuvre's and the model's.
      recording: noise and its like; datasheet noise if None.
      seconds: length of the drive; the manoeuvre's own if None. Durations are scaled, speeds are not.
      seed: of the noise; drawn if None.
      seal: the log gets a commitment to the answer and nothing else that tells it.
      split: fit, select or test.
      engine: of the dynamics.

    Returns:
      The folder.

    Raises:
      UserError: an effect, parameter or name is unknown, the simulation diverges, or the folder exists.
    """
    out, recording = Path(out), recording or Recording()
    plan = manoeuvre if isinstance(manoeuvre, Manoeuvre) else load_manoeuvre(manoeuvre)
    base = model or make_model(rover, terrain or plan.terrain, preset)
    if gravity_m_s2 is None:
        gravity_m_s2 = base.gravity if model is not None else LUNAR_GRAVITY
    spec = terrain or plan.terrain
    _check_new(out)
    # Before minutes of driving.
    if split is not None and split not in SPLITS:
        raise bad_input("log simulate", "--split", split, "does not exist", f"use one of {', '.join(SPLITS)}")
    for channel in recording.bias:
        if find_channel(channel) is None:
            remedy = "list the names with lunar-mjx log channels"
            raise bad_input("log simulate", "--bias", channel, "is no channel", remedy)
    scale = 1.0 if seconds is None else seconds / plan.duration_s
    hidden, answers = _hide(base, effects)
    settings: dict[str, Any] = {
        "manoeuvre": plan.name,
        "gravity_m_s2": gravity_m_s2,
        "terrain": spec,
        "environment": dict(plan.environment) or None,
        "rover_changes": _payload(base, plan),
        "initial": {"position_m": [plan.start[0], plan.start[1], base.rover.standing_height]},
        "split": split,
    }
    wanted = base.replace(modes={"drive": plan.drive_mode})
    moves = commands(plan, wanted, scale)
    name = base.rover.name if Path(str(rover)).name == str(rover) and model is None else str(base.rover.folder)
    # Through the log's own settings: what a reader will build from the files is what is driven here.
    seen = log_model(_planned(out, name, wanted, moves, settings), hidden)
    time, signals = _drive(seen, moves, plan.start, engine)
    nonce = secrets.token_hex(32)
    seed = secrets.randbits(63) if seed is None else seed
    # The noise of a sealed log must not be found by trying seeds.
    stream = np.random.default_rng([seed, int(nonce, 16)] if seal else seed)
    tables = record(time, signals, recording, stream)
    answer = Answer(out.name, nonce, seed, preset, plan.name, scale, answers, dataclasses.asdict(recording), "", "")
    settings["source"] = {"who": "lunar-mjx log simulate", "licence": "CC0-1.0", "citation": "a simulated log"}
    channels = [c for t in tables.values() for c in t.columns if c != "time_s"]
    answer = dataclasses.replace(answer, data_sha256=hash_tables(tables))
    write_log(out, tables, rover=name, noise=recording.noise(channels), **settings)
    write_answer(commit(out, answer) if seal else answer, answer_path(out))
    return out


def _check_new(out: Path) -> None:
    if answer_path(out).exists():
        raise bad_input("log simulate", "folder", str(answer_path(out)), "exists already", "name a new folder")
    refuse_used(out)


def _hide(base: Model, effects: Sequence[Hidden]) -> tuple[Model, list[dict[str, Any]]]:
    """The model with the hidden effects, and what the answer says of each."""
    answers: list[dict[str, Any]] = []
    for given in effects:
        spec, values = given if isinstance(given, tuple) else (given, {})
        name = spec.name if isinstance(spec, Effect) else spec
        if name in base.effect_names:
            if not values:
                raise bad_input(
                    "log simulate",
                    "--effect",
                    name,
                    "is in the model already",
                    f"give other values, as in {name}:parameter=value",
                )
            base = base.set(name, "log simulate", **values)
            answers.append({"name": name, "added": False, "parameters": dict(values)})
            continue
        before = set(base.effect_names)
        base = base.add(spec, "log simulate", **values)
        added = next(n for n in base.effect_names if n not in before)
        full = {k: _number(v) for k, v in base.parameters[added].items()}
        answers.append({"name": added, "added": True, "parameters": full})
    return base, answers


def _number(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else float(value)


def _payload(base: Model, plan: Manoeuvre) -> dict[str, Any] | None:
    if not plan.payload_share:
        return None
    mass = round(plan.payload_share * base.rover.mass, 3)
    return {"payload_kg": mass, "payload_position_m": [0.0, 0.0, 0.2]}


def _planned(out: Path, rover: str, model: Model, moves: Commands, settings: Mapping[str, Any]) -> Log:
    """The log as far as it is known before the drive, so that the model is made as a reader will make it."""
    time = moves.interval * np.arange(len(moves.values))
    channels = dict(zip(command_channels(model), moves.values.T, strict=True))
    table = LogTable("drive", out / "drive.csv", time, channels, 1.0 / moves.interval)
    return Log(
        folder=out,
        name=out.name,
        rover=rover,
        manoeuvre=settings["manoeuvre"],
        gravity_m_s2=settings["gravity_m_s2"],
        terrain=settings["terrain"],
        split=None,
        environment=settings["environment"] or {},
        rover_changes=settings["rover_changes"] or {},
        initial={},
        imu=Imu(),
        tables={"drive": table},
        noise={},
        source={},
    )


def _drive(
    model: Model, moves: Commands, start: tuple[float, float, float], engine: str
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Stands, then drives: time from 0, and what perfect instruments with the model's sensor effects would write."""
    steps_per_command = round(moves.interval / model.timestep)
    split = next(
        k
        for k in range(1, steps_per_command + 1)
        # The coarsest telemetry that is fine enough, in whole parts of a command.
        if (steps_per_command % k == 0 and moves.interval / k <= SIMULATED_DRIVE.finest) or k == steps_per_command
    )
    fine = np.repeat(moves.values, split, axis=0)
    interval = moves.interval / split
    settle = round(SIMULATED_DRIVE.settle / interval)
    # Commands of zero: the rover stands and sinks in before its clock begins.
    still = np.zeros((settle, fine.shape[1]))
    system, seen = simulate(model, Commands(np.concatenate([still, fine]), interval), *start, engine=engine)
    # the log's clock begins when the rover stands; what is measured before is left out
    seen = _after(seen, settle, np.asarray(seen.time)[settle])
    constant = None if bus.tells_bus_voltage(model.effect_names) else BUS_VOLTAGE
    # Which channels a log has must not tell what is hidden: those of every rover, and its bus.
    names = (*observe(system, seen, bus_voltage=constant).channels, bus.BUS_VOLTAGE)
    signals = measure(system, seen, bus_voltage=constant).channels
    channels = {n: np.asarray(signals[n], float) for n in names if n in signals}
    # A bus that never sags: without the channel its absence would tell that nothing is hidden there.
    channels.setdefault(bus.BUS_VOLTAGE, np.full(len(fine), BUS_VOLTAGE))
    if not all(np.isfinite(v).all() for v in channels.values()):
        raise UserError("log simulate: an effect at the port sensor gives values that are not finite; mend the effect.")
    time = interval * np.arange(len(fine))
    sent = dict(zip(command_channels(model), fine.T, strict=True))
    return time, {**sent, **channels}


def _after(seen: Any, first: int, origin: float) -> Any:
    import jax

    later = jax.tree.map(lambda a: np.asarray(a)[first:], seen)
    return dataclasses.replace(later, time=later.time - origin)
