"""A run folder: which logs, which model, and what was found so far, on disk as plain JSON and TOML."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lunar_mjx._version import __version__
from lunar_mjx.diagnosis.folder.refits import REFITS_FILE
from lunar_mjx.diagnosis.folder.stored import read_stored
from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.files import write_text
from lunar_mjx.logs import Finding, Log, SteadyLog, check, read_campaign
from lunar_mjx.logs.readers.folder import without_answers
from lunar_mjx.model import Model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.trust import require_trust

FORMAT = "lunar-mjx-run/1"
RUN_FILE, MODEL_FILE = "run.json", "model.toml"
FITTED_FILE = "fitted.toml"
"""The model as refitted with its posterior and, where wheel speeds are imposed, what was learnt as priors."""
COMPARISON_FILE, VERDICT_FILE, SERIES_FILE = "comparison.json", "verdict.json", "series.npz"
SIGNATURES_FILE, HYPOTHESES_FILE = "signatures.npz", "hypotheses.json"
AUDIT_FILE, UNKNOWN_FILE, NEXT_FILE = "audit.json", "unknown.json", "next.json"
WINDOWS_FILE, RESTLESS_FILE = "windows.json", "watch.json"
PAGES = ("report.html", "studio.html")
FOUND = (
    *(COMPARISON_FILE, VERDICT_FILE, SERIES_FILE, SIGNATURES_FILE, HYPOTHESES_FILE, REFITS_FILE),
    *(AUDIT_FILE, UNKNOWN_FILE, NEXT_FILE, WINDOWS_FILE, RESTLESS_FILE, FITTED_FILE, *PAGES),
)
"""What verbs find of one comparison; none of it is about another."""


@dataclasses.dataclass(frozen=True, eq=False)
class Run:
    """A run folder.

    Attributes:
      folder: where it lies. logs: paths of the log folders. model: the model as compared.
      candidates: effects from the user's own files, as file.py:name. splits: chosen by the user, by log or group.
      added: effects added since the first run. parent: folder of the run that this one grew from.
      seed: of all random starts. discrepancy: known unexplained error by quantity, added to the noise.
      settings: sizes, priors and effort of a diagnosis of tables, by name, where they are not the usual ones.
    """

    folder: Path
    logs: tuple[Path, ...]
    model: Model
    candidates: tuple[str, ...] = ()
    splits: Mapping[str, str] = dataclasses.field(default_factory=dict)
    added: tuple[str, ...] = ()
    parent: str | None = None
    seed: int = 0
    discrepancy: Mapping[str, float] = dataclasses.field(default_factory=dict)
    settings: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def campaign(self) -> list[Log] | list[SteadyLog]:
        """The logs, all of one kind.

        Raises:
          UserError: drive logs and steady-state tables together.
        """
        logs = read_campaign(self.logs)
        drives = [log for log in logs if isinstance(log, Log)]
        tables = [log for log in logs if isinstance(log, SteadyLog)]
        if drives and tables:
            raise UserError(
                f"{self.logs[0]}: drive logs and steady-state tables do not go into one run; compare them in two."
            )
        return drives or tables

    @functools.cached_property
    def checked(self) -> tuple[list[Log] | list[SteadyLog], list[Finding]]:
        """The logs and what the gate finds in them, read once.

        Raises:
          UserError: as `campaign`.
        """
        logs = self.campaign()
        return logs, check(logs)

    def write(self) -> None:
        """Writes `run.json` and `model.toml` in place of an earlier comparison, of which nothing that was found stays.

        Earlier looks at the test split stay on record.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        opened = (self.load(RUN_FILE) or {}).get("test_opened", [])
        save_model(self.model, self.folder / MODEL_FILE)
        save_json(
            self.folder / RUN_FILE,
            {
                "format": FORMAT,
                "version": __version__,
                "logs": [str(p) for p in self.logs],
                "hashes": {str(p): folder_hash(p) for p in self.logs},
                "candidates": list(self.candidates),
                "splits": dict(self.splits),
                "added": list(self.added),
                "parent": self.parent,
                "seed": self.seed,
                "discrepancy": dict(self.discrepancy),
                "settings": dict(self.settings),
                "test_opened": opened,
            },
        )
        # last, so that a full disk keeps what was found before
        for name in FOUND:
            (self.folder / name).unlink(missing_ok=True)

    def opened_test(self, verb: str, models: Mapping[str, str]) -> None:
        """Puts on record that the error on the test split was computed.

        Args:
          verb: by which command.
          models: fingerprint of the fit by the model's label; the same fit looked at again is no new opening.
        """
        data = self.load(RUN_FILE)
        data["test_opened"] = [
            *data.get("test_opened", []),
            *({"verb": verb, "model": m, "fit": f} for m, f in models.items()),
        ]
        self.save(RUN_FILE, data)

    def load(self, name: str) -> Any:
        """Contents of one of the run's JSON files; None if it has not been written yet."""
        return read_stored(self.folder / name)

    def save(self, name: str, content: Any) -> None:
        """Writes one of the run's JSON files."""
        save_json(self.folder / name, content)


