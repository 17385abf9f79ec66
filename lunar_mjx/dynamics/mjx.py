"""The MJX engine: one physics step from MJX's public stages, for any rover; the reference for other engines.

Contacts are off and the solver would see equality constraints only, so its problem is quadratic: it is solved at once
for the constraint forces (MuJoCo's dual problem), whose matrix is far better conditioned in float32 than the Hessian of
MJX's Newton iteration. With that iteration VIPER had values that are not finite on a GPU, and a batch of 64 never came
back on a machine of two cores; without it, and without LAPACK, neither was seen again (its Cholesky is the suspect, not
proven). MJX leaves out the loops' own acceleration at given speeds, J' v, which native MuJoCo takes away from the
reference acceleration of a `connect`: it is added here. Matrix products keep all of float32, on GPUs with TF32 too.
Kinematics run once per step and are fresh when the effects read them.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from lunar_mjx._quiet import mjx, solve_m
from lunar_mjx.dynamics.kinematics import Finish, Kinematics, wheel_feet
from lunar_mjx.effects.ports import Forces
from lunar_mjx.errors import UserError
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Frame, Vec3


class MjxEngine:
    """Rigid-body dynamics of one rover on MJX: `forward` gives the kinematics and a function that finishes the step."""

    name = "mjx"

    def __init__(self, rover: Rover):
        model = rover.compile()
        _check_options(model, rover)
        self.mj_model = model
        self.nq, self.nv = model.nq, model.nv
        self.qpos0 = np.array(model.qpos0)
        joints = [model.joint(name).id for name in rover.joints]
        self._qadr = model.jnt_qposadr[joints]
        self._dadr = model.jnt_dofadr[joints]
        self._wheels = np.array([model.body(wheel.body).id for wheel in rover.wheels])
        self._axles = np.array([model.jnt_axis[model.joint(wheel.drive).id] for wheel in rover.wheels])
        self._chassis = model.body(rover.chassis).id
        self._armature0 = np.array(model.dof_armature)
        self.wheel_feet = wheel_feet(model, self._wheels, self._chassis)
        self._pins = _Pins(model)
        self._mjx = mjx.put_model(model)
        self._data = mjx.make_data(model)

    @jax.default_matmul_precision("highest")
    def forward(self, params: Any, qpos: Any, qvel: Any, dt: Any) -> tuple[Kinematics, Finish]:
        """Kinematics at (qpos, qvel), and a function from forces to (qpos, qvel) a time step of `dt` s later."""
        dtype = qpos.dtype
        m = jax.tree.map(lambda a: _cast(a, dtype), self._mjx)
        d = jax.tree.map(lambda a: _cast(a, dtype), self._data)
        # The time step is the model's, not the MJCF's: halving it needs no new file.
        m = m.replace(opt=m.opt.replace(timestep=jnp.asarray(dt, dtype)))
        m = _with_gravity(m, jnp.asarray(params.gravity, dtype))
        d = d.replace(qpos=qpos, qvel=qvel)
        d = mjx.com_vel(m, mjx.com_pos(m, mjx.kinematics(m, d)))

        def finish(forces: Forces) -> tuple[Any, Any]:
            return self._finish(params, m, d, forces)

        return self._kinematics(d), finish

    def split(self, qpos: Any, qvel: Any) -> tuple[Any, Any]:
        """The coordinates as a loop over time carries them: unchanged."""
        return qpos, qvel

    def join(self, qpos: Any, qvel: Any) -> tuple[Any, Any]:
        """The inverse of `split`."""
        return qpos, qvel

    def _kinematics(self, d: mjx.Data) -> Kinematics:
        chassis, wheels = self._chassis, self._wheels
        about = d.subtree_com[chassis]
        spin, speed = d.cvel[:, :3], d.cvel[:, 3:]

        def velocity_at(body: Any, place: Any) -> Any:
            # cvel is taken at the centre of mass of the whole tree
            return speed[body] + jnp.cross(spin[body], place - about)

        axle = jnp.einsum("wij,wj->wi", d.xmat[wheels], jnp.asarray(self._axles, d.qpos.dtype))
        return Kinematics(
            position=Vec3.of(d.xpos[chassis]),
            quaternion=d.xquat[chassis],
            frame=Frame.of_matrix(d.xmat[chassis]),
            velocity=Vec3.of(velocity_at(chassis, d.xpos[chassis])),
            angular_velocity=Vec3.of(spin[chassis]),
            joint_angle=d.qpos[self._qadr],
            joint_speed=d.qvel[self._dadr],
            wheel_position=Vec3.of(d.xpos[wheels]),
            wheel_axle=Vec3.of(axle),
            wheel_velocity=Vec3.of(velocity_at(wheels, d.xpos[wheels])),
            wheel_angular_velocity=Vec3.of(spin[wheels]),
        )

    @jax.default_matmul_precision("highest")
    def _finish(self, params: Any, m: mjx.Model, d: mjx.Data, forces: Forces) -> tuple[Any, Any]:
        # Armature enters the mass matrix, so that it must be set before `crb`.
        m = m.replace(dof_armature=self._armature(params, d.qpos.dtype))
        if forces.geometry.gravity is not None:
            m = _with_gravity(m, jnp.asarray(forces.geometry.gravity, d.qpos.dtype))
        d = self._carry_payload(m, d, forces)
        # The order of MuJoCo's own mj_fwdPosition, minus collisions, which the effects replace.
        d = mjx.tendon(m, mjx.camlight(m, d))
        d = mjx.transmission(m, mjx.make_constraint(m, mjx.factor_m(m, mjx.crb(m, d))))
        d = mjx.fwd_velocity(m, d)
        d = self._apply(m, d, forces)
        d = mjx.fwd_acceleration(m, mjx.fwd_actuation(m, d))
        # Without constraints the smooth acceleration is the answer; with them `mjx.solve` is passed by (see the
        # module).
        d = d.replace(qacc=d.qacc_smooth) if m.neq == 0 else _hold_equalities(m, d, self._pins)
        d = mjx.euler(m, d)
        return d.qpos, d.qvel

    def _armature(self, params: Any, dtype: Any) -> Any:
        """Rotor inertia times the square of the gear ratio at the actuated joints, where the model has motors."""
        armature = jnp.asarray(self._armature0, dtype)
        motor = params.effects.get("motor")
        if motor is None:
            return armature
        reflected = motor["rotor_inertia"] * motor["gear_ratio"] ** 2 * jnp.ones(len(self._dadr), dtype)
        return armature.at[self._dadr].set(reflected)

    def _carry_payload(self, m: mjx.Model, d: mjx.Data, forces: Forces) -> mjx.Data:
        """Adds a point mass to the chassis and shifts its centre of mass, in the inertia that crb and rne read."""
        # The change is added to `cinert` and not to the model's masses, because these may differ from rover to rover
        # while the model is shared.
        geometry, chassis = forces.geometry, self._chassis
        rotation = d.xmat[chassis]
        about = d.subtree_com[chassis]
        mass = m.body_mass[chassis]
        com = d.xipos[chassis]
        moved = com + rotation @ geometry.com_offset.stack()
        payload = d.xpos[chassis] + rotation @ geometry.payload_position.stack()
        change = (
            _point_inertia(mass, moved - about)
            - _point_inertia(mass, com - about)
            + _point_inertia(geometry.payload_mass, payload - about)
        )
        cinert: Any = d._impl.cinert
        return _with_private(d, cinert=cinert.at[chassis].add(change))

    def _apply(self, m: mjx.Model, d: mjx.Data, forces: Forces) -> mjx.Data:
        """Forces at the wheels' centres and the chassis frame, moved to the centres of mass where xfrc_applied acts."""
        xfrc = jnp.zeros((m.nbody, 6), d.qpos.dtype)
        wheels, chassis = self._wheels, self._chassis

        def row(body: Any, force: Any, moment: Any) -> Any:
            # Effects give moments about the wheel's centre; xfrc_applied acts at the body's centre of mass.
            moment = moment + jnp.cross(d.xpos[body] - d.xipos[body], force)
            return jnp.concatenate([force, moment], axis=-1)

        xfrc = xfrc.at[wheels].add(row(wheels, forces.wheel_force.stack(), forces.wheel_moment.stack()))
        xfrc = xfrc.at[chassis].add(row(chassis, forces.chassis_force.stack(), forces.chassis_moment.stack()))
        qfrc = jnp.zeros(m.nv, d.qpos.dtype).at[self._dadr].set(forces.joint_torque)
        return d.replace(xfrc_applied=xfrc, qfrc_applied=qfrc)


