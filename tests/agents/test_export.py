"""An exported policy: graphs that act as the policy does, a contract that names every number, a node that keeps it."""

from __future__ import annotations

import ast
import importlib
import json
import math
import sys
import time
import types
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.agents.export import graphs, ros2_node
from lunar_mjx.agents.export.contract import Contract, contract_of
from lunar_mjx.agents.export.write import export_policy
from lunar_mjx.agents.networks import ACTIVATIONS, make_actor
from lunar_mjx.agents.policy import Policy, save_policy
from lunar_mjx.envs import make_navigation
from lunar_mjx.envs.navigation import kalman
from lunar_mjx.envs.navigation.labels import labels
from lunar_mjx.envs.navigation.observations import Scene, observe
from lunar_mjx.envs.navigation.view import View

SMALL = {"task": "large", "terrain": "flat", "places": 16, "decimation": 5}
PARITY = 1e-5


def make_policy(obs: int, actions: int, environment: dict[str, Any], normalise: bool = True, **network: Any) -> Policy:
    about = {"obs": obs, "actions": actions, "layers": [32, 16], "activation": "relu", "layer_norm": True, **network}
    rng = np.random.default_rng(0)
    mean, deviation = rng.normal(size=obs).astype(np.float32), rng.uniform(0.1, 3.0, obs).astype(np.float32)
    params = make_actor(**about).init(jax.random.PRNGKey(0))
    # at the start norms and biases are 1 and 0, and a graph that left them out would do as well
    params = jax.tree.map(lambda a: a + 0.1 * jnp.cos(jnp.arange(a.size, dtype=a.dtype)).reshape(a.shape), params)
    return Policy(params, mean if normalise else None, deviation if normalise else None, about, environment, {})


@pytest.fixture(scope="module")
def env():
    return make_navigation(**SMALL)


@pytest.fixture(scope="module")
def policy(env):
    options = {"name": "navigation", "options": SMALL}
    return make_policy(env.observation_size, env.action_size, options)


@pytest.fixture(scope="module")
def exported(policy, tmp_path_factory):
    """The folder without the ONNX graph, which needs a package more."""
    pytest.importorskip("flatbuffers", reason="needs the extra export")
    folder = tmp_path_factory.mktemp("export")
    export_policy(save_policy(policy, folder / "policy.npz"), folder, ["stablehlo"])
    return folder


def observations(policy: Policy, count: int = 64) -> np.ndarray:
    # some far beyond ten deviations, where normalising cuts
    return np.random.default_rng(1).normal(0.0, 6.0, (count, policy.network["obs"])).astype(np.float32)


@pytest.mark.parametrize("layer_norm", [True, False])
@pytest.mark.parametrize("activation", sorted(ACTIVATIONS))
def test_onnx_acts_as_the_policy(activation, layer_norm):
    pytest.importorskip("onnx", reason="needs the extra export")
    runtime = pytest.importorskip("onnxruntime", reason="needs the extra export")
    policy = make_policy(12, 3, {}, normalise=layer_norm, activation=activation, layer_norm=layer_norm)
    session = runtime.InferenceSession(graphs.to_onnx(policy), providers=["CPUExecutionProvider"])
    obs = observations(policy)
    (action,) = session.run(None, {"obs": obs})
    assert np.abs(action - np.asarray(policy.act(obs))).max() <= PARITY
    assert np.ptp(action) > 0.1


def test_stablehlo_acts_as_the_policy(policy, exported):
    read = jax.export.deserialize(bytearray((exported / "policy.stablehlo").read_bytes()))
    assert set(read.platforms) == {"cpu", "cuda"}
    for count in (1, 64):
        obs = observations(policy, count)
        assert np.abs(np.asarray(read.call(obs)) - np.asarray(policy.act(obs))).max() <= PARITY


