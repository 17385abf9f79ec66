"""Reads run folders for the report: whatever has been written so far, without the logs themselves."""

from __future__ import annotations

import dataclasses
import functools
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.folder.stored import read_arrays, read_stored
from lunar_mjx.diagnosis.runs import (
    AUDIT_FILE,
    COMPARISON_FILE,
    FORMAT,
    MODEL_FILE,
    NEXT_FILE,
    RUN_FILE,
    SERIES_FILE,
    SIGNATURES_FILE,
    UNKNOWN_FILE,
    VERDICT_FILE,
)
from lunar_mjx.errors import UserError, bad_input, one_line, require_file
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.model import Model
from lunar_mjx.model.file import load_model
from lunar_mjx.trust import trusting


@dataclasses.dataclass(frozen=True, eq=False)
class Traces:
    """Measurements and predictions of one run.

    Attributes:
      observations: the measurements with their noise taken as white (enough for blocks and places).
      labels: names of the models, in the order of fitting.
      predicted: (models, n), in the channels' units.
      residual: (models, n), measured less predicted, in sigma, as errors are told.
      whitened: (models, n), the same as signatures are.
      time: (n,) s, NaN for points of tables.
    """

    observations: Observations
    labels: tuple[str, ...]
    predicted: np.ndarray
    residual: np.ndarray
    time: np.ndarray
    whitened: np.ndarray

    @property
    def channel(self) -> np.ndarray:
        """(n,) number of each observation's channel among `channels`."""
        names = self.channels
        out = np.empty(len(self.observations), int)
        for s in self.observations.series:
            out[s.start : s.stop] = names.index(s.channel)
        return out

    @property
    def channels(self) -> list[str]:
        """Names of the channels, in the order of the logs."""
        return list(dict.fromkeys(s.channel for s in self.observations.series))

    @property
    def is_table(self) -> bool:
        """Whether these are points of steady-state tables."""
        return self.observations.place is not None


@dataclasses.dataclass(frozen=True, eq=False)
class Result:
    """What a run folder holds.

    Attributes:
      name: of the folder. run: contents of `run.json`.
      comparison, verdict, audit, unknown, next: contents of the other files, None where not written.
      traces: measurements and predictions, None where not written.
      signatures: whitened signature of each effect that was scored, over the fitted observations, in sigma.
      folder: where it lies; None for one made in memory.
    """

    name: str
    run: dict[str, Any]
    comparison: dict[str, Any] | None
    verdict: dict[str, Any] | None
    audit: dict[str, Any] | None
    unknown: dict[str, Any] | None
    next: dict[str, Any] | None
    traces: Traces | None
    signatures: dict[str, np.ndarray]
    folder: Path | None = None

    @property
    def path(self) -> Path:
        """The folder as it was given, which commands have to be given again; its name for one made in memory."""
        return self.folder or Path(self.name)

    @property
    def taken_back(self) -> list[dict[str, Any]]:
        """Contact laws that `improve` has taken back by then: `law`, and a `sentence` that says why, among others."""
        return ((self.verdict or {}).get("details") or {}).get("taken_back") or []

    @functools.cached_property
    def model(self) -> Model | None:
        """The model that was compared; None where it cannot be loaded any more, such as without a user's effect."""
        if self.folder is None or not (self.folder / MODEL_FILE).is_file():
            return None
        try:
            with trusting(False):  # a report runs nobody's code
                return load_model(self.folder / MODEL_FILE)
        except UserError:
            return None


def read_result(folder: Path) -> Result:
    """Reads a run folder.

    Raises:
      UserError: it is none, or one of its files is damaged.
    """
    path = require_file(folder / RUN_FILE, "the run (made by `lunar-mjx compare`)")
    run = read_stored(path)
    if run is None or run.get("format") != FORMAT:
        raise bad_input(path, "format", (run or {}).get("format"), "is not known", f"give a run of format {FORMAT}")
    # A run grows from verb to verb: what has not been asked yet is no mistake.
    names = (COMPARISON_FILE, VERDICT_FILE, AUDIT_FILE, UNKNOWN_FILE, NEXT_FILE)
    comparison, verdict, audit, unknown, following = (read_stored(folder / name) for name in names)
    traces, signatures = _traces(folder / SERIES_FILE), _signatures(folder / SIGNATURES_FILE)
    return Result(
        folder.resolve().name, run, comparison, verdict, audit, unknown, following, traces, signatures, folder
    )


