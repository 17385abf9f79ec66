"""Draws a case: a world, a table to measure on it, a test bed with its errors, and what is hidden."""

from __future__ import annotations

import dataclasses
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from . import kinds
from .laws import GRANULAR_HOLDS
from .misfit import Field
from .wheel import DEEPEST, Result, Rows, World, run

GROUPS: Mapping[str, float] = {"null": 0.25, "single": 0.45, "outside": 0.2, "pair": 0.1}
"""Shares of a set."""
NOISES = ("gaussian", "ar1", "student", "proportional")
QUANTITIES = ("drawbar_pull", "side_force", "driving_torque", "sinkage")


@dataclasses.dataclass(frozen=True)
class Errors:
    """What the test bed gets wrong.

    Attributes:
      scale: of what is measured, relative, by quantity. load: of the imposed load, relative. slip: added to the slip
        that was meant. angle: added to the slip angle, rad. cross_talk: share of the side force read as drawbar pull.
      std: of one run by quantity, SI. stated: the same as `log.toml` says. noise: one of `NOISES`. memory: correlation
        of neighbouring rows. share: of the value, for proportional noise.
    """

    scale: Mapping[str, float]
    load: float
    slip: float
    angle: float
    cross_talk: float
    std: Mapping[str, float]
    stated: Mapping[str, float]
    noise: str
    memory: float
    share: float


@dataclasses.dataclass(frozen=True)
class Case:
    """A sealed case.

    Attributes:
      name: of its folder. group: of `GROUPS`. world: with what is hidden. rows: as imposed on paper, a list for each
        log of the campaign. errors: of the bed. measured: quantities that the tables hold. replicates: runs per point.
      hidden: names of what is hidden. ports: at which it may be said to act. holds: names that the base law itself
        earns, so that naming them is no mistake.
    """

    name: str
    group: str
    world: World
    rows: tuple[Rows, ...]
    errors: Errors
    measured: tuple[str, ...]
    replicates: int
    hidden: tuple[str, ...]
    ports: tuple[str, ...]
    holds: tuple[str, ...]
    seed: int


def generator(seed: int, *words: str | int) -> np.random.Generator:
    """Random numbers of their own for each purpose: adding a case changes no other."""
    return np.random.default_rng([seed, *(zlib.crc32(str(w).encode()) for w in words)])


TWO_OUTSIDE = "two_outside"
"""Group of tables with two effects at once that the catalogue lacks; of no set but by itself."""


def plan(which: str, count: int, only: str = "") -> list[tuple[str, tuple[str, ...]]]:
    """Group and hidden names of every case of a set, mixed so that any first part is a small copy of the whole.

    Args:
      which: "tune" or "report". count: of cases. only: group of all of them; `GROUPS` by their shares if "".
    """
    known = kinds.TUNE_KNOWN if which == "tune" else kinds.REPORT_KNOWN
    outside = kinds.TUNE_OUTSIDE if which == "tune" else kinds.REPORT_OUTSIDE
    pairs = [(a, b) for i, a in enumerate(known) for b in known[i + 1 :] if not _clash(a, b)]
    order = generator(0, which, "pairs").permutation(len(pairs))
    pools = {
        "null": [()],
        "single": [(k,) for k in known],
        "outside": [(k,) for k in outside],
        "pair": [pairs[i] for i in order],
    }
    both = [(a, b) for i, a in enumerate(outside) for b in outside[i + 1 :] if _together(a, b)]
    pools[TWO_OUTSIDE] = [both[i] for i in generator(0, which, TWO_OUTSIDE).permutation(len(both))]
    found = []
    for group, share in ({only: 1.0} if only else GROUPS).items():
        number = round(share * count)
        found += [((n + 0.5) / number, group, pools[group][n % len(pools[group])]) for n in range(number)]
    return [(group, hidden) for _, group, hidden in sorted(found, key=lambda f: (f[0], f[1]))]


