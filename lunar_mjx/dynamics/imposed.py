"""Imposed motion: the wheels turn as measured, the body is free, and the motors' currents come out.

A rover whose wheel speeds were measured needs no controller that follows them: the joints' motion is given, the base
moves on its contacts, and the torque that each drive needs follows from the equation of motion (hybrid dynamics,
Featherstone 2008, sec. 9.2). The current is what the effects at the port `motor_torque` turn into that torque.

The ground is a plane under the wheels. Its slope enters as the direction of gravity in the chassis frame, which an
accelerometer measures or a map gives, so that a window needs no position.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.batching.batch_last import batch_last
from lunar_mjx.dynamics.indexing import select
from lunar_mjx.dynamics.state import Params, State, Temperature
from lunar_mjx.dynamics.structured.engine import Pieces, StructuredEngine
from lunar_mjx.dynamics.structured.legs import cast_group, joint_turns
from lunar_mjx.dynamics.system import System
from lunar_mjx.effects.context import Command, Context
from lunar_mjx.effects.joint.motor import REFERENCE_TEMPERATURE, torque_per_ampere
from lunar_mjx.effects.ports import apply_effects
from lunar_mjx.errors import UserError
from lunar_mjx.model import Model
from lunar_mjx.pytree import pytree
from lunar_mjx.spatial import Vec3, mul
from lunar_mjx.terrain.terrain import flat


@dataclasses.dataclass(frozen=True)
class ImposedMotion:
    """How windows of imposed motion are simulated."""

    settle_s: float = 0.5
    """Time for which a window's first speeds are held before it begins: ten times as long as a wheel's load takes to
    settle and as the yaw rate takes to follow (0.05 s for a Husky on its tyres)."""
    damping_time_s: float = 0.02
    """Damping of the sheared ground in place of `shear_state`'s 0.1 s, which calms parked rovers and would make a time
    step of 8 ms unstable on grippy ground (a limit cycle of two steps with 0.7 A at friction 0.6 over a slip of
    0.01)."""
    secant_steps: int = 2
    """Steps from torque to current. One is exact where the torque is affine in the current, as all motors and frictions
    of the catalogue are; the second serves a gear whose efficiency depends on the direction of power."""


IMPOSED = ImposedMotion()


LEFT_OUT = ("boulders", "chassis_contact", "joint_limits", "thermal_cutoff")
"""Effects of a whole rover that cannot act in a window on a plane: nothing but the wheels touches it."""


@pytree
class Windows:
    """Imposed motion of some windows, each of shape (window, edge) unless said otherwise.

    Attributes:
      speed: of the drive joints at the edges of the bins, (window, edge, joint), rad/s; linear between them.
      up_x, up_y, up_z: specific force of gravity in the chassis frame at the edges, m/s2; (0, 0, g) on level ground.
      yaw_rate: with which each window begins, (window,), rad/s.
    """

    speed: Any
    up_x: Any
    up_y: Any
    up_z: Any
    yaw_rate: Any


@pytree
class Seen:
    """Means over every bin, (batch, bin) unless said otherwise.

    Attributes:
      current: of the motors, (batch, bin, joint), A. torque: at the joints, (batch, bin, joint), N m.
      yaw_rate: rad/s. speed_x, speed_y: of the chassis frame's origin along its own axes, m/s.
    """

    current: Any
    torque: Any
    yaw_rate: Any
    speed_x: Any
    speed_y: Any


def on_a_plane(model: Model) -> Model:
    """A model with a plane as its ground, and without what cannot act there."""
    for name in LEFT_OUT:
        if name in model.effect_names:
            model = model.remove(name)
    if "shear_state" in model.effect_names:
        model = model.set("shear_state", "imposed motion", damping_time=IMPOSED.damping_time_s)
    # Eight metres are more than a window of some seconds drives; the plane has no edge that matters.
    return model.replace(terrain=flat(8.0))


def require_drives_alone(model: Model) -> None:
    """Refuses rovers with joints beside their drives: steered wheels, suspensions, rockers that turn freely.

    Raises:
      UserError: the rover has such joints, which imposed wheel speeds do not move.
    """
    if any(g.name != "drive" for g in model.rover.groups):
        joints = ", ".join(j for g in model.rover.groups if g.name != "drive" for j in g.joints)
        raise UserError(
            f"{model.rover.name}: imposed wheel speeds need a rover whose drives are its only joints, and it has "
            f"{joints}; leave `imposed` out of log.toml, so that its commands are simulated."
        )
    passive = [joint for joint in model.rover.joint_limits if joint not in model.rover.joints]
    if passive:
        raise UserError(
            f"{model.rover.name}: imposed wheel speeds need a rover whose drives are its only joints, and it has "
            f'{", ".join(passive)}; write type="fixed" for them in its URDF and convert it again.'
        )


class KinematicDrive:
    """A model whose wheels move as they were measured.

    Attributes:
      system: the model on a plane, with the effects that can act there.
      bin_s: length of the bins over which the results are means, s.
      steps: time steps per bin.
    """

    def __init__(self, model: Model, bin_s: float, longest_step_s: float = 0.005):
        """Builds and compiles the program for one model.

        Args:
          model: a rover whose wheels' drives are its only joints, on any terrain, which a plane takes the place of.
          bin_s: length of the bins, s.
          longest_step_s: of the dynamics; bins are divided evenly.

        Raises:
          UserError: the rover has other joints, which imposed wheel speeds do not move.
        """
        require_drives_alone(model)
        # The small number keeps an exact multiple from rounding up to one step more.
        self.steps = max(1, int(np.ceil(bin_s / longest_step_s - 1e-9)))
        self.bin_s = bin_s
        self.model = on_a_plane(model).replace(timestep=bin_s / self.steps)
        # MJX cannot take joint accelerations as given without a constraint for each.
        self.system = System(self.model, "structured")
        engine = self.system.engine
        assert isinstance(engine, StructuredEngine)
        self._engine = engine
        self._run = jax.jit(self._run_batch)

    def run(self, params: Params, windows: Windows) -> Seen:
        """Simulates a batch.

        Args:
          params: parameters with a leading batch axis, but for the terrain's, which is shared.
          windows: with the same leading axis.

        Returns:
          Means over the bins, as arrays.
        """
        # The terrain is one plane for all windows: left out here, it is not copied for every one of them, and `_step`
        # puts it back.
        return jax.tree.map(np.asarray, self._run(dataclasses.replace(params, terrain=None), windows))

    def _run_batch(self, params: Params, windows: Windows) -> Seen:
        # The batch goes last, so that neighbouring windows lie side by side in memory (see `batch_last`).
        first = jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), params)
        last = jax.tree.map(lambda a: jnp.moveaxis(a, 0, -1), windows)  # (edge, joint, batch) and (edge, batch)
        begin = (last.speed[0], last.up_x[0], last.up_y[0], last.up_z[0], last.yaw_rate)
        axes = (-1,) * 6
        state = batch_last(self._begin, axes)(first, *begin)
        step = batch_last(self._step, axes)

        def bin_of(state: Any, edges: Any) -> tuple[Any, Any]:
            old, new = edges

            def inside(k: Any, carry: Any) -> Any:
                state, total = carry
                # Speeds are linear between the edges of a bin, and imposed at the end of each step, where the semi-
                # implicit step applies them.
                share = (k + 1.0) / self.steps
                speed, up = (
                    jax.tree.map(lambda a, b: a + share * (b - a), o, n) for o, n in zip(old, new, strict=True)
                )
                state, seen = step(first, *state, speed, up)
                return state, jax.tree.map(jnp.add, total, seen)

            shapes = jax.eval_shape(lambda s: step(first, *s, *new)[1], state)
            zeros = jax.tree.map(lambda a: jnp.zeros(a.shape, a.dtype), shapes)
            state, total = jax.lax.fori_loop(0, self.steps, inside, (state, zeros))
            return state, jax.tree.map(lambda a: a / self.steps, total)

        edges = last.speed, Vec3(last.up_x, last.up_y, last.up_z)
        # a window is cut out of a drive: what its contacts remember at the start is made by holding its first speeds
        held = jax.tree.map(
            lambda a: jnp.broadcast_to(a[0], (round(IMPOSED.settle_s / self.bin_s) + 1, *a.shape[1:])), edges
        )
        state, _ = jax.lax.scan(bin_of, state, (held, held))
        before, after = (jax.tree.map(lambda a, s=s: a[s], edges) for s in (slice(None, -1), slice(1, None)))
        _, seen = jax.lax.scan(bin_of, state, (before, after))
        return jax.tree.map(lambda a: jnp.moveaxis(a, (-1, 0), (0, 1)), seen)

    def _begin(self, params: Params, speed: Any, up_x: Any, up_y: Any, up_z: Any, yaw_rate: Any) -> Any:
        """Rolling at the wheels' mean speed, standing on the ground: (positions, velocities, states of effects)."""
        del up_x, up_y, up_z
        system, engine = self.system, self._engine
        zero = jnp.zeros_like(yaw_rate)
        radius = float(np.mean(system.info.wheel_radius))
        forward = radius * jnp.mean(speed)
        height = zero + self.model.rover.standing_height
        joints, speeds = [], []
        for group in engine.structure.groups:
            n = cast_group(group, yaw_rate.dtype)
            drives = n.links[0].actuated
            assert drives is not None
            own = mul(n.links[0].numbers.sign, select(speed, drives))
            joints.append(joint_turns(n, [jnp.zeros_like(own)]))
            # Wheels begin at their measured speed, the body at their mean rolling speed: what is wrong with that has
            # settled by the time the window begins.
            speeds.append((own,))
        wheel = jnp.zeros_like(speed)
        shapes = {"joint": wheel, "wheel": wheel, "rover": zero}
        effects = {
            e.name: {name: s.reset(shapes[s.axis]) for name, s in e.state.items()}
            for e in self.model.effects
            if e.state
        }
        place = (zero, zero, height, zero + 1.0, zero, zero, zero)
        return Pieces(place, tuple(joints)), Pieces((forward, zero, zero, zero, zero, yaw_rate), tuple(speeds)), effects

    def _step(self, params: Params, q: Pieces, v: Pieces, effects: Any, speed: Any, up: Vec3) -> Any:
        """One time step of one rover towards the joint speeds `speed`: ((positions, velocities, states), seen)."""
        system = self.system
        params = dataclasses.replace(params, terrain=system.params.terrain)
        kinematics, finish = self._engine.forward_imposed(params, q, v, system.dt)
        # a window of seconds warms nothing, and no log tells the windings' temperature at its beginning
        cold = params.ambient_temperature(0.0) - REFERENCE_TEMPERATURE + jnp.zeros_like(speed)
        temperature = Temperature(cold, jnp.zeros_like(cold), cold, jnp.zeros_like(cold))
        pieces: tuple[Any, Any] = (q, v)  # as the engine carries them within a loop
        state = State(jnp.zeros((), jnp.int32), pieces[0], pieces[1], temperature, effects)
        ctx = system._context(params, state, kinematics)
        forces, ctx, effects = apply_effects(system.pipeline, ctx, kinematics.joint_speed, effects)
        # The acceleration that brings every wheel to its imposed speed in exactly this step.
        acceleration = (speed - kinematics.joint_speed) / ctx.dt
        q, v, torque, _ = finish(forces, acceleration, up)
        beside = forces.joint_torque - ctx.torque  # of brakes and stops, which help the motor or load it
        current = self._current(ctx, effects, torque - beside)
        own = kinematics.frame.from_world(kinematics.velocity)
        spin = kinematics.frame.from_world(kinematics.angular_velocity)
        return (q, v, effects), Seen(current, torque, spin.z, own.x, own.y)

    def _current(self, ctx: Context, effects: Any, torque: Any) -> Any:
        """(joint,) the motor currents that make the torques (joint,) at the joints, friction and losses included, A."""
        per_ampere = torque_per_ampere(ctx.parameters["motor"])

        def made(current: Any) -> Any:
            command = Command(ctx.joint_speed, current)
            at = dataclasses.replace(ctx, command=command)
            return self.system.pipeline.run("motor_torque", at, effects, jnp.zeros_like(torque))[0]

        current = torque / per_ampere
        for _ in range(IMPOSED.secant_steps):
            off = made(current) - torque
            moved = current - off / per_ampere
            # A secant instead of a derivative: friction has kinks, where a derivative tells nothing of the next ampere.
            slope = (made(moved) - torque - off) / jnp.where(moved == current, 1.0, moved - current)
            # where two trials say almost nothing of each other, the nominal constant is the safer slope
            current = current - off / jnp.where(jnp.abs(slope) > 0.05 * per_ampere, slope, per_ampere)
        return current
