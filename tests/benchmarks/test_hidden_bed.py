"""Effects of the catalogue on the hidden test bed, written anew from their equations, act as the tool's own do."""

from __future__ import annotations

import functools

import jax
import numpy as np
import pytest

from benchmarks.hidden.bed import effects as bed_effects
from benchmarks.hidden.bed.bench import Points, Soil, measure
from lunar_mjx.criticism import WheelBed, wheel_test
from lunar_mjx.effects import catalogue

RADIUS, WIDTH = 0.0625, 0.05
KINDS = {name: kind for name, kind in bed_effects.KNOWN.items() if name in catalogue.CATALOGUE}


@functools.cache
def bed() -> WheelBed:
    """The tool's bed with every effect that the hidden one knows, so that one program is compiled for all."""
    made = WheelBed.of_preset("consistent")
    for name in KINDS:
        made = made.with_effect(name, **catalogue.CATALOGUE[name].null())
    return made


def readings(name: str | None) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What the hidden bed and the tool's read with one effect, or with none."""
    slip, angle = (a.ravel() for a in np.meshgrid([-0.3, 0.1, 0.5, 0.8], np.radians([-10.0, 5.0, 25.0])))
    load, soil = np.resize([10.0, 25.0], slip.size), Soil(modulus_y=0.012)
    values = {} if name is None else KINDS[name].draw(np.random.default_rng(0), RADIUS)
    points = Points(slip, angle, load, RADIUS, WIDTH, gravity=bed().gravity)
    hidden = measure(points, soil, [] if name is None else [KINDS[name].make(values, RADIUS)])
    ground = {"k_c": soil.k_c, "k_phi": soil.k_phi, "n": soil.n, "cohesion": soil.cohesion}
    ground |= {"shear_modulus_x": soil.modulus_x, "shear_modulus_y": soil.modulus_y}
    ground |= {"friction_angle": soil.friction_angle}
    given = {"soil": ground} if name is None else {"soil": ground, name: values}
    with jax.enable_x64(True):
        seen = bed().with_values(given).run(wheel_test(slip, angle, load, RADIUS, WIDTH))
    tool = {
        "drawbar_pull_N": seen.drawbar_pull,
        "side_force_N": seen.side_force,
        "driving_torque_Nm": seen.driving_torque,
        "sinkage_m": seen.sinkage,
    }
    return hidden, {k: np.asarray(v) for k, v in tool.items()}


@pytest.mark.parametrize("name", [None, *KINDS])
def test_the_hidden_bed_reads_what_the_tools_bed_reads(name: str | None) -> None:
    hidden, tool = readings(name)
    for quantity, value in tool.items():
        assert np.abs(hidden[quantity] - value).max() < 1e-4 * np.abs(value).max(), quantity
    if name is not None:
        plain, _ = readings(None)
        assert max(np.abs(hidden[k] - plain[k]).max() / np.abs(plain[k]).max() for k in tool) > 0.02, "it acts"
