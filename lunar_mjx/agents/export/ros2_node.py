#!/usr/bin/env python3
"""Drives a rover with an exported policy, as a ROS 2 node; needs ROS 2's rclpy, NumPy and ONNX Runtime only.

    python3 ros2_node.py --ros-args -p folder:=exported -r odom:=/my_rover/odom

The folder holds `contract.json` and `policy.onnx`, as `lunar-mjx export policy` wrote them. The node acts at the
contract's rate as long as everything that the policy observes is fresh; else, and at the goal, it tells all motors to
stand.

Topics in (remap them as usual):
  odom            nav_msgs/Odometry: pose in a fixed frame with z up, twist along the chassis' axes (x ahead, y left)
  joint_states    sensor_msgs/JointState: angles and speeds of the contract's joints, by name
  goal            geometry_msgs/PoseStamped in the frame of the odometry; its heading is the one to arrive in
  blocks/<name>   std_msgs/Float32MultiArray: each block of observations that those three do not give, such as
                  height_scan or slip, in the contract's order and units
Topic out:
  joint_commands  sensor_msgs/JointState: a target for each joint in `position`, `velocity` or `effort`, by the mode in
                  the contract; not-a-number in the other two
Parameters: folder; timeout_s, the age beyond which an input is stale.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import math
import os
import sys
from typing import Any

import numpy as np

FIELD = {"position": "position", "velocity": "velocity", "torque": "effort"}
"""Field of a JointState that takes a target of this mode."""
TOLD = ("odom", "joint_states", "goal")


class ContractError(Exception):
    """The folder cannot be driven with; one sentence says why."""


class Policy:
    """The network and its contract.

    Args:
      folder: with both files.
    """

    def __init__(self, folder: str):
        with open(os.path.join(folder, "contract.json"), encoding="utf-8") as file:
            self.contract = json.load(file)
        path = os.path.join(folder, "policy.onnx")
        with open(path, "rb") as file:
            content = file.read()
        # Weights and meaning travel as two files: a mix of two exports would drive somehow.
        if hashlib.sha256(content).hexdigest() != self.contract["sha256"].get("policy.onnx"):
            raise ContractError(f"{path}: is not the file that the contract was written for; export the policy again.")
        wrong = [j["name"] for j in self.contract["joints"] if j["mode"] not in FIELD]
        if wrong:
            raise ContractError(f"joint {wrong[0]}: takes a current, which no JointState carries; train with torques.")
        # late: what reads the contract needs no runtime
        onnxruntime: Any = importlib.import_module("onnxruntime")
        options = onnxruntime.SessionOptions()
        # one core is the fastest for a network this small, and leaves the others alone
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])

    def act(self, obs: Any) -> Any:
        """Actions (action,) in [-1, 1] for observations (obs,)."""
        return self.session.run(None, {"obs": np.asarray(obs, np.float32)[None]})[0][0]


class Acceleration:
    """The contract's Kalman filter: acceleration in the fixed frame from position and velocity."""

    def __init__(self, contract: dict[str, Any]):
        self.gains = np.asarray(contract["filter"]["gains"])
        self.interval = contract["filter"]["interval_s"]
        self.state: Any = None
        self.count = 0

    def update(self, position: Any, velocity: Any) -> Any:
        """Takes a measurement, one every interval; returns the acceleration (3,)."""
        if self.state is None:
            self.state = np.stack([position, velocity, np.zeros(3)])
            return self.state[2]
        p, v, a = self.state
        t = self.interval
        p, v = p + t * (v + 0.5 * t * a), v + t * a
        # The last gain is the steady one.
        gain = self.gains[min(self.count, len(self.gains) - 1)]
        error = np.stack([position - p, velocity - v])
        self.state, self.count = np.stack([p, v, a]) + gain @ error, self.count + 1
        return self.state[2]


def rotation(x: float, y: float, z: float, w: float) -> Any:
    """Rotation matrix of a quaternion, body to fixed frame."""
    n = math.sqrt(x * x + y * y + z * z + w * w) or 1.0
    x, y, z, w = x / n, y / n, z / n, w / n
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def heading(matrix: Any) -> float:
    """Yaw of a rotation, rad."""
    return math.atan2(matrix[1, 0], matrix[0, 0])


def vector(v: Any) -> Any:
    """A message's vector as an array (3,)."""
    return np.array([v.x, v.y, v.z])


