"""A single-wheel test bed: imposed slip, slip angle and load; the wheel sinks until the soil carries it.

The forces come from the very port functions that the simulator calls; nothing of them is written again here. Effects
marked `transient` are left out, because a test bed reports the steady state.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Mapping, Sequence
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Bool, Float

from lunar_mjx.effects import catalogue, presets
from lunar_mjx.effects.base import Effect
from lunar_mjx.effects.context import Context, RoverInfo
from lunar_mjx.effects.ports import Pipeline, nominal_geometry, wheel_contact, wheel_ports
from lunar_mjx.errors import UserError, bad_input
from lunar_mjx.pytree import AnyArray, pytree
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import Terrain, flat

if TYPE_CHECKING:
    from lunar_mjx.model import Model

PORTS = ("geometry", "soil", "wheel_normal", "wheel_shear")
"""The ports that a test bed runs."""

SLIP_DEFINITIONS = ("wheel_frame", "travel_speed")
"""What the rim speed is compared with: v_x = V cos(beta) of the wheel's frame (eq. 8), or the travel speed V."""

EARTH_GRAVITY = 9.80665
"""m/s2; standard gravity (3rd CGPM 1901): test beds stand on the Earth."""

SPEED = 1.0
"""Larger of rim and travel speed at which the bed runs, m/s. The steady force of the effects that ship does not depend
on speed, and well above the speed floors that regularise standstill the imposed slip is exact."""


@dataclasses.dataclass(frozen=True)
class BedSearch:
    """How the bed looks for the sinkage that carries the load."""

    deepest: float = 1.5
    """Largest sinkage looked at, in wheel radii: up to there the contact arc is followed."""
    shallowest: float = 1e-6
    """Least sinkage looked at, in wheel radii: a tenth of a micrometre, far below what any load makes."""
    scan: int = 48
    """Sinkages at which a bracket is looked for, 35 % apart."""
    bisections: int = 33
    """Halvings of the bracket: to 3e-11 of the sinkage, before one Newton step."""


BED_SEARCH = BedSearch()


Parameters = Mapping[str, Mapping[str, Any]]


@pytree
class WheelTest:
    """What a test bed imposes; every field is one number or one per point.

    Attributes:
      rim_speed: r times the wheel's angular velocity, m/s.
      travel_speed: speed of the wheel's centre over the ground, m/s.
      slip_angle: between the wheel's heading and its velocity, rad, positive when it moves to its left.
      normal_load: weight that the ground carries, N.
      radius, width: of the wheel, m.
    """

    rim_speed: Float[AnyArray, "*point"]
    travel_speed: Float[AnyArray, "*point"]
    slip_angle: Float[AnyArray, "*point"]
    normal_load: Float[AnyArray, "*point"]
    radius: Float[AnyArray, "*point"]
    width: Float[AnyArray, "*point"]


@pytree
class WheelResult:
    """What a test bed measures; one entry per point.

    Attributes:
      drawbar_pull: force of the soil on the wheel along its heading, N.
      side_force: force of the soil across the wheel, N, positive where it opposes a positive slip angle (the sign of
        test beds; the simulator's force along the wheel's left axis is its negative).
      driving_torque: that the motor supplies to keep the wheel turning, N m.
      sinkage: of the wheel's lowest point, m.
      vertical_force: of the soil on the wheel at the sinkage found, N: the load to rounding, where reached.
      reached: whether some sinkage up to 1.5 radii carries the load; elsewhere the result is that of 1.5 radii.
    """

    drawbar_pull: Float[AnyArray, "*point"]
    side_force: Float[AnyArray, "*point"]
    driving_torque: Float[AnyArray, "*point"]
    sinkage: Float[AnyArray, "*point"]
    vertical_force: Float[AnyArray, "*point"]
    reached: Bool[AnyArray, "*point"]


class _Loads(NamedTuple):
    drawbar: Any
    side: Any
    torque: Any
    vertical: Any


