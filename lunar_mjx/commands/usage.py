"""A mistake on the command line itself, such as an unknown option, told in one sentence instead of Typer's box."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import typer

UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "UsageError")
"""Typer's own, wherever this version of Typer keeps it."""

# Of two words for one problem the longer is Typer's, the shorter `_plain_number`'s.
_PROBLEMS = (
    ("valid integer", "is not a whole number"),
    ("valid int", "is not a whole number"),
    ("valid number", "is not a number"),
    ("valid float", "is not a number"),
    ("greater than or equal to ", "is below {}"),
    ("less than or equal to ", "is above {}"),
)


def describe(error: Any, arguments: Sequence[str]) -> str:
    """The sentence: which option of which command, what was given, and where to read more.

    Args:
      error: a `UsageError`. arguments: of the command line, in which the value is found.
    """
    command = error.ctx.command_path if error.ctx else "lunar-mjx"
    names = list(getattr(getattr(error, "param", None), "opts", ()))
    name = next((n for n in names if n.startswith("--")), names[0] if names else "")
    # By name, since where the class is kept depends on the version of Typer.
    if type(error).__name__ != "BadParameter" or not name:
        text = _clause(error.format_message())
        return f"{command}: {text}; see {command} --help."
    value = _given(names, arguments)
    shown = name if value is None else f"{name} = {value!r}"
    return f"{command}: {shown} {_problem(error.message)}; see {command} --help."


def strict(command: Any) -> Any:
    """The command, which reads neither numbers nor paths as Python does: `1_0` is no 10, and "" no folder."""
    for inner in getattr(command, "commands", {}).values():
        strict(inner)
    for parameter in command.params:
        kind = getattr(getattr(parameter, "type_descriptor", None), "annotation", None)
        if kind in (int, float):
            # In the parameter, not around the command: errors then name the option as Typer's own do.
            parameter.process_value = functools.partial(_plain_number, parameter, parameter.process_value, kind)
        elif kind is Path:
            parameter.process_value = functools.partial(_named_path, parameter, parameter.process_value)
    return command


def _plain_number(parameter: Any, process: Callable[[Any, Any], Any], kind: type, ctx: Any, value: Any) -> Any:
    # Python's int and float read underscores between digits.
    if isinstance(value, str) and "_" in value:
        raise typer.BadParameter(f"{value!r} is not a valid {kind.__name__}", ctx=ctx, param=parameter)
    return process(ctx, value)


def _named_path(parameter: Any, process: Callable[[Any, Any], Any], ctx: Any, value: Any) -> Any:
    if value == "":  # of a variable that the shell does not know: Python reads the folder where one stands
        raise typer.BadParameter("empty; name a path", ctx=ctx, param=parameter)
    return process(ctx, value)


def _problem(message: str) -> str:
    for words, problem in _PROBLEMS:
        _, found, after = message.partition(words)
        if found:
            return problem.format(after)
    return f"is not accepted: {_clause(message)}"


def _clause(message: str) -> str:
    text = " ".join(message.split()).rstrip(".")
    return text[:1].lower() + text[1:]


def _given(names: Sequence[str], arguments: Sequence[str]) -> str | None:
    """What an option was given last, which counts; None for an argument, which has no name to be found by."""
    found = None
    for i, argument in enumerate(arguments):
        option, equals, value = argument.partition("=")
        if option in names:
            found = value if equals else next(iter(arguments[i + 1 :]), None)
    return found
