"""Grousers: the shearing surface that they carry outward, the ground that they grip, and the pulse of their number."""

from __future__ import annotations

import dataclasses
import math

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect


@effect(
    "wheel_shear",
    order=-5,
    height=Parameter(0.015, 0.0, (0.0, 0.1), "m", "height of the grousers", "VIPER: 10 to 25 mm"),
    count=Parameter(24.0, None, (0.0, 200.0), "1", "number of grousers around the wheel", "VIPER: 24"),
    area_share=Parameter(
        1.0,
        None,
        (0.0, 1.0),
        "1",
        "share mu of the shearing that takes place at the tips",
        "choice: soil between the tips turns with the wheel",
    ),
    largest=Parameter(
        1.5,
        None,
        (1.0, 5.0),
        "1",
        "largest factor of the shear stress",
        "choice: beyond it the tips stand too close to fill with soil",
    ),
)
def grousers(ctx, p, x, wheel):
    """Soil between the tips turns with the wheel: it shears at r_s = r + mu h_g, with 1 + N_g h_g/(2 pi r) the stress.

    r_s = r + h_g: Ishigami et al. 2007, Ding et al. 2011 (with the share mu of the tips); the factor is Iizuka &
    Kubota's (2011) ratio of the grousers' faces to the rim, up to a largest value.
    """
    # Area of the grousers' faces over that of the rim between them.
    faces = p.count * p.height / (math.tau * ctx.geometry.radius)
    lug = p.area_share * p.height * jnp.ones_like(wheel.slip_x)
    # Both factors go by the height, so that grousers of height zero change nothing.
    return dataclasses.replace(wheel, lug=lug, grip=1.0 + jnp.minimum(faces, p.largest - 1.0))


def _amplitude(which: str, nominal: float) -> Parameter:
    return Parameter(
        nominal,
        0.0,
        (-0.9, 0.9),
        "1",
        f"relative amplitude of the soil's stiffness, {which} part",
        "choice: drawbar pull oscillates by some 10 % (Irani et al. 2011)",
        axis="wheel",
    )


@effect(
    "soil",
    order=10,
    transient=True,
    state={"angle": StateVariable(0.0, "rad", "angle turned by the wheel since reset", axis="wheel")},
    cosine=_amplitude("cosine", 0.1),
    sine=_amplitude("sine", 0.0),
    count=Parameter(24.0, None, (1.0, 200.0), "1", "number of grousers around the wheel, a whole number", "VIPER: 24"),
)
def grouser_pulsation(ctx, p, x, ground):
    """k_c, k_phi and c times 1 + a cos(N_g theta) + b sin(N_g theta): the soil yields as each grouser enters.

    Sinkage and drawbar pull oscillate with the frequency N_g omega/2 pi (Irani et al. 2011). Amplitudes rather than
    amplitude and phase, so that both count where they vanish.
    """
    turn = ctx.contact.rim_speed / ctx.geometry.radius
    factor = 1.0 + p.cosine * jnp.cos(p.count * x.angle) + p.sine * jnp.sin(p.count * x.angle)
    soil = dataclasses.replace(
        ground, k_c=ground.k_c * factor, k_phi=ground.k_phi * factor, cohesion=ground.cohesion * factor
    )
    # Kept within one turn: in float32 the angle of a long drive would lose the position of the teeth.
    return soil, {"angle": jnp.mod(x.angle + ctx.dt * turn, math.tau)}
