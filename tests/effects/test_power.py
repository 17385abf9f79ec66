"""Electric power and the chassis: every joule of the battery and the Sun is found again."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate

from lunar_mjx.backends.physics import read_numbers
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.heat import step_heat
from lunar_mjx.dynamics.signals import observe
from lunar_mjx.dynamics.state import Temperature
from lunar_mjx.dynamics.system import default_params
from lunar_mjx.effects.context import Command, Heat, Power
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.effects.ports import Pipeline
from lunar_mjx.effects.power.supply import charge_of, open_voltage, terminal_voltage
from lunar_mjx.errors import UserError
from lunar_mjx.logs.schema import find_channel
from lunar_mjx.model import make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.model.sun import SunSettings
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain.sky import Sunlight
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

DT, CURRENT, SIGMA = 0.01, 3, 5.670374419e-8
NAMES = (
    "joint_control",
    "motor",
    "motor_power",
    "electronics",
    "solar_panels",
    "battery",
    "winding_conduction",
    "rotor_stator_path",
    "gear_friction_heat",
    "chassis_node",
)


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def run(
    steps: int, current: Any = (2.0, 1.0), speed: Any = (1.0, 0.5), sun: float = 0.0, names: Any = NAMES, **values: Any
) -> Any:
    """Two motors at given speeds and currents under a Sun from the left: power, heat and states of every step."""
    pipeline = Pipeline(effects_named(names))
    p = parameters(pipeline.effects, values)
    has_battery = "battery" in names
    zero, one, joint = jnp.zeros(()), jnp.ones(()), jnp.zeros(2)
    speed = jnp.asarray(speed)
    rover = rover_info(joint + 0.25, joint + 0.2, joints=2, mode=CURRENT)

    def step(carry: Any, _: Any) -> Any:
        temperature, state = carry
        ctx = bare_context(
            time=zero,
            dt=zero + DT,
            ambient_temperature=zero + 200.0,
            position=Vec3(zero, zero, zero),
            frame=Frame(Vec3(one, zero, zero), Vec3(zero, one, zero), Vec3(zero, zero, one)),
            joint_angle=joint,
            joint_speed=speed,
            winding_temperature=temperature.winding_kelvin,
            housing_temperature=temperature.housing_kelvin,
            rover=rover,
            parameters=p,
            sunlight=Sunlight(Vec3(zero, zero + 0.6, zero + 0.8), zero + sun),
            bus_voltage=terminal_voltage(p["battery"], SimpleNamespace(**state["battery"])) if has_battery else None,
        )
        command, state = pipeline.run("command", ctx, state, Command(jnp.asarray(current), joint))
        ctx = dataclasses.replace(ctx, command=command)
        torque, state = pipeline.run("motor_torque", ctx, state, joint)
        power, state = pipeline.run("power", dataclasses.replace(ctx, torque=torque), state, Power(zero, zero, zero))
        ctx = dataclasses.replace(ctx, torque=torque, power=power)
        heat, state, temperature = step_heat(pipeline, "euler", ctx, temperature, state)
        seen = {
            "bus": ctx.bus_voltage if has_battery else zero,
            "power": power,
            "heat": heat,
            "torque": torque,
            "current": command.current,
            "history": state,
        }
        return (temperature, state), seen

    start = Temperature(joint, joint, joint, joint)
    sizes = {"joint": joint, "rover": zero}
    memory = {e.name: {k: v.reset(sizes[v.axis]) for k, v in e.state.items()} for e in pipeline.effects if e.state}
    (temperature, state), seen = jax.lax.scan(step, (start, memory), None, steps)
    return SimpleNamespace(p=p, temperature=temperature, state=state, speed=np.asarray(speed), **seen)


@pytest.mark.parametrize("sun", [0.0, 400.0])
def test_energy_is_conserved(sun: float):
    """Battery, panels and absorbed sunlight against motion, warmed windings, housings and chassis, and radiation."""
    out = run(4000, sun=sun)
    battery, chassis = out.p["battery"], out.p["chassis_node"]
    used = float(out.state["battery"]["used"])
    given, _ = integrate.quad(lambda u: float(open_voltage(battery, charge_of(battery, u))), 0.0, used)
    heat: Heat = out.heat
    motion = DT * float(jnp.sum(out.torque * out.speed))
    warmed = float(jnp.sum(out.temperature.winding * heat.winding_capacity[-1]))
    warmed += float(jnp.sum(out.temperature.housing * heat.housing_capacity[-1]))
    warmed += chassis.capacity * float(out.state["chassis_node"]["warmer"])
    temperature = chassis.initial + np.concatenate([[0.0], out.history["chassis_node"]["warmer"][:-1]])
    radiated = DT * chassis.radiator * SIGMA * np.sum(temperature**4 - chassis.ground_view * 200.0**4)
    absorbed = DT * 4000 * chassis.absorber * sun
    panels = DT * float(jnp.sum(out.power.solar))
    if sun:
        # left panel, 0.6 of the Sun
        assert panels == pytest.approx(40.0 * 0.25 * 400.0 * 0.6, rel=1e-12)
    assert given + panels + absorbed == pytest.approx(motion + warmed + radiated, rel=1e-5)
    assert given > 1000.0


def test_the_battery_is_a_voltage_behind_a_resistance():
    """U I - R I^2 = P, and in closed form over time where U does not depend on the charge."""
    flat = {"full_voltage": 48.0, "empty_voltage": 48.0, "resistance": 0.2, "capacity": 3600.0}
    out = run(1000, current=(0.0, 0.0), names=("electronics", "battery"), battery=flat, electronics={"load": 480.0})
    current = (48.0 - math.sqrt(48.0**2 - 4.0 * 0.2 * 480.0)) / 0.4
    np.testing.assert_allclose(out.power.current, current, rtol=1e-12)
    np.testing.assert_allclose(out.power.voltage * out.power.current, 480.0, rtol=1e-12)
    np.testing.assert_allclose(out.power.loss, 480.0 + 0.2 * current**2, rtol=1e-12)
    assert float(out.state["battery"]["used"]) == pytest.approx(10.0 * current, rel=1e-12)


@pytest.mark.parametrize("resistance", [0.1, 1.0])
def test_motors_are_limited_by_the_voltage_of_the_battery(resistance: float):
    """Two motors ask for more than the battery gives: V' = V/(1 + |V/U|^8)^(1/8), U = U_0 - R I, and U I = P."""
    names = ("joint_control", "motor", "voltage_saturation", "motor_power", "electronics", "battery")
    battery = {"full_voltage": 30.0, "empty_voltage": 30.0, "resistance": resistance}
    free = {"winding_capacity": 1e12, "housing_capacity": 1e12, "alpha": 0.0, "beta": 0.0}
    out = run(200, current=(9.0, 9.0), names=names, battery=battery, motor=free, motor_power={"efficiency": 1.0})
    motor, current, bus = out.p["motor"], np.asarray(out.current[-1]), float(out.bus[-1])
    assert float(out.bus[0]) == 30.0 and bus < 30.0 - resistance
    back_emf = motor.torque_constant * motor.gear_ratio * out.speed
    asked = motor.resistance * 9.0 + back_emf
    voltage = motor.resistance * current + back_emf
    np.testing.assert_allclose(voltage, asked / (1.0 + (asked / bus) ** 8) ** 0.125, rtol=1e-9)
    drawn = 60.0 + float(voltage @ current)
    assert bus == pytest.approx(30.0 - resistance * drawn / bus, rel=1e-9)
    assert np.ptp(np.asarray(out.bus[-20:])) < 1e-6, "no chatter"


