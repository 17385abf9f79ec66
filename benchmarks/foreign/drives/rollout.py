"""Drives of rovers in plain MuJoCo on the soils of `laws.py`: many rollouts at once, all wheels in one sweep."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from ..laws import LAWS, Rim
from ..misfit import RIM, coordinates
from ..wheel import _GAUSS, _GAUSS_WEIGHT, _LONG, _LONG_WEIGHT, Motion, Rows, World, softening
from .rovers import CORNERS, Build, Rover, mjcf

SETTLE = 1.2
"""Time that a rover stands before its log begins, s."""
KEEP = 10
"""Steps from one kept sample to the next."""
LAG = 0.004
"""Time constant of the motors' current loops, s."""
STEER_GAIN, STEER_DAMPER = 1000.0, 70.0

Command = Callable[[float], tuple[np.ndarray, np.ndarray]]
"""Time (s) to wheel speeds (rad/s) and steering angles (rad) of the four corners."""


@dataclasses.dataclass(frozen=True)
class Ground:
    """A plane that rises along x and waves that no map has.

    Attributes:
      slope: rad. waves: (wave, 2) wave vectors, 1/m. sizes, phases: m, rad.
    """

    slope: float
    waves: np.ndarray
    sizes: np.ndarray
    phases: np.ndarray


