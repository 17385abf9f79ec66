"""Checks of joints and motors against each other: commands, angles and speeds, currents and voltages, temperatures."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lunar_mjx.logs.checks.frames import FRAME_LIMITS, _finding, rate_agreement
from lunar_mjx.logs.findings import WARNING, Finding, is_bad
from lunar_mjx.logs.log import Log
from lunar_mjx.logs.schema import CORNERS, SIDES
from lunar_mjx.logs.series import agreement, continuous, edges, guess, known, known_at, means, sigma, span


@dataclasses.dataclass(frozen=True)
class MotorLimits:
    """What the checks of motors tolerate."""

    crossed: float = 3.0
    """By how much two joints must fit each other's partner better than their own, before they count as swapped."""
    many: float = 5.0
    """Factor between a command and what follows it that no controller leaves, but a unit does."""
    least_resistance: float = 0.02
    """ohm, of any motor of a rover with its cables; less means that the current is in mA."""
    # Cosine between a motor's current and its wheel's speed below which the motor seems to brake all the way; deg of
    # pitch beyond which it may.
    against: float = -0.8
    downhill: float = 2.0
    follows: float = 0.95
    """Cosine between a joint and its command from which the factor between them is one of units."""
    least_factor: float = 0.01
    """Factor below which a joint was held: it did not follow its command in any unit."""
    least_steer: float = 0.02
    """rad by which a joint that steers or gives way turns within a window: a held one only by its rounding."""
    heat_every: float = 0.5
    """s between looks at temperatures: heat moves in seconds."""
    heat_least: float = 20.0
    """s of temperatures that tell whether a winding warms by its current: about two of its time constants."""
    same_values: int = 20
    """Different values of two currents that are equal row by row, from which one is a copy: rounded to 0.1 A, the
    currents of two motors agree in one row of ten or so."""


MOTOR_LIMITS = MotorLimits()


def check_motors(log: Log) -> list[Finding]:
    """Findings on every joint's motor, and on pairs of corners whose channels may be swapped."""
    findings = _against(log) + _copies(log)
    for kind in ("drive", "steer", "sus"):
        for quantity in ("speed_rad_s", "angle_rad"):
            findings += _follows(log, kind, quantity)
        # Angles, currents and temperatures are compared with the joints' speeds, which must be sound.
        if not is_bad(findings):
            findings += _angles(log, kind) + _electric(log, kind) + _heat(log, kind)
    return findings


def _present(log: Log, pattern: str) -> dict[str, str]:
    """Channels of a pattern by corner, or by side."""
    names = {c: pattern.format(c) for c in (*CORNERS, *SIDES)}
    return {c: n for c, n in names.items() if continuous(log, n) is not None}


def _copies(log: Log) -> list[Finding]:
    """Findings of currents of two motors that are one reading: a side's or the rover's, written under several names."""
    names = _present(log, "motor_{}_drive_current_A")
    speeds = {
        side: [n for c, n in _present(log, "joint_{}_drive_speed_rad_s").items() if c.startswith(side[0])]
        for side in SIDES
    }
    # Where both sides turn alike all the way, a simulation without noise gives both the same current.
    left, right = ([known(log, n)[1] for n in speeds[side]] for side in SIDES)
    alike = not left or not right or np.array_equal(left[0], right[0])
    findings = []
    for k, (corner, name) in enumerate(names.items()):
        values = known(log, name)[1]
        if len(np.unique(values)) < MOTOR_LIMITS.same_values:
            continue
        for other, twin in list(names.items())[:k]:
            across = corner[0] != other[0]
            if (across and alike) or not np.array_equal(values, known(log, twin)[1]):
                continue
            text = f"equals {twin} in all {len(values)} rows: two motors never draw the same; map each motor's own"
            remedy = "reading, a side's once as motor_left_drive_current_A, and leave out one of all motors together"
            findings.append(_finding(log, name, "copy", f"{text} {remedy}"))
            break
    return findings


