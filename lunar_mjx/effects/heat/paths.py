"""Heat paths between a motor's winding, its housing and the surroundings (seed paper, eqs. 1-3, and what they lack)."""

from __future__ import annotations

import dataclasses
from typing import Annotated

from lunar_mjx.effects.base import Parameter, effect

STEFAN_BOLTZMANN: Annotated[float, "W/m2/K4"] = 5.670374419e-8
"""CODATA 2018."""


def _winding_to_housing(ctx):
    """Heat flow from winding to housing, W (eq. 1)."""
    # The resistance is the motor's own parameter: both ends of one path read one number, so that heat is conserved.
    return (ctx.winding_temperature - ctx.housing_temperature) / ctx.parameters["motor"].R_th1


@effect("heat", requires=("motor",))
def winding_conduction(ctx, p, x, heat):
    """The winding loses (T_R - T_S)/R_th1 (eq. 2)."""
    return dataclasses.replace(heat, winding=heat.winding - _winding_to_housing(ctx))


@effect(
    "heat",
    requires=("motor",),
    share=Parameter(
        1.0, 0.0, (0.0, 1.0), "1", "share of the winding's heat loss that reaches the housing", "conservation of energy"
    ),
)
def rotor_stator_path(ctx, p, x, heat):
    """The housing receives what the winding loses: + (T_R - T_S)/R_th1 in eq. 3, which the paper leaves out.

    Source: two-resistance motor model; conservation of energy (flaw 1 of the paper).
    """
    return dataclasses.replace(heat, housing=heat.housing + p.share * _winding_to_housing(ctx))


@effect(
    "heat",
    R_th2=Parameter(
        10.9, None, (1e-3, 1e6), "K/W", "thermal resistance housing to ambient air", "maxon ECX TORQUE 22 XL, in air"
    ),
)
def housing_convection(ctx, p, x, heat):
    """The housing loses (T_S - T_A)/R_th2 (eq. 3), a figure that holds in air."""
    flow = (ctx.housing_temperature - ctx.ambient_temperature) / p.R_th2
    return dataclasses.replace(heat, housing=heat.housing - flow)


@effect(
    "heat",
    conductance=Parameter(
        0.05,
        0.0,
        (0.0, 1e3),
        "W/K",
        "thermal conductance housing to structure",
        "choice: 20 K/W through the motor's flange",
    ),
)
def housing_conduction(ctx, p, x, heat):
    """The housing loses G (T_S - T_A) into the structure, which follows the ambient temperature."""
    # Linear in the temperatures: a bolted joint conducts; what the housing radiates is another effect.
    flow = p.conductance * (ctx.housing_temperature - ctx.ambient_temperature)
    return dataclasses.replace(heat, housing=heat.housing - flow)


@effect(
    "heat",
    emissivity=Parameter(
        0.8, 0.0, (0.0, 1.0), "1", "infrared emissivity of the housing", "anodised or painted metal; choice"
    ),
    area=Parameter(
        0.008, None, (1e-6, 10.0), "m2", "radiating area of the housing", "22 mm x 110 mm motor with gearhead; choice"
    ),
)
def housing_radiation(ctx, p, x, heat):
    """In vacuum the housing radiates epsilon sigma A (T_S^4 - T_A^4); replaces the in-air figure (flaw 9)."""
    # The ambient temperature stands for all that the housing sees; regolith_infrared replaces it by ground and sky.
    flow = p.emissivity * STEFAN_BOLTZMANN * p.area * (ctx.housing_temperature**4 - ctx.ambient_temperature**4)
    return dataclasses.replace(heat, housing=heat.housing - flow)
