"""The navigation task with a rover: adapters, rewards and ends as the physics' own state says. One compiled step."""

from __future__ import annotations

import dataclasses

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from lunar_mjx.agents.configs import get_training
from lunar_mjx.agents.evaluate import Evaluator
from lunar_mjx.agents.policy import load_policy, shipped_policies, shipped_policy
from lunar_mjx.agents.run import unseen_params
from lunar_mjx.envs import make_agent, make_navigation, split_keys
from lunar_mjx.envs.gymnasium_env import NAVIGATION
from lunar_mjx.envs.navigation import rewards
from lunar_mjx.envs.navigation.actions import ACTION_MODES, action_map, reachable_speed
from lunar_mjx.envs.navigation.config import SOIL_RANGES, TASKS, UNSEEN_SOIL
from lunar_mjx.envs.navigation.places import draw_places
from lunar_mjx.envs.navigation.randomise import Range, check_ranges
from lunar_mjx.envs.navigation.view import VIEW
from lunar_mjx.envs.navigation.worlds import WORLDS, world
from lunar_mjx.errors import UserError
from lunar_mjx.model import make_model
from lunar_mjx.terrain import load_terrain, surface
from lunar_mjx.terrain.rocks import build_rocks

SHORT = {
    "task": "consistent",
    "terrain": "flat",
    "decimation": 50,
    "episode_time": 1.0,
    "places": 64,
    "goal_distance": (1.0, 1.5),
    "randomise": (Range("soil.cohesion", 0.5, 2.0, "log", relative=True), Range("winding_temperature", 280.0, 300.0)),
}


@pytest.fixture(scope="module")
def env():
    made = gym.make(NAVIGATION, render_mode="rgb_array", view="top", **SHORT)
    yield made
    made.close()


@pytest.mark.slow
def test_passes_gymnasiums_check(env):
    check_env(env.unwrapped, skip_render_check=True)
    assert env.observation_space.shape == (17,) and env.action_space.shape == (6,)


@pytest.mark.slow
def test_observation_reward_and_end_follow_the_physics(env):
    own = env.unwrapped
    obs, info = env.reset(seed=4)
    state = own._state
    assert 1.0 <= np.hypot(*obs[15:]) <= 1.5 and (obs[:3] == 0).all() and np.hypot(*info["goal_body"]) >= 1.0
    assert 280.0 < float(state.inner.drawn["winding_temperature"][0]) < 300.0
    total, steps = 0.0, own.env.episode_steps
    assert steps == 10
    for i in range(steps):
        before = np.asarray(own._state.inner.physics.qpos[0, :2])
        goal = np.asarray(own._state.inner.goal[0])
        obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.3, 0, 0, 0, 0], np.float32))
        place = before * 0 + np.asarray(state.inner.origin[0, :2]) + obs[:2]
        gained = np.hypot(*(goal - before)) - np.hypot(*(goal - place))
        bearing = np.arctan2(*(goal - place)[::-1]) - obs[5]
        hand = 20 * gained + 0.1 * np.cos(bearing) - 0.05 * np.abs(obs[3:5]).sum() - 0.1 * abs(obs[14])
        assert reward == pytest.approx(hand, abs=1e-2)
        total += reward
        assert truncated == (i == steps - 1) and not terminated
    assert info["episode_return"] == pytest.approx(total, rel=1e-4) and info["success"] == 0.0
    assert np.hypot(*obs[:2]) > 0.01, "it drove"
    fresh = own._state.inner
    assert int(fresh.steps[0]) == 0 and not np.allclose(fresh.goal[0], goal), "the next episode has another goal"


@pytest.mark.slow
def test_episodes_begin_anew_where_and_only_where_they_ended(env):
    own = env.unwrapped.env
    state = own.reset(own.params, split_keys(jax.random.PRNGKey(3), 40))
    restart = jax.jit(own._restart)
    done = np.zeros(40, bool)
    done[[0, 3, 4, 5]] = True

    def ended(state):
        return dataclasses.replace(state, terminated=jnp.asarray(done), final_obs=state.obs + 1.0)

    # taken from what is prepared; prepared anew because the same rovers end again; then because enough were taken
    for turn in range(3):
        if turn == 2:
            done[[19, 39]] = True
        state = ended(state)
        made = restart(own.params, state.inner, state)
        anew = own.reset(own.params, state.inner.key)
        for name in ("obs", "info"):
            _taken_where(done, *(getattr(s, name) for s in (made, anew, state)))
        _taken_where(done, *(dataclasses.replace(s.inner, ready=None, used=None) for s in (made, anew, state)))
        np.testing.assert_array_equal(made.final_obs, state.final_obs)
        np.testing.assert_array_equal(made.inner.used, done)
        assert not np.allclose(made.inner.goal[done], state.inner.goal[done])
        state = made


def _taken_where(done, made, anew, old):
    for got, fresh, before in zip(*map(jax.tree.leaves, (made, anew, old)), strict=True):
        at = done.reshape(-1, *[1] * (got.ndim - 1))
        np.testing.assert_allclose(got, np.where(at, fresh, before), rtol=1e-5, atol=1e-5)


@pytest.mark.slow
def test_pictures_show_rover_and_goal(env):
    env.reset(seed=4)
    first = env.render()
    assert first.dtype == np.uint8 and first.ndim == 3 and first.shape[2] == 3
    rover, goal = (255, 196, 60), (90, 255, 120)
    for colour in (rover, goal):
        assert (np.abs(first.astype(int) - colour).sum(axis=2) < 30).sum() > 10
    for _ in range(9):
        env.step(np.array([1.0, 0, 0, 0, 0, 0], np.float32))
    assert (env.render() != first).any(), "it moves"
    with pytest.raises(UserError, match="view"):
        gym.make(NAVIGATION, render_mode="rgb_array", view="side", **SHORT)


@pytest.mark.slow
def test_straight_line_and_shipped_policy_reach_goals_on_flat_ground_in_every_soil():
    # 25 s at 1 m/s, which 48 V do not allow: three and a half times as long
    env = make_navigation("large", terrain="flat", goal_distance=(4.0, 5.0), episode_time=90.0, places=64)
    straight, policy = make_agent("scripted", env), load_policy(shipped_policy("luvmi_x"))
    evaluator = Evaluator(env, lambda trained, s, key: jnp.where(trained, policy.act(s.obs), straight(s, key)), 16)
    for params in (env.params, unseen_params(env, {"ranges": "unseen"})):
        for trained in (False, True):
            assert evaluator(params, jnp.array(trained), 0).success >= 0.8, trained


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"terrain": 5}, "terrain: spec = 5 is no terrain; give a name, a path"),
        ({"terrain": ["flat"]}, r"terrain: spec = \['flat'\] is no terrain"),
        ({"rover": 5}, "5: no folder of that path or name holds rover.toml"),
        ({"task": 5}, "task = 5 does not exist; use one of paper, consistent"),
        ({"model": 5}, "model = 5 is no model; give a Model"),
    ],
)
def test_what_is_of_no_kind_is_refused(changes, said):
    with pytest.raises(UserError, match=said):
        make_navigation(**{"terrain": "flat", **changes})


def test_episodes_are_long_enough_for_what_the_bus_voltage_allows():
    """A shipped task's time is for 1 m/s; 48 V allow LUVMI-X 48/(71.6e-3 * 243) rad/s at 0.1 m. A given time stays."""
    speed = 48.0 / (71.6e-3 * 243.0) * 0.1
    for preset, longer in (("field", 1.0 / speed), ("consistent", 1.0)):
        near = {"terrain": "flat", "preset": preset, "places": 16, "goal_distance": (4.0, 5.0)}
        assert make_navigation("large", **near).config.episode_time == pytest.approx(120.0 * longer, rel=1e-6)
        assert make_navigation("large", **near, episode_time=25.0).config.episode_time == 25.0
    assert reachable_speed(make_model("luvmi_x", "flat")) == np.inf
    slow = make_model("luvmi_x", "flat", "field").set("voltage_saturation", limit=256.0)
    assert reachable_speed(slow) == pytest.approx(0.5 * speed, rel=1e-6), "24 V"


