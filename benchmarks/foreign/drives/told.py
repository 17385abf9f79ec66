"""How far who is told a foreign world's own law can tell what is hidden in drives (`benchmarks.foreign told`)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from scipy import linalg

from ..wheel import World
from .cases import SECONDS, Campaign, channels, quantity
from .rollout import Ground, Setup, simulate

BASE = {
    "linear": ("reece_phi", "friction_angle", "shear_x"),
    "integral": ("reece_phi", "friction_angle", "shear_x"),
    "granular": ("grain_stiffness", "rim_friction"),
}
"""Constants of a law's soil that are refitted without the effect."""
CONSTANT = 0.3
"""1; prior standard deviation of a constant of the soil, and of its damping, as a share."""
MOTOR = {"constant": 0.03, "resistance": 0.05, "efficiency": 0.03, "loss": 0.05}
"""1; what a motor is off its datasheet by."""
MASS, INERTIA, CENTRE = 0.015, 0.15, 0.008
"""1; what a rover's mass and each moment of inertia are off by, as shares, and its centre of mass, over half of a
base."""
MISFIT = 0.05
"""1; what a law's stresses are off by."""
IMU = {"gyro": 5e-4, "accelerometer": 0.008, "tilt": np.radians(0.3)}
"""rad/s, m/s2, rad; errors of an IMU."""
STEP = 0.1
"""1; step of a derivative, over the prior's standard deviation."""


def without(case: Campaign) -> tuple[World, list[Setup]]:
    """The world and the setups of a campaign without what is hidden."""
    plain = []
    for s in case.setups:
        build = dataclasses.replace(s.build, payload=0.0, rotor_share=1.0)
        if e := case.amounts.get("com_offset"):
            build = dataclasses.replace(build, com=(build.com[0] - e["x"], build.com[1] - e["y"], build.com[2]))
        plain.append(dataclasses.replace(s, build=build))
    return dataclasses.replace(case.world, effects={}), plain


def whitened(case: Campaign, found: Mapping[str, np.ndarray], sensors: bool) -> np.ndarray:
    """(drives, readings) of rollouts without noise, in sigma; `sensors`: as sensors with what is hidden in them read.

    Neighbouring samples of one memory count for less.
    """
    less = np.sqrt((1.0 - case.memory) / (1.0 + case.memory))
    parts = []
    for table in channels(case, found, sensors).values():
        for channel, values in table.items():
            parts.append(values / case.std[quantity(channel)] * less)
    return np.concatenate(parts, axis=1)


def make(case: Campaign) -> tuple[dict[str, np.ndarray], dict[str, dict[str, float]]]:
    """The drives of a campaign, and the sigma by which who is told the law separates what is hidden."""
    truth = simulate(case.rover, case.world, case.setups, SECONDS)
    return truth, {case.hidden[0]: {"sigma": separable(case, truth)}} if case.hidden else {}


def separable(case: Campaign, truth: Mapping[str, np.ndarray]) -> float:
    """Length in sigma of what a hidden effect does beside small changes of base constants (soil, motor, mass).

    To first order; who is told knows all else: misfit, ground, IMU.

    Args:
      case: campaign with something hidden. truth: its rollouts.
    """
    world, plain = without(case)
    step, variants = 0.02, [plain]
    for key in BASE[case.world.law]:
        variants.append([dataclasses.replace(s, soil={key: 1.0 + step}) for s in plain])
    variants.append([_motor(s, "constant", step) for s in plain])
    variants.append([_built(s, mass=s.build.mass + step) for s in plain])
    found = [whitened(case, there, False) for there in _rollouts(case, world, variants)]
    columns = np.stack([((v - found[0]) / step).ravel() for v in found[1:]], axis=1)
    return _left(0.3 * columns, (whitened(case, truth, True) - found[0]).ravel())


