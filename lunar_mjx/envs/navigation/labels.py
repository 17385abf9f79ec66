"""Name and unit of every number of an observation, for those who feed a policy outside the simulator."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from lunar_mjx.envs.ladder.chart import CHART
from lunar_mjx.envs.navigation.env import NavigationEnv
from lunar_mjx.envs.navigation.view import SCAN_SCALE, VIEW


class Label(NamedTuple):
    """Name of one number within its block of observations, and its unit ("1" if it has none)."""

    name: str
    unit: str


def _axes(unit: str, names: str = "x y z") -> Callable[[NavigationEnv], list[Label]]:
    return lambda env: [Label(name, unit) for name in names.split()]


def _goal_body(env: NavigationEnv) -> list[Label]:
    return [
        Label("distance", "m"),
        Label("1 - exp(-distance / 3 m)", "1"),
        Label("cosine of bearing", "1"),
        Label("sine of bearing", "1"),
    ]


def _joints(env: NavigationEnv) -> list[Label]:
    names = env.system.joint_names
    return [Label(f"sine of {n}", "1") for n in names] + [Label(f"speed of {n}", "rad/s") for n in names]


def _per_joint(unit: str) -> Callable[[NavigationEnv], list[Label]]:
    return lambda env: [Label(name, unit) for name in env.system.joint_names]


def _per_wheel(unit: str) -> Callable[[NavigationEnv], list[Label]]:
    return lambda env: [Label(wheel.corner, unit) for wheel in env.model.rover.wheels]


def _scan(env: NavigationEnv, wider: float = 1.0) -> list[Label]:
    scale = wider * SCAN_SCALE.get(env.model.rover.name, 1.0)
    return [
        Label(f"{scale * a:.4g} m ahead, {scale * b:.4g} m to the left", "m")
        for a in VIEW.scan_ahead
        for b in VIEW.scan_aside
    ]


def _pixels(unit: Callable[[NavigationEnv], str], colours: tuple[str, ...] = ("",)) -> Callable[..., list[Label]]:
    return lambda env: [
        Label(f"row {row}, column {column}{colour}", unit(env))
        for row in range(env.config.camera_height)
        for column in range(env.config.camera_width)
        for colour in colours
    ]


_PLACES = ("aim", *(f"node {k + 1} of the way" for k in range(CHART.steps)))

LABELS: dict[str, Callable[[NavigationEnv], list[Label]]] = {
    "position": _axes("m"),
    "euler": _axes("rad", "roll pitch yaw"),
    "velocity": _axes("m/s"),
    "angular_velocity": _axes("rad/s"),
    "acceleration": _axes("m/s2"),
    "goal": _axes("m", "x y"),
    "goal_body": _goal_body,
    "up": _axes("1"),
    "body_velocity": _axes("m/s"),
    "body_rates": _axes("rad/s"),
    "joints": _joints,
    "temperatures": _per_joint("100 K"),
    "slip": _per_wheel("1"),
    "sinkage": _per_wheel("cm"),
    "last_action": lambda env: [Label(name, "1") for name in env.actions.names],
    "waited": lambda env: [Label("time", "10 s")],
    "arrival": lambda env: [Label("cosine", "1"), Label("sine", "1")],
    "border": lambda env: [Label(side, "10 m") for side in ("ahead", "to the left", "behind", "to the right")],
    "visited": lambda env: [
        Label(f"{a:g} m ahead, {b:g} m to the left", "1") for a in VIEW.visited_grid for b in VIEW.visited_grid
    ],
    "plan": lambda env: [
        *(Label(f"{place}, {side}", "m") for place in _PLACES for side in ("ahead", "to the left")),
        Label("cost of the way", "50 m"),
    ],
    "power": lambda env: [
        Label("charge above the cut-off", "%"),
        Label("sunlight", "1361 W/m2"),
        Label("cosine of the Sun's bearing", "1"),
        Label("sine of the Sun's bearing", "1"),
    ],
    "height_scan": _scan,
    "far_scan": lambda env: _scan(env, VIEW.far_scan),
    "trail": lambda env: [
        Label(f"{axis}, {time:g} s", "m") for axis in ("ahead", "to the left") for time in VIEW.trail
    ],
    "camera/rgb": _pixels(lambda env: "1", (", red", ", green", ", blue")),
    "camera/depth": _pixels(lambda env: f"{env.config.camera_far:g} m"),
    "camera/labels": _pixels(lambda env: "1"),
}
"""Blocks whose numbers have names of their own. What was drawn is counted through."""


def labels(env: NavigationEnv) -> dict[str, list[Label]]:
    """The labels of every block of the environment's observation, in its order."""
    widths = {name: part.stop - part.start for name, part in env.blocks.items()}
    counted = {name: [Label(str(i), "1") for i in range(width)] for name, width in widths.items()}
    return {name: LABELS[name](env) if name in LABELS else counted[name] for name in widths}