class _Terrain:
    """The grounds of all rollouts at once."""

    def __init__(self, grounds: Sequence[Ground]) -> None:
        self.steep = np.tan([g.slope for g in grounds])[:, None]
        self.waves = np.stack([g.waves for g in grounds])[:, None]
        self.sizes = np.stack([g.sizes for g in grounds])[:, None]
        self.phases = np.stack([g.phases for g in grounds])[:, None]

    def at(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Height (m) and upward unit normal (..., 3) at places of shape (rollout, place)."""
        phase = x[..., None] * self.waves[..., 0] + y[..., None] * self.waves[..., 1] + self.phases
        height = self.steep * x + np.sum(self.sizes * np.sin(phase), axis=-1)
        rise = self.sizes * np.cos(phase)
        dx = self.steep + np.sum(rise * self.waves[..., 0], axis=-1)
        dy = np.sum(rise * self.waves[..., 1], axis=-1)
        normal = np.stack([-dx, -dy, np.ones_like(dx)], axis=-1)
        return height, normal / np.sqrt(dx**2 + dy**2 + 1.0)[..., None]


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cross product over the last axis; NumPy's own takes five times as long for few vectors."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


@dataclasses.dataclass(frozen=True)
class Motors:
    """Drive motors as built: factors of torque constant, resistance and efficiency; loss at small current.

    Torque is gear K eta (1 - loss exp(-|I|/0.1 of the middle current)) I: the gear's efficiency falls at small loads.
    """

    constant: float = 1.0
    resistance: float = 1.0
    efficiency: float = 1.0
    loss: float = 0.0
    small_current: float = 0.05


@dataclasses.dataclass(frozen=True)
class Setup:
    """One rollout: build, motors, ground, commands; soil's constants as factors of the world's, and damping.

    `misfit`: what is added to the weights of each of the world's fields, by the field's number, shape (2 wave,).
    """

    build: Build
    motors: Motors
    ground: Ground
    command: Command
    soil: Mapping[str, float]
    damping: float
    misfit: Mapping[int, np.ndarray] = dataclasses.field(default_factory=dict)


_MISFIT = "misfit "


def _rows(world: World, setups: Sequence[Setup]) -> dict[str, Any]:
    """The soil's constants for every wheel of every rollout, shape (row, 1), and what its misfits have beside the
    world's, shape (row, 2 wave)."""
    rows = {k: np.repeat([v * s.soil.get(k, 1.0) for s in setups], 4)[:, None] for k, v in world.soil.items()}
    for n, field in enumerate(world.fields or ()):
        if any(n in s.misfit for s in setups):
            more = [s.misfit.get(n, np.zeros(len(field.weights))) for s in setups]
            rows[_MISFIT + str(n)] = np.repeat(np.array(more), 4, axis=0)
    return rows


def _settled_motion(
    u: np.ndarray, v: np.ndarray, w: np.ndarray, radius: np.ndarray, least: float
) -> tuple[Motion, np.ndarray]:
    """Motion of wheels whose travel is positive, finite at standstill, and the share of rolling."""
    floor = np.maximum(np.abs(u), least)
    slip = (u - v) / np.maximum(np.maximum(np.abs(u), np.abs(v)), least)
    return Motion(np.clip(slip, -1.0, 1.0), v / floor, w / floor, floor, v, radius), (u / floor)[:, None]


def _contact(
    world: World,
    soil: dict[str, Any],
    moves: Motion,
    roll: np.ndarray,
    rows: Rows,
    sinkage: np.ndarray,
    softer: np.ndarray,
) -> tuple[np.ndarray, ...]:
    """Lift, pull, side force (to the left) and torque of the soil at a sinkage, all of wheels that travel forward."""
    entry = np.arccos(np.clip(1.0 - sinkage / moves.radius, -0.9, 1.0))[:, None]
    slip, t = moves.slip[:, None], world.traits
    # On rovers the most pressed place and the exit are shares of the entry angle whatever the slip.
    if world.law == "granular":
        low, leave = 0.02, 0.0
        place, weight = 0.5 * (1.0 + _LONG)[None], 0.5 * _LONG_WEIGHT[None]
    else:
        low, leave = t.get("c1", 0.5), -t.get("c3", 0.0)
        spans = ((leave, low), (low, 1.0))
        place = np.concatenate([0.5 * (a + b) + 0.5 * (b - a) * _GAUSS for a, b in spans])[None]
        weight = np.concatenate([0.5 * (b - a) * _GAUSS_WEIGHT for a, b in spans])[None]
    rim = Rim(
        moves.radius[:, None],
        entry,
        low * entry,
        leave * entry,
        place * entry,
        weight * entry,
        moves.turn[:, None],
        moves.aside[:, None],
        slip,
        moves.rim[:, None],
        rows.angle[:, None],
        roll,
        0.05,
    )
    growth, more = softening(world, rows, moves)
    more = more * softer[:, None]
    pressure, ahead, left = LAWS[world.law](rim, world.width, soil, growth, more, t.get("circle", 0.0), 1.0, 0.0)
    if world.fields is not None:
        x = coordinates(moves.slip, rows.angle, np.ones_like(moves.slip), place[0, 0])[:, :-1]
        rim_place = place[0] / RIM
        pressure, ahead, left = (
            v * (1.0 + f.by_rows_and_places(x, rim_place, soil.get(_MISFIT + str(n), 0.0)))
            for n, (v, f) in enumerate(zip((pressure, ahead, left), world.fields, strict=True))
        )
    area = (moves.radius * world.width)[:, None] * rim.weight
    sine, cosine = np.sin(rim.theta), np.cos(rim.theta)
    return (
        np.sum(area * (pressure * cosine + ahead * sine), axis=1),
        np.sum(area * (-pressure * sine + ahead * cosine), axis=1),
        np.sum(area * left, axis=1),
        np.sum(area * ahead * moves.radius[:, None], axis=1),
    )


def wheel_forces(
    world: World,
    soil: dict[str, Any],
    u: np.ndarray,
    v: np.ndarray,
    w: np.ndarray,
    radius: np.ndarray,
    sinkage: np.ndarray,
    softer: np.ndarray,
    gravity: float,
    floor: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lift, pull, force to the left (N) and resisting torque (N m) on wheels that roll either way, one per row.

    Args:
      u, v, w: speed of the rim, and of the wheel forward and to the left, m/s. sinkage: m; none where not positive.
      softer: divisor of the stiffness. gravity: m/s2. floor: rim speed below which shear is damped, m/s.
    """
    ahead = 0.5 * (1.0 + np.tanh((u + v) / floor))
    found = [np.zeros_like(u) for _ in range(4)]
    touching = sinkage > 1e-6
    for way, share in ((1.0, ahead), (-1.0, 1.0 - ahead)):
        at = np.flatnonzero(touching & (share > 1e-3))
        if not len(at):
            continue
        moves, roll = _settled_motion(way * u[at], way * v[at], w[at], radius[at], floor)
        angle = np.arctan2(w[at], np.maximum(moves.along, floor))
        travel = np.hypot(v[at], w[at])
        rows = Rows(moves.slip, angle, np.full(len(at), world.middle_load), travel, np.full(len(at), gravity))
        part = _contact(world, {k: x[at] for k, x in soil.items()}, moves, roll, rows, sinkage[at], softer[at])
        for total, value, sign in zip(found, part, (1.0, way, 1.0, way), strict=True):
            total[at] += share[at] * sign * value
    return found[0], found[1], found[2], found[3]


class _Ruts:
    """Depths of ruts on a grid about each rollout's start; those younger than half a second do not count."""

    CELL, HALF, AGE = 0.05, 100, 0.5

    def __init__(self, rollouts: int) -> None:
        size = 2 * self.HALF + 2
        self.depth = np.zeros((rollouts, size, size))
        self.born = np.full((rollouts, size, size), np.inf)
        self.which = np.repeat(np.arange(rollouts), 4)

    def read(self, x: np.ndarray, y: np.ndarray, now: float) -> np.ndarray:
        """Depth of old ruts, bilinear, m."""
        fx, fy = x / self.CELL + self.HALF, y / self.CELL + self.HALF
        i, j = np.clip(fx.astype(int), 0, 2 * self.HALF), np.clip(fy.astype(int), 0, 2 * self.HALF)
        a, b = np.clip(fx - i, 0.0, 1.0), np.clip(fy - j, 0.0, 1.0)
        total = np.zeros_like(x)
        for di, dj, weight in ((0, 0, (1 - a) * (1 - b)), (1, 0, a * (1 - b)), (0, 1, (1 - a) * b), (1, 1, a * b)):
            old = now - self.born[self.which, i + di, j + dj] > self.AGE
            total += weight * np.where(old, self.depth[self.which, i + di, j + dj], 0.0)
        return total

    def write(self, x: np.ndarray, y: np.ndarray, depth: np.ndarray, now: float) -> None:
        """A wheel has been here."""
        i = np.clip(np.rint(x / self.CELL + self.HALF).astype(int), 0, 2 * self.HALF)
        j = np.clip(np.rint(y / self.CELL + self.HALF).astype(int), 0, 2 * self.HALF)
        for dj in (-1, 0, 1):
            jj = np.clip(j + dj, 0, 2 * self.HALF)
            self.born[self.which, i, jj] = np.minimum(self.born[self.which, i, jj], now)
            np.maximum.at(self.depth, (self.which, i, jj), depth)


def simulate(rover: Rover, world: World, setups: Sequence[Setup], seconds: float) -> dict[str, np.ndarray]:
    """Rolls out drives that begin at rest on the ground.

    Args:
      rover: as described. world: law, soil, misfit and hidden effects, one for all. setups: a rollout each.
      seconds: length, after `SETTLE` with all commanded speeds zero.

    Returns:
      By quantity, arrays of (rollout, sample, ...): time, position, quaternion, velocity (world), gyro, accelerometer,
      drive_angle, drive_speed, steer_angle, sus_angle, current, voltage, winding, housing (degC), sinkage, slip.
    """
    models = [mujoco.MjModel.from_xml_string(mjcf(rover, s.build)) for s in setups]
    datas = [mujoco.MjData(m) for m in models]
    count = len(models)
    first = models[0]
    wheel_body = [first.body(f"{c}_wheel").id for c in CORNERS]
    knuckle = [first.body(f"{c}_knuckle").id for c in CORNERS]
    drive = np.array([first.joint(f"{c}_drive").dofadr[0] for c in CORNERS])
    steer = np.array([first.joint(f"{c}_steer").dofadr[0] for c in CORNERS]) if rover.steered else None
    sus = np.array([first.joint(f"{c}_sus").dofadr[0] for c in CORNERS]) if rover.suspension != "none" else None
    dt = first.opt.timestep
    soil = _rows(world, setups)
    radius = np.full(4 * count, rover.radius)
    if e := world.has("wheel_radius_error"):
        radius = radius + e["offset"]
    damping = np.repeat([s.damping for s in setups], 4)
    constant = rover.constant * np.repeat([s.motors.constant for s in setups], 4).reshape(count, 4)
    halves = 2.0 if rover.sides else 1.0
    resistance = halves * rover.resistance * np.array([s.motors.resistance for s in setups])[:, None]
    efficiency = rover.efficiency * np.array([s.motors.efficiency for s in setups])[:, None]
    loss = np.array([s.motors.loss for s in setups])[:, None]
    small = np.array([s.motors.small_current for s in setups])[:, None]
    unit = rover.gear * rover.constant * rover.efficiency
    current = np.zeros((count, 4))
    ambient = 25.0 if not world.has("cold_grease") else world.effects["cold_grease"]["ambient"]
    winding, housing = np.full((count, 4), ambient), np.full((count, 4), ambient)
    lever = rover.arm if rover.suspension == "swing" else 1.0
    spring = rover.spring if rover.suspension == "swing" else rover.spring / max(rover.arm, 1e-9) ** 2
    damper = rover.damper if rover.suspension == "swing" else rover.damper / max(rover.arm, 1e-9) ** 2
    level = _level(rover) * lever / spring if sus is not None else None
    ruts = _Ruts(count) if world.has("multipass") else None
    rotor = None
    if world.has("backlash"):
        rotor = {
            "angle": np.zeros((count, 4)),
            "speed": np.zeros((count, 4)),
            "inertia": rover.rotor * rover.gear**2 / halves,
        }
    terrain = _Terrain([s.ground for s in setups])
    height = terrain.at(np.zeros((count, 1)), np.zeros((count, 1)))[0][:, 0]
    for k, (m, d) in enumerate(zip(models, datas, strict=True)):
        tilt = setups[k].ground.slope
        d.qpos[:7] = [0.0, 0.0, height[k] + rover.height / np.cos(tilt), np.cos(tilt / 2), 0.0, -np.sin(tilt / 2), 0.0]
        mujoco.mj_forward(m, d)
    settle = round(SETTLE / dt)
    steps = settle + round(seconds / dt)
    kept: dict[str, list[np.ndarray]] = {}
    delay = world.effects["actuator_delay"]["delay"] if world.has("actuator_delay") else 0.0
    toe = np.array([world.effects["steering_toe"][c] for c in CORNERS]) if world.has("steering_toe") else np.zeros(4)
    body = np.zeros((count, 4, 3))
    frame = np.zeros((count, 4, 3, 3))
    twist, middle = np.zeros((count, 4, 6)), np.zeros((count, 3))
    wanted = turned = np.zeros((count, 4))
    qvel, qpos = np.zeros((count, first.nv)), np.zeros((count, first.nq))
    sink, slips = np.zeros((count, 4)), np.zeros((count, 4))
    for step in range(steps + 1):
        now = (step - settle) * dt
        for k, (m, d) in enumerate(zip(models, datas, strict=True)):
            mujoco.mj_step1(m, d)
            body[k] = d.xpos[wheel_body]
            frame[k] = d.xmat[knuckle].reshape(4, 3, 3)
            twist[k] = d.cvel[knuckle]
            middle[k] = d.subtree_com[1]
            qvel[k], qpos[k] = d.qvel, d.qpos
        # MuJoCo's cvel is that of the body's point at the tree's centre of mass.
        angular = twist[:, :, :3]
        linear = twist[:, :, 3:] + _cross(angular, body - middle[:, None, :])
        if step and step >= settle and (step - settle) % KEEP == 0:
            _keep(
                kept,
                now,
                datas,
                qpos,
                qvel,
                drive,
                steer,
                sus,
                current,
                constant,
                resistance,
                rover,
                winding,
                housing,
                sink,
                slips,
            )
        if step % KEEP == 0:
            commands = [s.command(max(now - delay, 0.0)) for s in setups]
            wanted = np.array([c[0] for c in commands]) * (now > 0.0)
            turned = np.array([c[1] for c in commands])
        speed = qvel[:, drive]
        motor_speed = speed if rotor is None else rotor["speed"]
        asked = rover.drive_gain * (wanted - motor_speed) / unit
        if e := world.has("voltage_saturation"):
            emf = rover.gear * constant * motor_speed
            asked = np.clip(asked, (-e["bus"] - emf) / resistance, (e["bus"] - emf) / resistance)
        current += (asked - current) * min(dt / LAG, 1.0)
        torque = rover.gear * constant * efficiency * (1.0 - loss * np.exp(-np.abs(current) / small)) * current
        torque = torque - _friction(world, motor_speed, qpos[:, drive + 1], housing)
        if rotor is not None:
            torque = _through_play(world, rotor, torque, qpos[:, drive + 1], speed, dt)
        winding, housing = _heat(winding, housing, current, resistance, ambient, dt)
        # Ground under each wheel
        centre = body.reshape(-1, 3)
        high, normal = terrain.at(body[:, :, 0], body[:, :, 1])
        normal = normal.reshape(-1, 3)
        depth = (centre[:, 2] - high.reshape(-1)) * normal[:, 2]
        softer = np.ones(len(centre))
        if ruts is not None:
            e = world.effects["multipass"]
            old = ruts.read(centre[:, 0], centre[:, 1], now)
            depth = depth + e["plastic"] * old
            softer = softer / (1.0 + e["harder"] * np.tanh(old / (0.02 * rover.radius)))
        if e := world.has("soil_patches"):
            f = sum(
                e[f"a{i}"] * np.exp(-((centre[:, 0] - e[f"x{i}"]) ** 2 + centre[:, 1] ** 2) / (2.0 * e["width"] ** 2))
                for i in range(3)
            )
            softer = softer * np.exp(-f)
        true_radius = radius
        if e := world.has("eccentric_wheel"):
            true_radius = radius * (1.0 + e["share"] * np.cos(qpos[:, drive + 1] + e["phase"]).reshape(-1))
        sinkage = true_radius - depth
        heading = frame.reshape(-1, 3, 3)[:, :, 0]
        if np.any(toe):
            side = frame.reshape(-1, 3, 3)[:, :, 1]
            angle = np.tile(toe, count)[:, None]
            heading = np.cos(angle) * heading + np.sin(angle) * side
        forward = heading - np.sum(heading * normal, axis=1, keepdims=True) * normal
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        across = _cross(normal, forward)
        moving = linear.reshape(-1, 3)
        v, w = np.sum(moving * forward, axis=1), np.sum(moving * across, axis=1)
        turn_y = np.sum(angular.reshape(-1, 3) * across, axis=1)
        u = (speed.reshape(-1) + turn_y) * true_radius
        lift, pull, left, resist = wheel_forces(
            world, soil, u, v, w, true_radius, sinkage, softer, rover.gravity, rover.floor
        )
        down = -np.sum(moving * normal, axis=1)
        patch = world.width * np.sqrt(np.maximum(2.0 * true_radius * np.maximum(sinkage, 0.0), 0.0))
        lift = np.maximum(lift + damping * patch * down, 0.0) * (sinkage > 0.0)
        if e := world.has("rolling_resistance"):
            resist = resist + e["coefficient"] * true_radius * lift * np.tanh(u / rover.floor)
        force = lift[:, None] * normal + pull[:, None] * forward + left[:, None] * across
        moment = -resist[:, None] * across + ((true_radius - np.maximum(sinkage, 0.0)) * left)[:, None] * forward
        if ruts is not None:
            ruts.write(centre[:, 0], centre[:, 1], np.maximum(sinkage, 0.0), now)
        sink = np.maximum(sinkage, 0.0).reshape(count, 4)
        slips = ((u - v) / np.maximum(np.maximum(np.abs(u), np.abs(v)), rover.floor)).reshape(count, 4)
        for k, (m, d) in enumerate(zip(models, datas, strict=True)):
            d.qfrc_applied[:] = 0.0
            d.qfrc_applied[drive] = torque[k]
            if steer is not None:
                d.qfrc_applied[steer] = STEER_GAIN * (turned[k] - qpos[k, steer + 1]) - STEER_DAMPER * qvel[k, steer]
            if sus is not None and level is not None:
                d.qfrc_applied[sus] = spring * (level - qpos[k, sus + 1]) - damper * qvel[k, sus]
                if e := world.has("suspension_friction"):
                    scale = e["torque"] if rover.suspension == "swing" else e["torque"] / rover.arm
                    slow = 0.01 if rover.suspension == "swing" else 0.01 * rover.arm
                    d.qfrc_applied[sus] -= scale * np.tanh(qvel[k, sus] / slow)
            d.xfrc_applied[wheel_body, :3] = force[4 * k : 4 * k + 4]
            d.xfrc_applied[wheel_body, 3:] = moment[4 * k : 4 * k + 4]
            if e := world.has("spooling_cable"):
                # A cable that is paid out behind the rover: its pull grows with the way gone.
                way = np.hypot(*d.qpos[:2])
                d.xfrc_applied[1, :3] = -e["per_metre"] * way * d.xmat[1].reshape(3, 3)[:, 0]
            mujoco.mj_step2(m, d)
    found = {k: np.stack(v, axis=1) for k, v in kept.items()}
    if not all(np.all(np.isfinite(v)) for v in found.values()):
        raise FloatingPointError(f"{rover.name}: a rollout is not finite.")
    return found


def _level(rover: Rover) -> np.ndarray:
    """What each corner carries of what is sprung, N, front corners first as in `CORNERS`."""
    sprung = rover.chassis_mass
    front = 0.5 + 0.5 * rover.chassis_com[0] / rover.half_base
    share = np.array([front, front, 1.0 - front, 1.0 - front]) / 2.0
    return sprung * rover.gravity * share


def _friction(world: World, speed: np.ndarray, angle: np.ndarray, housing: np.ndarray) -> np.ndarray:
    """Torque that hidden friction and cogging take at the joint, N m."""
    lost = np.zeros_like(speed)
    if e := world.has("coulomb_friction"):
        lost = lost + e["torque"] * np.tanh(speed / 0.05)
    if e := world.has("stribeck_friction"):
        lost = lost + e["torque"] * np.exp(-((speed / e["speed"]) ** 2)) * np.tanh(speed / 0.05)
    if e := world.has("cold_grease"):
        lost = lost + e["viscosity"] * np.exp(-e["per_kelvin"] * (housing - 25.0)) * speed
    if e := world.has("cogging"):
        lost = lost - e["torque"] * np.sin(e["poles"] * angle + e["phase"])
    if e := world.has("oil_churning"):
        lost = lost + e["torque"] * np.sign(speed) * speed**2
    return lost


def _through_play(
    world: World, rotor: dict[str, Any], torque: np.ndarray, angle: np.ndarray, speed: np.ndarray, dt: float
) -> np.ndarray:
    """Torque that reaches the wheel through a gear with play; moves the rotor."""
    e = world.effects["backlash"]
    apart = rotor["angle"] - angle
    pressed = np.sign(apart) * np.maximum(np.abs(apart) - e["half_gap"], 0.0)
    passed = e["stiffness"] * pressed + np.where(pressed != 0.0, e["damping"] * (rotor["speed"] - speed), 0.0)
    rotor["speed"] = rotor["speed"] + dt * (torque - passed) / rotor["inertia"]
    rotor["angle"] = rotor["angle"] + dt * rotor["speed"]
    return passed


def _heat(
    winding: np.ndarray, housing: np.ndarray, current: np.ndarray, resistance: np.ndarray, ambient: float, dt: float
) -> tuple[np.ndarray, np.ndarray]:
    """Two-node heat of the drive motors: 10 s and 10 min."""
    path = (winding - housing) / 2.46
    return (
        winding + dt * (resistance * current**2 - path) / 4.2,
        housing + dt * (path - (housing - ambient) / 9.0) / 58.0,
    )


def _keep(
    kept: dict[str, list[np.ndarray]],
    now: float,
    datas: Sequence[Any],
    qpos: np.ndarray,
    qvel: np.ndarray,
    drive: np.ndarray,
    steer: np.ndarray | None,
    sus: np.ndarray | None,
    current: np.ndarray,
    constant: np.ndarray,
    resistance: np.ndarray,
    rover: Rover,
    winding: np.ndarray,
    housing: np.ndarray,
    sink: np.ndarray,
    slips: np.ndarray,
) -> None:
    sensors = np.array([d.sensordata for d in datas])
    values = {
        "time": np.full(len(datas), now),
        "position": qpos[:, :3],
        "quaternion": qpos[:, 3:7],
        "velocity": qvel[:, :3],
        "gyro": sensors[:, :3],
        "accelerometer": sensors[:, 3:6],
        "drive_angle": qpos[:, drive + 1],
        "drive_speed": qvel[:, drive],
        "current": current,
        "voltage": resistance * current + rover.gear * constant * qvel[:, drive],
        "winding": winding,
        "housing": housing,
        "sinkage": sink,
        "slip": slips,
    }
    if steer is not None:
        values["steer_angle"] = qpos[:, steer + 1]
    if sus is not None:
        values["sus_angle"] = qpos[:, sus + 1] / (1.0 if rover.suspension == "swing" else rover.arm)
    for name, value in values.items():
        kept.setdefault(name, []).append(np.array(value))
