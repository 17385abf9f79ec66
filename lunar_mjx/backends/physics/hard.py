"""Hard things: rock surfaces, boulders, the chassis' underside, joint stops and the parking brake."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from lunar_mjx.backends.physics.context import Context, Values
from lunar_mjx.backends.physics.ellipsoids import box_in_ellipsoid, wheel_in_ellipsoid
from lunar_mjx.backends.physics.soil import entrance
from lunar_mjx.backends.physics.vectors import clamp, cross, dot


def rock_normal(c: Context, p: SimpleNamespace) -> None:
    """F_N = k_N z + c_N zdot where the ground is rock; the soil's stress vanishes there."""
    rock = c.soil["rock"] > 0.5
    if not rock.any():
        return
    contact, normal = c.contact, c.normal
    touching = contact["sinkage"] > 0.0
    load = p.stiffness * contact["sinkage"] * touching
    theta_1 = entrance(contact["sinkage"], c.geometry["radius"])
    values = {
        "entrance": theta_1,
        "theta_m": 0.5 * theta_1,
        "sigma_m": 0.0,
        "load": load,
        "resistance": 0.0,
        "damping": np.maximum(p.damping * contact["sinkage_rate"], -load) * touching,
    }
    for name, value in values.items():
        normal[name] = np.where(rock, value, normal[name])
    if "stress" in normal:
        theta, weight, sigma = normal["stress"]
        normal["stress"] = np.stack([theta, weight, sigma * ~rock[..., None]])


def rock_shear(c: Context, p: SimpleNamespace) -> None:
    """mu F_N (1 - exp(-|k|/k_0)) along the slip vector k of the shear state, in place of the soil's force."""
    rock = c.soil["rock"] > 0.5
    if not rock.any():
        return
    load = c.normal["load"] + c.normal["damping"]
    k_x, k_y, r = c.slip["slip_x"], c.slip["slip_y"], c.geometry["radius"]
    # The floor is that of the JAX effect, so that parked wheels agree.
    k = np.sqrt(k_x * k_x + k_y * k_y + 1e-12)
    share = -p.mu * load * np.expm1(-k / p.slip_scale) / k
    along, side = share * k_x, -p.side * share * k_y
    on_rock = rock[..., None]
    force, moment = np.stack([along, side, load], -1), np.stack([r * side, -r * along, 0.0 * r], -1)
    c.wheel["force"] = np.where(on_rock, force, c.wheel["force"])
    c.wheel["moment"] = np.where(on_rock, moment, c.wheel["moment"])


def _pushed(depth: np.ndarray, rate: np.ndarray, p: SimpleNamespace) -> np.ndarray:
    """max(k depth + c rate, 0) in contact, N."""
    return np.maximum(p.stiffness * depth + p.damping * rate, 0.0) * (depth > 0.0)


def _dragged(velocity: np.ndarray, normal: np.ndarray, load: np.ndarray, p: SimpleNamespace) -> np.ndarray:
    """-mu F_N tanh(|v_t|/v_e) along the tangential velocity, N."""
    tangent = velocity - normal * dot(velocity, normal)[..., None]
    speed = np.sqrt(np.maximum(dot(tangent, tangent), 1e-12))
    return tangent * (-p.mu * load * np.tanh(speed / p.speed_scale) / speed)[..., None]


def boulder_touch(c: Context, p: SimpleNamespace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray] | None:
    """Where each wheel (a cylinder) is nearest to its boulder, and how hard it presses; None if no wheel touches one.

    Returns:
      That point from the wheel's centre, unit vector into the boulder, velocity of the wheel there, (rover, wheel, 3),
      and the normal force, (rover, wheel), N.
    """
    if not c.ground.has_rocks:
        return None
    place, axle = c.wheel_position, c.wheel_axle
    center, radius = c.ground.rock(place[..., 0], place[..., 1])
    if not radius.any():
        return None
    gap = center - place
    axial = dot(gap, axle)
    radial = gap - axle * axial[..., None]
    out = np.maximum(np.sqrt(dot(radial, radial)), 1e-9)
    half = 0.5 * c.geometry["width"]
    closest = radial * (np.minimum(out, c.geometry["radius"]) / out)[..., None]
    closest += axle * clamp(axial, -half, half)[..., None]
    apart = gap - closest
    distance = np.maximum(np.sqrt(dot(apart, apart)), 1e-9)
    depth = np.where(radius > 0.0, radius - distance, -1.0)
    if not (depth > 0.0).any():
        return None
    toward = apart / distance[..., None]
    if c.ground.has_forms:  # within the spheres around them
        form = c.ground.form(place[..., 0], place[..., 1])
        closest, toward, reached = wheel_in_ellipsoid(form, gap, axle, c.geometry["radius"], c.geometry["width"])
        depth = np.where(radius > 0.0, reached, -1.0)
    velocity = c.wheel_velocity + cross(c.wheel_angular_velocity, closest)
    return closest, toward, velocity, _pushed(depth, dot(velocity, toward), p)


def push_wheels(c: Context, point: np.ndarray, force: np.ndarray) -> None:
    """Adds forces in world coordinates at points from the wheels' centres, (rover, wheel, 3)."""
    axes = np.stack([c.contact[k] for k in ("forward", "left", "normal")], axis=-2)
    c.wheel["force"] = c.wheel["force"] + np.einsum("...ij,...j->...i", axes, force)
    c.wheel["moment"] = c.wheel["moment"] + np.einsum("...ij,...j->...i", axes, cross(point, force))