def separable_blind(case: Campaign, truth: Mapping[str, np.ndarray], seconds: float = SECONDS) -> dict[str, float]:
    """Length in sigma of what a hidden effect does beside all that is uncertain without it; by what else were known.

    To first order about the world without the effect. Uncertain are constants of soil and motors, mass, inertia and
    centre of mass, amplitudes of the ground's waves and of those by which the law's stresses are off, and the IMU's
    errors, each of about the size with which campaigns draw it. Lengths and headings of these waves are known, so that
    this is more than anybody sees who is given the law's form only.

    Args:
      case: campaign with something hidden. truth: its rollouts. seconds: length of these.

    Returns:
      By what is known beside priors: "" for nothing, "all", and each kind of what is uncertain.
    """
    world, plain = without(case)
    priors = [float(np.sqrt(0.5 * np.mean(s.ground.sizes**2))) for s in plain]
    common = _common(case, plain)
    waves = [(k, phase) for k in range(len(plain[0].ground.sizes)) for phase in (0.0, 0.5 * np.pi)]
    ground = [
        [_with_wave(s, k, STEP * prior, phase) for s, prior in zip(plain, priors, strict=True)] for k, phase in waves
    ]
    # every rollout has as many waves as the others
    flat = [[_with_wave(s, 0, 0.0, 0.0) for s in setups] for setups in (plain, *(v for _, v in common))]
    every = _rollouts(case, world, [*flat, *ground], seconds)
    base = whitened(case, every[0], False)
    changes = [(whitened(case, there, False) - base) / STEP for there in every[1:]]
    kinds = [kind for kind, _ in common]
    columns = [c.ravel() for c in changes[: len(common)]]
    for change in changes[len(common) :]:
        for drive in range(len(plain)):
            alone = np.zeros_like(change)
            alone[drive] = change[drive]
            kinds.append("ground")
            columns.append(alone.ravel())
    for part, prior in IMU.items():
        for axis in range(len(case.imu[part])):
            moved = np.array(case.imu[part], float)
            moved[axis] += STEP * prior
            other = dataclasses.replace(case, imu={**case.imu, part: moved})
            kinds.append("imu")
            columns.append(((whitened(other, every[0], False) - base) / STEP).ravel())
    system, which = np.stack(columns, axis=1), np.array(kinds)
    difference = (whitened(case, truth, True) - base).ravel()
    known = {kind: _left(system[:, which != kind], difference) for kind in dict.fromkeys(kinds)}
    return {"": _left(system, difference), "all": float(np.linalg.norm(difference)), **known}


def _common(case: Campaign, plain: list[Setup]) -> list[tuple[str, list[Setup]]]:
    """What is uncertain in all drives alike, by kind, a step of each."""
    factor, found = 1.0 + STEP * CONSTANT, []
    for key in case.world.soil:
        if key != "unit_weight":
            found.append(("soil", [dataclasses.replace(s, soil={key: factor}) for s in plain]))
    found.append(("soil", [dataclasses.replace(s, damping=s.damping * factor) for s in plain]))
    for key, prior in MOTOR.items():
        found.append(("motor", [_motor(s, key, STEP * prior) for s in plain]))
    found.append(("build", [_built(s, mass=s.build.mass + STEP * MASS) for s in plain]))
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        inertia = [tuple(np.array(s.build.inertia) + INERTIA * step) for s in plain]
        found.append(("build", [_built(s, inertia=i) for s, i in zip(plain, inertia, strict=True)]))
        com = [tuple(np.array(s.build.com) + CENTRE * case.rover.half_base * step) for s in plain]
        found.append(("build", [_built(s, com=c) for s, c in zip(plain, com, strict=True)]))
    for n, field in enumerate(case.world.fields or ()):
        count = len(field.weights)
        for unit in STEP * MISFIT / np.sqrt(0.5 * count) * np.eye(count):
            found.append(("misfit", [dataclasses.replace(s, misfit={n: unit}) for s in plain]))
    return found


def _motor(setup: Setup, key: str, step: float) -> Setup:
    motors = setup.motors
    return dataclasses.replace(setup, motors=dataclasses.replace(motors, **{key: getattr(motors, key) + step}))


def _built(setup: Setup, **parts: object) -> Setup:
    return dataclasses.replace(setup, build=dataclasses.replace(setup.build, **parts))  # type: ignore[arg-type]


def _with_wave(setup: Setup, number: int, size: float, phase: float) -> Setup:
    """A setup whose ground has another wave of the length and direction of one that it has."""
    g = setup.ground
    waves = np.concatenate([g.waves, g.waves[number : number + 1]])
    ground = Ground(g.slope, waves, np.append(g.sizes, size), np.append(g.phases, g.phases[number] + phase))
    return dataclasses.replace(setup, ground=ground)


def _rollouts(
    case: Campaign, world: World, variants: list[list[Setup]], seconds: float = SECONDS
) -> list[dict[str, np.ndarray]]:
    """Rollouts of each of several lists of setups."""
    every = simulate(case.rover, world, [s for v in variants for s in v], seconds)
    count = len(case.setups)
    return [{k: v[i * count : (i + 1) * count] for k, v in every.items()} for i in range(len(variants))]


def _left(columns: np.ndarray, difference: np.ndarray) -> float:
    """Length of a difference in sigma beside columns (n, k) of unit prior."""
    inner = np.eye(columns.shape[1]) + columns.T @ columns
    seen = columns.T @ difference
    square = difference @ difference - seen @ linalg.solve(inner, seen, assume_a="pos")
    return float(np.sqrt(max(square, 0.0)))
