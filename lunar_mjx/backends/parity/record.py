"""What the engines are held against: states along the reference's drive, and how far errors carry that drive."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import numpy as np

from lunar_mjx.backends.base import Backend, BackendState, Observation, telemetry
from lunar_mjx.backends.native import NativeBackend, close_loops
from lunar_mjx.backends.parity.cases import Case
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands


@dataclasses.dataclass(frozen=True)
class Recording:
    """What a record of parity holds."""

    # Drives of the reference with errors of float64 and of float32 drawn anew. A rover that stands on rock chatters,
    # and may come to rest in more than one place: 2 of 16 drives of VIPER with errors of float32 ended 5e-5 m from
    # the reference and the others within 5e-6 m (slope of rock), which four did not show.
    runs_double: int = 4
    runs_single: int = 16
    spread: float = 4.0
    """Width of roundings in units of the last place. A float32 engine's sinkage on uneven ground is off by 4e-8 m (root
    mean square, measured at level 1): rounding alone would make it 1e-8 m, but heights and wheels are sums."""
    compliance: tuple[float, ...] = (0.1, 0.5, 1.5, 2.0)
    """Compliance of the loops in drives of the reference, over its own: how far it matters that they give way at all.
    The reference's impedance is 0.999. From closed loops an acceleration differs from that of a rigid loop in
    proportion to the compliance: by 4.5, 0.45 and 0.046 rad/s2 at an impedance of 0.99, 0.999 and 0.9999 (VIPER, slope
    of rock)."""


RECORDING = Recording()


@dataclasses.dataclass
class Samples:
    """States along the reference's drive on one ground, the control of each, and what followed.

    Attributes:
      closed: which of the states have no open loop. MuJoCo's constraint leaves loops open by a micrometre, which an
        engine that closes them exactly cannot represent: it would be asked about another state. With loops every
        state is here twice, as it was recorded and closed.
    """

    state: BackendState
    control: np.ndarray
    stages: Observation
    after: Observation
    closed: np.ndarray


@dataclasses.dataclass
class Noise:
    """The reference's drive under errors that an engine may make, each with leading axes (rover, time).

    Attributes:
      exact: the drive itself, one rover.
      double: started from coordinates that are rounded to float32 and left alone; and drives with coordinates
        and speeds moved by float64's errors after every step. With the preset paper a standing rover chatters, which
        carries those 3e-6 m far in half a second, farther than the rounding at the start.
      single: moved by float32's errors after every step, as in an engine that holds coordinates so.
      soft: with loops of another compliance, and with dampers within the loops; none where the rover has no loop.
    """

    exact: Telemetry
    double: Telemetry
    single: Telemetry
    soft: Telemetry

    def floor(self, single: bool, soft_loop: bool) -> Telemetry:
        """The drive itself and then the perturbed ones that two engines are held against, (rover, time).

        Args:
          single: whether one of them holds numbers in float32. soft_loop: whether one of them alone has soft loops.
        """
        parts = [self.exact, self.double] + [self.single] * single + [self.soft] * soft_loop
        return jax.tree.map(lambda *a: np.concatenate(a), *parts)


def record(model: Model, case: Case, commands: Commands, count: int) -> tuple[Samples, Telemetry, Noise]:
    """Drives the reference over one ground.

    Args:
      model: the model. case: the ground. commands: the drive. count: how many states to keep along it. The state at
        reset is not among them: its wheels touch the ground to rounding, where the printed force grows as the root of
        the sinkage (3e-17 m are 6e-7 N).

    Returns:
      Samples, telemetry of the reference, and telemetry of the reference under an engine's errors.
    """
    groups = np.cumsum(
        [1, 1, RECORDING.runs_double, RECORDING.runs_single, len(RECORDING.compliance) if model.rover.loops else 0]
    )
    backend = NativeBackend(model.replace(terrain=case.terrain), rovers=groups[-1])
    exact, start, double, single, soft = (slice(a, b) for a, b in zip([0, *groups], groups, strict=False))
    for rover, share in zip(range(groups[-1])[soft], RECORDING.compliance, strict=False):
        backend.soften_loops(rover, share)
    # One seed, so that a parity page can be made again.
    chance = np.random.default_rng(0)
    state = backend.reset()
    for part in (start, single):
        state.qpos[part] = _rounded(state.qpos[part])
    backend.set_state(state)
    kept = np.unique(np.linspace(min(1, len(commands.values) - 1), len(commands.values) - 1, count).astype(int))
    states: list[BackendState] = []
    seen: list[Observation] = []
    steps_per_command = round(commands.interval / model.timestep)
    for k, control in enumerate(commands.values):
        if k in kept:
            states.append(backend.state())
        for i in range(steps_per_command):
            backend.step(backend.controls(control))
            if i == 0:
                seen.append(backend.observe())
            state = backend.state()
            for held in (state.qpos, state.qvel):
                held[double] = _rounded_by_chance(held[double], chance, np.float64)
                held[single] = _rounded_by_chance(held[single], chance, np.float32)
            backend.set_state(state)
    together = telemetry(seen)
    run, *noise = (
        jax.tree.map(lambda a, at=at: a[at], together) for at in (exact, slice(start.start, double.stop), single, soft)
    )
    if model.rover.loops:
        # Damping within the loops is a property of the whole backend, so this drive runs by itself.
        within = NativeBackend(model.replace(terrain=case.terrain), damped_within=True).run(commands)
        noise[-1] = jax.tree.map(lambda *a: np.concatenate(a), noise[-1], within)
    return _samples(model, case, states, commands.values[kept]), run, Noise(run, *noise)


def _samples(model: Model, case: Case, states: list[BackendState], control: np.ndarray) -> Samples:
    """The first rover of the states with its loops as they are and closed, and what the reference makes of them."""
    recorded = len(states)
    if model.rover.loops:
        closed = [close_loops(model, s.qpos[:1], s.qvel[:1]) for s in states]
        states = states + [dataclasses.replace(s, qpos=q, qvel=v) for s, (q, v) in zip(states, closed, strict=True)]
    # The moments become rovers of one batch: one step judges them all.
    joined = _join(states)
    control = np.resize(control, (len(states), *control.shape[1:]))
    probe = NativeBackend(model.replace(terrain=case.terrain), rovers=len(states))
    stages, after = evaluate(probe, joined, control)
    return Samples(joined, control, stages, after, np.arange(len(states)) >= len(states) - recorded)


def evaluate(backend: Backend, state: BackendState, control: np.ndarray) -> tuple[Observation, Observation]:
    """What a step from a state saw, and the state after it as the quantities of level 2."""
    backend.set_state(state)
    backend.step(control)
    seen, new = backend.observe(), backend.state()
    # By difference, since not every engine tells its accelerations, and this is what moved the rover.
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


def _rounded(qpos: np.ndarray) -> np.ndarray:
    """Coordinates as float32 holds them, moved by one more unit in the last place where they are exact."""
    single = qpos.astype(np.float32)
    # Zeros and halves survive float32 unharmed, and would show a rover without any error.
    return np.where(single == qpos, np.nextafter(single, np.float32(np.inf)), single).astype(float)


def _rounded_by_chance(values: np.ndarray, chance: np.random.Generator, precision: type) -> np.ndarray:
    """Values as a precision holds them, moved by chance within `RECORDING.spread` units in the last place."""
    # Spacing, not a fixed step: an error of rounding grows with the number's size.
    unit = RECORDING.spread * np.spacing(np.abs(values).astype(precision))
    return (values + unit * (chance.random(values.shape) - 0.5)).astype(precision).astype(float)


def _join(states: list[BackendState]) -> BackendState:
    """The first rover of several states as the rovers of one state."""

    def rows(get: Callable[[BackendState], np.ndarray]) -> np.ndarray:
        return np.stack([get(s)[0] for s in states])

    effects = {e: {k: rows(lambda s, e=e, k=k: s.effects[e][k]) for k in own} for e, own in states[0].effects.items()}
    return BackendState(
        0,
        rows(lambda s: s.qpos),
        rows(lambda s: s.qvel),
        rows(lambda s: s.winding_temperature),
        rows(lambda s: s.housing_temperature),
        effects,
    )
