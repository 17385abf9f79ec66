"""From actions in [-1, 1] to the targets of the rover's motors: one scale and one source per joint."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from lunar_mjx.effects.joint.electrical import voltage_of
from lunar_mjx.effects.joint.motor import CURRENT, POSITION, TORQUE, VELOCITY
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model
from lunar_mjx.rover import Rover

ACTION_MODES = ("paper", "velocity", "joint_torque", "joint_current", "joint_velocity")
"""`paper`: drive torque, steering torque, one torque per suspension motor (section V). `velocity`: the same six
numbers as wheel speed, steering angle and suspension angles. The others: one number per motor."""


@dataclasses.dataclass(frozen=True)
class ActionSpans:
    """What an action of 1 asks of the joints that do not drive; choices, with which policies were trained."""

    steer_time: float = 0.5
    """s in which full steering torque turns a steering motor's own inertia from straight to its limit."""
    lift_share: float = 0.5
    """Share of a wheel's load that full torque of a suspension joint bears."""
    lift_span: float = 0.4
    """Share of a suspension joint's span that is commanded."""
    endless: float = 0.5
    """rad; span of a joint without limits."""


ACTION_SPANS = ActionSpans()


@dataclasses.dataclass(frozen=True, eq=False)
class ActionMap:
    """Joint targets are `scale * action[source]`, in the unit of each joint's control mode.

    Attributes:
      names: of the actions.
      source: (joint,) which action drives each joint.
      scale: (joint,) target at an action of 1; 0 for a joint that is held at zero.
      mode: (joint,) control mode, as in `RoverInfo`.
      drives: (wheel,) numbers of the joints that drive wheels.
    """

    names: tuple[str, ...]
    source: np.ndarray
    scale: np.ndarray
    mode: np.ndarray
    drives: np.ndarray

    @property
    def size(self) -> int:
        """Number of actions."""
        return len(self.names)

    def controls(self, action: Float[Array, "env action"]) -> Float[Array, "env joint"]:
        """Targets of all joints; actions beyond [-1, 1] are clipped."""
        chosen: Any = jnp.clip(action, -1.0, 1.0)[:, self.source]
        return chosen * jnp.asarray(self.scale, action.dtype)

    def ahead(self, action: Float[Array, "env action"]) -> Float[Array, "env"]:
        """1 where an action drives the wheels forwards on average, -1 backwards, 0 where it does neither."""
        return jnp.sign(self.controls(action)[:, self.drives].mean(-1))


def action_map(
    model: Model, mode: str, top_speed: float, load_share: float = 0.6, four_wheel_steering: bool = False
) -> ActionMap:
    """Builds the map of an action mode for a rover.

    Args:
      model: whose motors are driven.
      mode: one of `ACTION_MODES`.
      top_speed: rim speed at a wheel speed action of 1, m/s.
      load_share: tangential force at a drive torque action of 1, as a share of the wheel's load on flat ground.
      four_wheel_steering: rear wheels steer opposite to the front ones in the modes of six actions; else they are held
        straight.

    Raises:
      UserError: unknown mode, or a rover without the joints that the mode drives.
    """
    if mode not in ACTION_MODES:
        raise bad_input("navigation", "action", mode, "does not exist", f"use one of {', '.join(ACTION_MODES)}")
    rover = model.rover
    for group in ("drive",) if mode.startswith("joint") else ("drive", "steer", "suspension"):
        if rover.group(group) is None:
            raise bad_input(
                "navigation",
                "action",
                mode,
                f"drives {group} motors, which {rover.name} lacks",
                "use joint_torque, joint_current or joint_velocity",
            )
    # Scales by rover: an action of 1 means much, whatever the rover's size.
    limits = _limits(model, mode, top_speed, load_share)
    groups = [g.name for g in rover.groups for _ in g.joints]
    if mode.startswith("joint"):
        code = {"joint_torque": TORQUE, "joint_current": CURRENT, "joint_velocity": VELOCITY}[mode]
        count = len(rover.joints)
        names = tuple(rover.joints)
        return ActionMap(names, np.arange(count), limits, np.full(count, code), _drives(rover))
    return _six(rover, mode, groups, limits, four_wheel_steering)


def _drives(rover: Rover) -> np.ndarray:
    return np.array([rover.joints.index(w.drive) for w in rover.wheels if w.drive])


