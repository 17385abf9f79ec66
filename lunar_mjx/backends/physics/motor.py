"""Motors: control in four modes, cut-off, torque from current (eqs. 6, 7, 15, 16), and their heat (eqs. 1-5)."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values

REFERENCE = 298.15
"""K; where the catalogue states resistance and torque constant."""

STEFAN_BOLTZMANN = 5.670374419e-8
"""W/m2/K4 (CODATA 2018)."""


def controller(c: Context, p: SimpleNamespace) -> np.ndarray:
    """Motor current asked for, A: PD in position mode, P in velocity mode, else the target; within the limit."""
    numbers, motor = c.numbers, c.numbers.effects["motor"]
    error = np.where(numbers.mode == 0, c.target - c.joint_angle, 0.0)
    speed = c.joint_speed - np.where(numbers.mode == 1, c.target, 0.0)
    # One formula for both loops: the position loop's speed error is the speed itself.
    torque = numbers.position_gain * error - numbers.velocity_gain * speed
    torque = np.where(numbers.mode < 2, torque, c.target)
    own = motor.gear_ratio * motor.gear_efficiency * motor.torque_constant
    current = torque / np.where(p.assumed_torque_per_ampere > 0.0, p.assumed_torque_per_ampere, own)
    current = np.where(numbers.mode == 3, c.target, current)
    return np.minimum(np.maximum(current, -p.current_limit), p.current_limit)


def cut_off(c: Context, p: SimpleNamespace, state: Values) -> Values:
    """No current from the moment a winding reaches the limit until it has cooled by the hysteresis."""
    hot = c.winding_temperature >= p.temperature
    open_ = hot | ((state["tripped"] > 0.5) & (c.winding_temperature >= p.temperature - p.hysteresis))
    if open_.any():
        c.current = np.where(open_, 0.0, c.current)
    return {"tripped": open_.astype(float)}


def winding(motor: SimpleNamespace, temperature: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R = R_0 (1 + alpha dT), ohm, and K = K_0 (1 + beta dT), N m/A (eqs. 6, 7)."""
    rise = temperature - REFERENCE
    return motor.resistance * (1.0 + motor.alpha * rise), motor.torque_constant * (1.0 + motor.beta * rise)


def largest_damping(c: Context) -> np.ndarray:
    """J/dt, N m s/rad: the damping that an explicit step takes without turning a joint around."""
    motor = c.numbers.effects.get("motor")
    rotor = 0.0 if motor is None else motor.rotor_inertia * motor.gear_ratio**2
    return np.maximum(c.numbers.joint_inertia + rotor, 1e-3) / c.dt


def voltage_limit(c: Context, p: SimpleNamespace, state: Values) -> Values:
    """V' = V/(1 + (V/V_bus)^8)^(1/8) with V = R I + K N omega; what it takes from the current is `correction`, A."""
    motor = c.numbers.effects["motor"]
    constant = c.torque_constant * motor.gear_ratio
    voltage = c.resistance * c.current + constant * c.joint_speed
    # The eighth power: see `voltage_saturation`, of which this is the plain form.
    within = voltage * (1.0 + p.limit * np.abs(voltage / 48.0) ** 8) ** -0.125
    # limited voltage acts like a damper; where it is stiffer than the inertia takes in a step, the correction is
    # filtered, or an explicit step would turn the joint around
    per_ampere = motor.gear_ratio * motor.gear_efficiency * motor.torque_constant
    stiffness = per_ampere * constant / c.resistance / largest_damping(c)
    wanted = (within - voltage) / c.resistance
    correction = state["correction"] + (wanted - state["correction"]) / (1.0 + np.maximum(stiffness - 0.5, 0.0))
    c.current = c.current + correction
    return {"correction": correction}


def gear_losses(c: Context, p: SimpleNamespace) -> None:
    """tau eta^sgn(tau omega) in place of tau eta, with tanh(omega/omega_s) for the sign of the speed."""
    eta = c.numbers.effects["motor"].gear_efficiency
    level = 0.5 * p.asymmetry * (eta**-2 - 1.0) * np.abs(c.torque)
    way = np.sign(c.torque) * np.tanh(c.joint_speed / np.maximum(p.speed, level / largest_damping(c)))
    c.torque = c.torque * (1.0 + p.asymmetry * (eta ** (way - 1.0) - 1.0))


def heat_flow(c: Context, winding_K: np.ndarray, housing_K: np.ndarray) -> Values:
    """Net heat into winding and housing, W, and their capacities, J/K, at given temperatures."""
    effects = c.numbers.effects
    zero = np.zeros_like(winding_K)
    into_winding, into_housing = zero, zero
    capacity_w, capacity_h = zero + 1.0, zero + 1.0
    for name in c.numbers.order:
        p = effects[name]
        if name == "motor":
            resistance = p.resistance * (1.0 + p.alpha * (winding_K - REFERENCE))
            into_winding = into_winding + c.current * c.current * resistance * c.resistance_factor
            capacity_w, capacity_h = zero + p.winding_capacity, zero + p.housing_capacity
        elif name == "winding_conduction":
            into_winding = into_winding - (winding_K - housing_K) / effects["motor"].R_th1
        elif name == "rotor_stator_path":
            into_housing = into_housing + p.share * (winding_K - housing_K) / effects["motor"].R_th1
        elif name == "housing_convection":
            into_housing = into_housing - (housing_K - c.ambient_temperature) / p.R_th2
        elif name == "housing_conduction":
            into_housing = into_housing - p.conductance * (housing_K - c.ambient_temperature)
        elif name == "housing_radiation":
            # Two products: NumPy's power is slower by far.
            squared = housing_K * housing_K
            lost = squared * squared - c.ambient_temperature**4
            into_housing = into_housing - p.emissivity * STEFAN_BOLTZMANN * p.area * lost
        elif name == "gear_friction_heat":
            m = effects["motor"]
            constant = m.torque_constant * (1.0 + m.beta * (winding_K - REFERENCE))
            given = m.gear_ratio * constant * c.current - c.torque
            into_housing = into_housing + p.share * given * c.joint_speed
    return {
        "winding": into_winding,
        "housing": into_housing,
        "winding_capacity": capacity_w,
        "housing_capacity": capacity_h,
    }