class Driver:
    """From messages to joint targets; knows nothing of ROS but the fields of its messages.

    Args:
      policy: a `Policy`. timeout_s: age beyond which an input is stale, s.
    """

    def __init__(self, policy: Any, timeout_s: float):
        self.policy, self.contract, self.timeout = policy, policy.contract, timeout_s
        self.blocks = {b["name"]: len(b["names"]) for b in self.contract["observations"]}
        # A rover's own software computes such blocks: a node knows no height maps.
        self.foreign = [name for name in self.blocks if not hasattr(self, "block_" + name)]
        self.inputs: dict[str, Any] = {}
        self.begin()

    def begin(self) -> None:
        """Forgets the drive before: a new goal begins a new one."""
        self.filter = Acceleration(self.contract)
        self.action = np.zeros(len(self.contract["actions"]))
        self.origin: Any = None
        self.anchor: Any = None
        self.waited, self.arrived = 0.0, False

    def take(self, name: str, message: Any, now: float) -> None:
        """Takes a message of one of the topics in `TOLD`, or of a block, at a time in s."""
        if name == "goal":
            self.begin()
        elif name not in TOLD and len(message.data) != self.blocks[name]:
            raise ContractError(f"blocks/{name}: has {len(message.data)} numbers, not {self.blocks[name]}.")
        self.inputs[name] = (message, now)

    def stale(self, now: float) -> list[str]:
        """Names of inputs that are missing or too old; a goal does not age."""
        wanted = TOLD + tuple(self.foreign)
        ages = {k: now - self.inputs[k][1] if k in self.inputs else math.inf for k in wanted}
        # A goal is sent once, and holds until there is another.
        if "goal" in self.inputs:
            ages["goal"] = 0.0
        return [name for name, age in ages.items() if age > self.timeout]

    def tick(self, now: float) -> dict[str, dict[str, float]]:
        """Targets of all joints, by name, at a time in s: {"position": {...}, "velocity": {...}, "effort": {...}}."""
        if self.stale(now):
            self.action = np.zeros_like(self.action)
            return self.targets(self.action)
        self.look()
        if self.arrived:
            self.action = np.zeros_like(self.action)
        else:
            action = self.policy.act(self.observe())
            # A policy that was fed something not finite answers likewise: motors stand rather than run away.
            self.action = np.clip(action, -1.0, 1.0) if np.isfinite(action).all() else np.zeros_like(self.action)
        return self.targets(self.action)

    def targets(self, action: Any) -> dict[str, dict[str, float]]:
        """Targets of all joints for actions (action,)."""
        by_mode: dict[str, dict[str, float]] = {"position": {}, "velocity": {}, "effort": {}}
        for joint in self.contract["joints"]:
            by_mode[FIELD[joint["mode"]]][joint["name"]] = float(joint["scale"] * action[joint["action"]])
        return by_mode

    def look(self) -> None:
        """Reads pose and joints of the newest messages, and counts what the observations count."""
        odometry, joints, goal = (self.inputs[k][0] for k in TOLD)
        pose, twist = odometry.pose.pose, odometry.twist.twist
        self.position = vector(pose.position)
        # ROS has w last, the package has it first.
        q = pose.orientation
        self.matrix = rotation(q.x, q.y, q.z, q.w)
        self.body_velocity, self.body_rates = vector(twist.linear), vector(twist.angular)
        self.velocity = self.matrix @ self.body_velocity
        place = {name: i for i, name in enumerate(joints.name)}
        wanted = self.contract["rover"]["joints"]
        missing = [name for name in wanted if name not in place]
        if missing:
            raise ContractError(f"joint_states: lacks {missing[0]}.")
        self.angles = np.array([joints.position[place[name]] for name in wanted])
        self.speeds = np.array([joints.velocity[place[name]] for name in wanted])
        q = goal.pose.orientation
        self.goal, self.direction = vector(goal.pose.position)[:2], heading(rotation(q.x, q.y, q.z, q.w))
        self.acceleration = self.filter.update(self.position, self.velocity)
        if self.origin is None:
            self.origin, self.anchor = self.position, self.position[:2]
        elif np.linalg.norm(self.position[:2] - self.anchor) > self.contract["task"]["stuck_distance"]:
            self.anchor, self.waited = self.position[:2], 0.0
        else:
            self.waited += self.contract["control_interval_s"]
        task = self.contract["task"]
        near = bool(np.linalg.norm(self.goal - self.position[:2]) < task["goal_radius"])
        off = self.direction - heading(self.matrix)
        right = task["arrive_within"] >= math.pi or math.cos(off) > math.cos(task["arrive_within"])
        self.arrived = self.arrived or (near and right)

    def observe(self) -> Any:
        """All blocks side by side, (obs,)."""
        parts = []
        for name in self.blocks:
            known = getattr(self, "block_" + name, None)
            parts.append(np.asarray(known() if known else self.inputs[name][0].data, float))
        return np.concatenate(parts)

    # The blocks that odometry, joints and goal give, as the contract describes them.

    def block_position(self) -> Any:
        """Position from where the episode began, world axes, m."""
        return self.position - self.origin

    def block_euler(self) -> Any:
        """Roll, pitch and yaw, rad (pitch is positive with the nose down)."""
        m = self.matrix
        return [math.atan2(m[2, 1], m[2, 2]), math.asin(min(1.0, max(-1.0, -m[2, 0]))), heading(m)]

    def block_velocity(self) -> Any:
        """Velocity of the chassis, world axes, m/s."""
        return self.velocity

    def block_angular_velocity(self) -> Any:
        """Angular velocity of the chassis, world axes, rad/s."""
        return self.matrix @ self.body_rates

    def block_acceleration(self) -> Any:
        """Acceleration of the chassis, m/s2."""
        return self.acceleration

    def block_goal(self) -> Any:
        """Goal from where the episode began, world axes, m."""
        return self.goal - self.origin[:2]

    def block_goal_body(self) -> Any:
        """Distance of the goal, m, its squashed value in 0 to 1, and its direction ahead and to the left."""
        yaw, to = heading(self.matrix), self.goal - self.position[:2]
        ahead = math.cos(yaw) * to[0] + math.sin(yaw) * to[1]
        aside = math.cos(yaw) * to[1] - math.sin(yaw) * to[0]
        distance = math.hypot(ahead, aside)
        least = max(distance, 1e-3)
        return [distance, 1.0 - math.exp(-distance / 3.0), ahead / least, aside / least]

    def block_up(self) -> Any:
        """Direction of world up in axes of the chassis."""
        return self.matrix[2]

    def block_body_velocity(self) -> Any:
        """Velocity in axes of the chassis, m/s."""
        return self.body_velocity

    def block_body_rates(self) -> Any:
        """Angular velocity in axes of the chassis, rad/s."""
        return self.body_rates

    def block_joints(self) -> Any:
        """Sines of the joints' angles, then their speeds, rad/s."""
        return np.concatenate([np.sin(self.angles), self.speeds])

    def block_last_action(self) -> Any:
        """The action that was last sent."""
        return self.action

    def block_waited(self) -> Any:
        """Time without progress, in tens of seconds."""
        return [self.waited / 10.0]

    def block_arrival(self) -> Any:
        """Cosine and sine of the turn that is left to the wanted direction of arrival."""
        turn = self.direction - heading(self.matrix)
        return [math.cos(turn), math.sin(turn)]