def boulders(c: Context, p: SimpleNamespace) -> None:
    """Wheels against boulders: penalty along the line between the nearest points, and friction that creeps."""
    touch = boulder_touch(c, p)
    if touch is None:
        return
    closest, toward, velocity, load = touch
    push_wheels(c, closest, _dragged(velocity, toward, load, p) - toward * load[..., None])


def chassis_contact(c: Context, p: SimpleNamespace) -> None:
    """Points of the chassis below the ground, and boulders inside its boxes, push it out."""
    points, (height, slope_x, slope_y) = c.chassis_point, c.chassis_ground
    if ((height - points[..., 2]) > 0.0).any():
        arm = points - c.position[:, None]
        velocity = c.velocity[:, None] + cross(np.broadcast_to(c.angular_velocity[:, None], arm.shape), arm)
        up = 1.0 / np.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        normal = np.stack([-slope_x * up, -slope_y * up, up], axis=-1)
        load = _pushed((height - points[..., 2]) * up, -dot(velocity, normal), p)
        push = normal * load[..., None] + _dragged(velocity, normal, load, p)
        c.body["force"] = c.body["force"] + push.sum(axis=1)
        c.body["moment"] = c.body["moment"] + cross(arm, push).sum(axis=1)
    if c.ground.has_rocks and len(c.numbers.box_center):
        _chassis_boulders(c, p)


_CORNERS = np.array([(-0.5, -0.5), (-0.5, 0.5), (0.5, -0.5), (0.5, 0.5)])


def _chassis_boulders(c: Context, p: SimpleNamespace) -> None:
    """Boulders against the chassis' boxes; every quarter of a box looks for one boulder."""
    center, half = c.numbers.box_center[:, None], c.numbers.box_half[:, None]
    probe = np.broadcast_to(center, (center.shape[0], 4, 3)).copy()
    probe[..., :2] += _CORNERS * half[..., :2]
    rotation = c.rotation[:, None, None]
    world = np.einsum("...ij,...j->...i", rotation, probe) + c.position[:, None, None]
    rock, radius = c.ground.rock(world[..., 0], world[..., 1])
    if not radius.any():
        return
    # quarters that found the same boulder share its push
    same_boulder = (rock[..., :, None, :2] == rock[..., None, :, :2]).all(-1)
    # Counted with themselves, so that a boulder found once has a share of 1.
    share = 1.0 / same_boulder.sum(-1)
    gap = np.einsum("...ji,...j->...i", rotation, rock - c.position[:, None, None]) - center
    nearest = clamp(gap, -half, half)
    apart = gap - nearest
    distance = np.maximum(np.sqrt(dot(apart, apart)), 1e-9)
    within = distance < 1e-6
    depth = np.where(radius > 0.0, radius - np.where(within, 0.0, distance), -1.0)
    if not (depth > 0.0).any():
        return
    # A centre inside the box has no outside nearest: the box is lifted.
    toward = np.where(within[..., None], np.array([0.0, 0.0, -1.0]), apart / distance[..., None])
    toward = np.einsum("...ij,...j->...i", rotation, toward)
    if c.ground.has_forms:
        form, turn = c.ground.form(world[..., 0], world[..., 1]), np.broadcast_to(rotation, (*gap.shape, 3))
        nearest, toward, reached = box_in_ellipsoid(form, gap, turn, np.broadcast_to(half, gap.shape))
        depth = np.where(radius > 0.0, reached, -1.0)
    arm = np.einsum("...ij,...j->...i", rotation, nearest + center)
    spin = np.broadcast_to(c.angular_velocity[:, None, None], arm.shape)
    velocity = c.velocity[:, None, None] + cross(spin, arm)
    load = share * _pushed(depth, dot(velocity, toward), p)
    push = _dragged(velocity, toward, load, p) - toward * load[..., None]
    c.body["force"] = c.body["force"] + push.sum(axis=(1, 2))
    c.body["moment"] = c.body["moment"] + cross(arm, push).sum(axis=(1, 2))


def joint_limits(c: Context, p: SimpleNamespace) -> None:
    """Stops as damped springs that push only."""
    below, above = c.numbers.lower - c.joint_angle, c.joint_angle - c.numbers.upper
    if not ((below > 0.0) | (above > 0.0)).any():
        return
    up = np.maximum(p.stiffness * below - p.damping * c.joint_speed, 0.0)
    down = np.maximum(p.stiffness * above + p.damping * c.joint_speed, 0.0)
    up, down = np.where(below > 0.0, up, 0.0), np.where(above > 0.0, down, 0.0)
    c.body["joint_torque"] = c.body["joint_torque"] + up - down


def parking_brake(c: Context, p: SimpleNamespace, state: Values) -> Values:
    """Holds every drive joint by a damped spring at the angle where the brake caught it."""
    held = (c.numbers.group == 0) & (p.engaged > 0.5)
    angle = np.where(held, state["angle"], c.joint_angle)
    holding_torque = p.stiffness * (angle - c.joint_angle) - p.damping * c.joint_speed
    c.body["joint_torque"] = c.body["joint_torque"] + np.where(held, holding_torque, 0.0)
    return {"angle": angle}
