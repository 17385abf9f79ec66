"""A measured drive beside what a model predicts of it: two rovers on one ground, for a page that plays them back."""

from __future__ import annotations

import base64
import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import SPRAY, Grains
from lunar_mjx.cameras.dust.recorded import Dust, ground_below, none, wheel_motion
from lunar_mjx.model import Model
from lunar_mjx.terrain import surface
from lunar_mjx.viewer.pilot import Onlooker
from lunar_mjx.viewer.thrown import LIVE_DUST


@dataclasses.dataclass(frozen=True)
class ReplaySizes:
    """How a drive is shown again."""

    frames: int = 600
    """Pictures of a drive: one of ten minutes moves once a second, and a page of it stays below 2 MB."""
    foot: float = 0.5
    """Share of a rover's reach at which the ground under it is felt for its lean."""
    step: float = 0.05
    """Time between the rows by which wheels throw dust, s."""
    most_rows: int = 20000
    """Of them: a longer drive has longer steps."""
    window: float = 1.0
    """Time over which places and wheels are averaged for that, s: a place that is off by a centimetre is no slip."""
    sure: float = 3.0
    """Slip that counts as such, in standard deviations of a measured speed."""


REPLAY_SIZES = ReplaySizes()


@dataclasses.dataclass(frozen=True, eq=False)
class Course:
    """Poses of a recorded rover over time.

    Attributes:
      label: who says so. time: (n,) s, rising. x, y: (n,) m. yaw: (n,) rad, unwrapped.
      joints: times, s, and angles, rad, of those joints of the MJCF that are known. Other wheels are drawn to roll.
      noise: standard deviation of a place, m.
    """

    label: str
    time: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray
    joints: Mapping[str, tuple[np.ndarray, np.ndarray]] = dataclasses.field(default_factory=dict)
    noise: float = 0.0


@dataclasses.dataclass(frozen=True, eq=False)
class Trace:
    """A channel of the drive, measured and predicted.

    Attributes:
      label: with its unit. time: (n,) s. measured: (n,). predicted: (models, n) in the channel's unit.
      residual: (models, n), measured less predicted, in standard deviations of the noise.
    """

    label: str
    time: np.ndarray
    measured: np.ndarray
    predicted: np.ndarray
    residual: np.ndarray


class Replay:
    """A drive that is over, to be looked at: what `Viewer` serves in place of one that goes on.

    Args:
      model: brings rover and ground. title: of the drive.
      measured: the course as measured. predicted: that of each model. traces: channels, one line for each model.
      parts: when each part of the drive begins, s, and its title, where it was put together of several.

    Attributes:
      scene: what the page plays back: times, bodies of both rovers, traces. models: how many predict the drive.
    """

    live = False

    def __init__(
        self,
        model: Model,
        title: str,
        measured: Course,
        predicted: Sequence[Course],
        traces: Sequence[Trace],
        parts: Sequence[tuple[float, str]] = (),
    ) -> None:
        self.model, self.pilot, self.rate, self.path = model, Onlooker(), 1.0, 0.0
        # Evenly, whatever the log's own times: the page plays one picture after another.
        time = np.linspace(
            measured.time[0], measured.time[-1], min(REPLAY_SIZES.frames, max(2, 10 * len(measured.time)))
        )
        stand = _Stand(model)
        self.time = float(time[-1] - time[0])
        self._measured = stand.dust(measured)
        self._models = [stand.dust(course) for course in predicted]
        self.models = len(predicted)
        self.scene: dict[str, Any] = {
            "replay": {
                "title": title,
                "parts": [{"begin": round(begin, 4), "title": name} for begin, name in parts],
                "dusty": any(dust is not None for dust in (self._measured, *self._models)),
                "time": time.round(4).tolist(),
                "measured": _packed(stand.bodies(measured, time)),
                "models": [{"label": c.label, "bodies": _packed(stand.bodies(c, time))} for c in predicted],
                "traces": [
                    {
                        "label": t.label,
                        "time": _numbers(t.time),
                        "measured": _numbers(t.measured),
                        "predicted": [_numbers(p) for p in t.predicted],
                        "residual": [_numbers(r) for r in t.residual],
                    }
                    for t in traces
                ],
            }
        }

    def reset(self) -> None:
        """Nothing: the page goes back by itself."""

    def advance(self, duration: float) -> float:
        """Simulated time that passes in a tick, s: 0, since a recorded drive is complete."""
        return 0.0

    def dust(self) -> Grains:
        """Grains to send with a picture: none, since the page asks for those of the time that it shows."""
        return none()

    def thrown(self, time: float, model: int) -> Grains:
        """What the wheels of the measured rover and of a model throw up at a time, s, of the log's clock.

        Nothing where it is not known how wheels turned, or where how they were steered is not: their slip is not known.
        """
        grains = [dust.at(time, LIVE_DUST.most) for dust in (self._measured, self._models[model]) if dust is not None]
        return Grains(*map(np.concatenate, zip(*grains, strict=True))) if grains else none()

    def bodies(self) -> np.ndarray:
        """Poses of bodies to send: none, since the page holds the whole drive."""
        return np.zeros((0, 7))

    def readings(self) -> dict[str, Any]:
        """Readings to send: none, since the page holds the whole drive."""
        return {}


