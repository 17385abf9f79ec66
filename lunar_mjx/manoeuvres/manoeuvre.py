"""A manoeuvre: segments of commands in rover-independent terms, where it starts, and how the test is arranged."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.effects.body.chassis import MOST_PAYLOAD
from lunar_mjx.errors import UserError, bad_input, require_name, require_within
from lunar_mjx.manoeuvres.stand import stand
from lunar_mjx.model import Model
from lunar_mjx.model.ambient import ENVIRONMENT, require_environment
from lunar_mjx.rover import Rover, Wheel
from lunar_mjx.simulate import SIMULATE, Commands
from lunar_mjx.toml_fields import Fields

FORMAT = "lunar-mjx-manoeuvre/1"
_FOLDER = Path(__file__).resolve().parent
MANOEUVRES: tuple[str, ...] = tuple(sorted(p.stem for p in _FOLDER.glob("*.toml")))
"""Names of the canned manoeuvres."""

ARRANGEMENTS = ("stand", "parking_brake", "tether", "hard_surface")
"""Effects that a test may be arranged with; its user knows of them, and so does every model of its log."""

_TOP = (
    "format",
    "description",
    "separates",
    "terrain",
    "start",
    "environment",
    "payload_share",
    "modes",
    "arrangement",
    "segment",
)
_SIDES = ("front", "rear", "left", "right")
_QUANTITIES = {"speed_m_s": "velocity", "current_A": "current"}
_SEGMENT = ("duration_s", "ramp_s", *_QUANTITIES, "steer_deg", "suspension_deg", "spin_deg_s")


@dataclasses.dataclass(frozen=True)
class ManoeuvreLimits:
    """Commands beyond which no rover is driven: what is larger is in another unit, or torn."""

    speed: float = 10.0
    """m/s at the rim: rovers on the Moon and Mars drive below 5."""
    current: float = 200.0
    """A: of a rover's motor."""
    turn: float = 360.0
    """deg, of steering and suspension, and of the heading at the start."""
    spin: float = 360.0
    """deg/s: of a turn on the spot."""
    start: float = 1e5
    """m from the terrain's origin: a drive log stays within 100 km."""


LIMITS = ManoeuvreLimits()

Sided = float | Mapping[str, float]


@dataclasses.dataclass(frozen=True)
class Segment:
    """A stretch of constant commands.

    Attributes:
      duration_s: s. ramp_s: time over which the commands change from those before in a straight line.
      drive: rim speed m/s or motor current A of the drive joints; steer, suspension: rad. One number, or by front,
        rear, left, right; sides add up.
      spin: in place of drive and steer, a turn on the spot to the left at this nominal rate, rad/s: wheels along the
        circle about the middle as far as they steer, rim speeds as they would roll on it (they skid, and so turn
        slower). Zero turns the wheels there at rest. None for no such turn.
    """

    duration_s: float
    ramp_s: float
    drive: Sided
    steer: Sided
    suspension: Sided
    spin: float | None = None


@dataclasses.dataclass(frozen=True)
class Manoeuvre:
    """A manoeuvre that any rover with driven wheels can run.

    Attributes:
      name: of its file. description, separates: what it is and which effects it tells apart.
      terrain: as in a log. start: x m, y m, yaw rad. environment: as in a log.
      payload_share: payload as a share of the rover's mass.
      drive_mode: velocity (commands are rim speeds) or current.
      arrangement: parameters of the effects of `ARRANGEMENTS` that the test is arranged with.
      segments: in order.
    """

    name: str
    description: str
    separates: tuple[str, ...]
    terrain: str
    start: tuple[float, float, float]
    environment: Mapping[str, float]
    payload_share: float
    drive_mode: str
    arrangement: Mapping[str, Mapping[str, float]]
    segments: tuple[Segment, ...]

    @property
    def duration_s(self) -> float:
        """Duration of the manoeuvre at scale 1, s."""
        return sum(s.duration_s for s in self.segments)


