"""What every effect of the catalogue promises: null values, independence, finite derivatives, units, documentation."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.context import Power, RoverInfo
from lunar_mjx.effects.ports import Pipeline, apply_effects, heat_flow
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.errors import UserError
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import SoilMap, Terrain, build_rocks, inclined
from lunar_mjx.units import to_unit
from tests.effects.effects_harness import bare_context, effects_named, parameters

Array = Any
CATALOGUE = catalogue.CATALOGUE
WHEELS, JOINTS = 4, 12
COUNT = 120
"""Rovers in a batch; the same everywhere, so that an operation is compiled once."""
INTEGRAL = tuple("stress_integral" if n == "closed_form_shear" else n for n in PRESETS["consistent"])
INTEGRAL = tuple(n for n in INTEGRAL if n != "pressure_sinkage")
LISTS = {"consistent": PRESETS["consistent"], "integral": INTEGRAL, "paper": PRESETS["paper"]}

REMAINS = {
    "boulders": "the push of the boulder",
    "chassis_contact": "the push of the ground",
    "hard_ground": "the push of the rock",
    "motor": "a motor without temperature coefficients",
    "penalty_contact": "the contact's stiffness",
    "static_boulders": "the push of the boulder",
    "shear_state": "the memory of the soil",
    "thermal_cutoff": "a cut-off without hysteresis",
}
"""Effects of which something remains where all their nulls are taken, because other parameters have none."""
VANISHING = sorted(
    name
    for name, e in CATALOGUE.items()
    if name not in REMAINS and set(e.ports) != {"sensor"} and any(p.null is not None for p in e.parameters.values())
)


def terrain() -> Terrain:
    """A slope of 6 deg with hard rock on its eastern half, and boulders beside two of the wheels."""
    plane = inclined(0.1, 20.0, dtype=np.float64)
    bounds = (-10.0, -10.0, 10.0, 10.0)
    centers = np.array([[1.0, 0.5, 0.1], [-1.0, -0.5, -0.1], [5.0, 5.0, 0.5]])
    rocks = build_rocks(centers, np.array([0.35, 0.35, 0.3]), bounds, dtype=np.float64)
    rock = jnp.asarray(np.tile(np.arange(21) > 10, (21, 1)), float)
    ground = SoilMap(rock, *(jnp.asarray(v, float) for v in (-10.0, -10.0, 1.0)))
    return dataclasses.replace(plane, rocks=rocks, soil=ground)


def rover() -> RoverInfo:
    """Four wheels, twelve joints in all four modes."""
    number = jnp.arange(JOINTS)
    one = jnp.ones(JOINTS)
    points = Vec3(jnp.asarray([0.5, -0.5]), jnp.asarray([0.3, -0.3]), jnp.asarray([-0.2, 0.05]))
    group = number % 3
    return RoverInfo(
        0.25 * jnp.ones(WHEELS),
        0.2 * jnp.ones(WHEELS),
        group,
        jnp.where(group == 0, -jnp.inf, -0.2 * one),
        jnp.where(group == 0, jnp.inf, 0.2 * one),
        number % 4,
        40.0 * one,
        3.0 * one,
        points,
    )


def unit(v: Array) -> Array:
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def states(count: int, seed: int = 0) -> dict[str, Array]:
    """Random rovers, and among them (first to fifth) standstill, airborne, touching, deep, and steady rolling ones."""
    rng = np.random.default_rng(seed)

    def normal(*shape: int, scale: float = 1.0) -> Array:
        return scale * rng.normal(size=(count, *shape))

    axle = unit(np.array([0.0, 1.0, 0.0]) + normal(WHEELS, 3, scale=0.1))
    place = np.array([[0.5, 0.5], [0.5, -0.5], [-0.5, 0.5], [-0.5, -0.5]]) + normal(WHEELS, 2, scale=0.05)
    sinkage = np.where(rng.uniform(size=(count, WHEELS)) < 0.2, -0.05, rng.uniform(0.0, 0.1, (count, WHEELS)))
    s = {
        "sinkage": sinkage,
        "place": place,
        "axle": axle,
        "velocity": normal(WHEELS, 3, scale=0.2),
        "spin": normal(WHEELS, 3, scale=1.0),
        "steering": normal(WHEELS, scale=0.2),
        "chassis_height": 0.2 + normal(scale=0.2),
        "chassis_velocity": normal(3, scale=0.2),
        "chassis_spin": normal(3, scale=0.2),
        "angle": normal(JOINTS, scale=0.3),
        "speed": normal(JOINTS),
        "winding": 300.0 + normal(JOINTS, scale=80.0),
        "housing": 300.0 + normal(JOINTS, scale=40.0),
        "target": normal(JOINTS, scale=3.0),
        "slip": rng.uniform(-1, 1, (count, 3, WHEELS)),
    }
    for still in (0, 1, 2):
        for name in (
            "velocity",
            "spin",
            "chassis_velocity",
            "chassis_spin",
            "speed",
            "angle",
            "target",
            "slip",
            "steering",
        ):
            s[name][still] = 0.0
        s["axle"][still] = [0.0, 1.0, 0.0]
    s["winding"][0] = s["housing"][0] = 298.15
    s["sinkage"][0], s["sinkage"][1], s["sinkage"][2], s["sinkage"][3] = 0.02, -0.1, 0.0, 0.3
    s["axle"][4], s["velocity"][4], s["spin"][4] = [0.0, 1.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.4, 0.0]
    return s


def act(names: tuple[str, ...], world: Terrain, values: Mapping[str, Any], s: Mapping[str, Any]) -> dict[str, Any]:
    """Every force and heat flow on one rover, by the ports from command to heat."""
    pipeline = Pipeline(effects_named(names))
    place = s["place"]
    wheel = Vec3(place[:, 0], place[:, 1], 0.25 - s["sinkage"] + np.tan(0.1) * place[:, 0])
    zero, one = jnp.zeros(()), jnp.ones(())
    frame = Frame(Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one))
    ctx = bare_context(
        time=zero,
        dt=jnp.asarray(0.002),
        gravity=jnp.asarray(1.625),
        ambient_temperature=jnp.asarray(250.0),
        position=Vec3(zero, zero, s["chassis_height"]),
        frame=frame,
        velocity=Vec3.of(s["chassis_velocity"]),
        angular_velocity=Vec3.of(s["chassis_spin"]),
        joint_angle=s["angle"],
        joint_speed=s["speed"],
        steering_angle=s["steering"],
        winding_temperature=s["winding"],
        housing_temperature=s["housing"],
        wheel_position=wheel,
        wheel_axle=Vec3.of(s["axle"]),
        wheel_velocity=Vec3.of(s["velocity"]),
        wheel_angular_velocity=Vec3.of(s["spin"]),
        terrain=world,
        rover=rover(),
        parameters=parameters(pipeline.effects, values),
    )
    size = {"wheel": jnp.zeros(WHEELS), "joint": jnp.zeros(JOINTS), "rover": zero}
    memory = {e.name: {k: v.reset(size[v.axis]) for k, v in e.state.items()} for e in pipeline.effects if e.state}
    if "shear_state" in memory:
        memory["shear_state"] = dict(zip(("slip_x", "slip_y", "direction"), s["slip"], strict=True))
    forces, ctx, memory = apply_effects(pipeline, ctx, s["target"], memory)
    heat, memory = heat_flow(pipeline, ctx, memory)
    power = Power(zero, zero, zero) if ctx.power is None else ctx.power
    return {
        "joint_torque": forces.joint_torque,
        "wheel_force": forces.wheel_force.stack(),
        "wheel_moment": forces.wheel_moment.stack(),
        "chassis_force": forces.chassis_force.stack(),
        "chassis_moment": forces.chassis_moment.stack(),
        "radius": forces.geometry.radius,
        "payload": forces.geometry.payload_mass + zero,
        "com_offset": forces.geometry.com_offset.stack(),
        "winding_heat": heat.winding,
        "housing_heat": heat.housing,
        "electric_power": jnp.stack([power.load, power.solar, power.loss]),
    }


def run(
    names: tuple[str, ...], values: Mapping[str, Any], s: Mapping[str, Any], compiled: bool = False
) -> dict[str, Array]:
    """`act` for a batch of states, in float64; operation by operation, because compiling would take far longer."""
    with jax.enable_x64(True):
        full = {n: {**CATALOGUE[n].nominal(), **values.get(n, {})} for n in {*names, *values}}
        arguments = jax.tree.map(lambda a: jnp.asarray(a, float), (full, dict(s)))
        batch = jax.vmap(functools.partial(act, names, terrain()), in_axes=(None, 0))
        return jax.tree.map(np.asarray, (jax.jit(batch) if compiled else batch)(*arguments))


@functools.cache
def base_result(names: tuple[str, ...]) -> dict[str, Array]:
    return run(names, {}, states(COUNT))


def assert_alike(got: dict[str, Array], expected: dict[str, Array]) -> None:
    """To 4 ulp of the largest component on the rover, forces in N and moments in N m on the wheels taken together.

    A single component may be a small difference of large terms.
    """
    largest = {k: np.abs(v).reshape(len(v), -1).max(axis=1) for k, v in expected.items()}
    largest["wheel_moment"] = np.maximum(largest["wheel_moment"], largest["wheel_force"])
    for key, want in expected.items():
        difference = np.abs(got[key] - want).reshape(len(want), -1).max(axis=1)
        assert (difference <= 4 * np.spacing(largest[key])).all(), key


@pytest.mark.optimised
def test_all_that_vanishes_vanishes_together() -> None:
    """As compiled for a simulation: `consistent` with every such effect at null, and without any of them."""
    without = tuple(n for n in LISTS["consistent"] if n not in VANISHING)
    s = states(COUNT)
    nulls = {n: CATALOGUE[n].null() for n in VANISHING}
    assert_alike(run((*without, *VANISHING), nulls, s, compiled=True), run(without, {}, s, compiled=True))


UNSEEN = {"gravity_error", "multipass", "wheel_wear", "side_exit", "rim_contact", "ruts"}
"""Effects that act on the bodies or by what went before, not on the forces of one step (test_history.py has them), on
contact behind the axle, which this list does not have (test_sliding_contact.py), or on ground that is no plane
(test_rim_contact.py, test_ruts.py)."""


@pytest.mark.parametrize("name", VANISHING)
def test_an_effect_at_its_null_values_vanishes(name: str) -> None:
    """The list with it at null agrees with the list without it to 4 ulp; at other values it does not."""
    without = tuple(n for n in LISTS["consistent"] if n != name)
    effect = CATALOGUE[name]
    s = states(COUNT)
    expected = base_result(without)
    assert_alike(run((*without, name), {name: effect.null()}, s), expected)
    other = {k: p.nominal for k, p in effect.parameters.items()}
    same = {k: p for k, p in effect.parameters.items() if p.null is not None and p.null == p.nominal}
    other.update({k: min(p.bounds[1], 0.1) for k, p in same.items()})
    changed = run((*without, name), {name: other}, s)
    seen = any(not np.allclose(changed[k], v, rtol=1e-9, atol=0) for k, v in expected.items())
    assert seen == (name not in UNSEEN)


def test_effects_of_which_something_remains_are_still_there() -> None:
    """The exceptions to the test above are effects that exist and have a null."""
    for name in REMAINS:
        assert any(p.null is not None for p in CATALOGUE[name].parameters.values()), name


def velocities_changed(s: dict[str, Array]) -> dict[str, Array]:
    """The same rovers at other velocities."""
    keys = ("velocity", "spin", "chassis_velocity", "chassis_spin")
    return {k: -1.5 * v if k in keys else v for k, v in s.items()}


@pytest.mark.parametrize(
    "names, key, axes",
    [
        (("boulders",), "wheel_force", (0, 1, 2)),
        (("chassis_contact",), "chassis_force", (0, 1, 2)),
        (("soil", "hard_surface", "pressure_sinkage", "hard_ground"), "wheel_force", (0, 1, 2)),
        (("soil", "penalty_contact"), "wheel_force", (0, 1, 2)),
    ],
    ids=["boulders", "chassis_contact", "hard_ground", "penalty_contact"],
)
def test_what_remains_at_null_does_not_depend_on_velocity(names: tuple[str, ...], key: str, axes: Any) -> None:
    """With friction and damping at null only the push of a contact remains, and at their nominal values they count."""
    shear = () if names[-1] != "penalty_contact" else ("printed_shear",)
    nulls = {names[-1]: CATALOGUE[names[-1]].null()}
    names = (*names, *shear)
    s = states(COUNT)
    still, moving = run(names, nulls, s)[key], run(names, nulls, velocities_changed(s))[key]
    if shear:  # only the normal force is the contact's
        slope = np.array([-np.sin(0.1), 0.0, np.cos(0.1)])
        still, moving = still @ slope, moving @ slope
    scale = np.abs(still).max()
    assert scale > 1.0
    assert np.max(np.abs(still - moving)) < 1e-9 * scale
    damped = run(names, {}, velocities_changed(s))[key]
    assert np.max(np.abs(damped - run(names, {}, s)[key])) > 1e-3 * scale


def test_a_motor_without_coefficients_does_not_feel_its_temperature() -> None:
    s = states(COUNT)
    hotter = {**s, "winding": s["winding"] + 20.0}
    names = ("joint_control", "motor")
    for key in ("joint_torque", "winding_heat"):
        null = {"motor": CATALOGUE["motor"].null()}
        assert np.array_equal(run(names, null, s)[key], run(names, null, hotter)[key])
        assert not np.allclose(run(names, {}, s)[key], run(names, {}, hotter)[key])


@pytest.mark.parametrize("preset", list(LISTS))
def test_an_effect_that_is_not_in_the_list_changes_nothing(preset: str) -> None:
    """Bit for bit the same results, and the same program, whatever parameters lie about for effects not in the list."""
    strangers = {n: e.nominal() for n, e in CATALOGUE.items() if n not in LISTS[preset]}
    again = run(LISTS[preset], strangers, states(COUNT))
    for key, want in base_result(LISTS[preset]).items():
        assert np.array_equal(want, again[key]), key
        assert np.isfinite(want).all(), key
    with jax.enable_x64(True):
        one = jax.tree.map(lambda a: jnp.asarray(a[5]), states(6))
        world = terrain()
        programs = {
            str(jax.make_jaxpr(functools.partial(act, LISTS[preset], world, values))(one)) for values in ({}, strangers)
        }
    assert len(programs) == 1


SMOOTH = {
    "consistent": LISTS["consistent"],
    "integral": LISTS["integral"],
    "field": PRESETS["field"],
    "paper": LISTS["paper"],
    "paper, with all that vanishes": (*LISTS["paper"], *(n for n in VANISHING if n not in LISTS["paper"])),
}


@pytest.mark.parametrize("which", [w if w == "consistent" else pytest.param(w, marks=pytest.mark.slow) for w in SMOOTH])
def test_derivatives_are_finite(which: str) -> None:
    """All forces and heat flows by all parameters and all inputs, forward and reverse, at nominal and null values.

    States: standstill, airborne, touching with sinkage 0, deep, steady rolling without slip, and random ones. One
    random direction shows any derivative that is not finite (0 times NaN is NaN), and <a, J v> = <J' a, v>.
    """
    names = SMOOTH[which]
    effects = effects_named(names)
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        world = terrain()

        def outputs(values: Any, state: Any) -> Any:
            return jnp.concatenate([v.ravel() for v in act(names, world, values, state).values()])

        def one(values: Any, state: Any, way: Any, weight: Any) -> Any:
            _, forward = jax.jvp(outputs, (values, state), way)
            _, pull = jax.vjp(outputs, values, state)
            reverse = pull(weight)
            terms = jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(jnp.abs(a * b)), reverse, way))
            products = jax.tree.leaves(jax.tree.map(lambda a, b: jnp.sum(a * b), reverse, way))
            return forward, reverse, jnp.dot(weight, forward), sum(products), sum(terms)

        both = jax.vmap(one, in_axes=(None, 0, (None, 0), None))
        settings = [{e.name: e.nominal() for e in effects}, {e.name: e.null() for e in effects}]
        if "printed_shear" in names:
            mends = {k: 1.0 for k in CATALOGUE["printed_shear"].parameters if k.startswith("mend")}
            settings.append({**settings[0], "printed_shear": {**settings[0]["printed_shear"], **mends}})
        batch = jax.tree.map(jnp.asarray, states(COUNT, seed=1))
        for number in settings:
            values = jax.tree.map(jnp.asarray, number)
            way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), (values, batch))
            count = sum(v.size for v in base_result(LISTS["consistent"]).values()) // COUNT
            weight = jnp.asarray(rng.normal(size=count))
            forward, reverse, left, right, size = both(values, batch, way, weight)
            for path, value in jax.tree_util.tree_leaves_with_path(reverse):
                bad = np.unique(np.argwhere(~np.isfinite(np.asarray(value)))[:, 0])
                name = jax.tree_util.keystr(path)
                assert bad.size == 0, f"derivative by {name} is not finite in states {bad.tolist()}"
            assert np.isfinite(np.asarray(forward)).all()
            assert np.max(np.abs(left - right) / size) < 1e-9


@pytest.mark.parametrize("names", [LISTS["consistent"], LISTS["integral"]], ids=["consistent", "integral"])
def test_derivatives_are_those_of_the_forces(names: tuple[str, ...]) -> None:
    """Directional derivatives by sinkage, velocities and the soil's parameters against central differences."""
    s = {k: v[5:] for k, v in states(COUNT + 5, seed=2).items()}
    s["sinkage"] = np.abs(s["sinkage"])
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        world = terrain()
        batch = jax.tree.map(jnp.asarray, s)
        moved = {k: jnp.asarray(rng.normal(size=batch[k].shape)) for k in ("sinkage", "velocity", "spin", "slip")}
        way = {k: moved.get(k, jnp.zeros_like(v)) * 1e-2 for k, v in batch.items()}
        soil = {k: jnp.asarray(v) for k, v in CATALOGUE["soil"].nominal().items()}

        def forces(t: Any) -> Any:
            state = jax.tree.map(lambda a, b: a + t * b, batch, way)
            there = {"soil": {k: v * (1.0 + 0.3 * t) for k, v in soil.items()}}
            out = jax.vmap(lambda one: act(names, world, there, one))(state)
            return jnp.concatenate([out["wheel_force"], out["wheel_moment"]], axis=-1)

        h = 1e-6
        exact = np.asarray(jax.jvp(forces, (jnp.zeros(()),), (jnp.ones(()),))[1])
        numeric = np.asarray(forces(jnp.asarray(h)) - forces(jnp.asarray(-h))) / (2 * h)
    error = np.abs(exact - numeric) / (1.0 + np.abs(exact).max(axis=(1, 2), keepdims=True))
    print(f"derivative error: median {np.median(error):.1e}, 99 % {np.quantile(error, 0.99):.1e}")
    # a few wheels stand at a kink: rim speed equal to travel, a boulder just touched
    assert np.median(error) < 1e-9
    assert np.quantile(error, 0.99) < 1e-5
    assert np.abs(exact).max() > 10.0