def require_whole(result: Result) -> None:
    """Refuses a run of which only a part was copied: one comparison writes all that is looked for here.

    Raises:
      UserError: one of its files is missing, or the model's is torn.
    """
    folder = result.path
    model = folder / MODEL_FILE
    there = {COMPARISON_FILE: result.comparison is not None, SERIES_FILE: result.traces is not None}
    found = [name for name, given in there.items() if given]
    lacking = [name for name, given in {**there, MODEL_FILE: model.is_file()}.items() if not given]
    remedy = "copy the whole folder of the run, or make it anew with lunar-mjx compare"
    if found and lacking:
        raise UserError(f"{folder / lacking[0]}: is missing beside {found[0]}; {remedy}.")
    if model.is_file():
        try:
            tomllib.loads(model.read_text(encoding="utf-8-sig"))
        except ValueError as error:  # an effect that is not here is no damage, a torn file is
            raise UserError(f"{model}: is damaged ({one_line(error)[:150]}); {remedy}.") from None


def _signatures(path: Path) -> dict[str, np.ndarray]:
    arrays = read_arrays(path)
    if not arrays:
        return {}
    try:
        return dict(zip(map(str, arrays["names"]), arrays["signatures"], strict=True))
    except (KeyError, ValueError, TypeError) as error:
        raise UserError(f"{path}: is damaged ({error}); make it anew with lunar-mjx why.") from None


def _traces(path: Path) -> Traces | None:
    arrays = read_arrays(path)
    if not arrays:
        return None
    try:
        _check_shapes(arrays)
        # Series lie one behind the other: where the next begins the last one ends.
        starts = [*arrays["series_start"].tolist(), len(arrays["measured"])]
        # Points of tables follow no clock: their time is stored as NaN.
        independent = np.isnan(arrays["time"])
        series = []
        for i, (channel, log) in enumerate(zip(arrays["series_channel"], arrays["series_log"], strict=True)):
            a, b = starts[i], starts[i + 1]
            time = None if b > a and independent[a] else arrays["time"][a:b]
            series.append(Series(int(log), str(channel), a, b, time, arrays["sigma"][a:b]))
        observations = Observations(
            value=arrays["measured"],
            series=tuple(series),
            logs=tuple(map(str, arrays["logs"])),
            split=(),
            unit=arrays["unit"],
            unit_split=tuple(map(str, arrays["split"])),
            unit_names=tuple(map(str, arrays["unit_names"])),
            place=arrays["place"] if len(arrays["place"]) else None,
        )
        labels = tuple(map(str, arrays["labels"]))
        residual = arrays["residual"]
        whitened = arrays.get("whitened", residual)
        return Traces(observations, labels, arrays["predicted"], residual, arrays["time"], whitened)
    except KeyError as error:
        raise UserError(f"{path}: lacks {error}; make it anew with lunar-mjx compare.") from None
    except (ValueError, TypeError, IndexError) as error:
        raise UserError(f"{path}: is damaged ({error}); make it anew with lunar-mjx compare.") from None


def _check_shapes(found: Mapping[str, np.ndarray]) -> None:
    """Raises `ValueError` for arrays that do not go with the measurements."""
    n, models = len(found["measured"]), len(found["labels"])
    shapes = {
        "measured": (n,),
        "sigma": (n,),
        "time": (n,),
        "unit": (n,),
        "predicted": (models, n),
        "residual": (models, n),
        "place": (n if len(found["place"]) else 0, 3),
    }
    if "whitened" in found:
        shapes["whitened"] = (models, n)
    for name, shape in shapes.items():
        # Text in place of numbers would pass as an array and end a report with a traceback.
        if found[name].shape != shape or found[name].dtype.kind not in "fiu":
            raise ValueError(f"{name} is {found[name].dtype} of shape {found[name].shape}, not numbers of {shape}")
    start, units = found["series_start"], found["unit"]
    if start.ndim != 1 or (np.diff(start) < 0).any() or (len(start) and not 0 <= start[0] <= start[-1] <= n):
        raise ValueError("series_start does not rise within the measurements")
    if n and not (units.min() >= 0 and units.max() < len(found["unit_names"]) == len(found["split"])):
        raise ValueError("unit names no manoeuvre")