def test_the_contract_names_every_number(env, policy, exported):
    contract = Contract.model_validate_json((exported / "contract.json").read_text())
    place = 0
    for block in contract.observations:
        assert block.start == place and len(block.names) == len(block.units) == len(set(block.names))
        assert all(block.names) and all(block.units) and block.about.endswith(".")
        place += len(block.names)
    assert place == policy.network["obs"] == len(contract.normalisation.mean)
    assert contract.rate_hz == pytest.approx(1.0 / (5 * env.model.timestep))
    assert [a.name for a in contract.actions] == list(env.actions.names)
    action = np.linspace(-1.0, 1.0, env.action_size, dtype=np.float32)
    targets = [j.scale * action[j.action] for j in contract.joints]
    assert targets == pytest.approx(np.asarray(env.actions.controls(action[None]))[0], rel=1e-6)
    assert [j.name for j in contract.joints] == list(env.model.rover.joints)
    assert {(j.mode, j.unit) for j in contract.joints} == {("velocity", "rad/s"), ("position", "rad")}
    assert set(contract.sha256) == {"policy.npz", "policy.stablehlo"}


SEEING = {
    **SMALL,
    "observations": ("up", "camera/rgb", "camera/depth", "camera/labels"),
    "camera_width": 4,
    "camera_height": 3,
    "camera_far": 12.5,
}


def test_the_contract_tells_the_shape_and_scale_of_pictures():
    env = make_navigation(**SEEING)
    policy = make_policy(env.observation_size, env.action_size, {"name": "navigation", "options": SEEING})
    up, rgb, depth, kinds = contract_of(policy, env, "policy.npz", {}).observations
    assert up.picture is None
    for block, colours in ((rgb, 3), (depth, 1), (kinds, 1)):
        assert (block.picture.rows, block.picture.columns, block.picture.colours) == (3, 4, colours)
        assert (block.picture.far_m, block.picture.fovy_deg) == (12.5, env.config.camera_fovy_deg)
        assert len(set(block.names)) == 12 * colours
    # A pixel's number times its unit is metres.
    assert set(depth.units) == {"12.5 m"} and depth.names[4 + 2] == "row 1, column 2"
    assert rgb.names[3 * (2 * 4 + 3) + 1] == "row 2, column 3, green" and set(rgb.units + kinds.units) == {"1"}


@pytest.mark.parametrize(
    "options", [{"task": "paper", "terrain": "flat", "rover": "viper", "places": 16}, SMALL, SEEING]
)
def test_every_block_has_as_many_labels_as_numbers(options):
    env = make_navigation(**options)
    told = labels(env)
    assert [len(v) for v in told.values()] == [part.stop - part.start for part in env.blocks.values()]
    assert list(told) == list(env.config.observations)


@pytest.fixture
def drive(env):
    """A made-up drive of one rover: a view of every control step, and the rovers' joints and goal."""
    rng = np.random.default_rng(3)
    count, dt = 40, env.control_interval
    qpos = np.zeros((count, env.system.engine.mj_model.nq))
    qvel = np.zeros((count, env.system.engine.mj_model.nv))
    turn = rng.normal(0.0, 0.2, (count, 3)).cumsum(0)
    qpos[:, :3] = rng.normal(0.0, 0.05, (count, 3)).cumsum(0) + np.array([4.0, -2.0, 0.3])
    half = np.linalg.norm(turn, axis=1, keepdims=True) / 2
    qpos[:, 3:7] = np.hstack([np.cos(half), np.sin(half) * turn / np.maximum(2 * half, 1e-9)])
    qpos[:, 7:] = rng.normal(0.0, 2.0, qpos[:, 7:].shape)
    qvel[:] = rng.normal(0.0, 0.5, qvel.shape)
    # it stands for a while
    qpos[20:30, :2] = qpos[20, :2]
    goal, arrival = np.array([9.0, 1.5]), 0.7
    views, filtered, anchor, waited = [], None, qpos[0, :2], 0.0
    gains = jnp.asarray(env.params.gains)
    for k in range(count):
        warm = SimpleNamespace(winding_kelvin=jnp.full((1, 1), 300.0))
        physics = SimpleNamespace(
            qpos=jnp.asarray(qpos[k : k + 1]), qvel=jnp.asarray(qvel[k : k + 1]), temperature=warm
        )
        position, velocity = physics.qpos[:, :3], physics.qvel[:, :3]
        if filtered is None:
            filtered = kalman.start(position, velocity)
        else:
            filtered = kalman.update(gains, dt, filtered, position, velocity)
            away = np.linalg.norm(qpos[k, :2] - anchor) > env.config.stuck_distance
            anchor, waited = (qpos[k, :2], 0.0) if away else (anchor, waited + dt)
        views.append(
            View(
                **env._reader.pose(physics),
                slip=jnp.zeros((1, 4)),
                sinkage=jnp.zeros((1, 4)),
                origin=jnp.asarray(qpos[:1, :3]),
                goal=jnp.asarray(goal)[None],
                filtered=filtered,
                last_action=jnp.zeros((1, env.action_size)),
                waited=jnp.asarray([waited]),
                arrival=jnp.asarray([arrival]),
            )
        )
    return views, goal, arrival


