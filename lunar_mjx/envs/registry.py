"""Environments by name, those of the user's own included."""

from __future__ import annotations

import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lunar_mjx.envs.core import Environment
from lunar_mjx.errors import UserError, bad_input, require_file


def _navigation(**options: Any) -> Environment:
    from lunar_mjx.envs.navigation import make_navigation

    return make_navigation(**options)


def _point(**options: Any) -> Environment:
    from lunar_mjx.envs.point import PointEnv

    return PointEnv(**options)


SHIPPED: dict[str, Callable[..., Environment]] = {"navigation": _navigation, "point": _point}
"""Makers of the environments of this package."""


def make(name: str, /, **options: Any) -> Environment:
    """Makes an environment.

    Args:
      name: a shipped one (`navigation`, `point`), or `file.py:maker`, where `maker(**options)` returns an object with
        the attributes and functions of `Environment`. The file is the user's own code and is run as such.
      **options: passed on to the maker.

    Raises:
      UserError: no such name, file or maker, options that it does not take, or an object that is no environment.
    """
    if ".py" in name:
        maker = _from_file(name)
    elif name in SHIPPED:
        maker = SHIPPED[name]
    else:
        known = ", ".join(SHIPPED)
        raise bad_input("envs.make", "environment", name, "does not exist", f"use {known}, or my_env.py:make_env")
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
