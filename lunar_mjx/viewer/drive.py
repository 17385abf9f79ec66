"""A simulation that goes on in real time while somebody drives."""

from __future__ import annotations

import dataclasses
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable
from typing import Any, Protocol

import jax
import mujoco
import numpy as np

from lunar_mjx.backends import Backend
from lunar_mjx.backends.base import observation
from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.dynamics.signals import joint_channels
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.model import ZERO_CELSIUS, Model
from lunar_mjx.simulate import Commands, check_start
from lunar_mjx.viewer.pilot import Pilot, drivable
from lunar_mjx.viewer.thrown import LiveDust

ENGINES = ("auto", "native", "structured", "mjx")


@dataclasses.dataclass(frozen=True)
class DrivePace:
    """Pace of a drive in the viewer."""

    hold: float = 0.02
    """About how long a target of the motors is held, s."""
    tick: float = 0.04
    """Time between pictures, s."""
    most: float = 0.2
    """Simulated time that one tick may catch up with, s: a slow machine falls behind rather than stops."""
    creep: float = 0.01
    """Speed of rim and wheel below which a wheel counts as at rest, m/s."""


PACE = DrivePace()


_ROLLED = math.cos(math.radians(75.0))


def open_engine(model: Model, engine: str) -> Backend:
    """The engine that drives: native MuJoCo starts at once, the JAX engines compile first and know every effect.

    Raises:
      UserError: unknown engine, or one that lacks an effect of the model.
    """
    if engine not in ENGINES:
        raise bad_input("view", "--engine", engine, "does not exist", f"use one of {', '.join(ENGINES)}")
    from lunar_mjx.backends.native import NativeBackend

    if engine in ("auto", "native"):
        try:
            # Tried first: it needs no compilation, and a driver waits for none.
            return NativeBackend(model)
        except UserError:
            if engine == "native":
                raise
    from lunar_mjx.backends.jax_backend import JaxBackend

    # To standard error, since nothing is wrong and nothing has been printed yet.
    print("view: this engine compiles first, which can take a minute", file=sys.stderr)
    return JaxBackend(model, engine, precision="float32")


class Driver(Protocol):
    """Something that the viewer's keys can steer."""

    def hold(self, keys: Iterable[str]) -> None:
        """Takes the keys that are held down now."""
        ...


class Drive(Protocol):
    """What the page can show: a rover that goes on, or a drive that is over.

    Attributes:
      live: whether it goes on. scene: what the page is told once, beside rover and ground.
      model: brings both. pilot: takes the keys. rate: times real time.
    """

    live: bool
    scene: dict[str, Any]
    model: Model
    rate: float

    @property
    def pilot(self) -> Driver:
        """Who takes the keys."""
        ...

    def reset(self) -> None:
        """Begins anew."""
        ...

    def advance(self, duration: float) -> float:
        """Goes on by about a duration, s; returns by how much it did."""
        ...

    def dust(self) -> Grains:
        """What the wheels throw up now."""
        ...

    def bodies(self) -> np.ndarray:
        """Position, m, and quaternion of every body, (body, 7), in the world."""
        ...

    def readings(self) -> dict[str, Any]:
        """What the panel shows, ready for JSON."""
        ...


