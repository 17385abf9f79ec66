"""Do the engines agree? Three levels: one state stage by stage, single steps along a drive, and open-loop drives.

The reference is native MuJoCo with forces in NumPy. Level 1 and 2 start every engine from states that the reference
recorded, so that nothing drifts; level 3 lets them drive for themselves, with the reference itself perturbed by
float32 as the noise floor.
"""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import jax
import numpy as np

from lunar_mjx.backends.base import STAGES, Backend, BackendState, Observation, observation, telemetry
from lunar_mjx.backends.hooks import Hook
from lunar_mjx.backends.jax_backend import JaxBackend
from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.backends.parity_cases import ABSOLUTE, EXCEPTIONS, QUANTITIES, RELATIVE, Case, Tolerance
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands
from lunar_mjx.terrain import Terrain, stack

STEP_QUANTITIES = ("position", "orientation", "joint_angle", "velocity", "joint_speed", "winding_temperature",
                   "housing_temperature", "shear_state")  # fmt: skip
"""What level 2 compares after one step."""

DRIVE_QUANTITIES = ("position", "orientation", "joint_angle", "sinkage", "slip", "joint_torque",
                    "winding_temperature", "housing_temperature")  # fmt: skip
"""What level 3 compares along a drive."""

FLOOR_FACTOR = 10.0
"""A drive may depart from the reference by its tolerance and this many times the noise floor."""

MOMENTARY = ("sinkage", "slip", "joint_torque")
"""Quantities that are not integrals of the motion: their noise floor counts around its time, not ever after."""

RUNS = 4
"""Drives of the reference with roundings drawn anew: one alone would not tell how far they can carry it."""

SPREAD = 4.0
"""Width of those roundings in units of the last place. A float32 engine's sinkage on uneven ground is off by 4e-8 m
(root mean square, measured at level 1): rounding alone would make it 1e-8 m, but heights and wheels are sums."""

MOMENT = 10
"""Half the width of that window, in samples of a drive (0.5 s)."""


@dataclasses.dataclass
class Samples:
    """States along the reference's drive on one ground, the control of each, and what followed."""

    state: BackendState
    control: np.ndarray
    stages: Observation
    after: Observation


@dataclasses.dataclass
class Noise:
    """The reference's drive under float32's perturbations.

    Attributes:
      start: started from coordinates that are rounded to float32, and left alone.
      held: coordinates and speeds moved by float32's errors after every step, as in an engine that holds them so;
        (rover, time) with `RUNS` rovers.
    """

    start: Telemetry
    held: Telemetry


@dataclasses.dataclass(frozen=True)
class Result:
    """One comparison of two engines.

    Attributes:
      level: 1, 2 or 3. stage: of the step (level 1), "step" or "drive". quantity: compared.
      error: largest |a - b|/(atol + rtol |a|). difference: largest |a - b|. size: largest |a|.
      where: the entry of the largest error, such as a wheel's corner. floor: largest difference of the noise floor.
    """

    case: str
    level: int
    stage: str
    quantity: str
    error: float
    difference: float
    size: float
    where: str
    floor: float = 0.0

    @property
    def passed(self) -> bool:
        return bool(self.error <= 1.0)


class Runner:
    """An engine that evaluates states and drives, one backend per ground, with `rovers` at once."""

    def __init__(self, name: str, make: Callable[[Model, int], Backend], model: Model, rovers: int = 0) -> None:
        self.name, self.make, self.model, self.rovers = name, make, model, rovers

    def step_from(self, case: Case, samples: Samples) -> tuple[Observation, Observation]:
        """Stages of the step from every sample, and the state after it."""
        rovers = self.rovers or len(samples.control)
        with contextlib.closing(self.make(self.model.replace(terrain=case.terrain), rovers)) as backend:
            return _in_parts(backend, samples, rovers)

    def drive(self, case: Case, commands: Commands) -> Telemetry:
        with contextlib.closing(self.make(self.model.replace(terrain=case.terrain), 1)) as backend:
            backend.reset()
            return backend.run(commands)

    def close(self) -> None:
        """Frees what the engine keeps from one call to the next."""