def wheel_test(
    slip_ratio: Any, slip_angle: Any, normal_load: Any, radius: Any, width: Any, slip_definition: str = "wheel_frame"
) -> WheelTest:
    """A test at given slip ratios.

    Args:
      slip_ratio: -1 (locked) to 1 (spinning on the spot), by `slip_definition`.
      slip_angle: rad; below a right angle where the slip is that of the wheel's frame.
      normal_load: N, positive.
      radius, width: of the wheel, m.
      slip_definition: "wheel_frame" or "travel_speed".

    Returns:
      The test, with the larger of rim speed and travel speed at `SPEED`.

    Raises:
      UserError: unknown definition of slip.
    """
    if slip_definition not in SLIP_DEFINITIONS:
        raise bad_input(
            "wheel_test",
            "slip_definition",
            slip_definition,
            "does not exist",
            f"use one of {', '.join(SLIP_DEFINITIONS)}",
        )
    arrays = (slip_ratio, slip_angle, normal_load, radius, width)
    slip, angle, load, radius, width = jnp.broadcast_arrays(*(jnp.asarray(a, float) for a in arrays))
    rim = jnp.where(slip >= 0.0, 1.0, 1.0 + slip)
    along = jnp.where(slip >= 0.0, 1.0 - slip, 1.0)
    travel = along if slip_definition == "travel_speed" else along / jnp.cos(angle)
    # The faster of the two runs at the bed's speed, whatever the slip: neither becomes so slow that a speed floor acts.
    # Only the proportion of the two speeds counts: no shipped steady effect knows a rate.
    scale = SPEED / jnp.maximum(rim, travel)
    return WheelTest(scale * rim, scale * travel, angle, load, radius, width)


