"""A plain ground for tests: springs under the wheels and Coulomb friction, applied through `xfrc_applied`."""

from __future__ import annotations

import mujoco
import numpy as np

from lunar_mjx.rover import Rover

STIFFNESS, DAMPING, FRICTION = 2e4, 400.0, 0.5  # N/m, N s/m, -
CREEP = 0.05  # m/s over which friction builds up


class Drive:
    """A rover on the ground under its own nominal controls, stepped by native MuJoCo."""

    def __init__(self, rover: Rover, bump: float = 0.0) -> None:
        self.rover, self.bump = rover, bump
        self.model = rover.compile()
        self.data = mujoco.MjData(self.model)
        self.data.qpos[2] = rover.standing_height
        self.wheels = [self.model.body(w.body).id for w in rover.wheels]
        self.q = {g.name: [self.model.joint(j).qposadr[0] for j in g.joints] for g in rover.groups}
        self.v = {g.name: [self.model.joint(j).dofadr[0] for j in g.joints] for g in rover.groups}
        self.worst_loop_error = 0.0

    def command(self, **targets: np.ndarray | float) -> None:
        """Sets the controls that the groups' gains give for a target speed (drive) or angle; others get no torque."""
        torques = []
        for group in self.rover.groups:
            torque = np.zeros(len(group.joints))
            if group.name in targets:
                target, speed = targets[group.name], self.data.qvel[self.v[group.name]]
                if group.mode == "velocity":
                    torque = group.velocity_gain * (target - speed)
                else:
                    torque = group.position_gain * (target - self.data.qpos[self.q[group.name]])
                    torque = torque - group.velocity_gain * speed
            torques.append(torque)
        self.data.ctrl[:] = np.concatenate(torques)

    def step(self) -> None:
        """Presses the wheels on the ground and takes one time step."""
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        self._check_loops()
        velocity = np.zeros(6)
        for wheel, body in zip(self.rover.wheels, self.wheels, strict=True):
            mujoco.mj_objectVelocity(self.model, self.data, mujoco.mjtObj.mjOBJ_XBODY, body, velocity, 0)
            x, y, z = self.data.xpos[body]
            # Bumps under the left wheels only, so that the rover rolls and twists.
            ground = self.bump * np.sin(6 * x) * (y > 0) * min(self.data.time / 3, 1)
            depth = wheel.radius + ground - z
            load = max(0.0, STIFFNESS * depth - DAMPING * velocity[5]) if depth > 0 else 0.0
            arm = np.array([0.0, 0.0, -wheel.radius])
            sliding = velocity[3:] + np.cross(velocity[:3], arm)
            force = -FRICTION * load * np.tanh(sliding / CREEP)
            force[2] = load
            self.data.xfrc_applied[body] = [*force, *np.cross(arm, force)]
        mujoco.mj_step(self.model, self.data)

    def angles(self, group: str) -> np.ndarray:
        """Joint angles of a group in rad."""
        return self.data.qpos[self.q[group]].copy()

    def _check_loops(self) -> None:
        self.worst_loop_error = max(
            [self.worst_loop_error, *loop_errors(self.rover, self.model, self.data.xpos, self.data.xmat)]
        )


def loop_errors(rover: Rover, model: mujoco.MjModel, xpos: np.ndarray, xmat: np.ndarray) -> list[float]:
    """Distance in m between the two anchors of each loop."""
    errors = []
    for loop in rover.loops:
        ends = []
        for body, anchor in ((loop.body1, loop.anchor1), (loop.body2, loop.anchor2)):
            i = model.body(body).id
            ends.append(np.asarray(xpos[i]) + np.asarray(xmat[i]).reshape(3, 3) @ np.array(anchor))
        errors.append(float(np.linalg.norm(ends[0] - ends[1])))
    return errors
