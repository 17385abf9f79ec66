"""Checks of frames and of body channels against each other: quaternions, gravity, axes, left and right."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.logs.findings import Finding
from lunar_mjx.logs.log import Log
from lunar_mjx.logs.schema import SIDES, sensor_of
from lunar_mjx.logs.series import (
    Agreement,
    agreement,
    at,
    edges,
    guess,
    increments,
    integrals,
    known_at,
    means,
    sigma,
    span,
)


@dataclasses.dataclass(frozen=True)
class FrameLimits:
    """What the checks of frames and units tolerate."""

    norm_tolerance: float = 0.02
    """A quaternion of four components with 1 % noise has a norm within 2 %."""
    gravity_tolerance: float = 0.15
    """Relative; the bias of the poorest accelerometer is a few per cent of lunar gravity."""
    tilt_tolerance: float = 15.0
    """deg between measured and expected specific force: mounting errors and biases are a few degrees."""
    factor_tolerance: float = 0.3
    """Relative, between two channels of which one is the other's rate: scale errors are a few per cent."""
    # Cosine between two series above which they are proportional, and below which they have nothing in common.
    alike: float = 0.9
    unlike: float = 0.5
    course_tolerance: float = 60.0
    """deg between heading and course of a rover that does not crab: on side slopes they differ by less than 30."""
    ground_speed: float = 1.6
    """Factor between a velocity and the way in the same time that a winding course does not explain."""
    unknown_yaw: float = 60.0
    """Standard deviation of the IMU's mounting about z, deg, from which its yaw tells no heading."""
    level: float = 2.0
    """deg of pitch up to which no rover slides back on its own."""
    reversed_force: float = 150.0
    """deg between measured and expected specific force from which its sign is reversed, and not its axes."""
    steered: float = 0.05
    """rad by which a joint turns that steers: zeros of encoders are off by less."""
    turning: float = 0.05
    """rad/s of a wheel that drives: of a slower one, noise may tell the direction."""
    straight: float = 20.0
    """deg of heading within a window up to which its course has one direction."""


FRAME_LIMITS = FrameLimits()


def check_frames(log: Log) -> list[Finding]:
    """Findings on attitude, gravity, velocities against positions, and turning against the wheels."""
    findings = _quaternion(log)
    if not findings:
        findings += _euler(log) + _gravity(log)
    # Reported even so: they do not use the attitude.
    findings += _velocities(log) + _turning(log)
    # Course and sides read the channels checked before; broken ones would accuse good ones.
    return findings or _course(log) + _left_right(log)


def _finding(log: Log, channel: str, kind: str, message: str, row: int | None = None) -> Finding:
    table = log.table_of(channel)
    column = channel if table is None else table.columns.get(channel, channel)
    return Finding(log.name, "" if table is None else table.name, row, column, kind, message)


LEAST = {"position": 0.02, "roll": 1.0, "pitch": 1.0, "yaw": 1.0, "joint": 0.05}
"""Change per window, in m, deg and rad, below which nothing is said: rocking and rounding look like anything."""

QUATERNION = tuple(f"quaternion_{c}" for c in "wxyz")


def _quaternion(log: Log) -> list[Finding]:
    tables = [t for t in log.tables.values() if all(q in t.channels for q in QUATERNION)]
    if not tables:
        return []
    # The first table with a quaternion: a second one would be another estimate of one attitude.
    norm = np.sqrt(sum(tables[0].channels[q] ** 2 for q in QUATERNION))
    # Six sigma: four components and thousands of rows.
    tolerance = max(FRAME_LIMITS.norm_tolerance, 6.0 * max(sigma(log, q) for q in QUATERNION))
    wrong = np.isfinite(norm) & (np.abs(norm - 1.0) > tolerance)
    if not wrong.any():
        return []
    row = int(np.argmax(wrong))
    return [
        _finding(
            log,
            "quaternion_w",
            "quaternion",
            f"the quaternion has the norm {norm[row]:.4g}, and so in "
            f"{int(wrong.sum())} rows; normalise it (w, x, y, z, body to world)",
            row,
        )
    ]


def attitude(log: Log, time: np.ndarray) -> np.ndarray | None:
    """(n, 3, 3) body-to-world rotations at some times, from the quaternion or the Euler angles; None without either."""
    parts = [p for q in QUATERNION if (p := at(log, q, time)) is not None]
    if len(parts) == len(QUATERNION):
        q = np.stack(parts)
        w, x, y, z = q / np.linalg.norm(q, axis=0)
        return _rotation(w, x, y, z)
    return _euler_rotation(log, time)


