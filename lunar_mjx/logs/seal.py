"""Sealed logs: the log carries a commitment to the answer, the sender keeps the answer, and both are compared later."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pandas as pd
import tomli_w
from pydantic import BaseModel, ConfigDict, ValidationError, create_model

from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.errors import UserError, bad_input, one_line, require_file
from lunar_mjx.files import no_key_twice, write_text
from lunar_mjx.logs.log import Log
from lunar_mjx.logs.readers.folder import ANSWER, LOG_FILE, read_log
from lunar_mjx.toml_fields import Fields

FORMAT = "lunar-mjx-answer/2"
PREFIX = "sha256:"


@dataclasses.dataclass(frozen=True)
class Answer:
    """What is hidden in a simulated log.

    Attributes:
      log: name of its folder. nonce: 256 random bits in hexadecimal, without which no answer can be tried out.
      seed: of the noise. preset, manoeuvre, scale: what was driven with what.
      effects: name, whether it was added, and parameters of each hidden effect.
      recording: noise, biases and losses.
      data_sha256: of the tables, so that neither side can change them.
      log_sha256: of what `log.toml` says beside its commitment: another gravity or start is another drive.
    """

    log: str
    nonce: str
    seed: int
    preset: str
    manoeuvre: str
    scale: float
    effects: Sequence[Mapping[str, Any]]
    recording: Mapping[str, Any]
    data_sha256: str
    log_sha256: str

    def commitment(self) -> str:
        """SHA-256 of everything above, in one canonical spelling."""
        return PREFIX + _hash(dataclasses.asdict(self))

    @property
    def hidden(self) -> tuple[str, ...]:
        """Names of the effects that the model lacks."""
        return tuple(e["name"] for e in self.effects if e["added"])


def _hash(content: Mapping[str, Any]) -> str:
    """SHA-256 of some content in one spelling, which does not depend on the order of keys."""
    return hashlib.sha256(json.dumps(content, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def answer_path(out: Path) -> Path:
    """Where the answer to the log `out` is kept: beside it, never in it."""
    return out.with_name(out.name + ANSWER)


def write_answer(answer: Answer, path: Path) -> None:
    """Writes an answer, which `read_answer` reads back."""
    write_text(path, tomli_w.dumps({"format": FORMAT, **dataclasses.asdict(answer)}))


class _Hidden(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True)
    name: str
    added: bool
    parameters: dict[str, Any]


_KINDS: dict[str, Any] = {name: (kind, ...) for name, kind in get_type_hints(Answer).items()}
_KINDS |= {"effects": (list[_Hidden], ...)}
_Answer: type[BaseModel] = create_model("_Answer", __config__=ConfigDict(strict=True), **_KINDS)
"""Checks the kinds of an answer's fields; what is hashed is the file's own content, which nothing converts."""


def read_answer(path: str | Path) -> Answer:
    """Reads an answer.

    Raises:
      UserError: the file is missing, is no answer, or lacks a field.
    """
    top = Fields.read(Path(path), "the answer")
    names = [f.name for f in dataclasses.fields(Answer)]
    top.known(("format", *names))
    if top.text("format", "") != FORMAT:
        raise bad_input(
            path, "format", top.values.get("format"), "is no answer", f'give a file with format = "{FORMAT}"'
        )
    for name in names:
        if name not in top.values:
            raise bad_input(path, name, None, "is missing", "give the answer as log simulate wrote it")
    given = {n: top.values[n] for n in names}
    try:
        _Answer.model_validate(given)
        answer = Answer(**given)
        answer.commitment()
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        problem = f"is not what an answer holds there ({first['msg'].lower()})"
        raise bad_input(path, field, first["input"], problem, "give the answer as log simulate wrote it") from None
    except TypeError as error:  # dates, which JSON does not know
        raise UserError(f"{path}: {one_line(error)}; give the answer as log simulate wrote it.") from None
    return answer


def hash_tables(tables: Mapping[str, pd.DataFrame]) -> str:
    """SHA-256 over the names and values of all tables, as a log file holds them (nine digits)."""
    digest = hashlib.sha256()
    # In a fixed order, whatever order the tables were written in.
    for name in sorted(tables):
        frame = tables[name]
        digest.update(name.encode())
        for column in frame.columns:
            digest.update(str(column).encode())
            # As text of nine digits, since that is what comes back from a CSV.
            digest.update(",".join(f"{v:.9g}" for v in np.asarray(frame[column], float)).encode())
    return digest.hexdigest()


def log_hash(log: Log) -> str:
    """Hash of a log that was read, equal to `hash_tables` of the tables that it was written from."""
    frames = {
        name: pd.DataFrame({"time_s": t.time_s, **{t.columns.get(c, c): v for c, v in t.channels.items()}})
        for name, t in log.tables.items()
    }
    return hash_tables(frames)


def hash_settings(folder: Path) -> str:
    """SHA-256 over what a log's `log.toml` says, but for its commitment, in which the hash itself is hidden."""
    said = {k: v for k, v in Fields.read(folder / LOG_FILE).values.items() if k != "commitment"}
    # As text, since TOML has dates and times, which JSON does not know.
    return _hash(json.loads(json.dumps(said, default=str)))