def _six(rover: Rover, mode: str, groups: list[str], limits: np.ndarray, all_steer: bool) -> ActionMap:
    suspension = [w.suspension for w in rover.wheels if w.suspension]
    names = ("drive", "steer", *(str(s) for s in suspension))
    torque = mode == "paper"
    modes = {"drive": TORQUE if torque else VELOCITY, "steer": TORQUE if torque else POSITION}
    source, scale, code = [], [], []
    rear, front = ({w.steer for w in rover.wheels if w.steer and w.row == row} for row in ("rear", "front"))
    for joint, group, limit in zip(rover.joints, groups, limits, strict=True):
        source.append({"drive": 0, "steer": 1}.get(group, names.index(joint) if joint in names else 0))
        value, kind = limit, modes.get(group, TORQUE if torque else POSITION)
        if group == "steer" and joint not in front:
            # Rear wheels the other way: the circle driven is half as wide.
            value = -limit if all_steer and joint in rear else 0.0
            # Held straight by position: without a target, torque control would let the wheel turn freely.
            kind = kind if value else POSITION
        scale.append(value)
        code.append(kind)
    return ActionMap(names, np.array(source), np.array(scale), np.array(code), _drives(rover))


def reachable_speed(model: Model) -> float:
    """Rim speed that the bus voltage allows a wheel without load, m/s, of the slowest wheel; infinite without a limit.

    omega = V_bus/(K N), from |R I + K N omega| <= V_bus at I = 0.
    """
    supply = model.parameters.get("voltage_saturation")
    if supply is None:
        return np.inf
    rover, motor = model.rover, model.parameters["motor"]
    ratio, constant, voltage = (
        np.broadcast_to(values, len(rover.joints))
        for values in (motor["gear_ratio"], motor["torque_constant"], np.vectorize(voltage_of)(supply["limit"]))
    )
    driven = [(w.radius, rover.joints.index(w.drive)) for w in rover.wheels if w.drive]
    return min((float(radius * voltage[i] / (constant[i] * ratio[i])) for radius, i in driven), default=np.inf)


def _limits(model: Model, mode: str, top_speed: float, load_share: float) -> np.ndarray:
    """Target of every joint at an action of 1."""
    rover = model.rover
    compiled = rover.compile()
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    # In the model's own gravity: torque that climbs on the Moon is a sixth of the Earth's.
    load = rover.mass * model.gravity / len(rover.wheels)
    wheel_of = {j: w for w in rover.wheels for j in (w.drive, w.steer, w.suspension) if j}
    motor = model.parameters["motor"]
    ratio, efficiency, constant = (
        np.broadcast_to(motor[k], len(rover.joints)) for k in ("gear_ratio", "gear_efficiency", "torque_constant")
    )
    values = []
    for i, name in enumerate(rover.joints):
        group = next(g for g in rover.groups if name in g.joints)
        wheel, span = wheel_of.get(name), _span(rover, name)
        radius = wheel.radius if wheel else rover.wheels[0].radius
        joint = compiled.joint(name)
        if group.name == "drive":
            speed, torque, angle = top_speed / radius, load_share * load * radius, 2 * np.pi
        elif group.name == "steer":
            inertia = group.rotor_inertia * ratio[i] ** 2
            # From rest through the span: s = a t^2/2.
            speed, torque, angle = span / ACTION_SPANS.steer_time, 2 * inertia * span / ACTION_SPANS.steer_time**2, span
        else:
            body = compiled.body(wheel.body).id if wheel else compiled.body(rover.chassis).id
            # In plan, as the load is vertical.
            arm = np.linalg.norm((data.xpos[body] - data.xanchor[joint.id])[:2])
            speed, torque, angle = (
                span / ACTION_SPANS.steer_time,
                ACTION_SPANS.lift_share * load * arm,
                ACTION_SPANS.lift_span * span,
            )
        if mode == "joint_current":
            # The current that gives this torque at 25 degC.
            values.append(torque / (ratio[i] * efficiency[i] * constant[i]))
        elif mode == "joint_velocity" or (mode == "velocity" and group.name == "drive"):
            values.append(speed)
        else:
            values.append(angle if mode == "velocity" else torque)
    return np.array(values)


def _span(rover: Rover, name: str) -> float:
    low, high = rover.joint_limits[name]
    span = min(-low, high)
    return span if 0 < span < np.inf else ACTION_SPANS.endless
