"""Environments by name, those of the user's own included."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

from lunar_mjx.envs.core import Environment
from lunar_mjx.errors import UserError, bad_input, require_file
from lunar_mjx.trust import vouch


def _navigation(**options: Any) -> Environment:
    from lunar_mjx.envs.navigation.env import make_navigation

    return make_navigation(**options)


def _point(**options: Any) -> Environment:
    from lunar_mjx.envs.point import PointEnv

    return PointEnv(**options)


SHIPPED: dict[str, Callable[..., Environment]] = {"navigation": _navigation, "point": _point}
"""Makers of the environments of this package."""
GROUP = "lunar_mjx.environments"
"""Entry points by which other packages bring environments: `my_task = "my_package:make_env"`."""
_registered: dict[str, Callable[..., Environment]] = {}


def register(name: str, maker: Callable[..., Environment]) -> None:
    """Makes `maker(**options)` known by a name, for `make` and for trainings in this process.

    A package that is installed needs no call: an entry point in the group `lunar_mjx.environments` does the same, for
    the command line too.

    Raises:
      UserError: the name is one of this package's, or cannot be told from a file.
    """
    # A file is told from a name by its sign; plain words cannot be mistaken.
    if name in SHIPPED or not name.isidentifier():
        why = "is taken" if name in SHIPPED else "is no plain word"
        raise bad_input("envs.register", "name", name, why, "choose another name of letters, digits and underscores")
    _registered[name] = maker


def _installed() -> dict[str, metadata.EntryPoint]:
    return {point.name: point for point in metadata.entry_points(group=GROUP)}


def names() -> tuple[str, ...]:
    """Every name that `make` knows, the shipped ones first."""
    return tuple(dict.fromkeys([*SHIPPED, *_registered, *_installed()]))


def _by_name(name: str) -> Callable[..., Environment]:
    if name in SHIPPED or name in _registered:
        return (SHIPPED | _registered)[name]
    point = _installed().get(name)
    if point is None:
        raise bad_input(
            "envs.make", "environment", name, "does not exist", f"use {', '.join(names())}, or my_env.py:make_env"
        )
    try:
        return point.load()
    except Exception as error:
        raise UserError(
            f"envs.make: the entry point {name} = {point.value} does not load ({type(error).__name__}: "
            f"{error}); mend the package that brings it."
        ) from error


def make(name: str, /, **options: Any) -> Environment:
    """Makes an environment.

    Args:
      name: a shipped one (`navigation`, `point`), one made known by `register` or by an installed package's entry
        point, or `file.py:maker`, where `maker(**options)` returns an object with the attributes and functions of
        `Environment`. The file is the user's own code and is run as such.
      **options: passed on to the maker.

    Raises:
      UserError: no such name, file or maker, options that it does not take, or an object that is no environment.
    """
    if not isinstance(name, str):
        raise bad_input(
            "envs.make", "environment", name, "is no name", f"use {', '.join(names())}, or my_env.py:make_env"
        )
    vouch(name)
    maker = _from_file(name) if ".py" in name else _by_name(name)
    try:
        env = maker(**options)
    except TypeError as error:
        if not options:
            raise
        raise bad_input("envs.make", name, options, f"are not its options ({error})", "leave them out") from error
    lacks = [a for a in ("params", "observation_size", "action_size", "reset", "step") if not hasattr(env, a)]
    if lacks:
        raise bad_input("envs.make", "environment", name, f"lacks {', '.join(lacks)}", "return an Environment")
    return env


def _from_file(spec: str) -> Callable[..., Environment]:
    file, colon, member = spec.partition(":")
    path = require_file(file, "the environment's file")
    if not colon:
        raise bad_input("envs.make", "environment", spec, "names no maker", "write it as my_env.py:make_env")
    module_spec = importlib.util.spec_from_file_location(f"lunar_mjx_user_{Path(file).stem}", path)
    assert module_spec is not None and module_spec.loader is not None
    module = importlib.util.module_from_spec(module_spec)
    try:
        module_spec.loader.exec_module(module)
    except Exception as error:
        raise UserError(f"{path}: does not run ({type(error).__name__}: {error}); mend the file.") from error
    if not callable(getattr(module, member, None)):
        raise bad_input(path, "maker", member, "is not in the file", "name a function that returns an environment")
    return getattr(module, member)
