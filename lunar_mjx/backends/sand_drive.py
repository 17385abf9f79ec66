"""A drive of a rover through particle sand: set down, settled, and driven by commands."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from lunar_mjx.backends.base import Observation, telemetry, whole_steps
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


def drive(
    model: Model,
    moves: Commands,
    start: tuple[float, float, float],
    sand: Sand,
    numerics: Numerics,
    device: str,
    going_on: Callable[[float], bool] = lambda share: True,
    make_bed: Callable[..., Any] = moving_bed,
) -> SandDrive | None:
    """Drives a rover through particle sand.

    Args:
      model: its rover, motors, gravity and a plane as terrain; its soil has no say.
      moves: commands after the rover stands.
      start: x, y in m and yaw in rad.
      sand, numerics: of the bed; step_share is the share of a voxel that the rims move in a step.
      device: by Warp's name.
      going_on: called after each step of the bed with the share that is done; False ends the drive.
      make_bed: what makes the bed.

    Returns:
      The drive, as far as it came; None where it ended before the rover stood.

    Raises:
      UserError: the terrain is no plane, or the model has an effect that NumPy's physics lacks.
      FloatingPointError: the rover's place is no longer finite.
    """
    begun = time.perf_counter()
    backend = RoverInSand(model, bed_substeps(model, moves, numerics))
    plane = plane_of(model.terrain, start[0], start[1])
    # Contact at nodes of the grid acts from a quarter of a voxel outside a wheel.
    backend.place_above(plane, *start, 0.25 * numerics.voxel if numerics.contact == "S2" else 0.0)
    yields = backend.mobility()
    down = plane.into(np.array([0.0, 0.0, -model.gravity]))
    bed = backend.bed = make_bed(model, sand, down, numerics, backend.bed_step, yields, device)
    set_up = time.perf_counter() - begun

    radius = max(w.radius for w in model.rover.wheels)
    settle = math.ceil(numerics.settle * math.sqrt(radius / model.gravity) / backend.bed_step)
    per_command = whole_steps(moves, model.timestep)
    keep = _kept_steps(per_command, model.timestep)
    steps = len(moves.values) * per_command
    rounds = settle + math.ceil(steps / backend.substeps)
    balance = Balance(np.zeros(3), np.zeros(3), np.zeros(3))
    rows: list[Observation] = []
    standing: list[Observation] = []
    still = np.zeros((backend.substeps, moves.values.shape[1]))
    done, driven = 0, 0
    for done in range(1, rounds + 1):
        before = (done - 1 - settle) * backend.substeps
        if done <= settle:
            # Set down slowly over the first half: sand stays as deep as it was ever pressed.
            borne = max(0.0, 1.0 - 2.0 * done / settle)
            controls = still
        else:
            borne = 0.0
            which = np.minimum((before + np.arange(backend.substeps)) // per_command, len(moves.values) - 1)
            controls = moves.values[which]

        def seen(k: int, saw: Observation, before: int = before) -> None:
            if before < 0 and k == 0:
                standing.append(saw)
            if 0 <= before + k < steps and (before + k) % keep == 0:
                rows.append(saw)

        backend.advance(controls, yields, borne, balance, seen)
        driven = max(0, before + backend.substeps)
        if not going_on(done / rounds):
            break
    if not rows:
        return None
    seconds = time.perf_counter() - begun
    times = telemetry(rows)
    times = dataclasses.replace(times, time=times.time - settle * backend.bed_step)
    fine = np.repeat(moves.values, per_command // keep, axis=0)[: len(rows)]
    facts = {
        "particles": getattr(bed, "particles", 0),
        "bed_step_s": backend.bed_step,
        "settle_s": settle * backend.bed_step,
        "yields_per_kg_and_per_kg_m2": list(yields),
        "weight_N": backend.weight,
        "standing": _standing(standing[-math.ceil(DRIVE_NUMBERS.standing * settle) :], backend),
        "momentum_error": np.abs(balance.error).max().item(),
        "disagreement_m_s": math.sqrt(balance.disagreement / max(balance.steps, 1)),
        "rover_seconds": done * backend.bed_step,
        "driven_s": min(driven, steps) * model.timestep,
        "seconds": seconds,
        "set_up_seconds": set_up,
        "seconds_per_rover_second": (seconds - set_up) / (done * backend.bed_step),
    }
    surface = bed.surface() if hasattr(bed, "surface") else np.zeros((0, 3))
    return SandDrive(times, Commands(fine, keep * model.timestep), surface, facts, driven >= steps)


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