class LiveDrive:
    """A rover that somebody drives.

    Args:
      model: what drives.
      engine: one of `ENGINES`. top_speed: of the rims, m/s. x, y, yaw: start, m and rad.

    Attributes:
      model: with motors that follow the driver. backend: what steps. pilot: what the driver asks for.
      qpos: coordinates of the rover's MJCF, (nq,). time: s since the start. path: length driven, m.
      rate: times real time. note: what the driver should know.

    Raises:
      UserError: as `open_engine`, or a start off the terrain.
    """

    live = True

    def __init__(
        self,
        model: Model,
        engine: str = "auto",
        top_speed: float = 0.5,
        x: float = 0.0,
        y: float = 0.0,
        yaw: float = 0.0,
    ) -> None:
        check_start(model, x, y, yaw)
        self.model = drivable(model)
        self.pilot = Pilot(self.model, top_speed)
        self.backend = open_engine(self.model, engine)
        self.note, self.scene = "", {}
        self._start = (x, y, yaw)
        # Whole steps, so that a target never changes within one.
        self._steps = max(1, round(PACE.hold / self.model.timestep))
        self._scene = self.model.rover.compile()
        self._data = mujoco.MjData(self._scene)
        self._chassis = self._scene.body(self.model.rover.chassis).id
        self._radius = np.array([w.radius for w in self.model.rover.wheels])
        self._drives = [self.model.rover.joints.index(w.drive) for w in self.model.rover.wheels]
        self._joints = joint_channels(self.model.rover)
        self._behind, self.rate = 0.0, 1.0
        self._thrown = LiveDust(self.model)
        self.reset()

    def reset(self) -> None:
        """Puts the rover back to its start."""
        self.backend.reset(*self._start)
        self.pilot.halt()
        self.path, self._behind, self.note = 0.0, 0.0, ""
        self.time, self._place = 0.0, np.zeros(2)
        self._thrown.begin()
        self._go()

    def advance(self, duration: float) -> float:
        """Drives on, in whole control intervals; what is left over is driven next time. Returns the time driven, s."""
        interval = self._steps * self.model.timestep
        # Time that cannot be caught up is dropped.
        self._behind = min(self._behind + duration, PACE.most + interval)
        driven = 0.0
        # Rounding of sums must not cost an interval.
        while self._behind >= interval - 1e-9:
            self._go()
            self._behind -= interval
            driven += interval
        return driven

    def _go(self) -> None:
        interval = self._steps * self.model.timestep
        try:
            seen = self.backend.run(Commands(self.pilot.control(interval)[None], interval))
            self.qpos = self.backend.state().qpos[0]
            if not np.isfinite(self.qpos).all():
                raise UserError(f"the simulation diverged at {self.time:.2f} s; drive more slowly.")
        except UserError as diverged:
            # A drive that diverges at its start would begin anew for ever.
            if self.time == 0.0:
                raise
            self.reset()
            self.note = f"Back at the start: {diverged}"
            return
        self._seen = observation(jax.tree.map(lambda a: a[0, 0], seen))
        place = self.qpos[:2]
        # The first place is where the rover was put.
        self.path += float(np.hypot(*(place - self._place))) if self.time else 0.0
        self.time += interval
        self._place = place
        self._thrown.add(self.time, self.qpos)

    def dust(self) -> Grains:
        """What the wheels throw up now."""
        return self._thrown.at(self.time)

    def bodies(self) -> np.ndarray:
        """Place and quaternion (w, x, y, z) of every body of the rover's MJCF, (body, 7), the world's first."""
        self._data.qpos[:] = self.qpos
        # Poses alone, from the coordinates: the engine may be another than MuJoCo.
        mujoco.mj_kinematics(self._scene, self._data)
        return np.concatenate([self._data.xpos, self._data.xquat], axis=1)

    def readings(self) -> dict[str, Any]:
        """What instruments would show; SI units but where the name says otherwise; slip is None for a wheel at rest."""
        seen = self._seen
        roll, pitch, yaw = np.degrees(seen["euler"])
        winding = seen["winding_temperature"] - ZERO_CELSIUS
        hottest = int(np.argmax(winding))
        return {
            "time_s": self.time,
            "path_m": self.path,
            "speed_m_s": float(np.hypot(*seen["velocity"][:2])),
            "heading_deg": float(yaw) % 360.0,
            "roll_deg": float(roll),
            "pitch_deg": float(pitch),
            "power_W": float((seen["voltage"] * seen["current"]).sum()),
            "slip": [None if rest else slip for slip, rest in zip(seen["slip"].tolist(), self._rests(), strict=True)],
            "sinkage_mm": (1e3 * seen["sinkage"]).tolist(),
            "winding_degC": winding[self._drives].tolist(),
            "hottest": self._joints[hottest],
            "hottest_degC": float(winding[hottest]),
            "asked_m_s": self.pilot.throttle * self.pilot.top_speed,
            "asked_turn": self.pilot.wheel,
            "rate": self.rate,
            "note": self.note or self._warning(seen),
        }

    def _rests(self) -> list[bool]:
        """Wheels whose rim and centre both creep: their ratio is that of two roundings."""
        rim = self._radius * np.abs(self._seen["joint_speed"][self._drives])
        return (np.maximum(rim, np.linalg.norm(self._seen["wheel_velocity"], axis=-1)) < PACE.creep).tolist()

    def _warning(self, seen: dict[str, np.ndarray]) -> str:
        x, y = self.qpos[4:6]
        if 1.0 - 2.0 * (x * x + y * y) < _ROLLED:
            return "Rolled over: reset the rover to go on."
        if not seen["on_terrain"].all():
            return "Over the edge of the terrain: beyond it the ground is level."
        return ""


class Pace:
    """Drives in real time in a thread of its own, and hands every picture to a function.

    Args:
      drive: what drives. show: called after every tick. clock: s, monotonic.

    Attributes:
      lock: held while the drive changes. failure: what ended the thread, if anything did.
    """

    def __init__(self, drive: Drive, show: Callable[[], None], clock: Callable[[], float] = time.monotonic) -> None:
        self.drive, self.lock, self.clock, self._show = drive, threading.Lock(), clock, show
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="drive", daemon=True)
        self._last = clock()
        self.failure: BaseException | None = None

    def start(self) -> None:
        """Starts the thread that drives."""
        self._thread.start()

    def stop(self) -> None:
        """Ends the thread and waits for it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join()

    def tick(self) -> None:
        """Drives until the time that the clock shows, and shows the picture."""
        now = self.clock()
        with self.lock:
            driven = self.drive.advance(now - self._last)
            # a mean over about a second: single ticks hold whole control intervals only
            self.drive.rate += 0.05 * (driven / (now - self._last) - self.drive.rate)
        self._last = now
        self._show()

    def _run(self) -> None:
        self._last = self.clock()
        try:
            while not self._stop.wait(max(0.0, self._last + PACE.tick - self.clock())):
                self.tick()
        except Exception as failure:
            self.failure = failure
            self._show()
