"""Motors and gears driven through prescribed motions by the ports command, motor_torque and heat, without a rover."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.context import Command
from lunar_mjx.effects.joint.motor import CURRENT, POSITION, TORQUE, VELOCITY
from lunar_mjx.effects.ports import Pipeline, heat_flow
from lunar_mjx.spatial import Frame, Vec3
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

Array = Any
DT = 0.002
BASE = ("joint_control", "motor")
AMBIENT, GRAVITY = 250.0, 1.625
KELVIN = 273.15
POSITION_GAIN, VELOCITY_GAIN = 40.0, 3.0  # of the harness
K, R, N, ETA = 71.6e-3, 4.13, 243.0, 0.75  # of the nominal motor
ROTOR = 9e-7 * N**2
"""kg m2 at the joint."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """Motions of joints: targets, angles, speeds and temperatures in K (time, joint), modes (joint,), heading."""

    target: Array
    angle: Array
    speed: Array
    winding: Array
    housing: Array
    mode: Array
    yaw: Array


def scene(
    target: Array,
    angle: Array = 0.0,
    speed: Array = 0.0,
    celsius: Array = 25.0,
    mode: Array = TORQUE,
    yaw: float = 0.0,
    housing: Array | None = None,
) -> Scene:
    """Quantities that broadcast to (time, joint); a number is one joint in one step."""
    housed = celsius if housing is None else housing
    given: tuple[Array, ...] = (target, angle, speed, celsius, housed)
    shape = np.broadcast_shapes(*(np.shape(np.atleast_2d(a)) for a in (*given, mode)))
    full = [np.broadcast_to(np.asarray(a, float), shape) for a in given]
    modes = np.broadcast_to(mode, shape)[0].astype(int)
    return Scene(full[0], full[1], full[2], full[3] + KELVIN, full[4] + KELVIN, modes, np.asarray(yaw, float))


def many() -> Scene:
    """Every mode at rest, rolling, fast, reversing through zero, at -190 and 150 degC, with targets that change."""
    steps = 12
    when = np.arange(steps)[:, None]
    cases = [
        (0.0, 0.0, 25.0),
        (0.5, 0.0, -190.0),
        (-0.5, 0.0, 150.0),
        (0.05, -0.01, 25.0),
        (3.0, 0.0, 25.0),
        (-0.03, 0.006, -190.0),
        (1.0, 0.0, 60.0),
    ]
    start, rate, celsius = np.array(cases).T
    count = len(cases)
    speed = np.tile(start + rate * when, (1, 4))
    angle = 0.4 + np.cumsum(speed, axis=0) * DT
    mode = np.repeat([POSITION, VELOCITY, TORQUE, CURRENT], count)
    sign = np.where(when < 5, 1.0, np.where(when < 9, -0.5, 2.0))
    size = np.repeat([0.3, 1.0, 6.0, 1.5], count) * np.tile([0.0, 1, 1, 1, -1, 1, 0.2], 4)
    return scene(sign * size, angle, speed, np.tile(celsius, 4), mode, 0.3, housing=np.tile(celsius, 4) - 7.0)


@functools.cache
def runner(names: tuple[str, ...]) -> Callable[[Any, Any], dict[str, Array]]:
    """A compiled function from the effects' parameters and a scene's arrays to currents, torques and heat flows."""
    effects = effects_named(names)
    pipeline = Pipeline(effects)

    def step(values: Any, s: Any, memory: Any, now: Any) -> Any:
        count = s["mode"].shape[0]
        zero, one, nil = jnp.zeros(()), jnp.ones(()), jnp.zeros(count)
        cos, sin = jnp.cos(s["yaw"]), jnp.sin(s["yaw"])
        ctx = bare_context(
            dt=jnp.asarray(DT),
            gravity=GRAVITY,
            ambient_temperature=jnp.asarray(AMBIENT),
            frame=Frame(Vec3(cos, sin, zero), Vec3(-sin, cos, zero), Vec3(zero, zero, one)),
            joint_angle=now["angle"],
            joint_speed=now["speed"],
            winding_temperature=now["winding"],
            housing_temperature=now["housing"],
            rover=rover_info(jnp.ones(1), jnp.ones(1), count, s["mode"]),
            parameters=parameters(effects, values),
        )
        command, memory = pipeline.run("command", ctx, memory, Command(now["target"], nil))
        ctx = dataclasses.replace(ctx, command=command)
        torque, memory = pipeline.run("motor_torque", ctx, memory, nil)
        ctx = dataclasses.replace(ctx, torque=torque)
        heat, memory = heat_flow(pipeline, ctx, memory)
        seen = {"current": command.current, "torque": torque, "winding": heat.winding, "housing": heat.housing}
        return memory, seen

    @jax.jit
    def run(values: Any, s: Any) -> dict[str, Array]:
        size = {"joint": jnp.zeros(s["mode"].shape[0]), "rover": jnp.zeros(())}
        memory = {e.name: {k: size[v.axis] + v.initial for k, v in e.state.items()} for e in effects if e.state}
        steps = {k: s[k] for k in ("target", "angle", "speed", "winding", "housing")}
        return jax.lax.scan(lambda m, now: step(values, s, m, now), memory, steps)[1]

    return run


def arrays(s: Scene) -> dict[str, Array]:
    return {f.name: jnp.asarray(getattr(s, f.name)) for f in dataclasses.fields(s)}


def values_of(names: tuple[str, ...], changed: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Array]]:
    """Nominal values with some replaced, as arrays."""
    full = {e.name: {**e.nominal(), **changed.get(e.name, {})} for e in effects_named(names)}
    return {e: {k: jnp.asarray(v, float) for k, v in p.items()} for e, p in full.items()}


def drive(s: Scene, *extra: str, **changed: Mapping[str, Any]) -> dict[str, Array]:
    """Currents, torques and heat flows (time, joint) of the nominal motor with extra effects, in float64."""
    names = (*BASE, *extra)
    with jax.enable_x64(True):
        return {k: np.asarray(v) for k, v in runner(names)(values_of(names, changed), arrays(s)).items()}
