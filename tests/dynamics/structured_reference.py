"""Native MuJoCo in float64 as the reference for the structured engine: one step under the same forces."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lunar_mjx.dynamics.structured.engine import StructuredEngine
from lunar_mjx.effects.context import Geometry
from lunar_mjx.effects.ports import Forces
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Vec3

GRAVITY = 1.625


class Reference:
    """The structured engine and native MuJoCo of one rover, in float64 and without effects."""

    def __init__(self, rover: Rover, timestep: float = 0.002):
        self.rover = rover
        self.engine, self.timestep = StructuredEngine(rover), timestep
        self.model = m = self.engine.mj_model
        m.opt.timestep = timestep
        m.opt.gravity[:] = (0.0, 0.0, -GRAVITY)
        self.data = mujoco.MjData(m)
        self.wheels = [m.body(w.body).id for w in rover.wheels]
        self.chassis = m.body(rover.chassis).id
        self.dofs = [int(m.jnt_dofadr[m.joint(j).id]) for j in rover.joints]

    def step(self, qpos, qvel, forces):
        """What the engine sees, and its next state, operation by operation: compiling a step takes far longer."""
        return jax.vmap(self._step, in_axes=(None, 0, 0, 0))(self.timestep, qpos, qvel, forces)

    @functools.cached_property
    def fly(self):
        """A compiled function from time step, number of steps and one state to the state after them without forces."""
        nil = {k: jnp.zeros(f.shape[1:]) for k, f in self.random(1)[2].items()}

        def one(dt, now):
            return self._step(dt, *now, nil)[1]

        return jax.jit(lambda dt, count, *state: jax.lax.fori_loop(0, count, lambda _, now: one(dt, now), state))

    def _step(self, dt, qpos, qvel, f):
        params = SimpleNamespace(gravity=GRAVITY, effects={})
        kinematics, finish = self.engine.forward(params, qpos, qvel, dt)
        nil, none = jnp.zeros(()), jnp.zeros(len(self.rover.wheels))
        geometry = Geometry(none, none, none, nil, Vec3(nil, nil, nil), Vec3(nil, nil, nil))
        world = (Vec3(*f[k]) for k in ("wheel_force", "wheel_moment", "chassis_force", "chassis_moment"))
        return kinematics, finish(Forces(f["torque"], *world, geometry))

    def random(self, count: int, seed: int = 0):
        """Positions, velocities and forces of `count` rovers."""
        rng, m, wheels = np.random.default_rng(seed), self.model, len(self.rover.wheels)
        qpos = rng.normal(size=(count, m.nq)) * 0.3
        qpos[:, :3] = rng.normal(size=(count, 3))
        qpos[:, 3:7] = rng.normal(size=(count, 4))
        qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
        forces = {
            "torque": rng.normal(size=(count, len(self.dofs))) * 10,
            "wheel_force": rng.normal(size=(count, 3, wheels)) * 100,
            "wheel_moment": rng.normal(size=(count, 3, wheels)) * 10,
            "chassis_force": rng.normal(size=(count, 3)) * 100,
            "chassis_moment": rng.normal(size=(count, 3)) * 100,
        }
        return qpos, rng.normal(size=(count, m.nv)), forces

    def closed(self, qpos, qvel):
        """The same states with the loops closed."""
        return tuple(np.array(a) for a in jax.vmap(lambda q, v: self.engine.join(*self.engine.split(q, v)))(qpos, qvel))

    def load(self, qpos, qvel, forces):
        """Puts one state and its forces into MuJoCo's data, with fresh poses."""
        m, d = self.model, self.data
        d.qpos[:], d.qvel[:] = qpos, qvel
        d.qfrc_applied[:], d.xfrc_applied[:] = 0.0, 0.0
        mujoco.mj_kinematics(m, d)
        d.qfrc_applied[self.dofs] = forces["torque"]
        for i, body in enumerate(self.wheels):
            self._push(body, forces["wheel_force"][:, i], forces["wheel_moment"][:, i])
        self._push(self.chassis, forces["chassis_force"], forces["chassis_moment"])

    def _push(self, body, force, moment):
        d = self.data
        d.xfrc_applied[body] = [*force, *(moment + np.cross(d.xpos[body] - d.xipos[body], force))]

    def native(self, qpos, qvel, forces):
        """MuJoCo's next state, and where the wheels' centres were."""
        self.load(qpos, qvel, forces)
        places = self.data.xpos[self.wheels].copy()
        mujoco.mj_step(self.model, self.data)
        return self.data.qpos.copy(), self.data.qvel.copy(), places

    def hard_loop(self, qpos, qvel, forces, h: float = 1e-5):
        """Accelerations with rigid loops: [M J^T; J 0], the rate of J by central differences along the motion."""
        m, d = self.model, self.data

        def jacobian(q):
            d.qpos[:], d.qvel[:] = q, qvel
            mujoco.mj_forward(m, d)
            return d.efc_J.reshape(d.nefc, m.nv).copy()

        moved = [qpos.copy(), qpos.copy()]
        for q, dt in zip(moved, (h, -h), strict=True):
            mujoco.mj_integratePos(m, q, qvel, dt)
        rate = (jacobian(moved[0]) - jacobian(moved[1])) / (2 * h)
        jac = jacobian(qpos)
        assert np.abs(d.efc_pos).max() < 1e-14 and np.abs(jac @ qvel).max() < 1e-13
        self.load(qpos, qvel, forces)
        mujoco.mj_forward(m, d)
        mass = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, mass)
        # damping is implicit in the engine's step
        mass += self.timestep * np.diag(m.dof_damping)
        pushed = np.zeros(m.nv)
        self._accumulate(pushed)
        free = d.qfrc_passive + d.qfrc_applied + pushed - d.qfrc_bias
        matrix = np.block([[mass, jac.T], [jac, np.zeros((len(jac), len(jac)))]])
        return np.linalg.lstsq(matrix, np.r_[free, -rate @ qvel], rcond=1e-12)[0][: m.nv]

    def _accumulate(self, out):
        m, d = self.model, self.data
        for body in {*self.wheels, self.chassis}:
            f = d.xfrc_applied[body]
            mujoco.mj_applyFT(m, d, f[:3], f[3:], d.xipos[body], body, out)
