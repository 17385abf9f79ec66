"""Runs the public functions with every annotation of the package checked; `test_annotations.py` starts it.

The hook must be there before the package is imported, so this is a process of its own. What it leaves out are batches
that JAX carries with the batch axis last, whose arrays have another order than the annotations of one rover say.
"""

# ruff: noqa: E402

from __future__ import annotations

import functools
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
from beartype import BeartypeConf, beartype
from jaxtyping import TypeCheckError, install_import_hook

# The hook takes its checker by name. The numeric tower lets a whole number stand for a float.
CHECKER = types.ModuleType("strict_checker")
CHECKER.check = beartype(conf=BeartypeConf(is_pep484_tower=True))
sys.modules["strict_checker"] = CHECKER
install_import_hook("lunar_mjx", "strict_checker.check")

from lunar_mjx.criticism import WheelBed, load_figures
from lunar_mjx.dynamics import build
from lunar_mjx.dynamics.state import Temperature
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.model import Model, make_model
from lunar_mjx.model.file import load_model, save_model
from lunar_mjx.paper import hot_motor
from lunar_mjx.rover import convert
from lunar_mjx.spatial import Frame, Vec3
from lunar_mjx.terrain import (
    height,
    inclined,
    inside,
    load_terrain,
    nearest_rock,
    normal,
    rock_fraction,
    sample,
    slope,
    stack,
    to_mesh,
)
from lunar_mjx.wheel_bed.comparison import compare

SURFACE = {"width": 20.0, "height": 20.0, "cell": 0.5, "roughness": {}, "craters": {}}
DETAILED = {"surface": SURFACE, "detail": {"cell": 0.25, "roughness": {}}, "rocks": {}, "soil": {"rock_fraction": 0.2}}


def terrains() -> None:
    """Makes terrains of every kind and samples them at points of several shapes."""
    made = load_terrain(DETAILED)
    for points in (0.5, jnp.zeros(3), jnp.ones((2, 3))):
        for function in (sample, height, normal, slope, inside):
            function(made.field, points, points)
        nearest_rock(made.rocks, points, points)
        rock_fraction(made.soil, points, points)
    stack([inclined(0.1), load_terrain("flat")])
    to_mesh(made, solid=True)


def vectors() -> None:
    """Turns a vector into a frame and back."""
    frame = Frame.of_matrix(jnp.eye(3)[None])
    frame.euler()
    frame.from_world(frame.to_world(Vec3.of(jnp.ones((1, 3))).unit())).cross(Vec3.zero(jnp.ones(1))).stack()


def steps() -> None:
    """Traces one step and a rollout of LUVMI-X, by both engines and presets."""
    ground = load_terrain(DETAILED)
    for preset in ("field", "consistent", "paper"):
        for engine in ("mjx", "structured"):
            system = build(make_model("luvmi_x", ground, preset), engine)
            state = system.reset(system.params, 1.0, -1.0, 0.3)
            control = jnp.zeros(len(system.joint_names))
            jax.make_jaxpr(system.step)(system.params, state, control)
            jax.make_jaxpr(functools.partial(system.rollout, every=2))(system.params, state, jnp.stack([control] * 3))


def every_effect() -> None:
    """Traces a step with each effect that the preset leaves out, and with what it reads, beside the others or in their
    place."""
    model = make_model("luvmi_x", "flat")
    for name in CATALOGUE:
        if name in model.effect_names or any(name in e.replaces for e in model.effects):
            continue
        needed = [n for n in CATALOGUE[name].requires if n not in model.effect_names]
        system = build(functools.reduce(Model.add, [*needed, name], model))
        jax.make_jaxpr(system.step)(system.params, system.reset(system.params), jnp.zeros(len(system.joint_names)))


def files(folder: Path) -> None:
    """Saves and loads a model, and converts a URDF."""
    load_model(save_model(make_model("luvmi_x", "flat"), folder / "model.toml"))
    convert(Path(__file__).parent / "rover" / "data" / "steered.urdf", folder / "steered")


def wheels_and_motors() -> None:
    """Holds a wheel against the test bed, and heats a motor."""
    compare(WheelBed.of_preset("consistent"), load_figures(), "consistent")
    hot_motor("consistent", 0.1)


def refused() -> None:
    """Two wrong shapes: what shows that anything is checked at all."""
    for wrong in (
        lambda: sample(inclined(0.1).field, jnp.zeros(3), jnp.zeros(4)),
        lambda: Temperature(jnp.zeros(3), jnp.zeros(3), jnp.zeros(4), jnp.zeros(3)),
    ):
        try:
            wrong()
        except TypeCheckError:
            continue
        sys.exit("a wrong shape went through")


if __name__ == "__main__":
    refused()
    terrains()
    vectors()
    steps()
    every_effect()
    files(Path(sys.argv[1]))
    wheels_and_motors()
    print("checked")
