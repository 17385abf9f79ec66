"""A rover's model held against drives, with all effects that may be missing and what may be wrong at its ports."""

from __future__ import annotations

import concurrent.futures
import copy
import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.baseline import FROM_NOTHING
from lunar_mjx.diagnosis.drives.channel_errors import ChannelErrors, error_kind
from lunar_mjx.diagnosis.drives.differences import STEP
from lunar_mjx.diagnosis.drives.instruments import usual_kind
from lunar_mjx.diagnosis.drives.nuisances import is_linear
from lunar_mjx.diagnosis.drives.observations import with_errors
from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.diagnosis.drives.simulation.program import cores
from lunar_mjx.diagnosis.drives.simulation.unmapped_ground import POSE
from lunar_mjx.diagnosis.unknown_inputs.inputs import FOLLOWS
from lunar_mjx.diagnosis.unknown_inputs.port_fields import DRAWBAR, SHARES, WORDS, Usual, rotation
from lunar_mjx.diagnosis.weighed.form import MeasuredForm
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import (
    Amplitudes,
    Evidence,
    EvidenceError,
    Field,
    Gram,
    NoiseSize,
    expected_square,
    infer,
    infer_levels,
)
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.single_errors import single_errors
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Linear, Refit, Term
from lunar_mjx.logs.schema import parse_name

OWN_FORM = "the model"
USUAL_EFFECTS = "effects of usual size"
"""The field of all effects that no hypothesis names: every rover has a little of each."""
GROUND = "height of the ground"
"""The field of ground that nobody mapped, in wheel radii."""
LEARNT = frozenset({"channel_errors", "error_times_s"})
"""What `DriveForm.learnt` tells of the errors with which all hypotheses are weighed."""


@dataclasses.dataclass(frozen=True)
class DriveRefit:
    """How refits of drives are tried."""

    factors: tuple[float, ...] = tuple(10.0 ** (0.5 * k) for k in range(8))
    """1; dampings of steps that are simulated side by side, over the present one, as far as they fit into one batch."""
    damping: float = 1e-3
    """1; least damping, over the diagonal of the normal matrix: nearly a Gauss-Newton step (Marquardt 1963)."""
    stiffer: float = 1e3
    """1; factor on the damping where no step gained."""
    softer: float = 1e-2
    """1; factor on the damping of a step that gained: what held it back may lie behind it."""
    steep: float = 1e4
    """sigma; change of one reading within a coordinate's prior from which a slope is taken to the other side, too."""
    speaks: float = 0.5
    """1; amount that is asked for, over that of a secant, from which the secant is the nearer one."""
    dead: float = 0.01
    """1; length of a derivative over that of the secant below which an effect does nothing at its null."""
    visible: float = 1e-3
    """1; share of the chi-square of a model alone that a step has to promise: half of it in the error that is told."""
    together: int = 8
    """Candidates whose signatures one program simulates: fewer are faster per rover, more are fewer programs to
    make."""
    most_at_once: int = 4
    """Such programs that are made and run side by side at most: each holds some hundred rovers in memory."""


DRIVE_REFIT = DriveRefit()


