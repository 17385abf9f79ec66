"""Faults planted into the reference through its hooks: the hook, stages that fail at level 1, and the entries told."""

from __future__ import annotations

from lunar_mjx.backends import Hook


def _flip(ctx, state, value):
    value["force"][..., 1] *= -1.0


def _grow(ctx, state, value):
    value["radius"][:, 2] *= 1.01


def _drop(ctx, state, value):
    """Takes the rotor-stator path out of the housing's heat again."""
    apart = ctx.heat_winding_temperature - ctx.heat_housing_temperature
    value["housing"] -= apart / ctx.numbers.effects["motor"].R_th1


FAULTS = {
    "lateral force": (Hook("lateral force", {"shear": _flip}), ("soil wrench", "acceleration"), (" y", " x", " z")),
    "wheel radius": (
        Hook("wheel radius", {"geometry": _grow}),
        ("slip", "sinkage", "soil wrench", "acceleration"),
        ("lr",),
    ),
    "rotor-stator term": (Hook("rotor-stator term", {"heat": _drop}), ("heat",), ("_drive", "_steer", "_suspension")),
}
