"""The wheel of the preset `field` against adaptive quadrature and closed forms that share no code with it."""

from __future__ import annotations

import dataclasses
import functools
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from lunar_mjx.dynamics.system import default_params
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.effects.context import Contact
from lunar_mjx.effects.ports import Pipeline, nominal_geometry, wheel_ports
from lunar_mjx.effects.presets import FIELD_CHANGES, PRESET_PARAMETERS, PRESETS
from lunar_mjx.model import make_model
from lunar_mjx.model.ambient import SYNODIC_DAY
from lunar_mjx.spatial import Vec3
from lunar_mjx.terrain.rocks import build_rocks
from tests.effects.effects_harness import bare_context, effects_named, parameters, rover_info

RADIUS, WIDTH, GRAVITY = 0.25, 0.2, 1.625
SOIL = {"k_c": 1.4e3, "k_phi": 8.2e5, "n": 1.0, "cohesion": 170.0, "phi": np.deg2rad(35.0), "K": 0.0178}
"""Lunar nominal soil (Heiken 1991)."""
ON_SOIL = (
    "soil",
    "slip_sinkage",
    "stress_integral",
    "skid_shear",
    "friction_circle",
    "bulldozing",
    "rolling_resistance",
)


@dataclasses.dataclass(frozen=True)
class Motion:
    """One wheel: sinkage, m; travel along and across and the rim's speed, m/s."""

    sinkage: float
    v_x: float
    v_y: float
    rim: float

    @property
    def slip(self) -> float:
        """Eq. 8."""
        return (self.rim - self.v_x) / max(self.rim, self.v_x)


def _motions(count: int) -> list[Motion]:
    rng = np.random.default_rng(1)
    out = []
    for slip, angle, z in zip(
        rng.uniform(-0.9, 0.9, count),
        np.deg2rad(rng.uniform(-60.0, 60.0, count)),
        rng.uniform(0.005, 0.1, count),
        strict=True,
    ):
        v_x, rim = (0.2 * (1.0 - slip), 0.2) if slip > 0.0 else (0.2, 0.2 * (1.0 + slip))
        out.append(Motion(z, v_x, v_x * np.tan(angle), rim))
    return out


@functools.cache
def _program(names: tuple[str, ...]) -> Any:
    pipeline = Pipeline(effects_named(names))

    @jax.jit
    def run(z: Any, v_x: Any, v_y: Any, rim: Any, values: Any) -> Any:
        nil = Vec3(*(0.0 * z,) * 3)
        roll = jnp.where(jnp.abs(rim) > jnp.abs(v_x), rim, v_x)
        slip = (rim - v_x) / roll
        angle, slid = jnp.arctan2(v_y, v_x), jnp.abs(slip)
        contact = Contact(z, 0.0 * z, slip, angle, v_x, v_y, rim, nil, nil, nil, z > 0.0, slip, slid)
        ctx = bare_context(
            dt=jnp.asarray(0.002, z.dtype),
            gravity=GRAVITY,
            geometry=nominal_geometry(rover_info(RADIUS + 0.0 * z, WIDTH + 0.0 * z)),
            contact=contact,
            parameters=parameters(pipeline.effects, values),
        )
        return wheel_ports(pipeline, ctx, {})[0].wheel

    return run


def _wheels(motions: list[Motion], names: tuple[str, ...] = ON_SOIL, **values: dict[str, float]) -> Any:
    """Force and moment of every wheel by the ports soil, wheel_normal and wheel_shear; float64, values of `field`."""
    with jax.enable_x64(True):
        columns = [jnp.array([getattr(m, k) for m in motions]) for k in ("sinkage", "v_x", "v_y", "rim")]
        given = {**PRESET_PARAMETERS["field"], **values}
        return jax.device_get(_program(names)(*columns, {k: v for k, v in given.items() if k in names}))


