"""Who draws electric power, the panels that make it and the battery that stores it (port `power`)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, StateVariable, effect
from lunar_mjx.effects.joint.motor import constant_at, winding_resistance
from lunar_mjx.terrain.sky import fixed_sun


@effect(
    "power",
    requires=("motor",),
    efficiency=Parameter(
        0.95, None, (0.1, 1.0), "1", "efficiency of the motors' amplifiers", "choice: 48 V MOSFET bridge"
    ),
    returned=Parameter(
        0.0,
        None,
        (0.0, 1.0),
        "1",
        "share of the power of braking motors that reaches the bus",
        "choice: a brake resistor",
    ),
)
def motor_power(ctx, p, x, power):
    """P = sum of I (R I + K N omega)/eta over driving motors; of braking ones the share `returned` flows back.

    What amplifiers and brake resistors lose heats the chassis; the windings' own loss R I^2 is in P and heats them.
    """
    motor = ctx.parameters["motor"]
    current = ctx.command.current
    back_emf = constant_at(ctx.parameters, ctx.winding_temperature) * motor.gear_ratio * ctx.joint_speed
    per_motor = current * (winding_resistance(motor, ctx.winding_temperature) * current + back_emf)
    # motor by motor: on one rover some drive while others brake, and only a driving one pays the amplifier's loss
    drawn, braking = jnp.sum(jnp.maximum(per_motor, 0.0)), jnp.sum(jnp.minimum(per_motor, 0.0))
    # Returned power is negative load, so that a rover downhill may charge its battery.
    load = drawn / p.efficiency + p.returned * braking
    # The balance of energy: what is drawn and reaches no motor, and braking power that is not returned, heats the
    # chassis.
    return dataclasses.replace(power, load=power.load + load, loss=power.loss + load - drawn - braking)


@effect(
    "power",
    load=Parameter(
        60.0, 0.0, (0.0, 1e4), "W", "draw of computers, radios, instruments", "choice: a rover of some 100 kg at work"
    ),
)
def electronics(ctx, p, x, power):
    """P += P_0, all of which ends as heat in the chassis; what an antenna radiates is left out."""
    return dataclasses.replace(power, load=power.load + p.load, loss=power.loss + p.load)


def _panel(side: str, area: float, source: str) -> Parameter:
    return Parameter(area, 0.0, (0.0, 100.0), "m2", f"area of the panel that faces {side}", source)


@effect(
    "power",
    top=_panel("up", 0.0, "choice: none, since the Sun is low near the poles"),
    front=_panel("ahead", 0.0, "choice: cameras look out there"),
    rear=_panel("back", 1.0, "choice: three upright panels, as VIPER has"),
    left=_panel("to the left", 1.0, "choice: three upright panels, as VIPER has"),
    right=_panel("to the right", 1.0, "choice: three upright panels, as VIPER has"),
    efficiency=Parameter(
        0.25,
        None,
        (0.01, 0.6),
        "1",
        "electric power over sunlight on the panels",
        "triple-junction cells of 0.30 on 85 % of the area; choice",
    ),
)
def solar_panels(ctx, p, x, power):
    """P = eta E sum A_i max(0, n_i . s): panels on the five sides of the chassis, which turn with it.

    s and the irradiance E are those of the model's Sun, behind the terrain's horizon; without one it stands at an
    azimuth of 135 and an elevation of 15 deg. Boulders, the rover's own shadow, light thrown by the ground, dust and
    the cells' temperature are left out.
    """
    light = ctx.sunlight if ctx.sunlight is not None else _default_light(ctx)
    to = light.direction
    ahead, left, up = (to.dot(axis) for axis in (ctx.frame.forward, ctx.frame.left, ctx.frame.up))
    sides = ((p.top, up), (p.front, ahead), (p.rear, -ahead), (p.left, left), (p.right, -left))
    # Panels do not shade each other: opposite sides are never lit at once, and each counts only what faces the Sun.
    facing = sum(area * jnp.maximum(cosine, 0.0) for area, cosine in sides)
    return dataclasses.replace(power, solar=power.solar + p.efficiency * light.irradiance * facing)


def _default_light(ctx):
    return fixed_sun(dtype=jnp.result_type(ctx.dt)).light(ctx.time, ctx.position.x, ctx.position.y)


def open_voltage(p, charge):
    """Voltage of the battery without load, V, at a state of charge from 0 to 1."""
    return p.empty_voltage + (p.full_voltage - p.empty_voltage) * charge


def charge_of(p, used):
    """State of charge, 0 to 1, after `used` A s have been drawn since the reset."""
    return p.initial - used / p.capacity


_FOLLOW = 0.25
"""1; share of the way to the step's current by which the current behind the motors' voltage moves at each step.

