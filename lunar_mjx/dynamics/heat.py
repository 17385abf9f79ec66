"""Steps the motors' temperatures by the effects at the port `heat`; needs neither a rover nor an engine."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.dynamics.state import Temperature, compensated_add
from lunar_mjx.effects.context import Context, Heat
from lunar_mjx.effects.ports import EffectState, Pipeline, heat_flow


def step_heat(
    pipeline: Pipeline, integrator: str, ctx: Context, temperature: Temperature, effects: EffectState
) -> tuple[Heat, EffectState, Temperature]:
    """Advances the temperatures of all motors by one time step.

    Args:
      pipeline: the effects.
      integrator: "euler", the explicit step of eqs. 4 and 5, or "heun", of second order.
      ctx: context whose command is settled, with the temperatures at the beginning of the step.
      temperature: the same temperatures as compensated offsets.
      effects: the effects' state.

    Returns:
      Heat flow into the two nodes of every motor, averaged over the step, W; the effects' new state; the temperatures
      at the end of the step.
    """
    if "heat" not in pipeline:
        zero, one = jnp.zeros_like(temperature.winding), jnp.ones_like(temperature.winding)
        return Heat(zero, zero, one, one), effects, temperature
    heat, effects = heat_flow(pipeline, ctx, effects)
    if integrator == "heun":
        # Heun's trial step: the slope at its end is averaged with the one at the beginning.
        ahead = dataclasses.replace(
            ctx,
            winding_temperature=ctx.winding_temperature + ctx.dt * heat.winding / heat.winding_capacity,
            housing_temperature=ctx.housing_temperature + ctx.dt * heat.housing / heat.housing_capacity,
        )
        # the states that effects return here are those of a trial step, and are dropped
        flow_ahead, _ = heat_flow(pipeline, ahead, effects)
        heat = dataclasses.replace(
            heat, winding=0.5 * (heat.winding + flow_ahead.winding), housing=0.5 * (heat.housing + flow_ahead.housing)
        )
    # a step warms a winding by microkelvins, which float32 would drop beside 300 K
    winding = compensated_add(
        temperature.winding, temperature.winding_lost, ctx.dt * heat.winding / heat.winding_capacity
    )
    housing = compensated_add(
        temperature.housing, temperature.housing_lost, ctx.dt * heat.housing / heat.housing_capacity
    )
    return heat, effects, Temperature(*winding, *housing)