class WheelBed:
    """A test bed for a list of effects: `bed(parameters, test)` is pure; jit, vmap and grad compose over it.

    Attributes:
      effects: those that act in the steady state.
      parameters: their values, by effect and name.
      gravity: m/s2.
    """

    def __init__(
        self, effects: Sequence[Effect | str], parameters: Parameters | None = None, gravity: float = EARTH_GRAVITY
    ):
        effect_list = [catalogue.get(e) if isinstance(e, str) else e for e in effects]
        # Without states there is no history to run in: one evaluation of the ports is the steady state.
        self.effects = tuple(e for e in effect_list if not e.transient and any(port in PORTS for port in e.ports))
        given = parameters or {}
        self.parameters = {e.name: {**e.nominal(), **given.get(e.name, {})} for e in self.effects}
        for name, values in self.parameters.items():
            for key, value in values.items():
                if isinstance(value, tuple | list):
                    raise bad_input(
                        "WheelBed",
                        f"effects.{name}.{key}",
                        value,
                        "has one value per wheel",
                        "give one number: a test bed has one wheel",
                    )
        for effect in self.effects:
            for key, value in given.get(effect.name, {}).items():
                # Fits hand on arrays and traced values, which are checked where they come from.
                effect.check(key, value if isinstance(value, int | float) else effect.nominal()[key], "WheelBed")
        ports = {port for e in self.effects for port in e.ports}
        if not {"wheel_normal", "wheel_shear"} <= ports:
            raise UserError(
                "WheelBed: the effects hold no wheel-soil contact; add one at wheel_normal and one at wheel_shear, "
                "such as pressure_sinkage and closed_form_shear."
            )
        self.gravity = gravity
        self._pipeline = Pipeline(self.effects)
        self._compiled = jax.jit(self.__call__)

    @classmethod
    def of_preset(cls, preset: str) -> WheelBed:
        """The wheel of a preset, "consistent", "field" or "paper", with the preset's parameters.

        Raises:
          UserError: no such preset.
        """
        if preset not in presets.PRESETS:
            raise bad_input("WheelBed", "preset", preset, "does not exist", f"use one of {', '.join(presets.PRESETS)}")
        values: dict[str, Any] = {}
        # Twice: the first bed tells which effects stay, so that values of the others are not refused.
        bed = cls(presets.PRESETS[preset])
        for name in bed.parameters:
            values[name] = presets.PRESET_PARAMETERS[preset].get(name, {})
        return cls(bed.effects, values)

    @classmethod
    def of_model(cls, model: Model) -> WheelBed:
        """The wheel of a model, under the Earth's gravity where test beds stand."""
        return cls(model.effects, {name: dict(values) for name, values in model.parameters.items()})

    @classmethod
    def of_first_wheel(cls, model: Model, gravity: float) -> WheelBed:
        """The wheel of a model under a gravity, m/s2; of parameters with one value per wheel or joint it has the first.

        For tables, which do not say which one of the rover's wheels they measured.
        """

        def first(value: Any) -> Any:
            return float(value[0]) if isinstance(value, tuple | list) else value

        values = {e: {k: first(v) for k, v in own.items()} for e, own in model.parameters.items()}
        return cls(model.effects, values, gravity)

    def with_effect(self, effect: Effect | str, **values: float) -> WheelBed:
        """The bed with one more effect, in the place of those that it replaces."""
        added = catalogue.get(effect) if isinstance(effect, str) else effect
        kept = [e for e in self.effects if e.name not in added.replaces]
        return WheelBed([*kept, added], {**self.parameters, added.name: values}, self.gravity)

    def with_values(self, values: Parameters) -> WheelBed:
        """The bed with other parameter values, by effect and name; what was compiled is shared."""
        # Shallow, so that the compiled function goes along: parameters are its arguments and not part of it.
        bed = copy.copy(self)
        bed.parameters = self.merged(values)
        return bed

    def run(self, test: WheelTest) -> WheelResult:
        """Runs the test with the bed's own parameters, compiled once for each number of points, in float64.

        Returns:
          The results as NumPy arrays.
        """
        # Tables are compared to a tenth of their noise and fits take derivatives: float32 would show.
        with jax.enable_x64(True):
            return jax.device_get(self._compiled(self.parameters, test))

    def merged(self, values: Parameters) -> dict[str, dict[str, Any]]:
        """The bed's parameters with `values` in place of some."""
        unknown = [n for n in values if n not in self.parameters]
        if unknown:
            raise bad_input(
                "WheelBed",
                "effect",
                unknown[0],
                "does not act on this wheel",
                f"use one of {', '.join(self.parameters)}",
            )
        return {name: {**old, **values.get(name, {})} for name, old in self.parameters.items()}

    def __call__(self, parameters: Parameters, test: WheelTest) -> WheelResult:
        """Runs the test at every point.

        The sinkage is the smallest at which the vertical force reaches the load: bracketed on a grid, bisected, and
        finished by one linearised Newton step, through which alone the result is differentiated (implicit functions).

        Args:
          parameters: values by effect and name, as `merged` makes them.
          test: what is imposed; fields broadcast.

        Returns:
          The results, finite everywhere; `reached` tells where the load was carried.
        """
        fields = [getattr(test, f.name) for f in dataclasses.fields(WheelTest)]
        arrays = jnp.broadcast_arrays(*(jnp.asarray(a, float) for a in fields))
        shape = arrays[0].shape
        points = WheelTest(*(a.reshape(-1) for a in arrays))
        terrain = flat(4.0, dtype=points.radius.dtype)
        result = jax.vmap(lambda point: self._settle(parameters, point, terrain))(points)
        return jax.tree.map(lambda a: a.reshape(shape), result)

    def _settle(self, parameters: Parameters, test: WheelTest, terrain: Terrain) -> WheelResult:
        def loads(sinkage: Any) -> _Loads:
            return self._loads(parameters, test, terrain, sinkage)

        # The search carries no derivative; the step after it does.
        still_parameters, still_test = jax.lax.stop_gradient((parameters, test))

        deepest = BED_SEARCH.deepest * still_test.radius
        # In proportion, because loads range over decades and so do sinkages.
        grid = deepest * jnp.geomspace(BED_SEARCH.shallowest, 1.0, BED_SEARCH.scan, dtype=deepest.dtype)

        # One loop for scan and bisection: the forces are then compiled once.
        def probe(i: Any, bracket: tuple[Any, Any, Any]) -> tuple[Any, Any, Any]:
            low, high, is_found = bracket
            scanning = i < BED_SEARCH.scan
            at = jnp.where(scanning, grid[jnp.minimum(i, BED_SEARCH.scan - 1)], 0.5 * (low + high))
            enough = self._loads(still_parameters, still_test, terrain, at).vertical >= still_test.normal_load
            live = jnp.logical_not(scanning & is_found)
            return (
                jnp.where(live & jnp.logical_not(enough), at, low),
                jnp.where(live & enough, at, high),
                is_found | (scanning & enough),
            )

        start = (jnp.zeros_like(deepest), deepest, jnp.asarray(False))
        low, high, reached = jax.lax.fori_loop(0, BED_SEARCH.scan + BED_SEARCH.bisections, probe, start)
        root = jnp.where(reached, 0.5 * (low + high), deepest)
        load_at_root, slope = jax.jvp(loads, (root,), (jnp.ones_like(root),))
        # Held fixed: the step's derivative is then that of an implicit function, without second derivatives.
        slope = jax.lax.stop_gradient(slope)
        # A root of zero slope has no derivative; it is left where the bisection put it.
        firm = reached & (jnp.abs(slope.vertical) > 0.0)
        change = jnp.where(firm, (test.normal_load - load_at_root.vertical) / jnp.where(firm, slope.vertical, 1.0), 0.0)
        settled = jax.tree.map(lambda value, rate: value + rate * change, load_at_root, slope)
        # The force at the root tells how well the search did; the settled one would equal the load by construction.
        return WheelResult(settled.drawbar, settled.side, settled.torque, root + change, load_at_root.vertical, reached)

    def _loads(self, parameters: Parameters, test: WheelTest, terrain: Terrain, sinkage: Any) -> _Loads:
        ctx = _bed_context(parameters, test, terrain, sinkage, self.gravity)
        geometry, _ = self._pipeline.run("geometry", ctx, {}, nominal_geometry(ctx.rover))
        # A bed turns the wheel at an angular velocity; its rim speed and slip are those of the radius that was drawn.
        # Load and sinkage belong to the wheel as it is, so its hub stands at the true radius.
        spin = Vec3(ctx.wheel_velocity.x * 0.0, test.rim_speed / test.radius, ctx.wheel_velocity.x * 0.0)
        place = ctx.wheel_position._replace(z=geometry.radius - sinkage)
        ctx = dataclasses.replace(ctx, geometry=geometry, wheel_angular_velocity=spin, wheel_position=place)
        contact = wheel_contact(ctx)
        ctx = dataclasses.replace(ctx, contact=dataclasses.replace(contact, sinkage=contact.sinkage * 0.0 + sinkage))
        ctx, _ = wheel_ports(self._pipeline, ctx, {})
        wheel = ctx.wheel
        assert wheel is not None
        # Signs of test beds: what the motor supplies and what opposes the side slip are positive.
        return _Loads(wheel.force.x[0], -wheel.force.y[0], -wheel.moment.y[0], wheel.force.z[0])


