"""What the preset `field` adds on the ground: deeper sinking, ruts, skidding, bulldozing, rolling, boulders that hold.

Sources: Ding et al. 2010, Lyasko 2010 (slip-sinkage), Wong 2008 (ruts, rolling), Ishigami et al. 2007 (bulldozing),
Janosi & Hanamoto 1961 (displacement of a skidding wheel), Cundall & Strack 1979 (friction that holds).
"""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.hard import boulder_touch, push_wheels
from lunar_mjx.backends.physics.soil import below_surface, mobilised
from lunar_mjx.backends.physics.vectors import clamp, dot


@dataclasses.dataclass(frozen=True)
class Multipass:
    """Numbers of multipass, written again for the independent check."""

    places: int = 20
    """Places that a wheel remembers."""
    nowhere: float = 1e6
    """Coordinate of a place that has not been visited, m."""
    own_latest: int = 3
    faint: float = 0.05
    most_pressed: float = 0.14
    """Largest share by which a layer is pressed together: 1.50 to 1.74 g/cm3."""


MULTIPASS = Multipass()

DENSITY_POWERS = {"cohesion": 11.0, "tan_phi": 2.7, "shear_modulus_x": -1.0, "shear_modulus_y": -1.0}
"""Powers of the density with which strength and shear moduli go (Carrier et al. 1991; Senatore & Sandu 2011)."""


def slip_sinkage(c: Context, p: SimpleNamespace, soil: Values) -> None:
    """Sinkage exponent n_0 + n_1 s driving, n_0 + n_2 |s| skidding, with equal pressure at a sinkage of one radius."""
    s, slid = c.contact["soil_slip"], c.contact["soil_slid"]
    # opposed rim and hub drive and skid at once
    more = 0.5 * (slid + s) * p.driving + 0.5 * (slid - s) * p.skid
    scale = c.geometry["radius"] ** -more
    soil["k_c"], soil["k_phi"], soil["n"] = soil["k_c"] * scale, soil["k_phi"] * scale, soil["n"] + more


def no_places(rovers: int, wheels: int) -> Values:
    """The memory of `multipass` at reset, (rover, place, wheel)."""
    shape = (rovers, MULTIPASS.places, wheels)
    return {
        "place_x": np.full(shape, MULTIPASS.nowhere),
        "place_y": np.full(shape, MULTIPASS.nowhere),
        "depth": np.zeros(shape),
    }


def multipass(c: Context, p: SimpleNamespace, soil: Values, places: Values) -> Values:
    """Ruts of compacted soil: e z_u deep where a wheel went z_u deep, and (1 - e)^-n times as stiff below."""
    x, y = c.wheel_position[..., 0], c.wheel_position[..., 1]
    # (rover, place, wheel that left it, wheel that meets it)
    gap = (places["place_x"][..., None] - x[:, None, None]) ** 2 + (
        places["place_y"][..., None] - y[:, None, None]
    ) ** 2
    weight = np.maximum(1.0 - gap / (4.0 * p.spacing**2), 0.0) ** 2
    wheels = np.arange(x.shape[1])
    # What a wheel has just pressed is where it stands, not a rut that it meets.
    weight[:, : MULTIPASS.own_latest, wheels, wheels] = 0.0
    total = weight.sum(axis=(1, 2))
    met = np.sum(weight * places["depth"][..., None], axis=(1, 2)) / (total + MULTIPASS.faint)
    stiffer = 1.0 + total / (total + MULTIPASS.faint) * ((1.0 - p.plastic) ** -soil["n"] - 1.0)
    soil["k_c"], soil["k_phi"], soil["rut"] = soil["k_c"] * stiffer, soil["k_phi"] * stiffer, p.plastic * met
    layer = p.compacted_depth * c.geometry["width"]
    density = layer / (layer - np.minimum(soil["rut"], MULTIPASS.most_pressed * layer))
    for name, power in DENSITY_POWERS.items():
        soil[name] = soil[name] * density**power
    sinkage = c.contact["sinkage"]
    away = (x - places["place_x"][:, 0]) ** 2 + (y - places["place_y"][:, 0]) ** 2
    new = ((away > p.spacing**2) & (sinkage > 0.0) & (soil["rock"] < 0.5))[:, None]

    def pushed(old: np.ndarray, here: np.ndarray) -> np.ndarray:
        return np.where(new, np.concatenate([here[:, None], old[:, :-1]], axis=1), old)

    deep = pushed(places["depth"], sinkage)
    # the latest place deepens with the wheel, which touches its first one before it sinks in
    deep[:, 0] = np.maximum(deep[:, 0], np.where(soil["rock"] < 0.5, sinkage, 0.0))
    return {"place_x": pushed(places["place_x"], x), "place_y": pushed(places["place_y"], y), "depth": deep}


def skid_reversal(c: Context, p: SimpleNamespace) -> None:
    """theta_0 with cos(theta_0 + X) = (1 - |s|) cos X, X = 45 deg - phi/2: in front of it soil is shoved ahead; rad."""
    turning = 1.0 - p.reversal * 0.5 * (c.contact["soil_slid"] - c.contact["soil_slip"])
    break_out = 0.5 * (0.5 * np.pi - np.arctan(c.soil["tan_phi"]))
    angle = np.arccos(turning * np.cos(break_out)) - break_out
    c.normal["reversal"] = np.where(turning < 1.0, angle, 0.0)


