"""One physics step: an engine's rigid-body dynamics with the effects at their ports, as pure functions on pytrees."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics.batching import batch
from lunar_mjx.dynamics.engines import make_engine
from lunar_mjx.dynamics.heat import step_heat
from lunar_mjx.dynamics.indexing import select
from lunar_mjx.dynamics.kinematics import Kinematics, chassis_boxes
from lunar_mjx.dynamics.state import Ambient, Params, State, Supply, Telemetry, Temperature
from lunar_mjx.effects.context import Context, Heat, RoverInfo
from lunar_mjx.effects.joint.motor import MODES, REFERENCE_TEMPERATURE, constant_at, winding_resistance
from lunar_mjx.effects.ports import EffectState, Pipeline, apply_effects
from lunar_mjx.effects.power.chassis import chassis_temperature
from lunar_mjx.effects.power.supply import charge_of, terminal_voltage
from lunar_mjx.model.sun import make_sun
from lunar_mjx.rover import Rover
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import sample

if TYPE_CHECKING:
    from lunar_mjx.model import Model


class System:
    """A model made ready to run: `reset` and `step` are pure, for one rover, and compose with jit, vmap and grad.

    Everything that may differ between rovers is in `params`, which both take; `vmap` over it, over the state, or both.

    Attributes:
      model: what was built.
      params: the model's parameters, as a pytree of arrays.
      info: the rover as drawn.
      engine: the rigid-body engine.
    """

    def __init__(self, model: Model, engine: str = "auto"):
        self.model = model
        self.engine = make_engine(model.rover, engine)
        self.pipeline = Pipeline(model.effects)
        self.info = rover_info(model)
        self.params = default_params(model)
        # unsteered wheels read joint 0 and drop it, so that all wheels go through one gather
        steer = [model.rover.joints.index(w.steer) if w.steer else -1 for w in model.rover.wheels]
        self._steer, self._steered = np.maximum(steer, 0), np.array(steer) >= 0

    @property
    def dt(self) -> float:
        """Time step of the model, s."""
        return self.model.timestep

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Actuated joints in the order of the controls."""
        return self.model.rover.joints

    def reset(
        self, params: Params, x: Any = 0.0, y: Any = 0.0, yaw: Any = 0.0, winding_temperature: Any = None
    ) -> State:
        """A rover at rest on the terrain, its joints at zero, leaning with the slope under its wheels.

        Args:
          params: parameters.
          x, y: where its chassis frame stands, m, world frame.
          yaw: heading, rad, 0 along world x.
          winding_temperature: of all motors, winding and housing alike, K; ambient if None.

        Returns:
          The state.
        """
        dtype = jnp.result_type(float)
        # A rover starts in MuJoCo's reference pose (joints at zero, loops closed); only the free joint's seven numbers
        # are set here.
        qpos = jnp.asarray(self.engine.qpos0, dtype)
        position, quaternion = self._stand(
            params, jnp.asarray(x, dtype), jnp.asarray(y, dtype), jnp.asarray(yaw, dtype)
        )
        qpos = jnp.concatenate([position, quaternion, qpos[7:]])
        joint = jnp.zeros(len(self.joint_names), dtype)
        ambient = params.ambient_temperature(jnp.zeros((), dtype))
        warm = ambient if winding_temperature is None else winding_temperature
        # Temperatures are kept as offsets, whose small sums float32 does not lose (see `Temperature`).
        offset = joint + (jnp.asarray(warm, dtype) - REFERENCE_TEMPERATURE)
        wheel = jnp.zeros(len(self.model.rover.wheels), dtype)
        shapes = {"joint": joint, "wheel": wheel, "rover": jnp.zeros((), dtype)}
        effects = {
            e.name: {name: s.reset(shapes[s.axis]) for name, s in e.state.items()}
            for e in self.model.effects
            if e.state
        }
        return State(
            step=jnp.zeros((), jnp.int32),
            qpos=qpos,
            qvel=jnp.zeros(self.engine.nv, dtype),
            temperature=Temperature(offset, joint, offset, joint),
            effects=effects,
        )

    # GPUs multiply float32 matrices in TF32 unless told otherwise: a height of 5 m would be wrong by millimetres.
    @jax.default_matmul_precision("highest")
    def _stand(self, params: Params, x: Any, y: Any, yaw: Any) -> tuple[Any, Any]:
        """Pose on the plane fitted to the terrain under the wheels, none of which lies below the surface."""
        feet = self.engine.wheel_feet
        cos, sin = jnp.cos(yaw), jnp.sin(yaw)
        wheel_x, wheel_y = x + cos * feet[:, 0] - sin * feet[:, 1], y + sin * feet[:, 0] + cos * feet[:, 1]
        height, _, _ = sample(params.terrain.field, wheel_x, wheel_y)
        design = np.column_stack([np.ones(len(feet)), feet[:, :2]])
        # Least squares, since a rover of six wheels stands on more points than a plane has; the pseudo-inverse depends
        # on the rover alone and is a constant of the program.
        fit = jnp.asarray(np.linalg.pinv(design), height.dtype) @ height
        # Roll is the second rotation, so the cross slope counts along an axis that pitch has already tilted.
        pitch, roll = jnp.arctan(-fit[1]), jnp.arctan(fit[2] * jnp.cos(jnp.arctan(fit[1])))
        # The wheel that the fitted plane cuts deepest sets the height: a wheel that began below the surface would be
        # thrown up by its contact.
        above = jnp.max(height - jnp.asarray(design, height.dtype) @ fit)
        quaternion = _quaternion(roll, pitch, yaw)
        up = Vec3(*_rotate_z(quaternion))
        lift = self.model.rover.standing_height
        # the frame's origin stands above the fitted plane along its normal
        ground = fit[0] + above
        return jnp.stack([x + lift * up.x, y + lift * up.y, ground + lift * up.z]), quaternion

    def step(self, params: Params, state: State, control: Any) -> tuple[State, Telemetry]:
        """Advances one rover by one time step.

        Args:
          params: parameters.
          state: state at the beginning of the step.
          control: (joint,) target of every actuated joint, in its mode's unit (rad, rad/s, N m, A), held over the step.

        Returns:
          The state at the end of the step, and what the step saw at its beginning.
        """
        # The engine hands back a closure, so that kinematics are computed once: effects read them, and the end of the
        # step goes on with them.
        kinematics, finish = self.engine.forward(params, state.qpos, state.qvel, self.dt)
        ctx = self._context(params, state, kinematics)
        forces, ctx, effects = apply_effects(self.pipeline, ctx, jnp.asarray(control, state.qpos.dtype), state.effects)
        heat, effects, temperature = step_heat(
            self.pipeline, self.model.thermal_integrator, ctx, state.temperature, effects
        )
        qpos, qvel = finish(forces)
        telemetry = _telemetry(ctx, kinematics, heat, state.effects)
        return State(state.step + 1, qpos, qvel, temperature, effects), telemetry

    def rollout(self, params: Params, state: State, controls: Any, every: int = 1) -> tuple[State, Telemetry]:
        """Drives one rover through a sequence of controls.

        Args:
          params: parameters.
          state: initial state.
          controls: (time, joint) controls, each held for `every` steps.
          every: steps per control and per reported telemetry.

        Returns:
          The final state, and telemetry with a leading time axis (at the beginning of each control).
        """

        def hold(state: State, control: Any) -> tuple[State, Telemetry]:
            new, telemetry = self.step(params, state, control)
            if every > 1:
                # Begun anew from the old state, so that the step above is only its telemetry: half the compilation.
                new = jax.lax.fori_loop(0, every, lambda _, s: self.step(params, s, control)[0], state)
            return new, telemetry

        # A scan and not a Python loop: one compiled step whatever the length of the drive.
        return jax.lax.scan(hold, state, controls)

    def step_batch(
        self, params: Params, state: State, control: Any, params_axes: batch.Axes = None, chunk: int | None = None
    ) -> tuple[State, Telemetry]:
        """Advances many rovers by one time step; faster than `vmap` of `step`, with the same result.

        Args:
          params: parameters, shared by all rovers except where `params_axes` says otherwise.
          state: states with a leading batch axis.
          control: (batch, joint) targets.
          params_axes: None where parameters are shared; else a prefix of `params`, as `vmap`'s `in_axes`, with 0 for
            leaves that have a leading batch axis: `Params(gravity=0, ambient=None, effects=None, terrain=0)`.
          chunk: most rovers to hold in the cache at once; a value that suits the device if None.

        Returns:
          States and telemetry with a leading batch axis.

        Raises:
          UserError: leading axes that differ.
        """
        return batch.step_batch(self, params, state, control, params_axes, chunk)

    def rollout_batch(
        self,
        params: Params,
        state: State,
        controls: Any,
        every: int = 1,
        params_axes: batch.Axes = None,
        report: Callable[[Telemetry], Any] | None = None,
        chunk: int | None = None,
        one_body: bool = False,
        last: bool = False,
    ) -> tuple[State, Any]:
        """Drives many rovers through a sequence of controls.

        Args:
          params, params_axes, chunk: as for `step_batch`.
          state: states with a leading batch axis.
          controls: (batch, time, joint), or (time, joint) for all rovers, each held for `every` steps.
          every: steps per control and per reported telemetry.
          report: what to keep of a step's telemetry, elementwise; all of it if None.
          one_body: compile the step once, not once more for the steps without telemetry: half the compile time, for
            somewhat slower steps.
          last: report the last step of every control, not its first.

        Returns:
          The final states, and what was kept, with leading axes (batch, time).
        """
        return batch.rollout_batch(self, params, state, controls, every, params_axes, report, chunk, one_body, last)

    def _context(self, params: Params, state: State, k: Kinematics) -> Context:
        dtype = state.qpos.dtype
        # from the number of steps: sums of dt would drift in float32 by seconds within a day
        time = state.step.astype(dtype) * jnp.asarray(self.dt, dtype)
        return Context(
            time=time,
            dt=jnp.asarray(self.dt, dtype),
            gravity=params.gravity,
            ambient_temperature=params.ambient_temperature(time),
            position=k.position,
            frame=k.frame,
            velocity=k.velocity,
            angular_velocity=k.angular_velocity,
            joint_angle=k.joint_angle,
            joint_speed=k.joint_speed,
            winding_temperature=state.temperature.winding_kelvin,
            housing_temperature=state.temperature.housing_kelvin,
            steering_angle=jnp.where(self._steered, select(k.joint_angle, self._steer), 0.0),
            wheel_position=k.wheel_position,
            wheel_axle=k.wheel_axle,
            wheel_velocity=k.wheel_velocity,
            wheel_angular_velocity=k.wheel_angular_velocity,
            terrain=params.terrain,
            rover=jax.tree.map(lambda a: jnp.asarray(a, dtype) if a.dtype.kind == "f" else jnp.asarray(a), self.info),
            parameters={name: SimpleNamespace(**values) for name, values in params.effects.items()},
            sunlight=None if params.sun is None else params.sun.light(time, k.position.x, k.position.y),
            bus_voltage=_bus_voltage(params, state),
        )