def _clash(a: str, b: str) -> bool:
    """Whether two effects are one phenomenon, or no base law holds both."""
    same = (
        {"bulldozing", "side_wall"},
        {"slip_sinkage", "slide_softening", "shear_softening"},
        {"angle_sinkage", "slide_softening", "side_entry"},
        {"exit_angle", "side_exit"},
    )
    return any({a, b} <= s for s in same)


def _together(a: str, b: str) -> bool:
    """Whether a law holds both of two effects outside the catalogue."""
    return any(
        law in kinds.OUTSIDE[a].laws and law in kinds.OUTSIDE[b].laws for law in ("linear", "integral", "granular")
    )


LAW_SHARES = {
    "tune": {"linear": 0.4, "integral": 0.45, "granular": 0.15},
    "report": {"linear": 0.3, "integral": 0.4, "granular": 0.3},
}


def draw(which: str, seed: int, number: int, group: str, hidden: tuple[str, ...]) -> Case:
    """A case whose wheel neither floats nor drowns; draws again until so.

    Args:
      which: "tune" or "report". seed: of the set. number: of the case. group, hidden: what it is about.
    """
    for attempt in range(200):
        rng = generator(seed, which, number, attempt)
        found = _try(rng, which, seed, number, group, hidden)
        if found is not None:
            return found
    raise RuntimeError(
        f"case {number} ({', '.join(hidden) or 'null'}): no wheel of 200 stays between surface and axle."
    )


def _try(
    rng: np.random.Generator, which: str, seed: int, number: int, group: str, hidden: tuple[str, ...]
) -> Case | None:
    what = {name: kinds.KNOWN.get(name) or kinds.OUTSIDE[name] for name in hidden}
    needs = frozenset().union(*(k.needs for k in what.values())) if what else frozenset()
    shares = {law: share for law, share in LAW_SHARES[which].items() if all(law in k.laws for k in what.values())}
    law = str(rng.choice(list(shares), p=np.array(list(shares.values())) / sum(shares.values())))
    radius = float(np.exp(rng.uniform(np.log(0.06), np.log(0.27))))
    width = radius * float(rng.uniform(0.5, 1.1))
    gravity = float(rng.choice([9.80665, 9.80665, 9.80665, 3.71, 1.62]))
    soil, pressure = _soil(rng, law, radius, width, "cohesive" in needs)
    traits, holds = _traits(rng, law, hidden, needs)
    load = pressure * width * radius * 0.5
    bed = kinds.Bed(radius, load, pressure)
    effects = {name: kind.draw(rng, bed) for name, kind in what.items()}
    rms = [float(rng.uniform(0.02, 0.08)) for _ in range(3)]
    fields = tuple(Field.draw(rng, r, 4) for r in rms)
    world = World(law, radius, width, soil, traits, fields, load, effects)  # type: ignore[arg-type]
    rows = _table(rng, load, gravity, needs)
    replicates = int(rng.choice([1, 2, 3]))
    measured = tuple(
        q
        for q in QUANTITIES
        if not (q == "side_force" and np.all(rows[0].angle == 0.0))
        and not (q == "driving_torque" and "torque" not in needs and rng.random() < 0.3)
        and not (q == "sinkage" and "sinkage" not in needs and rng.random() < 0.15)
    )
    true = [run(world, r) for r in rows]
    if not all(_sound(t, radius) for t in true):
        return None
    errors = _errors(rng, true, load, radius)
    ports = tuple(dict.fromkeys(p for k in what.values() for p in k.ports))
    return Case(f"{which}-{number:03d}", group, world, rows, errors, measured, replicates, hidden, ports, holds, seed)


def _sound(result: Result, radius: float) -> bool:
    deep = np.max(result.sinkage) / radius
    return bool(np.all(result.reached) and np.min(result.sinkage) > 2e-4 and deep < 0.6 < DEEPEST)


