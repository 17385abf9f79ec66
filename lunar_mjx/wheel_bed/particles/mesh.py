"""The surface of a rigid wheel as a closed triangle mesh: a cylinder about the y axis, or one with grousers."""

from __future__ import annotations

import dataclasses

import numpy as np

from lunar_mjx.wheel_bed.particles.settings import ParticleWheel


@dataclasses.dataclass(frozen=True)
class WheelMesh:
    """How finely a wheel is drawn for the particles."""

    segments: int = 128
    """Corners of a smooth rim: it is round to 0.03 % of the radius."""
    thickness: float = 0.25
    """Share of the pitch from grouser to grouser that a grouser takes (choice: thin plates fall between nodes)."""


WHEEL_MESH = WheelMesh()


def rim(wheel: ParticleWheel) -> np.ndarray:
    """Outline of the wheel in the plane of its disc, counter-clockwise, (n, 2) in m: x and z."""
    if not wheel.grouser_count:
        angle = 2.0 * np.pi * np.arange(WHEEL_MESH.segments) / WHEEL_MESH.segments
        return wheel.radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    count = wheel.grouser_count
    pitch = 2.0 * np.pi / count
    per_gap = max(4, WHEEL_MESH.segments // count)
    # A middle corner on the grouser's tip keeps it round, too.
    high = np.linspace(0.0, WHEEL_MESH.thickness * pitch, 3)
    low = np.linspace(WHEEL_MESH.thickness * pitch, pitch, per_gap + 1)
    angle = np.concatenate([high, low[:-1], [pitch]])
    radius = np.concatenate([np.full(3, wheel.radius + wheel.grouser_height), np.full(per_gap + 1, wheel.radius)])
    angles = np.concatenate([angle + k * pitch for k in range(count)])
    radii = np.tile(radius, count)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)


def wheel_mesh(wheel: ParticleWheel) -> tuple[np.ndarray, np.ndarray]:
    """Corners (n, 3) in m and triangles (k, 3) of the wheel, normals outward; its axle is the y axis."""
    outline = rim(wheel)
    n = len(outline)
    side = np.full((n, 1), 0.5 * wheel.width)
    right = np.concatenate([outline[:, :1], -side, outline[:, 1:]], axis=1)
    left = np.concatenate([outline[:, :1], side, outline[:, 1:]], axis=1)
    hubs = np.array([[0.0, -0.5 * wheel.width, 0.0], [0.0, 0.5 * wheel.width, 0.0]])
    rim_index = np.arange(n)
    next_index = (rim_index + 1) % n
    faces = np.concatenate(
        [
            np.stack([rim_index, n + rim_index, next_index], axis=1),
            np.stack([next_index, n + rim_index, n + next_index], axis=1),
            np.stack([np.full(n, 2 * n), rim_index, next_index], axis=1),
            np.stack([np.full(n, 2 * n + 1), n + next_index, n + rim_index], axis=1),
        ]
    )
    corners = np.concatenate([right, left, hubs]).astype(np.float32)
    # The order of corners decides which side is inside; the solver pushes sand to the outside.
    if volume(corners, faces) < 0.0:
        faces = faces[:, [0, 2, 1]]
    return corners, faces.astype(np.int32)


def volume(corners: np.ndarray, faces: np.ndarray) -> float:
    """Enclosed volume, m3; negative where the normals point inward."""
    a, b, c = (corners[faces[:, k]].astype(float) for k in range(3))
    # Signed tetrahedra to the origin (divergence theorem).
    return float(np.sum(a * np.cross(b, c)) / 6.0)
