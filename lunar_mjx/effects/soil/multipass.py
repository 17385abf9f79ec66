"""Soil that has been driven over: ruts and their compacted bottom, remembered at a fixed number of places."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp

from lunar_mjx.effects.base import Parameter, StateVariable, effect


@dataclasses.dataclass(frozen=True)
class TrackMemory:
    """What is remembered of tracks, and how pressed soil differs."""

    places: int = 20
    """Places that every wheel remembers; with the nominal spacing a track of 2 m, in which the following wheels of all
    shipped rovers roll (`ruts` remembers by place). 64 places took two thirds of the time of a step on one H100."""
    fresh: int = 3
    """Latest places of a wheel that lie under or just behind it, and so are no earlier pass."""
    nowhere: float = 1e6
    """Where places lie that have not been visited yet, m from the origin."""
    faint: float = 0.05
    """Nearness, 1 on the place itself, at which the rut is half as deep as in the middle of the track."""
    # Powers of the density with which tan(phi), the cohesion and the shear moduli go. The first two through the four
    # layers of the Lunar Sourcebook's table of lunar soil (Carrier et al. 1991, ch. 9: 1.50, 1.58, 1.66, 1.74 g/cm3;
    # 42, 46, 49, 54 deg; 0.52, 0.90, 1.6, 3.0 kPa), the last as Senatore & Sandu 2011 read Holm's passes: the modulus
    # falls by the share by which the density rises.
    friction_power: float = 2.7
    cohesion_power: float = 11.0
    shear_power: float = -1.0
    most_pressed: float = 0.14
    """Share of its thickness by which soil can be pressed: from 1.50 to 1.74 g/cm3, the ends of that table."""


TRACK = TrackMemory()


def compacted(soil, pressed, thickness):
    """The soil whose upper layer of `thickness`, m, has been pressed together by `pressed`, m: denser, so stronger."""
    denser = thickness / (thickness - jnp.minimum(pressed, TRACK.most_pressed * thickness))
    modulus = denser**TRACK.shear_power
    return dataclasses.replace(
        soil,
        cohesion=soil.cohesion * denser**TRACK.cohesion_power,
        tan_phi=soil.tan_phi * denser**TRACK.friction_power,
        shear_modulus_x=soil.shear_modulus_x * modulus,
        shear_modulus_y=soil.shear_modulus_y * modulus,
    )


def rut_under(ctx, p, x):
    """What earlier passes left under each wheel.

    Args:
      ctx: wheel positions. p: spacing. x: places (place, wheel) with x, y and depth, m.

    Returns:
      Depth that earlier passes pressed the soil to, m, and how fully the wheel stands in a track (0 to 1), per wheel.
    """
    here_x, here_y = ctx.wheel_position.x[None, None, :], ctx.wheel_position.y[None, None, :]
    squared = (x.place_x[:, :, None] - here_x) ** 2 + (x.place_y[:, :, None] - here_y) ** 2
    # A bump of compact support: a place two spacings away no longer counts, and the depth changes without jumps.
    near = jnp.maximum(1.0 - squared / (4.0 * p.spacing**2), 0.0)
    near = near * near
    places, wheels = x.depth.shape
    # A wheel stands in the soil that it is pressing now; its own latest places are that soil and no earlier pass.
    own = jnp.eye(wheels, dtype=bool)[None] & (jnp.arange(places) < TRACK.fresh)[:, None, None]
    near = jnp.where(own, 0.0, near)
    # Weights are normalised, so that the depth found does not depend on how many places lie near.
    total = jnp.sum(near, axis=(0, 1))
    return jnp.sum(near * x.depth[:, :, None], axis=(0, 1)) / (total + TRACK.faint), total / (total + TRACK.faint)


def _remember(ctx, ground, p, x):
    """The remembered places and depths of every wheel, with a new place once it is `spacing` from its last one.

    The latest place deepens with the wheel: a wheel that is set down touches its first place before it sinks in.
    """
    wheel_at, depth = ctx.wheel_position, ctx.contact.sinkage
    gone = (wheel_at.x - x.place_x[0]) ** 2 + (wheel_at.y - x.place_y[0]) ** 2
    # Only soil that is loaded is remembered: a wheel over rock or in the air leaves no rut.
    drop = (gone > p.spacing**2) & (depth > 0.0) & (ground.rock < 0.5)

    def push(old, new):
        # The whole list moves by one or stays: a ring with an index would gather and scatter, which brought no gain on
        # a GPU.
        return jnp.where(drop, jnp.concatenate([new[None], old[:-1]]), old)

    deep = push(x.depth, depth)
    latest = jnp.maximum(deep[:1], jnp.where(ground.rock < 0.5, depth, 0.0)[None])
    places = {"place_x": push(x.place_x, wheel_at.x), "place_y": push(x.place_y, wheel_at.y)}
    return places | {"depth": jnp.concatenate([latest, deep[1:]])}


def _place(axis: str) -> StateVariable:
    return StateVariable(TRACK.nowhere, "m", f"{axis} of the places that the wheel has visited", slots=TRACK.places)


@effect(
    "soil",
    order=20,
    transient=True,
    state={
        "place_x": _place("x"),
        "place_y": _place("y"),
        "depth": StateVariable(0.0, "m", "sinkage of the wheel at those places", slots=TRACK.places),
    },
    plastic=Parameter(
        0.8,
        0.0,
        (0.0, 0.95),
        "1",
        "share of the sinkage that remains when the wheel has passed",
        "choice: k_0 + A_u z_u of dry sand (Wong 2008, ch. 4) unloads almost vertically",
    ),
    spacing=Parameter(
        0.1,
        None,
        (0.02, 2.0),
        "m",
        "distance between remembered places",
        "choice: half a wheel's width, a track then being twice that to either side",
    ),
    compacted_depth=Parameter(
        1.5,
        None,
        (1.0, 10.0),
        "1",
        "thickness of the soil that a pass presses together, in widths of the wheel",
        "choice: the thickest layer with which every pass pulls better, as Holm measured, in all wheel models here",
    ),
)
def multipass(ctx, p, x, ground):
    """Wheels that come later (rear wheels, or any wheel on another pass) roll in ruts of compacted soil.

    A pass to depth z_u leaves a rut of depth e z_u; p = p_u - (k_0 + A_u z_u)(z_u - z) of Wong 2008 from there to z_u,
    with k_0 + A_u z_u = p_u/((1 - e) z_u), is approximated by the soil's own law from the bottom of the rut, made
    stiffer by (1 - e)^-n so that it meets p_u = k z_u^n at z_u again. The soil that left the rut lies pressed together
    below it, denser by H/(H - e z_u) over a thickness H, and so is stronger and needs less displacement. Passes in one
    rut therefore roll easier and pull better, as Holm 1969 measured (Senatore & Sandu 2011). Each wheel remembers the
    last 20 places (their position and depth), and finds those of all wheels but the latest three of its own.
    """
    depth, inside = rut_under(ctx, p, x)
    # The factor by which a shorter sinkage, (1 - e) z_u, has to give the pressure of z_u.
    # The power, not its first order: with e = 0.8 and n = 1 pressed soil is five times as stiff.
    firm = 1.0 + inside * (jnp.power(1.0 - p.plastic, -ground.n) - 1.0)
    pressed = p.plastic * depth
    # The deeper of two ruts: what two effects remember of one pass must not add up.
    rut = pressed if ground.rut is None else jnp.maximum(pressed, ground.rut)
    soil = dataclasses.replace(ground, k_c=ground.k_c * firm, k_phi=ground.k_phi * firm, rut=rut)
    soil = compacted(soil, pressed, p.compacted_depth * ctx.geometry.width)
    return soil, _remember(ctx, ground, p, x)
