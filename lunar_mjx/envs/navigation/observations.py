"""Observations of the navigation task: named blocks of numbers, put side by side in the order of the configuration."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp

from lunar_mjx.cameras.batch import Pictures
from lunar_mjx.envs.navigation.sensing import in_sight
from lunar_mjx.envs.navigation.view import VIEW, View, goal_in_body, height_scan, scan_places
from lunar_mjx.errors import bad_input
from lunar_mjx.pytree import pytree, static
from lunar_mjx.terrain import Terrain
from lunar_mjx.terrain.sky import Sun
from lunar_mjx.terrain.sky.sun import SOLAR_CONSTANT

PAPER_OBSERVATION = ("position", "euler", "velocity", "angular_velocity", "acceleration", "goal")
"""The 17 numbers of section V: p, Euler angles, v, omega, filtered a (three each) and the goal (two)."""


@pytree
class Scene:
    """What blocks beyond the rover itself read.

    Attributes:
      terrain: the ground.
      drawn: parameters drawn for the episode, by name.
      ride: standing height of the chassis frame, m. scan_scale: of the height scan's pattern.
      sun: over the terrain; None where there is none.
      seen: what the front cameras see, where a block asks for it. far: depth that counts as 1, m.
      mast: height of the scan's sensor above the ground, m; 0 where nothing hides anything from it.
    """

    terrain: Terrain
    drawn: dict[str, Any]
    ride: float = static(default=0.0)
    scan_scale: float = static(default=1.0)
    sun: Sun | None = None
    seen: Pictures | None = None
    far: float = static(default=60.0)
    mast: float = static(default=0.0)


Block = Callable[[View, Scene], Any]


def position(v: View, s: Scene) -> Any:
    """Position of the chassis frame from where the episode began, world axes, m."""
    away = v.position - v.origin
    return away if v.drift is None else away.at[:, :2].add(v.drift)


def euler(v: View, s: Scene) -> Any:
    """Roll, pitch and yaw, rad."""
    return jnp.stack([v.roll, v.pitch, v.yaw], axis=-1)


def velocity(v: View, s: Scene) -> Any:
    """Velocity of the chassis along the world's axes, m/s."""
    return v.velocity


def angular_velocity(v: View, s: Scene) -> Any:
    """Angular velocity of the chassis along the world's axes, rad/s."""
    return v.angular_velocity


def acceleration(v: View, s: Scene) -> Any:
    """Kalman-filtered linear acceleration, world axes, m/s2."""
    return v.filtered.acceleration


def goal(v: View, s: Scene) -> Any:
    """The goal from where the episode began, world axes, m."""
    return v.goal - v.origin[:, :2]


def goal_body(v: View, s: Scene) -> Any:
    """Distance to the goal, 1 - exp(-distance / 3 m), and cosine and sine of its bearing from the heading."""
    ahead = goal_in_body(v)
    distance = jnp.sqrt(jnp.sum(ahead * ahead, axis=-1, keepdims=True))
    # Both: metres for planning, and a number that stays within 1 and is fine near the goal.
    return jnp.concatenate([distance, 1.0 - jnp.exp(-distance / 3.0), ahead / jnp.maximum(distance, 1e-3)], axis=-1)


def up(v: View, s: Scene) -> Any:
    """The vertical in the body frame."""
    return v.world_up


def body_velocity(v: View, s: Scene) -> Any:
    """Velocity of the chassis along its own axes, m/s."""
    return v.body_velocity


def body_rates(v: View, s: Scene) -> Any:
    """Angular velocity of the chassis along its own axes, rad/s."""
    return v.body_rates


def joints(v: View, s: Scene) -> Any:
    """Angles of the joints that do not turn on and on, as sine (drive joints too), and speeds, rad/s."""
    # As a sine, since drive angles grow without end.
    return jnp.concatenate([jnp.sin(v.joint_angle), v.joint_speed], axis=-1)


def temperatures(v: View, s: Scene) -> Any:
    """Temperatures of the motors' windings, in units of 100 K above 25 degC."""
    return (v.winding_temperature - 298.15) / 100.0


def slip(v: View, s: Scene) -> Any:
    """Slip ratio of every wheel within [-1, 1]."""
    return jnp.clip(v.slip, -1.0, 1.0)


