"""Every number that decides how drives are refitted: name, unit, and what it rests on."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class DriveRefit:
    """How refits of drives are tried."""

    # --- steps of a descent ------------------------------------------------------------------------------------------
    tried: tuple[tuple[float, float], ...] = (
        (1.0, 1.0),
        (1.0, 0.3),
        (1.0, 0.1),
        (10.0, 1.0),
        (1e3, 1.0),
        (1.0, 0.03),
        (1e2, 1.0),
        (1e2, 0.3),
    )
    """1; steps that are simulated side by side, as far as they fit into one batch: damping over the present one, and
    share of the step so damped. Where one coordinate of a hundred bends, a share of the whole step gains more than a
    damped one: 431 of 728 nats promised at one place of a foreign Husky; damped ones on its way had gained 55 to
    266."""
    damping: float = 1e-3
    """1; least damping, over the diagonal of the normal matrix: nearly a Gauss-Newton step (Marquardt 1963)."""
    stiffer: float = 1e3
    """1; factor on the damping where no step gained."""
    softer: float = 1e-2
    """1; factor on the damping of a step that gained: what held it back may lie behind it."""
    renewed_damping: float = 1.0
    """1; largest damping with which new derivatives begin: they earn new trust."""
    tiring: float = 0.1
    """1; gain of steps over what these derivatives have gained so far below which new ones gain more: they take as long
    as five steps."""
    inside: float = 1e-9
    """scale; distance from a bound at which a refit begins at least."""
    rounding: float = 1e-12
    """scale; distance beyond a bound that is rounding alone."""
    on_time: float = 1e-9
    """1; share of a held-out piece by which a reading may come too early for it: rounding alone."""
    visible: float = 1e-3
    """1; share of the chi-square of a model alone that a step has to promise: half of it in the error that is told."""

    # --- the model as it is ------------------------------------------------------------------------------------------
    nothing_start: float = 0.5
    """1; amount at which a parameter of `FROM_NOTHING` begins, over its prior standard deviation."""
    most_led: int = 5
    """Places at most with each size of errors that a refit is led by."""
    arrived: float = 8.0
    """chi-square; what a place gains at least where more places are looked at before errors lessen."""
    most_learnt: int = 8
    """Steps of EM at one place at most, by which errors of single readings are learnt."""
    most_held: int = 2
    """Such steps where all that a refit moves is held."""
    asked_sizes: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0)
    """1; sizes of a discrepancy, over the usual one, of which its amounts at a place ask for one."""
    shorter: float = 0.3
    """1; share of a step that is kept where the evidence has not risen with it."""
    least_share: float = 0.1
    """1; share of a step below which a refit has ended."""

    # --- the race of candidates ---------------------------------------------------------------------------------------
    race_steps: int = 3
    """Steps of each candidate."""
    race_tried: tuple[tuple[float, float], ...] = ((1.0, 1.0), (1.0, 0.3), (1.0, 0.1), (1e2, 1.0))
    """1; steps that are tried at each, as `tried`."""

    # --- derivatives and signatures ----------------------------------------------------------------------------------
    input_step: float = 1e-3
    """1; step of a derivative by an input before its size is known, over a field of size 1: a fiftieth of what is
    usual."""
    steep: float = 1e4
    """sigma; change of one reading within a coordinate's prior from which a slope is taken to the other side, too."""
    speaks: float = 0.5
    """1; amount that is asked for, over that of a secant, from which the secant is the nearer one."""
    dead: float = 0.01
    """1; length of a derivative over that of the secant below which an effect does nothing at its null."""
    secant_room: float = 0.5
    """1; share of the way to a bound that a secant takes at most."""
    together: int = 8
    """Candidates whose signatures one program simulates: fewer are faster per rover, more are fewer programs to
    make."""
    most_at_once: int = 4
    """Such programs that are made and run side by side at most: each holds some hundred rovers in memory."""


DRIVE_REFIT = DriveRefit()
