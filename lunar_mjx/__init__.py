"""lunar-mjx: lunar rovers on MuJoCo MJX, held against measurements.

The names below are the public interface: they stay where they are, or the changelog says what moved. Each is imported
when it is first asked for, since JAX takes a second.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from lunar_mjx._version import __version__ as __version__

_HOMES = {
    "Ambient": "lunar_mjx.dynamics",
    "Diagnosis": "lunar_mjx.criticism",
    "Effect": "lunar_mjx.effects",
    "Environment": "lunar_mjx.envs",
    "Log": "lunar_mjx.logs",
    "Model": "lunar_mjx.model",
    "Parameter": "lunar_mjx.effects",
    "Params": "lunar_mjx.dynamics",
    "Rover": "lunar_mjx.rover",
    "State": "lunar_mjx.dynamics",
    "StateVariable": "lunar_mjx.effects",
    "System": "lunar_mjx.dynamics",
    "Telemetry": "lunar_mjx.dynamics",
    "Terrain": "lunar_mjx.terrain",
    "UserError": "lunar_mjx.errors",
    "WheelBed": "lunar_mjx.criticism",
    "add": "lunar_mjx.criticism",
    "audit": "lunar_mjx.criticism",
    "build": "lunar_mjx.dynamics",
    "check": "lunar_mjx.criticism",
    "compare": "lunar_mjx.criticism",
    "effect": "lunar_mjx.effects",
    "explain": "lunar_mjx.criticism",
    "improve": "lunar_mjx.criticism",
    "load_model": "lunar_mjx.model.file",
    "load_rover": "lunar_mjx.rover",
    "load_terrain": "lunar_mjx.terrain",
    "make_model": "lunar_mjx.model",
    "make_navigation": "lunar_mjx.envs",
    "next_experiment": "lunar_mjx.criticism",
    "read_campaign": "lunar_mjx.logs",
    "read_log": "lunar_mjx.logs",
    "save_model": "lunar_mjx.model.file",
    "simulate_log": "lunar_mjx.logs",
    "unknown": "lunar_mjx.criticism",
    "why": "lunar_mjx.criticism",
    "write_log": "lunar_mjx.logs",
}
"""Public names, and the package that each is imported from."""

if TYPE_CHECKING:
    from lunar_mjx.criticism import Diagnosis as Diagnosis
    from lunar_mjx.criticism import WheelBed as WheelBed
    from lunar_mjx.criticism import add as add
    from lunar_mjx.criticism import audit as audit
    from lunar_mjx.criticism import check as check
    from lunar_mjx.criticism import compare as compare
    from lunar_mjx.criticism import explain as explain
    from lunar_mjx.criticism import improve as improve
    from lunar_mjx.criticism import next_experiment as next_experiment
    from lunar_mjx.criticism import unknown as unknown
    from lunar_mjx.criticism import why as why
    from lunar_mjx.dynamics import Ambient as Ambient
    from lunar_mjx.dynamics import Params as Params
    from lunar_mjx.dynamics import State as State
    from lunar_mjx.dynamics import System as System
    from lunar_mjx.dynamics import Telemetry as Telemetry
    from lunar_mjx.dynamics import build as build
    from lunar_mjx.effects import Effect as Effect
    from lunar_mjx.effects import Parameter as Parameter
    from lunar_mjx.effects import StateVariable as StateVariable
    from lunar_mjx.effects import effect as effect
    from lunar_mjx.envs import Environment as Environment
    from lunar_mjx.envs import make_navigation as make_navigation
    from lunar_mjx.errors import UserError as UserError
    from lunar_mjx.logs import Log as Log
    from lunar_mjx.logs import read_campaign as read_campaign
    from lunar_mjx.logs import read_log as read_log
    from lunar_mjx.logs import simulate_log as simulate_log
    from lunar_mjx.logs import write_log as write_log
    from lunar_mjx.model import Model as Model
    from lunar_mjx.model import make_model as make_model
    from lunar_mjx.model.file import load_model as load_model
    from lunar_mjx.model.file import save_model as save_model
    from lunar_mjx.rover import Rover as Rover
    from lunar_mjx.rover import load_rover as load_rover
    from lunar_mjx.terrain import Terrain as Terrain
    from lunar_mjx.terrain import load_terrain as load_terrain

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
