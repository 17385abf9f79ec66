"""A drive of a rover through particle sand: set down, settled, and driven by commands."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from lunar_mjx.backends.base import BackendState, Observation, telemetry, whole_steps
from lunar_mjx.backends.in_sand import Balance, Bed, RoverInSand, plane_of
from lunar_mjx.dynamics.state import Telemetry
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model
from lunar_mjx.simulate import Commands
from lunar_mjx.wheel_bed.particles.settings import BOX_SIZE, Numerics, ParticleWheel, Sand


@dataclasses.dataclass(frozen=True)
class DriveNumbers:
    """How a rover is coupled to its sand."""

    step: float = 0.06
    """Largest time step of the sand in sqrt(R/g): that of the test bed's wheel at eight voxels to its radius."""
    seen_every: float = 0.0101
    """Longest interval of what is kept, s: 100 Hz for an IMU at 50 Hz."""
    standing: float = 0.25
    """Last share of the time of settling over which the standing rover's forces are averaged."""


DRIVE_NUMBERS = DriveNumbers()


@dataclasses.dataclass(frozen=True)
class SandDrive:
    """What a rover did in particle sand.

    Attributes:
      seen: telemetry, leading axes (1, time), from when the rover stood.
      commands: that were held at its times.
      surface: middle x, y of every column of sand that was computed and its height, (n, 3), m, in the plane's frame.
      facts: settings, balance and cost, plain data.
      whole: whether all commands were driven.
    """

    seen: Telemetry
    commands: Commands
    surface: np.ndarray
    facts: dict[str, Any]
    whole: bool


def smooth_wheels(model: Model) -> tuple[ParticleWheel, ...]:
    """The rover's wheels as smooth cylinders."""
    return tuple(ParticleWheel(w.radius, w.width) for w in model.rover.wheels)


def require_shown(wheels: tuple[ParticleWheel, ...], voxel: float, fewest: float = BOX_SIZE.fewest_voxels) -> None:
    """Raises `UserError` for voxels that are too coarse to show a rover's wheels."""
    least = min(min(w.radius, w.width) for w in wheels)
    if voxel * fewest > least * (1.0 + 1e-9):
        raise bad_input(
            "particles",
            "--voxel",
            voxel,
            f"is too coarse for wheels whose radius or width is {least:g} m",
            f"give {least / fewest:.3g} m or less",
        )


def bed_substeps(model: Model, moves: Commands, numerics: Numerics) -> int:
    """Time steps of the model in one of the sand: the rims move by a share of a voxel, and forces hardly change."""
    drives = [model.rover.joints.index(w.drive) for w in model.rover.wheels]
    radius = max(w.radius for w in model.rover.wheels)
    longest = DRIVE_NUMBERS.step * math.sqrt(radius / model.gravity)
    if model.modes["drive"] == "velocity":
        rim = radius * float(np.abs(moves.values[:, drives]).max())
        longest = min(longest, numerics.step_share * numerics.voxel / max(rim, 1e-9))
    return max(1, int(longest / model.timestep + 1e-6))


def moving_bed(
    model: Model, sand: Sand, gravity: np.ndarray, numerics: Numerics, step: float, yields: Any, device: str
) -> Bed:
    """Particle sand for a model's wheels; see `MovingBed`."""
    from lunar_mjx.wheel_bed.particles.moving_bed import MovingBed

    return MovingBed(smooth_wheels(model), sand, gravity, numerics, step, yields, device)


