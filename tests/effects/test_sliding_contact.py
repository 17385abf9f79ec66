"""Wheels that move sideways: the flank as a blade, soil that enters from the side, contact lost behind the axle."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Contact, Soil, WheelForce
from lunar_mjx.effects.ports import initial_normal, nominal_geometry
from lunar_mjx.effects.wheel.closed_form import entrance_angle
from lunar_mjx.effects.wheel.sliding_contact import wall_bearing
from lunar_mjx.spatial import Vec3
from tests.effects.effects_harness import bare_context, parameters, rover_info, wheel_forces
from tests.effects.effects_reference import WheelState

R, B, Z = 0.0625, 0.05, 0.045
PHI, COHESION, K_Y, GRAVITY = np.radians(32.0), 200.0, 0.02, 9.81
Array = Any


def sideways(degrees: Array, rim: Array, speed: float = 0.1) -> tuple[WheelState, dict[str, Array]]:
    """Wheels that travel at slip angles with rim speeds, m/s; eq. 8 and eq. 11 in the steady state."""
    degrees, rim = np.broadcast_arrays(np.asarray(degrees, float), np.asarray(rim, float))
    one = np.ones(degrees.shape)
    v_x, v_y = speed * np.cos(np.radians(degrees)), speed * np.sin(np.radians(degrees))
    fastest = np.maximum(rim, v_x)
    slip = (rim - v_x) / fastest
    across = v_y / fastest * np.where(rim < v_x, 2.0 - rim / v_x, 1.0)
    state = WheelState(
        R * one,
        B * one,
        Z * one,
        0 * one,
        slip,
        across,
        one,
        0 * one,
        1e6 * one,
        one,
        COHESION * one,
        np.tan(PHI) * one,
        0.02 * one,
        K_Y * one,
    )
    return state, {"v_x": v_x, "v_y": v_y, "rim_speed": rim, "steering_angle": 0 * one}


def blade(degrees: Array, rim: Array, **values: float) -> Array:
    """Force of the flank alone, (3, wheels)."""
    side_wall = CATALOGUE["side_wall"]
    with jax.enable_x64(True):
        s, motion = sideways(degrees, rim)
        zero = jnp.zeros(s.sinkage.shape)
        nil = Vec3(zero, zero, zero)
        contact = Contact(
            s.sinkage,
            zero,
            s.slip_x,
            zero,
            motion["v_x"],
            motion["v_y"],
            motion["rim_speed"],
            nil,
            nil,
            nil,
            zero == 0,
            s.slip_x,
            jnp.abs(s.slip_x),
        )
        normal = initial_normal(zero)
        normal = dataclasses.replace(normal, entrance=entrance_angle(s.sinkage, s.radius))
        ctx = bare_context(
            gravity=GRAVITY,
            geometry=nominal_geometry(rover_info(s.radius, s.width)),
            contact=contact,
            normal=normal,
            soil=Soil(s.k_c, s.k_phi, s.n, s.cohesion, s.tan_phi, s.shear_modulus_x, s.shear_modulus_y, zero),
        )
        p = parameters([side_wall], {"side_wall": {"speed_scale": 1e-5, **values}})["side_wall"]
        wheel = WheelForce(s.slip_x, s.slip_y, s.direction, nil, nil)
        return np.array(side_wall.ports["wheel_shear"](ctx, p, None, wheel).force)


def test_bearing_is_that_of_coulomb() -> None:
    """Tabulated passive coefficients of a vertical wall (phi 30 deg); a smooth wall has Rankine's."""
    table = {0.0: 3.000, 5.0: 3.506, 10.0: 4.143, 15.0: 4.977, 20.0: 6.105}
    for delta, expected in table.items():
        assert float(wall_bearing(np.tan(np.radians(30)), np.tan(np.radians(delta)))) == pytest.approx(
            expected, abs=4e-3
        )
    assert float(wall_bearing(0.6, -0.1)) < float(wall_bearing(0.6, 0.0))


def test_without_friction_the_pressure_is_that_of_rankine() -> None:
    """Built up with the way and integrated over the segment by fine midpoints; a wheel that turns fast is near it."""
    for degrees in (15.0, 45.0, 75.0):
        push = -blade([degrees], [1e3], friction=0.0)[1, 0]
        half = np.sqrt(R * R - (R - Z) ** 2)
        x = half * (np.arange(20000) + 0.5) / 10000 - half
        h = np.sqrt(R * R - x * x) - (R - Z)
        k = np.tan(np.pi / 4 + PHI / 2) ** 2
        wall = 0.5 * k * 1600 * GRAVITY * h * h + 2 * COHESION * np.sqrt(k) * h
        grown = 1 - np.exp(-(half - x) * np.tan(np.radians(degrees)) / (4.0 * K_Y))
        assert push == pytest.approx(1.4 * np.mean(wall * grown) * 2 * half, rel=5e-3)
        assert -blade([degrees], [1e3])[1, 0] == pytest.approx(push, rel=0.1)


def test_a_locked_wheel_is_borne_and_pushes_harder() -> None:
    along, across, lift = blade([75.0, 75.0], [0.0, 10.0])
    assert 1.5 < across[0] / across[1] < 3.0
    assert lift[0] > 0.25 * -across[0] and abs(lift[1]) < 0.1 * -across[1]
    assert along[0] < 0.0 < along[1]


def test_no_sideways_motion_no_push() -> None:
    assert np.array_equal(blade([0.0, 0.0], [0.05, 0.2]), np.zeros((3, 2)))
    left, right = blade([40.0], [0.05]), blade([-40.0], [0.05])
    assert np.allclose(left * [[1], [-1], [1]], right, rtol=1e-12, atol=0)


def test_soil_from_the_side_and_behind_the_axle() -> None:
    """At 89 deg soil enters beside its place: kappa^n of the pressure; and no stress is left behind the axle."""
    names = ("stress_integral", "exit_angle", "side_entry", "side_exit")
    rear = {"exit_angle": {"c1": 0.5, "c2": 0.0, "c3": 0.5, "c4": 0.0}}
    state, motion = sideways([0.0, 89.0, 89.0], [0.1, 0.1, 1e3])
    none = {"side_entry": {"kept": 1.0}, "side_exit": {"lost": 0.0}}
    both = {"side_entry": {"kept": 0.3}, "side_exit": {"lost": 1.0}}
    before, after = (wheel_forces(names, state, motion, {**rear, **v}, np.float64)[1] for v in (none, both))
    theta, old, new = (np.array(a) for a in (before.stress.theta, before.stress.sigma, after.stress.sigma))
    assert np.allclose(new[:, 0], old[:, 0], rtol=1e-12)
    bottom = np.argmin(np.abs(theta[:, 1]) + (theta[:, 1] < 0))
    assert new[bottom, 1] == pytest.approx(0.3 * old[bottom, 1], rel=0.02)
    behind = theta[:, 1] < 0.0
    assert np.all(new[behind, 1] < 2e-3 * old[behind, 1].max())
    # a wheel that spins keeps feeding its rear, where side_entry alone acts
    assert np.all(new[behind, 2][-1:] > 10 * new[behind, 1][-1:])
    change = before.load - after.load
    area = R * B * np.array(before.stress.weight)
    assert np.allclose(change, np.sum(area * (old - new) * np.cos(theta), axis=0), rtol=1e-9, atol=1e-9)