def build(model: Model, engine: str = "auto") -> System:
    """Makes a model ready to run; `engine` is "auto" (the fastest that fits), "structured" or "mjx".

    Raises:
      UserError: unknown engine, a rover that the engine cannot run exactly, or an effect whose motor is missing.
    """
    from lunar_mjx.model import check_effects  # which imports this package

    check_effects(model, "build")
    return System(model, engine)


def rover_info(model: Model) -> RoverInfo:
    """The rover as drawn, with the control modes and gains of the model."""
    rover: Rover = model.rover
    # The order of `RoverInfo.joint_group`, which effects compare with.
    names = ("drive", "steer", "suspension")
    groups = [(g, names.index(g.name)) for g in rover.groups for _ in g.joints]
    limits = np.array([rover.joint_limits[j] for j in rover.joints], float)
    points = np.asarray(rover.chassis_points, float)
    compiled = rover.compile()
    dofs = [compiled.joint(j).dofadr[0] for j in rover.joints]
    center, half = chassis_boxes(compiled, compiled.body(rover.chassis).id)
    return RoverInfo(
        wheel_radius=np.array([w.radius for w in rover.wheels]),
        wheel_width=np.array([w.width for w in rover.wheels]),
        joint_group=np.array([i for _, i in groups]),
        joint_lower=limits[:, 0],
        joint_upper=limits[:, 1],
        mode=np.array([MODES.index(model.modes[g.name]) for g, _ in groups]),
        position_gain=np.array([model.gains[g.name][0] for g, _ in groups]),
        velocity_gain=np.array([model.gains[g.name][1] for g, _ in groups]),
        chassis_points=Vec3(*points.T),
        box_center=Vec3(*center.T) if len(center) else None,
        box_half=Vec3(*half.T) if len(half) else None,
        # MuJoCo's inverse weight is the joint's own inverse inertia in the whole mechanism at the reference pose, to
        # which the drawn rotor adds. A motor's takes its place.
        joint_inertia=1.0 / compiled.dof_invweight0[dofs] - ("motor" in model.parameters) * compiled.dof_armature[dofs],
        name=rover.name,
    )


