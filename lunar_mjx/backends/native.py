"""Native MuJoCo (C, float64, Euler) with the NumPy physics: the reference, and the generator of hidden effects.

MuJoCo steps all rovers of a backend in one call, on as many threads as asked for; the forces between two calls are
NumPy over (rover, wheel) arrays on one thread. Four-bar loops are MuJoCo's equality constraints.
"""

from __future__ import annotations

from collections.abc import Iterable

import mujoco
import numpy as np
from mujoco import batch as mujoco_batch

from lunar_mjx.backends.hooks import Hook
from lunar_mjx.backends.numpy_backend import NumpyBackend
from lunar_mjx.backends.physics import Context
from lunar_mjx.backends.physics.vectors import cross
from lunar_mjx.model import Model

_DERIVED = ("xpos", "xquat", "xmat", "xipos", "cvel", "subtree_com")
_BODY_FIELDS = ("body_mass", "body_inertia", "body_ipos", "body_iquat", "body_subtreemass")


class NativeBackend(NumpyBackend):
    """Native MuJoCo in double precision.

    Args:
      model: the model; its effects must all be among `physics.SUPPORTED`.
      hooks: functions that change the physics (hidden effects).
      rovers: how many to drive at once, on one terrain.
      threads: of MuJoCo; the forces are computed on one thread.
      damped_within: whether joints are damped implicitly before the loops' forces are solved for, as in the other
        engines, and not after it, as MuJoCo does; without loops it is the same.

    Raises:
      UserError: an effect that the NumPy physics does not implement.
    """

    name = "native"

    def __init__(
        self, model: Model, hooks: Iterable[Hook] = (), rovers: int = 1, threads: int = 1, damped_within: bool = False
    ) -> None:
        super().__init__(model, hooks, rovers)
        m = self._mj = native_model(model)
        if damped_within:  # M + dt D in place of M, so that MuJoCo's own addition must go
            # Euler's step with implicit damping has M + dt D; added to the inertia, the loops' forces see it, too.
            m.dof_armature += model.timestep * m.dof_damping
            m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
        self._wheels = np.array([m.body(w.body).id for w in model.rover.wheels])
        self._axles = np.array([m.jnt_axis[m.joint(w.drive).id] for w in model.rover.wheels])
        self._chassis = m.body(model.rover.chassis).id
        joints = [m.joint(j).id for j in model.rover.joints]
        self._qadr, self._dadr = m.jnt_qposadr[joints], m.jnt_dofadr[joints]
        self._bodies = np.concatenate([[self._chassis], self._wheels])
        # One call steps all rovers: a loop in Python would cost more than the physics.
        self._batch = mujoco_batch.Batch(m, nsim=rovers, nthread=threads, persistent=True)
        self._qpos, self._qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        self._xfrc, self._qfrc = self._batch.bind("xfrc_applied"), self._batch.bind("qfrc_applied")
        # Views of MuJoCo's own memory: read in every step without a copy.
        self._seen = {name: self._batch.bind(name) for name in _DERIVED}
        # Wheels whose centre of mass is their centre need no moment for the shift, the usual case.
        self._at_rim = not m.body_ipos[self._wheels].any()
        self._carried = np.zeros((rovers, 7))
        self._fields: dict[str, np.ndarray] = {}
        self._impedance: np.ndarray | None = None
        self._drawn_inertia = _inertia(m, self._chassis)
        self.reset()

    @property
    def _qpos0(self) -> np.ndarray:
        return np.array(self._mj.qpos0)

    def _place(self, qpos: np.ndarray, qvel: np.ndarray) -> None:
        self._qpos[:], self._qvel[:] = qpos, qvel
        # Forces of the drive before would act in the first step.
        self._xfrc[:], self._qfrc[:] = 0.0, 0.0
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def _coordinates(self) -> tuple[np.ndarray, np.ndarray]:
        return np.array(self._qpos), np.array(self._qvel)

    def _look(self, c: Context) -> None:
        seen, bodies = self._seen, self._bodies
        place, twist = seen["xpos"].take(bodies, 1), seen["cvel"].take(bodies, 1)
        spin = twist[..., :3]
        # cvel is taken at the centre of mass of the whole tree
        velocity = twist[..., 3:] + cross(spin, place - seen["subtree_com"][:, self._chassis, None])
        c.position, c.wheel_position = place[:, 0], place[:, 1:]
        c.velocity, c.wheel_velocity = velocity[:, 0], velocity[:, 1:]
        c.angular_velocity, c.wheel_angular_velocity = spin[:, 0], spin[:, 1:]
        c.quaternion = seen["xquat"][:, self._chassis].copy()
        turned = seen["xmat"].take(bodies, 1).reshape(self.rovers, -1, 3, 3)
        c.rotation = turned[:, 0]
        c.wheel_axle = np.matmul(turned[:, 1:], self._axles[..., None])[..., 0]
        c.joint_angle, c.joint_speed = self._qpos.take(self._qadr, 1), self._qvel.take(self._dadr, 1)

    def soften_loops(self, rover: int, share: float) -> None:
        """Gives one rover's loops `share` times the compliance that its MJCF gives them."""
        if self._impedance is None:
            self._impedance = self._batch.expand("eq_solimp")
        assert self._impedance is not None
        impedance = self._impedance[rover, :, :2]
        # MuJoCo's impedance d means a compliance of (1 - d)/d.
        impedance[:] = 1.0 / (1.0 + share * (1.0 / impedance - 1.0))

    def _push(self, c: Context) -> None:
        self._carry(c)
        force, moment = self.forces.wheel_world(c)
        if not self._at_rim:
            # MuJoCo applies forces at the centre of mass.
            moment = moment + cross(c.wheel_position - self._seen["xipos"].take(self._wheels, 1), force)
        self._xfrc[:, self._wheels, :3] = force
        self._xfrc[:, self._wheels, 3:] = moment
        body = c.body
        arm = c.position - self._seen["xipos"][:, self._chassis]
        self._xfrc[:, self._chassis, :3] = body["force"]
        self._xfrc[:, self._chassis, 3:] = body["moment"] + cross(arm, body["force"])
        self._qfrc[:, self._dadr] = c.torque + body["joint_torque"]
        # What depends on positions and velocities is known since the last look, and is not computed again.
        self._batch.step(stage=mujoco.mjtStage.mjSTAGE_VEL)

    def _carry(self, c: Context) -> None:
        """Gives the chassis its payload and shifted centre of mass, where they changed."""
        g = c.geometry
        if not (g["payload_mass"].any() or g["com_offset"].any() or self._carried.any()):
            return
        carried = np.concatenate([g["payload_mass"][:, None], g["payload_position"], g["com_offset"]], axis=1)
        # Payloads change seldom; setting inertias row by row is slow.
        if np.array_equal(carried, self._carried):
            return
        if not self._fields:
            self._fields = {name: self._batch.expand(name) for name in _BODY_FIELDS}
        self._carried = carried
        fields, b = self._fields, self._chassis
        for i, row in enumerate(carried):
            mass, center, moments, quaternion = _combined(self._drawn_inertia, row)
            # MuJoCo keeps the sums of masses below each body, and does not renew them itself.
            fields["body_subtreemass"][i, : b + 1] += mass - fields["body_mass"][i, b]
            fields["body_mass"][i, b], fields["body_ipos"][i, b] = mass, center
            fields["body_inertia"][i, b], fields["body_iquat"][i, b] = moments, quaternion
        self._batch.forward(stage=mujoco.mjtStage.mjSTAGE_VEL)