def _soil(
    rng: np.random.Generator, law: str, radius: float, width: float, cohesive: bool
) -> tuple[dict[str, float], float]:
    """Constants of the soil, and the pressure at a static sinkage of 4 to 12 % of the radius, Pa."""
    depth = float(rng.uniform(0.04, 0.12)) * radius
    if law == "granular":
        stiffness = float(np.exp(rng.uniform(np.log(0.4e6), np.log(4e6))))  # 0.1 to 3 N/cm3 and denser sands
        return {"grain_stiffness": stiffness, "rim_friction": float(rng.uniform(0.35, 0.7))}, 0.8 * stiffness * depth
    exponent = float(rng.uniform(0.6, 1.2))
    cohesion = float(rng.uniform(400.0, 1500.0) if cohesive else np.exp(rng.uniform(np.log(60.0), np.log(1000.0))))
    unit_weight = float(rng.uniform(2500.0, 17000.0))
    pressure = float(np.exp(rng.uniform(np.log(2500.0), np.log(12000.0))))
    if cohesive:
        pressure = min(pressure, 8.0 * cohesion)
    share = float(rng.uniform(0.0, 0.3))  # of the pressure that cohesion bears
    ratio = (depth / width) ** exponent
    return {
        "exponent": exponent,
        "cohesion": cohesion,
        "unit_weight": unit_weight,
        "reece_c": share * pressure / (cohesion * ratio),
        "reece_phi": (1.0 - share) * pressure / (unit_weight * width * ratio),
        "friction_angle": float(np.radians(rng.uniform(27.0, 38.0))),
        "shear_x": float(rng.uniform(0.05, 0.25)) * radius,
        "shear_y": float(rng.uniform(0.06, 0.30)) * radius,
    }, pressure


def _traits(
    rng: np.random.Generator, law: str, hidden: tuple[str, ...], needs: frozenset[str]
) -> tuple[dict[str, float], tuple[str, ...]]:
    """Choices of the base law and the catalogue's names for them."""
    if law == "granular":
        return {}, GRANULAR_HOLDS
    traits, holds = {"skid": 1.0}, ["stress_integral"] if law == "integral" else []
    if "skid_shear" in hidden or rng.random() < 0.5:
        traits["skid"] = 0.0
    else:
        holds.append("skid_shear")
    if "exit_angle" not in hidden and ("rear" in needs or rng.random() < 0.35):
        traits |= {
            "c1": float(rng.uniform(0.35, 0.5)),
            "c2": float(rng.uniform(0.0, 0.3)),
            "c3": float(rng.uniform(0.15 if "rear" in needs else 0.0, 0.35)),
            "c4": 0.0,
        }
        holds.append("exit_angle")
    if "friction_circle" not in hidden and rng.random() < 0.25:
        traits["circle"] = 1.0
        holds.append("friction_circle")
    return traits, tuple(holds)


_DRIVING = (
    (0.0, 0.1, 0.2, 0.3, 0.45, 0.6, 0.8),
    (0.05, 0.15, 0.3, 0.5, 0.7),
    (0.02, 0.08, 0.16, 0.25, 0.4, 0.55, 0.7, 0.85),
)
_ANGLES = ((0.0, 15.0, 30.0), (0.0, 10.0, 20.0, 40.0), (0.0, 15.0, 30.0, 45.0, 60.0))


