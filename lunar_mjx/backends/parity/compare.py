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

from lunar_mjx.backends.base import STAGES, Backend, BackendState, Observation, observation
from lunar_mjx.backends.hooks import Hook
from lunar_mjx.backends.jax_backend import JaxBackend
from lunar_mjx.backends.native import NativeBackend
from lunar_mjx.backends.parity.cases import (
    DRIVE_EXCEPTIONS,
    EXCEPTIONS,
    QUANTITIES,
    RELATIVE,
    SOFT_LOOP,
    SOFT_STEP,
    Case,
    Tolerance,
)
from lunar_mjx.backends.parity.record import Samples, evaluate
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands
from lunar_mjx.terrain import Terrain, stack

STEP_QUANTITIES = (
    "position",
    "orientation",
    "joint_angle",
    "velocity",
    "joint_speed",
    "winding_temperature",
    "housing_temperature",
    "shear_state",
)
"""What level 2 compares after one step."""

DRIVE_QUANTITIES = (
    "position",
    "orientation",
    "joint_angle",
    "sinkage",
    "slip",
    "joint_torque",
    "winding_temperature",
    "housing_temperature",
)
"""What level 3 compares along a drive."""


@dataclasses.dataclass(frozen=True)
class ParityWindow:
    """How drives of two engines are compared."""

    floor_factor: float = 10.0
    """A drive may depart from the reference by its tolerance and this many times the noise floor."""
    moment: int = 10
    """Half the width of the window in which a moment is sought, in samples of a drive (0.5 s)."""


PARITY_WINDOW = ParityWindow()


MOMENTARY = ("sinkage", "slip", "joint_torque")
"""Quantities that are not integrals of the motion: their noise floor counts around its time, not ever after."""


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
        """Whether the worst error keeps its tolerance."""
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
            # The rovers that only fill the width are dropped.
            out += [jax.tree.map(lambda a, i=i: a[i : i + 1], seen) for i in range(len(part))]
        return out

    def close(self) -> None:
        """Frees the compiled program."""
        self._backend = None
        # The jitted function alone does not free it: JAX keeps compiled programs in a cache of its own.
        jax.clear_caches()


def native_runner(model: Model, hooks: Iterable[Hook] = (), name: str = "native") -> Runner:
    """The reference, or with hooks a reference with planted faults."""
    return Runner(name, lambda m, n: NativeBackend(m, hooks, n), model)


def _filled(items: list[Any], width: int) -> list[Any]:
    """The items, and the last of them again up to `width`."""
    # Another number of rovers would be another program: compiling takes far longer than to drive a few in vain.
    return items + [items[-1]] * (width - len(items))


def _in_parts(backend: Backend, samples: Samples, rovers: int) -> tuple[Observation, Observation]:
    """`_evaluate` of all samples, `rovers` at once."""
    seen: list[Observation] = []
    after: list[Observation] = []
    for start in range(0, len(samples.control), rovers):
        at = list(range(start, min(start + rovers, len(samples.control))))
        state, control = _rows(samples, np.array(_filled(at, rovers)))
        for pieces, piece in zip((seen, after), evaluate(backend, state, control), strict=True):
            pieces.append({k: v[: len(at)] for k, v in piece.items()})
    return _joined(seen), _joined(after)


def _joined(pieces: list[Observation]) -> Observation:
    return {k: np.concatenate([p[k] for p in pieces]) for k in pieces[0]}


def _rows(samples: Samples, at: np.ndarray) -> tuple[BackendState, np.ndarray]:
    s = samples.state
    effects = {e: {k: v[at] for k, v in own.items()} for e, own in s.effects.items()}
    state = BackendState(s.step, s.qpos[at], s.qvel[at], s.winding_temperature[at], s.housing_temperature[at], effects)
    return state, samples.control[at]


