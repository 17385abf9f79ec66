"""What every effect on motors, gears and their heat promises, through motions with reversals, cold and heat."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects import catalogue
from tests.effects.joint_harness import BASE, arrays, drive, many, runner, values_of

Array = Any
COMPANIONS = {"gear_friction_heat": ("coulomb_friction",)}
"""Effects without which one has little to act on."""
NAMES = (
    "actuator_delay",
    "backlash",
    "cogging",
    "cold_grease",
    "coulomb_friction",
    "directional_gear_efficiency",
    "driveline_compliance",
    "gear_friction_heat",
    "housing_conduction",
    "housing_radiation",
    "iron_loss",
    "magnet_nonlinearity",
    "regolith_infrared",
    "rotor_stator_path",
    "solar_flux",
    "stribeck_friction",
    "viscous_friction",
    "voltage_saturation",
)
SMALL = {"voltage_saturation": 1e-9, "backlash": 1e-7, "driveline_compliance": 1e-10, "magnet_nonlinearity": 1e-9}
"""Step of the difference quotient at the null, where the effect is far from linear over 1e-6 of its unit."""


def outputs(names: tuple[str, ...], values: Any, s: Any) -> Array:
    return jnp.stack(list(runner(names)(values, s).values()))


@pytest.mark.parametrize("name", NAMES)
def test_null_agrees_with_the_list_without_it(name: str) -> None:
    effect = catalogue.get(name)
    extra = COMPANIONS.get(name, ())
    without, null = drive(many(), *extra), drive(many(), *extra, name, **{name: effect.null()})
    for key, want in without.items():
        scale = np.spacing(np.maximum(np.abs(want), np.abs(want).max(axis=0)))
        assert (np.abs(null[key] - want) <= 4 * scale).all(), key
    nominal = drive(many(), *extra, name)
    assert any(np.abs(nominal[k] - v).max() > 1e-6 * np.abs(v).max() for k, v in without.items())


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_at_the_null_are_those_of_a_first_touch(name: str) -> None:
    """By every parameter that has a null: finite, not zero, and equal to the difference quotient towards the inside."""
    effect = catalogue.get(name)
    names = (*BASE, *COMPANIONS.get(name, ()), name)
    with jax.enable_x64(True):
        s = arrays(many())
        null = values_of(names, {name: effect.null()})

        def along(own: Any) -> Array:
            return outputs(names, {**null, name: own}, s)

        exact = jax.jacfwd(along)(null[name])
        base = np.asarray(along(null[name]))
        for key, slope in exact.items():
            slope = np.asarray(slope)
            assert np.isfinite(slope).all(), key
            if effect.parameters[key].null is None:
                continue
            step = SMALL.get(name, 1e-6)
            touched = np.asarray(along({**null[name], key: null[name][key] + step}))
            numeric = (touched - base) / step
            assert np.abs(slope).max() > 0.0, key
            assert np.abs(numeric - slope).max() < 2e-3 * np.abs(slope).max(), key


@pytest.mark.slow
@pytest.mark.parametrize("at", ["null", "nominal"])
def test_derivatives_by_everything_are_finite(at: str) -> None:
    """All effects together, by all parameters and all motions, forward and reverse."""
    names = (*BASE, *NAMES, "harness_resistance", "bus_droop")
    with jax.enable_x64(True):
        values = values_of(names, {} if at == "nominal" else {n: catalogue.get(n).null() for n in names})
        s = arrays(many())
        smooth = {k: v for k, v in s.items() if k != "mode"}
        rng = np.random.default_rng(0)

        def total(values: Any, smooth: Any) -> Array:
            return outputs(names, values, {**smooth, "mode": s["mode"]})

        way = jax.tree.map(lambda a: jnp.asarray(rng.normal(size=a.shape)), (values, smooth))
        result, forward = jax.jvp(total, (values, smooth), way)
        pull = jax.vjp(total, values, smooth)[1](jnp.asarray(rng.normal(size=result.shape)))
        assert np.isfinite(np.asarray(result)).all() and np.isfinite(np.asarray(forward)).all()
        for path, leaf in jax.tree_util.tree_leaves_with_path(pull):
            assert np.isfinite(np.asarray(leaf)).all(), jax.tree_util.keystr(path)


def test_float32_stays_near_float64() -> None:
    """Nominal values, everything together: no digit lost beyond what single precision explains."""
    names = (*BASE, *NAMES)
    exact = drive(many(), *NAMES)
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), values_of(names, {}))
    s = {k: jnp.asarray(v, jnp.int32 if k == "mode" else jnp.float32) for k, v in vars(many()).items()}
    found = runner(names)(single, s)
    for key, want in exact.items():
        assert found[key].dtype == jnp.float32
        assert np.abs(np.asarray(found[key]) - want).max() < 2e-3 * np.abs(want).max(), key
