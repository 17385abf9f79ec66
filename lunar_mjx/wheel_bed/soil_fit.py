"""Refitting a wheel model's soil to a steady-state table, judged on slip angles that the fit never saw."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import optimize
from scipy.stats import qmc

from lunar_mjx.errors import UserError
from lunar_mjx.wheel_bed.bed import WheelBed
from lunar_mjx.wheel_bed.comparison import Comparison, compare, residuals
from lunar_mjx.wheel_bed.table import SteadyStateTable


class Free(NamedTuple):
    """A parameter that a fit may move, and how far: `log` searches its logarithm."""

    effect: str
    name: str
    low: float
    high: float
    log: bool = False


SOIL: tuple[Free, ...] = (
    Free("soil", "k_phi", 1e4, 1e8, log=True),
    Free("soil", "n", 0.3, 2.5),
    Free("soil", "cohesion", 0.0, 5e3),
    Free("soil", "friction_angle", 0.05, 0.9),
    Free("soil", "shear_modulus_x", 1e-4, 0.2, log=True),
    Free("soil", "shear_modulus_y", 1e-4, 0.2, log=True),
)
"""The soil's parameters that one wheel width can tell apart. k_c and k_phi act only through k_c/b + k_phi, so k_c is
held at `FIXED` and the fitted k_phi is that sum."""

FIXED: Mapping[str, Mapping[str, float]] = {"soil": {"k_c": 0.0}}

PAPER_CONTACT: tuple[Free, ...] = (
    Free("penalty_contact", "stiffness", 1e2, 1e6, log=True),
    Free("engine_friction", "mu", 0.0, 2.0),
)
"""What carries the wheel in the preset `paper`: its soil cannot."""


@dataclasses.dataclass(frozen=True)
class SoilFit:
    """Which slip angles are fitted and which are held out, and when a fit has ended."""

    fit_angles: tuple[float, float, float] = (0.0, 30.0, 60.0)
    """Fitted slip angles, deg."""
    inside_angles: tuple[float, float] = (15.0, 45.0)
    """Held out, inside the range of the fitted slip angles."""
    beyond_angles: tuple[float] = (75.0,)
    """Held out, beyond every fitted slip angle. 90 deg is set apart: the sinkage there reaches the wheel's radius."""
    apart_angles: tuple[float] = (90.0,)
    """Neither fitted nor held out."""
    # Starts agree with the best where their root mean square residual exceeds it by at most this share, or sigma.
    agree: float = 0.001
    exact: float = 1e-06


SOIL_FIT = SoilFit()


