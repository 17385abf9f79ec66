"""Electric motors: control electronics, torque from current, and the heat that they make.

Source of the equations: the seed paper's (6), (7), (15), (16), with the gear that it leaves out (PHYSICS flaw 8).
Motor data: maxon ECX TORQUE 22 XL with GPX 26 HP gearhead, catalogue values at 25 degC.
"""

from __future__ import annotations

import dataclasses
from typing import Annotated

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, StateVariable, effect

REFERENCE_TEMPERATURE: Annotated[float, "K"] = 298.15
"""T_R0 of eqs. 6 and 7, K (25 degC): where the catalogue states resistance and torque constant."""

WINDINGS = {
    12: {"resistance": 0.292, "torque_constant": 17.0e-3, "current_limit": 41.1},
    18: {"resistance": 0.757, "torque_constant": 28.3e-3, "current_limit": 23.8},
    24: {"resistance": 1.24, "torque_constant": 37.7e-3, "current_limit": 19.4},
    36: {"resistance": 2.87, "torque_constant": 54.6e-3, "current_limit": 12.5},
    48: {"resistance": 4.13, "torque_constant": 71.6e-3, "current_limit": 11.6},
}
"""Windings by nominal voltage, V: resistance ohm, torque constant N m/A, stall current A."""

# Numbers and not names: arrays of joints hold them, so that one step serves all modes.
POSITION, VELOCITY, TORQUE, CURRENT = range(4)
MODES = ("position", "velocity", "torque", "current")
MODE_UNITS = ("rad", "rad/s", "N m", "A")

_MAXON = "maxon ECX TORQUE 22 XL, 48 V winding"


def torque_per_ampere(motor) -> jnp.ndarray:
    """N m at the joint per ampere at 25 degC."""
    return motor.gear_ratio * motor.gear_efficiency * motor.torque_constant


def asked_per_ampere(parameters) -> jnp.ndarray:
    """N m at the joint that the controller expects of an ampere.

    Args:
      parameters: of all effects, by name, those of `motor` and `joint_control` among them.
    """
    own = torque_per_ampere(parameters["motor"])
    if "joint_control" not in parameters:
        return own
    assumed = parameters["joint_control"].assumed_torque_per_ampere
    return jnp.where(assumed > 0.0, assumed, own)


@effect(
    "command",
    requires=("motor",),
    order=50,
    current_limit=Parameter(
        11.6, None, (0.0, 1e3), "A", "largest current of the amplifier", _MAXON + ", stall current", axis="joint"
    ),
    assumed_torque_per_ampere=Parameter(
        0.0,
        None,
        (0.0, 1e6),
        "N m/A",
        "torque at the joint that the controller expects of an ampere; 0: what the motor gives at 25 degC",
        "choice: a controller that knows its motor",
        axis="joint",
    ),
)
def joint_control(ctx, p, x, command):
    """Turns each joint's target into a motor current by the joint's control mode.

    Position: PD, tau = k_p (q* - q) - k_d qdot. Velocity: P, tau = k_d (omega* - omega). Torque: tau = target, asked
    for as the current that gives it at 25 degC (eq. 15). Current: passed on. Source: seed paper III-D. A controller
    whose numbers are the data sheet's (`assumed_torque_per_ampere`) asks for the current by these, whatever motor was
    built in.
    """
    rover = ctx.rover
    target, mode = command.target, rover.mode
    position = rover.position_gain * (target - ctx.joint_angle) - rover.velocity_gain * ctx.joint_speed
    # Without feedforward: the paper's controller has none, and a steady drag then shows as a steady speed error.
    velocity = rover.velocity_gain * (target - ctx.joint_speed)
    torque = jnp.where(mode == POSITION, position, jnp.where(mode == VELOCITY, velocity, target))
    # The controller does not know how warm the winding is: it asks for the current that gives the torque at 25 degC.
    current = jnp.where(mode == CURRENT, target, torque / asked_per_ampere(ctx.parameters))
    # The amplifier clips current, whatever asked for it: a torque limit would move with the winding's temperature.
    return dataclasses.replace(command, current=jnp.clip(current, -p.current_limit, p.current_limit))


def winding_resistance(motor, temperature):
    """Eq. 6: R = R_0 (1 + alpha (T_R - T_R0)), ohm."""
    return motor.resistance * (1.0 + motor.alpha * (temperature - REFERENCE_TEMPERATURE))


def torque_constant(motor, temperature):
    """Eq. 7: K = K_0 (1 + beta (T_R - T_R0)), N m/A."""
    return motor.torque_constant * (1.0 + motor.beta * (temperature - REFERENCE_TEMPERATURE))


