"""What logs of drives hold and the model cannot use, so that it can be said once, aloud."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from lunar_mjx.dynamics.bus import BUS_CURRENT, BUS_VOLTAGE
from lunar_mjx.logs import Log
from lunar_mjx.logs.attitude import EULER, QUATERNION
from lunar_mjx.logs.schema import is_command, is_quantity, parse_name

REASONS: Mapping[str, str] = {
    "drawbar_pull": "a pull on a tether is no input of the model yet; compare drives without one",
    "bus_voltage": "the model has no supply; add the effect bus_droop to compare it",
    "bus_current": "nobody knows the voltage of the bus; log bus_voltage_V, or add bus_droop with the rover's voltage",
    "wheel_slip_angle": "no camera's slip angle is compared yet",
    "left": "the model's rover drives every wheel by a motor of its own",
    "right": "the model's rover drives every wheel by a motor of its own",
}
"""Why channels are not compared, by their quantity, or by the side that they stand for."""
OTHERWISE = "the model does not predict it"


def unused_channels(
    log: Log, compared: Collection[str], reasons: Mapping[str, str] = REASONS, otherwise: str = OTHERWISE
) -> dict[str, str]:
    """Channels of a log that nothing of a comparison reads, with the reason.

    Commands, imposed speeds, conditions of the environment, quaternions beside their angles and the voltage beside the
    current of the bus are read, though they are not compared.

    Args:
      log: of a drive. compared: channels that the problem compares.
      reasons: by quantity or side. otherwise: of all others.
    """
    read = {v for v in log.environment.values() if isinstance(v, str)}
    if any(e in compared for e in EULER):
        read |= set(QUATERNION)
    if BUS_CURRENT in compared:
        # The power of the motors is divided by it.
        read.add(BUS_VOLTAGE)
    out = {}
    for name in log.channel_names:
        speed = is_quantity(name, "joint_speed", "drive")
        if name in compared or name in read or is_command(name) or (log.imposed and speed):
            continue
        parts = parse_name(name)
        places = () if parts is None else (parts.quantity, parts.corner)
        out[name] = next((reasons[p] for p in places if p in reasons), otherwise)
    return out


def unused_sentence(
    logs: Sequence[Log],
    compared: Sequence[Collection[str]],
    reasons: Mapping[str, str] = REASONS,
    otherwise: str = OTHERWISE,
) -> str:
    """What the logs of a campaign hold and nothing reads, as one sentence; empty if all is read.

    Args:
      logs: of drives. compared: channels that are compared, by log. reasons, otherwise: as for `unused_channels`.
    """
    by_reason: dict[str, dict[str, None]] = {}
    for log, own in zip(logs, compared, strict=True):
        for name, why in unused_channels(log, own, reasons, otherwise).items():
            by_reason.setdefault(why, {})[name] = None
    parts = [f"{', '.join(names)} ({why})" for why, names in by_reason.items()]
    return f"Not used: {'; '.join(parts)}." if parts else ""
