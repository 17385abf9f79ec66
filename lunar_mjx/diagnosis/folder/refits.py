"""What each set of effects that was refitted leaves of the error, kept in a run folder for whoever looks at it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lunar_mjx.diagnosis.folder.stored import read_arrays
from lunar_mjx.errors import UserError
from lunar_mjx.files import replacing

REFITS_FILE = "refits.npz"
_BETWEEN = " + "


class Left(NamedTuple):
    """What a refit leaves.

    Attributes:
      residual: (n,) whitened, in sigma. predicted: (n,) in the channels' units, NaN where it was not kept.
    """

    residual: np.ndarray
    predicted: np.ndarray


def write_refits(folder: Path, found: Mapping[Sequence[str], tuple[np.ndarray, np.ndarray | None]]) -> None:
    """Writes `refits.npz` (arrays only, no pickle).

    Args:
      folder: of the run.
      found: whitened residuals (n,) and predictions (n,), None where not known, over the observations of
        `series.npz`, by names of the effects that were refitted together.
    """
    if not found:
        return
    names = [_BETWEEN.join(sorted(effects)) for effects in found]
    # Single precision: seven digits are more than any page shows.
    residual = np.array([r for r, _ in found.values()], np.float32)
    predicted = [np.full(len(r), np.nan) if p is None else p for r, p in found.values()]
    with replacing(folder / REFITS_FILE) as part:
        np.savez_compressed(part, names=np.array(names, str), residual=residual, predicted=np.array(predicted))


def read_refits(folder: Path, count: int) -> dict[tuple[str, ...], Left]:
    """Refits by names of their effects; none where the file is not there, or is of other observations.

    Args:
      folder: of the run. count: observations of its series.

    Raises:
      UserError: the file is damaged.
    """
    path = folder / REFITS_FILE
    stored = read_arrays(path)
    if not stored:
        return {}
    if missing := {"names", "residual", "predicted"} - set(stored):
        raise UserError(f"{path}: lacks {min(missing)}; make it anew with lunar-mjx studio.")
    shape = (len(np.atleast_1d(stored["names"])), count)
    arrays = [stored["residual"], stored["predicted"]]
    if any(a.dtype.kind != "f" or a.ndim != 2 for a in arrays):
        raise UserError(f"{path}: its arrays are no tables of numbers; make it anew with lunar-mjx studio.")
    # Of a comparison before the present one: out of date, and nothing is broken.
    if any(a.shape != shape for a in arrays):
        return {}
    names = [tuple(str(name).split(_BETWEEN)) for name in stored["names"]]
    return {name: Left(*(np.asarray(a[i], float) for a in arrays)) for i, name in enumerate(names)}
