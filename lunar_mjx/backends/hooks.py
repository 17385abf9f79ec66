"""Hooks: plain NumPy functions that change a reference backend's physics at named points of the step.

A hook is what a hidden effect is made of: a run with hooks is a measurement whose physics the model does not have.
See docs/backends.md for every point, its value, and examples.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from lunar_mjx.errors import bad_input

POINTS = (
    "command",
    "current",
    "winding",
    "torque",
    "geometry",
    "contact",
    "soil",
    "normal",
    "slip",
    "shear",
    "body",
    "heat",
)
"""Points of the step, in the order in which it reaches them (`heat` twice a step with the integrator Heun)."""

HookFunction = Callable[[Any, dict[str, Any], Any], Any]


@dataclasses.dataclass(frozen=True)
class Hook:
    """Functions at one or several points that share a state of their own.

    A function takes the `Context`, its state (a dict to change in place) and the point's value; it returns the new
    value, or None where it changed the value in place (arrays and dicts of arrays may be changed in place).

    Attributes:
      name: for messages.
      points: point -> function(ctx, state, value).
      initial: contents of the state at reset; copied, so that one hook serves many backends.
    """

    name: str
    points: Mapping[str, HookFunction]
    initial: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self) -> None:
        for point in self.points:
            if point not in POINTS:
                raise bad_input(
                    f"hook {self.name}", "point", point, "does not exist", f"use one of {', '.join(POINTS)}"
                )


class Hooks:
    """The hooks of one backend with their states."""

    def __init__(self, hooks: Iterable[Hook]) -> None:
        self.hooks = tuple(hooks)
        self._at: dict[str, list[tuple[int, HookFunction]]] = {}
        for i, hook in enumerate(self.hooks):
            for point, function in hook.points.items():
                self._at.setdefault(point, []).append((i, function))
        self.states: list[dict[str, Any]] = []
        self.reset()

    def reset(self) -> None:
        """Puts the state of every hook back to its beginning."""
        # Deep, since a state may hold arrays that a hook changes in place.
        self.states = [copy.deepcopy(dict(hook.initial)) for hook in self.hooks]

    def __contains__(self, point: str) -> bool:
        return point in self._at

    def call(self, point: str, ctx: Any, value: Any) -> Any:
        """Passes `value` through the hooks at `point`, in their order."""
        for i, function in self._at.get(point, ()):
            result = function(ctx, self.states[i], value)
            value = value if result is None else result
        return value