class JaxRunner(Runner):
    """A JAX engine: one compiled program of `WIDTH` rovers, each with its own ground, for samples and drives alike."""

    WIDTH = 6

    def __init__(self, engine: str, model: Model, precision: str = "float64") -> None:
        self.engine, self.model, self.precision = engine, model, precision
        self.name = engine if precision == "float64" else f"{engine}, {precision}"
        self._backend: JaxBackend | None = None

    def _on(self, grounds: list[Terrain]) -> JaxBackend:
        """The backend with these grounds, one per rover."""
        if self._backend is None:
            model = self.model.replace(terrain=grounds[0])
            self._backend = JaxBackend(model, self.engine, self.WIDTH, self.precision)
        self._backend.set_terrain(stack(grounds), each=True)
        return self._backend

    def step_from(self, case: Case, samples: Samples) -> tuple[Observation, Observation]:
        return _in_parts(self._on([case.terrain] * self.WIDTH), samples, self.WIDTH)

    def drives(self, cases: list[Case], commands: Commands) -> list[Telemetry]:
        """Drives on several grounds at once."""
        out: list[Telemetry] = []
        for start in range(0, len(cases), self.WIDTH):
            part = cases[start : start + self.WIDTH]
            backend = self._on([c.terrain for c in _filled(part, self.WIDTH)])
            backend.reset()
            seen = backend.run(commands)
            out += [jax.tree.map(lambda a, i=i: a[i : i + 1], seen) for i in range(len(part))]
        return out

    def close(self) -> None:
        """Frees the compiled program."""
        self._backend = None
        jax.clear_caches()


def native_runner(model: Model, hooks: Iterable[Hook] = (), name: str = "native") -> Runner:
    """The reference, or with hooks a reference with planted faults."""
    return Runner(name, lambda m, n: NativeBackend(m, hooks, n), model)


def _filled(items: list[Any], width: int) -> list[Any]:
    """The items, and the last of them again up to `width`."""
    return items + [items[-1]] * (width - len(items))


def _in_parts(backend: Backend, samples: Samples, rovers: int) -> tuple[Observation, Observation]:
    """`_evaluate` of all samples, `rovers` at once."""
    seen: list[Observation] = []
    after: list[Observation] = []
    for start in range(0, len(samples.control), rovers):
        at = list(range(start, min(start + rovers, len(samples.control))))
        state, control = _rows(samples, np.array(_filled(at, rovers)))
        for pieces, piece in zip((seen, after), _evaluate(backend, state, control), strict=True):
            pieces.append({k: v[: len(at)] for k, v in piece.items()})
    return _joined(seen), _joined(after)


def _joined(pieces: list[Observation]) -> Observation:
    return {k: np.concatenate([p[k] for p in pieces]) for k in pieces[0]}


def _rows(samples: Samples, at: np.ndarray) -> tuple[BackendState, np.ndarray]:
    s = samples.state
    effects = {e: {k: v[at] for k, v in own.items()} for e, own in s.effects.items()}
    state = BackendState(s.step, s.qpos[at], s.qvel[at], s.winding_temperature[at], s.housing_temperature[at],
                         effects)  # fmt: skip
    return state, samples.control[at]


def _evaluate(backend: Backend, state: BackendState, control: np.ndarray) -> tuple[Observation, Observation]:
    backend.set_state(state)
    backend.step(control)
    seen, new = backend.observe(), backend.state()
    seen["acceleration"] = (new.qvel - state.qvel) / backend.model.timestep
    return seen, coordinates(backend.model, new)


def coordinates(model: Model, state: BackendState) -> Observation:
    """A state as the quantities of level 2."""
    shear = state.effects.get("shear_state", {})
    return {
        "position": state.qpos[:, :3],
        "orientation": state.qpos[:, 3:7],
        "joint_angle": state.qpos[:, 7:],
        "velocity": state.qvel[:, :6],
        "joint_speed": state.qvel[:, 6:],
        "winding_temperature": state.winding_temperature,
        "housing_temperature": state.housing_temperature,
        "shear_state": np.concatenate([v for _, v in sorted(shear.items())] or [np.zeros((len(state.qpos), 1))], -1),
    }


