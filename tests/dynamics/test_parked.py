"""A rover that is set down and left standing comes to rest, and from nearly the same start to nearly the same rest."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.system import default_params
from lunar_mjx.model import make_model

OFFSETS = np.linspace(-2.9e-3, -2.3e-3, 41)
"""Errors of the wheels' radius, m: rovers that fall for 25 to 29 steps before they touch the ground."""
DURATION = 1.5
COLUMNS = {
    ("wheel_radius_error", "offset"): 0,
    ("slip_sinkage", "driving"): 1,
    ("slip_sinkage", "skid"): 2,
    ("slide_softening", "softening"): 3,
}
"""What differs between rovers, by effect and parameter."""


@functools.cache
def _parked():
    """Vertical wheel speeds (row, time, wheel), m/s, and joint speeds (row, joint) at the end, on a slope of 8 deg.

    Rows: slip-sinkage none, usual; slide-softening usual; then the offsets.
    """
    with jax.enable_x64(True):
        model = make_model("luvmi_x", terrain="slope:8deg").add("wheel_radius_error", offset=0.0)
        model = model.add("slip_sinkage", driving=0.0, skid=0.0).add("slide_softening", softening=0.0)
        system = build(model)
        params = default_params(model)
        rows = np.zeros((3 + len(OFFSETS), 4))
        rows[1, 1:3], rows[2, 3], rows[3:, 0] = (1.0, 0.5), 1.0, OFFSETS

        axes = {name: {k: 0 if (name, k) in COLUMNS else None for k in v} for name, v in params.effects.items()}
        each = dataclasses.replace(params, gravity=None, ambient=None, terrain=None, effects=axes)
        start = jax.jit(system.reset)(params)

        @jax.jit
        def stand(rows):
            effects = {
                name: {k: rows[:, COLUMNS[name, k]] if (name, k) in COLUMNS else v for k, v in values.items()}
                for name, values in params.effects.items()
            }
            starts = jax.tree.map(lambda a: jnp.broadcast_to(a, (len(rows), *a.shape)), start)
            still = jnp.zeros((round(DURATION / system.dt), len(system.joint_names)))
            mine = dataclasses.replace(params, effects=effects)
            return system.rollout_batch(
                mine, starts, still, params_axes=each, report=lambda seen: (seen.wheel_velocity.z, seen.joint_speed)
            )[1]

        vertical, speeds = jax.device_get(stand(jnp.asarray(rows)))
        return vertical, speeds[:, -1]


def test_soil_that_softens_with_slip_does_not_shake_a_parked_rover():
    """With the slip of the moment in place of the soil's own, wheels go up and down at 21 and 17 mm/s for ever."""
    vertical, _ = _parked()
    late = np.abs(vertical[:3, round(0.8 * vertical.shape[1]) :]).max(axis=(1, 2))
    assert (late < 2e-3).all(), late


def test_a_rover_stands_alike_after_alike_touchdowns():
    """The step in which a wheel touches the ground is a whole number; what it leaves behind must not show that.

    With a least contact length of a thousandth of the radius speeds bend by 2 mrad/s from one rover to the next.
    """
    _, speeds = _parked()
    bends = np.abs(np.diff(speeds[3:], 2, axis=0)).max()
    assert 0.0 < bends < 5e-4


def test_stiff_soil_does_not_shake_a_rover_that_stops():
    """A drive cannot follow soil that is stiff and damps for long: its wheels had gone to and fro at 0.2 rad/s.

    Parameters are such as refits try, within what is usual of each.
    """
    model = make_model("husky", terrain="flat", preset="consistent")
    rotor = 0.3 * np.asarray(model.parameters["motor"]["rotor_inertia"])
    model = model.set("motor", rotor_inertia=tuple(rotor)).set("shear_state", relaxation=0.14)
    with jax.enable_x64(True):
        system = build(model)
        params = default_params(model)
        commands = jnp.zeros((750, len(system.joint_names))).at[100:300].set(0.5)
        start = system.reset(params)
        speed = jax.device_get(jax.jit(system.rollout)(params, start, commands)[1].joint_speed)
    assert np.abs(speed[300:]).max() > 0.1
    assert np.abs(speed[-100:]).max() < 0.02


def test_what_differs_between_rovers_that_stand_does_not_grow():
    """Soil that renews itself over millimetres is a spring of which an explicit step makes an oscillation.

    Parameters are near those to which a refit of a foreign Husky had come, whose soil creeps. Differences between two
    rovers that stood grew by 1.7 a step there (largest eigenvalue of a step), so that no derivative told anything.
    """
    model = make_model("husky", terrain="flat", preset="consistent")
    rotor = 0.53 * np.asarray(model.parameters["motor"]["rotor_inertia"])
    soil = {k: float(f * model.parameters["soil"][k]) for k, f in (("cohesion", 22.0), ("shear_modulus_x", 0.59))}
    model = model.set("motor", rotor_inertia=tuple(rotor)).set("soil", **soil)
    model = model.set("shear_state", relaxation=0.0048, creep=0.06)
    with jax.enable_x64(True):
        system = build(model)
        params = default_params(model)
        still = jnp.zeros((750, len(system.joint_names)))
        state = jax.jit(system.rollout)(params, system.reset(params), still)[0]
        numbers, tree = jax.tree.flatten(state)
        floats = [i for i, v in enumerate(numbers) if jnp.issubdtype(v.dtype, jnp.floating)]

        def after(values):
            own = list(numbers)
            for i, value in zip(floats, values, strict=True):
                own[i] = value
            stepped = jax.tree.leaves(system.step(params, jax.tree.unflatten(tree, own), still[0])[0])
            return [stepped[i] for i in floats]

        slopes = jax.device_get(jax.jit(jax.jacfwd(after))([numbers[i] for i in floats]))
    sizes = [numbers[i].size for i in floats]
    whole = np.block(
        [
            [np.reshape(part, (n, m)) for part, m in zip(row, sizes, strict=True)]
            for row, n in zip(slopes, sizes, strict=True)
        ]
    )
    assert np.abs(np.linalg.eigvals(whole)).max() < 1.0 + 1e-6
