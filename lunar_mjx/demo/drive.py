"""Drives a batch of rovers over the shipped terrain and records what they do."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from lunar_mjx.dynamics import System, Telemetry, build
from lunar_mjx.effects.joint.motor import VELOCITY
from lunar_mjx.model import ZERO_CELSIUS, make_model
from lunar_mjx.terrain import Terrain, sample

RIM_SPEEDS = {"viper": (0.12, 0.25), "luvmi_x": (0.08, 0.15)}
"""Least and largest commanded rim speed of a rover, m/s; VIPER's top speed is about 0.2 m/s."""


@dataclasses.dataclass(frozen=True)
class DemoDrive:
    """The drives of the demo."""

    other_speeds: tuple[float, float] = (0.08, 0.15)
    """Least and greatest speed of the wheels' rims of rovers that `RIM_SPEEDS` does not name, m/s."""
    records_per_second: int = 10
    """Rows of a log per second: what a plot of a minute shows."""
    chunk_seconds: float = 1.0
    """Simulated at once, s, between two looks at the clock."""
    steering_amplitude: tuple[float, float] = (0.15, 0.4)
    """Least and greatest, rad: within the steering range of all rovers that ship."""
    steering_period: tuple[float, float] = (20.0, 60.0)
    """Least and greatest, s."""
    spin_up: float = 1.0
    """Seconds over which the wheels come up to speed."""
    spacing: float = 8.0
    """Between neighbouring rovers at the start, m."""
    clearance: float = 1.5
    """Distance from rocks at which a rover may start, beyond the rock's radius, m."""


DEMO_DRIVE = DemoDrive()


_STEEPEST = np.tan(np.radians(10.0))


@dataclasses.dataclass(frozen=True, eq=False)
class Drive:
    """A recorded batch drive of one kind of rover; arrays are (time, rover) or (time, rover, wheel), SI units.

    Attributes:
      rover: name. mass: kg. joints, wheels: names.
      time: (time,) s.
      x, y, z, roll, pitch, yaw: of the chassis frame, m, rad.
      slip, sinkage: of every wheel, eq. 8 and m. rolling: whether the wheel rolls fast enough for slip to mean
        something.
      winding_degC: hottest winding of every rover. hottest: (rover,) the joint whose winding became hottest.
      power: electrical power into all motors, W.
      energy: (rover,) J. distance: (rover,) length of the path in the plane, m.
      command_speed: (rover,) commanded rim speed, m/s.
    """

    rover: str
    mass: float
    wheels: tuple[str, ...]
    time: Float[np.ndarray, "time"]
    x: Float[np.ndarray, "time rover"]
    y: Float[np.ndarray, "time rover"]
    z: Float[np.ndarray, "time rover"]
    roll: Float[np.ndarray, "time rover"]
    pitch: Float[np.ndarray, "time rover"]
    yaw: Float[np.ndarray, "time rover"]
    slip: Float[np.ndarray, "time rover wheel"]
    rolling: Any
    sinkage: Float[np.ndarray, "time rover wheel"]
    winding_degC: Float[np.ndarray, "time rover"]
    hottest: tuple[str, ...]
    power: Float[np.ndarray, "time rover"]
    energy: Float[np.ndarray, "rover"]
    distance: Float[np.ndarray, "rover"]
    command_speed: Float[np.ndarray, "rover"]

    @property
    def mean_slip(self) -> Float[np.ndarray, "time rover"]:
        """Mean over the rolling wheels; not a number where none rolls."""
        count = self.rolling.sum(axis=-1)
        total = np.where(self.rolling, self.slip, 0.0).sum(axis=-1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    @property
    def rover_slip(self) -> Float[np.ndarray, "rover"]:
        """Mean over time of `mean_slip`; not a number for a rover whose wheels never rolled."""
        slip = self.mean_slip
        known = np.isfinite(slip)
        count = known.sum(axis=0)
        return np.where(count > 0, np.where(known, slip, 0.0).sum(axis=0) / np.maximum(count, 1), np.nan)


def drive(
    rover: str,
    count: int,
    seconds: float,
    seed: int,
    terrain: Terrain,
    progress: Callable[[float], None] | None = None,
    shift: float = 0.0,
) -> Drive:
    """Drives `count` rovers of one kind from different places, headings and commands.

    Args:
      rover: name of a rover.
      count: number of rovers.
      seconds: of simulated time.
      seed: of starts and commands.
      terrain: the ground.
      progress: called with the share done, 0 to 1.
      shift: of the grid of starts, as a share of its spacing, so that several drives share the ground.

    Raises:
      UserError: unknown rover.
    """
    model = make_model(rover, terrain)
    system = build(model)
    # A stream for each kind of rover: leaving one out does not move the others.
    rng = np.random.default_rng([seed, *rover.encode()])
    starts = _starts(terrain, count, rng, shift * DEMO_DRIVE.spacing)
    # A command holds for the time between two rows of the record.
    steps_per_record = round(1.0 / DEMO_DRIVE.records_per_second / system.dt)
    controls, speed = _controls(system, count, seconds, rng)
    # All rovers are one batch: one program is compiled for all of them.
    state = jax.jit(jax.vmap(system.reset, in_axes=(None, 0, 0, 0)))(system.params, *map(jnp.asarray, starts))

    run = jax.jit(lambda params, state, controls: system.rollout_batch(params, state, controls, steps_per_record))
    records: list[Telemetry] = []
    chunk = max(1, round(DEMO_DRIVE.chunk_seconds * DEMO_DRIVE.records_per_second))
    for first in range(0, controls.shape[1], chunk):
        part = controls[:, first : first + chunk]
        state, telemetry = run(system.params, state, jnp.asarray(part))
        # Off the device at once: a minute of telemetry need not lie there.
        records.append(jax.device_get(telemetry))
        if progress is not None:
            progress(min(1.0, (first + chunk) / controls.shape[1]))
    joined = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), *records)
    return _record(system, joined, speed)


