"""Chooses the rigid-body engine of a rover."""

from __future__ import annotations

import logging

from lunar_mjx.dynamics.mjx import MjxEngine
from lunar_mjx.dynamics.structured.engine import StructuredEngine
from lunar_mjx.dynamics.structured.suitability import UnsuitableError
from lunar_mjx.errors import UserError
from lunar_mjx.rover import Rover

ENGINES = ("auto", "mjx", "structured")
"""`auto` takes `structured` where the rover fits it, else `mjx`."""

Engine = MjxEngine | StructuredEngine

_log = logging.getLogger(__name__)


def make_engine(rover: Rover, engine: str = "auto") -> Engine:
    """Makes the engine of a rover.

    Args:
      rover: the rover.
      engine: one of `ENGINES`; `auto` logs one sentence where it falls back to MJX.

    Raises:
      UserError: unknown engine, or a rover that the engine cannot run exactly.
    """
    if engine not in ENGINES:
        raise UserError(f"build: engine = {engine!r} does not exist; use one of {', '.join(ENGINES)}.")
    if engine == "mjx":
        return MjxEngine(rover)
    try:
        return StructuredEngine(rover)
    except UnsuitableError as error:
        if engine == "structured":
            raise
        _log.warning(
            "%s runs on the MJX engine, at a twentieth to a fortieth of the rate on a GPU: %s", rover.name, error
        )
        return MjxEngine(rover)