def odometry(view: View) -> Any:
    """The messages that a rover in this state would send: Odometry."""

    def xyz(a: Any) -> Any:
        return SimpleNamespace(**dict(zip("xyz", map(float, a[0]), strict=True)))

    w, x, y, z = map(float, view.qpos[0, 3:7])
    turn = SimpleNamespace(x=x, y=y, z=z, w=w)
    pose = SimpleNamespace(position=xyz(view.position), orientation=turn)
    twist = SimpleNamespace(linear=xyz(view.body_velocity), angular=xyz(view.body_rates))
    return SimpleNamespace(pose=SimpleNamespace(pose=pose), twist=SimpleNamespace(twist=twist))


def joint_states(env: Any, view: View) -> Any:
    """JointState with the joints in another order, and one that the policy does not know."""
    order = list(reversed(range(len(env.system.joint_names))))
    return SimpleNamespace(
        name=["mast", *(env.system.joint_names[i] for i in order)],
        position=[0.0, *(float(view.joint_angle[0, i]) for i in order)],
        velocity=[0.0, *(float(view.joint_speed[0, i]) for i in order)],
    )


def goal_pose(goal: Any, yaw: float) -> Any:
    turn = SimpleNamespace(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    place = SimpleNamespace(x=float(goal[0]), y=float(goal[1]), z=0.0)
    return SimpleNamespace(pose=SimpleNamespace(position=place, orientation=turn))


def told_by_messages() -> list[str]:
    return [name.removeprefix("block_") for name in dir(ros2_node.Driver) if name.startswith("block_")]


def test_the_node_observes_as_the_environment(env, exported, drive):
    views, goal, arrival = drive
    contract = json.loads((exported / "contract.json").read_text())
    driver = ros2_node.Driver(SimpleNamespace(contract=contract), 0.5)
    names = told_by_messages()
    assert len(names) == 14
    driver.take("goal", goal_pose(goal, arrival), 0.0)
    for k, view in enumerate(views):
        driver.take("odom", odometry(view), 0.1 * k)
        driver.take("joint_states", joint_states(env, view), 0.1 * k)
        driver.look()
        for name in names:
            wanted = np.asarray(observe((name,), view, Scene(None, {})))[0]
            found = np.asarray(getattr(driver, f"block_{name}")(), float)
            scale = max(1.0, float(np.abs(wanted).max()))
            assert np.abs(found - wanted).max() <= 3e-5 * scale, (name, k)
    assert driver.waited > 0.0


class FakePolicy:
    """Answers with what it was asked, so that a test sees it."""

    def __init__(self, contract: Any, answer: float = 0.5):
        self.contract, self.answer, self.asked = contract, answer, []

    def act(self, obs: Any) -> Any:
        self.asked.append(obs)
        return np.full(len(self.contract["actions"]), self.answer)


def test_the_node_stands_where_an_input_is_missing_stale_or_the_goal_is_reached(env, exported, drive):
    views, goal, arrival = drive
    contract = json.loads((exported / "contract.json").read_text())
    policy = FakePolicy(contract)
    driver = ros2_node.Driver(policy, 0.5)
    # the acceleration is the node's own; what no standard message carries is asked for by its block's name
    assert driver.foreign == ["slip", "height_scan"]

    def feed(now: float, goal: Any) -> None:
        driver.take("odom", odometry(views[0]), now)
        driver.take("joint_states", joint_states(env, views[0]), now)
        for name in driver.foreign:
            driver.take(name, SimpleNamespace(data=[0.25] * driver.blocks[name]), now)

    def driven(now: float) -> bool:
        targets = driver.tick(now)
        values = [v for group in targets.values() for v in group.values()]
        assert len(values) == len(contract["joints"]) and np.isfinite(values).all()
        return any(values)

    assert not driven(0.0) and not policy.asked
    driver.take("goal", goal_pose(goal, arrival), 0.0)
    feed(1.0, goal)
    assert driven(1.2) and len(policy.asked[0]) == sum(driver.blocks.values())
    assert policy.asked[0][-1] == 0.25
    assert not driven(1.6) and driver.stale(1.6) == ["odom", "joint_states", *driver.foreign]
    feed(2.0, goal)
    assert driven(2.0)
    policy.answer = float("nan")
    assert not driven(2.1)
    policy.answer = 0.5
    driver.take("goal", goal_pose(np.asarray(views[0].position[0, :2]) + 0.1, arrival), 2.1)
    assert not driven(2.2) and driver.arrived
    driver.take("goal", goal_pose(goal, arrival), 2.2)
    assert driven(2.3), "a new goal begins a new drive"
    with pytest.raises(ros2_node.ContractError, match=r"blocks/slip: has 3 numbers, not 4\."):
        driver.take("slip", SimpleNamespace(data=[0.0] * 3), 2.3)
    with pytest.raises(ros2_node.ContractError, match="joint_states: lacks"):
        driver.take("joint_states", SimpleNamespace(name=[], position=[], velocity=[]), 2.3)
        driver.tick(2.3)


class FakeNode:
    """What the script asks of a ROS 2 node."""

    def __init__(self, parameters: dict[str, Any]):
        self.parameters, self.heard, self.sent, self.timers = parameters, {}, [], []

    def declare_parameter(self, name: str, default: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, default))

    def create_subscription(self, kind: Any, topic: str, callback: Any, depth: int) -> None:
        self.heard[topic] = callback

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        assert topic == "joint_commands"
        return SimpleNamespace(publish=self.sent.append)

    def create_timer(self, interval: float, callback: Any) -> None:
        self.timers.append((interval, callback))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.monotonic_ns()))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=lambda text: None)

    def destroy_node(self) -> None:
        self.heard.clear()


