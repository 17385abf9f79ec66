"""A measured drive beside what a model predicts of it: two rovers on one ground, for a page that plays them back."""

from __future__ import annotations

import base64
import dataclasses
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.cameras.dust.grains import Grains
from lunar_mjx.cameras.dust.recorded import none
from lunar_mjx.model import Model
from lunar_mjx.terrain import surface
from lunar_mjx.viewer.pilot import Onlooker


@dataclasses.dataclass(frozen=True)
class ReplaySizes:
    """How a drive is shown again."""

    frames: int = 600
    """Pictures of a drive: one of ten minutes moves once a second, and a page of it stays below 2 MB."""
    foot: float = 0.5
    """Share of a rover's reach at which the ground under it is felt for its lean."""


REPLAY_SIZES = ReplaySizes()


@dataclasses.dataclass(frozen=True, eq=False)
class Course:
    """Poses of a recorded rover over time.

    Attributes:
      label: who says so. time: (n,) s, rising. x, y: (n,) m. yaw: (n,) rad, unwrapped.
    """

    label: str
    time: np.ndarray
    x: np.ndarray
    y: np.ndarray
    yaw: np.ndarray


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

    Attributes:
      scene: what the page plays back: times, bodies of both rovers, traces.
    """

    live = False

    def __init__(
        self, model: Model, title: str, measured: Course, predicted: Sequence[Course], traces: Sequence[Trace]
    ) -> None:
        self.model, self.pilot, self.rate, self.path = model, Onlooker(), 1.0, 0.0
        # Evenly, whatever the log's own times: the page plays one picture after another.
        time = np.linspace(
            measured.time[0], measured.time[-1], min(REPLAY_SIZES.frames, max(2, 10 * len(measured.time)))
        )
        stand = _Stand(model)
        self.time = float(time[-1] - time[0])
        self.scene: dict[str, Any] = {
            "replay": {
                "title": title,
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
        """Grains to send: none, since the wheels of a replay are drawn to roll, and how they slipped is not known."""
        return none()

    def bodies(self) -> np.ndarray:
        """Poses of bodies to send: none, since the page holds the whole drive."""
        return np.zeros((0, 7))

    def readings(self) -> dict[str, Any]:
        """Readings to send: none, since the page holds the whole drive."""
        return {}


class _Stand:
    """Puts a rover onto its ground at a place and heading, its wheels turned by the way that it came."""

    def __init__(self, model: Model) -> None:
        rover = model.rover
        self._mj = rover.compile()
        self._data = mujoco.MjData(self._mj)
        self._terrain = model.terrain
        self._height = rover.standing_height
        self._reach = REPLAY_SIZES.foot * float(np.abs(np.asarray(rover.chassis_points)[:, :2]).max())
        self._wheels = [(int(self._mj.joint(w.drive).qposadr[0]), w.radius) for w in rover.wheels]

    def bodies(self, course: Course, time: np.ndarray) -> np.ndarray:
        """Place and quaternion (w, x, y, z) of every body at every time, (time, body, 7) float32."""
        x, y, yaw = (np.interp(time, course.time, v) for v in (course.x, course.y, course.yaw))
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=-1)
        step = np.diff(np.stack([x, y], axis=-1), axis=0, prepend=[[x[0], y[0]]])
        # Along the heading and with its sign: wheels turn back where the rover backs up, and not where it slides aside.
        way = np.cumsum((step * ahead).sum(axis=-1))
        frames = self._standing(np.stack([x, y], axis=-1), ahead)
        out = np.empty((len(time), self._mj.nbody, 7), np.float32)
        for i in range(len(time)):
            qpos = self._mj.qpos0.copy()
            qpos[:7] = frames[i]
            for joint, radius in self._wheels:
                qpos[joint] += way[i] / radius
            self._data.qpos[:] = qpos
            mujoco.mj_kinematics(self._mj, self._data)
            out[i] = np.concatenate([self._data.xpos, self._data.xquat], axis=1)
        return out

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


def _packed(values: np.ndarray) -> str:
    return base64.b64encode(np.ascontiguousarray(values, "<f4").tobytes()).decode()


def _numbers(values: np.ndarray) -> list[float | None]:
    """Numbers as JSON holds them, in five digits; None where one is missing."""
    return [float(f"{v:.5g}") if np.isfinite(v) else None for v in np.asarray(values, float)]