def record(model: Model, case: Case, commands: Commands, count: int) -> tuple[Samples, Telemetry, Noise]:
    """Drives the reference over one ground.

    Args:
      model: the model. case: the ground. commands: the drive. count: how many states to keep along it.

    Returns:
      Samples, telemetry of the reference, and telemetry of the reference perturbed by float32.
    """
    backend = NativeBackend(model.replace(terrain=case.terrain), rovers=2 + RUNS)
    chance = np.random.default_rng(0)
    state = backend.reset()
    state.qpos[1:] = _rounded(state.qpos[1:])
    backend.set_state(state)
    kept = np.unique(np.linspace(0, len(commands.values) - 1, count).astype(int))
    states: list[BackendState] = []
    seen: list[Observation] = []
    every = round(commands.interval / model.timestep)
    for k, control in enumerate(commands.values):
        if k in kept:
            states.append(backend.state())
        for i in range(every):
            backend.step(backend.controls(control))
            if i == 0:
                seen.append(backend.observe())
            state = backend.state()
            for held in (state.qpos, state.qvel):
                held[2:] = _rounded_by_chance(held[2:], chance)
            backend.set_state(state)
    both = telemetry(seen)
    joined = _join(states)
    probe = NativeBackend(model.replace(terrain=case.terrain), rovers=len(kept))
    stages, after = _evaluate(probe, joined, commands.values[kept])
    run, start, held = (jax.tree.map(lambda a, at=at: a[at], both) for at in (slice(1), slice(1, 2), slice(2, None)))
    return Samples(joined, commands.values[kept], stages, after), run, Noise(start, held)


def _rounded(qpos: np.ndarray) -> np.ndarray:
    """Coordinates as float32 holds them, moved by one more unit in the last place where they are exact."""
    single = qpos.astype(np.float32)
    return np.where(single == qpos, np.nextafter(single, np.float32(np.inf)), single).astype(float)


def _rounded_by_chance(values: np.ndarray, chance: np.random.Generator) -> np.ndarray:
    """Values as float32 holds them, moved by chance within `SPREAD` units in the last place."""
    unit = SPREAD * np.spacing(np.abs(values).astype(np.float32))
    return (values + unit * (chance.random(values.shape) - 0.5)).astype(np.float32).astype(float)


def _join(states: list[BackendState]) -> BackendState:
    """The first rover of several states as the rovers of one state."""

    def rows(get: Callable[[BackendState], np.ndarray]) -> np.ndarray:
        return np.stack([get(s)[0] for s in states])

    effects = {e: {k: rows(lambda s, e=e, k=k: s.effects[e][k]) for k in own} for e, own in states[0].effects.items()}
    return BackendState(0, rows(lambda s: s.qpos), rows(lambda s: s.qvel), rows(lambda s: s.winding_temperature),
                        rows(lambda s: s.housing_temperature), effects)  # fmt: skip


def compare(
    a: np.ndarray, b: np.ndarray, quantity: str, tolerance: Tolerance, model: Model, floor: np.ndarray | None = None
) -> tuple[float, float, str, float]:
    """Largest normalised error, largest difference, where, and the largest difference of the noise floor."""
    if quantity == "orientation":
        a, b = np.atleast_2d(a), np.atleast_2d(b)
        b = b * np.where(np.sum(a * b, -1, keepdims=True) < 0.0, -1.0, 1.0)
        difference, size = 2.0 * np.linalg.norm(a - b, axis=-1), 0.0
    else:
        difference, size = np.abs(a - b), np.abs(a)
    allowed = tolerance.absolute + tolerance.relative * size + np.zeros_like(difference)
    if floor is not None:
        allowed = allowed + FLOOR_FACTOR * floor
    error = np.where(np.isfinite(difference), difference / allowed, np.inf)
    at = np.unravel_index(int(np.argmax(error)), error.shape)
    return float(error[at]), float(difference[at]), _where(model, quantity, a.shape, at), float(np.max(size))