class _Pins:
    """The two anchors of every `connect` constraint, whose rows come first in MJX's Jacobian."""

    def __init__(self, model: mujoco.MjModel):
        pins = np.nonzero(model.eq_type == mujoco.mjtEq.mjEQ_CONNECT)[0]
        places = [_anchor(model, pin, end) for end in (0, 1) for pin in pins]
        self.rows = 3 * len(pins)
        self.pins = pins
        self.bodies = np.array([body for body, _ in places], int)
        self._anchors = np.array([anchor for _, anchor in places]).reshape(-1, 3)
        self._root = model.body_rootid[self.bodies]
        # the joints that move each of the bodies
        self._moves = np.zeros((len(places), model.nv))
        for row, body in enumerate(self.bodies):
            while body:
                first = model.body_dofadr[body]
                self._moves[row, first : first + model.body_dofnum[body]] = 1.0
                body = model.body_parentid[body]

    def bias(self, d: mjx.Data) -> Any:
        """J' v: how fast the anchors accelerate apart while the joints' speeds stay as they are, m/s2 (rows,)."""
        bodies = self.bodies
        place = d.xpos[bodies] + jnp.einsum("pij,pj->pi", d.xmat[bodies], jnp.asarray(self._anchors, d.qpos.dtype))
        # cvel, and accelerations by cdof_dot, are taken at the centre of mass of the whole tree
        arm = place - d.subtree_com[self._root]
        spin = d.cvel[bodies, :3]
        velocity = d.cvel[bodies, 3:] + jnp.cross(spin, arm)
        rate = jnp.asarray(self._moves, d.qpos.dtype) @ (d.cdof_dot * d.qvel[:, None])
        acceleration = rate[:, 3:] + jnp.cross(rate[:, :3], arm) + jnp.cross(spin, velocity)
        first, second = acceleration.reshape(2, -1, 3)
        return ((first - second) * d.eq_active[self.pins, None]).reshape(-1)