def _against(log: Log) -> list[Finding]:
    """Findings of currents that oppose their speed on average, where a driven rover takes power.

    A warning only: a motor may brake all the way down a slope that no channel tells.
    """
    current, speed = _present(log, "motor_{}_drive_current_A"), _present(log, "joint_{}_drive_speed_rad_s")
    findings = []
    for c, name in current.items():
        limits = span(log, (name, speed[c])) if c in speed and name not in log.magnitudes else None
        if limits is None:
            continue
        windows = edges(*limits)
        i, w = means(log, name, windows), means(log, speed[c], windows)
        pitch = means(log, "pitch_deg", windows) if span(log, ("pitch_deg",)) == limits else np.zeros(len(i))
        # Downhill a motor brakes, and its current has the other sign by right.
        keep = (np.abs(w) > FRAME_LIMITS.turning) & (np.sign(w) * pitch < MOTOR_LIMITS.downhill)
        if keep.sum() < 8:
            continue
        cosine = float(i[keep] @ w[keep] / max(np.linalg.norm(i[keep]) * np.linalg.norm(w[keep]), 1e-12))
        if cosine < MOTOR_LIMITS.against:
            text = f"is negative where {speed[c]} is positive (cosine {cosine:.2f}), as if the motor braked all the way"
            problem = _finding(log, name, "frame", f"{text}; correct its sign if it drove")
            findings.append(dataclasses.replace(problem, severity=WARNING))
    return findings


def _follows(log: Log, kind: str, quantity: str) -> list[Finding]:
    """Findings of joints that do not follow their commands, or follow another corner's."""
    measured = _present(log, f"joint_{{}}_{kind}_{quantity}")
    commanded = _present(log, f"command_{{}}_{kind}_{quantity}")
    corners = [c for c in measured if c in commanded]
    limits = span(log, [measured[c] for c in corners] + [commanded[c] for c in corners]) if corners else None
    if limits is None:
        return []
    time = np.linspace(*limits, 500)
    seen = {c: known_at(log, measured[c], time) for c in corners}
    wanted = {c: _held(log, commanded[c], time) for c in corners}
    findings = []
    for a in corners:
        noise = max(sigma(log, measured[a]), 1e-3)
        mine, other = wanted[a], seen[a]
        # A third of the noise: the agreement is taken over hundreds of samples.
        pair = agreement(other, mine, noise / 3.0)
        # one command tells neither sign nor unit: a controller may scale it down, or trade the sides' speeds for a turn
        if pair is None or len(np.unique(mine[mine != 0.0])) < 2:
            continue
        slow = MOTOR_LIMITS.least_factor < pair.factor < 1.0 / (4.0 * MOTOR_LIMITS.many)
        if pair.cosine > MOTOR_LIMITS.follows and (pair.factor > MOTOR_LIMITS.many or slow):
            findings.append(
                _finding(
                    log,
                    measured[a],
                    "unit",
                    f"is {pair.factor:.3g} times its command{guess(pair.factor)}; correct its unit, or the command's",
                )
            )
        # Both: about zero and about the means, since a constant offset can turn either alone.
        elif pair.cosine < -FRAME_LIMITS.alike and _together(mine, other) < -FRAME_LIMITS.unlike:
            findings.append(
                _finding(
                    log,
                    measured[a],
                    "frame",
                    f"moves against its command (cosine {pair.cosine:.2f}); "
                    "positive drives forward, steers left, raises the chassis",
                )
            )
    return findings or _swapped(log, {c: measured[c] for c in corners}, seen, wanted, "command")


def _together(one: np.ndarray, other: np.ndarray) -> float:
    """Correlation of two series about their means; 0 where one does not change."""
    a, b = one - np.nanmean(one), other - np.nanmean(other)
    size = float(np.sqrt(np.nansum(a * a) * np.nansum(b * b)))
    return float(np.nansum(a * b)) / size if size > 0.0 else 0.0


def _held(log: Log, name: str, time: np.ndarray) -> np.ndarray:
    samples = log.channel(name)
    assert samples is not None, name
    command_times, values = samples
    return values[np.maximum(np.searchsorted(command_times, time + 1e-6, side="right") - 1, 0)]


def _swapped(
    log: Log, names: dict[str, str], seen: dict[str, np.ndarray], wanted: dict[str, np.ndarray], what: str
) -> list[Finding]:
    """Findings of two corners whose channels fit each other's reference far better than their own."""

    def miss(a: str, b: str) -> float:
        # the response is taken a little later too, so that a controller's lag does not count
        gaps = [float(np.nanmean((np.roll(wanted[b], k) - seen[a])[5:] ** 2)) for k in range(5)]
        return np.sqrt(min(gaps))

    findings = []
    corners = list(names)
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            # Two joints that are told the same cannot be told apart.
            apart = float(np.sqrt(np.nanmean((wanted[a] - wanted[b]) ** 2)))
            noise = max(sigma(log, names[a]), sigma(log, names[b]), 1e-3)
            own, crossed = max(miss(a, a), 1e-12) + miss(b, b), miss(a, b) + miss(b, a)
            if (
                apart > 5.0 * noise
                and min(miss(a, a), miss(b, b)) > 0.5 * apart
                and own > MOTOR_LIMITS.crossed * crossed
            ):
                findings.append(
                    _finding(
                        log,
                        names[a],
                        "swap",
                        f"follows the {what} of {b} and {names[b]} that of {a} "
                        "(miss "
                        f"{own:.3g} as they are, {crossed:.3g} crossed); exchange the two columns",
                    )
                )
    return findings