def sinkage(v: View, s: Scene) -> Any:
    """Sinkage of every wheel, cm."""
    return 100.0 * v.sinkage


def scan(v: View, s: Scene) -> Any:
    """Height of ground and rocks at a pattern of places around the rover, m, within 1 m of its standing plane."""
    # Bounded: a cliff must not drown what lies before the wheels.
    return _scanned(v, s, s.scan_scale, 1.0)


def far_scan(v: View, s: Scene) -> Any:
    """The height scan over a wider and coarser pattern, m, within 2 m of the standing plane. Without a mast nothing
    hides what lies behind a boulder from it."""
    return _scanned(v, s, VIEW.far_scan * s.scan_scale, 2.0)


def _scanned(v: View, s: Scene, scale: float, most: float) -> Any:
    """Heights within `most`; below that, -1.5 times it, where the sensor on its mast sees nothing."""
    height = height_scan(s.terrain, v, scale, s.ride)
    told = jnp.clip(height, -most, most)
    if s.mast == 0.0:
        return told
    foot = v.position[:, 2] - s.ride
    eye = jnp.stack([v.position[:, 0], v.position[:, 1], foot + s.mast], axis=-1)
    x, y = scan_places(v, scale)
    clear = in_sight(s.terrain, eye, (x, y, height + foot[:, None]), scale * VIEW.scan_reach)
    return jnp.where(clear, told, -1.5 * most)


def trail(v: View, s: Scene) -> Any:
    """Where the rover was: means of its past positions that fade within the times `VIEW.trail`, along and across the
    heading from where it is now, m. Dead reckoning tells it; it is all the memory that a policy without any has."""
    assert v.trail is not None, "the environment keeps the trail that this block asks for"
    away = v.trail - v.believed[:, None]
    cos, sin = jnp.cos(v.yaw)[:, None], jnp.sin(v.yaw)[:, None]
    ahead = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    return jnp.concatenate(ahead, axis=-1)


def border(v: View, s: Scene) -> Any:
    """Distance to the border of the ground that the rover may drive on, ahead, to the left, behind and to the right,
    in units of 10 m and at most one: a fence that the operators have drawn."""
    low, high = v.corners[:, 0] - v.believed, v.corners[:, 1] - v.believed
    rays = v.yaw[:, None] + 0.5 * jnp.pi * jnp.arange(4)
    way = []
    for k, along in enumerate((jnp.cos(rays), jnp.sin(rays))):
        # Distance to the side that the ray runs towards, along x and along y; the nearer one is met first.
        gap = jnp.where(along > 0.0, high[:, k, None], -low[:, k, None])
        way.append(gap / jnp.maximum(jnp.abs(along), 1e-6))
    return jnp.clip(jnp.minimum(*way) / 10.0, 0.0, 1.0)


def visited(v: View, s: Scene) -> Any:
    """How often the rover has been near the places of a grid around it: a sum of bells two metres wide over the places
    that it remembers. Dead reckoning tells it; it shows which ways have been tried."""
    assert v.visited is not None, "the environment remembers the places that this block asks for"
    away = v.visited - v.believed[:, None]
    cos, sin = jnp.cos(v.yaw)[:, None], jnp.sin(v.yaw)[:, None]
    ahead, aside = cos * away[..., 0] + sin * away[..., 1], cos * away[..., 1] - sin * away[..., 0]
    grid = jnp.asarray(VIEW.visited_grid)
    # the bell of a place is the product of one along and one across
    fore, side = (jnp.exp(-0.5 * ((a[..., None] - grid) / VIEW.visited_apart) ** 2) for a in (ahead, aside))
    return jnp.einsum("epi,epj->eij", fore, side).reshape(v.yaw.shape[0], -1)


def plan(v: View, s: Scene) -> Any:
    """The way to the goal on the map that the rover has drawn of what it has seen (`ladder.chart`): where to aim, then
    the next nodes of the way, m, all in the body frame as along and across pairs, and the way's cost in units of 50 m
    of ground as it is on average."""
    assert v.plan is not None, "the environment keeps the chart that this block asks for"
    cos, sin = jnp.cos(v.yaw)[:, None], jnp.sin(v.yaw)[:, None]
    x, y = v.plan[:, :-1:2], v.plan[:, 1:-1:2]
    turned = jnp.stack([cos * x + sin * y, cos * y - sin * x], axis=-1)
    return jnp.concatenate([turned.reshape(v.yaw.shape[0], -1), v.plan[:, -1:] / 50.0], axis=-1)