def _anchor(model: mujoco.MjModel, pin: Any, end: int) -> tuple[int, np.ndarray]:
    """Body of one end of a `connect`, and the anchor in its frame (3,), m."""
    object_ids = (model.eq_obj1id, model.eq_obj2id)[end][pin]
    if model.eq_objtype[pin] == mujoco.mjtObj.mjOBJ_SITE:
        return int(model.site_bodyid[object_ids]), np.array(model.site_pos[object_ids])
    return int(object_ids), np.array(model.eq_data[pin, 3 * end : 3 * end + 3])


def _with_private(d: mjx.Data, **fields: Any) -> mjx.Data:
    """MJX's data with other values in fields that it keeps to itself."""
    replaced: Any = d.tree_replace({f"_impl.{name}": value for name, value in fields.items()})
    return replaced


def _hold_equalities(m: mjx.Model, d: mjx.Data, pins: _Pins) -> mjx.Data:
    """What `mjx.solve` converges to for equality constraints alone: (J M^-1 J^T + R) f = a_ref - J' v - J a_smooth."""
    implementation: Any = d._impl
    jacobian = implementation.efc_J
    # Each row is one solve with the factor of M that the step has made anyhow.
    moved = jax.vmap(lambda row: solve_m(m, d, row))(jacobian)  # M^-1 J^T, a row per constraint
    matrix = jacobian @ moved.T + jnp.diag(1.0 / implementation.efc_D)
    wanted = implementation.efc_aref.at[: pins.rows].add(-pins.bias(d))
    force = _solve_positive(matrix, wanted - jacobian @ d.qacc_smooth)
    return _with_private(d, efc_force=force).replace(
        qacc=d.qacc_smooth + force @ moved, qfrc_constraint=force @ jacobian
    )


def _solve_positive(a: Any, b: Any) -> Any:
    """Solves a x = b for a (n, n), symmetric and positive definite, by L D L^T with rows of L as vectors."""
    # Unrolled: n is three numbers for each loop of the rover, and LAPACK calls inside a batched loop are what hung (see
    # the module).
    n = len(b)
    low, pivots = [], []
    for j in range(n):
        pivots.append(a[j, j])
        low.append((a[:, j] / a[j, j]).at[: j + 1].set(0.0))
        a = a - jnp.outer(low[j], a[j])
        b = b - low[j] * b[j]
    x = b / jnp.stack(pivots)
    for j in reversed(range(n)):
        x = x.at[j].add(-jnp.dot(low[j], x))
    return x


def _with_gravity(m: mjx.Model, gravity: Any) -> mjx.Model:
    zero = jnp.zeros_like(gravity)
    return m.replace(opt=m.opt.replace(gravity=jnp.stack([zero, zero, -gravity])))


def _cast(leaf: Any, dtype: Any) -> Any:
    if isinstance(leaf, jax.Array | np.ndarray) and jnp.issubdtype(leaf.dtype, jnp.floating):
        return jnp.asarray(leaf, dtype)
    return leaf


def _point_inertia(mass: Any, r: Any) -> Any:
    """MuJoCo's ten numbers of a point mass at `r`: Ixx Iyy Izz Ixy Ixz Iyz, mass times r, mass."""
    x, y, z = r[0], r[1], r[2]
    moments = jnp.stack([y * y + z * z, x * x + z * z, x * x + y * y, -x * y, -x * z, -y * z])
    return mass * jnp.concatenate([moments, r, jnp.ones_like(r[:1])])


def _check_options(model: mujoco.MjModel, rover: Rover) -> None:
    """Refuses models whose constraints are more than equalities; mass matrices are kept sparse."""
    disabled = model.opt.disableflags
    problems = []
    if not disabled & mujoco.mjtDisableBit.mjDSBL_CONTACT:
        problems.append('contacts are on (set <flag contact="disable"/>)')
    if not disabled & mujoco.mjtDisableBit.mjDSBL_LIMIT and model.jnt_limited.any():
        problems.append('joint limits are on (set <flag limit="disable"/>; limits are an effect)')
    if (model.dof_frictionloss > 0).any():
        problems.append("frictionloss is set (use a friction effect)")
    if model.opt.integrator != mujoco.mjtIntegrator.mjINT_EULER:
        problems.append('the integrator is not Euler (set integrator="Euler")')
    if problems:
        raise UserError(f"{rover.mjcf}: the solver must see equality constraints only, but {'; '.join(problems)}.")
    # The dense form would fill a mass matrix whose legs do not touch each other.
    model.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE
