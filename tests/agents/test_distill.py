"""Distillation: the student comes to act as a teacher that sees what it does not, and to read it from a picture."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.configs import get_training, learner_name, override
from lunar_mjx.agents.evaluate import evaluate
from lunar_mjx.agents.export.graphs import to_onnx
from lunar_mjx.agents.from_teacher.distill import Distill, DistillConfig, Lesson, check_teacher, open_teacher
from lunar_mjx.agents.learner import Learner, TrainConfig
from lunar_mjx.agents.networks import make_actor
from lunar_mjx.agents.play import open_agent
from lunar_mjx.agents.policy import Policy, load_policy, save_policy
from lunar_mjx.agents.train import RunConfig, train
from lunar_mjx.envs import PointEnv, make_agent, make_navigation, split_keys
from lunar_mjx.errors import UserError

pytestmark = pytest.mark.slow

ROWS, COLUMNS = 12, 12
SPREAD = 0.3
"""Width of the spot that shows the goal, m."""


class SeeingPoint(PointEnv):
    """The point sees where it is, and the goal as a spot in a picture of the square about itself."""

    observation_size = 2 + ROWS * COLUMNS
    picture = (2, ROWS, COLUMNS, 1)

    def _observe(self, inner):
        ahead = inner.goal - inner.position
        x, y = jnp.linspace(-2.5, 2.5, COLUMNS), jnp.linspace(2.5, -2.5, ROWS)
        away = (x - ahead[:, :1])[:, None, :] ** 2 + (y - ahead[:, 1:])[:, :, None] ** 2
        spot = jnp.exp(-away / (2 * SPREAD**2)).reshape(len(ahead), -1)
        return jnp.concatenate([inner.position, spot], axis=-1), ahead


@pytest.fixture(scope="module")
def teacher(tmp_path_factory) -> str:
    """A policy of one layer that drives for the goal which it is told: tanh(3 times the way there)."""
    network = {"obs": 2, "actions": 2, "layers": [], "activation": "relu", "layer_norm": False}
    params = {"params": {"hidden_0": {"kernel": 3.0 * jnp.eye(2), "bias": jnp.zeros(2)}}}
    policy = Policy(params, None, None, network, {"name": "point", "options": {}}, {})
    return str(save_policy(policy, tmp_path_factory.mktemp("teacher") / "teacher.npz"))


def config(teacher: str, **settings) -> TrainConfig:
    algorithm = DistillConfig(teacher, (32,), filters=(8, 8), rate=3e-3, tau=0.05, teacher_steps=40, **settings)
    return TrainConfig(algorithm, envs=64, normalise=True, epoch_steps=40, episodes=False)


def test_the_student_reads_from_a_picture_what_the_teacher_is_told(teacher, tmp_path):
    env = SeeingPoint()
    result = train(Learner(env, config(teacher)), RunConfig(64 * 400, quiet=True), None)
    losses = [row["imitation_loss"] for row in result.rows]
    assert losses[-1] < 0.1 * losses[0]
    # the file holds all that acting needs
    policy = load_policy(save_policy(result.policy, tmp_path / "policy.npz"))
    assert policy.network["picture"] == [2, ROWS, COLUMNS, 1] and policy.network["filters"] == [8, 8]
    state = env.reset(env.params, split_keys(jax.random.PRNGKey(5), 256))
    taught = load_policy(teacher).act(state.privileged)
    apart = np.asarray(policy.act(state.obs) - taught)
    assert np.sqrt(np.mean(apart**2)) < 0.2 < np.sqrt(np.mean(np.asarray(taught) ** 2))
    with pytest.raises(UserError, match="no graph in ONNX yet; give --only stablehlo"):
        to_onnx(policy)
    drives = evaluate(env, lambda state, key: policy.act(state.obs), 128, seed=9)
    blind = evaluate(env, lambda state, key: policy.act(state.obs.at[:, 2:].set(policy.mean[2:])), 128, seed=9)
    assert drives.low > 0.8 > 0.5 > blind.high


@pytest.mark.parametrize("picture", [[2, 3, 3, 1], [0, 2, 2, 0], [1, 2, 2], "all"])
def test_a_file_whose_picture_lies_beyond_its_observations_is_refused(picture, teacher, tmp_path):
    good = load_policy(teacher)
    network = {**good.network, "obs": 10, "picture": picture, "filters": [2]}
    path = save_policy(dataclasses.replace(good, network=network), tmp_path / "bad.npz")
    with pytest.raises(UserError, match="picture"):
        load_policy(path)


def test_the_teacher_hands_over_environment_by_environment(teacher):
    env = SeeingPoint()
    agent = Distill(DistillConfig(teacher, (4,), filters=(2,), teacher_steps=10), env)
    state = env.reset(env.params, split_keys(jax.random.PRNGKey(0), 8))
    student, drive = jax.jit(agent.init)(jax.random.PRNGKey(1)), jax.jit(agent.drive)
    own, taught = agent.act(student.actor, state.obs), agent.teacher.act(state.privileged)
    for steps, by_teacher in ((0, 8), (5, 4), (9, 1), (10, 0), (1000, 0)):
        action, lesson = drive(student, state.obs, state.privileged, jnp.asarray(steps))
        assert (action[:by_teacher] == taught[:by_teacher]).all() and (action[by_teacher:] == own[by_teacher:]).all()
        assert (lesson.action == taught).all() and (lesson.obs == state.obs).all()
    alone = Distill(dataclasses.replace(agent.config, teacher_steps=0), env)
    assert (alone.drive(student, state.obs, state.privileged, jnp.asarray(0))[0] == own).all()


def test_every_lesson_counts_once_in_a_pass(teacher):
    """With one minibatch the update is one step along the gradient of the mean over all lessons."""
    agent = Distill(DistillConfig(teacher, (4,), filters=(2,), minibatches=1, tau=0.25), SeeingPoint())
    state, key = jax.jit(agent.init)(jax.random.PRNGKey(0)), jax.random.PRNGKey(1)
    lessons = Lesson(jax.random.normal(key, (6, 3, 2 + ROWS * COLUMNS)), jax.random.uniform(key, (6, 3, 2)))
    after, losses = jax.jit(agent.update)(state, lessons, key)
    loss, gradient = jax.jit(jax.value_and_grad(agent.loss))(state.actor, lessons)
    assert float(losses["imitation_loss"]) == pytest.approx(float(loss), rel=1e-5)
    change, _ = jax.jit(agent.optimiser.update)(gradient, state.optimiser)
    for a, b, c in zip(*(jax.tree.leaves(t) for t in (after.actor, state.actor, change)), strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b + c), abs=1e-6)
    # the policy that is kept follows by its share
    for a, b, c in zip(*(jax.tree.leaves(t) for t in (agent.policy(after), state.actor, change)), strict=True):
        assert np.asarray(a) == pytest.approx(np.asarray(b + 0.25 * c), abs=1e-6)


def test_convolutions_see_the_picture_alone_and_pass_the_other_numbers_on():
    actor = make_actor(3 + 4 * 6 + 2, 2, (8,), picture=(3, 4, 6, 1), filters=(5, 7))
    params, apply = jax.jit(actor.init)(jax.random.PRNGKey(0)), jax.jit(actor.apply)
    # two halvings of 4 x 6 leave 1 x 2 places of 7 features beside the 5 other numbers
    assert params["params"]["hidden_0"]["kernel"].shape == (5 + 1 * 2 * 7, 8)
    seen = jax.random.normal(jax.random.PRNGKey(1), (9, 29))
    slope = np.asarray(jax.jit(jax.jacobian(lambda x: actor.apply(params, x)))(seen[0]))
    assert slope.shape == (2, 29) and (np.abs(slope) > 0).any(axis=0).all()
    # leading axes do not matter
    assert np.asarray(apply(params, seen.reshape(3, 3, 29))).reshape(9, 2) == pytest.approx(
        np.asarray(apply(params, seen)), abs=1e-6
    )


SMALL = {
    "terrain": "flat",
    "places": 8,
    "goal_distance": (2.0, 4.0),
    "camera_width": 16,
    "camera_height": 12,
    "randomise": (),
}


@pytest.fixture(scope="module")
def rovers():
    options = {**get_training("large-depth").options, **SMALL}
    env = make_navigation(**options)
    return options, env, jax.jit(env.reset)


def test_a_rover_learns_from_the_shipped_policy_and_its_file_brings_the_camera(rovers, tmp_path):
    options, env, reset = rovers
    assert env.picture == (env.blocks["camera/depth"].start, 12, 16, 1)
    assert env.observation_size == env.blocks["camera/depth"].start + 12 * 16
    algorithm = DistillConfig("luvmi_x", (16,), filters=(4, 4), unroll=2, minibatches=2)
    learner = Learner(env, TrainConfig(algorithm, envs=4, normalise=True, epoch_steps=4, episodes=False))
    environment = {"name": "navigation", "options": {**options, "randomise": ()}}
    result = train(learner, RunConfig(32, quiet=True), None, environment)
    assert all(0.0 < row["imitation_loss"] < 2.0 for row in result.rows)
    path = save_policy(result.policy, tmp_path / "policy.npz")
    made, agent, _ = open_agent(str(path))
    assert made.blocks == env.blocks and "height_scan" not in made.blocks
    with pytest.raises(UserError, match=r"network\.picture"):
        open_agent(str(path), options={"camera_width": 12, "camera_height": 16})
    state = reset(env.params, split_keys(jax.random.PRNGKey(3), 2))
    assert np.asarray(agent(state, None)) == pytest.approx(np.asarray(result.policy.act(state.obs)), abs=1e-6)


def test_the_privileged_numbers_are_what_the_teacher_was_trained_on(rovers):
    _, env, reset = rovers
    seeing = make_navigation("large", preset="consistent", **{**SMALL, "privileged": ()})
    keys = split_keys(jax.random.PRNGKey(1), 2)
    assert (reset(env.params, keys).privileged == jax.jit(seeing.reset)(seeing.params, keys).obs).all()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rover": "viper"}, ("rover = 'luvmi_x'", "viper")),
        ({"action": "paper"}, ("action = 'velocity'", "'paper'")),
        ({"four_wheel_steering": False}, ("four_wheel_steering = True", "False")),
        ({"decimation": 25}, ("decimation = 50", "25")),
        ({"privileged": ("goal_body", "up")}, ("privileged", "is not what the teacher sees", "'height_scan'")),
    ],
)
def test_a_teacher_that_does_not_fit_is_refused(changes, words):
    options = {**get_training("large-depth").options, **SMALL, "observations": ("goal_body",), **changes}
    with pytest.raises(UserError) as refused:
        Learner(make_navigation(**options), get_training("large-depth").train)
    assert all(word in str(refused.value) for word in words), refused.value


def test_other_mistakes_with_teachers_are_refused(teacher):
    for name in ("", "nobody", "husky"):
        with pytest.raises(UserError, match=r"is no policy; give a policy\.npz"):
            Learner(SeeingPoint(), config(name))
    with pytest.raises(UserError, match=r"actions = \d+ are not the environment's 2"):
        Learner(SeeingPoint(), config("luvmi_x"))
    with pytest.raises(UserError, match="epoch_steps = 40 is no multiple of unroll = 7"):
        Learner(SeeingPoint(), config(teacher, unroll=7))


@pytest.mark.parametrize("name", ["large-depth", "ladder-3-depth"])
def test_shipped_trainings_see_what_their_teachers_see_but_the_scan(name):
    training = get_training(name)
    assert learner_name(training) == "distill"
    seen, taught = set(training.options["observations"]), set(training.options["privileged"])
    assert seen ^ taught == {"camera/depth", "height_scan"} and "camera/depth" in seen


def test_a_point_that_heads_for_the_goal_is_what_scripted_agents_do(teacher):
    """The teacher of these tests is no straw man."""
    env, policy = PointEnv(), load_policy(teacher)
    score = evaluate(env, lambda state, key: policy.act(state.privileged), 128, seed=3)
    assert score.low > 0.9 and make_agent("scripted", env) is not None


@pytest.mark.parametrize("line", ["filters = [1.5]", 'actor_layers = ["64"]', "filters = [true]"])
def test_a_file_with_widths_that_are_no_whole_numbers_is_refused(tmp_path, line):
    path = tmp_path / "mine.toml"
    path.write_text(f'environment = "point"\nsteps = 64\n[train]\nenvs = 4\n[distill]\nteacher = "luvmi_x"\n{line}\n')
    with pytest.raises(UserError, match=f"distill.{line.split()[0]} = .* is not like"):
        get_training(str(path))


def test_a_list_that_the_file_leaves_empty_is_set_by_its_kind(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(
        'environment = "point"\nsteps = 64\n[train]\nenvs = 4\n[distill]\nteacher = "luvmi_x"\nfilters = []\n'
    )
    training = get_training(str(path))
    assert training.train.algorithm.filters == ()
    assert override(training, filters="16,8").train.algorithm.filters == (16, 8)
    with pytest.raises(UserError, match="filters = '16,wide' is not like"):
        override(training, filters="16,wide")


def test_a_teacher_whose_file_names_no_task_is_refused(rovers):
    policy = open_teacher("luvmi_x")
    environment = {**policy.environment, "options": {**policy.environment["options"], "task": ["large"]}}
    nameless = dataclasses.replace(policy, environment=environment)
    with pytest.raises(UserError, match=r"distill: teacher luvmi_x: the policy's task = \['large'\] does not exist"):
        check_teacher("luvmi_x", nameless, rovers[1])