def native_model(model: Model) -> mujoco.MjModel:
    """The rover's MJCF with the model's gravity, time step and rotor inertia; every constraint is an equality."""
    m = model.rover.compile()
    m.opt.timestep = model.timestep
    m.opt.gravity[:] = 0.0, 0.0, -model.gravity
    # the problem is quadratic: one Newton iteration is exact, and starting it warm changes nothing
    m.opt.solver, m.opt.iterations, m.opt.ls_iterations = mujoco.mjtSolver.mjSOL_NEWTON, 1, 1
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART
    # a run that diverges must be told, not begun anew
    m.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    chassis = m.body(model.rover.chassis).id
    m.body_sameframe[chassis] = 0  # its centre of mass may move
    if "motor" in model.effect_names:
        motor = model.parameters["motor"]
        dofs = [int(m.jnt_dofadr[m.joint(j).id]) for j in model.rover.joints]
        # The model's motor, not the MJCF's: a preset may state another gear.
        m.dof_armature[dofs] = np.asarray(motor["rotor_inertia"]) * np.asarray(motor["gear_ratio"]) ** 2
    return m


def close_loops(model: Model, qpos: np.ndarray, qvel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """States (rover, nq), (rover, nv) with their loops closed to rounding, by the least change of angles and speeds."""
    m = native_model(model)
    m.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    d = mujoco.MjData(m)
    qpos, qvel = qpos.copy(), qvel.copy()
    for q, v in zip(qpos, qvel, strict=True):
        for _ in range(6):  # Newton, from loops that are open by micrometres
            jacobian = _loops_at(m, d, q, v)[:, 6:]
            # a pin holds two directions of a planar loop: the third row is nil
            # The least change (pseudo-inverse) of the joints alone; the base stays.
            q[7:] -= np.linalg.pinv(jacobian, 1e-8) @ d.efc_pos
        jacobian = _loops_at(m, d, q, v)
        # Speeds are taken off what would open the loops.
        v[6:] -= np.linalg.pinv(jacobian[:, 6:], 1e-8) @ (jacobian @ v)
    return qpos, qvel


def _loops_at(m: mujoco.MjModel, d: mujoco.MjData, qpos: np.ndarray, qvel: np.ndarray) -> np.ndarray:
    """Jacobian of the loops' constraints at a state, (rows, nv); how far they are open is left in `d.efc_pos`."""
    d.qpos[:], d.qvel[:] = qpos, qvel
    mujoco.mj_forward(m, d)
    return d.efc_J.reshape(d.nefc, m.nv).copy()


def _inertia(m: mujoco.MjModel, body: int) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, centre of mass and inertia about it (3, 3), in the body's frame."""
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, m.body_iquat[body])
    rotation = rotation.reshape(3, 3)
    return float(m.body_mass[body]), m.body_ipos[body].copy(), rotation @ np.diag(m.body_inertia[body]) @ rotation.T


def _combined(drawn: tuple[float, np.ndarray, np.ndarray], row: np.ndarray):
    """Mass, centre, principal moments and their frame of the body with payload (mass, place) and shifted centre."""
    mass, center, inertia = drawn
    payload, place, shifted = row[0], row[1:4], center + row[4:7]
    whole = mass + payload
    middle = (mass * shifted + payload * place) / whole
    for part, point in ((mass, shifted), (payload, place)):
        d = point - middle
        inertia = inertia + part * (d @ d * np.eye(3) - np.outer(d, d))
    # MuJoCo holds an inertia as principal moments and their frame.
    moments, axes = np.linalg.eigh(inertia)
    # eigh may give a mirrored frame, which no quaternion turns to.
    axes[:, 2] = np.cross(axes[:, 0], axes[:, 1])
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    return whole, middle, moments, quaternion
