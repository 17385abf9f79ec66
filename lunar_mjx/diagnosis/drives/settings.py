"""Every number that decides about drives, in one tree: name, unit, and what it rests on."""

from __future__ import annotations

import dataclasses

from lunar_mjx.diagnosis.weighed.form import SearchSettings


@dataclasses.dataclass(frozen=True)
class DriveSettings(SearchSettings):
    """Sizes, priors and effort of a diagnosis of drives."""

    effect_odds: float = 0.0033
    """1; prior odds of each effect of the catalogue: of some fifty, one is missing in every seventh campaign, as of the
    fifteen of a table. How many are listed says nothing about a rover (multiplicity: Scott & Berger 2010)."""
    laws: tuple[str, ...] = ()
    """Contact laws that are tried beside a model with the closed form, before anything is named, such as
    `stress_integral`; none by itself, since a rival's refit takes longer than all others together."""
    stated_spread: float = 0.3
    """1; standard deviation of the logarithm of the noise's size: it is only stated, or taken from a second of rest."""
    own_share: float = 0.5
    """1; share of a discrepancy's variance that each log has for itself; the rest all logs share."""
    usual_effect: float = 0.05
    """1; scale of the half-normal prior of what every effect does on any rover, over its nominal size: no rover is free
    of friction, play, delay or a displaced centre of mass, and a name is for what goes beyond that."""
    usual_ground: float = 0.05
    """1; scale of the half-normal prior of the heights of ground that nobody mapped, over a wheel's radius."""
    usual_error: float = 0.02
    """1; scale of the half-Cauchy prior of the error that a model's channels have beyond its ports, as a share of what
    a channel does: ground that no map has, play, dynamics that are left out."""
    errors: tuple[float, ...] = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
    """1; sizes of that error which are tried."""
    annealing: tuple[float, ...] = (0.3, 0.1, 0.03, 0.01)
    """1; least sizes of that error, one after the other, by which every refit is led. On a foreign campaign of a Husky
    with late actuators the truth ends 6,500 nats above the model as it is so, else 800."""
    error_times_s: tuple[float, ...] = (1.0, 10.0)
    """s; how long such an error lasts, which are tried: where a law is off, a wheel's speed errs for about a second,
    and its angle, as the sum of that, for all of a drive."""
    least_length: float = 0.3
    """sigma; a direction in which even an unlisted discrepancy is shorter is left out."""
    secant: float = 0.3
    """1; amount of a candidate, in nominal sizes, over which its signature is taken: an effect such as a delay does
    nothing within a time step, and the data ask for amounts of about the nominal one."""
    held_out_sure: float = 0.95
    """1; probability that a name helps held-out drives, below which it is taken back; 0: never. On 8 foreign campaigns
    6 names that fitted drives alone had chosen were wrong, each with more than 0.99."""
    held_out_piece: float = 1.0
    """s; length of the pieces of held-out drives each of which is one witness: as long as a wheel takes to meet ground
    that it has not touched."""

    noise_freedoms: tuple[float, ...] = (2.0, 4.0, 8.0, 16.0, 0.0)
    """1; degrees of freedom of Student's noise of single readings that are tried for each kind of channel; 0 for normal
    noise."""

    span: float = 0.1
    """s; over which readings are averaged before a model is held against them; 0 for every reading by itself."""

    # --- effort ------------------------------------------------------------------------------------------------------
    most_refits: int = 12
    """1; refits of a search, each of which simulates some hundred drives."""
    most_scored: int = 8
    """1; effects beside a set that are scored with sizes of their own, each of which takes a second or more."""
    most_steps: int = 16
    """1; places of a refit of the model as it is at most at each of which errors are learnt, once it was led there."""
    most_jacobians: int = 5
    """1; Jacobians of one descent."""
    settled: float = 2.0
    """chi-square; what a further step must promise, and what the steps with one Jacobian must gain: a nat, a quarter of
    the `window`."""
    longest_step: float = 3.0
    """scale; longest step of a coordinate."""