def _reference(m: Motion, bulldozing: bool = True) -> dict[str, float]:
    """Forces by adaptive quadrature of stress and displacement; the displacement itself is integrated over time.

    For forward rolling: a piece of soil that the rim met at theta_1 has been under it for (theta_1 - theta)/omega. A
    braked wheel's is shoved ahead, not dragged back, where the rim moves at more than 45 deg - phi/2 from its normal.
    """
    r, b, omega = RADIUS, WIDTH, m.rim / RADIUS
    theta_1 = np.arccos(1.0 - m.sinkage / r)
    n = SOIL["n"] + (1.0 * m.slip if m.slip > 0.0 else -0.5 * m.slip)
    modulus = (SOIL["k_c"] / b + SOIL["k_phi"]) * r ** (SOIL["n"] - n)

    def sigma(t: float) -> float:
        front = t if t > theta_1 / 2 else theta_1 - t
        return modulus * max(r * (np.cos(front) - np.cos(theta_1)), 0.0) ** n

    def moved(low: float, high: float, speed: float) -> float:
        """Way of the rim over soil that would stay if the wheel travelled at `speed`, m."""
        return quad(lambda a: (m.rim - speed * np.cos(a)) / omega, low, high)[0]

    theta_0 = min(_angle_of_reversal(m), theta_1)
    ahead = m.v_x
    if theta_0 > 0.0 and moved(theta_0, theta_1, m.v_x) < 0.0:
        ahead = brentq(lambda v: moved(theta_0, theta_1, v), 0.0, m.v_x)

    def shear(t: float) -> tuple[float, float]:
        j_x = moved(max(t, theta_0), theta_1, ahead) + moved(t, max(t, theta_0), m.v_x)
        j_y = m.v_y / omega * (theta_1 - t)
        q = np.hypot(j_x, j_y) / SOIL["K"]
        strength = SOIL["cohesion"] + sigma(t) * np.tan(SOIL["phi"])
        tau = strength * (1.0 - np.exp(-q))
        return tau * j_x / (q * SOIL["K"]), tau * j_y / (q * SOIL["K"])

    def over_arc(f: Any) -> float:
        ends = sorted({theta_1 / 2, theta_0} - {0.0, theta_1})
        return quad(f, 0.0, theta_1, points=ends, epsabs=1e-9, epsrel=1e-9, limit=200)[0] * r * b

    out = {
        "along": over_arc(lambda t: shear(t)[0] * np.cos(t) - sigma(t) * np.sin(t)),
        "across": -over_arc(lambda t: shear(t)[1]),
        "up": over_arc(lambda t: sigma(t) * np.cos(t) + shear(t)[0] * np.sin(t)),
        "turn": -over_arc(lambda t: shear(t)[0]) * r,
        "strength": over_arc(lambda t: SOIL["cohesion"] + sigma(t) * np.tan(SOIL["phi"])),
    }
    if bulldozing:
        x_c = np.pi / 4 - SOIL["phi"] / 2
        d_1 = 1 / np.tan(x_c) + np.tan(x_c + SOIL["phi"])
        d_2 = 1 / np.tan(x_c) + np.tan(SOIL["phi"]) / np.tan(x_c) ** 2

        def wall(h: float) -> float:
            return d_1 * (SOIL["cohesion"] * h + d_2 * 1600.0 * GRAVITY * h**2 / 2)

        out["along"] -= b * wall(m.sinkage) * m.v_x / max(m.rim, m.v_x)
        length = r * np.sin(theta_1)
        # the circle's height over the chord, by the parabola through its ends
        side = quad(lambda x: wall(m.sinkage * (1 - (x / length) ** 2)), 0.0, length)[0]
        # the way aside at the centroid of the buried side, for a braked wheel as its shear has it
        centroid = (
            quad(lambda x: x * (1 - (x / length) ** 2), 0.0, length)[0]
            / quad(lambda x: 1 - (x / length) ** 2, 0.0, length)[0]
        )
        moved = (length - centroid) * m.v_y / min(m.rim, m.v_x) / SOIL["K"]
        out["across"] -= side * np.sign(moved) * (1 - np.exp(-abs(moved)))
    out["turn"] -= 0.05 * r * out["up"] * np.tanh(m.rim / 0.01)
    return out


def _angle_of_reversal(m: Motion) -> float:
    """Where the rim of a braked wheel moves at 45 deg - phi/2 from its normal, rad; in front at more. 0 driving."""
    if m.rim >= m.v_x:
        return 0.0

    def beyond(t: float) -> float:
        return np.arctan2(m.v_x * np.cos(t) - m.rim, m.v_x * np.sin(t)) - (np.pi / 4 - SOIL["phi"] / 2)

    return brentq(beyond, 1e-9, np.pi / 2)


def test_field_wheel_matches_adaptive_quadrature() -> None:
    """Slip -0.9 to 0.9, slip angle to 60 deg: within 1e-3 of the load (18 fixed nodes against adaptive ones).

    The last four are deep and braked, so that their shear turns about within the arc.
    """
    deep = [
        Motion(z, 0.2, 0.2 * np.tan(angle), 0.2 * rim)
        for z, angle, rim in zip((0.2, 0.2, 0.15, 0.1), (0.0, 0.3, 0.0, 0.0), (0.1, 0.2, 0.3, 0.6), strict=True)
    ]
    motions = [*_motions(24), *deep]
    assert all(_angle_of_reversal(m) < np.arccos(1.0 - m.sinkage / RADIUS) for m in deep)
    wheel = _wheels(motions)
    for i, m in enumerate(motions):
        wanted = _reference(m)
        found = {
            "along": wheel.force.x[i],
            "across": wheel.force.y[i],
            "up": wheel.force.z[i],
            "turn": wheel.moment.y[i],
        }
        for name, value in found.items():
            assert value == pytest.approx(wanted[name], abs=1e-3 * wanted["up"]), (name, m)