class DriveForm(MeasuredForm):
    """A rover's model against drives.

    Derivatives are difference quotients between rovers of one batch. Those that lead a descent are taken where it
    stands. Hypotheses are weighed with those at one place, where the descent of the model as it is has learnt its
    errors, but for those of a refit's own effects.
    """

    def __init__(
        self,
        drives: DriveProblem,
        settings: DriveSettings,
        progress: Progress = silent,
        name: str = OWN_FORM,
        beside: DriveForm | None = None,
    ):
        """Makes the form.

        Args:
          drives: simulation of the logs with all candidates and unknown inputs. settings: sizes and priors.
          progress: told of refits. name: of the form.
          beside: the model's own form where this is a rival of it, weighed against measurements with the same errors.
        """
        self.drives, self.settings, self.progress = drives, settings, progress
        self.name, self.log_prior, self.late = name, 0.0, beside is not None
        self._rival_of = beside
        labels = list(drives.inputs)
        self.discrepancy = np.concatenate([np.zeros(0, int), *(drives.inputs[label] for label in labels)])
        self.coordinates, self.ground = drives.coordinates, drives.ground
        # (coordinates,) field that a coordinate belongs to, of discrepancy the common part, or -1
        self._field_of = np.full(len(self.coordinates), -1)
        self._field_of[self.discrepancy] = np.repeat(np.arange(len(labels)), [len(drives.inputs[k]) for k in labels])
        self.baseline, self.candidates = drives.baseline, dict(drives.candidates)
        self.words = {label: WORDS[label] for label in labels}
        self.shares = SHARES
        self.terms = (
            *(Term(e, EFFECT, settings.effect_log_odds) for e in self.candidates),
            *(Term(label, UNLISTED, settings.unlisted_log_odds) for label in labels),
        )
        usual = self._usual = usual_of(drives)
        # (coordinates,) prior standard deviations: shapes of candidates keep their own
        self._std = np.array([c.prior for c in self.coordinates])
        for places in self.candidates.values():
            for i in places:
                if self.coordinates[i].amplitude:
                    self._std[i] = self.effect_size(self.coordinates[i])
        # (discrepancy,) standard deviations of a log's amounts at size 1: what logs share and what each has for itself
        sizes = np.array([usual.size(label, q) for label in labels for q in FOLLOWS[label]])
        self._whole_size = sizes / np.array([self.coordinates[i].scale for i in self.discrepancy])
        self._hold(Errors(drives.observations))
        kinds = [error_kind(s.channel) for s in self.observations.series]
        self.noise_names = tuple(dict.fromkeys(kinds))
        self._group = np.empty(len(self.observations), int)
        for s, name in zip(self.observations.series, kinds, strict=True):
            self._group[s.start : s.stop] = self.noise_names.index(name)
        self._fit = self.observations.in_split("fit")
        fitted = {log: bool(self._fit[part.start]) for log, part in self.observations.of_log.items()}
        self._share = _Share.of(settings.own_share, list(fitted.values()))
        self._number = {f.name: k for k, f in enumerate(self._usual_fields())}  # of each field
        # ground of fitted logs, which refits move; that of held-out ones is mapped by their pose alone
        own = np.array([fitted.get(self.coordinates[i].log_index, False) for i in drives.ground], bool)
        self._own_ground, self._other_ground = drives.ground[own], drives.ground[~own]
        if len(drives.ground):
            self._field_of[self._own_ground] = self._number[GROUND]
        self._std[self.discrepancy] = math.sqrt(self._share.mean) * self._whole_size
        # (coordinates,) steps of derivatives, in scales. Inputs act on every reading, at all times: to first order in a
        # fiftieth of what is usual a jump of a reading is little, where over a short step it is a slope of thousands.
        own = [FROM_NOTHING.get(c.effect, {}).get(c.name, (0.0, 0.0, STEP))[2] for c in self.coordinates]
        self._steps = np.array(own)
        self._steps[self.discrepancy] = 1e-3 * self._whole_size
        self._seen: np.ndarray | None = None  # (n, coordinates) derivatives at the base, SI
        self._secants: np.ndarray | None = None  # (n, coordinates) changes by a usual amount there, over that amount
        kinds = [usual_kind(c) for c in self.coordinates]
        self._instruments = {k: np.flatnonzero([kind == k for kind in kinds]) for k in dict.fromkeys(kinds) if k}
        self._slopes: dict[frozenset[str], tuple[np.ndarray, np.ndarray]] = {}
        self._frame: tuple[np.ndarray, np.ndarray] | None = None  # what moves at the base, and derivatives by it
        self._sizes: tuple[np.ndarray, np.ndarray] | None = None
        self.start = self._as_given()  # where the first refit begins
        self.kept: Mapping[str, Any] = {}  # what `learnt` told of that place; then it has been refitted already
        self._trial: np.ndarray | None = None  # where a refit begins for which an effect is to act
        self._base = self.origin()  # where it was refitted

    @property
    def parts(self) -> list[list[str]]:
        """Candidates whose signatures are simulated by one program each."""
        names = list(self.candidates)
        return [names[at : at + DRIVE_REFIT.together] for at in range(0, len(names), DRIVE_REFIT.together)]

    # --- predictions and derivatives ---------------------------------------------------------------------------------

    def predicted(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`."""
        return self.drives.predict(u[None])[0]

    def told(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`: a reading that is far off is told so, whatever error of its own it is weighed with."""
        plain = self.errors.plain
        return plain.whiten(plain.value - self.predicted(u))

    def jacobian(self, u: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) at (coordinates,) and their derivatives (n, free).

        A jump of a hundredth of a sigma within a difference quotient's step would be a slope of a hundred thousand, and
        stand in it as knowledge. Where a slope says so much, the one to the other side is taken as well, and of each
        reading's two the flatter: the other has the jump.
        """
        value, slopes = self.drives.jacobian(u, free, steps=self._steps)
        slopes = np.where(np.isfinite(slopes), slopes, 0.0)
        steep = self._steep(slopes, free)
        if len(steep):
            other = self.drives.jacobian(u, free[steep], side=-1, steps=self._steps)[1]
            slopes[:, steep] = _flatter(slopes[:, steep], other)
        return value, slopes

    def _steep(self, slopes: np.ndarray, which: np.ndarray) -> np.ndarray:
        """Which of some coordinates' slopes (n, m) say more of a reading than any can be true."""
        reach = np.abs(slopes) * self._std[which] / self.observations.sigma()[:, None]
        return np.flatnonzero(reach.max(axis=0, initial=0.0) > DRIVE_REFIT.steep)

    def _look(self, u: np.ndarray, free: np.ndarray) -> np.ndarray:
        """(n, free) derivatives at a place (coordinates,), about which instruments' errors are linear from now on.

        They become signatures, with those of the ground of held-out drives.
        """
        self.drives.about(u)
        which = np.concatenate([free, self._other_ground])
        slopes = self.jacobian(u, which)[1]
        if self._seen is None:
            self._seen = np.zeros((len(self.observations), len(self.coordinates)))
        self._seen[:, which] = slopes
        return slopes[:, : len(free)]

    def _see(self, u: np.ndarray) -> None:
        """Takes the signatures of all candidates at a refit of the model as it is, which has been looked at.

        Candidates for which the time does not suffice are `skipped`: they have no signature.
        """
        parts = self.parts
        assert self._seen is not None
        seen, secants = self._seen, np.zeros_like(self._seen)

        def take(part: list[str]) -> tuple[str, ...]:
            """Fills in the signatures of some candidates; those are returned for which there was no time."""
            amplitudes = np.array([i for e in part for i in self.candidates[e] if self.coordinates[i].amplitude], int)
            far = np.array([self._secant(i) for i in amplitudes])
            steps = np.concatenate([np.copysign(STEP, far), far])
            try:
                quotients = self._changes(u, np.tile(amplitudes, 2), steps) / steps
            except TimeUp:
                return tuple(part)
            seen[:, amplitudes], secants[:, amplitudes] = self._tamed(amplitudes, *np.split(quotients, 2, axis=1))
            self.progress("signatures of all candidates", math.nan)
            return ()

        # one program is made while another runs: the first takes Python's lock, and the second a core
        with concurrent.futures.ThreadPoolExecutor(min(cores(), DRIVE_REFIT.most_at_once)) as pool:
            self.skipped = tuple(name for late in pool.map(take, parts) for name in late)
        self._secants = secants

    def _tamed(self, places: np.ndarray, slopes: np.ndarray, secants: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Derivatives (n, m) and secants (n, m) of candidates, where either tells nothing the other in its place.

        A jump of a hundredth of a sigma within a step is no slope (see `jacobian`), and an effect such as a delay does
        nothing within a time step.
        """
        reach = self._std[places] / self.observations.sigma()[:, None]
        jumps = (np.abs(slopes) * reach > DRIVE_REFIT.steep) & (np.abs(slopes) > np.abs(secants))
        slopes = np.where(jumps, secants, slopes)
        sizes = [np.linalg.norm(q * reach, axis=0) for q in (slopes, secants)]
        slopes = np.where(sizes[0] < DRIVE_REFIT.dead * sizes[1], secants, slopes)
        return slopes, np.where(sizes[1] > 0.0, secants, slopes)

    def _choose_signatures(
        self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, sizes: tuple[np.ndarray, np.ndarray]
    ) -> None:
        """Takes of each candidate's derivative and secant the one that explains more of what the model leaves.

        Where wheels stick and slip a usual amount may lead elsewhere than its beginning. On two foreign campaigns of a
        Husky slip-sinkage showed with 348 nats by its secant and not at all by its derivative, and a wheel that is too
        small with 3 and 24. A secant speaks of amounts as large as its own alone: beside the slope of a clock, which
        every model has, it would else stand for a curve that no clock bends (252 nats where nothing was hidden).

        Args:
          u, free, slopes: as for `_columns`. sizes: of discrepancy and noise there.
        """
        assert self._seen is not None and self._secants is not None
        tau, noise = sizes
        columns, residual, number = self._columns(u, free, slopes)
        count = len(self.coordinates)
        scale = np.concatenate([self._prior_std(tau), tau[number]])
        whole = np.column_stack([columns * scale, self._secants * self._std, residual])
        white = self.observations.whiten(whole)[self._fit] / noise[self._group[self._fit], None]
        always = np.concatenate([self._free(frozenset()), np.arange(count, len(scale))]).astype(int)
        # What the rest takes up, the priors counted as observations.
        rest = white[:, always]
        seen = rest.T @ white
        # Amounts are counted from the refit: from the prior's mean rounding would hide the residual.
        seen[:, -1] += (self._prior_mean(u, len(number)) / scale)[always]
        factor = linalg.cho_factor(np.eye(len(always)) + rest.T @ rest)
        left = white - rest @ linalg.cho_solve(factor, seen)

        def explained(places: np.ndarray) -> tuple[float, np.ndarray]:
            """Log evidence of columns of `white` at these sizes, and the amounts, over the prior's, with it."""
            matrix = np.eye(len(places)) + white[:, places].T @ left[:, places]
            seen = white[:, places].T @ left[:, -1]
            amounts = np.linalg.solve(matrix, seen)
            return float(0.5 * seen @ amounts - 0.5 * np.linalg.slogdet(matrix)[1]), amounts

        for places in self.candidates.values():
            far = np.array([self._secant(i) for i in places])
            amounts = explained(len(scale) + places)[1] * self._std[places]
            speaks = amounts / far > DRIVE_REFIT.speaks
            mixed = np.where(speaks, len(scale), 0) + places
            if speaks.any() and explained(mixed)[0] > explained(places)[0]:
                self._seen[:, places[speaks]] = self._secants[:, places[speaks]]

    def effect_size(self, c: Coordinate) -> float:
        """See `MeasuredForm`: nominal sizes are a small rover's; a larger one's forces and torques are larger."""
        return self.settings.effect_size * max(1.0, self._usual.amounts.get(c.unit, 0.0) / abs(c.scale))

    def _secant(self, i: int) -> float:
        """Amount of a candidate's amplitude over which its signature is taken."""
        low, high = self.coordinates[i].bounds()
        step = self.settings.secant * self._std[i] * (1.0 if high > 0.0 else -1.0)
        return float(np.clip(step, 0.5 * low, 0.5 * high))

    def _changes(self, u: np.ndarray, which: Sequence[int] | np.ndarray, steps: np.ndarray) -> np.ndarray:
        """(n, m) changes of the predictions by a step of each of some coordinates alone; 0 where a rover diverged."""
        rows = np.repeat(u[None], 1 + len(which), axis=0)
        rows[1 + np.arange(len(which)), which] += steps
        values = self.drives.predict(rows)
        change = values[1:] - values[:1]
        change[~np.isfinite(change).all(axis=1)] = 0.0
        return change.T

    def _field_columns(
        self, observations: Observations, inputs: np.ndarray, but: frozenset[str] = frozenset()
    ) -> tuple[np.ndarray, np.ndarray]:
        """Columns (n, m) of all fields at size 1, SI units, and the field (m,) of each: of every log for itself.

        They are turned so that few are left which the observations' noise does not hide. The mean over the fitted logs
        is a coordinate, which a refit moves: a linear estimate of it would hold for no more than a per cent or two.

        Args:
          observations: with the channels' errors. inputs: (n, discrepancy) derivatives there.
          but: effects that are no part of what is usual: where an effect has its own refit, the difference of its
            derivatives here and there would be one more freedom, which no other hypothesis has.
        """
        assert self._seen is not None
        settings, share = self.settings, self._share
        columns, number = [np.zeros((len(observations), 0))], [np.zeros(0, int)]
        # (n, amounts) what each log has of every amount beside the mean: rows of a log are alike
        apart = np.zeros((len(observations), share.apart.shape[1]))
        for part, own in zip(observations.of_log.values(), share.apart, strict=True):
            apart[part] = own
        for k in range(len(self.words)):
            own = self._field_of[self.discrepancy] == k
            mine = inputs[:, own] * self._whole_size[own]
            whole = (apart[:, :, None] * mine[:, None, :]).reshape(len(mine), -1)
            turned = whole @ rotation(observations.whiten(whole), settings.least_length / settings.unlisted_discrepancy)
            columns.append(turned)
            number.append(np.full(turned.shape[1], k))
        others = [own for e, own in self.candidates.items() if e not in but]
        small = [i for own in others for i in own if self.coordinates[i].amplitude]
        whole = self._seen[:, small] * self._std[small]
        turned = whole @ rotation(observations.whiten(whole), settings.least_length / settings.usual_effect)
        columns.append(turned)
        number.append(np.full(turned.shape[1], self._number[USUAL_EFFECTS]))
        return np.column_stack(columns), np.concatenate(number)

    def _prior_mean(self, u: np.ndarray, count: int) -> np.ndarray:
        """(coordinates + m,) prior mean of all that `_columns` has columns of, relative to a place.

        Args:
          u: the place. count: m; the last of these are of the ground of held-out drives, which has been moved to there.
        """
        fields = np.zeros(count)
        fields[count - len(self._other_ground) :] = -u[self._other_ground]
        return np.concatenate([[c.centre for c in self.coordinates] - u, fields])

    def _inputs(self, free: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(n, discrepancy) derivatives by discrepancy among those (n, free) of some coordinates."""
        return slopes[:, np.isin(free, self.discrepancy)]

    def _columns(
        self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, effects: frozenset[str] = frozenset()
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives (n, k) by all that hypotheses hold, and residuals (n,), SI units, around a place (coordinates,).

        Args:
          u: the place. free: coordinates, discrepancy among them, whose derivatives (n, free) there are the `slopes`;
            others keep signatures. effects: of a refit.

        Returns:
          The derivatives, the residuals, and the field (m,) of each of the last columns.
        """
        assert self._seen is not None
        seen = self._seen.copy()
        seen[:, free] = slopes
        residual = self.observations.value - self.predicted(u)
        # Of a mean over other logs a held-out one is expected to have a share alone.
        held_out, inputs, known = ~self._fit, self._inputs(free, slopes), self._share.known
        residual[held_out] += (1.0 - known) * inputs[held_out] @ u[self.discrepancy]
        seen[np.ix_(held_out, self.discrepancy)] *= known
        columns, number = self._field_columns(self.observations, inputs, effects)
        ground = self._other_ground
        number = np.concatenate([number, np.full(len(ground), self._number.get(GROUND, -1))])
        return np.column_stack([seen, columns, self._seen[:, ground]]), residual, number

    def _linear(self, u: np.ndarray, effects: frozenset[str], slopes: np.ndarray, unkept: float = 0.0) -> Linear:
        """Everything that hypotheses need around a place (coordinates,) with some effects.

        Args:
          u: the place. effects: those of the refit. slopes: (n, free) derivatives there. unkept: see `Linear`.
        """
        settings, count = self.settings, len(self.coordinates)
        columns, residual, field_of = self._columns(u, self._free(effects), slopes, effects)
        columns, residual = self.observations.whiten(columns), self.observations.whiten(residual)
        std = np.concatenate([self._std, np.ones(len(field_of))])
        low, high = np.full(len(std), -np.inf), np.full(len(std), np.inf)
        # Where the step's error or a reading before its command would have to be more than all there is, the model is
        # not that much better: linear estimates had gone beyond (on a foreign campaign of a Husky clock_offset promised
        # 87 nats so, and its refit gained none).
        bounded = np.concatenate([self.baseline, *(i for i in self.candidates.values())]).astype(int)
        bounded = bounded[[i in self.baseline or self.coordinates[i].amplitude for i in bounded]]
        low[bounded], high[bounded] = np.array([self.coordinates[i].bounds() for i in bounded]).T - u[bounded]
        at = np.zeros(len(std))
        for places in self.candidates.values():
            at[places] = u[places]
        kinds, fit, observations = len(self.noise_names), self._fit, self.observations
        held = {}
        for name, rows in held_out_pieces(observations, settings.held_out_piece).items():
            held[name] = Gram.of(columns[rows], residual[rows], self._group[rows], kinds)
        return Linear(
            gram=Gram.of(columns[fit], residual[fit], self._group[fit], kinds),
            held_out=held,
            # Amplitudes are counted from the refit: the prior's centre lies at its distance from there.
            amplitudes=Amplitudes(std, np.concatenate([self._field_of, field_of]), self._prior_mean(u, len(field_of))),
            low=low,
            high=high,
            always=np.concatenate([self._free(frozenset()), np.arange(count, len(std))]).astype(int),
            effects=self.candidates,
            at=at,
            calibration=self._instruments,
            following={},
            fields=self._usual_fields(),
            noises=self._noise_sizes(),
            wide=settings.unlisted_discrepancy,
            far=1.0,
            amount=self.amounts(len(std)),
            freedom=settings.effect_freedom,
            unkept=unkept,
        )

    def _free(self, effects: frozenset[str]) -> np.ndarray:
        """Places that a refit with some effects moves: of the model, of unmapped ground, of common discrepancy, and of
        them."""
        own = [places for name, places in self.candidates.items() if name in effects]
        return np.concatenate([self.baseline, self._own_ground, self.discrepancy, *own])

    def _prior_std(self, tau: np.ndarray) -> np.ndarray:
        """(coordinates,) prior standard deviations where discrepancy has sizes (fields,)."""
        return np.where(self._field_of < 0, self._std, self._std * tau[self._field_of])

    def measuring(self, value: np.ndarray, start: np.ndarray) -> DriveForm:
        """A form of this model against other measurements.

        Args:
          value: (n,) what is measured instead, in SI units. start: (coordinates,) where its refits begin.
        """
        drives = copy.copy(self.drives)
        drives.observations = dataclasses.replace(drives.observations, value=value)
        drives.noise_unlearnt = False
        other = DriveForm(drives, self.settings)
        other.start = start
        return other

    # --- refits ------------------------------------------------------------------------------------------------------

    def trial(self, u: np.ndarray, effect: str) -> np.ndarray:
        """See `Form`."""
        self._trial = super().trial(u, effect)
        return self._trial

    def _as_given(self) -> np.ndarray:
        """(coordinates,) where refits begin: the model as given, and parameters of `FROM_NOTHING` at half their prior.

        At zero such a parameter has next to no slope while the other constants of contact move first, and a descent
        that begins there may leave it there.
        """
        place = self.origin()
        for i in self.baseline:
            c = self.coordinates[i]
            if c.name in FROM_NOTHING.get(c.effect, {}) and c.start == 0.0:
                place[i] = 0.5 * self._std[i]
        return place

    def learnt(self, refit: Refit) -> dict[str, Any]:
        """Log evidence of a refit, and the errors beside the noise that it was found with.

        The evidence is that of the fitted measurements in their units, so that runs with other settings compare.

        Args:
          refit: of this form.

        Returns:
          `log_evidence`; `channel_errors`, shares of what a channel does, and `error_times_s`, how long these last, by
          channel.
        """
        value = refit.linear.evidence(self.listed(refit.effects))[0]
        return {
            "log_evidence": value + self._log_scale(),
            "channel_errors": dict(self.errors.by_channel),
            "error_times_s": dict(self.errors.times_s),
        }

    def _log_scale(self) -> float:
        """What turns a log evidence in sigma of normal noise into one of the fitted measurements in their units, under
        Student's noise."""
        return float(np.sum((self.errors.log_ratio - self.observations.log_widths())[self._fit]))

    def limit(self, until: float) -> None:
        """See `MeasuredForm`."""
        self.drives.bench.deadline.until = until

    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> Refit:
        """See `Form`; Levenberg-Marquardt under the covariance of noise and discrepancy.

        Raises:
          TimeUp: before the refit had ended; that of the model as it is counts from wherever it has come.
        """
        first = self._frame is None
        if first:
            if effects:
                raise EvidenceError("the model as it is has not been refitted")
            start = self._own_refit()
        free = self._free(effects)
        u = self.origin()
        u[self.drives.ground] = self._base[self.drives.ground]
        given = start if start is not None else None if near is None else near.u
        if given is not None:
            u[free] = given[free]
        low, high = self.drives.bounds(free)
        u[free] = np.clip(u[free], low + 1e-9, high - 1e-9)
        # A trial begins where its effect acts, whatever that costs: at its null it may have no slope.
        if near is not None and start is not None and start is not self._trial:
            u = self._better_start(u, near, free)
        slopes = self._guess(free, near)
        terms, sizes = self.listed(effects), self._sizes if near is None else self._sizes_of(near)
        best: tuple[float, np.ndarray, np.ndarray, Linear] | None = None
        for number in range(self.settings.most_rounds):
            guessed = number == 0 and bool(effects)
            u, slopes = self._descend(u, free, sizes, slopes, guessed=guessed, whole=not first)
            try:
                linear = self._reached(u, effects, free, slopes)
                value, found, _ = linear.evidence(terms, sizes)
            except EvidenceError:
                # A place of which nothing can be told is not gone to; the one before it stands.
                if best is None:
                    raise
                break
            gained = math.inf if best is None else value - best[0]
            if best is None or gained > 0.0:
                best = value, u, slopes, linear
            if gained < self.settings.settled:
                break
            sizes = self._led_by((found.tau, found.noise))
        assert best is not None
        _, u, slopes, linear = best
        self._slopes[effects] = free, slopes
        if first:
            self._base = u
        return Refit(self.name, effects, u, linear)

    def _reached(self, u: np.ndarray, effects: frozenset[str], free: np.ndarray, slopes: np.ndarray) -> Linear:
        """What hypotheses need around the place of a refit, all with one discrepancy: that of the model as it is.

        Derivatives of all but the effects' own are those at the base. They jump from one place to the next, so that two
        places which predict alike would have evidences hundreds of nats apart. What derivatives promise beyond the
        place by the sizes that led the descent, and no step has kept, is credited to none, but for so little that no
        further step was asked for it. What larger discrepancy would explain is credited to all alike, as far as
        derivatives tell it.

        Args:
          u: the place. effects: of the refit. free, slopes: as for `_descend`.
        """
        assert self._frame is not None
        framed, own = slopes.copy(), np.isin(free, self._frame[0])
        framed[:, own] = self._frame[1]
        linear = self._linear(u, effects, framed)
        found = linear.evidence(self.listed(effects), self._sizes)[1]
        cost = self._cost(u, free, self._led_by((found.tau, found.noise)), self._frame_inputs)
        promise = self._promise(cost, u, free, framed)
        return dataclasses.replace(linear, unkept=0.5 * max(promise - self.settings.settled, 0.0))

    @property
    def _frame_inputs(self) -> np.ndarray | None:
        """(n, discrepancy) derivatives at the base; None where it has not been refitted."""
        return None if self._frame is None else self._inputs(*self._frame)

    def _own_refit(self) -> np.ndarray:
        """(coordinates,) where the model as it is explains most, with the errors that all hypotheses are weighed with.

        Derivatives there are the discrepancy of all hypotheses.

        Raises:
          EvidenceError, TimeUp: as for `refit`.
        """
        free, arrived = self._free(frozenset()), not self.candidates
        if self._rival_of is not None:
            self._begin_beside(self._rival_of)
            u = self._approach(self._nearer_start(free), free)
        elif self._take_kept():
            u, arrived = self.start, False
        else:
            self._forget_errors()
            # Instruments first: currents that are read before a command's jump differ by thirty sigma from those after
            # it, and a descent that moves everything at once follows them into soil that nothing brings it back from.
            nuisances = free[[self.coordinates[i].nuisance and self._field_of[i] < 0 for i in free]]
            u = self._descend(self.start, nuisances)[0]
            # Ground before soil: waves that nobody mapped cost a rover more torque than a few per cent of the soil's
            # constants do, which would follow them.
            if len(self._own_ground):
                u = self._descend(u, np.concatenate([nuisances, self._own_ground]), self._usual_sizes())[0]
            u = self._approach(u, free)
            if self.drives.noise_unlearnt:
                self.drives.learn_noise(u)
                self._forget_errors()
                arrived = False
        if self.candidates:
            self._look(u, free)
            self._see(u)
        if not arrived:
            # with a little of every effect among what is usual
            u = self._approach(u, free)
        slopes = self._look(u, free)
        assert self._sizes is not None
        self._frame = self._slopes[frozenset()] = free, slopes
        self._base = u
        if self.candidates:
            self._choose_signatures(u, free, slopes, self._sizes)
        return u

    def _approach(self, u: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Moves the model as it is to where its evidence is highest, errors and sizes with it.

        Errors are learnt anew at every Jacobian: at a poor place they are large, and a descent that kept them would end
        there. The time may end it wherever it has come.

        Args:
          u: where from. free: places of what moves.

        Returns:
          (coordinates,) where to; `errors` and sizes are those of there.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before that was looked at.
        """
        settings, damping, idle, looks = self.settings, DRIVE_REFIT.damping, 0, 0
        best: tuple[float, np.ndarray, Errors, tuple[np.ndarray, np.ndarray]] | None = None
        slopes = np.zeros((0, 0))
        try:
            for _ in range(settings.most_steps):
                # A second look at a place has steps that fit what the first has found; a third would see the same.
                if looks < 2:
                    slopes = self._look(u, free)
                looks += 1
                learnt = self._learn_errors(u, free, slopes)
                assert self._sizes is not None
                cost = self._cost(u, free, self._sizes, self._inputs(free, slopes))
                # what slopes promise has not been reached yet
                value = learnt.log_evidence - 0.5 * self._promise(cost, u, free, slopes)
                gained = math.inf if best is None else value - best[0]
                if best is None or gained > 0.0:
                    best = value, u, self.errors, self._sizes
                # Smaller errors promise more of the same slopes: one place without a gain may lie on the way.
                idle = idle + 1 if gained < 0.5 * settings.settled else 0
                if idle > 1:
                    break
                self.progress("refitting the model as it is", math.nan)
                there = self._step(cost, u, free, slopes, damping, settings.settled)
                damping, looks = min(there.damping, 1.0), looks if there.gained == 0.0 else 0
                u = self._map_held_out(there.u, u, slopes, free)
                # A rival is weighed against measurements with the very errors of the model's own form.
                if self._rival_of is None:
                    self._learn_single_errors(learnt)
        # A place of which nothing can be told is not gone to; the best one before it stands.
        except (EvidenceError, TimeUp):
            if best is None:
                raise
        assert best is not None
        _, u, errors, self._sizes = best
        self._hold(errors)
        return u

    def _better_start(self, start: np.ndarray, near: Refit, free: np.ndarray) -> np.ndarray:
        """Of a linear estimate's place, the refit around which it was made, and that refit with the estimate's effects
        alone, the one that the model itself likes best.

        A linear estimate moves soil and starts of logs along slopes that do not hold so far: of a foreign LUVMI-X whose
        IMU is off, refits from the estimate's place ended 25 nats below those from the refit around which it was made.
        """
        # What that refit has and this set has not stays at its null: a set is told by what it has alone.
        there, (low, high) = start.copy(), self.drives.bounds(free)
        there[free] = np.clip(near.u[free], low, high)
        rows = np.stack([start, there, there])
        own = np.setdiff1d(free, self._free(frozenset()))
        rows[2, own] = start[own]
        cost = self._cost(near.u, free, self._sizes_of(near), self._frame_inputs)
        return self._least(cost, rows, free)

    def alone(self, refit: Refit) -> np.ndarray:
        """See `MeasuredForm`; from the refit's parameters and from those as given.

        A refit that leaves much to discrepancy may predict worse without it than the model as given does.
        """
        free = self._slopes[refit.effects][0]
        free = free[self._field_of[free] < 0]
        fitted = self.bare(refit.u)
        given = fitted.copy()
        given[[i for i in self.baseline if not self.coordinates[i].nuisance]] = 0.0
        centre = np.array([self.coordinates[i].centre for i in free])

        def cost(u: np.ndarray) -> float:
            left = self.residual(u)[self._fit]
            # a simulation that diverged is no candidate
            return float(np.nan_to_num(left @ left, nan=np.inf) + np.sum(((u[free] - centre) / self._std[free]) ** 2))

        starts = [u for u in (fitted, given) if math.isfinite(cost(u))]
        return min((self._descend(u, free, once=True, whole=bool(refit.effects))[0] for u in starts), key=cost)

    def _learn_errors(self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray) -> _Learnt:
        """Takes errors of channels of the most probable sizes, and sizes of what is usual, with errors of single
        readings as they are.

        Args:
          u, free, slopes: as for `_columns`.
        """
        columns, residual, number = self._columns(u, free, slopes)
        count, ground = len(self.coordinates), len(self._other_ground)
        # ground of held-out drives, whose columns are the last, does nothing to the fitted ones
        always = np.concatenate([free, np.arange(count, columns.shape[1] - ground)])
        std = np.concatenate([self._std, np.ones(len(number))])[always]
        field = np.concatenate([self._field_of, number])[always]
        prior = Amplitudes(std, field, self._prior_mean(u, len(number))[always])
        columns, fit = columns[:, always], self._fit
        fields, noises, begun = self._usual_fields(bounded=True), self._noise_sizes(), self._sizes

        def as_they_are() -> _Learnt:
            white = self.observations.whiten(np.column_stack([columns, residual]))[fit]
            gram = Gram.of(white[:, :-1], white[:, -1], self._group[fit], len(self.noise_names))
            found = infer(gram, prior, fields, noises, begun)
            return _Learnt(found.log_evidence + self._log_scale(), found, columns, residual)

        # What an earlier run or a rival has found of the channels holds: all hypotheses were weighed with it.
        if self.kept:
            learnt = as_they_are()
        else:
            if begun is None:
                # first those of single readings: a few that are far off would else be a slow error of all
                self._learn_single_errors(as_they_are())
            # a place that is a step away has other errors by little
            here = self._channel_errors().at_shares(self.errors.by_channel, self.errors.times_s)
            start = None if begun is None else here
            errors = self._channel_errors(self.errors.single)
            found = infer_levels(errors.levels(columns, residual, start), prior, fields, noises, begun)
            assert found.levels is not None
            self._take(found.levels)
            value = found.log_evidence + float(np.sum((self.errors.log_ratio * np.ones(len(fit)))[fit]))
            learnt = _Learnt(value, found, columns, residual)
        self._sizes = self._led_by((learnt.found.tau, learnt.found.noise))
        # Slopes by inputs are to hold as far as these may still be off; over shorter steps single readings jump. (Of 31
        # sigma that inputs of a campaign of LUVMI-X might still change, slopes over a thousandth left 9.3, these 5.9.)
        inputs = np.flatnonzero(np.isin(free, self.discrepancy))
        self._steps[free[inputs]] = np.sqrt(np.diag(learnt.found.covariance)[inputs])
        return learnt

    def _learn_single_errors(self, learnt: _Learnt) -> None:
        """Takes errors of single readings by a step of EM, given what the model has been found to leave.

        Where a wheel sticks or slips, meets an edge or begins to turn, a prediction jumps with every little change, and
        some readings are off by many times what others are. Normal noise would have to be as large as these for all.
        """
        square = expected_square(self.observations.whiten(learnt.found.left(learnt.columns, learnt.residual)))
        square = square / learnt.found.noise[self._group] ** 2
        freedoms = [freedom or math.inf for freedom in self.settings.noise_freedoms]
        single = single_errors(self.errors.plain, self.observations, square, self._group, self._fit, freedoms)
        self._hold(dataclasses.replace(self.errors, single=single.std, log_ratio=single.log_ratio))

    def _channel_errors(self, single: np.ndarray | float = 0.0) -> ChannelErrors:
        """Observations with each size of their channels' errors, and with errors of single readings."""
        seen = with_errors(self.drives.observations, np.broadcast_to(single, len(self.drives.observations)))
        return ChannelErrors(seen, self._group, len(self.noise_names), self.settings)

    def _take(self, levels: np.ndarray) -> None:
        """Holds the measurements with errors of a level (groups,) of each group of channels from now on."""
        errors = self._channel_errors()
        self._hold(
            dataclasses.replace(
                self.errors, plain=errors.at(levels), by_channel=errors.shares(levels), times_s=errors.times_s(levels)
            )
        )

    def _forget_errors(self) -> None:
        """Begins anew with channels' errors of usual size, and with the noise that the drives hold."""
        self._sizes = None
        self._hold(Errors(self.drives.observations))
        self._take(self._channel_errors().usual)

    def _hold(self, errors: Errors) -> None:
        """Weighs the measurements with these errors from now on."""
        self.errors, self.observations = errors, errors.observations

    def _usual_sizes(self) -> tuple[np.ndarray, np.ndarray]:
        """Usual sizes of discrepancy (fields,) and of noise (groups,)."""
        return np.array([f.usual for f in self._usual_fields()]), np.ones(len(self.noise_names))

    def _led_by(self, sizes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
        """Sizes of discrepancy (fields,) and of noise (groups,) with which a descent is led, of those that were found.

        Those of discrepancy are no larger than usual: found where a descent stands, they are as large as what it has
        not reached yet, and from then on nothing speaks against that. Ground alone is as rough as it is.
        """
        tau = np.minimum(sizes[0], self._usual_sizes()[0])
        if len(self.drives.ground):
            tau[self._number[GROUND]] = sizes[0][self._number[GROUND]]
        return tau, sizes[1]

    def _usual_fields(self, bounded: bool = False) -> tuple[Field, ...]:
        """What is usual: discrepancy at every port, a little of every effect, and ground that nobody mapped.

        Args:
          bounded: whether sizes are the usual ones at most, but for that of ground.
        """
        ports = [Field(label, self.settings.usual_discrepancy, bounded=bounded) for label in self.words]
        ground = [Field(GROUND, self.settings.usual_ground)] if len(self.drives.ground) else []
        return *ports, Field(USUAL_EFFECTS, self.settings.usual_effect, bounded=bounded), *ground

    def _noise_sizes(self) -> tuple[NoiseSize, ...]:
        return tuple(NoiseSize(name, self.settings.stated_spread) for name in self.noise_names)

    def _guess(self, free: np.ndarray, near: Refit | None) -> np.ndarray:
        """(n, free) derivatives as far as they are known: those of a similar refit, and signatures of what is new."""
        assert self._seen is not None
        known = self._seen.copy()
        places, slopes = self._slopes[frozenset() if near is None else near.effects]
        known[:, places] = slopes
        return known[:, free]

    def _sizes_of(self, near: Refit) -> tuple[np.ndarray, np.ndarray]:
        found = near.linear.evidence(self.listed(near.effects))[1]
        return self._led_by((found.tau, found.noise))

    def _take_kept(self) -> bool:
        """Whether an earlier refit of these drives has left errors of channels, which are taken then."""
        kept, self.kept = self.kept, {}
        # Noise that is learnt from a refit is not among what is kept.
        if not kept or self.drives.noise_unlearnt:
            return False
        levels = self._channel_errors().at_shares(kept["channel_errors"], kept["error_times_s"])
        if levels is None:
            return False
        self.kept = kept
        self.drives.about(self.start)
        self._take(levels)
        return True

    def _begin_beside(self, own: DriveForm) -> None:
        """Begins where a rival's refit ended, with the noise and the very errors that it has learnt."""
        self.drives.take_noise(own.drives)
        there = {c.key: amount for c, amount in zip(own.coordinates, own._base, strict=True)}
        mine = {*self._free(frozenset()), *self.drives.ground}
        self.start = np.array([there.get(c.key, 0.0) if i in mine else 0.0 for i, c in enumerate(self.coordinates)])
        self.drives.about(self.start)
        self._hold(own.errors)
        self.kept = own.errors.by_channel

    def _nearer_start(self, free: np.ndarray) -> np.ndarray:
        """Of the start and the model's own parameters as given, (coordinates,), the one that predicts better."""
        given, own = self.start.copy(), [i for i in self.baseline if not self.coordinates[i].nuisance]
        # A rival's parameters make up for what it lacks; where this form has that, they are far off.
        given[own], given[self.discrepancy] = self._as_given()[own], 0.0
        cost = self._cost(self.start, free, self._rival_of._sizes if self._rival_of else None)
        return self._least(cost, np.stack([self.start, given]), free)

    def _map_held_out(self, u: np.ndarray, there: np.ndarray, slopes: np.ndarray, free: np.ndarray) -> np.ndarray:
        """A place with the most probable ground of held-out drives by a linear model of their pose.

        Their ground is mapped, not fitted: nothing counts but pose, and nothing else that drives share moves by it.

        Args:
          u: the place. there: where the slopes are from. slopes, free: as for `_columns`.
        """
        ground, observations = self._other_ground, self.observations
        if not len(ground):
            return u
        assert self._seen is not None and self._sizes is not None
        pose = np.zeros(len(observations), bool)
        for s in observations.series:
            pose[s.start : s.stop] = s.channel in POSE
        rows = pose & ~self._fit
        logs = {self.coordinates[i].log_index for i in ground}
        # where such a drive began is uncertain, too
        own = np.flatnonzero([self.coordinates[i].log_index in logs for i in free])
        own = own[self._field_of[free[own]] < 0]
        residual = observations.whiten(observations.value - self.predicted(there))
        columns = observations.whiten(np.column_stack([slopes[:, own], self._seen[:, ground]]))
        # a held-out drive whose simulation diverges there tells nothing of its ground
        rows &= np.isfinite(residual)
        places = np.concatenate([free[own], ground])
        tau, noise = self._sizes
        std = np.concatenate([self._std[free[own]], np.full(len(ground), tau[self._number[GROUND]])])
        weight = 1.0 / noise[self._group[rows]]
        columns, residual = columns[rows] * weight[:, None], residual[rows] * weight
        centre = np.array([self.coordinates[i].centre for i in places]) - there[places]
        normal = columns.T @ columns + np.diag(std**-2)
        step = np.linalg.solve(normal, columns.T @ residual + centre / std**2)
        low, high = self.drives.bounds(ground)
        out = u.copy()
        out[ground] = np.clip(there[ground] + step[len(own) :], low, high)
        return out

    def _cost(
        self,
        u: np.ndarray,
        free: np.ndarray,
        sizes: tuple[np.ndarray, np.ndarray] | None,
        inputs: np.ndarray | None = None,
    ) -> _Cost:
        """What a descent from a place minimises.

        Args:
          u, free, sizes: as for `_descend`.
          inputs: (n, discrepancy) derivatives; None where logs have no discrepancy of their own.
        """
        observations = self.observations
        noise = np.ones(len(self.noise_names)) if sizes is None else sizes[1]
        weight = 1.0 / noise[self._group[self._fit]]
        misfit = np.zeros((len(weight), 0))
        if sizes is not None and inputs is not None:
            effects = frozenset(e for e, own in self.candidates.items() if own[0] in free)
            columns, number = self._field_columns(observations, inputs, effects)
            misfit = observations.whiten(columns)[self._fit] * sizes[0][number] * weight[:, None]
        std = self._std if sizes is None else self._prior_std(sizes[0])
        std = self.effect_std(u, std, self.settings.effect_freedom)
        factor = linalg.cho_factor(np.eye(misfit.shape[1]) + misfit.T @ misfit, lower=True)
        centre = np.array([self.coordinates[i].centre for i in free])
        return _Cost(observations, self._fit, weight, misfit, factor, std[free], centre)

    def _descend(
        self,
        u: np.ndarray,
        free: np.ndarray,
        sizes: tuple[np.ndarray, np.ndarray] | None = None,
        slopes: np.ndarray | None = None,
        guessed: bool = False,
        once: bool = False,
        whole: bool = False,
    ) -> tuple[np.ndarray, np.ndarray]:
        """The most probable coordinates at given sizes of discrepancy and noise, and the derivatives near them.

        Args:
          u: (coordinates,) where from. free: places of what moves.
          sizes: None for noise alone.
          slopes: (n, free) derivatives, if known. guessed: whether these are to be taken anew before the end.
          once: whether no others than these are taken. whole: whether a descent that the time cuts short is none.

        Raises:
          EvidenceError: the simulation diverged at the start.
          TimeUp: before the descent had begun, or had ended where it has to be `whole`.
        """
        if slopes is None:
            slopes = self.jacobian(u, free)[1]
        settings, damping = self.settings, DRIVE_REFIT.damping
        cost = self._cost(u, free, sizes, None if sizes is None else self._frame_inputs)
        settled = settings.settled
        if once:
            settled = max(settled, DRIVE_REFIT.visible * cost.chi2(self._left(cost, u), u[free]))
        try:
            for _ in range(settings.most_jacobians):
                there = self._step(cost, u, free, slopes, damping, settled)
                # slopes that are new earn new trust
                u, damping = there.u, min(there.damping, 1.0)
                if once or (not guessed and there.gained < settings.settled):
                    break
                slopes, guessed = self._renewed(u, free, slopes), False
        except TimeUp:
            if whole:
                raise
        return u, slopes

    def _renewed(self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray) -> np.ndarray:
        """(n, free) derivatives at a place, of which those by ground are the ones that are known.

        Ground is a third of what moves, and bends little: from one Jacobian of a campaign of LUVMI-X to the next its
        columns changed by 5 %, and those of inputs by 40 %.
        """
        new, moved = slopes.copy(), ~np.isin(free, self._own_ground)
        new[:, moved] = self.jacobian(u, free[moved])[1]
        return new

    def _promise(self, cost: _Cost, u: np.ndarray, free: np.ndarray, slopes: np.ndarray) -> float:
        """Decrease of a cost that slopes still promise at a place; as for `_descend`."""
        jacobian = cost.white(slopes)
        normal = cost.inner(jacobian, jacobian) + np.diag(cost.std**-2)
        downhill = cost.inner(jacobian, self._left(cost, u)) - (u[free] - cost.centre) / cost.std**2
        return _promise_left(normal, downhill, u[free], *self.drives.bounds(free))

    def _left(self, cost: _Cost, u: np.ndarray) -> np.ndarray:
        """(fitted,) whitened residual at a place."""
        return cost.white(self.observations.value - self.predicted(u))

    def _least(self, cost: _Cost, rows: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Of some places (m, coordinates) the one of least cost; see `_cost`."""
        white = [cost.white(self.observations.value - v) for v in self.drives.predict(rows)]
        return rows[int(np.argmin([cost.chi2(r, row[free]) for r, row in zip(white, rows, strict=True)]))]

    def _step(
        self, cost: _Cost, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, damping: float, settled: float
    ) -> _Step:
        """Steps with one Jacobian, as long as they gain and it promises more: Levenberg-Marquardt with bounds.

        Args:
          cost: what they lower. u, free, slopes: as for `_descend`. damping: of the first one.
          settled: decrease of the cost that a step must promise.

        Raises:
          EvidenceError: the simulation diverged at the start.
        """
        # Slopes of instruments hold however far they move, and scales of inputs are another rover's. The others have a
        # box about the place: were the whole step shortened until the longest of them fits, one that does almost
        # nothing, and so has far to go, would hold back all.
        longest = self.settings.longest_step
        linear = np.array([is_linear(self.coordinates[i]) for i in free], bool)
        scaled = (self._field_of[free] < 0) & ~linear
        low, high = self.drives.bounds(free)
        residual, trials = self._left(cost, u), min(len(DRIVE_REFIT.factors), self.drives.together)
        if not np.isfinite(residual).all():
            raise EvidenceError("a rover's simulation diverged")
        first = present = cost.chi2(residual, u[free])
        jacobian = cost.white(slopes)
        normal = cost.inner(jacobian, jacobian) + np.diag(cost.std**-2)
        while True:
            downhill = cost.inner(jacobian, residual) - (u[free] - cost.centre) / cost.std**2
            dampings = damping * np.array(DRIVE_REFIT.factors[:trials])
            near = np.where(scaled, np.maximum(low, u[free] - longest), low)
            far = np.where(scaled, np.minimum(high, u[free] + longest), high)
            steps = [
                _bounded_step(normal + np.diag(d * np.diag(normal)), downhill, u[free], near, far) for d in dampings
            ]
            # There is nothing left to gain where these slopes hold. (The least damped step need not promise most: in a
            # box it may even lead uphill, as what it holds at a wall is never let go.)
            if max(_promised(s, normal, downhill) for s in steps) < settled:
                break
            rows = np.repeat(u[None], trials, axis=0)
            rows[:, free] = np.clip(u[free] + steps, low, high)
            residuals = [cost.white(self.observations.value - v) for v in self.drives.predict(rows)]
            reached = [cost.chi2(r, row[free]) for r, row in zip(residuals, rows, strict=True)]
            best = int(np.argmin(reached))
            gained = present - reached[best]
            if not gained > 0.0:
                damping *= DRIVE_REFIT.stiffer
                continue
            damping = max(DRIVE_REFIT.softer * dampings[best], DRIVE_REFIT.damping)
            u, residual, present = rows[best], residuals[best], reached[best]
            # What gains a tenth of what these slopes have gained so far gains more with new ones, which take as long as
            # five steps.
            if gained < max(settled, 0.1 * (first - present)):
                break
        return _Step(u, first - present, damping)


@dataclasses.dataclass(frozen=True, eq=False)
class Errors:
    """Errors of measurements that a model's own form has found, and with which all hypotheses are weighed.

    Attributes:
      plain: observations with noise and errors of channels.
      single: (n,) standard deviation of each reading's own error beside these, in its channel's unit.
      log_ratio: (n,) log density of a reading under Student's noise over that under normal noise with its own error.
      by_channel, times_s: size of a channel's errors, as a share of what it does, and how long they last, s.
    """

    plain: Observations
    single: np.ndarray | float = 0.0
    log_ratio: np.ndarray | float = 0.0
    by_channel: Mapping[str, float] = dataclasses.field(default_factory=dict)
    times_s: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @functools.cached_property
    def observations(self) -> Observations:
        """The measurements with all these errors."""
        return with_errors(self.plain, np.broadcast_to(self.single, len(self.plain)))


@dataclasses.dataclass(frozen=True, eq=False)
class _Learnt:
    """What the model as it is tells of errors at a place.

    Attributes:
      log_evidence: of the fitted measurements with them, up to a constant. found: sizes, and amplitudes.
      columns, residual: (n, k), (n,) derivatives by these amplitudes, and what the place leaves, SI units.
    """

    log_evidence: float
    found: Evidence
    columns: np.ndarray
    residual: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class _Step:
    """Where steps with one Jacobian lead (coordinates,), what they have gained of a cost, and with which damping to go
    on."""

    u: np.ndarray
    gained: float
    damping: float


@dataclasses.dataclass(frozen=True, eq=False)
class _Cost:
    """Chi-square under the covariance of noise and discrepancy, and of the prior.

    Attributes:
      observations, fit: which of them count. weight: (fitted,).
      misfit: (fitted, m) whitened discrepancy at its sizes; factor: of the identity and its products.
      std, centre: (free,) of the prior.
    """

    observations: Observations
    fit: np.ndarray
    weight: np.ndarray
    misfit: np.ndarray
    factor: tuple[np.ndarray, bool]
    std: np.ndarray
    centre: np.ndarray

    def white(self, columns: np.ndarray) -> np.ndarray:
        """(fitted, ...) whitened columns or residual (n, ...)."""
        found = self.observations.whiten(columns)[self.fit]
        return found * (self.weight if found.ndim == 1 else self.weight[:, None])

    def inner(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Products of whitened columns under the covariance of noise and discrepancy."""
        # Woodbury's identity: the covariance of the data is as large as they are, and is never made. It is applied to
        # what is narrower, which saves most of the work where that is a residual.
        return a.T @ self.left(b)

    def left(self, residual: np.ndarray) -> np.ndarray:
        """What discrepancy of the most probable amounts leaves of a whitened residual (fitted, ...)."""
        return residual - self.misfit @ linalg.cho_solve(self.factor, self.misfit.T @ residual)

    def chi2(self, residual: np.ndarray, x: np.ndarray) -> float:
        """Of a whitened residual (fitted,) at a place (free,); infinite where the simulation diverged."""
        if not np.isfinite(residual).all():
            return np.inf
        return float(self.inner(residual, residual)) + float(np.sum(((x - self.centre) / self.std) ** 2))


@dataclasses.dataclass(frozen=True, eq=False)
class _Share:
    """How the amounts of discrepancy in several logs hang together, in variances over those of a log's amount.

    A log's amount is one that all logs share and one of its own. The mean over the fitted logs is what a refit moves:
    were it the shared amount alone, equal own amounts would stand for part of a mean, and to first order.

    Attributes:
      mean: variance of the mean over the fitted logs. known: what a held-out log is expected to have, over that mean.
      apart: (logs, amounts) what independent amounts of unit variance give to each log beside that.
    """

    mean: float
    known: float
    apart: np.ndarray

    @classmethod
    def of(cls, own: float, fitted: Sequence[bool]) -> _Share:
        """Of logs that are fitted or held out, where a share of the variance is each log's own."""
        fit, held_out = np.flatnonzero(fitted), np.flatnonzero(~np.array(fitted))
        mean = 1.0 - own + own / len(fit)
        known = (1.0 - own) / mean
        apart = np.zeros((len(fitted), len(fit) - 1 + len(held_out) + 1))
        # contrasts of the fitted logs: an orthonormal basis of what has no mean
        apart[fit, : len(fit) - 1] = math.sqrt(own) * linalg.helmert(len(fit)).T
        apart[held_out, len(fit) - 1 + np.arange(len(held_out))] = math.sqrt(own)
        # what these logs share and the mean does not tell
        apart[held_out, -1] = math.sqrt((1.0 - own) * (1.0 - known))
        return cls(mean, known, apart)


def _flatter(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Of slopes to two sides the flatter ones, reading by reading."""
    return np.where(np.isfinite(other) & (np.abs(other) < np.abs(one)), other, one)


def _promised(step: np.ndarray, normal: np.ndarray, downhill: np.ndarray) -> float:
    """Decrease of chi-square that the linear model promises of a step."""
    return float(2.0 * step @ downhill - step @ normal @ step)


def _promise_left(normal: np.ndarray, downhill: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Decrease of chi-square that a step within bounds still promises; 0 where it leads uphill, since none need be."""
    return max(_promised(_bounded_step(normal, downhill, x, low, high), normal, downhill), 0.0)


def held_out_pieces(observations: Observations, seconds: float) -> dict[str, np.ndarray]:
    """Places of the observations of each piece of held-out drives, by a name such as "climb from 2 s".

    A campaign holds out one drive or two: too few to tell what a name gains there from chance.

    Args:
      observations: of drives. seconds: length of a piece.
    """
    found: dict[str, list[np.ndarray]] = {}
    for s in observations.series:
        assert s.time is not None
        rows = np.arange(s.start, s.stop)
        number = observations.unit[rows]
        since = s.time - s.time[0]
        # what is left over belongs to the last piece: a sample or two are no witness
        last = max(round(float(since[-1]) / seconds), 1) - 1
        piece = np.minimum(np.floor(since / seconds + 1e-9), last)
        for unit, at in np.unique(np.stack([number, piece]), axis=1).T:
            if observations.unit_split[int(unit)] in ("select", "test"):
                name = f"{observations.unit_names[int(unit)]} from {at * seconds:g} s"
                found.setdefault(name, []).append(rows[(number == unit) & (piece == at)])
    return {name: np.concatenate(parts) for name, parts in found.items()}


def _bounded_step(
    normal: np.ndarray, downhill: np.ndarray, x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """The Gauss-Newton step within bounds: coordinates that it would carry beyond one stay on it."""
    step, held = np.zeros(len(x)), np.zeros(len(x), bool)
    for _ in range(len(x)):
        move = ~held
        known = downhill[move] - normal[np.ix_(move, held)] @ step[held]
        step[move] = np.linalg.solve(normal[np.ix_(move, move)], known)
        outside = move & ((x + step < low - 1e-12) | (x + step > high + 1e-12))
        if not outside.any():
            break
        step[outside] = np.clip(step[outside], (low - x)[outside], (high - x)[outside])
        # Never let go again: at most one solve for each coordinate, at the price of a step that may not be the very
        # best.
        held |= outside
    return step


def usual_of(drives: DriveProblem) -> Usual:
    """What is usual on the rover of drives: its wheels' load, and torque, current and speed of its drives."""
    model, rover = drives.model, drives.model.rover
    names = list(rover.joints)
    driven = [names.index(w.drive) for w in rover.wheels if w.drive in names]

    def own(name: str) -> float:
        return float(np.mean(np.broadcast_to(model.parameters["motor"][name], len(names))[driven]))

    weight = float(rover.mass) * float(model.gravity)
    load, radius = weight / len(rover.wheels), float(np.mean([w.radius for w in rover.wheels]))
    drawbar = DRAWBAR * load * radius
    per_current = own("gear_ratio") * own("gear_efficiency") * own("torque_constant")
    # A share of a torque is one of what acts: a skid-steer rover that turns needs several times a usual drawbar pull.
    current = acting_current(drives.observations, {g.name: len(g.joints) for g in rover.drive_groups})
    if not current:
        current = drawbar / per_current
    commands = np.concatenate([r.commands[:, driven].ravel() for r in drives.bench.runs])
    moving = np.abs(commands[np.abs(commands) > 1e-6])
    # Not the largest, which may be a single jerk.
    speed = float(np.quantile(moving, 0.9)) if len(moving) else 1.0
    return Usual(load, radius, speed, per_current * current, drawbar, current, own("resistance"), weight, 2.0 * radius)


def acting_current(observations: Observations, shared: Mapping[str, int]) -> float:
    """Median of the absolute current of a drive as measured, A; 0 where none is measured or it is not twice its noise.

    Args:
      observations: of drives. shared: number of wheels that a motor drives, by the name of its side; else one.
    """
    found, noise = [], []
    for s in observations.series:
        name = parse_name(s.channel)
        if name is not None and name.quantity == "motor_current" and name.joint == "drive":
            wheels = shared.get(name.corner, 1)
            found.append(np.abs(observations.value[s.start : s.stop]) / wheels)
            noise.append(np.broadcast_to(np.hypot(s.white, s.coloured), s.stop - s.start) / wheels)
    if not found:
        return 0.0
    # Not the root mean square: where commands jump, rotors take tens of times what the ground does.
    middle = float(np.median(np.concatenate(found)))
    return middle if middle > 2.0 * float(np.median(np.concatenate(noise))) else 0.0