class SandRun:
    """A drive of a rover through particle sand, which may be left and gone on with.

    Args:
      model: its rover, motors, gravity and a plane as terrain; its soil has no say.
      moves: commands after the rover stands.
      start: x, y in m and yaw in rad.
      sand, numerics: of the bed; step_share is the share of a voxel that the rims move in a step.
      device: by Warp's name.
      make_bed: what makes the bed.

    Raises:
      UserError: the terrain is no plane, or the model has an effect that NumPy's physics lacks.
    """

    def __init__(
        self,
        model: Model,
        moves: Commands,
        start: tuple[float, float, float],
        sand: Sand,
        numerics: Numerics,
        device: str,
        make_bed: Callable[..., Any] = moving_bed,
    ) -> None:
        begun = time.perf_counter()
        self.moves = moves
        backend = self.backend = RoverInSand(model, bed_substeps(model, moves, numerics))
        plane = plane_of(model.terrain, start[0], start[1])
        # Contact at nodes of the grid acts from a quarter of a voxel outside a wheel.
        backend.place_above(plane, *start, 0.25 * numerics.voxel if numerics.contact == "S2" else 0.0)
        self._yields = backend.mobility()
        down = plane.into(np.array([0.0, 0.0, -model.gravity]))
        self.bed: Any = make_bed(model, sand, down, numerics, backend.bed_step, self._yields, device)
        backend.bed = self.bed
        radius = max(w.radius for w in model.rover.wheels)
        self._settle = math.ceil(numerics.settle * math.sqrt(radius / model.gravity) / backend.bed_step)
        self._per_command = whole_steps(moves, model.timestep)
        self._keep = _kept_steps(self._per_command, model.timestep)
        self._steps = len(moves.values) * self._per_command
        self.rounds = self._settle + math.ceil(self._steps / backend.substeps)
        """Steps of the bed in all."""
        self.done = 0
        """Steps of the bed that are done."""
        self._balance = Balance(np.zeros(3), np.zeros(3), np.zeros(3))
        self._rows: list[Observation] = []
        self._standing: list[Observation] = []
        self._set_up, self._seconds = time.perf_counter() - begun, 0.0

    def run(self, going_on: Callable[[float], bool] = lambda share: True) -> None:
        """Drives on, until the end or until `going_on`, called with the share that is done, says False.

        Raises:
          FloatingPointError: the rover's place is no longer finite.
        """
        while self.done < self.rounds:
            begun = time.perf_counter()
            self._advance()
            self._seconds += time.perf_counter() - begun
            if not going_on(self.done / self.rounds):
                return

    def _advance(self) -> None:
        """One step of the bed."""
        substeps, values = self.backend.substeps, self.moves.values
        before = (self.done - self._settle) * substeps
        if before < 0:
            # Set down slowly over the first half: sand stays as deep as it was ever pressed.
            borne, controls = (
                max(0.0, 1.0 - 2.0 * (self.done + 1) / self._settle),
                np.zeros((substeps, values.shape[1])),
            )
        else:
            which = np.minimum((before + np.arange(substeps)) // self._per_command, len(values) - 1)
            borne, controls = 0.0, values[which]

        def seen(k: int, saw: Observation) -> None:
            if before < 0 and k == 0:
                self._standing.append(saw)
            if 0 <= before + k < self._steps and (before + k) % self._keep == 0:
                self._rows.append(saw)

        self.backend.advance(controls, self._yields, borne, self._balance, seen)
        self.done += 1

    def result(self) -> SandDrive | None:
        """The drive, as far as it came; None where the rover does not stand yet."""
        if not self._rows:
            return None
        backend, balance = self.backend, self._balance
        times = telemetry(self._rows)
        times = dataclasses.replace(times, time=times.time - self._settle * backend.bed_step)
        fine = np.repeat(self.moves.values, self._per_command // self._keep, axis=0)[: len(self._rows)]
        driven = min((self.done - self._settle) * backend.substeps, self._steps)
        rover_seconds = self.done * backend.bed_step
        facts = {
            "particles": self.bed.particles,
            "bed_step_s": backend.bed_step,
            "settle_s": self._settle * backend.bed_step,
            "yields_per_kg_and_per_kg_m2": list(self._yields),
            "weight_N": backend.weight,
            "standing": _standing(self._standing[-math.ceil(DRIVE_NUMBERS.standing * self._settle) :], backend),
            "momentum_error": np.abs(balance.error).max().item(),
            "disagreement_m_s": math.sqrt(balance.disagreement / max(balance.steps, 1)),
            "rover_seconds": rover_seconds,
            "driven_s": driven * backend.model.timestep,
            "seconds": self._seconds,
            "set_up_seconds": self._set_up,
            "seconds_per_rover_second": self._seconds / rover_seconds,
        }
        kept = Commands(fine, self._keep * backend.model.timestep)
        return SandDrive(times, kept, self.bed.surface(), facts, driven >= self._steps)

    def state(self) -> dict[str, np.ndarray]:
        """All that the drive needs to go on, as arrays by name."""
        engine, balance = self.backend.state(), self._balance
        out = {f"bed/{k}": v for k, v in self.bed.state().items()}
        out |= {f"engine/{k}": np.asarray(getattr(engine, k)) for k in _ENGINE}
        out |= {f"effects/{e}/{k}": v for e, own in engine.effects.items() for k, v in own.items()}
        out |= {f"balance/{k}": np.asarray(v) for k, v in dataclasses.asdict(balance).items()}
        for name, rows in (("rows", self._rows), ("standing", self._standing)):
            out |= {f"{name}/{k}": np.stack([r[k] for r in rows]) for k in (rows[0] if rows else ())}
        wheels = self.backend.wheel_forces()
        return {**out, "wheels": wheels, "done": np.array(self.done), "seconds": np.array(self._seconds)}

    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        """Goes back to where `state` was taken; the sand's solver begins anew from there."""
        own: dict[str, dict[str, np.ndarray]] = {}
        for name, value in state.items():
            part, _, rest = name.partition("/")
            own.setdefault(part, {})[rest] = value
        effects: dict[str, dict[str, np.ndarray]] = {}
        for name, value in own.get("effects", {}).items():
            effects.setdefault(name.split("/")[0], {})[name.split("/")[1]] = value
        engine: dict[str, Any] = {k: own["engine"][k] for k in _ENGINE}
        engine["step"] = int(engine["step"])
        self.backend.set_state(BackendState(**engine, effects=effects))
        self.backend.set_wheel_forces(state["wheels"])
        self.bed.restore(own.get("bed", {}))
        balance: dict[str, Any] = {k: v if v.ndim else v.item() for k, v in own["balance"].items()}
        self._balance = Balance(**balance)
        for name in ("rows", "standing"):
            held = own.get(name, {})
            count = len(next(iter(held.values()))) if held else 0
            setattr(self, f"_{name}", [{k: v[i] for k, v in held.items()} for i in range(count)])
        self.done, self._seconds = int(state["done"]), float(state["seconds"])


_ENGINE = ("step", "qpos", "qvel", "winding_temperature", "housing_temperature")
"""Fields of `BackendState` that are arrays; no hook of a rover in sand has a state."""


def _kept_steps(per_command: int, timestep: float) -> int:
    """Time steps from one kept observation to the next: the longest interval that is fine enough, or one step."""
    fits = [n for n in range(1, per_command + 1) if per_command % n == 0 and n * timestep <= DRIVE_NUMBERS.seen_every]
    return max(fits, default=1)


def _standing(seen: list[Observation], backend: RoverInSand) -> dict[str, Any]:
    """Force on all wheels over the weight, and sinkage of each wheel, m, of the rover before it drives."""
    if not seen:
        return {}
    force = np.mean([s["wheel_force"][0] for s in seen], axis=0)
    corners = [w.corner for w in backend.model.rover.wheels]
    sinkage = np.mean([s["sinkage"][0] for s in seen], axis=0)
    cosine = float(backend.plane.axes[2, 2])
    return {
        "force_over_weight": float(force[:, 2].sum() / (backend.weight * cosine)),
        "normal_force_N": dict(zip(corners, force[:, 2].tolist(), strict=True)),
        "sinkage_m": dict(zip(corners, sinkage.tolist(), strict=True)),
    }