def joint_state(message: Any, targets: dict[str, dict[str, float]]) -> Any:
    """Fills a JointState with targets: each joint's in one field, not-a-number in the others."""
    message.name = [name for group in targets.values() for name in group]
    for field in ("position", "velocity", "effort"):
        setattr(message, field, [targets[field].get(name, math.nan) for name in message.name])
    return message


def main(args: Any = None) -> None:
    """Runs the node until it is shut down."""
    rclpy: Any = importlib.import_module("rclpy")
    odometry = importlib.import_module("nav_msgs.msg").Odometry
    state = importlib.import_module("sensor_msgs.msg").JointState
    pose = importlib.import_module("geometry_msgs.msg").PoseStamped
    array = importlib.import_module("std_msgs.msg").Float32MultiArray
    rclpy.init(args=args)
    node = rclpy.create_node("lunar_mjx_policy")
    folder = node.declare_parameter("folder", os.path.dirname(os.path.abspath(__file__))).value
    policy = Policy(folder)
    interval = policy.contract["control_interval_s"]
    driver = Driver(policy, float(node.declare_parameter("timeout_s", 5.0 * interval).value))
    publisher = node.create_publisher(state, "joint_commands", 1)

    def seconds() -> float:
        return node.get_clock().now().nanoseconds * 1e-9

    def listen(kind: Any, name: str, topic: str) -> None:
        node.create_subscription(kind, topic, lambda message: driver.take(name, message, seconds()), 1)

    for kind, name in ((odometry, "odom"), (state, "joint_states"), (pose, "goal")):
        listen(kind, name, name)
    for name in driver.foreign:
        listen(array, name, "blocks/" + name)
    warnings: list[str] = []

    def tick() -> None:
        stale = driver.stale(seconds())
        if stale != warnings:
            warnings[:] = stale
            node.get_logger().info("waiting for " + ", ".join(stale) if stale else "driving")
        publisher.publish(joint_state(state(), driver.tick(seconds())))

    node.create_timer(interval, tick)
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    try:
        main()
    except (ContractError, OSError) as error:
        sys.exit(str(error))