def test_the_script_runs_against_a_fake_ros(env, exported, drive, monkeypatch):
    views, goal, arrival = drive
    contract = json.loads((exported / "contract.json").read_text())
    node = FakeNode({"folder": str(exported), "timeout_s": 60.0})
    monkeypatch.setattr(ros2_node, "Policy", lambda folder: FakePolicy(contract))

    def spin(node: FakeNode) -> None:
        ((interval, tick),) = node.timers
        assert interval == contract["control_interval_s"]
        tick()
        node.heard["goal"](goal_pose(goal, arrival))
        node.heard["odom"](odometry(views[0]))
        node.heard["joint_states"](joint_states(env, views[0]))
        for block in ("slip", "height_scan"):
            width = next(len(b["names"]) for b in contract["observations"] if b["name"] == block)
            node.heard[f"blocks/{block}"](SimpleNamespace(data=[0.0] * width))
        tick()

    rclpy = types.ModuleType("rclpy")
    rclpy.__dict__.update(init=lambda args: None, create_node=lambda name: node, spin=spin, try_shutdown=lambda: None)
    monkeypatch.setitem(sys.modules, "rclpy", rclpy)
    for name, kinds in (
        ("nav_msgs", ["Odometry"]),
        ("sensor_msgs", ["JointState"]),
        ("geometry_msgs", ["PoseStamped"]),
        ("std_msgs", ["Float32MultiArray"]),
    ):
        module = types.ModuleType(f"{name}.msg")
        module.__dict__.update(dict.fromkeys(kinds, SimpleNamespace))
        monkeypatch.setitem(sys.modules, f"{name}.msg", module)
    ros2_node.main()
    standing, driving = node.sent
    assert standing.name == driving.name and set(standing.name) == set(env.model.rover.joints)
    for joint, position, velocity in zip(driving.name, driving.position, driving.velocity, strict=True):
        told = next(j for j in contract["joints"] if j["name"] == joint)
        value = velocity if told["mode"] == "velocity" else position
        assert value == pytest.approx(0.5 * told["scale"]) and math.isnan(velocity) != math.isnan(position)


