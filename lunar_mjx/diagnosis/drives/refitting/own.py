"""The refit of a model as it is: with the errors, sizes and derivatives by which all hypotheses are weighed."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.drives.problem import DriveProblem
from lunar_mjx.diagnosis.drives.refitting.derivatives import Derivatives
from lunar_mjx.diagnosis.drives.refitting.descent import Descent
from lunar_mjx.diagnosis.drives.refitting.design import Columns, Design
from lunar_mjx.diagnosis.drives.refitting.errors import ErrorModel, Errors, Learnt
from lunar_mjx.diagnosis.drives.refitting.fields import Sizes
from lunar_mjx.diagnosis.drives.refitting.ground import HeldOutGround
from lunar_mjx.diagnosis.drives.refitting.prior import Prior
from lunar_mjx.diagnosis.drives.refitting.settings import DRIVE_REFIT
from lunar_mjx.diagnosis.drives.refitting.signatures import Signatures
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.deadline import TimeUp
from lunar_mjx.inference.evidence import EvidenceError
from lunar_mjx.inference.fitting import Progress


@dataclasses.dataclass(frozen=True, eq=False)
class Base:
    """Where the model as it is was refitted, and what holds there for all hypotheses.

    Attributes:
      u: (coordinates,) the place. free: coordinates that were moved. slopes: (n, free) derivatives there.
      sizes: of discrepancy and noise, as they lead a descent.
    """

    u: np.ndarray
    free: np.ndarray
    slopes: np.ndarray
    sizes: Sizes


@dataclasses.dataclass(frozen=True, eq=False)
class Beside:
    """Where another model has been refitted to the same drives.

    Attributes:
      drives: its simulation. u: (coordinates,) the place, among its own. sizes: of discrepancy and noise there; None
        if it was not refitted. errors: of measurements, as it has found them.
    """

    drives: DriveProblem
    u: np.ndarray
    sizes: Sizes | None
    errors: Errors


@dataclasses.dataclass(eq=False)
class OwnRefit:
    """Refits a model as it is.

    Attributes:
      drives: simulation. derivatives, design, signatures: of its predictions. descent: within bounds.
      prior: of what moves. errors: of the readings, which are learnt. settings: effort. progress: told of refits.
    """

    drives: DriveProblem
    derivatives: Derivatives
    design: Design
    signatures: Signatures
    descent: Descent
    prior: Prior
    errors: ErrorModel
    settings: DriveSettings
    progress: Progress

    def refit(self, start: np.ndarray, kept: Mapping[str, Any], beside: Beside | None) -> Base:
        """Where the model as it is explains most, with the errors that all hypotheses are weighed with.

        Derivatives there are the discrepancy of all hypotheses.

        Args:
          start: (coordinates,) where from.
          kept: what an earlier refit there has told of errors of channels, or nothing.
          beside: another model, with whose errors this one is weighed.

        Raises:
          EvidenceError: nothing can be told of where it begins.
          TimeUp: before the refit had ended; it counts from wherever it has come.
        """
        places = self.prior.places
        free, arrived, sizes, learns = places.free(), not places.candidates, None, beside is None
        if beside is not None:
            start = self._begin_beside(beside)
            u, sizes, _ = self.approach(self._nearer_start(start, free, beside.sizes), free, sizes, learns)
        elif self._take_kept(start, kept):
            u, arrived = start, False
        else:
            u, sizes, _ = self.approach(self.lead(self._begin(start, free), free), free, None, learns)
            if self.drives.noise_unlearnt:
                self.drives.learn_noise(u)
                self.errors.forget(self.drives.observations)
                arrived, sizes = False, None
        if places.candidates:
            self.signatures.look(u, free)
            self.signatures.see(u)
        if not arrived:
            # With a little of every effect among what is usual, which changes little of where it ends; with noise that
            # has just been learnt it is the first refit.
            u, sizes, _ = self.approach(u, free, sizes, learns)
        slopes = self.signatures.look(u, free)
        assert sizes is not None
        if places.candidates:
            self.signatures.choose(self.design.columns(u, free, slopes), sizes)
        return Base(u, free, slopes, sizes)

    @contextlib.contextmanager
    def apart(self, errors: Errors | None, base: Base) -> Iterator[None]:
        """A time within which errors are a hypothesis' own; afterwards all is again as for the model as it is.

        Args:
          errors: with which it begins; usual ones if None. base: the refit of the model as it is.
        """
        kept = self.errors.present, self.errors.channels_held
        seen, steps = self.design.seen.copy(), self.derivatives.steps.copy()
        try:
            if errors is not None:
                self.errors.present = errors
            self.errors.channels_held = False
            yield
        finally:
            self.errors.present, self.errors.channels_held = kept
            self.design.seen, self.derivatives.steps = seen, steps
            self.drives.about(base.u)

    def anew(self, effects: frozenset[str], start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where (coordinates,) the model with some effects ends on the way that the model as it is was refitted, and
        derivatives (n, free) there.

        The model as it is makes up for what it lacks by all else that it has, and takes what remains for errors: from
        there, and by these errors, an effect may have nothing to gain. Errors are those of the place afterwards.

        Args:
          effects: of the model. start: (coordinates,) where they act, with the model's own parameters as given.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before the refit was led to its end.
        """
        free = self.prior.places.free(effects)
        u, _, slopes = self.approach(self.lead(self._begin(start, free), free, whole=True), free, None, True)
        return u, slopes

    def _begin(self, start: np.ndarray, free: np.ndarray) -> np.ndarray:
        """Where (coordinates,) instruments, starts of logs and unmapped ground are when all else is as at the start.

        Errors of readings begin anew.

        Args:
          start: (coordinates,) where from. free: coordinates that a refit moves.
        """
        places = self.prior.places
        self.errors.forget(self.drives.observations)
        # Instruments first: currents that are read before a command's jump differ by thirty sigma from those after
        # it, and a descent that moves everything at once follows them into soil that nothing brings it back from.
        nuisances = free[[places.coordinates[i].nuisance and self.prior.field_of[i] < 0 for i in free]]
        u = self.descent.descend(start, nuisances)[0]
        # Ground before soil: waves that nobody mapped cost a rover more torque than a few per cent of the soil's
        # constants do, which would follow them.
        if len(places.own_ground):
            usual = self.prior.fields.usual, self.errors.stated_noise
            u = self.descent.descend(u, np.concatenate([nuisances, places.own_ground]), usual)[0]
        return u

    def lead(self, u: np.ndarray, free: np.ndarray, whole: bool = False) -> np.ndarray:
        """Where (coordinates,) a model comes to while errors of channels are large, and less and less so.

        Under small errors a descent from afar ends in the nearest of many valleys, where readings that would lead out
        of it pass for errors of their own. Under large ones there is one valley, which narrows as they do
        (deterministic annealing: Rose 1998; graduated non-convexity: Blake & Zisserman 1987).
        Errors are usual ones afterwards: what they are is learnt where it ends.

        Args:
          u: where from. free: places of what moves. whole: whether the time may not cut it short.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before that was looked at, or before the end of
            one that is to be `whole`.
        """
        settings, damping, sizes = self.settings, DRIVE_REFIT.damping, None
        if not settings.annealing:
            return u
        try:
            for floor in settings.annealing:
                self.errors.floor = floor
                # What single readings err by shows once what all of them share is known about as well as is usual.
                single = floor <= settings.usual_error
                for place in range(DRIVE_REFIT.most_led):
                    slopes = self.signatures.look(u, free)
                    _, sizes = self.settle(u, free, slopes, sizes if place else None, single)
                    cost = self.descent.cost(u, free, sizes, self.prior.places.inputs(free, slopes))
                    there = self.descent.step(cost, u, free, slopes, damping, settings.settled)
                    u, damping = there.u, min(there.damping, DRIVE_REFIT.renewed_damping)
                    self.progress("refitting, with errors of channels that lessen", math.nan)
                    if place and there.gained < DRIVE_REFIT.arrived:
                        break
        except (EvidenceError, TimeUp) as error:
            if sizes is None or (whole and isinstance(error, TimeUp)):
                raise
        finally:
            self.errors.floor = 0.0
            self.errors.forget(self.drives.observations)
        return u

    @contextlib.contextmanager
    def under_large_errors(self) -> Iterator[None]:
        """A time within which errors of channels begin anew, and are no smaller than the least that refits are led by.

        Within `apart`, which brings back what they were.
        """
        self.errors.forget(self.drives.observations)
        self.errors.floor = min(self.settings.annealing, default=0.0)
        try:
            yield
        finally:
            self.errors.floor = 0.0

    def approach(
        self, u: np.ndarray, free: np.ndarray, begun: Sizes | None, learns: bool
    ) -> tuple[np.ndarray, Sizes, np.ndarray]:
        """Where (coordinates,) the evidence of the model as it is is highest; sizes and derivatives (n, free) there.

        They are learnt at every Jacobian: at a poor place they are large, and a descent that kept them would end there.
        What a refit leaves to gain goes to whatever is refitted next. The time may end it wherever it has come; errors
        are those of the place in the end.

        Args:
          u: where from. free: places of what moves. begun: sizes that were found near there, or None.
          learns: whether errors of single readings are learnt; a rival is weighed against measurements with the very
            errors of the model's own form.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before that was looked at.
        """
        settings, damping, idle, looks = self.settings, DRIVE_REFIT.damping, 0, 0
        ground, sizes = HeldOutGround(self.drives, self.design, self.prior, self.errors), begun
        best: tuple[float, np.ndarray, Errors, Sizes, np.ndarray] | None = None
        slopes = np.zeros((0, 0))
        try:
            for _ in range(settings.most_steps):
                # A second look at a place has steps that fit what the first has found; a third would see the same.
                if looks < DRIVE_REFIT.most_looks:
                    slopes = self.signatures.look(u, free)
                looks += 1
                learnt, sizes = self.settle(u, free, slopes, sizes, learns)
                cost = self.descent.cost(u, free, sizes, self.prior.places.inputs(free, slopes))
                # what slopes promise has not been reached yet
                value = learnt.log_evidence - 0.5 * self.descent.promise(cost, u, free, slopes)
                gained = math.inf if best is None else value - best[0]
                if best is None or gained > 0.0:
                    best = value, u, self.errors.present, sizes, slopes
                # Smaller errors promise more of the same slopes: one place without a gain may lie on the way.
                idle = idle + 1 if gained < 0.5 * settings.settled else 0
                self.progress("refitting, and learning errors of readings", math.nan)
                if idle > DRIVE_REFIT.most_idle:
                    break
                there = self.descent.step(cost, u, free, slopes, damping, settings.settled)
                damping = min(there.damping, DRIVE_REFIT.renewed_damping)
                looks = looks if there.gained == 0.0 else 0
                u = ground.mapped(there.u, u, slopes, free, sizes)
        # A place of which nothing can be told is not gone to; the best one before it stands.
        except (EvidenceError, TimeUp):
            if best is None:
                raise
        assert best is not None
        _, u, self.errors.present, sizes, slopes = best
        return u, sizes, slopes

    def settle(
        self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, begun: Sizes | None, learns: bool
    ) -> tuple[Learnt, Sizes]:
        """What the model as it is tells of errors at a place once these have settled; see `learn`.

        Errors of single readings are learnt by steps of EM, each of which shows others what they hide. One step for
        each Jacobian was what refits waited for: that of a foreign Husky ended 345 nats below where it ends now.

        Args:
          u: (coordinates,) the place. free: coordinates that are moved. slopes: (n, free) derivatives there.
          begun: as for `learn`. learns: whether errors of single readings settle.
        """
        columns = self.design.columns(u, free, slopes, self.prior.places.effects(free))
        if not learns and not self.errors.channels_held:
            self.errors.forget_single()
        learnt, sizes = self.learn(columns, free, begun, single=learns)
        for _ in range(DRIVE_REFIT.most_learnt if learns else 0):
            before = learnt.log_evidence
            self.errors.learn_single(learnt)
            # Those of channels stay: thirteen sizes of each are tried, which takes most of the time.
            learnt, sizes = self.learn(columns, free, sizes, channels=False)
            if learnt.log_evidence - before < 0.5 * self.settings.settled:
                break
        return learnt, sizes

    def learn(
        self, columns: Columns, free: np.ndarray, begun: Sizes | None, channels: bool = True, single: bool = True
    ) -> tuple[Learnt, Sizes]:
        """What the model as it is tells of errors at a place, and sizes with which a descent from there is led.

        Errors of channels of the most probable sizes are taken, and steps of derivatives.

        Args:
          columns: derivatives and residual there. free: coordinates, discrepancy among them.
          begun: sizes near there, or None. channels: whether errors of channels are learnt, too. single: whether those
            of single readings are, too, where nothing has begun.
        """
        fields = self.prior.fields
        derivatives, prior = self.design.of_the_model(columns, free)
        learnt = self.errors.learn(
            derivatives, columns.residual, prior, fields.priors(bounded=True), begun, channels, single
        )
        # Slopes by inputs are to hold as far as these may still be off; over shorter steps single readings jump. (Of 31
        # sigma that inputs of a campaign of LUVMI-X might still change, slopes over a thousandth left 9.3, these 5.9.)
        inputs = np.flatnonzero(np.isin(free, self.prior.places.discrepancy))
        self.derivatives.step_over(free[inputs], np.sqrt(np.diag(learnt.found.covariance)[inputs]))
        return learnt, fields.led_by(learnt.sizes)

    def _take_kept(self, start: np.ndarray, kept: Mapping[str, Any]) -> bool:
        """Whether an earlier refit of these drives has left errors of channels, which are taken then."""
        # Noise that is learnt from a refit is not among what is kept.
        if not kept or self.drives.noise_unlearnt:
            return False
        if not self.errors.hold_channels(kept["channel_errors"], kept["error_times_s"]):
            return False
        self.drives.about(start)
        return True

    def _begin_beside(self, other: Beside) -> np.ndarray:
        """(coordinates,) where a rival's refit ended; with the noise and the very errors that it has learnt."""
        self.drives.take_noise(other.drives)
        places = self.prior.places
        there = {c.key: amount for c, amount in zip(other.drives.coordinates, other.u, strict=True)}
        mine = {*places.free(), *self.drives.ground}
        start = np.array([there.get(c.key, 0.0) if i in mine else 0.0 for i, c in enumerate(places.coordinates)])
        self.drives.about(start)
        self.errors.hold(self.drives.observations, other.errors)
        return start

    def _nearer_start(self, start: np.ndarray, free: np.ndarray, sizes: Sizes | None) -> np.ndarray:
        """Of the start and the model's own parameters as given, (coordinates,), the one that predicts better."""
        places = self.prior.places
        given, own = start.copy(), [i for i in places.baseline if not places.coordinates[i].nuisance]
        # A rival's parameters make up for what it lacks; where this form has that, they are far off.
        given[own], given[places.discrepancy] = self.prior.as_given()[own], 0.0
        cost = self.descent.cost(start, free, sizes)
        return self.descent.least(cost, np.stack([start, given]), free)
