"""Effects that a single step from rest does not show: they act through what went before, or outside the wheels."""

from __future__ import annotations

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from scipy.optimize import brentq

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Geometry
from lunar_mjx.effects.soil.multipass import TRACK
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
    depth = SimpleNamespace(sinkage=np.array([0.02, 0.01]))
    return SimpleNamespace(wheel_position=where, contact=depth, geometry=_geometry())


def test_a_wheel_finds_the_rut_of_another_but_not_its_own_under_it():
    nowhere = np.full((TRACK.places, WHEELS), 1e6)
    state = {"place_x": nowhere.copy(), "place_y": nowhere.copy(), "depth": np.zeros((TRACK.places, WHEELS))}
    state["place_x"][0, 0], state["place_y"][0, 0], state["depth"][0, 0] = 1.0, 0.0, 0.02
    with jax.enable_x64(True):
        soil, _ = _call("multipass", "soil", _ground([1.0, 1.0]), {"plastic": 0.5}, state, _soil())
        assert float(soil.rut[1]) == pytest.approx(0.5 * 0.02, rel=0.1), (
            "the second wheel stands in the first one's rut"
        )
        assert float(soil.rut[0]) == 0.0, "its own latest place is no earlier pass"
        assert float(soil.k_phi[1]) > 1.5 and float(soil.k_phi[0]) == 1.0


def test_a_wheel_remembers_a_place_once_it_has_left_the_last_one():
    nowhere = np.full((TRACK.places, WHEELS), 1e6)
    state = {"place_x": nowhere, "place_y": nowhere, "depth": np.zeros((TRACK.places, WHEELS))}
    with jax.enable_x64(True):
        _, new = _call("multipass", "soil", _ground([1.0, 2.0]), {}, state, _soil())
        assert np.allclose(new["place_x"][0], [1.0, 2.0]) and np.allclose(new["depth"][0], [0.02, 0.01])
        near = {k: np.asarray(v) for k, v in new.items()}
        _, same = _call("multipass", "soil", _ground([1.05, 2.0]), {"spacing": 0.1}, near, _soil())
        assert np.allclose(same["place_x"], near["place_x"]), "5 cm on, nothing is dropped at a spacing of 10 cm"


def test_the_latest_place_deepens_with_the_wheel():
    """Wheels touch their first place before they sink in: a place of no depth would be firm and no rut."""
    nowhere = np.full((TRACK.places, WHEELS), 1e6)
    state = {"place_x": nowhere, "place_y": nowhere, "depth": np.zeros((TRACK.places, WHEELS))}
    touching = _ground([1.0, 2.0])
    touching.contact.sinkage = np.array([1e-7, 0.0])
    with jax.enable_x64(True):
        _, new = _call("multipass", "soil", touching, {}, state, _soil())
        found = {k: np.asarray(v) for k, v in new.items()}
        _, sunk = _call("multipass", "soil", _ground([1.0, 2.0]), {}, found, _soil())
        assert np.allclose(sunk["depth"][0], [0.02, 0.01]) and np.allclose(sunk["depth"][1:], 0.0)
        assert np.allclose(sunk["place_x"][0], [1.0, 2.0])


RADIUS, WIDTH, LOAD = 0.25, 0.2, 180.0
"""VIPER's wheel and a quarter of its weight on the Moon, N."""


def _pull(z, slip, soil, field=True):
    """Load and drawbar pull of a driving wheel, N, by quadrature of Wong & Reece with bulldozing; soil as a dict."""
    x, w = np.polynomial.legendre.leggauss(24)
    theta_1 = np.arccos(1.0 - z / RADIUS)
    theta, w = 0.5 * theta_1 * (1.0 + x), 0.5 * theta_1 * w
    more = slip if field else 0.0
    n = soil["n"] + more
    modulus = (soil["k_c"] / WIDTH + soil["k_phi"]) * RADIUS**-more
    depth = RADIUS * (np.cos(np.maximum(theta, theta_1 - theta)) - np.cos(theta_1))
    sigma = modulus * np.maximum(depth, 0.0) ** n
    j = RADIUS * ((theta_1 - theta) - (1.0 - slip) * (np.sin(theta_1) - np.sin(theta)))
    tau = (soil["cohesion"] + sigma * soil["tan_phi"]) * -np.expm1(-j / soil["shear_modulus_x"])
    area, phi = RADIUS * WIDTH, np.arctan(soil["tan_phi"])
    wedge = 0.25 * np.pi - 0.5 * phi
    wall = 1.0 / np.tan(wedge) + np.tan(wedge + phi)
    weight = 0.5 * (1.0 / np.tan(wedge) + np.tan(phi) / np.tan(wedge) ** 2) * 1600.0 * 1.625
    front = WIDTH * wall * (soil["cohesion"] * z + weight * z * z) * (1.0 - slip) if field else 0.0
    load = area * np.sum(w * (sigma * np.cos(theta) + tau * np.sin(theta)))
    return load, area * np.sum(w * (tau * np.cos(theta) - sigma * np.sin(theta))) - front


