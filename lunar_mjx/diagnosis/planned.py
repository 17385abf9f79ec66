"""Measurements not made yet: canned manoeuvres, and sweeps of a test bed, with the instruments of a campaign."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.errors import UserError
from lunar_mjx.logs import Log, SteadyLog
from lunar_mjx.logs.log import LogTable, Noise
from lunar_mjx.logs.schema import is_command, suffix_of
from lunar_mjx.manoeuvres import MANOEUVRES, commands, load_manoeuvre
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.simulate import command_channels
from lunar_mjx.wheel_bed.table import QUANTITIES, SteadyStateTable, average


@dataclasses.dataclass(frozen=True)
class PlannedSweeps:
    """Sweeps of a test bed that are proposed."""

    angles: tuple[float, ...] = (0.0, 15.0, 30.0, 45.0, 60.0)
    """Slip angles of planned sweeps, deg."""
    loads: tuple[float, float, float] = (0.5, 1.0, 2.0)
    """Loads of planned sweeps, as a share of the median one so far."""
    replicates: int = 3


PLANNED = PlannedSweeps()

SLIPS = np.linspace(-0.3, 0.8, 12)


def planned_drives(logs: Sequence[Log], model: Model, seconds: float) -> list[tuple[str, str, Log]]:
    """Every canned manoeuvre as an empty log with the channels, rates and noise of a campaign.

    Args:
      logs: of the campaign. model: its model. seconds: most that a planned drive lasts; longer ones are scaled down.

    Returns:
      Name, description and log of each manoeuvre that the rover can drive.
    """
    drives = []
    for name in MANOEUVRES:
        plan = load_manoeuvre(name)
        own = model.replace(modes={"drive": plan.drive_mode})
        try:
            moves = commands(plan, own, min(1.0, seconds / plan.duration_s))
        except UserError:
            continue  # not a manoeuvre for this rover
        time = moves.interval * np.arange(len(moves.values))
        # The best instrumented drive: what was measured once can be measured again.
        template = max(logs, key=lambda log: len(log.channel_names))
        ambient = template.environment.get("ambient_temperature_degC")
        environment = {"ambient_temperature_degC": ambient} if isinstance(ambient, float | int) else {}
        environment |= plan.environment
        kelvin = float(environment.get("ambient_temperature_degC", model.ambient[0] - ZERO_CELSIUS))
        drive = dict(zip(command_channels(own), moves.values.T, strict=True))
        tables = {"commands": LogTable("commands", Path(name), time, drive, 1.0 / moves.interval)}
        for table in template.tables.values():
            channels = [c for c in table.channels if not is_command(c)]
            count = int(time[-1] * table.rate_hz) + 1
            if channels and count > 1:
                fill = {c: np.full(count, _first(c, plan.start, kelvin)) for c in channels}
                sample_times = np.arange(count) / table.rate_hz
                tables[table.name] = LogTable(table.name, Path(name), sample_times, fill, table.rate_hz)
        payload = {"payload_kg": plan.payload_share * model.rover.mass, "payload_position_m": (0.0, 0.0, 0.2)}
        drives.append(
            (
                name,
                plan.description,
                Log(
                    folder=Path(name),
                    name=name,
                    rover=template.rover,
                    manoeuvre=name,
                    gravity_m_s2=template.gravity_m_s2,
                    terrain=plan.terrain,
                    split="fit",
                    environment=environment,
                    rover_changes={**template.rover_changes, **(payload if plan.payload_share else {})},
                    initial={"position_m": (plan.start[0], plan.start[1], model.rover.standing_height)},
                    imu=template.imu,
                    tables=tables,
                    noise=template.noise,
                    source={},
                ),
            )
        )
    return drives


def _first(channel: str, start: tuple[float, float, float], celsius: float) -> float:
    """First value of a planned channel, as far as the start of a simulation reads it."""
    known = {"position_x_m": start[0], "position_y_m": start[1], "yaw_deg": float(np.degrees(start[2]))}
    return celsius if suffix_of(channel) == "degC" else known.get(channel, 0.0)


def planned_sweeps(logs: Sequence[SteadyLog]) -> list[tuple[str, str, SteadyLog]]:
    """Slip sweeps at other loads and slip angles, and with what has not been measured yet, as empty tables."""
    template = logs[0]
    table = average(template.table)
    load = float(np.median(table.test["normal_load_N"]))
    sigma = {q: s for q in table.measured if (s := _sigma(template, table, q)) > 0.0}
    # What was never measured has no noise yet: force sensors are taken to be alike, and torque is force times radius.
    reference = sigma.get("drawbar_pull", sigma.get("side_force", 0.01 * load))
    typical = {
        "drawbar_pull": reference,
        "side_force": reference,
        "driving_torque": reference * table.radius,
        "sinkage": 5e-4,
    }
    sweeps = []
    for share in PLANNED.loads:
        for angle in PLANNED.angles:
            name = f"slip sweep at {angle:g} deg slip angle, {share * load:.3g} N"
            sweeps.append(
                (
                    name,
                    "twelve slip ratios from -0.3 to 0.8, three runs each",
                    _sweep(template, name, angle, share * load, sigma),
                )
            )
    missing = [q for q in QUANTITIES if q not in table.measured]
    if missing:
        names = " and ".join(QUANTITIES[q][2] for q in missing)
        for angle in (0.0, 30.0):
            name = f"slip sweep at {angle:g} deg slip angle, {load:.3g} N, measuring {names} too"
            conditions = {**typical, **sigma}
            sweeps.append(
                (
                    name,
                    "twelve slip ratios from -0.3 to 0.8, three runs each",
                    _sweep(template, name, angle, load, conditions),
                )
            )
    return sweeps


def _sigma(log: SteadyLog, table: SteadyStateTable, quantity: str) -> float:
    """Standard deviation of the noise of a quantity in one run of a table."""
    stated: Any = log.noise.get(QUANTITIES[quantity][0])
    return float(table.sigma.get(quantity, stated.std if stated is not None else 0.0))


def _sweep(template: SteadyLog, name: str, angle: float, load: float, sigma: dict[str, float]) -> SteadyLog:
    count = len(SLIPS)
    table = dataclasses.replace(
        template.table,
        name=name,
        test={"slip_ratio": SLIPS, "slip_angle_deg": np.full(count, angle), "normal_load_N": np.full(count, load)},
        # No values: a plan is judged by predictions and noise alone.
        measured={q: np.zeros(count) for q in sigma},
        replicates=np.ones(count, int),
        sigma={},
    )
    noise = {QUANTITIES[q][0]: Noise(s / np.sqrt(PLANNED.replicates), "replicate") for q, s in sigma.items()}
    return dataclasses.replace(template, folder=Path(name), table=table, noise=noise, split="fit")