def _euler_rotation(log: Log, time: np.ndarray) -> np.ndarray | None:
    angles = [at(log, f"{a}_deg", time) for a in ("roll", "pitch", "yaw")]
    if any(a is None for a in angles[:2]):
        return None
    roll, pitch, yaw = (np.zeros_like(time) if a is None else np.radians(a) for a in angles)
    cr, sr, cp, sp, cy, sy = (f(0.5 * a) for a in (roll, pitch, yaw) for f in (np.cos, np.sin))
    return _rotation(
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def _rotation(w: np.ndarray, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def _euler(log: Log) -> list[Finding]:
    """Findings where Euler angles contradict the quaternion of the same log."""
    limits = span(log, (*QUATERNION, "roll_deg", "pitch_deg", "yaw_deg"))
    if limits is None:
        return []
    # A fixed number of times, since the tables have rates of their own.
    time = np.linspace(*limits, 200)
    one, two = attitude(log, time), _euler_rotation(log, time)
    assert one is not None and two is not None
    # The angle between two rotations from the trace of R_1^T R_2.
    cosine = 0.5 * (np.einsum("nij,nij->n", one, two) - 1.0)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    if np.median(angle) < 5.0:
        return []
    return [
        _finding(
            log,
            "roll_deg",
            "frame",
            f"the Euler angles differ from the quaternion by {np.median(angle):.0f} "
            "deg; roll, pitch, yaw are intrinsic z-y'-x'', the quaternion is w, x, y, z from body to world",
        )
    ]


def _gravity(log: Log) -> list[Finding]:
    """Findings where the accelerometer, at rest or on average, does not read +g along the world's z."""
    names = [f"accelerometer_{a}_m_s2" for a in "xyz"]
    limits = span(log, names)
    if limits is None:
        return []
    time = np.linspace(*limits, 400)
    measured = np.stack([known_at(log, n, time) for n in names], 1)
    w, x, y, z = (np.full(1, v) for v in log.imu.quaternion)
    measured = measured @ _rotation(w, x, y, z)[0].T
    turn = attitude(log, time)
    if turn is not None:
        # A table of attitude may begin later or end sooner than the accelerometer's.
        both = np.isfinite(turn).all(axis=(1, 2))
        turn, measured = (turn[both], measured[both]) if both.any() else (None, measured)
    # The last row of body-to-world is the world's z in the body's axes.
    up = np.tile([0.0, 0.0, 1.0], (len(measured), 1)) if turn is None else turn[:, 2, :]
    # Medians, because a drive over boulders has jolts of many g.
    force, expected = np.median(measured, axis=0), np.median(up, axis=0)
    size, g = float(np.linalg.norm(force)), log.gravity_m_s2
    angle = float(np.degrees(np.arccos(np.clip(force @ expected / max(size, 1e-12) / np.linalg.norm(expected), -1, 1))))
    shown = ", ".join(f"{v:.3g}" for v in force)
    # First the sign: a reversed axis would also fail the size's and the axes' tests.
    if angle > FRAME_LIMITS.reversed_force:
        return [
            _finding(
                log,
                names[2],
                "gravity",
                f"the accelerometer reads ({shown}) m/s2 where +g along the "
                "body's z "
                "belongs: its sign is reversed; specific force points up at rest (an IMU that hangs upside down: "
                "quaternion = [0, 1, 0, 0] in [imu])",
            )
        ]
    if abs(size / g - 1.0) > FRAME_LIMITS.gravity_tolerance + 6.0 * max(sigma(log, n) for n in names) / g / 20.0:
        return [
            _finding(
                log,
                names[2],
                "gravity",
                f"the accelerometer reads {size:.4g} m/s2 at rest, but "
                "gravity_m_s2 = "
                f"{g:g}{guess(size / g)}; correct its unit or gravity_m_s2",
            )
        ]
    # without a known attitude the rover may stand on any slope
    if angle > (FRAME_LIMITS.tilt_tolerance if turn is not None else 45.0):
        return [
            _finding(
                log,
                names[2],
                "frame",
                f"the accelerometer reads ({shown}) m/s2, {angle:.0f} deg off the "
                "vertical that the attitude gives; check its axes and [imu] quaternion",
            )
        ]
    return []


def rate_agreement(log: Log, integral: str, rate: str, scale: float = 1.0, zero_known: bool = True) -> Agreement | None:
    """How the increments of a channel follow the integral of its rate (times `scale`) over windows of the log.

    Args:
      log: which holds both. integral, rate: channels. scale: unit of the integral over that of the rate.
      zero_known: whether a constant rate counts; else both are compared about their means.
    """
    limits = span(log, (integral, rate))
    if limits is None:
        return None
    windows = edges(*limits)
    length = float(windows[1] - windows[0])
    # Noise of a sum over a window at 20 Hz: the root of its length by the step.
    noise = sigma(log, integral) + abs(scale) * sigma(log, rate) * np.sqrt(length * 0.05)
    expected = scale * integrals(log, rate, windows, like=integral)
    moved, least = increments(log, integral, windows), LEAST[sensor_of(integral)]
    if not zero_known:
        both = np.isfinite(moved) & np.isfinite(expected)
        if both.any():
            moved, expected = moved - moved[both].mean(), expected - expected[both].mean()
    return agreement(moved, expected, noise, least)


def _velocities(log: Log) -> list[Finding]:
    """Findings where velocities do not fit positions: unit, sign, swapped axes."""
    pairs = {a: (f"position_{a}_m", f"world_velocity_{a}_m_s") for a in "xyz"}
    findings = _paired(log, pairs, "the change of") or _ground_speed(log)
    limits = span(log, [f"{k}_velocity_{a}_m_s" for k in ("world", "body") for a in "xy"])
    if findings or limits is None:
        return findings
    time = np.linspace(*limits, 300)
    speed = {}
    for frame in ("world", "body"):
        x, y = (known_at(log, f"{frame}_velocity_{a}_m_s", time) for a in "xy")
        speed[frame] = np.hypot(x, y)
    noise = max(sigma(log, f"{k}_velocity_x_m_s") for k in ("world", "body"))
    shared = agreement(speed["body"], speed["world"], noise)
    if (
        shared is not None
        and shared.cosine > FRAME_LIMITS.alike
        and abs(shared.factor - 1.0) > FRAME_LIMITS.factor_tolerance
    ):
        return [
            _finding(
                log,
                "body_velocity_x_m_s",
                "unit",
                f"is {shared.factor:.3g} times the world velocity in size{guess(shared.factor)}; correct its unit",
            )
        ]
    return []


def _ground_speed(log: Log) -> list[Finding]:
    """Findings where the forward velocity does not fit the way that positions tell, by tenths of the drive."""
    names = ("position_x_m", "position_y_m", "body_velocity_x_m_s")
    limits = span(log, names)
    if limits is None:
        return []
    # Long windows: over a few seconds positions of a receiver err more than a rover moves.
    windows = edges(*limits, count=10, shortest=4.0)
    way = np.hypot(*(increments(log, n, windows) for n in names[:2]))
    driven = np.abs(integrals(log, names[2], windows))
    # a rover that turns within a window goes further than its positions are apart: what goes straight is compared
    pair = agreement(driven, way, sigma(log, names[0]) / np.sqrt(5.0), least=0.5)
    if (
        pair is None
        or pair.cosine < FRAME_LIMITS.alike
        or 1.0 / FRAME_LIMITS.ground_speed < pair.factor < FRAME_LIMITS.ground_speed
    ):
        return []
    shown = f"is {pair.factor:.3g} times as fast as the positions change{guess(pair.factor)}"
    return [_finding(log, names[2], "unit", f"{shown}; correct its unit")]


def _turning(log: Log) -> list[Finding]:
    """Findings where the gyroscope does not fit the change of the attitude."""
    pairs = {"z": ("yaw_deg", "gyro_z_rad_s"), "x": ("roll_deg", "gyro_x_rad_s"), "y": ("pitch_deg", "gyro_y_rad_s")}
    return _paired(log, pairs, "the change of", scale=57.29577951308232)


def _paired(log: Log, pairs: dict[str, tuple[str, str]], what: str, scale: float = 1.0) -> list[Finding]:
    """Findings of channels that do not follow their rates: a wrong factor, or another channel's rate."""
    findings = []
    for key, (integral, rate) in pairs.items():
        own = rate_agreement(log, integral, rate, scale)
        other_pairs = [p[1] for k, p in pairs.items() if k != key]
        # A rate that follows another angle than its own is another axis's.
        twin = next((o for o in other_pairs if _alike(rate_agreement(log, integral, o, scale))), None)
        cosine = 0.0 if own is None else own.cosine
        if twin is not None and abs(cosine) < FRAME_LIMITS.unlike and span(log, (rate,)) is not None:
            text = f"has nothing in common with {what} {integral} (cosine {cosine:.2f}), which {twin} follows"
            findings.append(_finding(log, rate, "swap", f"{text}; these two are swapped"))
        elif own is None:
            continue
        elif abs(own.cosine) > FRAME_LIMITS.alike and abs(own.factor - 1.0) > FRAME_LIMITS.factor_tolerance:
            # A wrong sign is an axis, a wrong size a unit.
            kind = "frame" if own.factor < 0.0 else "unit"
            findings.append(
                _finding(
                    log,
                    rate,
                    kind,
                    f"does not agree with {integral}, which changes {own.factor:.3g} "
                    "times "
                    f"as fast{guess(own.factor)}; correct one of the two",
                )
            )
        elif _stuck(own) and _stuck(rate_agreement(log, integral, rate, scale, zero_known=sensor_of(rate) != "gyro")):
            findings.append(
                _finding(
                    log,
                    integral,
                    "stuck",
                    f"hardly changes ({own.series:.3g} per window) while {rate} "
                    f"lets expect {own.reference:.3g}; leave the broken one out",
                )
            )
    return findings


def _stuck(pair: Agreement | None) -> bool:
    """Whether a channel does not move where its rate lets expect it: it has no cosine to speak of.

    A gyroscope's zero is off by what nobody knows: a rate that never changes tells of its zero, and of no movement.
    """
    return pair is not None and abs(pair.cosine) < FRAME_LIMITS.unlike and pair.series < 0.2 * pair.reference


def _alike(pair: Agreement | None) -> bool:
    return (
        pair is not None and pair.cosine > FRAME_LIMITS.alike and abs(pair.factor - 1.0) < FRAME_LIMITS.factor_tolerance
    )


def wheel_means(log: Log, windows: np.ndarray, corners: Sequence[str], kind: str) -> np.ndarray | None:
    """Mean over some corners of a channel such as `joint_{}_drive_speed_rad_s`, by window."""
    names = [kind.format(c) for c in corners]
    present = [n for n in names if span(log, (n,)) is not None]
    # All or none: a mean over fewer wheels would be of another place.
    return None if len(present) < len(names) else np.mean([means(log, n, windows) for n in present], axis=0)


SPEED, STEER = "joint_{}_drive_speed_rad_s", "joint_{}_steer_angle_rad"


def _steers(log: Log) -> bool:
    """Whether any joint is steered by more than `FRAME_LIMITS.steered`."""
    names = [n for n in log.channel_names if "_steer_angle_rad" in n]
    return any(s is not None and float(np.abs(s[1]).max()) > FRAME_LIMITS.steered for s in map(log.channel, names))


def _turn_rate(log: Log) -> tuple[str, str] | None:
    """The channel that tells how the rover turns, and whether it is a rate or an angle."""
    for name, kind in (("gyro_z_rad_s", "rate"), ("yaw_deg", "angle")):
        if span(log, (name,)) is not None:
            return name, kind
    return None


def _side_speeds(log: Log) -> tuple[list[str], list[str]]:
    """Channels of the left and of the right wheels' speeds: by corner where all are there, else by side."""
    sides = [[SPEED.format(f"{s}{e}") for e in "fr"] for s in "lr"]
    if span(log, [*sides[0], *sides[1]]) is None:
        sides = [[SPEED.format(s)] for s in SIDES]
    return sides[0], sides[1]


def _left_right(log: Log) -> list[Finding]:
    """Findings where a rover turns against its wheels: faster right wheels and left steering turn it left."""
    turn = _turn_rate(log)
    own_left, own_right = _side_speeds(log)
    sides = [*own_left, *own_right]
    limits = span(log, [*sides, turn[0]]) if turn else None
    if turn is None or limits is None:
        return []
    windows = edges(*limits)
    yaw = integrals(log, turn[0], windows) if turn[1] == "rate" else np.radians(increments(log, turn[0], windows))
    left, right = (np.mean([means(log, n, windows) for n in names], axis=0) for names in (own_left, own_right))
    if not _steers(log):
        pair = agreement(yaw, right - left, sigma(log, sides[0]))
        if pair is not None and pair.cosine < -0.8:
            return [
                _finding(
                    log,
                    sides[0],
                    "swap",
                    f"the rover turns against its wheels (cosine {pair.cosine:.2f} "
                    "between "
                    f"{turn[0]} and right less left wheel speed): left and right are swapped, or z points down",
                )
            ]
        return []
    steer = [wheel_means(log, windows, c, STEER) for c in (("lf", "rf"), ("lr", "rr"))]
    if steer[0] is None or span(log, [STEER.format(c) for c in ("lf", "rf")]) is None:
        return []
    forward = 0.5 * (left + right)
    # Rear wheels steered the same way crab, the other way turn.
    bend = steer[0] - (0.0 if steer[1] is None else steer[1])
    # Backing up, the same steering turns the rover the other way: hence times the speed.
    pair = agreement(yaw, bend * forward, 0.01 * float(np.abs(forward).max()))
    if pair is not None and pair.cosine < -0.8:
        return [
            _finding(
                log,
                STEER.format("lf"),
                "swap",
                "the rover turns against its steering (cosine "
                f"{pair.cosine:.2f}); "
                "positive steering turns a wheel to the left",
            )
        ]
    return []


def _climbs(log: Log, windows: np.ndarray, spin: np.ndarray) -> np.ndarray:
    """Windows in which the wheels drive uphill while the rover, as far as its altitude is known, does not rise.

    A rover that climbs more than its soil bears slides back over spinning wheels. With an axis of its position reversed
    it would seem to, too, but it would rise.
    """
    limits = span(log, ("pitch_deg",))
    if limits is None or limits[0] > windows[0] or limits[1] < windows[-1]:
        return np.zeros(len(windows) - 1, bool)
    # A positive pitch has the nose down (right-handed about y, to the left).
    uphill = -means(log, "pitch_deg", windows) * np.sign(spin) > FRAME_LIMITS.level
    height = span(log, ("position_z_m",))
    if height is None or height[0] > windows[0] or height[1] < windows[-1]:
        return uphill
    return uphill & (increments(log, "position_z_m", windows) < 0.0)


def _course(log: Log) -> list[Finding]:
    """Findings where an unsteered rover does not move along its heading as its wheels drive, sliding downhill apart."""
    names = ("position_x_m", "position_y_m", "yaw_deg")
    drives = [n for side in _side_speeds(log) for n in side]
    limits = span(log, (*names, *drives))
    if limits is None or _steers(log):
        return []
    windows = edges(*limits)
    east, north = (increments(log, n, windows) for n in names[:2])
    sides = [np.mean([means(log, d, windows) for d in side], axis=0) for side in _side_speeds(log)]
    spin = 0.5 * (sides[0] + sides[1])
    turned = np.abs(increments(log, "yaw_deg", windows))
    # Backing up, course and heading point opposite ways by right.
    moved = np.hypot(east, north) * np.sign(spin)
    keep = np.abs(moved) > max(20.0 * sigma(log, names[0]), 1e-3)
    keep &= (np.abs(spin) > FRAME_LIMITS.turning) & (turned < FRAME_LIMITS.straight)
    # Where the sides turn against each other, slip decides where to the rover moves, however slowly it turns.
    keep &= sides[0] * sides[1] > 0.0
    heading = np.radians(means(log, "yaw_deg", windows))
    along, across = east * np.cos(heading) + north * np.sin(heading), north * np.cos(heading) - east * np.sin(heading)
    # Angle of the course off the heading, in the direction that the wheels drive.
    off = np.degrees(np.arctan2(across * np.sign(spin), along * np.sign(spin)))
    if log.imu.attitude and log.imu.mounting_std_deg[2] > FRAME_LIMITS.unknown_yaw and keep.any():
        # yaw counts from nowhere: only that the difference stays the same can be asked
        zero = np.degrees(np.angle(np.mean(np.exp(1j * np.radians(off[keep])))))
        off = (off - zero + 180.0) % 360.0 - 180.0
    keep &= (np.abs(off) < 90.0) | ~_climbs(log, windows, spin)
    if keep.sum() < 5:
        return []
    off = off[keep]
    if np.median(np.abs(off)) < FRAME_LIMITS.course_tolerance:
        return []
    return [
        _finding(
            log,
            "position_x_m",
            "frame",
            f"the rover travels {np.median(np.abs(off)):.0f} deg off its "
            "heading "
            "without steering; x is forward at yaw 0, yaw turns to the left, and the world is right-handed",
        )
    ]