def commit(folder: Path, answer: Answer) -> Answer:
    """The answer with the hash of a log's settings; the log gets the commitment to it."""
    answer = dataclasses.replace(answer, log_sha256=hash_settings(folder))
    said = Fields.read(folder / LOG_FILE).values
    write_text(folder / LOG_FILE, tomli_w.dumps({**said, "commitment": answer.commitment()}))
    return answer


def unseal(answer: str | Path, log: str | Path, verdict: str | Path | None = None) -> dict[str, Any]:
    """Opens an answer: is it the one that the log was sealed with, and did the colleague find it?

    Args:
      answer: file that the sender kept.
      log: folder of the log.
      verdict: the colleague's verdict.json, or the folder that holds it.

    Returns:
      `hidden` (names), `effects` (with parameters), and with a verdict its label, effects and `score`: right, class
      (within the named class), missed, false alarm or wrong.

    Raises:
      UserError: the log is not sealed, or not with this answer, these tables and this `log.toml`.
    """
    given, sealed = read_answer(answer), read_log(log)
    path = Path(log) / LOG_FILE
    committed = Fields.read(path).text("commitment", "")
    if not committed:
        raise UserError(f"{path}: commitment is missing; this log was not sealed.")
    if committed != given.commitment():
        raise UserError(f"{answer}: is not the answer that {log} was sealed with; ask its sender for the right file.")
    if not isinstance(sealed, Log) or log_hash(sealed) != given.data_sha256:
        raise UserError(f"{log}: its tables were changed after it was sealed; ask its sender for the log.")
    if hash_settings(Path(log)) != given.log_sha256:
        raise UserError(f"{path}: was changed after the log was sealed; ask its sender for the log.")
    result: dict[str, Any] = {"sealed": True, "hidden": list(given.hidden), "effects": [dict(e) for e in given.effects]}
    if verdict is not None:
        label, effects = read_verdict(verdict)
        result |= {"verdict": label, "named": effects, "score": score(given, label, effects)}
    return result


LABELS = {
    "NOISE_ONLY": False,
    "BAD_DATA": False,
    "BAD_FIT": False,
    "KNOWN": True,
    "KNOWN_CLASS": True,
    "MULTIPLE": True,
    "UNKNOWN": False,
    "UNDECIDABLE": False,
}
"""Labels of verdicts, and whether they name effects."""


def read_verdict(path: str | Path) -> tuple[str, list[str]]:
    """Label and effects of a `verdict.json`.

    Raises:
      UserError: the file is missing, holds no verdict, or one of an unknown label or of a name without an effect.
    """
    path = Path(path) / "verdict.json" if Path(path).is_dir() else Path(path)
    require_file(path, "the verdict")
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"), object_pairs_hook=no_key_twice)
        label, effects = data["verdict"], data.get("effects", [])
        # A text would be taken for its letters, and score as a wrong answer.
        if not isinstance(label, str) or not isinstance(effects, list) or not all(isinstance(e, str) for e in effects):
            raise TypeError("verdict and effects are a text and a list of texts")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f'{path}: is no verdict ({one_line(error)[:150]}); give a JSON file with "verdict" and "effects".'
        ) from None
    if label not in LABELS:
        raise bad_input(path, "verdict", label, "is no verdict", f"give one of {', '.join(LABELS)}")
    if LABELS[label] and not effects:
        raise bad_input(path, "effects", effects, f"are none, and {label} names some", "give the verdict as it was")
    return label, effects


def score(answer: Answer, label: str, effects: Sequence[str]) -> str:
    """How a verdict stands to the answer; a changed parameter of the model's own effects counts as nothing hidden."""
    hidden, named = set(answer.hidden), set(effects)
    if label == "NOISE_ONLY":
        return "missed" if hidden else "right"
    if label in ("BAD_DATA", "BAD_FIT", "UNDECIDABLE"):
        return "missed" if hidden else "wrong"
    if not hidden:
        return "false alarm"
    if label == "UNKNOWN":
        return "right" if any(name not in CATALOGUE for name in hidden) else "missed"
    if label == "KNOWN_CLASS":
        return "class" if hidden <= named else "wrong"
    return "right" if hidden == named else "wrong"
