"""The motors' thermal network: closed-form step response in float32, energy balance, radiation, ambient."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import effects_reference as ref
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics.heat import step_heat
from lunar_mjx.dynamics.state import Temperature
from lunar_mjx.effects import catalogue
from lunar_mjx.effects.base import Parameter, effect
from lunar_mjx.effects.context import Command
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE
from lunar_mjx.effects.ports import Pipeline
from lunar_mjx.effects.presets import PRESETS
from tests.effects.effects_harness import bare_context, effects_named, parameters

Array = Any
POWERS = np.array([0.05, 0.2, 0.5, 2.0, 10.0, 50.0])
C_R, C_S, R_1, R_2 = 4.07, 55.0, 2.46, 10.9


@effect("heat", power=Parameter(0.0, 0.0, (0.0, 1e3), "W", "heat made in the winding", "test", axis="joint"))
def winding_power(ctx: Any, p: Any, x: Any, heat: Any) -> Any:
    """A constant power into the winding."""
    return dataclasses.replace(heat, winding=heat.winding + p.power)


NETWORK = ("motor", "winding_power", "winding_conduction", "rotor_stator_path", "housing_convection")


@functools.partial(jax.jit, static_argnames=("names", "integrator", "steps", "samples"))
def _run(
    names: Any, integrator: str, steps: int, samples: int, start: Any, dt: Any, values: Any, ambient: Any, current: Any
) -> Any:
    pipeline = Pipeline(effects_named([winding_power if n == "winding_power" else n for n in names]))

    def step(carry: Any, _: Any) -> Any:
        t, flows = carry
        ctx = bare_context(
            dt=dt,
            ambient_temperature=ambient,
            joint_angle=jnp.zeros_like(t.winding),
            winding_temperature=t.winding_kelvin,
            housing_temperature=t.housing_kelvin,
            command=Command(current, current),
            parameters=parameters(pipeline.effects, values),
        )
        heat, _, t = step_heat(pipeline, integrator, ctx, t, {})
        return (t, (flows[0] + dt * heat.winding, flows[1] + dt * heat.housing)), None

    def sample(carry: Any, _: Any) -> Any:
        carry, _ = jax.lax.scan(step, carry, None, length=steps // samples)
        return carry, (carry[0].winding_kelvin, carry[0].housing_kelvin, *carry[1], *jax.tree.leaves(carry[0]))

    flows = (jnp.zeros_like(start[0]), jnp.zeros_like(start[0]))
    first = Temperature(start[0], 0 * start[0], start[1], 0 * start[0])
    return jax.lax.scan(sample, (first, flows), None, length=samples)[1]


def respond(
    names: tuple[str, ...],
    dtype: Any,
    dt: float,
    steps: int,
    samples: int,
    *,
    integrator: str = "heun",
    power: Array = POWERS,
    start: float = REFERENCE_TEMPERATURE,
    ambient: float = REFERENCE_TEMPERATURE,
    current: float = 0.0,
    **values: Any,
) -> tuple[Array, ...]:
    """Steps motors that are given constant powers, by the library's own stepping.

    Returns:
      Winding and housing temperature, K; net heat so far into winding and housing, J; the four compensated offsets,
      K; each (samples, motors).
    """
    with jax.enable_x64(np.dtype(dtype) == np.float64):
        offset = jnp.full(len(power), start - REFERENCE_TEMPERATURE, dtype)
        values = {"winding_power": {"power": jnp.asarray(power, dtype)}, **values}
        arguments = (jnp.asarray(v, dtype) for v in (dt, ambient))
        dt_, ambient_ = arguments
        amperes = jnp.full(len(power), current, dtype)
        out = _run(names, integrator, steps, samples, (offset, offset), dt_, values, ambient_, amperes)
        return tuple(np.asarray(o, float) for o in out)


@pytest.mark.parametrize("ambient", [REFERENCE_TEMPERATURE, 100.0])
@pytest.mark.parametrize("dt", [0.002, 0.004])
@pytest.mark.parametrize("dtype, tolerance", [(np.float32, 1e-4), (np.float64, 1e-6)])
def test_step_response(dtype: Any, tolerance: float, dt: float, ambient: float) -> None:
    """Rise of winding and housing after a step of 0.05..50 W against the matrix exponential, relative to the rise.

    The winding from the first sample (0.5 s or 1 s) to 300 s or 600 s; the housing from 6 s on: its rise grows with the
    square of time, and at 0.05 W and 1 s it is 1e-5 K, less than float32 resolves in the difference of temperatures.
    """
    steps, samples = 150_000, 600
    out = respond(NETWORK, dtype, dt, steps, samples, start=ambient, ambient=ambient)
    time = dt * steps / samples * np.arange(1, samples + 1)
    start = float(dtype(ambient - REFERENCE_TEMPERATURE))
    exact = ref.winding_response(POWERS, time, C_R, C_S, R_1, R_2)
    for name, total, lost, rise, begin in zip(
        ("winding", "housing"), out[4::2], out[5::2], exact, (0.0, 6.0), strict=True
    ):
        error = np.abs((total - lost - start) / rise - 1.0)[time >= begin]
        print(f"{name} {dtype.__name__} dt {dt} at {ambient} K: {error.max():.1e}")
        assert error.max() < tolerance


def test_step_response_over_an_hour() -> None:
    """1.8 million float32 steps of 2 ms: increments that a float32 near 300 K could not take (physics notes, 2)."""
    out = respond(NETWORK, np.float32, 0.002, 1_800_000, 10)
    exact = ref.winding_response(POWERS, 360.0 * np.arange(1, 11), C_R, C_S, R_1, R_2)
    for name, total, rise in zip(("winding", "housing"), out[4::2], exact, strict=True):
        error = np.abs(total / rise - 1.0).max()
        print(f"{name} over an hour: {error:.1e}")
        assert error < 1e-4
    naive, increment = np.float32(298.15), np.float32(0.002 * 0.05 / C_S)
    assert naive + increment == naive


def test_euler_is_the_printed_integrator() -> None:
    """Eqs. 4 and 5 step by step in NumPy, to rounding; its error against the exact response is of first order."""
    steps, dt = 1000, 0.1
    out = respond(NETWORK, np.float64, dt, steps, steps, integrator="euler")
    winding, housing = np.zeros_like(POWERS), np.zeros_like(POWERS)
    for _ in range(steps):
        flow = (winding - housing) / R_1
        winding, housing = winding + dt * (POWERS - flow) / C_R, housing + dt * (flow - housing / R_2) / C_S
    assert out[4][-1] == pytest.approx(winding, rel=1e-10)
    assert out[6][-1] == pytest.approx(housing, rel=1e-10)
    exact = ref.winding_response(POWERS, np.array([dt * 10]), C_R, C_S, R_1, R_2)[0][0]
    halved = respond(NETWORK, np.float64, dt / 2, 20, 1, integrator="euler")[4][0]
    assert (exact - halved) / (exact - out[4][9]) == pytest.approx(0.5, abs=0.02)


def heat_effects(preset: str) -> tuple[str, ...]:
    return tuple(n for n in PRESETS[preset] if "heat" in catalogue.get(n).ports)


def balance(preset: str, rule: Any, ambient: float, integrator: str) -> tuple[Array, Array, Array, Array]:
    """Joule heat, heat stored, heat to the surroundings, and winding to housing, J, from the temperatures alone."""
    steps, dt, current = 60_000, 0.01, 0.8
    start = 290.0
    names = heat_effects(preset)
    out = respond(
        names,
        np.float64,
        dt,
        steps,
        steps,
        integrator=integrator,
        start=start,
        ambient=ambient,
        current=current,
        power=np.zeros(1),
    )
    winding, housing = (np.concatenate([[start], t[:, 0]]) for t in out[:2])
    p = {n: catalogue.get(n).nominal() for n in names}
    motor = p["motor"]
    joule = current**2 * ref.resistance(motor["resistance"], motor["alpha"], winding)
    loss = np.zeros_like(housing)
    if "housing_convection" in p:
        loss += (housing - ambient) / p["housing_convection"]["R_th2"]
    if "housing_conduction" in p:
        loss += p["housing_conduction"]["conductance"] * (housing - ambient)
    if "housing_radiation" in p:
        q = p["housing_radiation"]
        loss += q["emissivity"] * ref.STEFAN_BOLTZMANN * q["area"] * (housing**4 - ambient**4)
    stored = motor["winding_capacity"] * (winding[-1] - start) + motor["housing_capacity"] * (housing[-1] - start)
    return rule(joule, dt), stored, rule(loss, dt), rule((winding - housing) / motor["R_th1"], dt)


@pytest.mark.parametrize("ambient", [100.0, 298.15, 400.0])
def test_heat_in_is_heat_stored_and_heat_out(ambient: float) -> None:
    """`consistent`, 10 minutes at 0.8 A: conservation of energy to 1e-6 of the heat that went in."""
    heat, stored, out, passed = balance("consistent", lambda y, dt: np.trapezoid(y, dx=dt), ambient, "heun")
    print(f"at {ambient} K: in {heat:.1f} J, stored {stored:.1f}, out {out:.1f}, error {heat - stored - out:.1e}")
    assert abs(heat - stored - out) < 1e-6 * heat
    assert passed > 0.1 * heat


def test_the_paper_loses_the_heat_between_winding_and_housing() -> None:
    """`paper` violates the balance by exactly the missing term of eq. 3, the integral of (T_R - T_S)/R_th1 (flaw 1)."""
    heat, stored, out, passed = balance("paper", lambda y, dt: y[:-1].sum() * dt, 298.15, "euler")
    print(f"paper: in {heat:.1f} J, stored {stored:.1f}, out {out:.1f}, lost {heat - stored - out:.1f}")
    assert heat - stored - out == pytest.approx(passed, rel=1e-9)
    assert passed > 0.5 * heat
    mended = (*heat_effects("paper"), "rotor_stator_path")
    assert set(mended) - set(heat_effects("consistent")) == {"housing_convection"}


@pytest.mark.parametrize("integrator", ["heun", "euler"])
def test_equilibrium(integrator: str) -> None:
    """No power and everything at the ambient temperature: nothing moves, whatever the path."""
    for names in (heat_effects("consistent"), heat_effects("paper")):
        out = respond(names, np.float64, 0.01, 1000, 1, start=250.0, ambient=250.0, integrator=integrator)
        assert np.abs(out[0] - 250.0).max() < 1e-12 and np.abs(out[1] - 250.0).max() < 1e-12