def _passes(slip, field=True, compacted_depth=1.5, count=4):
    """Depth of the rut over the first one's, and pull over load, of passes of one wheel in one rut.

    With `field`, the wheel sinks deeper as it slips and pushes soil ahead.
    """
    fresh = {"k_c": 1.4e3, "k_phi": 8.2e5, "n": 1.0, "cohesion": 170.0, "tan_phi": np.tan(np.deg2rad(35.0))}
    fresh |= {"shear_modulus_x": 0.0178, "shear_modulus_y": 0.0178, "rock": 0.0}
    soil, deep, out = fresh, 0.0, []
    for _ in range(count):
        rut = soil.get("rut", 0.0)
        z = float(brentq(lambda z, soil=soil: _pull(z, slip, soil, field)[0] - LOAD, 1e-5, 0.2))
        deep = rut + z
        out.append((deep, _pull(z, slip, soil, field)[1] / LOAD))
        # as if the wheel had left many places here: it stands fully in the rut
        state = {k: np.zeros((TRACK.places, WHEELS)) for k in ("place_x", "place_y")} | {
            "depth": np.full((TRACK.places, WHEELS), deep)
        }
        virgin = fresh | {"n": 1.0 + slip * field}
        before = _soil_of({k: np.full(WHEELS, v) for k, v in virgin.items()})
        met, _ = _call("multipass", "soil", _ground([0.0, 0.0]), {"compacted_depth": compacted_depth}, state, before)
        soil = {k: float(getattr(met, k)[1]) for k in (*fresh, "rut")} | {"n": 1.0}
    return [(d / out[0][0], pull) for d, pull in out]


def _soil_of(values):
    from lunar_mjx.effects.context import Soil

    return Soil(**values, rut=None)


@pytest.mark.parametrize("field", [True, False])
@pytest.mark.parametrize("slip", [0.05, 0.1, 0.2, 0.4, 0.6])
def test_passes_in_one_rut_pull_better_and_deepen_less_and_less(slip, field):
    """Holm 1969 as Senatore & Sandu 2011 read it: every pass pulls better. Ruts deepen as n^(1/a), a from 4 to 8."""
    with jax.enable_x64(True):
        depth, pull = np.array(_passes(slip, field)).T
    # soil cannot be pressed beyond the densest of the table: from there on passes pull alike
    assert (np.diff(pull) >= 0.0).all() and pull[1] > pull[0] + 0.005
    assert (np.diff(depth) > 0.0).all() and (np.diff(depth, 2) < 0.0).all()
    exponents = np.log(np.arange(2, 5)) / np.log(depth[1:])
    assert ((exponents > 4.0) & (exponents < 8.0)).all(), exponents


def test_without_denser_soil_a_following_wheel_would_pull_worse():
    """What docs/physics.md tells of passes at 20 % slip, with and without compaction below the rut."""
    with jax.enable_x64(True):
        dense, loose = _passes(0.2), _passes(0.2, compacted_depth=1e6)
    assert dense[0][1] == pytest.approx(0.106, abs=1e-3)
    assert loose[1][1] == pytest.approx(0.093, abs=1e-3) and dense[1][1] == pytest.approx(0.175, abs=1e-3)
    assert dense[3][1] == pytest.approx(0.197, abs=1e-3)
    assert [float(d) for d, _ in dense[1:]] == pytest.approx([1.12, 1.22, 1.30], abs=6e-3)
