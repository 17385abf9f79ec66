"""Steady-state logs of the test bed: a true soil away from the nominal one, slip x slip angle x load, replicates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from lunar_mjx.logs import write_steady_log
from lunar_mjx.logs.log import Noise

from ..noise import Recipe, ar1, rounded, smooth
from . import effects as bed_effects
from .bench import Points, Soil, measure

QUANTITIES = ("drawbar_pull_N", "side_force_N", "driving_torque_Nm", "sinkage_m")
DECAY = 0.8
"""Correlation of coloured noise between neighbours of a sweep."""
DEEPEST = 0.6
"""Sinkage over radius at which an operator stops the run."""


@dataclasses.dataclass(frozen=True, eq=False)
class Truth:
    """A bed and what is hidden in it.

    Attributes:
      points, soil, law: of the bed. effects: parameters by hidden effect. sigma: datasheet noise by quantity.
      channels: what the bed measures.
    """

    points: Points
    soil: Soil
    effects: dict[str, dict[str, float]]
    sigma: dict[str, float]
    law: str = "closed"
    channels: tuple[str, ...] = QUANTITIES

    def clean(self) -> dict[str, np.ndarray]:
        """Noise-free measurements."""
        hidden = [bed_effects.make(n, p, self.points.radius) for n, p in self.effects.items()]
        return measure(self.points, self.soil, hidden, self.law)


def draw_soil(rng: np.random.Generator) -> Soil:
    """A soil as it might lie in the bin, away from the nominal one."""
    modulus = rng.uniform(0.010, 0.025)
    return Soil(
        k_phi=8.2e5 * np.exp(rng.normal(0.0, 0.35)),
        n=rng.uniform(0.9, 1.2),
        cohesion=rng.uniform(60.0, 500.0),
        friction_angle=np.radians(rng.uniform(29.0, 39.0)),
        modulus_x=modulus,
        modulus_y=modulus * rng.uniform(0.7, 1.4),
    )


def grid(
    rng: np.random.Generator, angles: Sequence[float] = (0.0, 10.0, 20.0, 30.0, 45.0), loads: int = 3, slips: int = 9
) -> Points:
    """A test plan: slip -0.1 to 0.7, slip angles deg, loads around a contact pressure of 1.5 kPa on r b."""
    radius = rng.uniform(0.10, 0.25)
    width = radius * rng.uniform(0.6, 1.0)
    levels = 1500.0 * radius * width * (np.geomspace(0.6, 1.8, loads) if loads > 1 else np.ones(1))
    slip = np.linspace(-0.1, 0.7, slips)
    load, angle, s = (a.ravel() for a in np.meshgrid(levels, np.radians(angles), slip, indexing="ij"))
    return Points(s, angle, np.round(load, 1), radius, width)


def sigmas(points: Points) -> dict[str, float]:
    """Datasheet noise of one run: a six-axis cell of 0.6 % of the largest load, a laser of 0.4 mm."""
    force = 0.006 * float(points.load.max())
    return dict(zip(QUANTITIES, (force, force, force * points.radius, 4e-4), strict=True))


def draw(
    rng: np.random.Generator,
    names: Sequence[str],
    points: Points,
    law: str = "closed",
    channels: tuple[str, ...] = QUANTITIES,
) -> Truth:
    """Soil and sizes of the hidden effects, drawn until no wheel digs itself in."""
    for _ in range(200):
        kinds = {**bed_effects.KNOWN, **bed_effects.OUTSIDE}
        effects = {n: kinds[n].draw(rng, points.radius) for n in names}
        truth = Truth(points, draw_soil(rng), effects, sigmas(points), law, channels)
        clean = truth.clean()
        if clean["carried"].all() and clean["sinkage_m"].max() < DEEPEST * points.radius:
            return truth
    raise RuntimeError(f"no soil carries the wheel with {', '.join(names)}")


def record(truth: Truth, recipe: Recipe, rng: np.random.Generator, replicates: int = 3) -> pd.DataFrame:
    """The table as the bed writes it: every replicate a sweep of its own, in the order of slip."""
    p = truth.points
    clean = truth.clean()
    places = np.column_stack([p.slip / 0.35, p.angle / np.radians(25.0), np.log(p.load) / 0.4])
    dirt = {q: recipe.dirt * smooth(rng, places) for q in QUANTITIES}
    sweep = np.unique(np.column_stack([p.angle, p.load]), axis=0, return_inverse=True)[1].reshape(-1)
    parts = []
    for trial in range(1, replicates + 1):
        row = {"slip_ratio": p.slip, "slip_angle_deg": np.degrees(p.angle), "normal_load_N": p.load}
        for q in QUANTITIES:
            noise = rng.normal(size=len(p.slip))
            if recipe.kind == "coloured":
                for k in range(sweep.max() + 1):
                    mine = np.flatnonzero(sweep == k)
                    noise[mine[np.argsort(p.slip[mine])]] = ar1(rng, len(mine), DECAY)
            row[q] = clean[q] + truth.sigma[q] * (recipe.scale * noise + dirt[q])
        parts.append(pd.DataFrame(row | {"trial": trial}))
    frame = pd.concat(parts, ignore_index=True)
    if recipe.kind == "quantised":
        for q in QUANTITIES:
            frame[q] = rounded(frame[q].to_numpy(), 0.7 * truth.sigma[q])
        # runs get lost, but never all of a point
        lost = (rng.random(len(frame)) < 0.06) & (frame["trial"] > 1)
        frame = frame[~lost].reset_index(drop=True)
    # the plan is stated in full digits; what is measured in the digits of the instrument
    frame = frame.drop(columns=[q for q in QUANTITIES if q not in truth.channels])
    return frame.round(dict.fromkeys(truth.channels, 7) | {"slip_ratio": 4, "slip_angle_deg": 3})


def write(folder: Path, frame: pd.DataFrame, truth: Truth, recipe: Recipe, commitment: str) -> None:
    """Writes the log folder with the stated noise of the datasheet."""
    noise = {q: Noise(recipe.scale * truth.sigma[q], "datasheet") for q in QUANTITIES if q in frame}
    write_steady_log(
        folder,
        frame,
        wheel={"radius_m": truth.points.radius, "width_m": truth.points.width},
        slip_definition="wheel_frame",
        noise=noise,
        gravity_m_s2=truth.points.gravity,
        commitment=commitment,
    )
