"""Evaluates the forces of a step in the order of the ports, with hooks between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lunar_mjx.backends.hooks import Hooks
from lunar_mjx.backends.physics import hard, motor, outdoors, printed, soil
from lunar_mjx.backends.physics.contact import momentary_slip, rim_plane, wheel_contact
from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.ground import Ground
from lunar_mjx.backends.physics.parameters import Numbers
from lunar_mjx.backends.physics.ruts import relief_of, ruts, untouched
from lunar_mjx.backends.physics.vectors import clamp

EffectState = dict[str, Values]

_SOIL = ("surface_type", "hard_surface", "soil_gradient")
_NORMAL: dict[str, Callable] = {
    "skid_shear": outdoors.skid_reversal,
    "pressure_sinkage": soil.pressure_sinkage,
    "stress_integral": soil.integral_normal,
    "penalty_contact": printed.penalty_contact,
    "hard_ground": hard.rock_normal,
}
_SHEAR: dict[str, Callable] = {
    "closed_form_shear": soil.closed_form_shear,
    "stress_integral": soil.integral_shear,
    "printed_shear": printed.printed_shear,
    "engine_friction": printed.engine_friction,
    "hard_ground": hard.rock_shear,
    "boulders": hard.boulders,
    "skid_shear": outdoors.skid_shear,
    "bulldozing": outdoors.bulldozing,
    "rolling_resistance": outdoors.rolling_resistance,
}
_BODY: dict[str, Callable] = {"chassis_contact": hard.chassis_contact, "joint_limits": hard.joint_limits}


class ForceModel:
    """The force models of a model, for any engine that can tell poses and take forces.

    Args:
      numbers: the model as plain numbers.
      ground: the terrain.
      hooks: functions that change the physics.
      rovers: how many.
    """

    def __init__(self, numbers: Numbers, ground: Ground, hooks: Hooks, rovers: int = 1) -> None:
        self.numbers, self.ground, self.hooks, self.rovers = numbers, ground, hooks, rovers
        order = numbers.order
        self._soil = tuple(n for n in order if n in _SOIL)
        self._normal = tuple((_NORMAL[n], numbers.effects[n]) for n in order if n in _NORMAL)
        self._shear = tuple((_SHEAR[n], numbers.effects[n]) for n in order if n in _SHEAR)
        self._body = tuple((n, _BODY.get(n), numbers.effects[n]) for n in order if n in (*_BODY, "parking_brake"))
        # -1 stands for no steering joint: index 0 is read and multiplied by zero.
        self._steer, self._steered = np.maximum(numbers.steer, 0), (numbers.steer >= 0).astype(float)
        self._nominal = self._drawn()
        # Computed once: the soil is the same everywhere and always.
        self._uniform = soil.uniform_soil(numbers.effects.get("soil"), self._nominal["radius"])

    def _drawn(self) -> Values:
        """The geometry with the model's own effects on it: radius error, toe, payload, shifted centre of mass."""
        n, numbers, effects = self.rovers, self.numbers, self.numbers.effects
        one = np.ones((n, len(numbers.radius)))
        point = {"payload": np.zeros((n, 3)), "com_offset": np.zeros((n, 3))}
        for name, vector in point.items():
            if name in effects:
                vector[:] = [getattr(effects[name], axis) for axis in "xyz"]
        error = effects["wheel_radius_error"].offset if "wheel_radius_error" in effects else 0.0
        toe = effects["steering_toe"].angle if "steering_toe" in effects else 0.0
        mass = effects["payload"].mass if "payload" in effects else 0.0
        return {
            "radius": numbers.radius * one + error,
            "width": numbers.width * one,
            "toe": one * toe,
            "payload_mass": np.full(n, mass),
            "payload_position": point["payload"],
            "com_offset": point["com_offset"],
        }

    def initial_state(self) -> EffectState:
        """State of the effects at reset."""
        wheel = np.zeros((self.rovers, len(self.numbers.radius)))
        joint = np.zeros((self.rovers, len(self.numbers.mode)))
        every = {
            "shear_state": {k: wheel.copy() for k in ("slip_x", "slip_y", "direction")},
            "thermal_cutoff": {"tripped": joint.copy()},
            "parking_brake": {"angle": joint.copy()},
            "voltage_saturation": {"correction": joint.copy()},
            "multipass": outdoors.no_places(*wheel.shape),
            "static_boulders": outdoors.no_bristles(*wheel.shape),
            "ruts": untouched(self.rovers),
        }
        return {k: v for k, v in every.items() if k in self.numbers}

    def start(self, c: Context, control: np.ndarray) -> None:
        """Completes the part of the context that needs no forces."""
        numbers = self.numbers
        c.numbers, c.ground, c.dt, c.gravity = numbers, self.ground, numbers.dt, numbers.gravity
        c.time = c.step * numbers.dt
        c.ambient_temperature = numbers.ambient_temperature(c.time)
        c.steering_angle = c.joint_angle.take(self._steer, -1) * self._steered
        c.control = control

    def forces(self, c: Context, state: EffectState) -> EffectState:
        """Fills the context from `target` to `body`; returns the effects' new state.

        Args:
          c: context that `start` completed.
          state: the effects' state, left as it is.
        """
        # A copy of the table, not of the arrays: functions return new ones.
        new = dict(state)
        self._motor(c, state, new)
        self._contact(c, state)
        self._wheels(c, state, new)
        n, hooks = self.rovers, self.hooks
        c.body = {"force": np.zeros((n, 3)), "moment": np.zeros((n, 3)), "joint_torque": np.zeros_like(c.joint_angle)}
        for name, function, p in self._body:
            if function is None:
                new[name] = hard.parking_brake(c, p, state[name])
            else:
                function(c, p)
        if "body" in hooks:
            c.body = hooks.call("body", c, c.body)
        return new

    def _motor(self, c: Context, state: EffectState, new: EffectState) -> None:
        effects, hooks = self.numbers.effects, self.hooks
        c.target = c.control
        if "command" in hooks:
            c.target = hooks.call("command", c, c.target.copy())
        current = np.zeros_like(c.joint_angle)
        if "joint_control" in effects:
            current = motor.controller(c, effects["joint_control"])
        c.torque = np.zeros_like(current)
        if "motor" in effects:
            p = effects["motor"]
            resistance, constant = motor.winding(p, c.winding_temperature)
            if "winding" in hooks:
                changed = hooks.call("winding", c, {"resistance": resistance.copy(), "torque_constant": constant})
                c.resistance_factor = changed["resistance"] / resistance
                resistance, constant = changed["resistance"], changed["torque_constant"]
            c.resistance, c.torque_constant = resistance, constant
        # Before the voltage limit, as a controller asks before the amplifier gives.
        c.current = hooks.call("current", c, current) if "current" in hooks else current
        if "voltage_saturation" in effects:
            p = effects["voltage_saturation"]
            new["voltage_saturation"] = motor.voltage_limit(c, p, state["voltage_saturation"])
        if "thermal_cutoff" in effects:
            new["thermal_cutoff"] = motor.cut_off(c, effects["thermal_cutoff"], state["thermal_cutoff"])
        if "motor" in effects:
            p = effects["motor"]
            c.torque = (p.gear_ratio * p.gear_efficiency) * c.torque_constant * c.current
        if "directional_gear_efficiency" in effects:
            motor.gear_losses(c, effects["directional_gear_efficiency"])
        if "torque" in hooks:
            c.torque = hooks.call("torque", c, c.torque)

    def _contact(self, c: Context, state: EffectState) -> None:
        hooks = self.hooks
        c.geometry = self._nominal
        if "geometry" in hooks:
            # Copies: hooks may write, and the nominal geometry serves every step.
            c.geometry = hooks.call("geometry", c, {k: v.copy() for k, v in self._nominal.items()})
        place = c.wheel_position
        wheels = place.shape[1]
        if "chassis_contact" in self.numbers:
            # wheels and chassis look the ground up together: a look-up costs by the call, hardly by the point
            points = np.matmul(self.numbers.chassis_points, c.rotation.swapaxes(-1, -2)) + c.position[:, None]
            place = np.concatenate([place, points], axis=1)
            c.chassis_point = points
        # One look-up for wheels and chassis.
        height, slope_x, slope_y, inside = self.ground.field.value(place[..., 0], place[..., 1])
        c.chassis_ground = height[:, wheels:], slope_x[:, wheels:], slope_y[:, wheels:]
        flat, along_x, along_y = height[:, :wheels], slope_x[:, :wheels], slope_y[:, :wheels]
        if "rim_contact" in self.numbers:
            effects, moved = self.numbers.effects, None
            if "ruts" in effects:
                moved = relief_of(c, effects["ruts"], state["ruts"]).height
            share, fitted = effects["rim_contact"].share, rim_plane(c, self.ground.field, moved)
            flat = flat + share * (fitted[0] - flat)
            along_x, along_y = along_x + share * (fitted[1] - along_x), along_y + share * (fitted[2] - along_y)
        c.contact = wheel_contact(c, flat, along_x, along_y, inside[:, :wheels])
        if "contact" in hooks:
            c.contact = hooks.call("contact", c, c.contact)

    def _wheels(self, c: Context, state: EffectState, new: EffectState) -> None:
        effects, hooks = self.numbers.effects, self.hooks
        if "shear_state" in effects:  # the soil remembers its shear displacement, which a standing wheel keeps
            kept = state["shear_state"]
            c.contact["soil_slip"] = clamp(kept["direction"] * kept["slip_x"], -1.0, 1.0)
            slid = np.abs(kept["direction"] * kept["slip_x"]) + np.maximum(np.abs(kept["slip_x"]) - 1.0, 0.0)
            c.contact["soil_slid"] = np.minimum(slid, 1.0)
        c.soil = soil.local_soil(c, self._uniform, self._soil)
        if "slip_sinkage" in effects:
            outdoors.slip_sinkage(c, effects["slip_sinkage"], c.soil)
        if "multipass" in effects:
            new["multipass"] = outdoors.multipass(c, effects["multipass"], c.soil, state["multipass"])
        if "ruts" in effects:
            new["ruts"] = ruts(c, effects["ruts"], c.soil, state["ruts"])
        if "soil" in hooks:
            c.soil = hooks.call("soil", c, {k: v.copy() for k, v in c.soil.items()})
        zero = np.zeros(c.wheel_position.shape[:-1])
        c.normal = {
            # An empty arc that is not of length zero, through which the laws divide; as the JAX ports begin.
            "entrance": zero + 2e-4,
            "exit": zero,
            "theta_m": zero + 1e-4,
            "sigma_m": zero,
            "load": zero,
            "resistance": zero,
            "damping": zero,
        }
        for function, p in self._normal:
            function(c, p)
        if "normal" in hooks:
            c.normal = hooks.call("normal", c, c.normal)
        if "shear_state" in effects:
            c.slip = {}
            new["shear_state"] = soil.shear_state(c, effects["shear_state"], state["shear_state"])
        else:
            c.slip = momentary_slip(c.contact)
        if "slip" in hooks:
            c.slip = hooks.call("slip", c, c.slip)
        c.wheel = {"force": np.zeros(c.wheel_position.shape), "moment": np.zeros(c.wheel_position.shape)}
        for function, p in self._shear:
            function(c, p)
        if "static_boulders" in effects:
            p = effects["static_boulders"]
            new["static_boulders"] = outdoors.static_boulders(c, p, state["static_boulders"])
        if "shear" in hooks:
            c.wheel = hooks.call("shear", c, c.wheel)

    def shear_functions(self) -> tuple[tuple[Callable, Any], ...]:
        """The model's effects on the wheel force, in order, with their parameters."""
        return self._shear

    def wheel_world(self, c: Context) -> tuple[np.ndarray, np.ndarray]:
        """Force and moment on the wheels in world coordinates, (rover, wheel, 3)."""
        forward, left, normal = (c.contact[k] for k in ("forward", "left", "normal"))

        def to_world(v: np.ndarray) -> np.ndarray:
            return forward * v[..., 0:1] + left * v[..., 1:2] + normal * v[..., 2:3]

        return to_world(c.wheel["force"]), to_world(c.wheel["moment"])

    def heat(self, c: Context) -> tuple[np.ndarray, np.ndarray]:
        """Temperatures of windings and housings at the end of the step, K; fills `heat`, averaged over the step."""
        first = self._heat_at(c, c.winding_temperature, c.housing_temperature)
        dt, flow = c.dt, first
        rate_w, rate_h = flow["winding"] / flow["winding_capacity"], flow["housing"] / flow["housing_capacity"]
        if self.numbers.integrator == "heun":
            # Heun: the mean of the flows at both ends of the step, of second order.
            heat_ahead = self._heat_at(c, c.winding_temperature + dt * rate_w, c.housing_temperature + dt * rate_h)
            flow = {
                **first,
                "winding": 0.5 * (first["winding"] + heat_ahead["winding"]),
                "housing": 0.5 * (first["housing"] + heat_ahead["housing"]),
            }
            rate_w, rate_h = flow["winding"] / flow["winding_capacity"], flow["housing"] / flow["housing_capacity"]
        c.heat = flow
        return c.winding_temperature + dt * rate_w, c.housing_temperature + dt * rate_h

    def _heat_at(self, c: Context, winding_K: np.ndarray, housing_K: np.ndarray) -> Values:
        flow = motor.heat_flow(c, winding_K, housing_K)
        if "heat" not in self.hooks:
            return flow
        c.heat_winding_temperature, c.heat_housing_temperature = winding_K, housing_K
        return self.hooks.call("heat", c, flow)
