"""Forward and reverse mode through a whole drive of 10 s, against finite differences."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.batching.computed_once import computed_once
from lunar_mjx.dynamics.reverse import reversible
from lunar_mjx.model import make_model
from lunar_mjx.terrain import inclined

FACTORS = ("gravity", "soil.k_phi", "soil.cohesion", "motor.torque_constant")
SECONDS = 10.0
STEPS = (1e-4, 1e-5, 1e-6)
"""Steps of the finite differences; at 1e-3 a wheel's force changes its branch within the step."""


class Drive:
    """A steady drive along a slope, at an angle to it, begun gently from rest; outputs where it ends and how warm."""

    def __init__(self, rover: str):
        self.system = system = build(make_model(rover, terrain=inclined(0.1)), "structured")
        groups = [g.name for g in system.model.rover.groups for _ in g.joints]
        time = np.arange(round(SECONDS / system.dt)) * system.dt
        ramp = 0.5 - 0.5 * np.cos(np.pi * np.minimum(time / 2.0, 1.0))
        drives = np.array([1.0 if g == "drive" else 0.0 for g in groups])
        self.controls = jnp.asarray(ramp[:, None] * drives, jnp.result_type(float))
        still = jnp.zeros((1, len(groups)))
        settle = jax.jit(lambda s: system.rollout(system.params, s, still, every=500)[0])
        self.start = settle(system.reset(system.params, 0.0, 0.0, 0.4))
        self.step = computed_once(self._step)
        self.backward = reversible(self._step)

    def _step(self, factors, state, control):
        params = self.system.params
        effects = {name: dict(values) for name, values in params.effects.items()}
        for name, factor in zip(FACTORS[1:], factors[1:], strict=True):
            effect, _, parameter = name.partition(".")
            effects[effect][parameter] = effects[effect][parameter] * factor
        params = dataclasses.replace(params, gravity=params.gravity * factors[0], effects=effects)
        return self.system.step(params, state, control)[0]

    def end(self, factors, step=None):
        """Position, velocity along the ground and the first winding's temperature after the drive."""
        step = step or self.step
        last = jax.lax.scan(lambda s, u: (step(factors, s, u), None), self.start, self.controls)[0]
        return jnp.concatenate([last.qpos[:3], last.qvel[:2], last.temperature.winding[:1]])

    def reverse(self, weights):
        """Gradient of the weighted sum of the outputs, in reverse mode."""
        return jax.grad(lambda f: self.end(f, self.backward) @ weights)


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
def test_ten_seconds_in_both_modes_agree_with_finite_differences(rover):
    with jax.enable_x64(True):
        drive = Drive(rover)
        one, weights = jnp.ones(len(FACTORS)), jnp.linspace(1.0, 2.0, 6)
        run = jax.jit(drive.end)
        moved = np.asarray(run(one))[:2] - np.asarray(drive.start.qpos)[:2]
        forward = np.asarray(jax.jit(jax.jacfwd(drive.end))(one))
        reverse = np.asarray(jax.jit(drive.reverse(weights))(one))
        errors = []
        for h in STEPS:
            sides = [(np.asarray(run(one.at[i].add(h))), np.asarray(run(one.at[i].add(-h)))) for i in range(len(one))]
            central = np.stack([(a - b) / (2 * h) for a, b in sides], axis=1)
            errors.append(np.abs(central - forward).max(axis=1) / np.abs(forward).max(axis=1))
        weights = np.asarray(weights)
    print(
        rover,
        "travelled",
        np.linalg.norm(moved),
        "m; worst relative difference by step",
        dict(zip(STEPS, np.max(errors, axis=1), strict=True)),
    )
    assert np.linalg.norm(moved) > 0.3
    assert (np.abs(forward).max(axis=1) > 1e-6).all()
    # an output's greatest derivative is the scale of its row: some factors hardly matter to some outputs
    assert np.min(np.max(errors, axis=1)) < 1e-6
    np.testing.assert_allclose(reverse, forward.T @ weights, rtol=1e-7, atol=1e-9 * np.abs(forward).max())


@pytest.mark.slow
@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
def test_ten_seconds_in_single_precision_are_finite(rover):
    drive = Drive(rover)
    one = jnp.ones(len(FACTORS), jnp.float32)
    gradient = np.asarray(jax.jit(drive.reverse(jnp.linspace(1.0, 2.0, 6)))(one))
    assert gradient.dtype == np.float32 and np.isfinite(gradient).all() and (gradient != 0.0).all()
