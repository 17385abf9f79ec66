"""From series to a table: steady values of a run, and the numerical error of a table as its noise."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from lunar_mjx.wheel_bed.particles.sand_box import Series
from lunar_mjx.wheel_bed.particles.settings import BedRun, Numerics

MEASURED = ("drawbar_pull", "side_force", "driving_torque", "sinkage")
"""What a run measures: names as in `wheel_bed.table.QUANTITIES`, and in `Series`."""


@dataclasses.dataclass(frozen=True)
class SteadyPart:
    """Which part of a run counts as steady."""

    window: float = 0.5
    """Share of the drive, its end, over which steady values are means."""
    blocks: int = 8
    """Parts of the window from whose scatter the mean's standard error is taken."""
    load_error: float = 0.05
    """Largest relative error of the mean vertical force with which a run counts: the wheel is not settled beyond."""


STEADY_PART = SteadyPart()


VARIANTS: Mapping[str, Mapping[str, float]] = {
    "voxel": {"voxel": 1.5},
    "step": {"step_share": 0.5},
    "contact": {},
    "jitter": {},
}
"""What is changed to learn the numerical error, with the factor on a setting."""


def variant_numerics(numerics: Numerics, variant: str) -> Numerics:
    """The settings with one of `VARIANTS` changed."""
    # The other contact law, whichever the table has.
    if variant == "contact":
        return dataclasses.replace(numerics, contact="pic8" if numerics.contact == "S2" else "S2")
    if variant == "jitter":
        return dataclasses.replace(numerics, seed=numerics.seed + 1)
    changed: dict[str, Any] = {k: getattr(numerics, k) * f for k, f in VARIANTS[variant].items()}
    if variant == "voxel":  # the time step stays as it is, so that the voxel alone is changed
        changed["step_share"] = numerics.step_share / VARIANTS["voxel"]["voxel"]
    return dataclasses.replace(numerics, **changed)


def error_share(variant: str) -> float:
    """Ratio of the numerical error at the table's settings to the difference that a variant of them makes.

    Voxel and time step are assumed to err by the first power of their size (no runs of three sizes exist); two
    contacts bracket the truth, of which the whole gap is told; two jitters differ by root two times the scatter of one.
    """
    if variant == "voxel":
        return 1.0 / (VARIANTS["voxel"]["voxel"] - 1.0)
    if variant == "step":
        return 1.0 / (1.0 - VARIANTS["step"]["step_share"])
    return 1.0 if variant == "contact" else float(np.sqrt(0.5))


def steady(run: BedRun, series: Series) -> dict[str, Any]:
    """Steady values of a run as plain data.

    Returns:
      values: mean of each quantity over the window, SI units, by quantity. error: standard error of these means from
      blocks. drift: mean of the window's second half less its first. static_sinkage in m; vertical_force in N;
      momentum_error: largest part of gravity's impulse that the balance of momentum misses; contacts; usable: whether
      all is finite, the load is carried to 5 % and the hub is above the undisturbed surface.
    """
    begin = run.settle_time + run.ramp_time
    window = series.time > begin + (1.0 - STEADY_PART.window) * (series.time[-1] - begin)
    # The last fifth before the drive, when the wheel shall have come to rest under its load.
    still = (series.time > 0.8 * run.settle_time) & (series.time <= run.settle_time)
    values, error, drift = {}, {}, {}
    for quantity in MEASURED:
        seen = getattr(series, quantity)[window]
        half = len(seen) // 2
        # Means of blocks, since neighbouring steps are correlated and would claim too small an error.
        blocks = np.array([block.mean() for block in np.array_split(seen, STEADY_PART.blocks)])
        values[quantity] = float(seen.mean())
        error[quantity] = float(blocks.std(ddof=1) / np.sqrt(STEADY_PART.blocks))
        drift[quantity] = float(seen[half:].mean() - seen[:half].mean())
    carried = float(series.vertical_force[window].mean())
    usable = bool(
        np.isfinite(list(values.values())).all()
        # A wheel that still sinks or rises carries more or less than its load.
        and abs(carried / run.point.load - 1.0) < STEADY_PART.load_error
        and values["sinkage"] < run.wheel.radius
    )
    return {
        "values": values,
        "error": error,
        "drift": drift,
        "static_sinkage": float(series.sinkage[still].mean()) if still.any() else None,
        "vertical_force": carried,
        "momentum_error": float(np.abs(series.momentum_error).max()),
        "contacts": float(series.contacts[window].mean()),
        "particles": series.particles,
        "steps": len(series.time),
        "usable": usable,
    }


def numerical_error(results: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, float]]:
    """Numerical error of a table by quantity and cause, SI units, from its runs and their variants.

    Args:
      results: as kept by the campaign: `variant`, `point`, `values`, `error`, `drift`, `usable`.

    Returns:
      By quantity: root mean square over the points that were varied of each cause (`VARIANTS`), `time` (standard error
      of the mean over the window, of all runs), `drift` (what changes still from half to half of the window, of all
      runs: they may not have come to rest), and `total`, the root of the sum of their squares. Causes that no run
      tells are left out.
    """
    usable = [r for r in results if r["usable"]]
    base = {_point(r): r for r in usable if r["variant"] == "table"}
    out: dict[str, dict[str, float]] = {}
    for quantity in MEASURED:
        parts = {}
        for variant in VARIANTS:
            away = [
                error_share(variant) * (r["values"][quantity] - base[_point(r)]["values"][quantity])
                for r in usable
                if r["variant"] == variant and _point(r) in base
            ]
            if away:
                parts[variant] = float(np.sqrt(np.mean(np.square(away))))
        if base:
            parts["drift"] = float(np.sqrt(np.mean([r["drift"][quantity] ** 2 for r in base.values()])))
            parts["time"] = float(np.sqrt(np.mean([r["error"][quantity] ** 2 for r in base.values()])))
        if parts:
            # Independent causes: squares add.
            parts["total"] = float(np.sqrt(sum(v**2 for v in parts.values())))
        out[quantity] = parts
    return out


def _point(result: Mapping[str, Any]) -> tuple[float, ...]:
    # JSON and arithmetic may differ in the last digit of one point.
    return tuple(round(v, 9) for v in result["point"].values())