@pytest.mark.parametrize("effect", list(CATALOGUE.values()), ids=list(CATALOGUE))
def test_documentation_units_and_bounds(effect: Effect) -> None:
    """A documented equation, and for every parameter a nominal and null within bounds, a unit, a meaning, a source."""
    assert len(effect.doc) > 30, "the docstring states equation and source"
    for replaced in effect.replaces:
        assert replaced in CATALOGUE
    for name, p in effect.parameters.items():
        assert np.isfinite(p.nominal) and p.bounds[0] <= p.nominal <= p.bounds[1], name
        assert p.null is None or p.bounds[0] <= p.null <= p.bounds[1], name
        assert p.meaning.strip() and p.source.strip() and p.unit.strip(), name
        assert effect.check(name, p.nominal, "test") == p.nominal
        if "(" in p.unit:  # a power of the sinkage exponent must be written exactly so
            assert to_unit(2.0, p.unit, p.unit, "test", name) == 2.0
        else:
            assert to_unit(2.0, f" {p.unit} ", p.unit, "test", name) == pytest.approx(2.0, rel=1e-12)
        with pytest.raises(UserError, match="does not convert"):
            to_unit(2.0, "candela", p.unit, "test", name)
        for value in (np.nextafter(p.bounds[0], -np.inf), np.nextafter(p.bounds[1], np.inf), np.nan):
            with pytest.raises(UserError):
                effect.check(name, float(value), "test")
    for name, state in effect.state.items():
        assert np.isfinite(state.initial) and state.unit.strip() and state.meaning.strip(), name


@pytest.mark.parametrize("preset", list(PRESETS))
def test_presets_hold_no_effect_beside_one_that_replaces_it(preset: str) -> None:
    names = PRESETS[preset]
    assert len(set(names)) == len(names)
    for name in names:
        assert not set(CATALOGUE[name].replaces) & set(names), name
