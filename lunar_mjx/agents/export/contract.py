"""What a policy asks of those who run it: the order, units and rates of its observations, and what its actions mean."""

from __future__ import annotations

import inspect
import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from lunar_mjx._version import __version__
from lunar_mjx.agents.networks import MOST_DEVIATIONS
from lunar_mjx.agents.policy import Policy
from lunar_mjx.effects.joint.motor import CURRENT, POSITION, TORQUE, VELOCITY
from lunar_mjx.envs import NavigationEnv
from lunar_mjx.envs.navigation.labels import Label, labels
from lunar_mjx.envs.navigation.observations import BLOCKS, CAMERA

FORMAT = "lunar-mjx-contract/1"
Mode = Literal["position", "velocity", "torque", "current"]
MODES: dict[int, tuple[Mode, str]] = {
    POSITION: ("position", "rad"),
    VELOCITY: ("velocity", "rad/s"),
    TORQUE: ("torque", "N m"),
    CURRENT: ("current", "A"),
}
"""Control modes of motors with the unit of their target."""


class _Part(BaseModel):
    # A reader must not pass over a field that it does not know: it may change what an action means.
    model_config = ConfigDict(extra="forbid")


class Picture(_Part):
    """Shape and optics of a block that is a picture: rows from the top, pixels from the left, the colours of each.

    Attributes:
      rows, columns, colours: how many. fovy_deg: vertical angle of view. pitch_deg: how far the camera looks down.
      far_m: depth from which on a pixel reads 1 in `camera/depth`, and beyond which the camera sees nothing, m.
      lens: its distortion, `D` of a ROS CameraInfo (plumb_bob): k1, k2, p1, p2, k3; empty if there is none.
    """

    rows: Annotated[int, Field(ge=1)]
    columns: Annotated[int, Field(ge=1)]
    colours: Annotated[int, Field(ge=1)]
    fovy_deg: float
    pitch_deg: float
    far_m: float
    lens: list[float] = []


class Block(_Part):
    """A run of observations: `names` and `units` are of its numbers, `start` is the place of the first; `picture` is
    None unless they are pixels."""

    name: str
    about: str
    start: Annotated[int, Field(ge=0)]
    names: list[str]
    units: list[str]
    picture: Picture | None = None


class Normalisation(_Part):
    """How graphs scale observations: clip((obs - mean) / deviation, -most, most)."""

    mean: list[float]
    deviation: list[float]
    most: float


class Action(_Part):
    """One output, from -1 to 1."""

    name: str
    low: float = -1.0
    high: float = 1.0


class Joint(_Part):
    """A motor's target is `scale` times action number `action`, in `unit`; `low` and `high` limit the joint's angle."""

    name: str
    mode: Mode
    unit: str
    action: Annotated[int, Field(ge=0)]
    scale: float
    low: float | None
    high: float | None


class Rover(_Part):
    """Who drives; lengths in m, `ride_height` of the chassis frame over the ground when standing."""

    name: str
    mass_kg: float
    ride_height: float
    joints: list[str]
    wheels: list[str]


class Filter(_Part):
    """Kalman filter of the block `acceleration`: gains (n, 3, 2) of the first, second, ... measurement."""

    interval_s: float
    gains: list[list[list[float]]]


class Task(_Part):
    """What the observations count from and when an episode ends; m, s and rad."""

    goal_radius: float
    arrive_within: float
    stuck_distance: float
    stuck_time: float


class Contract(_Part):
    """The contract of an exported policy.

    Attributes:
      format: of this file. package, version: what wrote it.
      policy: name of the file it comes from. sha256: of the files by name, the policy's among them.
      environment: name and options of the environment that it was trained in. notes: of its training.
      control_interval_s, rate_hz: of actions.
      input, output, dtype: of the graphs.
      observations: in order. normalisation: within the graphs; None if there is none.
      actions: in order. joints: what the actions drive, in the order of the rover's motors.
      rover, filter, task: None for environments without a rover.
    """

    format: Literal["lunar-mjx-contract/1"] = FORMAT
    package: Literal["lunar-mjx"] = "lunar-mjx"
    version: str = __version__
    policy: str
    sha256: dict[str, str]
    environment: dict[str, Any]
    notes: dict[str, Any]
    control_interval_s: Annotated[float, Field(gt=0.0)]
    rate_hz: Annotated[float, Field(gt=0.0)]
    input: Literal["obs"] = "obs"
    output: Literal["action"] = "action"
    dtype: Literal["float32"] = "float32"
    observations: list[Block]
    normalisation: Normalisation | None
    actions: list[Action]
    joints: list[Joint]
    rover: Rover | None
    filter: Filter | None
    task: Task | None


def contract_of(policy: Policy, env: Any, source: str, sha256: dict[str, str]) -> Contract:
    """The contract of a policy.

    Args:
      policy: what is exported. env: that it was trained in.
      source: name of the policy's file. sha256: of the files by name.
    """
    shared = {
        "policy": source,
        "sha256": sha256,
        "environment": policy.environment,
        "notes": policy.notes,
        "control_interval_s": env.control_interval,
        # Both interval and rate: robots are set up by either.
        "rate_hz": 1.0 / env.control_interval,
        "normalisation": _normalisation(policy),
    }
    if not isinstance(env, NavigationEnv):
        # Of a user's own environment nothing is known but sizes: its numbers have numbers for names.
        size, actions = policy.network["obs"], policy.network["actions"]
        names = [str(i) for i in range(size)]
        block = Block(name="obs", about="As the environment gives it.", start=0, names=names, units=["1"] * size)
        numbered = [Action(name=str(i)) for i in range(actions)]
        return Contract(**shared, observations=[block], actions=numbered, joints=[], rover=None, filter=None, task=None)
    c, rover = env.config, env.model.rover
    return Contract(
        **shared,
        observations=_blocks(env),
        actions=[Action(name=name) for name in env.actions.names],
        joints=_joints(env),
        rover=Rover(
            name=rover.name,
            mass_kg=rover.mass,
            ride_height=rover.standing_height,
            joints=list(env.system.joint_names),
            wheels=[w.corner for w in rover.wheels],
        ),
        filter=Filter(interval_s=env.control_interval, gains=np.asarray(env.params.gains, float).tolist()),
        task=Task(
            goal_radius=c.goal_radius,
            arrive_within=c.arrive_within,
            stuck_distance=c.stuck_distance,
            stuck_time=c.stuck_time,
        ),
    )


def _normalisation(policy: Policy) -> Normalisation | None:
    if policy.mean is None or policy.deviation is None:
        return None
    mean, deviation = (np.asarray(a, float).tolist() for a in (policy.mean, policy.deviation))
    return Normalisation(mean=mean, deviation=deviation, most=MOST_DEVIATIONS)


def _blocks(env: NavigationEnv) -> list[Block]:
    told: dict[str, list[Label]] = labels(env)
    return [
        Block(
            name=name,
            # The block's own docstring, so that contract and code cannot differ.
            about=" ".join((inspect.getdoc(BLOCKS[name]) or "").split()),
            start=env.blocks[name].start,
            names=[label.name for label in parts],
            units=[label.unit for label in parts],
            picture=_picture(env, len(parts)) if name.startswith(CAMERA) else None,
        )
        for name, parts in told.items()
    ]


def _picture(env: NavigationEnv, size: int) -> Picture:
    c = env.config
    return Picture(
        rows=c.camera_height,
        columns=c.camera_width,
        # A depth picture has one number a pixel, a colour picture three.
        colours=size // (c.camera_height * c.camera_width),
        fovy_deg=c.camera_fovy_deg,
        pitch_deg=c.camera_pitch_deg,
        far_m=c.camera_far,
        lens=list(c.camera_lens),
    )


def _joints(env: NavigationEnv) -> list[Joint]:
    rover, joints = env.model.rover, []
    for name, source, scale, mode in zip(
        rover.joints, env.actions.source, env.actions.scale, env.actions.mode, strict=True
    ):
        word, unit = MODES[int(mode)]
        # JSON has no infinity.
        low, high = (value if math.isfinite(value) else None for value in map(float, rover.joint_limits[name]))
        joints.append(
            Joint(name=name, mode=word, unit=unit, action=int(source), scale=float(scale), low=low, high=high)
        )
    return joints
