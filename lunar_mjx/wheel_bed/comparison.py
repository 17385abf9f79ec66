"""Holding a wheel model against a steady-state table: residuals in units of the replicates' scatter."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import UserError
from lunar_mjx.wheel_bed.bed import WheelBed, WheelResult
from lunar_mjx.wheel_bed.table import QUANTITIES, SteadyStateTable, at_angles

if TYPE_CHECKING:
    from lunar_mjx.model import Model


class Worst(NamedTuple):
    """The point at which a model is farthest from the measurement (SI units; slip as the table defines it)."""

    slip_ratio: float
    slip_angle_deg: float
    measured: float
    predicted: float
    residual: float


@dataclasses.dataclass(frozen=True, eq=False)
class Comparison:
    """A wheel model against a table; plain data.

    Attributes:
      name: of the model.
      table: the measurements.
      predicted: by quantity, one entry per point, SI units.
      residual: (predicted - measured)/sigma by quantity, with sigma the scatter of single runs.
      rms: root mean square residual by quantity, in sigma.
      overall: the same over all quantities together.
      worst: by quantity.
      unreached: number of points whose load the model's soil cannot carry; they count with the forces at 1.5 radii.
    """

    name: str
    table: SteadyStateTable
    predicted: Mapping[str, np.ndarray]
    residual: Mapping[str, np.ndarray]
    rms: Mapping[str, float]
    overall: float
    worst: Mapping[str, Worst]
    unreached: int

    def score(self, angles_deg: tuple[float, ...]) -> float:
        """Root mean square residual over all quantities at some slip angles, in sigma."""
        # All quantities in one list: in units of scatter they weigh by their number.
        keep = at_angles(self.table.test["slip_angle_deg"], angles_deg)
        return _rms(np.concatenate([r[keep] for r in self.residual.values()]))

    def to_dict(self) -> dict[str, Any]:
        """Numbers and names only, ready for JSON."""
        return {
            "model": self.name,
            "table": self.table.name,
            "unit": "standard deviation of single runs",
            "sigma": {QUANTITIES[q][0]: s for q, s in self.table.sigma.items()},
            "overall": self.overall,
            "rms": dict(self.rms),
            "worst": {q: w._asdict() for q, w in self.worst.items()},
            "unreached": self.unreached,
            "slip_ratio": self.table.test["slip_ratio"].tolist(),
            "slip_angle_deg": self.table.test["slip_angle_deg"].tolist(),
            "predicted": {QUANTITIES[q][0]: v.tolist() for q, v in self.predicted.items()},
            "measured": {QUANTITIES[q][0]: v.tolist() for q, v in self.table.measured.items()},
        }


def as_bed(model: WheelBed | Model | str | Sequence[Effect | str]) -> WheelBed:
    """The test bed of a model, of a preset by name, or of a list of effects at their nominal values."""
    if isinstance(model, WheelBed):
        return model
    if isinstance(model, str):
        return WheelBed.of_preset(model)
    return WheelBed(model) if isinstance(model, Sequence) else WheelBed.of_model(model)


def residuals(result: WheelResult, table: SteadyStateTable) -> dict[str, Any]:
    """Residuals (model less measurement) in sigma, by quantity."""
    return {q: (getattr(result, q) - v) / table.sigma[q] for q, v in table.measured.items()}


def compare(
    model: WheelBed | Model | str | Sequence[Effect | str], table: SteadyStateTable, name: str | None = None
) -> Comparison:
    """Repeats a table on a model's wheel, in float64.

    Args:
      model: a test bed, a model, a preset's name, or a list of effects.
      table: averaged over its replicates (`average`), so that it has their scatter.
      name: of the model, for reports.

    Raises:
      UserError: the table has no scatter to measure by.
    """
    # Written so that a scatter of NaN counts as missing, too.
    missing = [q for q in table.measured if not table.sigma.get(q, 0.0) > 0.0]
    if missing:
        raise UserError(
            f"{table.name}: no replicate scatter is known for {', '.join(missing)}; average a table that has "
            "replicates, or give sigma."
        )
    bed = as_bed(model)
    result = bed.run(table.wheel_test())
    residual = residuals(result, table)
    predicted = {q: np.asarray(getattr(result, q)) for q in table.measured}
    return Comparison(
        name=name or (model if isinstance(model, str) else "model"),
        table=table,
        predicted=predicted,
        residual=residual,
        rms={q: _rms(r) for q, r in residual.items()},
        overall=_rms(np.concatenate(list(residual.values()))),
        worst={q: _worst(table, q, predicted[q], r) for q, r in residual.items()},
        unreached=int((~np.asarray(result.reached)).sum()),
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2))) if len(values) else float("nan")


def _worst(table: SteadyStateTable, quantity: str, predicted: np.ndarray, residual: np.ndarray) -> Worst:
    # In sigma and not in newtons, so that the worst is where the model is most surely wrong.
    i = int(np.argmax(np.abs(residual)))
    slip, angle = (float(table.test[c][i]) for c in ("slip_ratio", "slip_angle_deg"))
    return Worst(slip, angle, float(table.measured[quantity][i]), float(predicted[i]), float(residual[i]))