def test_braking_soil_is_mobilised_over_the_wheels_own_turning() -> None:
    """At 50 % skid the displacement of eq. 8 brakes a fifth too little; 1/(1 + s) is that of the quadrature."""
    m = Motion(0.02, 0.2, 0.0, 0.1)
    names = ("soil", "stress_integral", "skid_shear")

    def brake(share: float) -> float:
        return -float(_wheels([m], names, skid_shear={"share": share}).force.x[0])

    wanted = -_straight_pull(m)
    assert brake(1.0) == pytest.approx(wanted, rel=1e-3)
    assert 0.75 * wanted < brake(0.0) < 0.9 * wanted


def test_without_reversal_soil_is_sheared_one_way_along_the_whole_rim() -> None:
    """As many models have it; a wheel's own turning and the shear that turns about are told apart."""
    m = Motion(0.02, 0.2, 0.0, 0.18)
    names = ("soil", "stress_integral", "skid_shear")
    one_way, about = (
        float(_wheels([m], names, skid_shear={"share": 1.0, "reversal": q}).force.x[0]) for q in (0.0, 1.0)
    )
    assert one_way == pytest.approx(_straight_pull(m), rel=1e-3)
    assert one_way < 1.2 * about < 0.0


def test_a_braked_wheel_meets_more_support_the_deeper_it_sinks() -> None:
    """From 0.4 to 0.9 radii at 90 % skid, in equal steps: each bears more than the one before, and not ever less so.

    Sheared backward over its whole arc, the wheel bore 153 N more from 0.4 to 0.5 radii and 31 N from 0.8 to 0.9.
    """
    motions = [Motion(z, 0.2, 0.0, 0.02) for z in (0.1, 0.125, 0.15, 0.175, 0.2, 0.225)]
    gained = np.diff(_wheels(motions).force.z)
    assert (gained > 100.0).all() and (np.diff(gained) > 0.0).all()


def _straight_pull(m: Motion) -> float:
    """Force along the wheel without slip-sinkage and bulldozing, by quadrature."""
    r, b, omega = RADIUS, WIDTH, m.rim / RADIUS
    theta_1 = np.arccos(1.0 - m.sinkage / r)

    def sigma(t: float) -> float:
        front = t if t > theta_1 / 2 else theta_1 - t
        return (SOIL["k_c"] / b + SOIL["k_phi"]) * r * (np.cos(front) - np.cos(theta_1))

    def stress(t: float) -> float:
        j = quad(lambda a: (m.rim - m.v_x * np.cos(a)) / omega, t, theta_1)[0] / SOIL["K"]
        tau = (SOIL["cohesion"] + sigma(t) * np.tan(SOIL["phi"])) * np.sign(j) * (1.0 - np.exp(-abs(j)))
        return tau * np.cos(t) - sigma(t) * np.sin(t)

    return quad(stress, 0.0, theta_1, points=[theta_1 / 2], limit=200)[0] * r * b


def test_shear_stays_within_mohr_coulomb() -> None:
    """Rim and side together carry no more than the soil's strength; without the circle up to sqrt(2) times as much."""
    motions = [dataclasses.replace(m, v_y=np.sign(m.v_y) * 2.0) for m in _motions(24)]
    names = tuple(n for n in ON_SOIL if n not in ("bulldozing", "rolling_resistance"))

    def share(circle: float) -> np.ndarray:
        wheel = _wheels(motions, names, friction_circle={"share": circle})
        strength = np.array([_reference(m, bulldozing=False)["strength"] for m in motions])
        return np.hypot(wheel.moment.y / RADIUS, wheel.force.y) / strength

    assert (share(1.0) < 1.0 + 1e-6).all() and share(1.0).max() > 0.9
    assert 1.2 < share(0.0).max() < np.sqrt(2.0) + 1e-6


def test_a_slipping_wheel_sinks_deeper() -> None:
    """The sinkage that carries 180 N on VIPER's wheel, against the root of the quadrature's."""

    def depth(slip: float, names: tuple[str, ...]) -> float:
        def excess(z: float) -> float:
            return float(_wheels([Motion(z, 0.2 * (1.0 - slip), 0.0, 0.2)], names).force.z[0]) - 180.0

        return brentq(excess, 1e-3, 0.24, xtol=1e-6)

    wanted = brentq(lambda z: _reference(Motion(z, 0.08, 0.0, 0.2))["up"] - 180.0, 1e-3, 0.24, xtol=1e-6)
    assert depth(0.6, ON_SOIL) == pytest.approx(wanted, rel=1e-3)
    plain = tuple(n for n in ON_SOIL if n != "slip_sinkage")
    assert depth(0.6, ON_SOIL) > 2.0 * depth(0.6, plain)