def _table(rng: np.random.Generator, load: float, gravity: float, needs: frozenset[str]) -> tuple[Rows, ...]:
    """What is imposed: slips by angles by loads by speeds, in each gravity."""
    slips = np.array(_DRIVING[rng.integers(len(_DRIVING))])
    if "braking" in needs or rng.random() < 0.3:
        slips = np.concatenate([[-0.6, -0.4, -0.2, -0.1], slips])
    angles = np.array(_ANGLES[rng.integers(len(_ANGLES))]) if "angles" in needs or rng.random() < 0.6 else np.zeros(1)
    several = "loads" in needs or len(angles) == 1 or rng.random() < 0.4
    loads = np.array([0.6, 1.0, 1.6]) if several else np.ones(1)
    if len(loads) > 1 and len(angles) > 3:
        loads = np.array([0.7, 1.4])
    travel = float(np.exp(rng.uniform(np.log(0.01), np.log(0.1))))
    speeds = travel * (np.array([0.3, 1.0, 3.0]) if "speeds" in needs else np.ones(1))
    if len(speeds) > 1:
        slips, angles, loads = slips[::2], angles[:2], loads[:2]
    if len(speeds) == 1 and rng.random() < 0.3:
        travel = travel * (1.0 + 0.5 * rng.random())
    gravities = (9.80665, 1.62) if "gravities" in needs else (gravity,)
    grid = [g.ravel() for g in np.meshgrid(np.radians(angles), loads * load, speeds, slips, indexing="ij")]
    angle, weight, speed, slip = grid
    found = []
    for g in gravities:
        # A mass is put on the wheel: it weighs less where gravity is less.
        w = weight * (g / gravities[0])
        found.append(Rows(slip, angle, w, speed, np.full(len(slip), g)))
    return tuple(found)


def _errors(rng: np.random.Generator, true: list[Result], load: float, radius: float) -> Errors:
    """Errors of a bed: load cell 1 to 3 %, slip 0.01 to 0.02, angle under a degree, noise misjudged by 20 %."""

    def either(low: float, high: float) -> float:
        return float(rng.choice([-1.0, 1.0]) * rng.uniform(low, high))

    cell = either(0.01, 0.03)
    scale = {
        "drawbar_pull": cell,
        "side_force": cell + either(0.0, 0.01),
        "driving_torque": either(0.01, 0.03),
        "sinkage": either(0.01, 0.03),
    }
    size = {
        "drawbar_pull": load,
        "side_force": load,
        "driving_torque": load * radius,
        "sinkage": float(np.mean(true[0].sinkage)),
    }
    share = {
        "drawbar_pull": (0.006, 0.02),
        "side_force": (0.006, 0.02),
        "driving_torque": (0.006, 0.02),
        "sinkage": (0.02, 0.06),
    }
    std = {q: size[q] * float(rng.uniform(*share[q])) for q in QUANTITIES}
    noise = str(rng.choice(NOISES))
    return Errors(
        scale=scale,
        load=either(0.005, 0.02),
        slip=either(0.01, 0.02),
        angle=np.radians(either(0.2, 1.0)),
        cross_talk=either(0.003, 0.015),
        std=std,
        stated={q: s * float(rng.uniform(0.8, 1.2)) for q, s in std.items()},
        noise=noise,
        memory=float(rng.uniform(0.3, 0.7)) if noise == "ar1" else 0.0,
        share=float(rng.uniform(0.02, 0.05)) if noise == "proportional" else 0.0,
    )


def summary(case: Case) -> dict[str, Any]:
    """The sealed truth as numbers, names and lists."""
    world = case.world
    return {
        "case": case.name,
        "kind": "table",
        "group": case.group,
        "hidden": list(case.hidden),
        "ports": list(case.ports),
        "holds": list(case.holds),
        "amounts": {k: dict(v) for k, v in world.effects.items()},
        "law": world.law,
        "soil": dict(world.soil),
        "traits": dict(world.traits),
        "misfit_rms": [float(np.sqrt(np.sum(f.weights**2) / 2.0)) for f in world.fields or ()],
        "calibration": {
            "scale": dict(case.errors.scale),
            "load": case.errors.load,
            "slip": case.errors.slip,
            "angle_deg": float(np.degrees(case.errors.angle)),
            "cross_talk": case.errors.cross_talk,
        },
        "noise": {
            "kind": case.errors.noise,
            "std": dict(case.errors.std),
            "stated": dict(case.errors.stated),
            "memory": case.errors.memory,
            "share": case.errors.share,
        },
        "replicates": case.replicates,
        "measured": list(case.measured),
        "points": sum(len(r.slip) for r in case.rows),
    }
