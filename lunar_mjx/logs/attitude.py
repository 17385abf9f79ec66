"""The attitude that a log tells: Euler angles of the chassis, also where it holds quaternions or a tilted IMU's."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from lunar_mjx.logs.log import Imu, LogTable, Noise

EULER = ("roll_deg", "pitch_deg", "yaw_deg")
QUATERNION = tuple(f"quaternion_{c}" for c in "wxyz")


def body_attitude(tables: Mapping[str, LogTable], imu: Imu) -> dict[str, LogTable]:
    """Tables whose attitude channels are the chassis's, and hold Euler angles wherever they hold a quaternion.

    A log with quaternions only gets `roll_deg`, `pitch_deg` and `yaw_deg`, so that everything that reads angles reads
    it. Where `imu.attitude` says that the angles are the IMU's own, the mounting is taken off: R_body = R_imu R(q)^T.

    Args:
      tables: as read. imu: how the IMU is mounted.
    """
    known = {c for t in tables.values() for c in t.channels}
    out = {}
    for name, table in tables.items():
        channels = dict(table.channels)
        # R_body = R_imu R(q)^T: the mounting acts on the body's side, so it is multiplied from the right.
        mounted = _mounting(imu).inv() if imu.attitude else Rotation.identity()
        if all(q in channels for q in QUATERNION):
            there, turned = _of_quaternion(channels)
            turned = turned * mounted
            if imu.attitude:
                size = np.sqrt(sum(channels[q][there] ** 2 for q in QUATERNION))
                # With the norm as logged, so that the check of norms still sees what was written.
                channels |= _filled(QUATERNION, (turned.as_quat(scalar_first=True) * size[:, None]).T, there)
            # Angles that were logged beside the quaternion stay as logged: they are measurements of their own.
            if not any(e in known for e in EULER):
                channels |= _filled(EULER, turned.as_euler("ZYX", degrees=True).T[::-1], there)
        if imu.attitude and all(e in table.channels for e in EULER[:2]):
            there, turned = _of_angles(channels)
            angles = _filled(EULER, (turned * mounted).as_euler("ZYX", degrees=True).T[::-1], there)
            channels |= {e: v for e, v in angles.items() if e in channels}
        out[name] = dataclasses.replace(table, channels=channels)
    return out


def _of_quaternion(channels: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Rotation]:
    parts = np.stack([channels[q] for q in QUATERNION], axis=1)
    # Rows of zeros are what some drivers write before their first fix.
    known = np.isfinite(parts).all(axis=1) & (np.linalg.norm(np.nan_to_num(parts), axis=1) > 1e-6)
    return known, Rotation.from_quat(parts[known], scalar_first=True)


def _of_angles(channels: Mapping[str, np.ndarray]) -> tuple[np.ndarray, Rotation]:
    roll, pitch = (channels[e] for e in EULER[:2])
    # Roll and pitch alone still tell the vertical.
    yaw = channels.get(EULER[2], np.zeros(len(roll)))
    known = np.isfinite(roll) & np.isfinite(pitch) & np.isfinite(yaw)
    angles = np.stack([yaw, pitch, roll], axis=1)[known]
    return known, Rotation.from_euler("ZYX", angles, degrees=True)


def _mounting(imu: Imu) -> Rotation:
    return Rotation.from_quat(imu.quaternion, scalar_first=True)


def _filled(names: Sequence[str], values: np.ndarray, there: np.ndarray) -> dict[str, np.ndarray]:
    """Series by name with values (names, k) at the k rows that are `there`, and gaps elsewhere."""
    out = {name: np.full(len(there), np.nan) for name in names}
    for name, row in zip(names, values, strict=True):
        out[name][there] = row
    return out


def with_angles(noise: Mapping[str, Noise], channels: Sequence[str]) -> dict[str, Noise]:
    """Noise of angles that come from a quaternion: a small turn changes its components by half its angle."""
    out = dict(noise)
    parts = [noise[q] for q in QUATERNION if q in noise]
    if parts and all(q in channels for q in QUATERNION):
        largest = max(parts, key=lambda n: n.std)
        # The largest of the four: which component tells a turn depends on the attitude.
        angle = dataclasses.replace(largest, std=float(np.degrees(2.0 * largest.std)))
        for name in EULER:
            if name in channels:
                out.setdefault(name, angle)
    return out
