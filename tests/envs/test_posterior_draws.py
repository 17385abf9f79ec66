"""Parameters drawn from a fitted model: mean, covariance, bounds, keys, and an environment's use of them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.dynamics.system import default_params
from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.navigation import randomise
from lunar_mjx.envs.navigation.config import SOIL_RANGES
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.model.posterior import Posterior

NAMES = ("soil.k_phi", "soil.friction_angle", "motor.resistance")
LOG = (True, False, True)
COVARIANCE = np.array([[0.04, 0.006, 0.0], [0.006, 0.0025, 0.001], [0.0, 0.001, 0.01]])
COUNT = 40_000


@pytest.fixture(scope="module")
def plain():
    return make_model("luvmi_x", "flat", "consistent")


@pytest.fixture(scope="module")
def model(plain):
    return dataclasses.replace(plain, posterior=Posterior.of(NAMES, LOG, COVARIANCE))


def _draws(model, count=COUNT, seed=0):
    spread = randomise.spread_of(model)
    draw = jax.jit(randomise.draw_spread)
    return jax.device_get(draw(spread, default_params(model), split_keys(jax.random.PRNGKey(seed), count)))


def test_draws_have_the_files_mean_and_covariance(model):
    drawn = _draws(model)
    soil, motor = model.parameters["soil"], model.parameters["motor"]
    deviation = [
        np.log(drawn["soil.k_phi"] / soil["k_phi"]),
        drawn["soil.friction_angle"] - soil["friction_angle"],
        np.log(drawn["motor.resistance"][:, 0] / np.ravel(motor["resistance"])[0]),
    ]
    error = 5.0 / np.sqrt(COUNT)
    size = np.sqrt(np.diag(COVARIANCE))
    np.testing.assert_allclose(np.mean(deviation, axis=1) / size, 0.0, atol=error)
    np.testing.assert_allclose(
        np.cov(deviation) / np.outer(size, size), COVARIANCE / np.outer(size, size), atol=2 * error
    )


def test_all_joints_deviate_together(model):
    own = np.ravel(model.parameters["motor"]["resistance"])
    drawn = _draws(model, 100)["motor.resistance"]
    factor = drawn / own
    assert drawn.shape[1] > 1 and np.ptp(factor[:, 0]) > 0.1
    np.testing.assert_allclose(factor, factor[:, :1] * np.ones_like(own), rtol=1e-6)


def test_draws_stay_within_the_effects_bounds_and_do_not_pile_up_there(plain):
    low, high = plain.effects[plain.effect_names.index("soil")].parameters["friction_angle"].bounds
    near = plain.set("soil", friction_angle=high - 0.02)
    wide = dataclasses.replace(near, posterior=Posterior.of(NAMES[:2], LOG[:2], np.diag([0.04, 0.09])))
    drawn = _draws(wide)["soil.friction_angle"]
    assert np.isfinite(drawn).all() and (drawn >= low).all() and (drawn <= high + 1e-6).all()
    assert np.mean(drawn > high - 1e-5) < 0.002
    assert np.mean(drawn > high - 0.02) == pytest.approx(0.02 * 2 / (0.3 * np.sqrt(2 * np.pi)), rel=0.2)
    # Even a posterior whose every draw lies outside gives values that are allowed.
    edge = dataclasses.replace(
        plain.set("soil", n=1.0), posterior=Posterior.of(("soil.n",), (True,), np.array([[1e6]]))
    )
    n = _draws(edge, 100)["soil.n"]
    bounds = plain.effects[plain.effect_names.index("soil")].parameters["n"].bounds
    assert (n >= bounds[0] * (1 - 1e-6)).all() and (n <= bounds[1] * (1 + 1e-6)).all()


def test_what_is_drawn_by_its_logarithm_stays_positive(plain):
    wide = dataclasses.replace(plain, posterior=Posterior.of(("soil.k_phi",), (True,), np.array([[1e6]])))
    assert plain.effects[plain.effect_names.index("soil")].parameters["k_phi"].bounds[0] == 0.0
    assert (_draws(wide, 100)["soil.k_phi"] > 0.0).all()


def test_a_key_gives_its_draw_whatever_runs_beside_it(model):
    many, again, few = _draws(model, 8), _draws(model, 8), _draws(model, 8, seed=1)
    for name in NAMES:
        np.testing.assert_array_equal(many[name], again[name])
        assert not np.isclose(many[name], few[name]).any()
    keys = split_keys(jax.random.PRNGKey(0), 8)
    one = randomise.draw_spread(randomise.spread_of(model), default_params(model), keys[3:4])
    np.testing.assert_allclose(one["soil.k_phi"], many["soil.k_phi"][3:4], rtol=1e-6)


def test_derivatives_of_draws_are_finite(model):
    spread, params = randomise.spread_of(model), default_params(model)
    keys = split_keys(jax.random.PRNGKey(0), 16)

    def total(factor):
        drawn = randomise.draw_spread(dataclasses.replace(spread, factor=factor), params, keys)
        return sum(jnp.mean(jnp.log(v)) for v in drawn.values())

    slope = np.asarray(jax.grad(total)(spread.factor))
    assert np.isfinite(slope).all() and np.abs(slope).max() > 1e-3


def test_an_environment_takes_from_the_posterior_what_it_tells_and_ranges_for_the_rest(model):
    env = make_navigation("consistent", model=model, places=16, randomise=SOIL_RANGES, posterior=True)
    assert {r.parameter for r in env.config.randomise} == {r.parameter for r in SOIL_RANGES} - set(NAMES)
    state = jax.eval_shape(env.reset, env.params, jax.ShapeDtypeStruct((4, 2), jnp.uint32))
    assert set(state.inner.drawn) == {r.parameter for r in SOIL_RANGES} | set(NAMES)
    # Other values of the same parameters are other parameters of the same program.
    softer = env.place(model.set("soil", friction_angle=0.5))
    assert jax.tree.structure(softer) == jax.tree.structure(env.params)
    assert softer.spread.low[1] == pytest.approx(
        float(env.params.spread.low[1]) + float(model.parameters["soil"]["friction_angle"]) - 0.5, abs=1e-5
    )


def test_a_model_without_posterior_is_refused_by_name(plain):
    with pytest.raises(
        UserError, match=r"posterior = True does not go with a model without \[posterior\].*fitted.toml"
    ):
        make_navigation("consistent", model=plain, posterior=True)
    with pytest.raises(UserError, match="neither true nor false"):
        make_navigation("consistent", model=plain, posterior="yes")