class _Stand:
    """Puts a rover onto its ground at a place and heading, its wheels turned by the way that it came."""

    def __init__(self, model: Model) -> None:
        self._model, rover = model, model.rover
        self._mj = rover.compile()
        self._data = mujoco.MjData(self._mj)
        self._terrain = model.terrain
        self._height = rover.standing_height
        self._reach = REPLAY_SIZES.foot * float(np.abs(np.asarray(rover.chassis_points)[:, :2]).max())
        self._drives = {w.drive: w.radius for w in rover.wheels}
        mujoco.mj_kinematics(self._mj, self._data)
        # Where a wheel is not steered, turning moves it along its rolling by its place to the left, m.
        self._aside = {w.drive: 0.0 if w.steer else float(self._data.body(w.body).xpos[1]) for w in rover.wheels}
        self._steers = [w.steer for w in rover.wheels if w.steer is not None]

    def bodies(self, course: Course, time: np.ndarray) -> np.ndarray:
        """Place and quaternion (w, x, y, z) of every body at every time, (time, body, 7) float32."""
        out = np.empty((len(time), self._mj.nbody, 7), np.float32)
        for row, qpos in zip(out, self._coordinates(course, time, 0), strict=True):
            self._data.qpos[:] = qpos
            mujoco.mj_kinematics(self._mj, self._data)
            row[:] = np.concatenate([self._data.xpos, self._data.xquat], axis=1)
        return out

    def dust(self, course: Course) -> Dust | None:
        """The soil that its wheels throw; None where their slip is not known, or where none flies."""
        known = all(joint in course.joints for joint in (*self._drives, *self._steers))
        if not known or self._model.gravity >= SPRAY.heaviest or "hard_surface" in self._model.effect_names:
            return None
        span = float(course.time[-1] - course.time[0])
        rows = min(REPLAY_SIZES.most_rows, round(span / REPLAY_SIZES.step) + 1)
        if rows < 2:
            return None
        time = np.linspace(course.time[0], course.time[-1], rows)
        spread = round(0.5 * REPLAY_SIZES.window / (time[1] - time[0]))
        motion = wheel_motion(self._model.rover, self._coordinates(course, time, spread), self._mj)
        # The rover is put onto its ground by its middle; each wheel stands on the ground under itself.
        height, normal = ground_below(jax.device_get(self._terrain.field), motion.centre[..., 0], motion.centre[..., 1])
        motion.centre[..., 2] = height + np.array(list(self._drives.values())) / normal[..., 2]
        # Of the difference of two places a window apart.
        noise = math.sqrt(2.0) * course.noise / REPLAY_SIZES.window
        quiet = max(SPRAY.quiet, REPLAY_SIZES.sure * noise)
        return Dust(self._model.rover, self._terrain, time, motion, self._model.gravity, quiet=quiet)

    def _coordinates(self, course: Course, time: np.ndarray, spread: int) -> np.ndarray:
        """Coordinates of the MJCF at every time, (time, nq), each averaged with `spread` rows before and after it."""

        def then(when: np.ndarray, values: np.ndarray) -> np.ndarray:
            return _averaged(np.interp(time, when, values), spread)

        x, y, yaw = (then(course.time, v) for v in (course.x, course.y, course.yaw))
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        step = np.diff(np.stack([x, y], axis=-1), axis=0, prepend=[[x[0], y[0]]])
        # Along the heading and with its sign: wheels turn back where the rover backs up, and not where it slides aside.
        way = np.cumsum((step * ahead).sum(axis=-1))
        qpos = np.tile(self._mj.qpos0, (len(time), 1))
        qpos[:, :7] = self._standing(np.stack([x, y], axis=-1), ahead)
        turned = {j: (way - self._aside[j] * (yaw - yaw[0])) / radius for j, radius in self._drives.items()}
        turned |= {joint: then(*angle) for joint, angle in course.joints.items()}
        for joint, angle in turned.items():
            qpos[:, int(self._mj.joint(joint).qposadr[0])] += angle
        return qpos

    def _standing(self, place: np.ndarray, ahead: np.ndarray) -> np.ndarray:
        """Place and attitude (n, 7) of a chassis that stands on the ground about it, at places and headings (n, 2)."""
        aside = np.stack([-ahead[:, 1], ahead[:, 0]], axis=-1)
        points = place + self._reach * np.stack([ahead, -ahead, aside, -aside])
        x, y = (points[..., i].astype(np.float32) for i in range(2))
        z = np.asarray(surface(self._terrain, x, y), float)
        forward = np.column_stack([2.0 * self._reach * ahead, z[0] - z[1]])
        up = np.cross(forward, np.column_stack([2.0 * self._reach * aside, z[2] - z[3]]))
        forward, up = (v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (forward, up))
        turn = np.stack([forward, np.cross(up, forward), up], axis=-1)
        out = np.empty((len(place), 7))
        out[:, :3] = np.column_stack([place, z.mean(axis=0)]) + self._height * up
        for row, matrix in zip(out, turn, strict=True):
            mujoco.mju_mat2Quat(row[3:], matrix.ravel())
        return out


def _averaged(values: np.ndarray, spread: int) -> np.ndarray:
    """Mean of each value and `spread` ones before and after it; at its ends a course goes on as it came."""
    spread = min(spread, len(values) - 1)
    padded = np.pad(values, spread, mode="reflect", reflect_type="odd")
    return np.convolve(padded, np.full(2 * spread + 1, 1.0 / (2 * spread + 1)), "valid")


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()


def _numbers(values: np.ndarray) -> list[float | None]:
    """Numbers as JSON holds them, in five digits; None where one is missing."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in np.asarray(values, float)]
