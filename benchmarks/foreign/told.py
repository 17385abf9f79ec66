"""How far who is told the world's own law can tell an effect from a refit of that law without it."""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.optimize import least_squares

from .bed import deviation, readings
from .cases import Case, Errors, generator
from .misfit import Field
from .wheel import World

LOGARITHMS = (
    "exponent",
    "cohesion",
    "reece_phi",
    "friction_angle",
    "shear_x",
    "shear_y",
    "grain_stiffness",
    "rim_friction",
)
TRAITS = ("c1", "c2", "c3")
WEAK = {"soil": 1.0, "traits": 0.3}
"""Standard deviations of the priors on constants of a told refit: a factor of e; 0.3 for the law of an angle."""
USUAL = {
    "drawbar_pull": 0.02,
    "side_force": 0.02,
    "driving_torque": 0.02,
    "sinkage": 0.02,
    "load": 0.012,
    "slip": 0.015,
    "angle": np.radians(0.6),
    "cross_talk": 0.009,
}
"""Usual sizes of calibration errors of a bed, as `cases.py` draws them."""


def without(world: World, name: str) -> World:
    """The world with one hidden effect left out."""
    return dataclasses.replace(world, effects={k: v for k, v in world.effects.items() if k != name})


def _start(world: World) -> tuple[list[tuple[str, str]], np.ndarray]:
    names = [("soil", k) for k in LOGARITHMS if k in world.soil] + [("traits", k) for k in TRAITS if k in world.traits]
    return names, np.array([WEAK[where] for where, _ in names])


def _moved(world: World, names: list[tuple[str, str]], at: np.ndarray) -> World:
    soil, traits = dict(world.soil), dict(world.traits)
    for (where, key), x in zip(names, at, strict=True):
        if where == "soil":
            soil[key] = soil[key] * float(np.exp(np.clip(x, -5.0, 5.0)))
            if key == "friction_angle":
                soil[key] = min(soil[key], 1.3)
        else:
            traits[key] = traits[key] + float(x)
    return dataclasses.replace(world, soil=soil, traits=traits)


def _vector(case: Case, world: World, errors: Errors) -> np.ndarray:
    parts = [readings(world, rows, errors) for rows in case.rows]
    return np.concatenate([p[q] for p in parts for q in case.measured])


def separable(case: Case) -> dict[str, dict[str, float]]:
    """Sigma by which each hidden effect stands out, by name.

    `sigma`: the world's own law with its misfit and calibration known, base constants refitted without the effect, the
    root of what remains of chi-square in noise-free readings. `sigma_blind`: the same where neither misfit nor
    calibration is known but in size, to first order about that refit; what anybody can hope for who is given the
    law's form only.
    """
    return {name: _one(case, name) for name in case.hidden}


def _one(case: Case, name: str) -> dict[str, float]:
    target = _vector(case, case.world, case.errors)
    clean = [readings(case.world, rows, case.errors) for rows in case.rows]
    std = np.concatenate([deviation(case.errors, q, c[q]) for c in clean for q in case.measured])
    std = std / np.sqrt(case.replicates)
    bare = without(case.world, name)
    names, weak = _start(bare)

    def residual(at: np.ndarray) -> np.ndarray:
        missed = (_vector(case, _moved(bare, names, at), case.errors) - target) / std
        return np.concatenate([np.nan_to_num(missed, nan=1e3, posinf=1e3, neginf=-1e3), at / weak])

    fit = least_squares(residual, np.zeros(len(names)), x_scale=0.1, diff_step=1e-4, max_nfev=60)
    left = residual(fit.x)[: len(target)]
    return {"sigma": float(np.sqrt(np.sum(left**2))), "sigma_blind": _blind(case, bare, names, fit.x, weak, left, std)}


def _blind(
    case: Case,
    bare: World,
    names: list[tuple[str, str]],
    at: np.ndarray,
    weak: np.ndarray,
    left: np.ndarray,
    std: np.ndarray,
) -> float:
    """Length of what remains after misfits of usual size and calibration have taken their share, sigma."""
    base = _moved(bare, names, at)
    zero = _vector(case, base, case.errors)
    columns, priors = [], []

    def add(world: World, errors: Errors, step: float, prior: float) -> None:
        columns.append(np.nan_to_num((_vector(case, world, errors) - zero) / step / std))
        priors.append(prior)

    for i, prior in enumerate(weak):
        moved = at.copy()
        moved[i] += 1e-4
        add(_moved(bare, names, moved), case.errors, 1e-4, float(prior))
    rng = generator(case.seed, case.name, "blind")
    for place in range(3):
        fields = list(base.fields or ())
        rms = float(np.sqrt(np.sum(fields[place].weights ** 2) / 2.0))
        other = Field.draw(rng, 1.0, 4)
        half = len(other.waves)
        for k in range(2 * half):
            # The field that is there and one wave more.
            unit = np.zeros(2 * half)
            unit[k] = 1e-3
            both = Field(np.concatenate([fields[place].waves, other.waves]), _joined(fields[place].weights, unit))
            fields_there = (*fields[:place], both, *fields[place + 1 :])
            add(dataclasses.replace(base, fields=fields_there), case.errors, 1e-3, rms / np.sqrt(half))  # type: ignore[arg-type]
    for key, prior in USUAL.items():
        add(base, _miscalibrated(case.errors, key, 1e-4), 1e-4, prior)
    matrix, prior = np.stack(columns, axis=1), np.array(priors)
    system = np.concatenate([matrix, np.diag(1.0 / prior)])
    right = np.concatenate([-left, np.zeros(len(prior))])
    best = np.linalg.lstsq(system, right, rcond=None)[0]
    return float(np.sqrt(np.sum((right - system @ best) ** 2)))


def _joined(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    a, b = len(first) // 2, len(second) // 2
    return np.concatenate([first[:a], second[:b], first[a:], second[b:]])


def _miscalibrated(errors: Errors, key: str, step: float) -> Errors:
    if key in errors.scale:
        return dataclasses.replace(errors, scale={**errors.scale, key: errors.scale[key] + step})
    return dataclasses.replace(errors, **{key: getattr(errors, key) + step})