def default_params(model: Model) -> Params:
    """The model's parameters as arrays of the default float type."""
    dtype = jnp.result_type(float)
    terrain, sun = jax.tree.map(
        lambda a: jnp.asarray(a, dtype) if jnp.issubdtype(jnp.asarray(a).dtype, jnp.floating) else jnp.asarray(a),
        (model.terrain, make_sun(model.sun, model.terrain)),
    )
    ambient = Ambient(*(jnp.asarray(v, dtype) for v in model.ambient))
    effects = {e.name: {k: jnp.asarray(v, dtype) for k, v in model.parameters[e.name].items()} for e in model.effects}
    return Params(jnp.asarray(model.gravity, dtype), ambient, effects, terrain, sun)


def _telemetry(ctx: Context, k: Kinematics, heat: Heat, effects: EffectState) -> Telemetry:
    contact, wheel = ctx.contact, ctx.wheel
    assert contact is not None and wheel is not None and ctx.command is not None and ctx.torque is not None
    motor = ctx.parameters.get("motor")
    if motor is None:
        current = voltage = joule = jnp.zeros_like(ctx.joint_angle)
    else:
        current = ctx.command.current
        resistance = winding_resistance(motor, ctx.winding_temperature)
        back_emf = constant_at(ctx.parameters, ctx.winding_temperature) * motor.gear_ratio * ctx.joint_speed
        voltage, joule = current * resistance + back_emf, current**2 * resistance
    return Telemetry(
        time=ctx.time,
        position=k.position,
        quaternion=k.quaternion,
        euler=k.frame.euler(),
        velocity=k.velocity,
        angular_velocity=k.angular_velocity,
        joint_angle=k.joint_angle,
        joint_speed=k.joint_speed,
        joint_torque=ctx.torque,
        current=current,
        voltage=voltage,
        winding_temperature=ctx.winding_temperature,
        housing_temperature=ctx.housing_temperature,
        joule_heat=joule,
        winding_heat=heat.winding,
        housing_heat=heat.housing,
        wheel_position=k.wheel_position,
        wheel_velocity=k.wheel_velocity,
        sinkage=contact.sinkage,
        slip=contact.slip,
        slip_angle=contact.slip_angle,
        wheel_force=wheel.force,
        wheel_moment=wheel.moment,
        on_terrain=contact.inside,
        supply=_supply(ctx, effects),
    )