Motors under their voltage limit draw less when the voltage sags, one step later. That loop multiplies an error by at
most 2 n R/R_w (n stalled motors of winding resistance R_w: 0.3 for six of 4.1 ohm behind 0.1 ohm) and would chatter
beyond 1; a quarter of the way holds it up to 7 and settles within some ten steps.
"""


def terminal_voltage(p, x):
    """Voltage of the battery under its load, V, as the step before left it; at reset that without load."""
    # The current of the step before breaks the loop between the voltage and the motors that draw by it.
    return open_voltage(p, charge_of(p, x.used)) - p.resistance * x.current


def _store(ctx, p, x, power):
    charge = charge_of(p, x.used)
    voltage = open_voltage(p, charge)
    needed = power.load - power.solar
    # U I - R I^2 = P, the root with the smaller current; beyond U^2/(4 R) the battery gives what it can
    # Clipped at zero: more power than U^2/(4 R) is not to be had.
    root = jnp.sqrt(jnp.maximum(voltage * voltage - 4.0 * p.resistance * needed, 0.0))
    # the quadratic's root without the difference U - root, which has no digits left at small loads
    current = 2.0 * needed / (voltage + root)
    # U/(2 R) is where a battery gives its largest power: more current would give less.
    current = jnp.clip(current, -voltage / (2.0 * p.resistance), voltage / (2.0 * p.resistance))
    # a full battery takes nothing more (panels are turned off), an empty one gives nothing more
    current = jnp.where(charge >= 1.0, jnp.maximum(current, 0.0), current)
    current = jnp.where(charge <= 0.0, jnp.minimum(current, 0.0), current)
    # Kahan's sum: in float32 a charge of 1e5 A s does not take the 1e-3 A s of a time step
    step = ctx.dt * current - x.used_lost
    used = x.used + step
    # with hysteresis: without it the first joule from the Sun would start the motors, which would stop again at once
    flat = jnp.where(charge <= p.cut_off, 1.0, jnp.where(charge >= p.cut_off + p.restart, 0.0, x.flat))
    loss = power.loss + p.resistance * current**2
    return dataclasses.replace(power, loss=loss, current=current, voltage=voltage - p.resistance * current), {
        "used": used,
        "used_lost": (used - x.used) - step,
        # The motors' voltage follows behind the current (see `_FOLLOW`); charge and reading take the current itself.
        "current": x.current + _FOLLOW * (current - x.current),
        "flat": flat,
    }


def _cut_off(ctx, p, x, command):
    return dataclasses.replace(command, current=jnp.where(x.flat > 0.5, 0.0, command.current)), {}


battery = Effect(
    name="battery",
    ports={"command": _cut_off, "power": _store},
    parameters={
        "capacity": Parameter(
            144e3, None, (1.0, 1e9), "A s", "charge that a full battery gives", "choice: 40 A h, 1.9 kW h at 48 V"
        ),
        "resistance": Parameter(
            0.1, None, (1e-6, 10.0), "ohm", "internal resistance", "choice: as bus_droop, 5 % of 48 V at 24 A"
        ),
        "full_voltage": Parameter(
            54.6, None, (1.0, 1e3), "V", "open-circuit voltage when full", "13 lithium-ion cells in series at 4.2 V"
        ),
        "empty_voltage": Parameter(
            39.0, None, (1.0, 1e3), "V", "open-circuit voltage when empty", "13 lithium-ion cells in series at 3.0 V"
        ),
        "initial": Parameter(0.9, None, (0.0, 1.0), "1", "state of charge at reset", "choice"),
        "cut_off": Parameter(
            0.05, None, (0.0, 1.0), "1", "state of charge at which the motors are cut off", "choice: cells are spared"
        ),
        "restart": Parameter(
            0.05, None, (0.0, 1.0), "1", "charge above the cut-off at which they get current again", "choice"
        ),
    },
    state={
        "used": StateVariable(0.0, "A s", "charge drawn since the reset", axis="rover"),
        "used_lost": StateVariable(0.0, "A s", "rounding that its last sum lost", axis="rover", rounding_of="used"),
        "current": StateVariable(0.0, "A", "current of the last steps, which lowers the motors' voltage", axis="rover"),
        "flat": StateVariable(0.0, "1", "1 while the motors are cut off", axis="rover"),
    },
    replaces=("bus_droop",),
    order=100,
    doc="""dq/dt = -I/Q with U(q) I - R I^2 = P, U linear in the state of charge q: a battery behind a resistance.

    P is what the other effects at the port draw less what panels give. R I^2 heats the chassis. A full battery takes no
    more and an empty one gives no more; below `cut_off` the motors get no current (electronics draw on). U - R I of the
    last steps is the voltage at which voltage_saturation limits the motors, and the channel bus_voltage_V.""",
)