def test_float32_keeps_the_charge():
    """A million steps' worth of a day's charge would be lost in rounding without the compensated sum."""
    with jax.enable_x64(False):
        out = run(20000, names=("electronics", "battery"), battery={"full_voltage": 50.0, "empty_voltage": 50.0})
    current = (50.0 - math.sqrt(50.0**2 - 4.0 * 0.1 * 60.0)) / 0.2
    assert float(out.state["battery"]["used"]) == pytest.approx(20000 * DT * current, rel=2e-7)


def test_a_full_battery_takes_nothing_and_an_empty_one_stops_the_motors():
    full = run(50, (0.0, 0.0), sun=1361.0, battery={"initial": 1.0}, electronics={"load": 0.0})
    assert float(full.power.solar[0]) > 100.0 and np.abs(full.power.current).max() == 0.0
    charging = run(50, (0.0, 0.0), sun=1361.0, electronics={"load": 0.0})
    assert np.max(charging.power.current) < 0.0 and np.min(charging.power.voltage) > 50.0
    small = {"capacity": 5.0, "initial": 0.5, "cut_off": 0.2, "restart": 0.1}
    empty = run(400, battery=small)
    on = np.asarray(empty.current[:, 0]) > 0.0
    assert on[0] and not on[-1] and np.abs(np.diff(on.astype(int))).sum() == 1
    assert np.abs(empty.torque[-1]).max() == 0.0
    charge = charge_of(empty.p["battery"], np.asarray(empty.history["battery"]["used"]))
    assert charge[np.argmin(on) - 1] == pytest.approx(0.2, abs=0.01) and charge.min() > -0.01
    again = run(3000, battery=small, sun=1361.0, electronics={"load": 5.0}, current=(8.0, 8.0), speed=(3.0, 3.0))
    assert np.abs(np.diff((np.asarray(again.current[:, 0]) > 0.0).astype(int))).sum() >= 2


