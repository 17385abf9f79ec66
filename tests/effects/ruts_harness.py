"""What one time step makes of wheels that roll in their own ruts, for tests under one wheel and under four."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp

from lunar_mjx.effects.context import Geometry
from lunar_mjx.effects.ports import Pipeline, nominal_geometry, wheel_contact, wheel_ports
from lunar_mjx.effects.soil.ruts import PATCH
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain import HeightField
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

RADIUS, WIDTH, MASS, GRAVITY, DT = 0.25, 0.2, 110.0, 1.625, 0.02
"""Of a wheel, m, and a quarter of VIPER's mass, kg, on the Moon, m/s2; time step, s."""
NAMES = ("rim_contact", "soil", "ruts", "pressure_sinkage", "closed_form_shear")


class Wheels:
    """Some wheels whose axles point left, on a height field."""

    def __init__(self, count: int):
        self.pipeline = Pipeline(effects_named(NAMES))
        self.one = jnp.ones(count)
        self.drawn: Geometry = nominal_geometry(rover_info(RADIUS * self.one, WIDTH * self.one))

    def forces(self, field: HeightField, place: Vec3, v_x: Any, v_z: Any, rim: Any, memory: Any) -> Any:
        """What the ports settle, the patch of soil after the step, and the force on each wheel, world frame, N."""
        zero = 0.0 * self.one
        ctx = bare_context(
            dt=jnp.asarray(DT, jnp.result_type(place.z)),
            gravity=GRAVITY,
            terrain=SimpleNamespace(field=field),
            wheel_position=place,
            wheel_axle=Vec3(zero, self.one, zero),
            wheel_velocity=Vec3(v_x * self.one, zero, v_z * self.one),
            wheel_angular_velocity=Vec3(zero, rim / RADIUS * self.one, zero),
            geometry=self.drawn,
            parameters=parameters(self.pipeline.effects, {}),
        )
        geometry, state = self.pipeline.run("geometry", ctx, {"ruts": memory}, self.drawn)
        ctx = dataclasses.replace(ctx, geometry=geometry)
        ctx = dataclasses.replace(ctx, contact=wheel_contact(ctx))
        done, state = wheel_ports(self.pipeline, ctx, state)
        contact: Any = done.contact
        wheel: Any = done.wheel
        force = contact.forward * wheel.force.x + contact.left * wheel.force.y + contact.normal * wheel.force.z
        return done, state["ruts"], force


def fresh_patch() -> dict[str, Any]:
    """The memory of a patch that no wheel has touched."""
    cells = jnp.zeros(PATCH.side * PATCH.side)
    return {"moved": cells, "pressed": cells, "tile": cells - 1e7}