@pytest.mark.parametrize("rover", ["luvmi_x", "viper"])
def test_shipped_policies_fit_their_task_and_hold_what_they_scored(rover):
    path = shipped_policy(rover)
    policy = load_policy(path)
    assert path.stat().st_size < 2_000_000 and policy.environment["options"] == {
        "task": "large",
        "rover": rover,
        "preset": "consistent",
    }
    env = make_navigation("large", rover, terrain="flat", places=64, goal_distance=(4.0, 5.0))
    assert policy.network["obs"] == env.observation_size and policy.network["actions"] == env.action_size
    assert policy.notes["train_score"]["success"] > 0.95
    action = policy.act(jnp.asarray(policy.mean)[None])
    assert action.shape == (1, 6) and (abs(action) <= 1.0).all()


def test_a_policy_of_another_training_ships_by_its_name():
    policy = load_policy(shipped_policy("luvmi_x/ladder-3"))
    trained, options = get_training("ladder-3"), policy.environment["options"]
    assert tuple(options["observations"]) == tuple(trained.options["observations"]) and options["task"] == "ladder/3"
    assert policy.environment["unseen"] == dict(trained.unseen) and policy.notes["score"]["success"] > 0.9
    action = policy.act(jnp.asarray(policy.mean)[None])
    assert action.shape == (1, 6) and (abs(action) <= 1.0).all()
    assert shipped_policy("viper/ladder-3") is None and shipped_policy("luvmi_x/policy") == shipped_policy("luvmi_x")
    assert "luvmi_x/ladder-3" in shipped_policies() and None not in map(shipped_policy, shipped_policies())


def test_the_height_scan_misses_no_rock():
    """Wherever the smallest rock lies among the near places of the scan, some place shows it."""
    radius = 0.125
    ahead, aside = np.meshgrid(VIEW.scan_ahead, VIEW.scan_aside, indexing="ij")
    for at in np.random.default_rng(0).uniform([-1.0, -0.75], [1.6, 0.75], (20, 2)):
        rocks = build_rocks(np.array([[*at, 0.0]]), np.array([radius]), (-4.0, -4.0, 4.0, 4.0))
        ground = load_terrain("flat")
        ground = dataclasses.replace(ground, rocks=rocks)
        seen = np.asarray(
            surface(ground, jnp.asarray(ahead, jnp.float32), jnp.asarray(aside, jnp.float32), VIEW.scan_reach)
        )
        assert seen.max() > 0.02, at
        bare = np.hypot(ahead - at[0], aside - at[1]) - radius
        assert (seen[bare > VIEW.scan_reach] == 0.0).all() and (seen[bare < 0.0] > 0.0).all()


def test_worlds_share_one_shape_and_padding_adds_no_rock():
    train, unseen = world("train"), world("heldout")
    assert [a.shape for a in jax.tree.leaves(train)] == [a.shape for a in jax.tree.leaves(unseen)]
    raw = load_terrain(WORLDS["train"]).rocks
    assert (np.asarray(train.rocks.radii) > 0).sum() == (np.asarray(raw.radii) > 0).sum() > 1000


def test_it_never_pays_to_end_an_episode_early():
    """Sitting out an episode, shaken and leaning, costs less than failing; the worst way to the goal beats both."""
    c = TASKS["large"]
    two = np.zeros((1, 2), np.float32)
    idle = rewards.Transition(
        two + 30.0,
        two + 30.0,
        np.full(1, 0.2),
        np.full(1, 0.2),
        np.zeros(1),
        np.ones(1),
        np.zeros((1, 6)),
        np.zeros((1, 6)),
    )
    step = sum(w * float(rewards.TERMS[n](idle)[0]) for n, w in c.weights.items())
    whole = step * round(c.episode_time / (c.decimation * 0.002))
    assert c.failure < whole <= 0.0
    assert c.success + 20.0 * c.goal_distance[0] + whole > 0.0