@effect(
    "command",
    order=60,
    state={"tripped": StateVariable(0.0, "1", "1 while the cut-off is open", axis="joint")},
    temperature=Parameter(
        423.15, None, (273.15, 1e4), "K", "winding temperature that cuts the current", "seed paper: 150 degC"
    ),
    hysteresis=Parameter(
        20.0, 0.0, (0.0, 500.0), "K", "cooling below the cut-off before the current returns", "choice"
    ),
)
def thermal_cutoff(ctx, p, x, command):
    """No current, hence no torque, from the moment a winding reaches 150 degC until it has cooled (seed paper III-C2).

    Without hysteresis the current returns at the next step and the motor chatters at the cut-off.
    """
    closes_at = p.temperature - p.hysteresis
    # A state of floats holds the flag, since states of all effects are one kind of array.
    # Hysteresis needs the state: between the two temperatures both answers are right, and the past decides.
    stays = (x.tripped > 0.5) & (ctx.winding_temperature >= closes_at)
    tripped = (ctx.winding_temperature >= p.temperature) | stays
    current = jnp.where(tripped, 0.0, command.current)
    return dataclasses.replace(command, current=current), {"tripped": jnp.where(tripped, 1.0, 0.0)}


def _motor_torque(ctx, p, x, torque):
    constant = torque_constant(p, ctx.winding_temperature)
    return torque + p.gear_ratio * p.gear_efficiency * constant * ctx.command.current


def _motor_heat(ctx, p, x, heat):
    # I^2 R with the resistance of the warm winding: copper gains 0.4 % per kelvin, so a hot winding heats faster still.
    joule = ctx.command.current**2 * winding_resistance(p, ctx.winding_temperature)
    one = jnp.ones_like(joule)
    return dataclasses.replace(
        heat,
        winding=heat.winding + joule,
        # The motor sets the capacities that every other heat path uses; there is one motor for every joint.
        winding_capacity=p.winding_capacity * one,
        housing_capacity=p.housing_capacity * one,
    )


@effect(
    "motor_torque",
    requires=("motor",),
    order=1,
    beta_2=Parameter(
        -2e-6,
        0.0,
        (-1.2e-5, 1.2e-5),
        "1/K2",
        "quadratic temperature coefficient of the magnet",
        "choice: NdFeB loses 2 % more than linearly at 125 degC",
    ),
)
def magnet_nonlinearity(ctx, p, x, torque):
    """K = K_0 (1 + beta dT + beta_2 dT^2), dT = T_R - 25 degC, in torque and back-EMF.

    Reversible: lasting demagnetisation is left out.
    """
    parameters = ctx.parameters["motor"]
    return torque + torque_per_ampere(parameters) * _quadratic(p, ctx.winding_temperature) * ctx.command.current


def _quadratic(p, temperature):
    return p.beta_2 * (temperature - REFERENCE_TEMPERATURE) ** 2


def constant_at(parameters, temperature):
    """The torque constant K at a winding temperature, N m/A, with magnet_nonlinearity where it is in the list."""
    motor, magnet = parameters["motor"], parameters.get("magnet_nonlinearity")
    linear = torque_constant(motor, temperature)
    return linear if magnet is None else linear + motor.torque_constant * _quadratic(magnet, temperature)


motor = Effect(
    name="motor",
    ports={"motor_torque": _motor_torque, "heat": _motor_heat},
    parameters={
        "resistance": Parameter(4.13, None, (1e-3, 1e3), "ohm", "winding resistance at 25 degC", _MAXON, "joint"),
        "torque_constant": Parameter(
            71.6e-3, None, (1e-5, 10.0), "N m/A", "torque constant at 25 degC", _MAXON, "joint"
        ),
        "alpha": Parameter(0.0040, 0.0, (0.0, 0.02), "1/K", "temperature coefficient of the winding", "copper"),
        "beta": Parameter(-0.0012, 0.0, (-0.02, 0.0), "1/K", "temperature coefficient of the magnet", "NdFeB"),
        "gear_ratio": Parameter(
            243.0,
            None,
            (1.0, 1e4),
            "1",
            "gear reduction",
            "maxon GPX 26 HP, smallest four-stage ratio; choice",
            "joint",
        ),
        "gear_efficiency": Parameter(
            0.75, None, (0.05, 1.0), "1", "gear efficiency", "choice for a 3- or 4-stage gear", "joint"
        ),
        "rotor_inertia": Parameter(
            9e-7, 0.0, (0.0, 1e-2), "kg m2", "rotor inertia", "estimate for a 22 mm motor; not in the paper", "joint"
        ),
        "winding_capacity": Parameter(
            4.07,
            None,
            (1e-3, 1e6),
            "J/K",
            "heat capacity of the winding C_R",
            "winding time constant 10 s over R_th1; choice",
        ),
        "housing_capacity": Parameter(
            55.0,
            None,
            (1e-3, 1e6),
            "J/K",
            "heat capacity of the housing C_S",
            "housing time constant 10 min over R_th2; choice",
        ),
        "R_th1": Parameter(2.46, None, (1e-3, 1e4), "K/W", "thermal resistance winding to housing", _MAXON),
    },
    doc="Torque N eta K(T_R) I (eqs. 7, 15, 16); Joule heat I^2 R(T_R) (eqs. 1, 6).",
)