def test_braking_motors_give_back_what_is_asked_of_them():
    for returned in (0.0, 0.6):
        out = run(1, (-0.5, 0.0), (2.0, 0.0), motor_power={"returned": returned})
        motor = out.p["motor"]
        back_emf = motor.torque_constant * motor.gear_ratio * 2.0
        each = -0.5 * (motor.resistance * -0.5 + back_emf)
        assert each < 0.0
        load = 60.0 + returned * each
        assert float(out.power.load[0]) == pytest.approx(load, rel=1e-9)
        lost = float(out.power.loss[0]) - 0.1 * float(out.power.current[0]) ** 2
        assert lost == pytest.approx(60.0 - (1.0 - returned) * each, rel=1e-9)


def test_a_chassis_left_alone_tends_to_the_temperature_at_which_it_radiates_its_gain():
    names = ("electronics", "motor", "chassis_node")
    node = {"capacity": 5.0, "conductance": 0.0, "absorber": 0.05}
    out = run(20000, (0.0, 0.0), sun=1000.0, names=names, chassis_node=node)
    gain = 60.0 + 0.05 * 1000.0
    wanted = (gain / (0.4 * SIGMA) + 0.2 * 200.0**4) ** 0.25
    assert 293.15 + float(out.state["chassis_node"]["warmer"]) == pytest.approx(wanted, rel=1e-6)
    assert float(out.temperature.housing[0]) == 0.0 and REFERENCE_TEMPERATURE == 298.15


def test_a_model_with_a_sun_is_saved_and_read(tmp_path):
    model = make_model("luvmi_x", "flat", "field")
    for name in ("motor_power", "electronics", "solar_panels", "battery", "chassis_node"):
        model = model.add(name)
    assert "housing_conduction" not in model.effect_names
    model = model.replace(sun=SunSettings(azimuth_deg=10.0, elevation_deg=2.0, horizon=False))
    again = load_model(save_model(model, tmp_path / "model.toml"))
    assert again.sun == model.sun and again.effect_names == model.effect_names
    with pytest.raises(UserError, match=r"sun = at rest .*remove \[sun\]"):
        read_numbers(make_model("luvmi_x", "flat").replace(sun=model.sun), "native")


def test_a_rover_steps_with_all_of_it():
    """Traced, not run: states keep their shapes, the ambient temperature is the Sun's, and no Sun adds no array."""
    model = make_model("luvmi_x", "flat", "field")
    assert default_params(model).sun is None
    for name in ("motor_power", "electronics", "solar_panels", "battery", "chassis_node", "solar_flux"):
        model = model.add(name)
    system = build(model.replace(sun=SunSettings(horizon=False)))
    state = jax.jit(system.reset)(system.params)
    assert float(state.temperature.winding_kelvin[0]) == pytest.approx(230.0)
    after, seen = jax.eval_shape(system.step, system.params, state, jnp.zeros(len(system.joint_names)))
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, state)
    drive = jax.tree.map(lambda a: jnp.ones((3, *a.shape)), seen)
    channels = observe(system, dataclasses.replace(drive, time=jnp.arange(3.0))).channels
    wanted = {"bus_load_W", "bus_solar_W", "bus_voltage_V", "battery_charge_ratio", "chassis_temperature_degC"}
    assert wanted <= set(channels) and all(find_channel(name) for name in wanted)
    assert float(channels["chassis_temperature_degC"][0]) == pytest.approx(1.0 - 273.15)
    bare = build(make_model("luvmi_x", "flat", "field"))
    state = bare.reset(bare.params)
    assert jax.eval_shape(bare.step, bare.params, state, jnp.zeros(len(bare.joint_names)))[1].supply is None
