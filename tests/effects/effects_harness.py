"""Random wheels and motors, and the library's effects run on them without a rover or an engine."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.context import Contact, Context, Normal, RoverInfo, Soil, WheelForce
from lunar_mjx.effects.ports import Pipeline, initial_normal, nominal_geometry
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain.soil.named import SOILS
from tests.effects.effects_reference import WheelState

Array = Any
STATES = 100_000
MOTION = ("v_x", "v_y", "rim_speed", "steering_angle")


def random_wheels(count: int = STATES, seed: int = 0) -> tuple[WheelState, dict[str, Array]]:
    """Wheels in every state that a rover meets, in float32 values so that both precisions see the same numbers.

    Sinkage goes to 0.6 r, half of it spread evenly in its logarithm from 1e-7 m, one wheel in twenty is airborne, and
    the soils are the five that ship. Slip is -1..1, slip angle -90..90 deg, direction -1..1 with a third of
    the wheels at either end.

    Returns:
      The wheels, and velocities and steering angles that go with them.
    """
    rng = np.random.default_rng(seed)

    def uniform(low: float, high: float) -> Array:
        return rng.uniform(low, high, count)

    radius, width = uniform(0.05, 0.3), uniform(0.04, 0.3)
    sinkage = np.where(uniform(0, 1) < 0.5, 1e-7 * (0.6 * radius / 1e-7) ** uniform(0, 1), uniform(0, 0.6) * radius)
    sinkage[rng.uniform(size=count) < 0.05] = 0.0
    which = rng.integers(len(SOILS), size=count)
    table = {k: np.array([s[k] for s in SOILS.values()])[which] for k in next(iter(SOILS.values()))}
    slip, angle = uniform(-1, 1), np.radians(uniform(-90, 90))
    angle[: count // 1000] = np.radians(90)
    direction = rng.choice([-1.0, 1.0, 0.0], count)
    direction = np.where(direction == 0, uniform(-1, 1), direction)
    state = WheelState(
        radius,
        width,
        sinkage,
        uniform(-0.1, 0.1),
        slip,
        (1 - slip) * np.tan(angle),
        direction,
        table["k_c"],
        table["k_phi"],
        table["n"],
        table["cohesion"],
        np.tan(table["friction_angle"]),
        table["shear_modulus_x"],
        table["shear_modulus_y"],
    )
    motion = {"v_x": uniform(-1, 1), "v_y": uniform(-1, 1), "rim_speed": uniform(-1, 1)}
    # the paper's regularisation below 0.02 m/s is tested by itself
    motion = {k: np.where(np.abs(v) < 0.03, 0.03, v) for k, v in motion.items()}
    motion["steering_angle"] = uniform(-0.5, 0.5)
    rounded = WheelState(*(np.float32(getattr(state, f.name)).astype(float) for f in dataclasses.fields(state)))
    return rounded, {k: np.float32(v).astype(float) for k, v in motion.items()}


def rover_info(radius: Array, width: Array, joints: int = 1, mode: Array = 0) -> RoverInfo:
    """A rover with these wheels, and joints of one mode or of the given ones."""
    ones = jnp.ones(joints, jnp.result_type(float))
    info = RoverInfo(
        radius,
        width,
        jnp.zeros(joints, int),
        -0.5 * ones,
        0.5 * ones,
        jnp.zeros(joints, int) + mode,
        40.0 * ones,
        3.0 * ones,
        Vec3(0 * ones[:1], 0 * ones[:1], -0.1 * ones[:1]),
    )
    return info


def bare_context(**known: Any) -> Context:
    """A context with only the fields that the effects under test read."""
    return Context(**{f.name: known.get(f.name) for f in dataclasses.fields(Context)})


def parameters(
    effects: Sequence[Effect], values: Mapping[str, Mapping[str, Any]] | None = None
) -> dict[str, SimpleNamespace]:
    """Nominal parameters of the effects, with some replaced."""
    return {e.name: SimpleNamespace(**{**e.nominal(), **(values or {}).get(e.name, {})}) for e in effects}


def effects_named(names: Sequence[str | Effect]) -> tuple[Effect, ...]:
    return tuple(catalogue.get(n) if isinstance(n, str) else n for n in names)


@functools.cache
def _compiled(names: tuple[str | Effect, ...]) -> Callable[..., tuple[WheelForce, Normal]]:
    pipeline = Pipeline(effects_named(names))

    @jax.jit
    def run(s: Any, motion: Any, values: Any, rock: Any) -> tuple[WheelForce, Normal]:
        zero = jnp.zeros_like(s.sinkage)
        nil = Vec3(zero, zero, zero)
        roll = jnp.where(jnp.abs(motion["rim_speed"]) > jnp.abs(motion["v_x"]), motion["rim_speed"], motion["v_x"])
        contact = Contact(
            s.sinkage,
            s.sinkage_rate,
            jnp.sign(roll) * s.slip_x,
            jnp.arctan2(motion["v_y"], jnp.abs(motion["v_x"])),
            motion["v_x"],
            motion["v_y"],
            motion["rim_speed"],
            nil,
            nil,
            nil,
            zero == 0,
            jnp.clip(jnp.sign(roll) * s.slip_x, -1.0, 1.0),
            jnp.minimum(jnp.abs(s.slip_x), 1.0),
        )
        soil = Soil(s.k_c, s.k_phi, s.n, s.cohesion, s.tan_phi, s.shear_modulus_x, s.shear_modulus_y, rock + zero)
        ctx = bare_context(
            dt=jnp.asarray(0.002, s.sinkage.dtype),
            geometry=nominal_geometry(rover_info(s.radius, s.width)),
            contact=contact,
            soil=soil,
            steering_angle=motion["steering_angle"],
            parameters=parameters(pipeline.effects, values),
        )
        normal, _ = pipeline.run("wheel_normal", ctx, {}, initial_normal(s.sinkage))
        ctx = dataclasses.replace(ctx, normal=normal)
        wheel, _ = pipeline.run("wheel_shear", ctx, {}, WheelForce(s.slip_x, s.slip_y, s.direction, nil, nil))
        return wheel, normal

    return run


def wheel_forces(
    names: Sequence[str | Effect],
    state: WheelState,
    motion: Mapping[str, Array],
    values: Mapping[str, Mapping[str, Any]],
    dtype: Any,
    rock: Array = 0.0,
) -> tuple[WheelForce, Normal]:
    """Force and moment of every wheel by the ports wheel_normal and wheel_shear, as NumPy arrays.

    The slip that the soil remembers is `slip_x`, `slip_y` and `direction` of `state`.

    Args:
      names: effects in the list.
      state: the wheels. motion: their velocities, see `random_wheels`.
      values: parameters that differ from the nominal ones, each a number or one per wheel.
      dtype: numpy.float32 or numpy.float64.
      rock: 1 where the wheel stands on rock.
    """
    run = _compiled(tuple(names))

    def cast(a: Any) -> Any:
        return jnp.asarray(a, dtype)

    with jax.enable_x64(np.dtype(dtype) == np.float64):
        fields = [f.name for f in dataclasses.fields(state)]
        arguments = jax.tree.map(cast, ({f: getattr(state, f) for f in fields}, dict(motion), dict(values), rock))
        result = run(SimpleState(**arguments[0]), *arguments[1:])
        return jax.tree.map(np.asarray, result)


SimpleState = jax.tree_util.register_dataclass(
    dataclasses.make_dataclass("SimpleState", [f.name for f in dataclasses.fields(WheelState)])
)
