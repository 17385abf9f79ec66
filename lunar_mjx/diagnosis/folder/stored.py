"""What is read back from a run folder, held against schemas: a damaged file is one sentence, never a traceback.

Fits are a cache: they are dropped where they are damaged, saying so, and made anew.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from lunar_mjx.errors import UserError, no_archive
from lunar_mjx.files import no_key_twice

Number = Annotated[float, Field(allow_inf_nan=False)]
Split = Literal["fit", "select", "test", "apart"]


class _Stored(BaseModel):
    """Fields that are read; what else stands there is for the reader of the file."""

    # Strict: a text where a number belongs is damage, and nothing to be converted.
    model_config = ConfigDict(extra="allow", strict=True)


class _Run(_Stored):
    format: str
    version: str = ""
    logs: list[str]
    hashes: dict[str, str]
    candidates: list[str] = []
    splits: dict[str, Split] = {}
    added: list[str] = []
    parent: str | None = None
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    discrepancy: dict[str, Annotated[float, Field(ge=0, allow_inf_nan=False)]] = {}
    settings: dict[str, Any] = {}
    test_opened: list[dict[str, Any]] = []


class _Channel(_Stored):
    manoeuvre: str
    split: str
    channel: str
    as_given: Number | None
    refitted: Number | None


class _Certificate(_Stored):
    problems: list[str]


class _Comparison(_Stored):
    as_given: dict[str, Number | None]
    refitted: dict[str, Number | None]
    by_channel: list[_Channel]
    certificate: _Certificate | None = None
    parameters: dict[str, dict[str, dict[str, Any] | None]] | None = None
    # Of drives alone, where `why` goes on from them.
    channel_errors: dict[str, Number] = {}
    error_times_s: dict[str, Number] = {}


class _Evidence(_Stored):
    effect: str
    status: str
    separable_sigma: Number | None = None
    z: Number | None = None
    values: dict[str, Any] = {}
    std: dict[str, Any] = {}


class _Remains(_Stored):
    text: str
    low: Number
    high: Number


class _TakenBack(_Stored):
    law: str
    run: str
    sentence: str


class _Details(_Stored):
    held_out: dict[str, Any] | None = None
    parameters: dict[str, dict[str, dict[str, Any] | None]] | None = None
    findings: list[dict[str, Any]] | None = None
    taken_back: list[_TakenBack] | None = None


class _Verdict(_Stored):
    verdict: str
    sentence: str
    effects: list[str]
    evidence: list[_Evidence] = []
    details: _Details | None = None
    probabilities: dict[str, Number] | None = None
    inclusion: dict[str, Number | None] | None = None
    forms: dict[str, Number] | None = None
    discrepancy: dict[str, _Remains] | None = None


class _Refit(_Stored):
    u: dict[str, Number]


class _Window(_Stored):
    log: str
    start_s: Number
    split: Split


class _Windows(_Stored):
    window_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    interval_s: Annotated[float, Field(gt=0, allow_inf_nan=False)]
    used: list[_Window]


_SCHEMAS: dict[str, TypeAdapter[Any]] = {
    "run.json": TypeAdapter(_Run),
    "comparison.json": TypeAdapter(_Comparison),
    "verdict.json": TypeAdapter(_Verdict),
    "hypotheses.json": TypeAdapter(dict[str, _Refit]),
    "windows.json": TypeAdapter(_Windows),
}
_ANY: TypeAdapter[Any] = TypeAdapter(dict[str, Any])


def read_stored(path: Path) -> dict[str, Any] | None:
    """Contents of a JSON file of a run folder; None if it is not there.

    Raises:
      UserError: it is no JSON, or a field is missing or of another kind.
    """
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=no_key_twice)
        _SCHEMAS.get(path.name, _ANY).validate_python(content)
    except (ValueError, RecursionError) as error:  # ValidationError, JSONDecodeError and UnicodeDecodeError are such
        raise UserError(
            f"{path}: is damaged ({_told(error)}); make it anew with lunar-mjx {_MAKERS.get(path.name, 'compare')}."
        ) from None
    return content


_MAKERS = {"verdict.json": "why", "hypotheses.json": "compare", "audit.json": "why --audit", "next.json": "next"}


def _told(error: Exception) -> str:
    """A validation's first problem in a few words."""
    if isinstance(error, ValidationError):
        first = error.errors(include_url=False, include_input=False)[0]
        field = ".".join(map(str, first["loc"])) or "the whole"
        return f"{field}: {first['msg'].lower()}"
    return " ".join(str(error).split())[:150] or type(error).__name__


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """Arrays of an `.npz` file without pickles; none if it is not there.

    Raises:
      UserError: it cannot be read.
    """
    if not path.is_file():
        return {}
    try:
        # NumPy leaves a file open that is no archive
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except Exception as error:  # zip archives, their compression and NumPy's headers raise a dozen kinds
        raise UserError(
            f"{path}: is damaged ({no_archive(error)[:150]}); make it anew with lunar-mjx compare or why."
        ) from None
