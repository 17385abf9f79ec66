"""Kernels of the particle bed: sums of contact impulses, and the motion of the wheels. Needs the extra `particles`."""

# pyright: reportMissingImports=false, reportInvalidTypeForm=false, reportIndexIssue=false, reportCallIssue=false
# pyright: reportOperatorIssue=false, reportArgumentType=false
# (Warp compiles these functions itself; its types are none of Python's)

from __future__ import annotations

import warp as wp

IMPOSED = 8
"""Columns of what is imposed on a wheel: travel speed m/s, angular velocity rad/s, cosine and sine of the heading from
the travel, load N, mass kg, damping kg/s, time at which it has arrived s."""
PLACE = 5
"""Columns of a wheel's state: x, y, z m, vertical velocity m/s, angle turned rad."""
RECORDED = 7
"""Columns recorded in each step: forces of the sand on the wheel along its heading, to its left and up N, moment about
its axle (to its left) N m, height of its centre m, place along the travel m, contacts."""


@wp.func
def rise(t: float, begin: float, duration: float):
    """Share of a load or speed at time `t`: 0 before `begin`, straight up, 1 after `duration`."""
    return wp.clamp((t - begin) / wp.max(duration, 1.0e-9), 0.0, 1.0)


@wp.kernel
def sum_impulses(
    collider: wp.array(dtype=int),
    impulse: wp.array(dtype=wp.vec3),
    place: wp.array(dtype=wp.vec3),
    body_of: wp.array(dtype=int),
    pose: wp.array(dtype=wp.transform),
    scale: float,
    bodies: int,
    total: wp.array2d(dtype=float),
):
    """Adds up impulses and their moments about each body's centre; the last row is all that does not move."""
    i = wp.tid()
    c = collider[i]
    # Most nodes touch nothing.
    if c < 0:
        return
    p = scale * impulse[i]
    if wp.length_sq(p) == 0.0:
        return
    b = body_of[c]
    row = bodies
    arm = wp.vec3(0.0, 0.0, 0.0)
    if b >= 0:
        row = b
        arm = place[i] - wp.transform_get_translation(pose[b])
    moment = wp.cross(arm, p)
    for k in range(3):
        # Sums in no fixed order: the last digits differ from run to run, as do those of any GPU's sums.
        wp.atomic_add(total, row, k, p[k])
        wp.atomic_add(total, row, 3 + k, moment[k])
    wp.atomic_add(total, row, 6, 1.0)


@wp.kernel
def record_and_move(
    step: int,
    dt: float,
    load_time: float,
    settle_time: float,
    ramp_time: float,
    imposed: wp.array2d(dtype=float),
    place: wp.array2d(dtype=float),
    total: wp.array2d(dtype=float),
    record: wp.array3d(dtype=float),
    record_walls: wp.array2d(dtype=float),
    pose: wp.array(dtype=wp.transform),
    twist: wp.array(dtype=wp.spatial_vector),
):
    """Ends step `step` (from 1; 0 only prepares the first): records, moves, and sets the next step's velocities.

    The load and the damper act implicitly: the solver is given the wheel's velocity after them and the mass m + c dt,
    and answers with the vertical impulse of the sand.
    """
    b = wp.tid()
    v = imposed[b, 0]
    omega = imposed[b, 1]
    cosine = imposed[b, 2]
    sine = imposed[b, 3]
    m = imposed[b, 5]
    c = imposed[b, 6]
    arrived = imposed[b, 7]
    t = float(step) * dt
    if step > 0:
        before = t - dt
        # The share that the finished step was given, so that what is recorded belongs to what was imposed.
        share = rise(before, settle_time, ramp_time) * (1.0 - rise(before, arrived, ramp_time))
        load = imposed[b, 4] * rise(t, 0.0, load_time)
        # Implicit in the damper, so that its strength sets no limit to the time step.
        vz = (m * place[b, 3] - dt * load + total[b, 2]) / (m + dt * c)
        place[b, 0] = place[b, 0] + dt * share * v
        place[b, 2] = place[b, 2] + dt * vz
        place[b, 3] = vz
        place[b, 4] = place[b, 4] + dt * share * omega
        # Impulses over the step, hence means of the force, in the wheel's own directions.
        record[step - 1, b, 0] = (cosine * total[b, 0] + sine * total[b, 1]) / dt
        record[step - 1, b, 1] = (-sine * total[b, 0] + cosine * total[b, 1]) / dt
        record[step - 1, b, 2] = total[b, 2] / dt
        record[step - 1, b, 3] = (-sine * total[b, 3] + cosine * total[b, 4]) / dt
        record[step - 1, b, 4] = place[b, 2]
        record[step - 1, b, 5] = place[b, 0]
        record[step - 1, b, 6] = total[b, 6]
        # Walls belong to all boxes; one thread copies their sum.
        if b == 0:
            walls = total.shape[0] - 1
            for k in range(3):
                record_walls[step - 1, k] = total[walls, k]
    share = rise(t, settle_time, ramp_time) * (1.0 - rise(t, arrived, ramp_time))
    load = imposed[b, 4] * rise(t + dt, 0.0, load_time)
    vz = (m * place[b, 3] - dt * load) / (m + dt * c)
    # The wheel travels along x and is turned to its slip angle: boxes stay aligned with the grid.
    heading = wp.quat_from_axis_angle(wp.vec3(0.0, 0.0, 1.0), wp.atan2(sine, cosine))
    turned = wp.quat_from_axis_angle(wp.vec3(0.0, 1.0, 0.0), place[b, 4])
    pose[b] = wp.transform(wp.vec3(place[b, 0], place[b, 1], place[b, 2]), heading * turned)
    twist[b] = wp.spatial_vector(
        wp.vec3(share * v, 0.0, vz), wp.vec3(-sine * omega * share, cosine * omega * share, 0.0)
    )


@wp.kernel
def keep_vertical(response: wp.array(dtype=wp.mat33)):
    """Leaves of a body's response to an impulse its vertical velocity: the wheel's axle is guided."""
    i = wp.tid()
    m = response[i]
    response[i] = wp.mat33(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, m[2, 0], m[2, 1], m[2, 2])