def _bed_context(parameters: Parameters, test: WheelTest, terrain: Terrain, sinkage: Any, gravity: float) -> Context:
    """A rover of one wheel, its axle held level, drawn over flat ground."""
    one = jnp.ones(1, jnp.result_type(test.radius))
    zero, nil = 0.0 * one, 0.0 * one[0]
    still, nowhere = Vec3(zero, zero, zero), Vec3(nil, nil, nil)
    rover = RoverInfo(
        wheel_radius=test.radius * one,
        wheel_width=test.width * one,
        joint_group=jnp.zeros(1, int),
        joint_lower=-jnp.inf * one,
        joint_upper=jnp.inf * one,
        mode=jnp.ones(1, int),
        position_gain=zero,
        velocity_gain=zero,
        chassis_points=still,
        name="single_wheel_bed",
    )
    return Context(
        time=nil,
        # Read by friction limits alone; no state is stepped.
        dt=nil + 1e-3,
        gravity=nil + gravity,
        ambient_temperature=nil + 298.15,
        position=nowhere,
        frame=Frame(Vec3(nil + 1.0, nil, nil), Vec3(nil, nil + 1.0, nil), Vec3(nil, nil, nil + 1.0)),
        velocity=nowhere,
        angular_velocity=nowhere,
        joint_angle=zero,
        joint_speed=zero,
        steering_angle=zero,
        winding_temperature=zero + 298.15,
        housing_temperature=zero + 298.15,
        wheel_position=Vec3(zero, zero, zero + test.radius - sinkage),
        wheel_axle=Vec3(zero, one, zero),
        wheel_velocity=Vec3(
            test.travel_speed * jnp.cos(test.slip_angle) * one, test.travel_speed * jnp.sin(test.slip_angle) * one, zero
        ),
        wheel_angular_velocity=still,
        terrain=terrain,
        rover=rover,
        parameters={name: SimpleNamespace(**values) for name, values in parameters.items()},
    )
