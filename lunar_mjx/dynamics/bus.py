"""What all motors together take from the bus: its current, by the balance of power. Pure JAX, time on the last axis."""

from __future__ import annotations

from collections.abc import Collection
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.state import Params, Telemetry
from lunar_mjx.effects.joint.electrical import sagged_voltage

BUS_CURRENT, BUS_VOLTAGE = "bus_current_A", "bus_voltage_V"
"""Channels of the supply: the current that it gives, positive when drawn, and its voltage."""
_SUPPLIES = frozenset({"battery", "bus_droop"})


def tells_bus_voltage(effects: Collection[str]) -> bool:
    """Whether a model with effects of these names predicts the voltage of its bus."""
    return not _SUPPLIES.isdisjoint(effects)


def bus_current(seen: Telemetry, params: Params, voltage: Any = None) -> Any:
    """The current that the battery or bus gives, A: (P_drawn - P_solar)/V_bus, positive when drawn.

    A motor behind an amplifier with pulse-width modulation takes its power from the bus, and not its current: at half
    of the bus's voltage it takes half of its current. P_drawn is the sum of V_m I_m over all motors: lossless
    amplifiers, by which the power of braking motors flows back, first into the other motors; or what `motor_power`
    makes of it, where the model has that. What the harness loses is in it, and the load of other effects at the port
    `power`. What nobody told the model of, such as its electronics, is not.

    Args:
      seen: telemetry, (time,) or (batch, time).
      params: of the drive. Those of `bus_droop` are a number or (batch,). The resistance of the harness is a number,
        (joint,) or (batch, joint); one of each rover is (batch, 1), since (batch,) cannot be told from (joint,).
      voltage: of the bus, V, a number, (time,) or (batch, time); by the model's own supply if None.

    Returns:
      The current at the times of the telemetry; None where nobody knows the voltage.
    """
    motors = jnp.sum(seen.voltage * seen.current, axis=-1)
    if voltage is None:
        voltage = _own_voltage(seen, params, motors)
    if voltage is None:
        return None
    power = 0.0 if "motor_power" in params.effects else motors
    harness = params.effects.get("harness_resistance")
    if harness is not None:
        resistance = harness["resistance"]
        resistance = resistance[..., None, :] if np.ndim(resistance) > 1 else resistance
        power = power + jnp.sum(resistance * seen.current**2, axis=-1)
    supply = seen.supply
    if supply is not None and supply.load is not None and supply.solar is not None:
        power = power + supply.load - supply.solar
    return power / voltage


def _own_voltage(seen: Telemetry, params: Params, motors: Any) -> Any:
    """Voltage of the bus, V, by the model's battery or `bus_droop` at the motors' power, W; None without either."""
    if seen.supply is not None and seen.supply.voltage is not None:
        return seen.supply.voltage
    droop = params.effects.get("bus_droop")
    if droop is None:
        return None
    over_time = {k: v[..., None] if np.ndim(v) else v for k, v in droop.items()}
    return sagged_voltage(SimpleNamespace(**over_time), motors)