def skid_shear(c: Context, p: SimpleNamespace) -> None:
    """A skidding wheel's soil stays under it for its own turning: slips of eqs. 8 and 11 over 1 + s and 1 - s^2.

    Ahead of the angle of reversal the slip is that which brings the displacement back to zero there, if it is less.
    """
    slip, theta_1 = c.slip, c.normal["entrance"]
    skid = clamp(-slip["direction"] * slip["slip_x"], 0.0, 1.0)
    left = np.maximum(1.0 - p.share * skid, 0.01)
    slip["slip_x"], slip["slip_y"] = slip["slip_x"] / left, slip["slip_y"] / (left * (1.0 + p.share * skid))
    theta_0 = np.minimum(c.normal["reversal"], theta_1)
    half = 0.5 * (theta_1 - theta_0)
    # a wheel sunk to its axle has an upright front, where the sines of both ends are alike
    chord = np.maximum(np.cos(theta_1 - half), 0.05) * np.sinc(half / np.pi)
    kept = np.maximum(1.0 - 1.0 / chord - slip["direction"] * slip["slip_x"], 0.0)
    slip["slip_ahead"] = slip["slip_x"] + p.reversal * slip["direction"] * kept


def earth_pressure(c: Context, weight: float, depth: np.ndarray, squared: np.ndarray) -> np.ndarray:
    """Passive pressure per width of a wall, N/m: D_1 (c h + D_2 gamma h^2/2), the wedge breaking out at 45 - phi/2."""
    tan_phi = c.soil["tan_phi"]
    phi = np.arctan(tan_phi)
    wedge = 0.25 * np.pi - 0.5 * phi
    d_1 = 1.0 / np.tan(wedge) + np.tan(wedge + phi)
    d_2 = 1.0 / np.tan(wedge) + tan_phi / np.tan(wedge) ** 2
    return d_1 * (c.soil["cohesion"] * depth + 0.5 * d_2 * weight * squared)


def bulldozing(c: Context, p: SimpleNamespace) -> None:
    """Soil pushed ahead, as far as the wheel travels more than it turns free, and beside, by its flank's way aside."""
    sinkage, r = below_surface(c), c.geometry["radius"]
    soft = (sinkage > 0.0) & (c.soil["rock"] <= 0.5)
    weight = p.density * c.gravity
    # opposed rim and hub: the lean holds the travel twice
    share = 1.0 - 0.5 * (np.abs(c.slip["slip_x"]) > 1.0)
    ahead = clamp(share * (c.slip["direction"] - c.slip["slip_x"]), -1.0, 1.0)
    front = -p.front * soft * c.geometry["width"] * earth_pressure(c, weight, sinkage, sinkage * sinkage) * ahead
    theta_1 = c.normal["entrance"]
    length = r * np.sin(np.minimum(theta_1, 0.5 * np.pi))
    v_x, still = c.contact["v_x"], 2e-3
    fastest = np.maximum(np.abs(c.contact["rim_speed"]), np.abs(v_x))
    aside = c.slip["slip_y"] * np.hypot(fastest, still) / np.hypot(v_x, still)
    moved = mobilised(0.625 * length * aside, p.build_up * c.soil["shear_modulus_y"])
    # Along the wheel's front the depth falls as a parabola, 1 - u^2: 2/3 is its mean, 8/15 that of its square.
    wall = earth_pressure(c, weight, sinkage * (2.0 / 3.0), sinkage * sinkage * (8.0 / 15.0))
    side = -p.side * soft * length * wall * moved
    force, moment = c.wheel["force"], c.wheel["moment"]
    force[..., 0] += front
    force[..., 1] += side
    moment[..., 0] += r * side
    # The centroid of that parabola lies 3/8 of its length ahead.
    moment[..., 2] += 0.375 * length * c.slip["direction"] * side


def rolling_resistance(c: Context, p: SimpleNamespace) -> None:
    """M_y = -f r W tanh(r omega/v_0), with the load W that the wheel carries."""
    load = np.maximum(c.wheel["force"][..., 2], 0.0)
    turning = np.tanh(c.contact["rim_speed"] / p.speed_scale)
    c.wheel["moment"][..., 1] -= p.coefficient * c.geometry["radius"] * load * turning


def no_bristles(rovers: int, wheels: int) -> Values:
    """The deflections of `static_boulders` at reset."""
    return {f"bristle_{axis}": np.zeros((rovers, wheels)) for axis in "xyz"}


def static_boulders(c: Context, p: SimpleNamespace, state: Values) -> Values:
    """Wheels against boulders, held by a deflection xi with k_t |xi| <= mu F_N."""
    touch = boulder_touch(c, p)
    if touch is None:
        return {name: np.zeros_like(v) for name, v in state.items()} if c.ground.has_rocks else state
    closest, toward, velocity, load = touch
    slide = velocity - toward * dot(velocity, toward)[..., None]
    xi = np.stack([state[f"bristle_{axis}"] for axis in "xyz"], axis=-1) + slide * c.dt
    # The boulder's surface turns under a rolling wheel: a deflection of before is laid into the present tangent plane.
    xi -= toward * dot(xi, toward)[..., None]
    most = p.mu * load
    long = np.maximum(np.sqrt(dot(xi, xi)), 1e-9)
    xi *= np.minimum(most / (p.tangential_stiffness * long), 1.0)[..., None]
    pull = -p.tangential_stiffness * xi - p.tangential_damping * slide
    size = np.maximum(np.sqrt(dot(pull, pull)), 1e-9)
    push_wheels(c, closest, pull * np.minimum(most / size, 1.0)[..., None] - toward * load[..., None])
    return {f"bristle_{axis}": xi[..., i] for i, axis in enumerate("xyz")}