@functools.cache
def load_manoeuvre(name: str | Path) -> Manoeuvre:
    """A canned manoeuvre by name, or one from a TOML file of the same layout.

    Raises:
      UserError: there is none, or a key or value of its file is wrong.
    """
    path = _FOLDER / f"{name}.toml" if str(name) in MANOEUVRES else Path(name)
    if path.suffix != ".toml":
        raise bad_input(
            "manoeuvre", "name", str(name), "is neither canned nor a TOML file", f"use one of {', '.join(MANOEUVRES)}"
        )
    top = Fields.read(path, "the manoeuvre")
    top.known(_TOP)
    if top.text("format", "") != FORMAT:
        raise bad_input(path, "format", top.values.get("format"), "is not known", f'write format = "{FORMAT}"')
    start, environment = top.table("start"), top.table("environment")
    start.known(("x_m", "y_m", "yaw_deg"))
    environment.known(tuple(ENVIRONMENT))
    parts = top.tables("segment", "segment")
    if not parts:
        raise UserError(f"{path}: holds no [[segment]]; give at least one with duration_s.")
    arranged = top.table("arrangement")
    arranged.known(ARRANGEMENTS)
    modes = top.table("modes")
    modes.known(("drive",))
    mode = modes.choice("drive", ("velocity", "current")) or "velocity"
    described = [_segment(p, mode) for p in parts]
    longest = SIMULATE.most_commands * SIMULATE.interval
    if (whole := sum(s.duration_s for s in described)) > longest:
        raise bad_input(path, "sum of duration_s", whole, f"is above {longest:g} s", "give shorter segments")
    return Manoeuvre(
        name=path.stem,
        description=top.text("description", ""),
        separates=top.texts("separates"),
        terrain=require_name(path, "terrain", top.text("terrain", "flat")),
        start=(
            _within(start, "x_m", LIMITS.start),
            _within(start, "y_m", LIMITS.start),
            float(np.radians(_within(start, "yaw_deg", LIMITS.turn))),
        ),
        environment={
            k: require_environment(path, environment.field(k), k, environment.number(k)) for k in environment.values
        },
        payload_share=require_within(path, "payload_share", top.number("payload_share", 0.0), 0.0, MOST_PAYLOAD),
        drive_mode=mode,
        arrangement={k: {n: arranged.table(k).number(n) for n in arranged.table(k).values} for k in arranged.values},
        segments=tuple(described),
    )


def _within(fields: Fields, key: str, most: float) -> float:
    """A number of at most this size, zero if it is not there."""
    return require_within(fields.path, fields.field(key), fields.number(key, 0.0), -most, most)


def _segment(fields: Fields, mode: str) -> Segment:
    fields.known(_SEGMENT)
    for quantity, meant in _QUANTITIES.items():
        if quantity in fields.values and meant != mode:
            raise bad_input(
                fields.path,
                fields.field(quantity),
                fields.values[quantity],
                f'goes with modes.drive = "{meant}"',
                "set that mode, or use the other quantity",
            )
    duration = fields.positive("duration_s")
    ramp = fields.number("ramp_s", 0.0)
    if not 0.0 <= ramp <= duration:
        raise bad_input(fields.path, fields.field("ramp_s"), ramp, "is not within the segment", "give 0 to duration_s")
    most = LIMITS.speed if mode == "velocity" else LIMITS.current
    drive = _sided(fields, next((q for q, m in _QUANTITIES.items() if m == mode), "speed_m_s"), most)
    spin = float(np.radians(_within(fields, "spin_deg_s", LIMITS.spin))) if "spin_deg_s" in fields.values else None
    if spin is not None and mode != "velocity":
        raise bad_input(fields.path, fields.field("spin_deg_s"), spin, "needs drives in velocity mode", "set that mode")
    steer, suspension = (_radians(_sided(fields, key, LIMITS.turn)) for key in ("steer_deg", "suspension_deg"))
    return Segment(duration, ramp, drive, steer, suspension, spin)


def _sided(fields: Fields, key: str, most: float) -> Sided:
    value = fields.values.get(key, 0.0)
    if not isinstance(value, Mapping):
        return _within(fields, key, most)
    sides = fields.table(key)
    sides.known(_SIDES)
    return {side: _within(sides, side, most) for side in sides.values}


def _radians(value: Sided) -> Sided:
    return (
        {k: float(np.radians(v)) for k, v in value.items()} if isinstance(value, Mapping) else float(np.radians(value))
    )


def _of_wheel(value: Sided, wheel: Wheel) -> float:
    if not isinstance(value, Mapping):
        return float(value)
    # A wheel in the middle is neither front nor rear: only its side counts.
    return sum(value.get(place, 0.0) for place in (wheel.side or "right", wheel.row))


def with_arrangement(manoeuvre: Manoeuvre, model: Model) -> Model:
    """The model with the effects of the test's arrangement: a stand, a brake, a tether, hard ground."""
    for name, values in manoeuvre.arrangement.items():
        effect: Any = stand if name == "stand" else name
        if name in model.effect_names:
            model = model.set(name, manoeuvre.name, **values)
        else:
            model = model.add(effect, manoeuvre.name, **values)
    return model


