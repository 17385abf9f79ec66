"""Random rovers without an engine, and a list of effects run on them: where an effect is probed (`contract`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np

from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.context import Context, Power, RoverInfo
from lunar_mjx.effects.ports import Pipeline, apply_effects, heat_flow
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import SoilGrids, SoilMap, Terrain, build_rocks, inclined
from lunar_mjx.terrain.sky import Sunlight


@dataclasses.dataclass(frozen=True)
class RandomRovers:
    """The rovers and grounds on which effects are tried."""

    slope: float = 0.1
    """Inclination of the probe's ground, rad."""
    radius: float = 0.25
    """Radius of the wheels, m."""
    width: float = 0.2
    """Width of the wheels, m."""
    timestep: float = 0.002
    """Time step, s: that of a model unless it says otherwise."""
    gravity: float = 1.625
    """Gravity on the Moon, m/s2."""
    ambient: float = 250.0
    """Temperature around the rover, K."""
    warm_up: int = 2
    """Steps before the one that is looked at, from which effects have their memory."""


RANDOM_ROVERS = RandomRovers()


Values = Mapping[str, Mapping[str, Any]]
Memory = dict[str, dict[str, Any]]


def terrain() -> Terrain:
    """A slope with rock and ever firmer soil in the east, under some of the wheels, and boulders beside two of them."""
    dtype = jnp.result_type(float)
    # Inclined, so that an effect which mixes up the vertical with the ground's normal shows.
    plane = inclined(RANDOM_ROVERS.slope, 20.0, dtype=dtype)
    bounds = (-10.0, -10.0, 10.0, 10.0)
    centers = np.array([[1.0, 0.5, 0.1], [-1.0, -0.5, -0.1], [5.0, 5.0, 0.5]])
    rocks = build_rocks(centers, np.array([0.35, 0.35, 0.3]), bounds, dtype=dtype)
    cell = 0.1
    columns = np.arange(201) * cell - 10.0
    rock = jnp.asarray(np.tile(columns > 0.55, (201, 1)), float)
    ground = SoilMap(rock, *(jnp.asarray(v, float) for v in (-10.0, -10.0, cell)))
    east = jnp.asarray(np.tile(np.linspace(0.5, 1.5, 5), (5, 1)), float)
    at = (jnp.asarray(v, float) for v in (-10.0, -10.0, 5.0))
    # Soil that changes with the place: effects that read it at a wrong wheel give other forces.
    firmer = SoilGrids(*at, k_phi=8e5 * east, n=0.0 * east + 1.1, cohesion=170.0 * east, tan_phi=0.7 * east)
    return dataclasses.replace(plane, rocks=rocks, soil=ground, grids=firmer)


