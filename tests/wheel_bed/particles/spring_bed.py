"""A bed without particles: springs, dampers and friction under smooth wheels, solved with what the wheels yield."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


class SpringBed:
    """Answers `RoverInSand` as `MovingBed` does: implicit in the motion of each wheel alone."""

    stiffness, damping, friction = 2000.0, 150.0, 0.5

    def __init__(self, model: Any, sand: Any, gravity: Any, numerics: Any, step: float, yields: Any, device: str):
        self.step, self.yields, self.voxel = step, yields, numerics.voxel
        self.radius = [w.radius for w in model.rover.wheels]
        self.particles = 0

    def push(self, place: np.ndarray, axes: np.ndarray, velocity: np.ndarray, spin: np.ndarray):
        impulse, moment = np.zeros_like(place), np.zeros_like(place)
        dt, (light, turns) = self.step, self.yields
        for i, radius in enumerate(self.radius):
            # Softer where voxels are larger, as a numerical error.
            k = self.stiffness / (1.0 + 4.0 * self.voxel)
            gap, v = place[i, 2] - radius, velocity[i, 2]
            lift = dt * (-k * (gap + dt * v) - self.damping * v) / (1.0 + dt * light * (k * dt + self.damping))
            impulse[i, 2] = max(0.0, lift)
            arm = np.array([0.0, 0.0, -radius])
            slide = velocity[i] + np.cross(spin[i], arm)
            slide[2] = 0.0
            rub = -slide / (light + turns * radius**2)
            most = self.friction * impulse[i, 2]
            rub *= min(1.0, most / max(math.hypot(*rub), 1e-12))
            impulse[i] += rub
            moment[i] = np.cross(arm, rub)
        return impulse, moment

    def state(self) -> dict[str, np.ndarray]:
        return {}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        pass

    def surface(self) -> np.ndarray:
        return np.zeros((1, 3))
