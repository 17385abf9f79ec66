"""Observations that come late, odometry that drifts, and ground that a mast cannot see."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs import make_navigation, split_keys
from lunar_mjx.envs.navigation import sensing
from lunar_mjx.envs.navigation.observations import Scene, far_scan, scan
from lunar_mjx.envs.navigation.view import VIEW
from lunar_mjx.errors import UserError
from lunar_mjx.terrain import load_terrain, surface
from lunar_mjx.terrain.rocks import build_rocks

RIDE = 0.3
TASK = {"terrain": "flat", "decimation": 50, "episode_time": 1.0, "places": 64, "goal_distance": (1.0, 1.5)}
BLOCKS = ("position", "goal_body", "last_action")
DRIFT = 0.5


def test_an_observation_arrives_after_the_delay_and_the_first_one_until_then():
    made = [jnp.full((2, 3), float(i)) for i in range(7)]
    queue, seen = sensing.queue_of(made[0], 3), []
    for obs in made[1:]:
        late, queue = sensing.arrived(queue, obs)
        seen.append(float(late[0, 0]))
    assert seen == [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]


def test_odometry_errs_by_its_share_of_the_way_to_a_side_of_its_own():
    odometry = sensing.odometry_at_start(split_keys(jax.random.PRNGKey(0), 500), jnp.float32)
    assert not np.asarray(odometry.error).any()
    for way in (1.0, 2.5):
        odometry = sensing.drifted(odometry, jnp.full(500, way), 0.02)
    np.testing.assert_allclose(np.hypot(*odometry.error.T), 0.07, rtol=1e-5)
    assert np.linalg.norm(odometry.astray.mean(axis=0)) < 0.15, "to all sides"


@pytest.fixture(scope="module")
def envs():
    plain = make_navigation("consistent", observations=BLOCKS, **TASK)
    return plain, make_navigation("consistent", observations=BLOCKS, delay=0.3, drift=DRIFT, **TASK)


@pytest.mark.slow
def test_an_environment_observes_late_and_astray_and_drives_as_before(envs):
    keys, count = split_keys(jax.random.PRNGKey(5), 4), 14
    told, places, astray = [], [], None
    for env in envs:
        state, step = env.reset(env.params, keys), jax.jit(env.step)
        if state.inner.odometry is not None:
            astray = np.asarray(state.inner.odometry.astray)
        observed, positions, rules = [state.obs], [state.info["position"]], [{**state.info}]
        for i in range(count):
            action = jnp.tile(jnp.array([1.0, 0.1 * i, 0.0, 0.0, 0.0, 0.0]), (4, 1))
            state = step(env.params, state, action)
            observed.append(state.obs)
            positions.append(state.info["position"])
            rules.append({**state.info})
            if i == 9:
                assert np.asarray(state.done).all()
                final = np.asarray(state.final_obs)
        told.append((np.asarray(observed), final, rules))
        places.append(np.asarray(positions))
    (plain, plain_final, plain_rules), (late, late_final, late_rules) = told
    np.testing.assert_allclose(places[1], places[0], atol=1e-4)
    way = np.cumsum(np.hypot(*np.moveaxis(np.diff(places[0][:10, :, :2], axis=0), -1, 0)), axis=0)
    assert way[-1].min() > 0.02
    blocks = envs[0].blocks
    for t in range(10):
        then = max(t - 3, 0)
        error = DRIFT * way[then - 1][:, None] * astray if then else np.zeros((4, 2))
        expected = plain[then].copy()
        expected[:, :2] += error
        np.testing.assert_allclose(late[t][:, blocks["position"]], expected[:, blocks["position"]], atol=2e-4)
        np.testing.assert_allclose(late[t][:, blocks["last_action"]], plain[t][:, blocks["last_action"]], atol=1e-6)
        # The goal is seen from where the rover believes to be: its distance changes by less than the error.
        off = np.abs(late[t] - plain[then])[:, blocks["goal_body"].start]
        assert (off <= np.hypot(*error.T) + 1e-4).all()
    assert np.abs(late[9] - plain[6])[:, blocks["goal_body"].start].max() > 0.25 * DRIFT * way[5].min()
    # A successor is late, too; the next episode begins with what is seen at its start, and no drift.
    np.testing.assert_allclose(late_final[:, 2], plain[7][:, 2], atol=2e-4)
    assert np.abs(plain_final[:, 2] - plain[7][:, 2]).max() > 1e-6
    for t in range(10, 14):
        np.testing.assert_allclose(late[t][:, 2], plain[max(t - 3, 10)][:, 2], atol=2e-4)
    np.testing.assert_allclose(late[10][:, blocks["goal_body"]], plain[10][:, blocks["goal_body"]], atol=2e-4)
    # Rules act by what is told beside the observation: late as well, and as astray as the block of the same name.
    for t in range(14):
        then = max(t - 3, 10 * (t >= 10))
        for name in ("joint_angle", "body_velocity"):
            np.testing.assert_allclose(late_rules[t][name], plain_rules[then][name], atol=2e-4)
        distance = np.hypot(*np.asarray(late_rules[t]["goal_body"]).T)
        np.testing.assert_allclose(distance, late[t][:, blocks["goal_body"].start], atol=2e-4)
    assert np.abs(np.asarray(plain_rules[9]["body_velocity"]) - plain_rules[6]["body_velocity"]).max() > 1e-3


def _view(x=0.0):
    position = jnp.array([[x, 0.0, RIDE]])
    return SimpleNamespace(position=position, yaw=jnp.zeros(1))


def _boulder():
    """A boulder of 0.45 m on level ground, 1.5 m ahead."""
    rocks = build_rocks(np.array([[1.5, 0.0, 0.0]]), np.array([0.45]), (-10.0, -10.0, 10.0, 10.0))
    return dataclasses.replace(load_terrain("flat"), rocks=rocks)


def test_a_boulder_hides_what_lies_behind_it_and_not_what_lies_before():
    ahead = np.repeat(VIEW.scan_ahead, len(VIEW.scan_aside))
    aside = np.tile(VIEW.scan_aside, len(VIEW.scan_ahead))
    ground = _boulder()
    low, high, all_seen = (
        np.asarray(scan(_view(), Scene(ground, {}, RIDE, 1.0, mast=mast)))[0] for mast in (0.6, 50.0, 0.0)
    )
    top = float(surface(ground, jnp.array(1.5), jnp.array(0.0)))
    assert top > 0.35
    behind = (ahead > 2.2) & (np.abs(aside) < 0.1)
    assert behind.sum() >= 3 and (low[behind] == -1.5).all()
    unknown = low == -1.5
    assert not unknown[ahead < 1.1].any() and not unknown[np.abs(aside) > 1.5].all()
    np.testing.assert_array_equal(low[~unknown], all_seen[~unknown])
    np.testing.assert_array_equal(high, all_seen)
    far = np.asarray(far_scan(_view(), Scene(ground, {}, RIDE, 1.0, mast=0.6)))[0]
    assert (far == -3.0).any() and (far >= -2.0).any()


def test_nothing_hides_level_ground():
    for scale in (1.0, 1.6):
        seen = scan(_view(3.0), Scene(load_terrain("flat"), {}, RIDE, scale, mast=0.8))
        np.testing.assert_allclose(seen, 0.0, atol=1e-5)


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ({"delay": 0.25}, "multiple of 0.1 s"),
        ({"delay": -0.1}, "delay"),
        ({"drift": 2.0}, "drift"),
        ({"mast": -1.0}, "mast"),
        ({"drift": True}, "drift = True is not a number"),
        ({"delay": "0.1"}, "delay = '0.1' is not a number"),
        ({"mast": 1.0}, "mast = 1.0 does nothing where no height_scan is observed"),
    ],
)
def test_what_no_sensor_does_is_refused(setting, says):
    with pytest.raises(UserError, match="navigation") as error:
        make_navigation("consistent", **TASK, **setting)
    assert says in str(error.value)
