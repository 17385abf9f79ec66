"""Each effect on motors, gears and their heat against its formula, written here in NumPy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from lunar_mjx.effects.joint.electrical import limit_of, voltage_of
from lunar_mjx.effects.joint.motor import CURRENT, POSITION, VELOCITY
from tests.effects.joint_harness import (
    AMBIENT,
    DT,
    ETA,
    KELVIN,
    POSITION_GAIN,
    ROTOR,
    VELOCITY_GAIN,
    K,
    N,
    R,
    drive,
    many,
    scene,
)

Array = Any
SIGMA = 5.670374419e-8
SPEEDS = np.array([[-2.0, -0.5, -0.1, 0.0, 0.1, 0.5, 2.0]])


def lost(speed: Array, name: str, celsius: Array = 25.0, target: Array = 0.0, **values: Any) -> Array:
    """Torque that an effect takes away from motors in torque control."""
    s = scene(target, speed=speed, celsius=celsius, mode=2)
    return (drive(s)["torque"] - drive(s, name, **{name: values})["torque"])[0]


def test_coulomb_friction() -> None:
    """0.4 N m against the speed, from 0.1 rad/s on; none at standstill, where it changes sign."""
    assert lost(SPEEDS, "coulomb_friction") == pytest.approx(0.4 * np.tanh(SPEEDS[0] / 0.02), rel=1e-12)
    assert lost(SPEEDS, "coulomb_friction")[[0, 3, 6]] == pytest.approx([-0.4, 0.0, 0.4], abs=1e-9)


def test_dry_friction_cannot_turn_a_rotor_around() -> None:
    """10 N m in a step of 2 ms: the impulse at small speeds is at most the momentum of the rotor at the joint."""
    speed = np.linspace(1e-4, 0.05, 50)[None]
    impulse = lost(speed, "coulomb_friction", torque=10.0) * DT
    assert (impulse <= ROTOR * speed[0] * (1 + 1e-12)).all() and (impulse > 0.3 * ROTOR * speed[0]).all()


def test_stribeck_friction() -> None:
    expected = 0.3 * np.exp(-((SPEEDS[0] / 0.1) ** 2)) * np.tanh(SPEEDS[0] / 0.02)
    assert lost(SPEEDS, "stribeck_friction") == pytest.approx(expected, rel=1e-12, abs=1e-15)


def test_viscous_friction() -> None:
    assert lost(SPEEDS, "viscous_friction") == pytest.approx(0.3 * SPEEDS[0], rel=1e-12)
    assert lost(SPEEDS, "viscous_friction", damping=400.0) == pytest.approx(ROTOR / DT * SPEEDS[0], rel=1e-12)


def test_cold_grease_stiffens_with_the_housing() -> None:
    celsius = np.array([[-100.0, -42.0, 25.0, 100.0]])
    expected = 0.1 * np.exp(-0.025 * (celsius[0] - 25.0)) * 0.5
    assert lost(0.5 + 0 * celsius, "cold_grease", celsius) == pytest.approx(expected, rel=1e-12)
    assert expected[0] / expected[2] == pytest.approx(22.8, abs=0.1)


def test_gear_efficiency_by_direction() -> None:
    """Driving N eta K I as before, driven back N K I/eta (the motor recovers eta of the power), at rest N K I."""
    current = np.array([[0.3, 0.3, -0.3, -0.3, 0.3]])
    speed = np.array([[1.0, -1.0, 1.0, -1.0, 0.0]])
    out = drive(scene(current, speed=speed, mode=CURRENT), "directional_gear_efficiency")["torque"][0]
    rotor = N * K * 0.3
    expected = [ETA * rotor, rotor / ETA, -rotor / ETA, -ETA * rotor, rotor]
    assert out == pytest.approx(np.array(expected), rel=1e-6)


def test_ripple_follows_the_joint() -> None:
    angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)[None]
    values = {"sine": 0.3, "cosine": -0.1, "cycles": 5.0}
    gained = -lost(0 * angle, "cogging", **values)
    assert gained == pytest.approx(-0.1 + 0 * angle[0])
    out = drive(scene(0.0, angle=angle), "cogging", cogging=values)["torque"][0]
    assert out == pytest.approx(0.3 * np.sin(5 * angle[0]) - 0.1 * np.cos(5 * angle[0]), rel=1e-9, abs=1e-12)
    assert out.mean() == pytest.approx(0.0, abs=1e-12), "no work over a revolution"


def test_magnet_nonlinearity() -> None:
    celsius = np.array([[-160.0, 25.0, 125.0]])
    out = drive(scene(3.0, celsius=celsius, mode=CURRENT), "magnet_nonlinearity")["torque"][0]
    dt = celsius[0] - 25.0
    assert out == pytest.approx(N * ETA * K * (1 - 0.0012 * dt - 2e-6 * dt**2) * 3.0, rel=1e-12)


def test_iron_loss_brakes_what_it_heats() -> None:
    """K_fe omega_m^2 into the winding; the rotor is braked by the same power."""
    speed = np.array([[-1.0, 0.0, 0.7]])
    plain, out = drive(scene(2.0, speed=speed)), drive(scene(2.0, speed=speed), "iron_loss")
    power = 1e-6 * (N * speed[0]) ** 2
    assert (out["winding"] - plain["winding"])[0] == pytest.approx(power, rel=1e-9, abs=1e-12)
    assert ((plain["torque"] - out["torque"]) * speed)[0] == pytest.approx(power, rel=1e-9, abs=1e-12)
    heat_only = drive(scene(2.0, speed=speed), "iron_loss", iron_loss={"drag": 0.0})
    np.testing.assert_array_equal(heat_only["torque"], plain["torque"])


def test_gear_friction_heat() -> None:
    """Driving: (1/eta - 1) tau omega; no part of it at standstill."""
    plain = drive(scene(6.0, speed=0.5))
    out = drive(scene(6.0, speed=np.array([[0.5, 0.0]])), "gear_friction_heat")
    assert out["housing"][0] - plain["housing"][0] == pytest.approx(np.array([(1 / ETA - 1) * 3.0, 0.0]), rel=1e-12)


def test_energy_is_conserved_from_the_supply_to_the_joint() -> None:
    """V I = tau omega + heat in both nodes, whichever way the gear turns, with every loss in the list.

    The joint's angle is held, so that cogging is left out; temperatures change K and R.
    """
    losses = (
        "magnet_nonlinearity",
        "directional_gear_efficiency",
        "coulomb_friction",
        "stribeck_friction",
        "viscous_friction",
        "cold_grease",
        "iron_loss",
        "gear_friction_heat",
    )
    s = many()
    out = drive(s, *losses)
    dt = s.winding - KELVIN - 25.0
    back_emf = N * K * (1 - 0.0012 * dt - 2e-6 * dt**2) * s.speed
    supplied = (out["current"] * R * (1 + 0.004 * dt) + back_emf) * out["current"]
    spent = out["torque"] * s.speed + out["winding"] + out["housing"]
    assert np.abs(supplied - spent).max() < 1e-12 * np.abs(supplied).max()
    friction = out["housing"]
    assert friction.min() > -1e-9 * friction.max(), "friction only heats"


def test_sunlight_turns_with_the_rover() -> None:
    """Normal to the left of a rover that faces east looks north: full light from a low Sun in the north."""
    azimuth = np.radians(np.arange(0, 360, 15.0))
    elevation, area, flux = 0.0873, 0.0024, 1361.0
    plain = drive(scene(0.0 * azimuth[None]))["housing"][0]

    def lit(yaw: float, **values: Any) -> Array:
        given = {"sun_azimuth": values.pop("sun_azimuth", 0.0), **values}
        return drive(scene(0.0 * azimuth[None], yaw=yaw), "solar_flux", solar_flux=given)["housing"][0] - plain

    full = 0.4 * area * flux * np.cos(elevation)
    assert lit(0.0) == pytest.approx(full, rel=1e-9)
    assert lit(np.pi) == pytest.approx(0.0, abs=1e-12), "and none after a turn on the spot"
    sun = np.stack([np.cos(elevation) * np.sin(azimuth), np.cos(elevation) * np.cos(azimuth)])
    facing = np.linspace(-np.pi, np.pi, len(azimuth))
    for yaw in (0.0, 1.1):
        normal = np.stack([np.cos(yaw + facing), np.sin(yaw + facing)])
        for i in (0, 7, 13):
            expected = 0.4 * area * flux * np.maximum(sun[:, i] @ normal, 0.0)
            assert lit(yaw, sun_azimuth=azimuth[i], facing=facing) == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert lit(0.0, sun_elevation=-0.01) == pytest.approx(0.0, abs=1e-15), "night"


def test_radiation_to_ground_and_sky() -> None:
    """Row 2 of the catalogue: eps A sigma (F_g T_g^4 + F_s T_sky^4 - T_S^4), whatever the ambient temperature."""
    celsius = np.array([[-190.0, 25.0, 150.0]])
    names = ("housing_radiation", "regolith_infrared")
    values = {"area": 0.0064, "view": 0.4, "ground_temperature": 230.0}
    out = drive(scene(0.0, celsius=celsius), *names, regolith_infrared=values)["housing"][0]
    body = celsius[0] + KELVIN
    assert out == pytest.approx(0.0064 * SIGMA * (0.4 * 230.0**4 + 0.6 * 3.0**4 - body**4), rel=1e-9)
    alone = drive(scene(0.0, celsius=celsius), "housing_radiation")["housing"][0]
    assert alone == pytest.approx(0.0064 * SIGMA * (AMBIENT**4 - body**4), rel=1e-9)


def test_heat_that_the_winding_loses_reaches_the_housing() -> None:
    s = scene(4.0, celsius=np.array([[150.0, 25.0]]), housing=25.0)
    lossless = drive(s)
    out = drive(s, "winding_conduction", "rotor_stator_path")
    flow = np.array([125.0, 0.0]) / 2.46
    assert (out["housing"] - lossless["housing"])[0] == pytest.approx(flow, rel=1e-12)
    assert (lossless["winding"] - out["winding"])[0] == pytest.approx(flow, rel=1e-12)


@pytest.mark.parametrize("delay", [0.003, 0.02, 0.05, 0.1])
def test_delay_is_exact_for_held_commands(delay: float) -> None:
    """The impulse of torque over each step is that of the command of `delay` ago, whole or in part."""
    steps = 120
    rng = np.random.default_rng(0)
    command = np.repeat(rng.uniform(-5, 5, steps // 10), 10)
    out = drive(scene(command[:, None]), "actuator_delay", actuator_delay={"delay": delay})["torque"][:, 0]
    fine = 1000
    late = (np.arange(steps * fine) + 0.5) * DT / fine - delay
    index = np.floor(late / DT).astype(int)
    expected = np.where(index < 0, 0.0, command[np.clip(index, 0, steps - 1)]).reshape(steps, fine).mean(axis=1)
    assert out == pytest.approx(expected, abs=1e-9)


def test_delay_beyond_its_memory_is_that_of_eight_changes() -> None:
    """Commands new at every step: the limit that the documentation states, 8 steps."""
    command = np.linspace(1.0, 5.0, 50)
    out = drive(scene(command[:, None]), "actuator_delay", actuator_delay={"delay": 0.1})["torque"][:, 0]
    assert out[20:] == pytest.approx(command[12:-8], rel=1e-9)


def test_compliance_is_a_lag_of_k_d_over_k_s() -> None:
    """Velocity control: tau + c k_d dtau/dt = tau_0; a step of 1.2 N m with a lag of 30 ms."""
    steps, compliance = 200, 0.01
    out = drive(
        scene(np.full((steps, 1), 0.4), mode=VELOCITY),
        "driveline_compliance",
        driveline_compliance={"compliance": compliance},
    )["torque"][:, 0]
    time = (np.arange(steps) + 1.0) * DT
    rigid = VELOCITY_GAIN * 0.4
    assert out == pytest.approx(rigid * -np.expm1(-time / (compliance * VELOCITY_GAIN)), abs=0.02 * rigid)
    held = drive(
        scene(np.full((steps, 1), 0.4), mode=POSITION),
        "driveline_compliance",
        driveline_compliance={"compliance": compliance},
    )["torque"][-1, 0]
    assert held == pytest.approx(POSITION_GAIN * 0.4 / (1.0 + POSITION_GAIN * compliance), rel=1e-6), "a softer spring"
    free = drive(scene(np.full((5, 1), 2.0), mode=CURRENT), "driveline_compliance")
    assert free["current"] == pytest.approx(2.0)


def test_backlash_is_crossed_at_the_speed_asked_for() -> None:
    """From the middle of 0.014 rad at 0.5 rad/s: 14 ms without torque; after a reversal the whole of it, 28 ms."""
    target = np.concatenate([np.full(50, 0.5), np.full(50, -0.5)])[:, None]
    out = drive(scene(target, mode=VELOCITY), "backlash")
    torque, rigid = out["torque"][:, 0], VELOCITY_GAIN * 0.5
    free = np.abs(torque) < 1e-9
    assert free[:7].all() and torque[7:50] == pytest.approx(rigid, rel=1e-9)
    assert free[50:64].all() and torque[64:] == pytest.approx(-rigid, rel=1e-9)
    assert (np.abs(out["current"][free[:, None]]) < 1e-12).all()


def test_backlash_in_position_control_settles_in_the_gap() -> None:
    """An error smaller than half the play is turned by the motor alone."""
    out = drive(scene(np.full((300, 1), 0.005), mode=POSITION), "backlash")["torque"][:, 0]
    assert np.abs(out).max() < 1e-9
    far = drive(scene(np.full((300, 1), 0.05), mode=POSITION), "backlash")["torque"][-1, 0]
    assert far == pytest.approx(POSITION_GAIN * (0.05 - 0.007), rel=1e-3)


def test_bus_voltage_limits_current_and_speed() -> None:
    """|R I + K N omega| follows V/(1 + |V/V_bus|^8)^(1/8): within 9 % of the sharp limit and never above it."""
    bus = 30.0
    speed = np.linspace(-2.5, 2.5, 41)[None]
    s = scene(np.full((60, 1), 4.0), speed=speed, mode=CURRENT)
    out = drive(s, "voltage_saturation", voltage_saturation={"limit": limit_of(bus)})
    wanted = R * 4.0 + K * N * speed[0]
    current = out["current"][-1]  # the correction of a bare rotor takes some steps
    voltage = R * current + K * N * speed[0]
    assert voltage == pytest.approx(wanted / (1 + np.abs(wanted / bus) ** 8) ** 0.125, rel=1e-9)
    assert (np.abs(voltage) < bus).all()
    assert np.abs(voltage - np.clip(wanted, -bus, bus)).max() < 0.09 * bus
    small = np.abs(wanted) < 0.5 * bus
    assert current[small] == pytest.approx(4.0, rel=2e-3) and small.any()
    assert voltage_of(limit_of(bus)) == pytest.approx(bus) and voltage_of(0.0) == np.inf


def test_harness_and_droop_take_part_in_the_limit() -> None:
    """The same current needs R_w I more; a sagging bus gives less."""
    s = scene(np.full((60, 1), 8.0), speed=0.5, mode=CURRENT)
    alone = drive(s, "voltage_saturation")["current"][-1, 0]
    harness = drive(s, "voltage_saturation", "harness_resistance", harness_resistance={"resistance": 1.0})
    sagging = drive(s, "voltage_saturation", "bus_droop", bus_droop={"resistance": 2.0})
    assert harness["current"][-1, 0] < alone - 0.05 and sagging["current"][-1, 0] < alone - 0.3
    wanted = (R + 1.0) * 8.0 + K * N * 0.5
    limited = wanted / (1 + (wanted / 48.0) ** 8) ** 0.125
    assert harness["current"][-1, 0] == pytest.approx(8.0 - (wanted - limited) / (R + 1.0), rel=1e-9)


def test_a_cold_saturated_motor_comes_to_rest_at_its_idle_speed() -> None:
    """Windings at -190 degC brake faster than a step of 2 ms follows; the speed settles where V = V_bus, no chatter."""
    import jax
    import jax.numpy as jnp

    from lunar_mjx.effects.context import Command
    from lunar_mjx.effects.ports import Pipeline
    from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

    names = ("joint_control", "motor", "voltage_saturation")
    with jax.enable_x64(True):
        pipeline = Pipeline(effects_named(names))
        cold = jnp.asarray([83.15])

        def step(carry: Any, _: Any) -> Any:
            speed, correction = carry
            ctx = bare_context(
                dt=jnp.asarray(DT),
                joint_angle=0 * speed,
                joint_speed=speed,
                winding_temperature=cold,
                rover=rover_info(jnp.ones(1), jnp.ones(1), 1, 3),
                parameters=parameters(pipeline.effects),
            )
            memory = {"voltage_saturation": {"correction": correction}}
            command, memory = pipeline.run("command", ctx, memory, Command(jnp.asarray([5.0]), 0 * speed))
            constant = K * (1 - 0.0012 * (83.15 - 298.15))
            new = speed + DT / ROTOR * (N * ETA * constant * command.current - 2.0)
            return (new, memory["voltage_saturation"]["correction"]), new

        speeds = np.asarray(jax.lax.scan(step, (jnp.zeros(1), jnp.zeros(1)), None, 2000)[1])[:, 0]
    constant = K * (1 - 0.0012 * (83.15 - 298.15))
    idle = 48.0 / (N * constant)
    assert np.ptp(speeds[-200:]) < 1e-6
    assert speeds[-1] == pytest.approx(idle, rel=0.15)