def _bus_voltage(params: Params, state: State) -> Any:
    """Voltage of the battery as the step before left it, V; None without one.

    The port `command` comes before `power`, so that a step limits its motors by the voltage that it finds.
    """
    battery = state.effects.get("battery")
    if battery is None:
        return None
    return terminal_voltage(SimpleNamespace(**params.effects["battery"]), SimpleNamespace(**battery))


def _supply(ctx: Context, effects: EffectState) -> Supply | None:
    """Power of the step, and charge and temperature at its beginning; None for a model that has none of them."""
    power, parameters = ctx.power, ctx.parameters
    supplied: dict[str, Any] = {} if power is None else {"load": power.load, "solar": power.solar}
    if "battery" in effects:
        supplied["charge"] = charge_of(parameters["battery"], effects["battery"]["used"])
        supplied["voltage"] = ctx.bus_voltage
    if "chassis_node" in effects:
        node = SimpleNamespace(**effects["chassis_node"])
        supplied["chassis_temperature"] = chassis_temperature(parameters["chassis_node"], node)
    return Supply(**supplied) if supplied else None


def _quaternion(roll: Any, pitch: Any, yaw: Any) -> Any:
    """w, x, y, z of intrinsic z-y'-x'' Euler angles."""
    cr, sr = jnp.cos(0.5 * roll), jnp.sin(0.5 * roll)
    cp, sp = jnp.cos(0.5 * pitch), jnp.sin(0.5 * pitch)
    cy, sy = jnp.cos(0.5 * yaw), jnp.sin(0.5 * yaw)
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def _rotate_z(q: Any) -> tuple[Any, Any, Any]:
    """The body's up axis in the world."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    return 2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)