@jax.enable_x64(True)
def _on_boulder(name: str, pull: float, steps: int) -> tuple[np.ndarray, float]:
    """A point of 10 kg that a boulder bears from below, with a force along x: its speed over time, and its load."""
    rocks = build_rocks(np.array([[0.0, 0.0, -1.0]]), np.array([1.0]), (-2.0, -2.0, 2.0, 2.0))
    own = CATALOGUE[name]
    p = SimpleNamespace(**own.nominal())
    radius, dt, depth = 0.25, 0.002, 1e-3

    def vector(x: Any, y: Any, z: Any) -> Vec3:
        return Vec3(*(jnp.reshape(jnp.asarray(v, float), (1,)) for v in (x, y, z)))

    zero = vector(0, 0, 0)
    one = jnp.ones(1)
    terrain = SimpleNamespace(rocks=jax.tree.map(jnp.asarray, rocks))
    contact = SimpleNamespace(forward=vector(1, 0, 0), left=vector(0, 1, 0), normal=vector(0, 0, 1))

    def step(carry: Any, _: Any) -> Any:
        speed, state = carry
        ctx = SimpleNamespace(
            terrain=terrain,
            contact=contact,
            dt=dt,
            wheel_position=vector(0, 0, radius - depth),
            wheel_axle=vector(0, 1, 0),
            wheel_velocity=vector(speed, 0, 0),
            wheel_angular_velocity=zero,
            geometry=SimpleNamespace(radius=radius * one, width=0.2 * one),
        )
        wheel = WheelStart(zero, zero)
        result = own.ports["wheel_shear"](ctx, p, SimpleNamespace(**state), wheel)
        wheel, state = result if own.state else (result, state)
        return (speed + dt / 10.0 * (pull + wheel.force.x[0]), state), (speed, wheel.force.z[0])

    start = {k: jnp.zeros(1) for k in own.state}
    _, (speeds, loads) = jax.lax.scan(step, (jnp.zeros(()), start), length=steps)
    return np.asarray(speeds), float(loads[-1])


@dataclasses.dataclass
class WheelStart:
    """As much of a wheel's force as a boulder adds to."""

    force: Vec3
    moment: Vec3


def test_friction_on_boulders_holds_and_slides() -> None:
    """Below mu F_N the wheel comes to rest (and creeps at v_e artanh in `boulders`); above it, it slides on mu F_N."""
    load = 2e5 * 1e-3
    held, carried = _on_boulder("static_boulders", 0.5 * 0.8 * load, 4000)
    assert carried == pytest.approx(load, rel=1e-6)
    assert np.abs(held[-200:]).max() < 1e-9
    creeps, _ = _on_boulder("boulders", 0.5 * 0.8 * load, 4000)
    assert creeps[-1] == pytest.approx(0.05 * np.arctanh(0.5), rel=1e-3)
    slides, _ = _on_boulder("static_boulders", 1.5 * 0.8 * load, 1000)
    gained = (slides[-1] - slides[499]) / (500 * 0.002)
    assert gained == pytest.approx(0.5 * 0.8 * load / 10.0, rel=1e-6)


def test_field_has_what_its_list_of_changes_names() -> None:
    """Every effect that the list says mends a flaw is in the preset, and none that it is said to replace."""
    assert set(PRESETS["field"]) <= CATALOGUE.keys()
    for change in FIELD_CHANGES:
        added, _, replaced = change.mended_by.partition(" for ")
        for name in CATALOGUE:
            if name in added.replace(",", " ").split():
                assert name in PRESETS["field"] and name not in PRESETS["consistent"], name
            if name in replaced.split():
                assert name not in PRESETS["field"] and name in PRESETS["consistent"], name


def test_field_knows_day_and_night() -> None:
    """230 K at noon, 90 K at night, by the fourth root of the Sun's height in between."""
    model = make_model("luvmi_x", "flat", "field")
    assert model.ambient == (230.0, 90.0, 0.0, SYNODIC_DAY)
    assert make_model("luvmi_x", "flat").ambient[0] == make_model("luvmi_x", "flat").ambient[1]
    ambient = default_params(model).ambient
    expected = {0.0: 230.0, 1 / 6: 90.0 + 140.0 * 0.5**0.25, 0.25: 90.0, 0.5: 90.0}
    for day, kelvin in expected.items():
        assert float(ambient.at(day * SYNODIC_DAY)) == pytest.approx(kelvin, abs=5.0 if day == 0.25 else 0.05)