def rover(wheels: int) -> RoverInfo:
    """A rover of four or six wheels with three joints each, in all control modes."""
    joints = 3 * wheels
    number, one = jnp.arange(joints), jnp.ones(joints)
    points = Vec3(jnp.asarray([0.5, -0.5]), jnp.asarray([0.3, -0.3]), jnp.asarray([-0.2, 0.05]))
    # Drive, steer and suspension of each wheel lie side by side.
    group = number % 3
    return RoverInfo(
        RANDOM_ROVERS.radius * jnp.ones(wheels),
        RANDOM_ROVERS.width * jnp.ones(wheels),
        group,
        jnp.where(group == 0, -jnp.inf, -0.2 * one),
        jnp.where(group == 0, jnp.inf, 0.2 * one),
        (number // 3 + number) % 4,
        40.0 * one,
        3.0 * one,
        points,
    )


def _unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def states(count: int, wheels: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Random rovers over `RANDOM_ROVERS.warm_up` + 1 moments, of shape (count, moment, ...).

    The first six of them at their last moment: standstill, airborne, touching, deep, rolling without slip, and backing
    up; one wheel in five is airborne. From moment to moment the wheels change places, so that each stands where another
    has been.
    """
    rng = np.random.default_rng(seed)
    moments, joints = RANDOM_ROVERS.warm_up + 1, 3 * wheels

    def normal(*shape: int, scale: float = 1.0) -> np.ndarray:
        return scale * rng.normal(size=(count, moments, *shape))

    # Two columns of wheels, so that a left and a right one differ.
    wheel_places = np.array([[0.5 - i // 2 * (2.0 / wheels), 0.5 - i % 2] for i in range(wheels)])
    # What a state remembers of a place is met by another wheel, as behind each other in a rut.
    lane = np.stack([np.roll(wheel_places, moment, axis=0) for moment in range(moments)])
    airborne = rng.uniform(size=(count, moments, wheels)) < 0.2
    s = {
        "sinkage": np.where(airborne, -0.05, rng.uniform(0.001, 0.1, (count, moments, wheels))),
        "place": lane + normal(wheels, 2, scale=0.05),
        "axle": _unit(np.array([0.0, 1.0, 0.0]) + normal(wheels, 3, scale=0.1)),
        "velocity": normal(wheels, 3, scale=0.2),
        "spin": normal(wheels, 3),
        "steering": normal(wheels, scale=0.2),
        "chassis_height": 0.2 + normal(scale=0.2),
        "chassis_velocity": normal(3, scale=0.2),
        "chassis_spin": normal(3, scale=0.2),
        "angle": normal(joints, scale=0.3),
        "speed": normal(joints),
        "winding": 300.0 + normal(joints, scale=80.0),
        "housing": 300.0 + normal(joints, scale=40.0),
        "target": normal(joints, scale=3.0),
        "slip": rng.uniform(-1, 1, (count, moments, 3, wheels)),
    }
    moving = {"velocity", "spin", "chassis_velocity", "chassis_spin", "speed", "angle", "target", "slip", "steering"}
    for still in range(min(3, count)):
        for name in moving:
            # Exactly at rest: the place at which quotients and roots lose their derivatives.
            s[name][still, -1] = 0.0
        s["axle"][still, -1] = [0.0, 1.0, 0.0]
    for i, sinkage in enumerate((0.02, -0.1, 0.0, 0.3)[:count]):
        # Standing, airborne, just touching and deep: where contact begins and ends.
        s["sinkage"][i, -1] = sinkage
    for i, way in ((4, 1.0), (5, -1.0)):
        if i < count:
            s["axle"][i, -1], s["velocity"][i, -1] = [0.0, 1.0, 0.0], [0.1 * way, 0.0, 0.0]
            s["spin"][i, -1] = [0.0, 0.1 * way / RANDOM_ROVERS.radius, 0.0]
    return s


def context(effects: Sequence[Effect], values: Values, world: Terrain, s: Mapping[str, Any], moment: int) -> Context:
    """What the ports see of one rover at one moment."""
    wheels = s["sinkage"].shape[-1]
    place = s["place"][moment]
    zero, one = jnp.zeros(()), jnp.ones(())
    axes = (Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one))
    return Context(
        time=zero + RANDOM_ROVERS.timestep * moment,
        dt=zero + RANDOM_ROVERS.timestep,
        gravity=zero + RANDOM_ROVERS.gravity,
        ambient_temperature=zero + RANDOM_ROVERS.ambient,
        position=Vec3(zero, zero, s["chassis_height"][moment]),
        frame=Frame(*axes),
        velocity=Vec3.of(s["chassis_velocity"][moment]),
        angular_velocity=Vec3.of(s["chassis_spin"][moment]),
        joint_angle=s["angle"][moment],
        joint_speed=s["speed"][moment],
        winding_temperature=s["winding"][moment],
        housing_temperature=s["housing"][moment],
        steering_angle=s["steering"][moment],
        wheel_position=Vec3(
            place[:, 0],
            place[:, 1],
            RANDOM_ROVERS.radius - s["sinkage"][moment] + np.tan(RANDOM_ROVERS.slope) * place[:, 0],
        ),
        wheel_axle=Vec3.of(s["axle"][moment]),
        wheel_velocity=Vec3.of(s["velocity"][moment]),
        wheel_angular_velocity=Vec3.of(s["spin"][moment]),
        terrain=world,
        rover=rover(wheels),
        parameters={e.name: SimpleNamespace(**{**e.nominal(), **values.get(e.name, {})}) for e in effects},
        sunlight=Sunlight(Vec3(0.6 * one, -0.48 * one, 0.64 * one), 1000.0 * one),
    )


def reset_memory(effects: Sequence[Effect], wheels: int) -> Memory:
    """The effects' state at reset."""
    size = {"wheel": jnp.zeros(wheels), "joint": jnp.zeros(3 * wheels), "rover": jnp.zeros(())}
    return {e.name: {k: v.reset(size[v.axis]) for k, v in e.state.items()} for e in effects if e.state}


def step(
    pipeline: Pipeline, world: Terrain, values: Values, s: Mapping[str, Any], moment: int, memory: Memory
) -> tuple[dict[str, Any], Memory]:
    """Every force, torque and heat flow on one rover at one moment, by all ports from command to heat."""
    # Random slip to remember: what a few steps from rest leave is much alike on all rovers.
    if "shear_state" in memory:
        memory = {**memory, "shear_state": dict(zip(("slip_x", "slip_y", "direction"), s["slip"][moment], strict=True))}
    ctx = context(pipeline.effects, values, world, s, moment)
    forces, ctx, memory = apply_effects(pipeline, ctx, s["target"][moment], memory)
    heat, memory = heat_flow(pipeline, ctx, memory)
    geometry, nil = forces.geometry, jnp.zeros(())
    power = Power(nil, nil, nil) if ctx.power is None else ctx.power
    return {
        "joint_torque": forces.joint_torque,
        "wheel_force": forces.wheel_force.stack(),
        "wheel_moment": forces.wheel_moment.stack(),
        "chassis_force": forces.chassis_force.stack(),
        "chassis_moment": forces.chassis_moment.stack(),
        "wheel_radius": geometry.radius,
        "payload_mass": geometry.payload_mass + 0.0,
        "com_offset": geometry.com_offset.stack(),
        "gravity": ctx.gravity,
        "winding_heat": heat.winding,
        "housing_heat": heat.housing,
        "electric_power": jnp.stack([power.load, power.solar, power.loss]),
    }, memory


def act(effects: Sequence[Effect], world: Terrain, values: Values, s: Mapping[str, Any]) -> dict[str, Any]:
    """`step` at the last moment, with the memory that the moments before have left."""
    pipeline = Pipeline(tuple(effects))
    memory = reset_memory(effects, s["sinkage"].shape[-1])
    for moment in range(RANDOM_ROVERS.warm_up):
        _, memory = step(pipeline, world, values, s, moment, memory)
    return step(pipeline, world, values, s, RANDOM_ROVERS.warm_up, memory)[0]