def power(v: View, s: Scene) -> Any:
    """The battery's charge above its cut-off, %; sunlight as a share of that in free space, which falls in shadow; and
    cosine and sine of the Sun's bearing from the heading, as a Sun sensor or the panels' currents tell them. For models
    with `battery` and a Sun at rest."""
    assert v.charge is not None and s.sun is not None, "the environment refuses this block without battery and Sun"
    light = s.sun.light(0.0, v.position[:, 0], v.position[:, 1])
    bearing = jnp.arctan2(light.direction.y, light.direction.x) - v.yaw
    parts = 100.0 * v.charge, light.irradiance / SOLAR_CONSTANT, jnp.cos(bearing), jnp.sin(bearing)
    return jnp.stack(jnp.broadcast_arrays(*parts), axis=-1)


def camera_rgb(v: View, s: Scene) -> Any:
    """Front camera's picture, 0 to 1: rows from the top, pixels from the left, red, green, blue."""
    return _flat(_seen(s).rgb)


def camera_depth(v: View, s: Scene) -> Any:
    """Front camera's depth along its axis, as a share of the farthest, pixel by pixel; 1 in the sky."""
    return _flat(jnp.minimum(_seen(s).depth / s.far, 1.0))


def camera_labels(v: View, s: Scene) -> Any:
    """What each pixel of the front camera shows: 0 sky, 1 ground, 2 rock, 3 rover."""
    return _flat(_seen(s).label.astype(v.position.dtype))


def _seen(s: Scene) -> Pictures:
    assert s.seen is not None, "the environment draws the pictures that its blocks ask for"
    return s.seen


def _flat(pictures: Any) -> Any:
    return pictures.reshape(pictures.shape[0], -1)


def last_action(v: View, s: Scene) -> Any:
    """The action of the control step before, in [-1, 1]."""
    return v.last_action


def arrival(v: View, s: Scene) -> Any:
    """Cosine and sine of the heading to arrive in, from the rover's own."""
    assert v.arrival is not None, "the configuration refuses this block without a ladder"
    turn = v.arrival - v.yaw
    return jnp.stack([jnp.cos(turn), jnp.sin(turn)], axis=-1)


def waited(v: View, s: Scene) -> Any:
    """Time since the rover left the place that it may be stuck at, in units of 10 s."""
    return v.waited[:, None] / 10.0


def drawn(v: View, s: Scene) -> Any:
    """What was drawn for the episode, logarithms of the sizes; for critics only, a rover cannot know it."""
    # Logarithms: moduli range over decades.
    parts = [jnp.log(jnp.abs(a).reshape(a.shape[0], -1) + 1e-6) for _, a in sorted(s.drawn.items())]
    return jnp.concatenate(parts, axis=-1) if parts else jnp.zeros((v.yaw.shape[0], 0))


BLOCKS: dict[str, Block] = {
    f.__name__: f
    for f in (
        position,
        euler,
        velocity,
        angular_velocity,
        acceleration,
        goal,
        goal_body,
        up,
        body_velocity,
        body_rates,
        joints,
        temperatures,
        slip,
        sinkage,
        last_action,
        waited,
        arrival,
        far_scan,
        trail,
        border,
        visited,
        plan,
        power,
        drawn,
    )
} | {"height_scan": scan, "camera/rgb": camera_rgb, "camera/depth": camera_depth, "camera/labels": camera_labels}
"""All blocks by name."""

CAMERA = "camera/"
"""What the names of blocks begin with that are pictures."""


def check_blocks(names: Sequence[str], field: str) -> None:
    """Refuses names that are no blocks."""
    for name in names:
        if name not in BLOCKS:
            raise bad_input("navigation", field, name, "is no observation", f"use some of {', '.join(BLOCKS)}")


def observe(names: Sequence[str], view: View, scene: Scene) -> Any:
    """The blocks side by side, (env, n)."""
    if not names:
        return jnp.zeros((view.yaw.shape[0], 0), view.position.dtype)
    return jnp.concatenate([BLOCKS[name](view, scene) for name in names], axis=-1)
