"""Physical effects: small pure functions at the ports of a step, and the catalogue of those that ship."""

from lunar_mjx.effects.base import PORTS, Effect, Parameter, StateVariable, effect

__all__ = ["PORTS", "Effect", "Parameter", "StateVariable", "effect"]
