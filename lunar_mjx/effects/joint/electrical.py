"""The supply of the motors: the bus that limits their voltage, and how it sags (ports `command` and `sensor`)."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Any

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect
from lunar_mjx.effects.joint.friction import largest_damping
from lunar_mjx.effects.joint.motor import constant_at, torque_per_ampere, winding_resistance

BUS_VOLTAGE: Annotated[float, "V"] = 48.0
"""V; bus voltage at which `voltage_saturation.limit` is 1."""

SHARPNESS = 8
"""Power p of the limit V' = V/(1 + |V/V_bus|^p)^(1/p)."""


def limit_of(voltage: Any) -> Any:
    """`voltage_saturation.limit` of a bus of this voltage, V."""
    return (BUS_VOLTAGE / voltage) ** SHARPNESS


def voltage_of(limit: float) -> float:
    """Bus voltage, V, of a `voltage_saturation.limit`; infinite for 0."""
    return BUS_VOLTAGE * limit ** (-1.0 / SHARPNESS) if limit > 0.0 else float("inf")


@effect(
    "command",
    requires=("motor",),
    order=55,
    state={"correction": StateVariable(0.0, "A", "current taken away by the limit", axis="joint")},
    limit=Parameter(
        1.0,
        0.0,
        (0.0, 1e6),
        "1",
        "(48 V/V_bus)^8, with V_bus the largest voltage of the amplifier",
        "48 V bus, the winding's nominal voltage; 24 V is 256, 30 V is 42.9, 60 V is 0.168",
    ),
)
def voltage_saturation(ctx, p, x, command):
    """|R I + K N omega| <= V_bus: V' = V/(1 + |V/V_bus|^8)^(1/8), and the current is that of V'.

    V' is within 0.2 % of V up to 0.57 V_bus, 8 % below the sharp limit at V = V_bus, and within 0.5 % of it from
    1.5 V_bus on. The parameter is limit = (48 V/V_bus)^8, not 1/V_bus: the derivative by 1/V_bus is zero at its null,
    where no limit acts, so that no score test could see it; the derivative by `limit` at 0 is -V |V/48 V|^8/8.
    `limit_of` and `voltage_of` convert. With harness_resistance in the list the amplifier gives R_w I as well, and with
    bus_droop V_bus sags. With a battery in the list V_bus is the battery's voltage under load, and `limit` is not read.
    Where the back-EMF alone brakes faster than a time step follows (cold windings), the
    correction is relaxed over a few steps. Source: MuJoCo's dcmotor note (voltage limit).
    """
    motor = ctx.parameters["motor"]
    harness = ctx.parameters.get("harness_resistance")
    resistance = winding_resistance(motor, ctx.winding_temperature)
    resistance = resistance if harness is None else resistance + harness.resistance
    constant = constant_at(ctx.parameters, ctx.winding_temperature) * motor.gear_ratio
    voltage = resistance * command.current + constant * ctx.joint_speed
    limit = p.limit if ctx.bus_voltage is None else limit_of(ctx.bus_voltage)
    droop = ctx.parameters.get("bus_droop")
    if droop is not None:
        # The droop needs the power, and the power the droop: the voltage before it is taken, once. Sags of some per
        # cent leave an error of their square.
        power = jnp.sum(_limited(voltage, limit) * command.current)
        # a fifth at least: beyond the power that the resistance passes on, the formula turns negative
        sagged = jnp.maximum(1.0 - droop.resistance * power / droop.voltage**2, 0.2)
        limit = limit * sagged**-SHARPNESS
    # only the current can be changed; the back-EMF is given by the speed
    wanted = (_limited(voltage, limit) - voltage) / resistance
    # slope of the braking torque by speed, against what an explicit step takes
    stiffness = torque_per_ampere(motor) * constant / resistance / largest_damping(ctx)
    # Below half of what an explicit step takes, the correction acts at once; above it only as fast as the motor
    # follows.
    correction = x.correction + (wanted - x.correction) / (1.0 + jnp.maximum(stiffness - 0.5, 0.0))
    return dataclasses.replace(command, current=command.current + correction), {"correction": correction}


def _limited(voltage, limit):
    excess = limit * jnp.abs(voltage / BUS_VOLTAGE) ** SHARPNESS
    # expm1 and log1p: far below the limit V' - V is a difference of nearly equal numbers
    return voltage + voltage * jnp.expm1(-jnp.log1p(excess) / SHARPNESS)


def sagged_voltage(p: Any, power: Any) -> Any:
    """Voltage, V, of a bus with the parameters of `bus_droop` under the power of its motors, W."""
    # By V_0 and not by the sagged voltage: the equation in V would be quadratic, for a change of second order.
    return p.voltage - p.resistance * power / p.voltage


@effect(
    "sensor",
    order=-10,
    resistance=Parameter(
        0.1, 0.0, (0.0, 5.0), "ohm", "internal resistance of the battery and bus", "choice: 5 % of 48 V at 24 A"
    ),
    voltage=Parameter(
        BUS_VOLTAGE, None, (1.0, 500.0), "V", "voltage of the unloaded bus", "the winding's nominal voltage"
    ),
)
def bus_droop(ctx, p, x, signals):
    """V_bus = V_0 - R_b P/V_0 with P = sum V_m I_m of the motors (lossless amplifiers): the channel bus_voltage_V.

    It changes the motion only where voltage_saturation is in the list too, which then limits by the sagged voltage.
    """
    power = 0.0
    for joint in ctx.joints:
        power = power + signals.channels[f"motor_{joint}_voltage_V"] * signals.channels[f"motor_{joint}_current_A"]
    return signals.with_channels({"bus_voltage_V": sagged_voltage(p, power) + jnp.zeros_like(signals.time)})