def load_run(folder: str | Path) -> Run:
    """Reads a run folder.

    Raises:
      UserError: it is none, is of another version, or its logs have changed or gone.
    """
    folder = Path(folder)
    path = require_file(folder / RUN_FILE, "the run (made by `lunar-mjx compare`)")
    data = read_stored(path)
    assert data is not None
    if data["format"] != FORMAT:
        raise bad_input(path, "format", data["format"], "is not known", f"give a run of format {FORMAT}")
    logs, hashes = tuple(Path(p) for p in data["logs"]), data["hashes"]
    for log in logs:
        if not log.exists():
            raise bad_input(path, "logs", str(log), "is missing", "put the log back, or compare anew")
        # What was found belongs to the very bytes that were compared.
        if folder_hash(log) != hashes.get(str(log)):
            raise bad_input(path, "logs", str(log), "has changed since the comparison", "compare anew")
    # A run that was received names files of code, which the next verbs would run.
    for candidate in data.get("candidates", ()):
        require_trust(path, "candidates", candidate)
    model = load_model(folder / MODEL_FILE)
    return Run(
        folder,
        logs,
        model,
        tuple(data.get("candidates", ())),
        data.get("splits", {}),
        tuple(data.get("added", ())),
        data.get("parent"),
        data.get("seed", 0),
        data.get("discrepancy", {}),
        data.get("settings", {}),
    )


def log_folders(paths: Sequence[str | Path]) -> tuple[Path, ...]:
    """Absolute paths of the logs, as given, without answers to sealed ones.

    Raises:
      UserError: none is given, or one does not exist.
    """
    paths = without_answers(paths)
    if not paths:
        raise UserError("compare: no log is given; give at least one log folder.")
    # Absolute, since a run is read from other folders than the one in which it was made.
    folders = tuple(Path(p).resolve() for p in paths)
    for path in folders:
        if not path.exists():
            raise bad_input("compare", "log", str(path), "does not exist", "give a log folder")
    return folders


def folder_hash(path: Path) -> str:
    """SHA-256 over names and contents of a log's files."""
    digest = hashlib.sha256()
    files = [path] if path.is_file() else sorted(p for p in path.rglob("*") if p.is_file())
    for file in files:
        # Relative names with forward slashes: a log that is moved, or read on another system, stays the same log.
        digest.update(file.relative_to(path).as_posix().encode() if path.is_dir() else file.name.encode())
        # The digest of each file has one length, so that no byte can pass from one file's end to the next one's name.
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def save_json(path: Path, content: Any) -> None:
    """Writes JSON without NaN (null instead), whole or not at all."""
    text = json.dumps(plain(content), indent=1, allow_nan=False)
    write_text(path, text + "\n")


def plain(value: Any) -> Any:
    """A value as JSON takes it: lists, numbers, names, and None for what is not finite."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value