def compare(
    a: np.ndarray, b: np.ndarray, quantity: str, tolerance: Tolerance, model: Model, floor: np.ndarray | None = None
) -> tuple[float, float, str, float]:
    """Largest normalised error, largest difference, where, and the largest difference of the noise floor."""
    if quantity == "orientation":
        a, b = np.atleast_2d(a), np.atleast_2d(b)
        # q and -q are one orientation; half the angle between two is |a - b| as long as it is small.
        b = b * np.where(np.sum(a * b, -1, keepdims=True) < 0.0, -1.0, 1.0)
        difference, size = 2.0 * np.linalg.norm(a - b, axis=-1), 0.0
    else:
        difference, size = gap(a, b, quantity), np.abs(a)
    allowed = tolerance.absolute + tolerance.relative * size + np.zeros_like(difference)
    if floor is not None:
        allowed = allowed + PARITY_WINDOW.floor_factor * floor
    # NaN would lose against every number in a search for the largest; as infinity it wins.
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
    case: Case,
    samples: Samples,
    other: tuple[Observation, Observation],
    tolerance: dict[str, Tolerance],
    model: Model,
    soft_loop: bool = False,
) -> list[Result]:
    """Levels 1 and 2: another engine's stages and steps against the reference's, from the same states.

    With `soft_loop`, where only one of the two engines can hold loops open, from the states whose loops are closed.
    """
    out = []
    rows = samples.closed if soft_loop else slice(None)
    stages = [(1, stage, q, samples.stages, other[0]) for stage, names in STAGES.items() for q in names]
    steps = [(2, "step", q, samples.after, other[1]) for q in STEP_QUANTITIES]
    for level, stage, quantity, a, b in stages + steps:
        error, difference, worst_place, size = compare(
            a[quantity][rows], b[quantity][rows], quantity, tolerance[quantity], model
        )
        out.append(Result(case.name, level, stage, quantity, error, difference, size, worst_place))
    return out


def judge_drive(
    case: Case, reference: Telemetry, noise: Telemetry, other: Telemetry, tolerance: dict[str, Tolerance], model: Model
) -> list[Result]:
    """Level 3: an open-loop drive against another's; the first drive of `noise` is that whose perturbations follow."""
    a, b = traces(reference), traces(other)
    exact, *perturbed = (traces(noise, i) for i in range(len(noise.time)))
    out = []
    for quantity in DRIVE_QUANTITIES:
        # The farthest of all: how a contact falls is chance, and few drives show too little of it.
        apart = np.max([gap(exact[quantity], n[quantity], quantity) for n in perturbed], axis=0)
        # what has been perturbed stays perturbed, where it is an integral of the motion
        floor = _around(apart) if quantity in MOMENTARY else np.maximum.accumulate(apart, axis=0)
        error, difference, worst_place, size = compare(
            a[quantity], b[quantity], quantity, tolerance[quantity], model, floor
        )
        out.append(Result(case.name, 3, "drive", quantity, error, difference, size, worst_place, float(np.max(apart))))
    return out


def _around(apart: np.ndarray) -> np.ndarray:
    """The largest value within `PARITY_WINDOW.moment` samples of each time (first axis)."""
    padded = np.pad(apart, [(PARITY_WINDOW.moment, PARITY_WINDOW.moment)] + [(0, 0)] * (apart.ndim - 1))
    return np.lib.stride_tricks.sliding_window_view(padded, 2 * PARITY_WINDOW.moment + 1, axis=0).max(axis=-1)


def gap(a: np.ndarray, b: np.ndarray, quantity: str) -> np.ndarray:
    """|a - b|, or the angle between two orientations; a slip of 2 and one of -2 are the same.

    Where rim and travel are opposite and equally fast, which of them is the faster only decides the sign.
    """
    if quantity == "slip":
        apart = np.abs(a - b)
        return np.minimum(apart, np.abs(4.0 - apart))
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
      kind: keys of `RELATIVE`, comma-separated: the loosest counts. drive: whether whole drives are compared, which
        gather ten times as much.
    """
    grown = 10.0 if drive else 1.0
    out = {}
    for quantity, (_, size) in QUANTITIES.items():
        relative = grown * DRIVE_EXCEPTIONS.get(kind, {}).get(quantity, 0.0) if drive else 0.0
        for k in kind.split(", "):
            usual = RELATIVE[k] if drive or k != SOFT_LOOP else SOFT_STEP.get(quantity, 0.0)
            relative = max(relative, grown * EXCEPTIONS.get(k, {}).get(quantity, usual))
        out[quantity] = Tolerance(relative * size, relative)
    return out


def first_failure(results: Iterable[Result]) -> Result | None:
    """The first stage of level 1 that failed, in the order of the step: where the engines part."""
    order = {stage: i for i, stage in enumerate(STAGES)}
    failed = [r for r in results if r.level == 1 and not r.passed]
    # Later stages inherit an earlier one's error, so the first in the order of the step is the cause.
    return min(failed, key=lambda r: (order[r.stage], -r.error), default=None)
