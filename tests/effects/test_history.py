"""Effects that a single step from rest does not show: they act through what went before, or outside the wheels."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Geometry
from lunar_mjx.effects.soil.multipass import PLACES
from lunar_mjx.spatial import Vec3

WHEELS = 2


def _call(name, port, ctx, values, state, value):
    p = SimpleNamespace(**{**{k: v.nominal for k, v in CATALOGUE[name].parameters.items()}, **values})
    return CATALOGUE[name].ports[port](ctx, p, SimpleNamespace(**state), value)


def _geometry():
    still = Vec3(*np.zeros(3))
    return Geometry(np.full(WHEELS, 0.25), np.full(WHEELS, 0.2), np.zeros(WHEELS), 0.0, still, still)


def test_gravity_error_is_relative_to_the_stated_value():
    with jax.enable_x64(True):
        found = _call("gravity_error", "geometry", SimpleNamespace(gravity=1.62), {"relative": 0.1}, {}, _geometry())
        assert float(found.gravity) == pytest.approx(1.782)


def test_a_wheel_wears_by_the_distance_that_it_has_rolled():
    spin, axle = Vec3(np.zeros(2), np.array([4.0, -2.0]), np.zeros(2)), Vec3(np.zeros(2), np.ones(2), np.zeros(2))
    ctx = SimpleNamespace(wheel_angular_velocity=spin, wheel_axle=axle)
    with jax.enable_x64(True):
        worn, rate = _call(
            "wheel_wear", "geometry", ctx, {"wear": 1e-4}, {"distance": np.array([0.0, 300.0])}, _geometry()
        )
        assert np.allclose(worn.radius, [0.25, 0.25 - 0.03])
        assert np.allclose(rate["distance"], [1.0, 0.5]), "forwards and backwards alike"


def _soil():
    from lunar_mjx.effects.context import Soil

    fields = Soil.__dataclass_fields__
    values = {k: np.full(WHEELS, 1.0) for k in fields if k not in ("rut", "rock")}
    return Soil(**values, **{k: v for k, v in (("rock", np.zeros(WHEELS)), ("rut", None)) if k in fields})


def _ground(x):
    where = Vec3(np.array(x), np.zeros(WHEELS), np.zeros(WHEELS))
    return SimpleNamespace(wheel_position=where, contact=SimpleNamespace(sinkage=np.array([0.02, 0.01])))


def test_a_wheel_finds_the_rut_of_another_but_not_its_own_under_it():
    nowhere = np.full((PLACES, WHEELS), 1e6)
    state = {"place_x": nowhere.copy(), "place_y": nowhere.copy(), "depth": np.zeros((PLACES, WHEELS))}
    state["place_x"][0, 0], state["place_y"][0, 0], state["depth"][0, 0] = 1.0, 0.0, 0.02
    with jax.enable_x64(True):
        soil, _ = _call("multipass", "soil", _ground([1.0, 1.0]), {"plastic": 0.5}, state, _soil())
        assert float(soil.rut[1]) == pytest.approx(0.5 * 0.02, rel=0.1), (
            "the second wheel stands in the first one's rut"
        )
        assert float(soil.rut[0]) == 0.0, "its own latest place is no earlier pass"
        assert float(soil.k_phi[1]) > 1.5 and float(soil.k_phi[0]) == 1.0


def test_a_wheel_remembers_a_place_once_it_has_left_the_last_one():
    nowhere = np.full((PLACES, WHEELS), 1e6)
    state = {"place_x": nowhere, "place_y": nowhere, "depth": np.zeros((PLACES, WHEELS))}
    with jax.enable_x64(True):
        _, new = _call("multipass", "soil", _ground([1.0, 2.0]), {}, state, _soil())
        assert np.allclose(new["place_x"][0], [1.0, 2.0]) and np.allclose(new["depth"][0], [0.02, 0.01])
        near = {k: np.asarray(v) for k, v in new.items()}
        _, same = _call("multipass", "soil", _ground([1.05, 2.0]), {"spacing": 0.1}, near, _soil())
        assert np.allclose(same["place_x"], near["place_x"]), "5 cm on, nothing is dropped at a spacing of 10 cm"
