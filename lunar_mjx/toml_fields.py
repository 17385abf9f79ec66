"""A table of a TOML file whose values are taken by name and kind; every mistake names the file and the field."""

from __future__ import annotations

import dataclasses
import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lunar_mjx.errors import UserError, bad_input, require_file, require_finite

LONGEST_KEY = 200
"""Characters of a key: a longer one is an accident, and no message could show it."""


def read_toml(path: Path) -> dict[str, Any]:
    """Contents of a TOML file in UTF-8, with or without a byte order mark.

    Raises:
      UserError: it is no text, or not TOML.
    """
    try:
        # Editors of Windows write a byte order mark, which TOML does not know.
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except UnicodeDecodeError:
        raise UserError(f"{path}: is not a text file in UTF-8; give a TOML file.") from None
    except RecursionError:
        raise UserError(f"{path}: is not valid TOML (nested too deeply); mend the file.") from None
    except ValueError as error:  # tomllib.TOMLDecodeError, and numbers of thousands of digits
        reason = str(error)
        # The parser quotes what it met, which may be a whole binary file.
        shown = reason if len(reason) <= 200 else f"{reason[:100]} ... {reason[-60:]}"
        raise UserError(f"{path}: is not valid TOML ({shown}); mend that line.") from None
    _short_keys(path, document)
    return document


def _short_keys(path: Path, value: Any) -> None:
    for inner in value.values() if isinstance(value, dict) else value:
        if isinstance(inner, dict | list):
            _short_keys(path, inner)
    for key in value if isinstance(value, dict) else ():
        if len(key) > LONGEST_KEY:
            raise bad_input(path, "a key", key[:40] + "...", f"has {len(key)} characters", "give a name of fewer")


@dataclasses.dataclass(frozen=True)
class Fields:
    """A table and where it stands: `path` the file, `prefix` such as "tables.drive"."""

    path: Path
    values: Mapping[str, Any]
    prefix: str = ""

    @classmethod
    def read(cls, path: Path, what: str = "the file") -> Fields:
        """The whole of a TOML file.

        Raises:
          UserError: the file is missing or is not TOML.
        """
        return cls(path, read_toml(require_file(path, what)))

    def field(self, key: str) -> str:
        """Name of a key with the tables that it stands in, as messages show it."""
        return f"{self.prefix}.{key}" if self.prefix else key

    def known(self, keys: Sequence[str]) -> None:
        """Refuses keys that are not in `keys`."""
        for key, value in self.values.items():
            if key not in keys:
                raise bad_input(self.path, self.field(key), value, "is an unknown key", f"use one of {', '.join(keys)}")

    def table(self, key: str) -> Fields:
        """A table within; empty if it is not there."""
        # A table that is left out is an empty one, whose required keys then are missing.
        value = self.values.get(key, {})
        if not isinstance(value, Mapping):
            raise bad_input(self.path, self.field(key), value, "is not a table", f"write it as [{self.field(key)}]")
        return Fields(self.path, value, self.field(key))

    def tables(self, key: str, name: str = "") -> list[Fields]:
        """The tables of an array, each with its place counted from one as `name`; empty if it is not there."""
        values = self.values.get(key, [])
        if not isinstance(values, list) or not all(isinstance(v, Mapping) for v in values):
            raise bad_input(self.path, self.field(key), values, "is no list of tables", f"write [[{self.field(key)}]]")
        return [Fields(self.path, v, f"{name or self.field(key)} {i + 1}") for i, v in enumerate(values)]

    def texts(self, key: str) -> tuple[str, ...]:
        """A list of texts; empty if it is not there."""
        values = self.values.get(key, [])
        if not isinstance(values, list) or not all(isinstance(v, str) for v in values):
            raise bad_input(self.path, self.field(key), values, "is no list of texts", 'write ["one", "another"]')
        return tuple(values)

    def text(self, key: str, default: str | None = None) -> str:
        """A text, which must be there if there is no default."""
        value = self.values.get(key, default)
        if not isinstance(value, str) or (default is None and not value):
            raise bad_input(self.path, self.field(key), value, "is not a text", "give a name in quotes")
        return value

    def choice(self, key: str, choices: Sequence[str]) -> str | None:
        """One of `choices`, or None if it is not there."""
        if key not in self.values:
            return None
        value = self.text(key)
        if value not in choices:
            raise bad_input(self.path, self.field(key), value, "does not exist", f"use one of {', '.join(choices)}")
        return value

    def number(self, key: str, default: float | None = None) -> float:
        """A finite number, which must be there if there is no default."""
        return self._finite(self.field(key), self.values.get(key, default))

    def positive(self, key: str, default: float | None = None, most: float = math.inf) -> float:
        """A positive finite number, `most` at most."""
        value = self.number(key, default)
        if value <= 0.0:
            raise bad_input(self.path, self.field(key), value, "is not positive", "give a positive number")
        if value > most:
            raise bad_input(self.path, self.field(key), value, f"is above {most:g}", "check its unit")
        return value

    def vector(self, key: str, count: int, default: Sequence[float] | None = None) -> tuple[float, ...]:
        """A list of `count` finite numbers."""
        value = self.values.get(key, default)
        if not isinstance(value, list | tuple) or len(value) != count:
            raise bad_input(self.path, self.field(key), value, f"is not a list of {count} numbers", "write [a, b, ...]")
        return tuple(self._finite(self.field(key), v) for v in value)

    def _finite(self, field: str, value: Any) -> float:
        # bool is an int to Python.
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise bad_input(self.path, field, value, "is not a number", "give a number")
        return require_finite(self.path, field, value)