def test_the_node_stands_alone():
    """Only the standard library and NumPy are imported; the rest by name, when it is needed."""
    tree = ast.parse(Path(str(ros2_node.__file__)).read_text(encoding="utf-8"))
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    names |= {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}
    assert names <= set(sys.stdlib_module_names) | {"numpy"}


def test_the_exported_folder_acts_by_one_session_on_one_core(policy, tmp_path, monkeypatch):
    """What makes an action cheap, told without a clock, whose time is the machine's."""
    pytest.importorskip("onnx", reason="needs the extra export")
    runtime = pytest.importorskip("onnxruntime", reason="needs the extra export")
    made, runs = [], []

    class Counted(runtime.InferenceSession):
        def __init__(self, content, options, **more):
            made.append((options.intra_op_num_threads, options.inter_op_num_threads))
            super().__init__(content, options, **more)

        def run(self, names, values):
            runs.append(values["obs"].shape)
            return super().run(names, values)

    monkeypatch.setattr(runtime, "InferenceSession", Counted)
    written = export_policy(save_policy(policy, tmp_path / "policy.npz"), tmp_path)
    assert [p.name for p in written] == ["policy.onnx", "policy.stablehlo", "contract.json", "ros2_node.py"]
    # the copy in the folder, not the package's module
    spec: Any = importlib.util.spec_from_file_location("exported_node", tmp_path / "ros2_node.py")
    node = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(node)
    taken = node.Policy(str(tmp_path))
    obs = observations(policy)
    for row, wanted in zip(obs, np.asarray(policy.act(obs)), strict=True):
        assert np.abs(taken.act(row) - wanted).max() <= PARITY
    assert made == [(1, 1)] and runs == [(1, policy.network["obs"])] * len(obs)
    (tmp_path / "policy.onnx").write_bytes(b"another")
    with pytest.raises(node.ContractError, match="is not the file that the contract was written for"):
        node.Policy(str(tmp_path))


def test_mistakes_are_one_sentence(run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    nameless = save_policy(make_policy(2, 1, {}), tmp_path / "nameless.npz")
    other = {"name": "navigation", "options": SMALL}
    narrow = save_policy(make_policy(3, 2, other), tmp_path / "narrow.npz")
    for line, said in (
        (("missing.npz",), "missing.npz"),
        (("clever",), "is no rover with a trained policy"),
        ((nameless, "--only", "torch"), "is no format; use onnx or stablehlo"),
        ((nameless,), "says of no environment what its observations are"),
        ((narrow, "--only", "stablehlo"), "as its environment has them now"),
    ):
        found = run("export", "policy", *line)
        assert found.status == 2 and said in found.err and "Traceback" not in found.err
        assert found.err.count("\n") == 1
    # importing None fails as a package does that is not installed
    monkeypatch.setitem(sys.modules, "onnx", None)
    point = save_policy(make_policy(4, 2, {"name": "point", "options": {}}), tmp_path / "point.npz")
    found = run("export", "policy", point)
    assert found.status == 2 and "pip install 'lunar-mjx[export]'" in found.err
    with monkeypatch.context() as without:
        for name in ("flatbuffers", "jax._src.export.serialization", "jax._src.export.serialization_generated"):
            without.setitem(sys.modules, name, None)
        found = run("export", "policy", point, "--only", "stablehlo")
    assert found.status == 2 and "flatbuffers" in found.err and found.err.count("\n") == 1
    pytest.importorskip("flatbuffers", reason="needs the extra export")
    found = run("export", "policy", point, "--only", "stablehlo", "-o", tmp_path / "out")
    assert found.status == 0 and (tmp_path / "out" / "contract.json").is_file()
    assert not (tmp_path / "out" / "ros2_node.py").exists()
