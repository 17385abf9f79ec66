"""A rover on sand that is simulated beside it: MuJoCo moves the rover, the sand answers its wheels with impulses.

The two are coupled once in a step of the sand, which is some steps of MuJoCo. MuJoCo goes ahead with the forces of the
step before and tells how the wheels would move. The sand is solved with wheels that give way to what is new in its
impulses as a mass and an inertia about the axle would. MuJoCo is set back and makes the step with the new forces. In a
steady state the old impulses are the new ones, and sand and rover agree on the motion whatever the mass.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from lunar_mjx.backends.base import Observation
from lunar_mjx.backends.hooks import Hook
from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.backends.physics import Context, Ground
from lunar_mjx.backends.physics.vectors import cross
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model
from lunar_mjx.terrain import Terrain

PROBE = 0.1
"""Force by which a wheel is pushed to learn how the rover yields, over the wheel's weight: small, so that no motor
reaches its limit (choice)."""


class Bed(Protocol):
    """What answers wheels: `wheel_bed.particles.moving_bed.MovingBed`, or something simpler in a test."""

    def push(
        self, place: np.ndarray, axes: np.ndarray, velocity: np.ndarray, spin: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Impulses (w, 3) on wheels and their moments about the centres, of one step; all in the bed's frame."""
        ...


@dataclasses.dataclass(frozen=True)
class Plane:
    """Frame of a plane of sand: origin (3,) in the world, m, and axes as columns (3, 3), the third one its normal."""

    origin: np.ndarray
    axes: np.ndarray

    def into(self, vectors: np.ndarray) -> np.ndarray:
        """World vectors (..., 3) in the plane's frame."""
        return vectors @ self.axes

    def out(self, vectors: np.ndarray) -> np.ndarray:
        """The plane's vectors (..., 3) in the world."""
        return vectors @ self.axes.T


def plane_of(terrain: Terrain, x: float, y: float) -> Plane:
    """The plane that a terrain is, with its origin at x, y, m.

    Raises:
      UserError: the terrain is no plane, or has boulders.
    """
    field = Ground(terrain).field
    at = field.x0 + field.cell * np.arange(field.cols), field.y0 + field.cell * np.arange(field.rows)
    height, slope_x, slope_y, _ = (float(v[0]) for v in field.value(np.array([x]), np.array([y])))
    flat = height + slope_x * (at[0] - x)[None] + slope_y * (at[1] - y)[:, None]
    if np.abs(field.flat.reshape(flat.shape) - flat).max() > 1e-3 or terrain.rocks is not None:
        raise bad_input("particles", "terrain", terrain.name, "is no plane", "use flat or slope:5deg")
    normal = np.array([-slope_x, -slope_y, 1.0])
    ahead = np.array([1.0, 0.0, slope_x])
    axes = [ahead / np.linalg.norm(ahead), np.zeros(3), normal / np.linalg.norm(normal)]
    axes[1] = np.cross(axes[2], axes[0])
    return Plane(np.array([x, y, height]), np.stack(axes, axis=1))


@dataclasses.dataclass
class Balance:
    """Sums over a drive, in N s: the rover's change of momentum and what gravity and the wheels gave it.

    Attributes:
      wheels: impulse of the sand on the wheels, world, (3,). gravity: (3,). change: of the rover's momentum, (3,).
      disagreement: sum of squares of the difference in speed between wheels in sand and in MuJoCo, over wheels and
        steps, m2/s2; steps: of the sand.
    """

    wheels: np.ndarray
    gravity: np.ndarray
    change: np.ndarray
    disagreement: float = 0.0
    steps: int = 0

    @property
    def error(self) -> np.ndarray:
        """What is left of the balance, (3,), over gravity's impulse: zero but for MuJoCo's own error."""
        return (self.change - self.wheels - self.gravity) / max(float(np.linalg.norm(self.gravity)), 1e-30)


