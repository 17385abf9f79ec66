"""PyBullet, the seed paper's engine, with the same NumPy physics: URDF, height field, loops closed by pins.

What Bullet lacks is added outside it: springs and dampers of the joints, and the inertia that a rotor reflects through
its gear. For that a trial step tells the joints' accelerations u0 without rotors; those with rotors of inertia A follow
from (1 + W A) u = u0, where W is the inverse joint-space inertia under the loops' constraints, and the torque -A u
makes Bullet's own step yield u. Dampers enter A as dt d, which is MuJoCo's implicit Euler step.
"""

# pyright: reportMissingModuleSource=false, reportMissingImports=false, reportAttributeAccessIssue=false
# (PyBullet is a compiled module, and need not be installed where types are checked)

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np

from lunar_mjx.backends.bullet_ground import BulletGround
from lunar_mjx.backends.hooks import Hook
from lunar_mjx.backends.native import native_model
from lunar_mjx.backends.numpy_backend import NumpyBackend
from lunar_mjx.backends.physics import Context
from lunar_mjx.backends.physics.vectors import cross
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.model import Model
from lunar_mjx.rover import Rover
from lunar_mjx.toml_fields import read_toml

CONTACTS = ("numpy", "engine")


def import_pybullet() -> ModuleType:
    """The module `pybullet`.

    Raises:
      UserError: it is not installed.
    """
    try:
        with _quiet():
            import pybullet
    except ImportError:
        raise UserError(
            "pybullet: the module is not installed; install the extra lunar-mjx[pybullet] (where no wheel exists, it "
            "compiles for about 7 minutes)."
        ) from None
    return pybullet


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Holds back what Bullet's C code prints on the standard streams."""
    sys.stdout.flush()
    # File descriptors: C code knows nothing of sys.stdout.
    kept = [os.dup(1), os.dup(2)]
    void = os.open(os.devnull, os.O_WRONLY)
    try:
        for stream in (1, 2):
            os.dup2(void, stream)
        yield
    finally:
        for stream, old in zip((1, 2), kept, strict=True):
            os.dup2(old, stream)
            os.close(old)
        os.close(void)


