"""A user's mistake: one clear sentence, and exit status 2 at the command line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

EXIT_STATUS = 2
"""Exit status of a command that a mistake of the user's ends."""
LONGEST_PATH = 4000
"""Characters; what is longer is no path anywhere."""
LONGEST_NAME = 255
"""Bytes of one part of a path, which usual file systems keep at most."""


class UserError(ValueError):
    """Bad input, told in one sentence that names the file, the field, the value and the remedy.

    The command line prints the sentence without a traceback and exits with status 2.
    """


def bad_input(source: str | Path, field: str, value: Any, problem: str, remedy: str) -> UserError:
    """Builds the error for one bad value.

    Args:
      source: file or function that brought the value.
      field: name of the field, channel or argument.
      value: the offending value, shown as given.
      problem: what is wrong with it, such as "is negative".
      remedy: what to do, as an imperative clause, such as "give the mass in kg".

    Returns:
      The error, to be raised by the caller.
    """
    try:
        shown = f"{value!r}" if isinstance(value, str) else f"{value}"
    except ValueError:  # whole numbers of more than 4300 digits
        shown = "a number of thousands of digits"
    if len(field) > 120:
        field = field[:117] + "..."
    if len(shown) > 120:
        shown = shown[:117] + "..."
    return UserError(f"{source}: {field} = {shown} {problem}; {remedy}.")


def plain_digits(text: str) -> str:
    """Returns a text that is to be read as numbers, or raises `ValueError` if it holds an underscore.

    Python reads 1_0 as 10, which is rarely what a hand or a file with a lost blank meant.
    """
    if "_" in text:
        raise ValueError("an underscore")
    return text


def require_finite(source: str | Path, field: str, value: Any) -> float:
    """Returns `value` as a float, or raises `UserError` if it is not a finite number."""
    try:
        number = float(plain_digits(value) if isinstance(value, str) else value)
    except OverflowError:
        raise bad_input(source, field, value, "is too large", "give a finite number") from None
    except (TypeError, ValueError):
        raise bad_input(source, field, value, "is not a number", "give a finite number") from None
    if not math.isfinite(number):
        raise bad_input(source, field, value, "is not finite", "give a finite number")
    return number


def require_within(
    source: str | Path, field: str, value: Any, low: float, high: float = math.inf, above: bool = False
) -> float:
    """Returns a finite number within [low, high], or within (low, high] where `above`; else raises `UserError`."""
    number = require_finite(source, field, value)
    if number < low or number > high or (above and number == low):
        least = f"above {low:g}" if above else f"{low:g} or more"
        raise bad_input(
            source,
            field,
            value,
            "is out of range",
            f"give {least}" + (f", {high:g} at most" if high < math.inf else ""),
        )
    return number


def require_name(source: str | Path, field: str, value: Any, remedy: str = "give a name or a path in quotes") -> str:
    """Returns `value` if a name or path can be called so, or raises `UserError`."""
    if not isinstance(value, str) or not value:
        raise bad_input(source, field, value, "is not a name", remedy)
    longest = max(len(part.encode("utf-8", "surrogatepass")) for part in value.split("/"))
    # A line break or a byte of zero is damage, and would break the sentence or the system's call.
    if any(ord(c) < 32 for c in value) or longest > LONGEST_NAME or len(value) > LONGEST_PATH:
        raise bad_input(source, field, value, "is no name of a file or folder", remedy)
    return value


def require_file(path: str | Path, what: str) -> Path:
    """Returns `path` if it is a readable file, or raises `UserError` saying that `what` is missing there."""
    path = Path(path)
    if "\0" in str(path) or len(str(path)) > LONGEST_PATH:
        raise UserError(f"{what} = {str(path)[:60]!r}... is no path; give the path of a file.")
    if path.is_dir():
        raise UserError(f"{path}: {what} is a folder, not a file; give the path of the file itself.")
    if path.exists() and not path.is_file():
        raise UserError(f"{path}: {what} is a device, a pipe or a socket; give the path of a file.")
    if path.is_symlink() and not path.exists():
        raise UserError(f"{path}: {what} is a link that leads to no file; mend the link, or give the file itself.")
    if not path.is_file():
        raise UserError(f"{path}: {what} is not there; check the path or its spelling.")
    return path


def no_archive(error: Exception) -> str:
    """Why NumPy reads no archive, in its words on one line; but not its advice to load what may run code."""
    text = one_line(error) or type(error).__name__
    return "it is no archive of arrays" if "pickle" in text else text


def one_line(error: object) -> str:
    """Text of an error of another library on one line, to stand within a sentence."""
    return " ".join(str(error).split())