class RoverInSand(NativeBackend):
    """Native MuJoCo whose wheels get the impulses of a bed instead of a soil law's forces; one rover.

    Args:
      model: of a rover on a plane; effects on soil and wheel forces have no say.
      substeps: time steps of the model in one step of the bed.
    """

    name = "native in sand"

    def __init__(self, model: Model, substeps: int) -> None:
        self.substeps, wheels = substeps, len(model.rover.wheels)
        self._force, self._moment = np.zeros((wheels, 3)), np.zeros((wheels, 3))
        self._borne = 0.0
        self.bed: Bed | None = None
        super().__init__(model, [Hook("sand", {"shear": self._wheel_forces, "body": self._crane})])

    @property
    def bed_step(self) -> float:
        """Time step of the bed, s."""
        return self.substeps * self.model.timestep

    def _wheel_forces(self, c: Context, _: dict[str, Any], wheel: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """The impulses of the step as constant forces, N, N m, in the frame of each wheel."""
        frame = np.stack([c.contact[k] for k in ("forward", "left", "normal")], axis=-2)[0]
        wheel["force"] = np.einsum("wij,wj->wi", frame, self._force)[None]
        wheel["moment"] = np.einsum("wij,wj->wi", frame, self._moment)[None]
        return wheel

    def _crane(self, c: Context, _: dict[str, Any], body: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        """A force in the rover's centre of mass that bears a part of its weight while it is set down."""
        if self._borne:
            centre = self._seen["subtree_com"][:, self._chassis]
            force = np.array([[0.0, 0.0, self._borne * self.weight]])
            body["force"] = body["force"] + force
            body["moment"] = body["moment"] + cross(centre - c.position, force)
        return body

    @property
    def weight(self) -> float:
        """Weight of the rover, N."""
        return float(self._mj.body_subtreemass[self._chassis]) * self.model.gravity

    def place_above(self, plane: Plane, x: float, y: float, yaw: float, clearance: float) -> None:
        """Puts the rover at rest above the plane, its wheels clear of it by `clearance`, m."""
        self.reset(x, y, yaw)
        state = self.state()
        state.qpos[:, :3] += clearance * plane.axes[:, 2]
        self.set_state(state)
        self.plane = plane

    def wheel_forces(self) -> np.ndarray:
        """Forces and moments of the last step of the bed on the wheels, world, (2, w, 3), N and N m."""
        return np.stack([self._force, self._moment])

    def set_wheel_forces(self, forces: np.ndarray) -> None:
        """Takes what `wheel_forces` gave as the last step's."""
        self._force, self._moment = forces.copy()

    def mobility(self) -> tuple[float, float]:
        """1/mass, 1/kg, and 1/inertia about the axle, 1/(kg m2), as which a wheel shall yield to new impulses.

        A rover yields less than a wheel pushed alone, and more where all wheels are pushed together; joints and motors
        have their part. So every wheel is pushed at its lowest point in three directions for one step of the bed. The
        pair returned is the least multiple of (weight borne, drive) by which no pattern of pushes moves the rover more:
        the remainder that lags a step then dies away.
        """
        wheels, start = len(self._force), self.state()
        radius = np.array([w.radius for w in self.model.rover.wheels])
        push = PROBE * self.weight / wheels
        still = self._yield(start, np.zeros((wheels, 3)), radius)
        columns = []
        for k in range(3 * wheels):
            forces = np.zeros((wheels, 3))
            forces[k // 3, k % 3] = push
            columns.append((self._yield(start, forces, radius) - still).ravel() / (push * self.bed_step))
        response = np.stack(columns, axis=1)
        response = 0.5 * (response + response.T)
        by_weight = wheels * self.model.gravity / self.weight
        along = np.diag(response)[::3]
        # What a push along the rim moves more than the weight borne would: the drive turns.
        turn = float(np.max(np.maximum(along - by_weight, 0.0) / radius**2))
        own = np.tile([by_weight, by_weight, by_weight], wheels)
        own[::3] += turn * radius**2
        largest = float(np.linalg.eigvalsh(response / np.sqrt(own[:, None] * own[None])).max())
        self._force[:], self._moment[:] = 0.0, 0.0
        self.set_state(start)
        return max(largest, 1.0) * by_weight, max(largest, 1.0) * turn

    def _yield(self, start: Any, forces: np.ndarray, radius: np.ndarray) -> np.ndarray:
        """Velocities (w, 3), m/s, of the wheels' lowest points, along their headings, to their left and up, after one
        step of the bed with forces there, (w, 3), N, in these directions."""
        self.set_state(start)
        c = Context(1)
        self._look(c)
        up = np.broadcast_to(self.plane.axes[:, 2], forces.shape)
        ahead = np.cross(c.wheel_axle[0], up)
        ahead /= np.linalg.norm(ahead, axis=1, keepdims=True)
        frame = np.stack([ahead, np.cross(up, ahead), up], axis=1)
        arm = -radius[:, None] * up
        self._force = np.einsum("wij,wi->wj", frame, forces)
        self._moment = np.cross(arm, self._force)
        for _ in range(self.substeps):
            self.step(np.zeros(len(self.model.rover.joints)))
        self._look(c)
        return np.einsum("wij,wj->wi", frame, c.wheel_velocity[0] + np.cross(c.wheel_angular_velocity[0], arm))

    def advance(
        self,
        controls: np.ndarray,
        mobility: tuple[float, float],
        borne: float,
        balance: Balance,
        seen: Callable[[int, Observation], None],
    ) -> None:
        """One step of the bed.

        Args:
          controls: of its time steps, (substeps, joint).
          mobility: that the bed gives the wheels.
          borne: share of the weight that a crane bears meanwhile.
          balance: to which the step is added.
          seen: called with the number of each time step and what it saw.
        """
        assert self.bed is not None
        before, at, after = self.state(), Context(1), Context(1)
        self._look(at)
        axes = self._seen["xmat"].take(self._wheels, 1).reshape(-1, 3, 3).copy()
        momentum = self._momentum()
        self._borne = borne
        for control in controls:
            self.step(control)
        self._look(after)
        plane, dt = self.plane, self.bed_step
        axle = axes[..., 1]
        # Without the impulses that the wheels answer to in the bed's own solution.
        velocity = after.wheel_velocity[0] - mobility[0] * dt * self._force
        about = np.sum(self._moment * axle, axis=1, keepdims=True)
        spin = after.wheel_angular_velocity[0] - mobility[1] * dt * about * axle
        impulse, moment = self.bed.push(
            plane.into(at.wheel_position[0] - plane.origin),
            np.einsum("ji,wjk->wik", plane.axes, axes),
            plane.into(velocity),
            plane.into(spin),
        )
        self._force, self._moment = plane.out(impulse) / dt, plane.out(moment) / dt
        in_bed = velocity + mobility[0] * dt * self._force
        self.set_state(before)
        for k, control in enumerate(controls):
            self.step(control)
            seen(k, self.observe())
        self._look(after)
        balance.disagreement += float(np.mean(np.sum((after.wheel_velocity[0] - in_bed) ** 2, axis=-1)))
        balance.steps += 1
        balance.wheels += plane.out(impulse).sum(axis=0)
        balance.gravity[2] -= (1.0 - borne) * self.weight * dt
        balance.change += self._momentum() - momentum
        if not np.isfinite(self._qpos).all():
            raise FloatingPointError(f"the rover's place is not finite after step {balance.steps} of the sand")

    def _momentum(self) -> np.ndarray:
        """Momentum of the whole rover, (3,), N s."""
        twist = self._seen["cvel"][0]
        middle = self._seen["xipos"][0] - self._seen["subtree_com"][0, self._chassis]
        velocity = twist[:, 3:] + np.cross(twist[:, :3], middle)
        return np.sum(np.asarray(self._mj.body_mass)[:, None] * velocity, axis=0)