def _angles(log: Log, kind: str) -> list[Finding]:
    """Findings of joint angles that do not follow their speeds."""
    angles, speeds = _present(log, f"joint_{{}}_{kind}_angle_rad"), _present(log, f"joint_{{}}_{kind}_speed_rad_s")
    findings = []
    for c, angle in angles.items():
        pair = rate_agreement(log, angle, speeds[c]) if c in speeds else None
        if pair is None or (kind != "drive" and pair.reference < MOTOR_LIMITS.least_steer):
            continue
        if abs(pair.cosine) > FRAME_LIMITS.alike and abs(pair.factor - 1.0) > FRAME_LIMITS.factor_tolerance:
            findings.append(
                _finding(
                    log,
                    angle,
                    "unit",
                    f"changes {pair.factor:.3g} times as fast as {speeds[c]} says"
                    f"{guess(pair.factor)}; correct one of the two",
                )
            )
        elif pair.cosine < FRAME_LIMITS.unlike:
            findings.append(
                _finding(
                    log,
                    angle,
                    "swap",
                    f"has nothing in common with {speeds[c]} (cosine "
                    f"{pair.cosine:.2f}); "
                    "one of them is another joint's, or broken",
                )
            )
    return findings or _crossed_speeds(log, kind, angles, speeds)


def _crossed_speeds(log: Log, kind: str, angles: dict[str, str], speeds: dict[str, str]) -> list[Finding]:
    """Findings of two joints whose angles fit each other's speed."""
    corners = [c for c in angles if c in speeds]
    limits = span(log, [angles[c] for c in corners] + [speeds[c] for c in corners]) if corners else None
    if limits is None or kind != "drive":
        return []
    time = np.linspace(*limits, 60)
    length = time[1] - time[0]

    def rate(name: str) -> np.ndarray:
        return np.diff(known_at(log, name, time)) / length

    def mean(name: str) -> np.ndarray:
        sample_times, values = known(log, name)
        total = np.concatenate([[0.0], np.cumsum(0.5 * (values[1:] + values[:-1]) * np.diff(sample_times))])
        return np.diff(np.interp(time, sample_times, total)) / length

    return _swapped(
        log,
        {c: angles[c] for c in corners},
        {c: rate(angles[c]) for c in corners},
        {c: mean(speeds[c]) for c in corners},
        "speed",
    )


def _electric(log: Log, kind: str) -> list[Finding]:
    """Findings where V = R I + k omega asks for a negative R or k: unit of the current, swapped columns or motors."""
    current, voltage = _present(log, f"motor_{{}}_{kind}_current_A"), _present(log, f"motor_{{}}_{kind}_voltage_V")
    speed = _present(log, f"joint_{{}}_{kind}_speed_rad_s")
    corners = [c for c in current if c in voltage and c in speed]
    limits = span(log, [d[c] for c in corners for d in (current, voltage, speed)]) if corners else None
    if limits is None:
        return []
    time = np.linspace(*limits, 500)
    data = {c: _Motor(*(known_at(log, d[c], time) for d in (voltage, current, speed))) for c in corners}
    findings = []
    for c in corners:
        fit = _circuit(data[c])
        if fit is None:
            continue
        (resistance, back_emf), (error_r, error_k) = fit
        # A motor that turns adds to its voltage; twenty errors, as noise is not white.
        if back_emf < -20.0 * error_k:
            findings.append(
                _finding(
                    log,
                    voltage[c],
                    "swap",
                    "falls with the joint's speed at a given current "
                    f"({back_emf:.3g} "
                    f"V s/rad): it is swapped with {current[c]}, or has the wrong sign",
                )
            )
        elif 0.0 < resistance < MOTOR_LIMITS.least_resistance and resistance > 20.0 * error_r:
            findings.append(
                _finding(
                    log,
                    current[c],
                    "unit",
                    f"gives a motor of {resistance:.3g} ohm with {voltage[c]} (looks like mA for A); correct its unit",
                )
            )
    return findings or _crossed_currents(log, current, data)