def commands(manoeuvre: Manoeuvre, model: Model, scale: float = 1.0) -> Commands:
    """The manoeuvre as commands for a model whose drive joints are in the manoeuvre's mode.

    Args:
      manoeuvre: what to drive.
      model: of any rover; its control mode of `drive` must be the manoeuvre's.
      scale: factor on the durations of segments; speeds stay, so that a short version covers less ground.

    Returns:
      One row per whole number of time steps nearest to 0.05 s.

    Raises:
      UserError: a scale that is not positive, a manoeuvre shorter than one command, or another mode.
    """
    if not 0.0 < scale <= 1e3:
        raise bad_input("manoeuvre", "scale", scale, "is not a factor on durations", "give a positive number")
    if model.modes["drive"] != manoeuvre.drive_mode:
        raise bad_input(
            manoeuvre.name,
            "mode",
            model.modes["drive"],
            "is not that of its drive commands",
            f'set control.drive.mode = "{manoeuvre.drive_mode}"',
        )
    interval = max(1, round(SIMULATE.interval / model.timestep)) * model.timestep
    count = round(scale * manoeuvre.duration_s / interval)
    if count < 2:
        raise bad_input(
            "manoeuvre", "scale", scale, f"leaves {scale * manoeuvre.duration_s:g} s", "give a larger scale"
        )
    if count > SIMULATE.most_commands:
        problem = f"makes it {scale * manoeuvre.duration_s:g} s"
        raise bad_input("manoeuvre", "scale", scale, problem, "give a smaller scale")
    targets = [_targets(s, model) for s in manoeuvre.segments]
    ends = scale * np.cumsum([s.duration_s for s in manoeuvre.segments])
    out = np.empty((count, len(model.rover.joints)))
    # Row by row and not segment by segment: ends of scaled segments need not fall on the grid of commands.
    for row in range(count):
        time = row * interval
        # A nanosecond, so that a row at a segment's end belongs to the next one whichever way its time was rounded.
        i = min(int(np.searchsorted(ends, time + 1e-9, side="right")), len(ends) - 1)
        begin = ends[i - 1] if i else 0.0
        # ramps are scaled only as far as they must, so that short versions are not rougher
        stated = manoeuvre.segments[i].ramp_s
        ramp, into = min(stated, max(scale * stated, 0.5 * (ends[i] - begin))), time - begin
        share = 1.0 if into >= ramp else into / ramp
        # The first ramp starts from rest.
        before = targets[i - 1] if i else np.zeros_like(targets[0])
        out[row] = targets[i] if share == 1.0 else before + share * (targets[i] - before)
    return Commands(out, interval)


def _targets(segment: Segment, model: Model) -> np.ndarray:
    """(joint,) commands of a segment, within the joints' limits."""
    rover = model.rover
    places = wheel_places(rover) if segment.spin is not None else {}
    out = dict.fromkeys(rover.joints, 0.0)
    for wheel in rover.wheels:
        drive, steer = _of_wheel(segment.drive, wheel), _of_wheel(segment.steer, wheel)
        if segment.spin is not None:
            x, y = places[wheel.corner]
            drive = segment.spin * float(np.hypot(x, y)) * (-1.0 if y > 0.0 else 1.0)
            # the tangent of the circle, taken within 90 deg: left wheels then run backwards
            steer = float(np.arctan2(-x, y) if y > 0.0 else np.arctan2(x, -y))
        if model.modes["drive"] == "velocity":
            drive /= wheel.radius
        out[wheel.drive] = drive
        for joint, value in ((wheel.steer, steer), (wheel.suspension, _of_wheel(segment.suspension, wheel))):
            if joint is not None:
                # One manoeuvre serves every rover: where a joint cannot go as far, it goes as far as it can.
                low, high = rover.joint_limits[joint]
                out[joint] = float(np.clip(value, low, high))
    return np.array([out[j] for j in rover.joints])


@functools.cache
def wheel_places(rover: Rover) -> Mapping[str, tuple[float, float]]:
    """x, y of every wheel in the chassis frame at zero joint angles, m, by corner."""
    import mujoco

    model = rover.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    base = data.body(rover.chassis).xpos
    centres = {w.corner: data.body(w.body).xpos - base for w in rover.wheels}
    return {corner: (float(centre[0]), float(centre[1])) for corner, centre in centres.items()}