def _where(model: Model, quantity: str, shape: tuple[int, ...], at: Any) -> str:
    """The wheel or joint of an entry."""
    rover = model.rover
    if len(at) < 2:
        return ""
    axes = "xyz"
    if quantity.startswith("wheel_"):
        return f"{rover.wheels[at[1]].corner} {axes[at[2]]}"
    if quantity in ("sinkage", "slip", "slip_angle"):
        return rover.wheels[at[1]].corner
    if shape[1] == len(rover.joints):
        return rover.joints[at[1]]
    return f"{at[1]}"


def judge(
    case: Case, samples: Samples, other: tuple[Observation, Observation], tolerance: dict[str, Tolerance], model: Model
) -> list[Result]:
    """Levels 1 and 2: another engine's stages and steps against the reference's, from the same states."""
    out = []
    stages = [(1, stage, q, samples.stages, other[0]) for stage, names in STAGES.items() for q in names]
    steps = [(2, "step", q, samples.after, other[1]) for q in STEP_QUANTITIES]
    for level, stage, quantity, a, b in stages + steps:
        error, difference, where, size = compare(a[quantity], b[quantity], quantity, tolerance[quantity], model)
        out.append(Result(case.name, level, stage, quantity, error, difference, size, where))
    return out


def judge_drive(
    case: Case, reference: Telemetry, noise: Telemetry, other: Telemetry, tolerance: dict[str, Tolerance], model: Model
) -> list[Result]:
    """Level 3: an open-loop drive against the reference's, with the drive or drives that give the noise floor."""
    a, b = traces(reference), traces(other)
    perturbed = [traces(noise, i) for i in range(len(noise.time))]
    out = []
    for quantity in DRIVE_QUANTITIES:
        apart = np.max([gap(a[quantity], n[quantity], quantity) for n in perturbed], axis=0)
        # what has been perturbed stays perturbed, where it is an integral of the motion
        floor = _around(apart) if quantity in MOMENTARY else np.maximum.accumulate(apart, axis=0)
        error, difference, where, size = compare(a[quantity], b[quantity], quantity, tolerance[quantity], model, floor)
        out.append(Result(case.name, 3, "drive", quantity, error, difference, size, where, float(np.max(apart))))
    return out


def _around(apart: np.ndarray) -> np.ndarray:
    """The largest value within `MOMENT` samples of each time (first axis)."""
    padded = np.pad(apart, [(MOMENT, MOMENT)] + [(0, 0)] * (apart.ndim - 1))
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * MOMENT + 1, axis=0).max(axis=-1)


def gap(a: np.ndarray, b: np.ndarray, quantity: str) -> np.ndarray:
    """|a - b|, or the angle between two orientations."""
    if quantity != "orientation":
        return np.abs(a - b)
    return 2.0 * np.linalg.norm(a - b * np.where(np.sum(a * b, -1, keepdims=True) < 0.0, -1.0, 1.0), axis=-1)


def traces(seen: Telemetry, rover: int = 0) -> Observation:
    """One rover's telemetry as arrays with a leading time axis."""
    values = observation(seen)
    out = {k: v[rover].astype(float) for k, v in values.items()}
    return {**out, "orientation": out["quaternion"]}


def tolerances(kind: str, drive: bool = False) -> dict[str, Tolerance]:
    """Tolerance of every quantity: relative, and absolute in proportion to the quantity's typical size.

    Args:
      kind: key of `RELATIVE`. drive: whether whole drives are compared, which gather ten times as much.
    """
    grown = 10.0 if drive else 1.0
    out = {}
    for quantity, (_, size) in QUANTITIES.items():
        relative = grown * EXCEPTIONS.get(kind, {}).get(quantity, RELATIVE[kind])
        absolute = grown * ABSOLUTE.get(kind, {}).get(quantity, 0.0)
        out[quantity] = Tolerance(max(relative * size, absolute), relative)
    return out


def first_failure(results: Iterable[Result]) -> Result | None:
    """The first stage of level 1 that failed, in the order of the step: where the engines part."""
    order = {stage: i for i, stage in enumerate(STAGES)}
    failed = [r for r in results if r.level == 1 and not r.passed]
    return min(failed, key=lambda r: (order[r.stage], -r.error), default=None)