@dataclasses.dataclass(frozen=True, eq=False)
class WheelFit:
    """A fitted wheel model.

    Attributes:
      name: of the model.
      bed: the test bed with the fitted values.
      values: fitted, by effect and name, SI units. fixed: held, likewise.
      comparison: of the fitted model with the whole table.
      fitted, inside, beyond, apart: root mean square residual in sigma over the angles of `SOIL_FIT` called
        so; held_out: over inside and beyond together.
      starts: root mean square residual that each start ended with, rising. agreeing: how many reached the least one.
      at_bound: parameters that ended at the edge of their range.
    """

    name: str
    bed: WheelBed
    values: Mapping[str, Mapping[str, float]]
    fixed: Mapping[str, Mapping[str, float]]
    comparison: Comparison
    fitted: float
    held_out: float
    inside: float
    beyond: float
    apart: float
    starts: tuple[float, ...]
    agreeing: int
    at_bound: tuple[str, ...]

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only, ready for JSON."""
        plain = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        for left_out in ("bed", "comparison"):
            del plain[left_out]
        return plain | {
            "fit_angles_deg": SOIL_FIT.fit_angles,
            "inside_angles_deg": SOIL_FIT.inside_angles,
            "beyond_angles_deg": SOIL_FIT.beyond_angles,
            "held_out_rms": {q: held_out_rms(self.comparison, q) for q in self.comparison.residual},
        }


def held_out_rms(comparison: Comparison, quantity: str) -> float:
    """Root mean square residual of one quantity at the held-out slip angles, in sigma."""
    one = dataclasses.replace(comparison, residual={quantity: comparison.residual[quantity]})
    return one.score(SOIL_FIT.inside_angles + SOIL_FIT.beyond_angles)


def _solve(
    bed: WheelBed,
    table: SteadyStateTable,
    free: Sequence[Free],
    starts: int,
    seed: int,
    progress: Callable[[int], None] | None,
) -> list[Any]:
    """Least squares from every start; arguments as for `fit`. Best first."""
    with jax.enable_x64(True):
        evaluate, jacobian = _functions(bed, table, free)
        # SciPy's annotations know no function for `jac`.
        least_squares: Any = optimize.least_squares
        # Starts spread evenly over the box: residuals of a sinkage exponent have several minima.
        points = qmc.Sobol(len(free), rng=np.random.default_rng(seed)).random(starts)
        solutions = []
        for i, start in enumerate(points):
            # The middle of the range keeps starts away from its edges, where an exponent of 2.5 carries no load.
            x0 = 0.1 + 0.8 * start
            solution = least_squares(
                evaluate,
                x0,
                jac=jacobian,
                bounds=(0.0, 1.0),
                # Steps of a tenth of each range: parameters are places in [0, 1], of like size.
                x_scale=0.1,
            )
            solutions.append(solution)
            if progress is not None:
                progress(i + 1)
    return sorted(solutions, key=lambda s: s.cost)


def fit(
    bed: WheelBed,
    table: SteadyStateTable,
    free: Sequence[Free] = SOIL,
    name: str = "model",
    starts: int = 8,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> WheelFit:
    """Fits parameters at the fitted angles of `SOIL_FIT` by least squares on exact Jacobians, from Sobol starts.

    Args:
      bed: the wheel model; parameters that are not free keep their values, but for `FIXED`.
      table: averaged over its replicates.
      free: what the fit may move.
      name: of the model, for reports.
      starts: number of starting points; a power of two.
      seed: of the Sobol sequence.
      progress: called with the number of starts done.

    Raises:
      UserError: a free parameter's effect does not act on the wheel, or the table lacks the slip angles.
    """
    seen = table.at_angles(SOIL_FIT.fit_angles)
    if not len(seen):
        raise UserError(f"{table.name}: holds none of the slip angles {SOIL_FIT.fit_angles} deg; the fit needs them.")
    fixed = {e: dict(v) for e, v in FIXED.items() if e in bed.parameters}
    base = bed.with_values(fixed)
    # Refuses effects that do not act on this wheel before the fit begins.
    base.merged({f.effect: {f.name: f.low} for f in free})
    solutions = _solve(base, seen, free, starts, seed, progress)
    rms = tuple(float(np.sqrt(2.0 * s.cost / len(s.fun))) for s in solutions)
    best = solutions[0].x
    values: dict[str, dict[str, float]] = {}
    for f, u in zip(free, best, strict=True):
        values.setdefault(f.effect, {})[f.name] = float(_physical(f, u, np))
    fitted_bed = base.with_values(values)
    whole = compare(fitted_bed, table, name)
    return WheelFit(
        name=name,
        bed=fitted_bed,
        values=values,
        fixed=fixed,
        comparison=whole,
        fitted=whole.score(SOIL_FIT.fit_angles),
        held_out=whole.score(SOIL_FIT.inside_angles + SOIL_FIT.beyond_angles),
        inside=whole.score(SOIL_FIT.inside_angles),
        beyond=whole.score(SOIL_FIT.beyond_angles),
        apart=whole.score(SOIL_FIT.apart_angles),
        starts=rms,
        agreeing=sum(r <= rms[0] * (1.0 + SOIL_FIT.agree) + SOIL_FIT.exact for r in rms),
        at_bound=tuple(f"{f.effect}.{f.name}" for f, u in zip(free, best, strict=True) if u < 1e-4 or u > 1 - 1e-4),
    )


def _physical(f: Free, unit: Any, numpy: Any) -> Any:
    """A parameter's value in its unit, from its place in [0, 1] of the searched range."""
    # Moduli range over decades: a step by a share is alike everywhere.
    if f.log:
        return numpy.exp(np.log(f.low) + unit * np.log(f.high / f.low))
    return f.low + unit * (f.high - f.low)


def _functions(bed: WheelBed, table: SteadyStateTable, free: Sequence[Free]) -> tuple[Callable, Callable]:
    """Residual vector in sigma and its Jacobian, as NumPy functions of the places in [0, 1]."""
    test = table.wheel_test()

    def vector(place: Any) -> Any:
        values = {e: dict(v) for e, v in bed.parameters.items()}
        for i, f in enumerate(free):
            values[f.effect][f.name] = _physical(f, place[i], jnp)
        return jnp.concatenate(list(residuals(bed(values, test), table).values()))

    # Forward mode: a handful of parameters and hundreds of residuals.
    run, slope = jax.jit(vector), jax.jit(jax.jacfwd(vector))
    return (lambda x: np.asarray(run(x))), (lambda x: np.asarray(slope(x)))