def _starts(
    terrain: Terrain, count: int, rng: np.random.Generator, shift: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """x, y and yaw of every rover: a jittered grid about the origin, clear of rocks and of steep ground."""
    rows = int(np.ceil(np.sqrt(count)))
    line = (np.arange(rows) - (rows - 1) / 2) * DEMO_DRIVE.spacing + shift
    cells = [(cx, cy) for cy in line for cx in line]
    places = []
    # Off its cell's middle by up to 2 m: a row of rovers would meet a ridge all at once.
    for cx, cy in cells[:count]:
        x = y = 0.0
        # A cell without a good place keeps the last one that was tried: rovers are never fewer than asked for.
        for _ in range(200):
            x, y = np.array([cx, cy]) + rng.uniform(-2.0, 2.0, 2)
            if _good(terrain, x, y):
                break
        places.append((x, y))
    x, y = np.array(places).T
    return x, y, rng.uniform(-np.pi, np.pi, count)


def _good(terrain: Terrain, x: float, y: float) -> bool:
    # As wide as a rover stands: a gentle place in its middle may have a crater's wall under a wheel.
    near = np.stack(np.meshgrid(x + np.linspace(-1, 1, 5), y + np.linspace(-1, 1, 5)))
    _, slope_x, slope_y = sample(terrain.field, jnp.asarray(near[0]), jnp.asarray(near[1]))
    if float(jnp.max(jnp.hypot(slope_x, slope_y))) > _STEEPEST:
        return False
    if terrain.rocks is None:
        return True
    centers, radii = np.asarray(terrain.rocks.centers), np.asarray(terrain.rocks.radii)
    apart = np.hypot(centers[:, 0] - x, centers[:, 1] - y)
    return bool(np.all(apart > radii + DEMO_DRIVE.clearance))


def _controls(
    system: System, count: int, seconds: float, rng: np.random.Generator
) -> tuple[Float[np.ndarray, "rover time joint"], Float[np.ndarray, "rover"]]:
    """Constant rim speed after a ramp, and front and rear wheels that steer against each other in a slow wave."""
    rover = system.model.rover
    steps = max(1, round(seconds * DEMO_DRIVE.records_per_second))
    time = np.arange(steps) / DEMO_DRIVE.records_per_second
    speed = rng.uniform(*RIM_SPEEDS.get(rover.name, DEMO_DRIVE.other_speeds), count)
    amplitude, period = (
        rng.uniform(*DEMO_DRIVE.steering_amplitude, count),
        rng.uniform(*DEMO_DRIVE.steering_period, count),
    )
    # Waves that begin anywhere, or all rovers would turn the same way first.
    phase = rng.uniform(0.0, 2.0 * np.pi, count)
    ramp = np.minimum(time / DEMO_DRIVE.spin_up, 1.0)
    wave = amplitude[:, None] * np.sin(2.0 * np.pi * time[None, :] / period[:, None] + phase[:, None]) * ramp
    controls = np.zeros((count, steps, len(system.joint_names)))
    for wheel in rover.wheels:
        rate = speed[:, None] / wheel.radius * ramp
        at = system.joint_names.index(wheel.drive)
        # Another mode would take the rates for angles or torques without a word.
        assert int(system.info.mode[at]) == VELOCITY
        controls[:, :, at] = rate
        if wheel.steer is not None:
            at = system.joint_names.index(wheel.steer)
            # Short of the limits, so that no wheel is driven against its stop.
            low, high = 0.9 * np.array(rover.joint_limits[wheel.steer])
            controls[:, :, at] = np.clip(wave if wheel.corner.endswith("f") else -wave, low, high)
    return controls, speed


def _record(system: System, t: Telemetry, speed: np.ndarray) -> Drive:
    """From telemetry with axes (rover, time, ...) to a `Drive` with axes (time, rover, ...)."""

    def turned(value: Any) -> np.ndarray:
        return np.swapaxes(np.asarray(value, float), 0, 1)

    x, y = turned(t.position.x), turned(t.position.y)
    rim = turned(t.joint_speed)[..., : len(system.model.rover.wheels)] * np.asarray(system.info.wheel_radius)
    winding = turned(t.winding_temperature)
    power = turned(t.voltage * t.current).sum(axis=-1)
    return Drive(
        rover=system.model.rover.name,
        mass=system.model.rover.mass,
        wheels=tuple(w.corner for w in system.model.rover.wheels),
        time=np.asarray(t.time[0], float),
        x=x,
        y=y,
        z=turned(t.position.z),
        roll=turned(t.euler.x),
        pitch=turned(t.euler.y),
        yaw=turned(t.euler.z),
        slip=turned(t.slip),
        rolling=np.abs(rim) > 0.02,
        sinkage=turned(t.sinkage),
        winding_degC=winding.max(axis=-1) - ZERO_CELSIUS,
        hottest=tuple(system.joint_names[i] for i in winding.max(axis=0).argmax(axis=-1)),
        power=power,
        energy=power.sum(axis=0) / DEMO_DRIVE.records_per_second,
        distance=np.hypot(np.diff(x, axis=0), np.diff(y, axis=0)).sum(axis=0),
        command_speed=speed,
    )