class _Motor(NamedTuple):
    """Voltage, V, current, A, and the joint's speed, rad/s, at common times."""

    voltage: np.ndarray
    current: np.ndarray
    speed: np.ndarray


def _circuit(motor: _Motor) -> tuple[np.ndarray, np.ndarray] | None:
    """Resistance and back-EMF constant with standard errors; None where current and speed do not tell them apart."""
    # Least squares of V = R I + k omega; where the columns are nearly parallel (a steady drive) nothing can be told.
    design, voltage = np.stack([motor.current, motor.speed], 1), motor.voltage
    size = np.sqrt(np.mean(design**2, axis=0))
    if not (size > 0.0).all():
        return None
    scaled = design / size
    # A steady drive draws current in proportion to its speed.
    if np.linalg.cond(scaled) > 100.0:
        return None
    coefficients, *_ = np.linalg.lstsq(scaled, voltage, rcond=None)
    residual = voltage - scaled @ coefficients
    if residual @ residual > 0.1 * (voltage @ voltage):
        return None  # another circuit than a motor's; no statement
    variance = residual @ residual / max(1, len(voltage) - 2) * np.diag(np.linalg.inv(scaled.T @ scaled))
    return coefficients / size, np.sqrt(variance) / size


def _crossed_currents(log: Log, names: dict[str, str], data: dict[str, _Motor]) -> list[Finding]:
    def miss(a: str, b: str) -> float:
        design, voltage = np.stack([data[b].current, data[a].speed], 1), data[a].voltage
        return float(np.linalg.norm(voltage - design @ np.linalg.lstsq(design, voltage, rcond=None)[0]))

    findings = []
    corners = list(data)
    for i, a in enumerate(corners):
        for b in corners[i + 1 :]:
            pairs = [(miss(a, a), miss(a, b)), (miss(b, b), miss(b, a))]
            apart = float(np.sqrt(np.mean((data[a].current - data[b].current) ** 2)))
            if apart > 5.0 * sigma(log, names[a]) and all(
                own > MOTOR_LIMITS.crossed * crossed for own, crossed in pairs
            ):
                findings.append(
                    _finding(
                        log,
                        names[a],
                        "swap",
                        f"fits the voltage of {b} and {names[b]} that of {a}; exchange the two columns",
                    )
                )
    return findings


def _heat(log: Log, kind: str) -> list[Finding]:
    """Findings of windings that do not rise above their housings while current flows."""
    winding = _present(log, f"winding_{{}}_{kind}_temperature_degC")
    housing = _present(log, f"housing_{{}}_{kind}_temperature_degC")
    current = _present(log, f"motor_{{}}_{kind}_current_A")
    findings = []
    for c in [c for c in winding if c in housing and c in current]:
        limits = span(log, (winding[c], housing[c], current[c]))
        if limits is None:
            continue
        time = np.arange(*limits, MOTOR_LIMITS.heat_every)
        power = _average(known_at(log, current[c], time), MOTOR_LIMITS.heat_every / 10.0)
        apart = known_at(log, winding[c], time) - known_at(log, housing[c], time)
        if len(time) < MOTOR_LIMITS.heat_least / MOTOR_LIMITS.heat_every:
            continue
        rise, cosine = _slope(power, apart)
        if cosine < -0.8 and abs(rise) * np.ptp(power) > max(5.0, 8.0 * sigma(log, winding[c])):
            findings.append(
                _finding(
                    log,
                    winding[c],
                    "swap",
                    f"falls against {housing[c]} as current flows (correlation {cosine:.2f}): the two are swapped",
                )
            )
    return findings


def _average(current: np.ndarray, share: float) -> np.ndarray:
    """Squared current through a first-order lag, as the winding's heat follows it."""
    out, state = np.zeros_like(current), float(current[0] ** 2)
    for i, value in enumerate(current):
        # A lag of ten seconds: order of a small motor's winding.
        state += share * (value**2 - state)
        out[i] = state
    return out


def _slope(x: np.ndarray, y: Sequence[float] | np.ndarray) -> tuple[float, float]:
    a, b = x - np.mean(x), np.asarray(y) - np.mean(y)
    size = float(a @ a)
    if size <= 0.0 or not (b @ b) > 0.0:
        return 0.0, 0.0
    return float(a @ b) / size, float(a @ b / np.sqrt(size * (b @ b)))
