"""What a fit leaves open of a model's parameters: the table `[posterior]` of a `model.toml`."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.effects.base import Effect
from lunar_mjx.errors import bad_input, require_within
from lunar_mjx.toml_fields import Fields

_KEYS = ("parameters", "log", "std", "correlation")
_ROUNDING = 1e-6
"""By which a written correlation may miss symmetry, a diagonal of one, or the least eigenvalue of zero."""
LARGEST_STD = 1e15
"""Beyond any parameter's range, in SI units; single precision still holds its square."""


@dataclasses.dataclass(frozen=True, eq=False)
class Posterior:
    """A normal distribution of parameters about the values of the model that holds it.

    Attributes:
      parameters: `effect.parameter` of each. log: of each, whether its logarithm is normal: the value stays positive.
      std: (parameter,) standard deviation of the logarithm, or of the value in SI units.
      correlation: (parameter, parameter).
    """

    parameters: tuple[str, ...]
    log: tuple[bool, ...]
    std: np.ndarray
    correlation: np.ndarray

    @classmethod
    def of(cls, parameters: Sequence[str], log: Sequence[bool], covariance: np.ndarray) -> Posterior:
        """The posterior of a covariance (parameter, parameter) of logarithms, or of values where not `log`."""
        std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
        # What does not vary at all has no correlation with anything.
        size = np.where(std > 0.0, std, 1.0)
        correlation = np.asarray(covariance) / np.outer(size, size)
        np.fill_diagonal(correlation, 1.0)
        correlation = np.clip(0.5 * (correlation + correlation.T), -1.0, 1.0)
        return cls(tuple(parameters), tuple(map(bool, log)), std, correlation)

    @property
    def covariance(self) -> np.ndarray:
        """(parameter, parameter) covariance of logarithms, or of values in SI units where not `log`."""
        return self.correlation * np.outer(self.std, self.std)

    def factor(self) -> np.ndarray:
        """(parameter, parameter) F with F F' = covariance, for draws F z of standard normal z."""
        values, axes = np.linalg.eigh(self.correlation)
        # Rounding makes eigenvalues of what the fit ties together slightly negative.
        return self.std[:, None] * axes * np.sqrt(np.maximum(values, 0.0))

    def within(self, effects: Collection[str]) -> Posterior | None:
        """The marginal distribution of the parameters of some effects; None if it has none of them."""
        kept = [i for i, name in enumerate(self.parameters) if name.partition(".")[0] in effects]
        if not kept:
            return None
        names, log = tuple(self.parameters[i] for i in kept), tuple(self.log[i] for i in kept)
        return Posterior(names, log, self.std[kept], self.correlation[np.ix_(kept, kept)])

    def record(self) -> dict[str, Any]:
        """The table that `read_posterior` reads back."""
        return {
            "parameters": list(self.parameters),
            "log": list(self.log),
            "std": self.std.tolist(),
            "correlation": self.correlation.tolist(),
        }


def read_posterior(
    path: Path, table: Mapping[str, Any], effects: Sequence[Effect], values: Mapping[str, Mapping[str, Any]]
) -> Posterior:
    """The posterior of a file's table.

    Args:
      path: of the file. table: its `[posterior]`. effects: of the model. values: of their parameters.

    Raises:
      UserError: names the field that is missing, of another length, or no parameter or correlation.
    """
    fields = Fields(path, table, "posterior")
    fields.known(_KEYS)
    names, log = (table.get(key) for key in ("parameters", "log"))
    known = [f"{e.name}.{p}" for e in effects for p in e.parameters]
    if not isinstance(names, list) or not names:
        raise bad_input(path, "posterior.parameters", names, "is no list of names", 'write it like ["soil.k_phi"]')
    for name in names:
        if name not in known or names.count(name) > 1:
            problem = "stands there twice" if name in known else "is no parameter of the model's effects"
            raise bad_input(path, "posterior.parameters", name, problem, "write each as effect.parameter, once")
    if not isinstance(log, list) or len(log) != len(names) or not all(isinstance(b, bool) for b in log):
        raise bad_input(path, "posterior.log", log, f"is not a list of {len(names)}", "write [true, false, ...]")
    std = np.array(fields.vector("std", len(names)))
    for name, is_log, size in zip(names, log, std, strict=True):
        effect, _, parameter = name.partition(".")
        require_within(path, f"posterior.std of {name}", size, 0.0, LARGEST_STD)
        value = values[effect][parameter]
        # Found when the file is read: a draw would else be not a number, far from its cause.
        if is_log and np.min(value) <= 0.0:
            raise bad_input(
                path, f"effects.{name}", value, "has no logarithm, as [posterior] has it", "set log = false"
            )
    rows = table.get("correlation")
    if not isinstance(rows, list) or len(rows) != len(names):
        raise bad_input(path, "posterior.correlation", rows, f"is not {len(names)} rows", "write [[1.0, ...], ...]")
    whole = np.array(
        [Fields(path, {"correlation": row}, "posterior").vector("correlation", len(names)) for row in rows]
    )
    # The least eigenvalue may miss zero by the rounding of every row, so that its tolerance grows with their number.
    off = max(np.abs(whole - whole.T).max(), np.abs(np.diag(whole) - 1.0).max())
    if off > _ROUNDING or np.linalg.eigvalsh(0.5 * (whole + whole.T))[0] < -_ROUNDING * len(names):
        remedy = "give a symmetric matrix with ones on its diagonal and no negative eigenvalue"
        raise bad_input(path, "posterior.correlation", rows, "is no matrix of correlations", remedy)
    return Posterior(tuple(names), tuple(log), std, whole)