def test_six_actions_drive_the_joints_that_the_paper_names():
    model = make_model("luvmi_x", "flat")
    rover = model.rover
    two, four = (action_map(model, "velocity", 0.5, four_wheel_steering=w) for w in (False, True))
    assert two.names[:2] == ("drive", "steer") and two.size == 6
    groups = dict(zip(rover.joints, (g.name for g in rover.groups for _ in g.joints), strict=True))
    turned = np.asarray(two.controls(np.array([[1.0, 0.0, 0, 0, 0, 0], [0.0, 1.0, 0, 0, 0, 0]], np.float32)))
    radius = rover.wheels[0].radius
    for i, joint in enumerate(rover.joints):
        if groups[joint] == "drive":
            assert turned[0, i] == pytest.approx(0.5 / radius) and turned[1, i] == 0
        elif groups[joint] == "steer":
            front = next(w for w in rover.wheels if w.steer == joint).corner in ("lf", "rf")
            assert turned[0, i] == 0 and (turned[1, i] > 0) == front
            assert (four.scale[i] > 0) == front and abs(four.scale[i]) > 0
        else:
            assert (turned[:, i] == 0).all()
    assert action_map(model, "joint_torque", 0.5).size == len(rover.joints) == 12
    for mode in ACTION_MODES:
        asked = action_map(model, mode, 0.5)
        action = np.zeros((3, asked.size), np.float32)
        # ahead, backwards, and the steering alone
        action[0, asked.source[:4]], action[1, asked.source[:4]] = 0.3, -1.0
        action[2, asked.source[rover.joints.index("lf_steer")]] = 1.0
        assert np.asarray(asked.ahead(action)).tolist() == [1.0, -1.0, 0.0], mode
    with pytest.raises(UserError, match="does not exist"):
        action_map(model, "thoughts", 0.5)


def test_places_lie_within_bounds_clear_of_rocks_and_as_far_apart_as_asked():
    ground = load_terrain(
        {
            "seed": 3,
            "surface": {"width": 30.0, "height": 30.0, "cell": 0.2},
            "rocks": {"abundance": 0.05, "smallest": 0.4, "largest": 1.0, "gap": 0.5},
        }
    )
    starts, goals = draw_places(ground, 300, (3.0, 6.0), 1, clearance=0.4, margin=2.0)
    apart = np.hypot(*(goals - starts).T)
    assert apart.min() >= 3.0 - 1e-5 and apart.max() <= 6.0 + 1e-5
    rocks, radii = np.asarray(ground.rocks.centers), np.asarray(ground.rocks.radii)
    real = radii > 0
    for points in (starts, goals):
        gap = np.hypot(*(points[:, None] - rocks[real, :2]).transpose(2, 0, 1)) - radii[real]
        assert gap.min() > 0.4 - 1e-5 and np.abs(points).max() <= 13.0
    with pytest.raises(UserError, match="too few places"):
        draw_places(ground, 10, (40.0, 50.0), 1, clearance=0.4)


def test_held_out_soil_is_outside_all_of_training():
    trained = {r.parameter: r for r in SOIL_RANGES}
    for r in UNSEEN_SOIL:
        inside = trained[r.parameter]
        assert r.high <= inside.low or r.low >= inside.high, r.parameter
    check_ranges(make_model("luvmi_x", "flat"), UNSEEN_SOIL)


def test_tasks_and_mistakes():
    assert TASKS["paper"].weights == rewards.PAPER_WEIGHTS and TASKS["large"].goal_distance == (10.0, 40.0)
    for settings, said in (
        ({"task": "easy"}, "paper, consistent, large"),
        ({"decimation": 0}, "decimation"),
        ({"speed": 3}, "is no setting"),
        ({"observations": ("smell",)}, "is no observation"),
        ({"goal_distance": (0.1, 5.0)}, "goal_radius"),
        ({"weights": {"joy": 1.0}}, "reward term"),
        ({"randomise": (Range("soil.joy", 1, 2),)}, "no parameter"),
    ):
        with pytest.raises(UserError, match=said):
            make_navigation(**{"terrain": "flat", **settings})
