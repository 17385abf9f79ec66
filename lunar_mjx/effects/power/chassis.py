"""The chassis as one thermal node: what electronics, motors and the Sun bring, and what it radiates (port `heat`)."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Effect, Parameter, StateVariable
from lunar_mjx.effects.heat.paths import STEFAN_BOLTZMANN


def chassis_temperature(p, x):
    """Temperature of the chassis, K."""
    return p.initial + x.warmer


def _exchange(ctx, p, x, heat):
    temperature = chassis_temperature(p, x)
    # what housings lose the chassis gains: the same number on both sides keeps the energy
    flow = p.conductance * (ctx.housing_temperature - temperature)
    # What the radiator sees of the ground; the rest of its view is black sky at 3 K, whose fourth power is nothing.
    ground = p.ground_view * ctx.ambient_temperature**4
    radiated = p.radiator * STEFAN_BOLTZMANN * (temperature**4 - ground)
    # Whatever the heading: no side of the chassis is told apart from the others.
    sunlight = 0.0 if ctx.sunlight is None else p.absorber * ctx.sunlight.irradiance
    losses = 0.0 if ctx.power is None else ctx.power.loss
    gain = jnp.sum(flow) + losses + sunlight - radiated
    # Kahan's sum: a time step warms the chassis by microkelvins
    step = ctx.dt * gain / p.capacity - x.warmer_lost
    warmer = x.warmer + step
    heat = dataclasses.replace(heat, housing=heat.housing - flow)
    return heat, {"warmer": warmer, "warmer_lost": (warmer - x.warmer) - step}


chassis_node = Effect(
    name="chassis_node",
    ports={"heat": _exchange},
    parameters={
        "capacity": Parameter(
            2.7e4, None, (1.0, 1e8), "J/K", "heat capacity of the chassis", "choice: 30 kg of aluminium, 900 J/(kg K)"
        ),
        "conductance": Parameter(
            0.05, None, (0.0, 1e3), "W/K", "conductance from each motor's housing", "as in housing_conduction"
        ),
        "radiator": Parameter(
            0.4,
            None,
            (0.0, 100.0),
            "m2",
            "emissivity times radiating area",
            "choice: 0.8 on 0.5 m2, the rest insulated",
        ),
        "ground_view": Parameter(
            0.2, None, (0.0, 1.0), "1", "share of its view that the ground fills", "choice: a radiator that looks up"
        ),
        "absorber": Parameter(
            0.05, None, (0.0, 100.0), "m2", "absorptivity times area that faces the Sun", "choice: 0.1 on 0.5 m2"
        ),
        "initial": Parameter(293.15, None, (20.0, 450.0), "K", "temperature at reset", "choice: 20 degC"),
    },
    state={
        "warmer": StateVariable(0.0, "K", "temperature above that at reset", axis="rover"),
        "warmer_lost": StateVariable(0.0, "K", "rounding that its last sum lost", axis="rover", rounding_of="warmer"),
    },
    replaces=("housing_conduction",),
    order=50,
    doc="""C dT/dt = sum of G (T_S - T) + losses + alpha A E - eps A sigma (T^4 - F T_A^4): the structure as one node.

    Motors' housings conduct into it in place of the ambient temperature (`housing_conduction`); what amplifiers,
    electronics and the battery lose warms it, and so does sunlight behind the terrain's horizon where the model has a
    Sun. The ground, at the ambient temperature, fills the share F of its view, black sky the rest. Panels are taken for
    thermally apart.""",
)