class PyBulletBackend(NumpyBackend):
    """Bullet's multi-body dynamics in double precision; one world per rover.

    Args:
      model: the model; its effects must all be among `physics.SUPPORTED`.
      hooks: functions that change the physics.
      rovers: how many worlds.
      contact: "numpy" for the same contact as the other engines, or "engine": on rock, and everywhere with
        `penalty_contact`, Bullet's own contact of wheel and height field with that effect's stiffness, damping and
        friction, as the paper does it.

    Raises:
      UserError: PyBullet is not installed; the rover has no URDF; an effect that the NumPy physics lacks, or a payload
        or shifted centre of mass, which a loaded URDF cannot change.
    """

    name = "pybullet"

    def __init__(self, model: Model, hooks: Iterable[Hook] = (), rovers: int = 1, contact: str = "numpy") -> None:
        if contact not in CONTACTS:
            raise bad_input("pybullet", "contact", contact, "does not exist", f"use one of {', '.join(CONTACTS)}")
        # Refused, not ignored: a comparison would be of two rovers.
        heavy = [e for e in ("payload", "com_offset") if e in model.effect_names]
        if heavy:
            raise bad_input("pybullet", "effects", ", ".join(heavy), "cannot change a loaded URDF", "remove them")
        self._p: Any = import_pybullet()
        super().__init__(model, hooks, rovers)
        self._mj = native_model(model)
        self._own_contact = contact == "engine"
        if self._own_contact:
            self.name = "pybullet, own contact"
        self._worlds = [_World(self._p, model, self._mj, self._own_contact, self.ground) for _ in range(rovers)]
        w = self._worlds[0]
        self._joint_of = np.array([w.names.index(j) for j in model.rover.joints])
        self._wheel_links = [w.link_of[wheel.body] for wheel in model.rover.wheels]
        self._axles = np.array([self._mj.jnt_axis[self._mj.joint(x.drive).id] for x in model.rover.wheels])
        self.reset()

    def close(self) -> None:
        """Disconnects from PyBullet, which frees its worlds."""
        for world in self._worlds:
            world.close()
        self._worlds = []

    @property
    def _qpos0(self) -> np.ndarray:
        return np.array(self._mj.qpos0)

    def _place(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        for world, q, v in zip(self._worlds, qpos, qvel, strict=True):
            world.place(q, v)

    def _coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        per_world = [world.coordinates() for world in self._worlds]
        return np.stack([b[0] for b in per_world]), np.stack([b[1] for b in per_world])

    def _look(self, c: Context) -> None:
        rows = [world.look(self._wheel_links, self._axles) for world in self._worlds]
        for name in rows[0]:
            setattr(c, name, np.stack([row[name] for row in rows]))
        c.joint_angle, c.joint_speed = c.joint_angle[:, self._joint_of], c.joint_speed[:, self._joint_of]

    def _push(self, c: Context) -> None:
        bears = None
        if self._own_contact:
            bears = self._yield_to_engine(c)
        force, moment = self.forces.wheel_world(c)
        for i, world in enumerate(self._worlds):
            torque = np.zeros(len(world.names))
            torque[self._joint_of] = c.torque[i] + c.body["joint_torque"][i]
            loads = [
                (link, force[i, k], c.wheel_position[i, k], moment[i, k]) for k, link in enumerate(self._wheel_links)
            ]
            loads.append((-1, c.body["force"][i], c.position[i], c.body["moment"][i]))
            if bears is not None:
                world.bear(self._wheel_links, bears[i])
            world.step(torque, loads)
            if bears is not None:
                self._add_contact(c, i, world)

    def _yield_to_engine(self, c: Context) -> np.ndarray:
        """Takes normal force and friction out of the wheel forces where Bullet's contact gives them."""
        everywhere = "penalty_contact" in self.numbers
        # Where Bullet's own contact carries the wheel.
        bears = np.ones_like(c.soil["rock"], bool) if everywhere else c.soil["rock"] > 0.5
        if everywhere and "engine_friction" in self.numbers:
            kept = c.wheel["force"].copy(), c.wheel["moment"].copy()
            c.wheel = {"force": np.zeros_like(kept[0]), "moment": np.zeros_like(kept[1])}
            for function, p in self.forces.shear_functions():
                # All laws again but those that Bullet's contact stands for.
                if function.__name__ not in ("engine_friction", "rock_shear"):
                    function(c, p)
            c.wheel["force"][..., 2] -= c.normal["load"] + c.normal["damping"]
        else:
            for name in ("force", "moment"):
                c.wheel[name] = np.where(bears[..., None], 0.0, c.wheel[name])
        return bears

    def _add_contact(self, c: Context, i: int, world: _World) -> None:
        """Adds Bullet's contact force of this step to what is reported of the wheels."""
        for k, link in enumerate(self._wheel_links):
            force, moment = world.contact_force(link, c.wheel_position[i, k])
            axes = np.stack([c.contact[a][i, k] for a in ("forward", "left", "normal")])
            c.wheel["force"][i, k] += axes @ force
            c.wheel["moment"][i, k] += axes @ moment


def urdf_of(rover: Rover) -> Path:
    """The URDF that a rover was converted from.

    Raises:
      UserError: its folder holds none.
    """
    description = read_toml(rover.folder / "rover.toml")
    path = rover.folder / description.get("source", f"{rover.name}.urdf")
    if not path.is_file():
        raise bad_input(
            rover.folder,
            "source",
            path.name,
            "is not there, and PyBullet loads URDF only",
            "put the rover's URDF into its folder",
        )
    return path


class _World:
    """One rover in one Bullet world, with MuJoCo's coordinates outside."""

    def __init__(self, p: Any, model: Model, mj: Any, own_contact: bool, ground: Any) -> None:
        if (mj.eq_type == mujoco.mjtEq.mjEQ_JOINT).any():
            raise bad_input(
                "pybullet",
                "rover",
                model.rover.name,
                "has joints in a fixed ratio (a differential, a mimic, wheels behind one motor), which are not coupled "
                "in Bullet here",
                "use native, structured or mjx",
            )
        self._p, self._mj = p, mj
        self._client = p.connect(p.DIRECT)
        self._id = {"physicsClientId": self._client}
        with _quiet():
            self._body = p.loadURDF(
                str(urdf_of(model.rover)),
                useFixedBase=False,
                flags=p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_IMPLICIT_CYLINDER,
                **self._id,
            )
        p.setGravity(0.0, 0.0, -model.gravity, **self._id)
        p.setTimeStep(model.timestep, **self._id)
        # As exact as Bullet's iterations go: what differs from MuJoCo shall be the method, not its tolerance.
        p.setPhysicsEngineParameter(numSolverIterations=200, solverResidualThreshold=0.0, erp=0.8, **self._id)
        self._dt = model.timestep
        self._join(model)
        self._pins = [self._pin(loop) for loop in model.rover.loops]
        self._ground = (
            BulletGround(p, self._client, self._body, self._wheel_links, model, ground) if own_contact else None
        )

    def close(self) -> None:
        if self._p.isConnected(self._client):
            self._p.disconnect(self._client)

    def _join(self, model: Model) -> None:
        """Links and joints by name, matched with the MJCF; what Bullet would add of its own is turned off."""
        p, mj = self._p, self._mj
        infos = [p.getJointInfo(self._body, j, **self._id) for j in range(p.getNumJoints(self._body, **self._id))]
        self.link_of = {info[12].decode(): info[0] for info in infos} | {model.rover.chassis: -1}
        moving = [info for info in infos if info[2] == p.JOINT_REVOLUTE]
        self._moving = [info[0] for info in moving]
        self.names = [info[1].decode() for info in moving]
        self._wheel_links = [self.link_of[w.body] for w in model.rover.wheels]
        ids = [mj.joint(name).id for name in self.names]
        self._qadr, self._dadr = mj.jnt_qposadr[ids], mj.jnt_dofadr[ids]
        axes = np.array([info[13] for info in moving])
        turned = np.sum(axes * mj.jnt_axis[ids], axis=1)
        # Axes may be reversed (see `_sign`), but not turned.
        if np.abs(np.abs(turned) - 1.0).max() > 1e-6:
            wrong = self.names[int(np.argmax(np.abs(np.abs(turned) - 1.0)))]
            raise bad_input(
                "pybullet",
                "joint",
                wrong,
                "turns about another axis than in the rover's MJCF",
                "write the URDF with link frames parallel to the chassis",
            )
        self._sign = np.sign(turned)
        self._spring, self._rest = mj.jnt_stiffness[ids].copy(), mj.qpos_spring[self._qadr].copy()
        self._damping = mj.dof_damping[self._dadr].copy()
        # Rotors and implicit dampers in one: see the module.
        self._inertia = mj.dof_armature[self._dadr] + self._dt * self._damping
        for link in range(-1, len(infos)):
            p.changeDynamics(
                self._body,
                link,
                # Bullet's own damping of 0.04 would slow everything.
                linearDamping=0.0,
                angularDamping=0.0,
                jointDamping=0.0,
                maxJointVelocity=1e4,
                **self._id,
            )
            # No collisions of its own.
            p.setCollisionFilterGroupMask(self._body, link, 0, 0, **self._id)
        for link in self._moving:
            # Stops are an effect, the same in every engine.
            p.changeDynamics(self._body, link, jointLowerLimit=-1e9, jointUpperLimit=1e9, **self._id)
        count = len(self._moving)
        # Bullet holds every joint by a motor until told otherwise.
        p.setJointMotorControlArray(self._body, self._moving, p.VELOCITY_CONTROL, forces=[0.0] * count, **self._id)
        base = p.getDynamicsInfo(self._body, -1, **self._id)
        self._base_at, self._base_turn = np.array(base[3]), _matrix(base[4])

    def _pin(self, loop: Any) -> tuple[int, int, np.ndarray, np.ndarray]:
        """A point-to-point constraint, whose anchors Bullet takes from the links' centres of mass.

        Returns:
          The two links and the anchors in the links' frames, where Bullet's Jacobians take them from.
        """
        p = self._p
        links = [self.link_of[body] for body in (loop.body1, loop.body2)]
        anchors = []
        for link, anchor in zip(links, (loop.anchor1, loop.anchor2), strict=True):
            info = p.getDynamicsInfo(self._body, link, **self._id)
            anchors.append(_matrix(info[4]).T @ (np.array(anchor) - np.array(info[3])))
        constraint = p.createConstraint(
            self._body,
            links[0],
            self._body,
            links[1],
            p.JOINT_POINT2POINT,
            [0, 0, 0],
            anchors[0].tolist(),
            anchors[1].tolist(),
            **self._id,
        )
        # Far beyond any force in a loop.
        p.changeConstraint(constraint, maxForce=1e9, **self._id)
        return links[0], links[1], np.array(loop.anchor1), np.array(loop.anchor2)

    def place(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        p = self._p
        # Bullet's quaternions have w last.
        turn = _matrix(qpos[[4, 5, 6, 3]])
        arm = turn @ self._base_at
        # MuJoCo gives a free body's angular velocity in its own axes.
        spin = turn @ qvel[3:6]
        orientation = _quaternion(turn @ self._base_turn)
        p.resetBasePositionAndOrientation(self._body, (qpos[:3] + arm).tolist(), orientation, **self._id)
        p.resetBaseVelocity(self._body, (qvel[:3] + cross(spin, arm)).tolist(), spin.tolist(), **self._id)
        angle, speed = self._sign * qpos[self._qadr], self._sign * qvel[self._dadr]
        p.resetJointStatesMultiDof(
            self._body, self._moving, angle[:, None].tolist(), speed[:, None].tolist(), **self._id
        )

    def coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        position, turn, velocity, spin = self._base()
        states = self._p.getJointStates(self._body, self._moving, **self._id)
        qpos, qvel = np.array(self._mj.qpos0), np.zeros(self._mj.nv)
        qpos[:3], qpos[3:7] = position, np.array(_quaternion(turn))[[3, 0, 1, 2]]
        qvel[:3], qvel[3:6] = velocity, turn.T @ spin
        qpos[self._qadr] = self._sign * [s[0] for s in states]
        qvel[self._dadr] = self._sign * [s[1] for s in states]
        return qpos, qvel

    def _base(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Position, rotation, velocity and spin of the chassis frame."""
        at, orientation = self._p.getBasePositionAndOrientation(self._body, **self._id)
        velocity, spin = (np.array(v) for v in self._p.getBaseVelocity(self._body, **self._id))
        turn = _matrix(orientation) @ self._base_turn.T
        arm = turn @ self._base_at
        return np.array(at) - arm, turn, velocity - cross(spin, arm), spin

    def look(self, wheels: list[int], axles: np.ndarray) -> dict[str, np.ndarray]:
        p = self._p
        position, turn, velocity, spin = self._base()
        states = p.getJointStates(self._body, self._moving, **self._id)
        links = p.getLinkStates(self._body, wheels, computeLinkVelocity=1, computeForwardKinematics=1, **self._id)
        # from the centres of mass: Bullet reckons link frames in the world in float32 (6e-8 m at 1 m from the origin)
        center = np.array([link[0] for link in links])
        turned = np.stack([_matrix(link[1]) @ _matrix(link[3]).T for link in links])
        place = center - np.einsum("wij,wj->wi", turned, np.array([link[2] for link in links]))
        wheel_spin = np.array([link[7] for link in links])
        return {
            "position": position,
            "rotation": turn,
            "quaternion": np.array(_quaternion(turn))[[3, 0, 1, 2]],
            "velocity": velocity,
            "angular_velocity": spin,
            "wheel_position": place,
            "wheel_axle": np.einsum("wij,wj->wi", turned, axles),
            "wheel_velocity": np.array([link[6] for link in links]) + cross(wheel_spin, place - center),
            "wheel_angular_velocity": wheel_spin,
            "joint_angle": self._sign * [s[0] for s in states],
            "joint_speed": self._sign * [s[1] for s in states],
        }

    def step(self, torque: np.ndarray, loads: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]) -> None:
        """One step under motor torques (moving joint,) and loads (link, force, point, moment) in world coordinates."""
        qpos, qvel = self.coordinates()
        angle, speed = qpos[self._qadr], qvel[self._dadr]
        passive = -self._spring * (angle - self._rest) - self._damping * speed
        # The trial step: its accelerations are those of a rover without rotors and dampers.
        self._drive(torque + passive, loads)
        free_acceleration = (self.coordinates()[1][self._dadr] - speed) / self._dt
        # Taken back: the world must begin the real step where the trial began.
        self.place(qpos, qvel)
        response = self._response(self._sign * angle)
        rotors = np.linalg.solve(np.eye(len(angle)) + response * self._inertia, free_acceleration)
        self._drive(torque + passive - self._inertia * rotors, loads)

    def _drive(self, torque: np.ndarray, loads: list[tuple[int, np.ndarray, np.ndarray, np.ndarray]]) -> None:
        p = self._p
        for link, force, point, moment in loads:
            if force.any():
                p.applyExternalForce(self._body, link, force.tolist(), point.tolist(), p.WORLD_FRAME, **self._id)
            if moment.any():
                p.applyExternalTorque(self._body, link, moment.tolist(), p.WORLD_FRAME, **self._id)
        p.setJointMotorControlArray(
            self._body, self._moving, p.TORQUE_CONTROL, forces=(self._sign * torque).tolist(), **self._id
        )
        p.stepSimulation(**self._id)

    def _response(self, angle: np.ndarray) -> np.ndarray:
        """Acceleration of the joints per unit of torque at each, in MuJoCo's signs, loops held."""
        p, q = self._p, angle.tolist()
        inverse = np.linalg.inv(np.array(p.calculateMassMatrix(self._body, q, **self._id)))
        if self._pins:
            still = [0.0] * len(q)
            rows = []
            for first, second, on_first, on_second in self._pins:
                one, two = (
                    np.array(p.calculateJacobian(self._body, link, at.tolist(), q, still, still, **self._id)[0])
                    for link, at in ((first, on_first), (second, on_second))
                )
                rows.append(one - two)
            loops = np.concatenate(rows)
            # Motions that would open a loop are projected out; a planar pin holds two directions, hence the pseudo-
            # inverse.
            inverse = inverse - inverse @ loops.T @ np.linalg.pinv(loops @ inverse @ loops.T, 1e-9) @ loops @ inverse
        return self._sign[:, None] * inverse[6:, 6:] * self._sign

    def bear(self, wheels: list[int], bears: np.ndarray) -> None:
        """Lets Bullet's contact bear the given wheels."""
        assert self._ground is not None
        self._ground.bear(wheels, bears)

    def contact_force(self, link: int, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Force and moment about the wheel's centre of Bullet's contact in the last step, world coordinates."""
        assert self._ground is not None
        return self._ground.force(link, center)


def _matrix(quaternion: Any) -> np.ndarray:
    """Rotation matrix of x, y, z, w."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def _quaternion(matrix: np.ndarray) -> list[float]:
    """x, y, z, w of a rotation matrix, by the largest of the four components."""
    m = matrix
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    # The largest component is divided by: any other may be zero for some rotation.
    k = int(np.argmax(squares))
    if k == 3:
        q = [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]]
    else:
        i, j = (k + 1) % 3, (k + 2) % 3
        q = [0.0] * 4
        q[k], q[i], q[j], q[3] = squares[k], m[k, i] + m[i, k], m[k, j] + m[j, k], m[j, i] - m[i, j]
    return (np.array(q) / np.linalg.norm(q)).tolist()
