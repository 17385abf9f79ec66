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
from lunar_mjx.diagnosis.drives.refitting.descent import Cost, Descent
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


@dataclasses.dataclass(frozen=True, eq=False)
class _Place:
    """What is known of a place on the way of a refit.

    Attributes:
      value: log density of the measurements and of the prior there, nats. u: (coordinates,) the place.
      asked, asked_sizes: errors that it asks for by itself, and sizes of discrepancy and noise with them.
      errors, sizes: those of where its slopes promise to lead. slopes: (n, free) derivatives. seen: those of `Design`.
      cost: what the next step lowers.
    """

    value: float
    u: np.ndarray
    asked: Errors
    asked_sizes: Sizes
    errors: Errors
    sizes: Sizes
    slopes: np.ndarray
    seen: np.ndarray
    cost: Cost


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
        free, arrived, led, sizes, learns = places.free(), not places.candidates, False, None, beside is None
        if beside is not None:
            start = self._begin_beside(beside)
            there = self.approach(self._nearer_start(start, free, beside.sizes), free, sizes, learns)
            u, sizes = there.u, there.asked_sizes
        elif self._take_kept(start, kept):
            u, arrived, led = start, False, bool(places.candidates)
        else:
            there, led = self.approach(self.lead(self._begin(start, free), free), free, None, learns), True
            u, sizes = there.u, there.asked_sizes
            if self.drives.noise_unlearnt:
                self.drives.learn_noise(u)
                self.errors.forget(self.drives.observations)
                arrived, sizes = False, None
        if places.candidates:
            self.signatures.look(u, free)
            self.signatures.see(u)
        if not arrived:
            # With a little of every effect among what is usual; with noise that has just been learnt it is the first
            # refit. Led anew, with errors of its own, it ends where those of effects do: two foreign Huskys 209 and
            # 293 nats higher, which is as much as many an effect explains.
            if led:
                self.errors.channels_held = False
                u, sizes = self.lead(u, free), None
            there = self.approach(u, free, sizes, learns)
            u, sizes = there.u, there.asked_sizes
        slopes = self.signatures.look(u, free)
        assert sizes is not None
        if places.candidates:
            self.signatures.choose(self.design.columns(u, free, slopes), sizes)
        return Base(u, free, slopes, sizes)

    @contextlib.contextmanager
    def apart(self, base: Base) -> Iterator[None]:
        """A time within which errors are a hypothesis' own; afterwards all is again as for the model as it is.

        Args:
          base: the refit of the model as it is.
        """
        kept = self.errors.present, self.errors.channels_held
        seen, steps = self.design.seen.copy(), self.derivatives.steps.copy()
        try:
            self.errors.channels_held = False
            yield
        finally:
            self.errors.present, self.errors.channels_held = kept
            self.design.seen, self.derivatives.steps = seen, steps
            self.drives.about(base.u)

    def go_on(self, u: np.ndarray, free: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where (coordinates,) a model ends from near where another has ended, and derivatives (n, free) there.

        With errors of its own, which begin anew and lead it as they led the model as it is: by the errors of another it
        would have to explain what that one has taken for errors. (Led by the least of them alone, the hidden delay of
        a foreign Husky's actuators ended at half of its size, 4,300 nats lower.)

        Args:
          u: (coordinates,) where from. free: coordinates that are moved.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before it was led to its end, or anything was
            learnt of where that is.
        """
        self.drives.about(u)
        self.errors.forget(self.drives.observations)
        there = self.approach(self.lead(u, free, whole=True), free, None, True)
        return there.u, there.slopes

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
        looked = False
        try:
            for floor in self.settings.annealing:
                self.errors.floor = floor
                # What single readings err by shows once what all of them share is known about as well as is usual.
                single = floor <= self.settings.usual_error
                most, enough = DRIVE_REFIT.most_led, DRIVE_REFIT.arrived
                u, looked = self.approach(u, free, None, single, most, enough, whole).u, True
        except (EvidenceError, TimeUp) as error:
            if not looked or (whole and isinstance(error, TimeUp)):
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
        self.errors.floor = next(reversed(self.settings.annealing), 0.0)
        try:
            yield
        finally:
            self.errors.floor = 0.0

    def approach(
        self,
        u: np.ndarray,
        free: np.ndarray,
        begun: Sizes | None,
        learns: bool,
        most: int | None = None,
        enough: float | None = None,
        whole: bool = False,
    ) -> _Place:
        """Where the evidence of the model as it is is highest, and what is known of that place.

        They are learnt at every Jacobian: at a poor place they are large, and a descent that kept them would end there.
        A step lowers a cost at the sizes of its beginning. Where its end does not explain more by itself, with errors
        learnt anew, it is shortened (backtracking: Armijo 1966). The time may end it wherever it has come; errors are
        those of the place in the end.

        Args:
          u: where from. free: places of what moves. begun: sizes that were found near there, or None.
          learns: whether errors of single readings are learnt; a rival is weighed against measurements with the very
            errors of the model's own form.
          most: places that are looked at; as many as the settings say if None.
          enough: chi-square that a place must gain for another to be looked at; what the settings call settled if None.
          whole: whether the time may not cut it short.

        Raises:
          EvidenceError: nothing can be told of where it begins. TimeUp: before that was looked at, or before the end of
            one that is to be `whole`.
        """
        settings, damping, share, end, best = self.settings, DRIVE_REFIT.damping, 1.0, u, None
        ground, sizes = HeldOutGround(self.drives, self.design, self.prior, self.errors), begun
        try:
            for _ in range(settings.most_steps if most is None else most):
                place = self._place(u, free, sizes, learns, required=best is None)
                self.progress("refitting, and learning errors of readings", math.nan)
                if best is not None and (place is None or place.value <= best.value):
                    share *= DRIVE_REFIT.shorter
                    if share < DRIVE_REFIT.least_share:
                        break
                else:
                    assert place is not None
                    gained, best, share = math.inf if best is None else place.value - best.value, place, 1.0
                    if gained < 0.5 * (settings.settled if enough is None else enough):
                        break
                    there = self.descent.step(place.cost, u, free, place.slopes, damping, settings.settled)
                    if there.gained == 0.0:
                        break
                    damping = min(there.damping, DRIVE_REFIT.renewed_damping)
                    end = ground.mapped(there.u, u, place.slopes, free, place.sizes)
                self.errors.present, sizes = best.errors, best.sizes
                u = best.u + share * (end - best.u)
        except TimeUp:
            if best is None or whole:
                raise
        assert best is not None
        self.errors.present, self.design.seen = best.asked, best.seen
        return best

    def _place(
        self, u: np.ndarray, free: np.ndarray, sizes: Sizes | None, learns: bool, required: bool
    ) -> _Place | None:
        """What a place (coordinates,) tells once errors have settled there; None where that is nothing.

        Args:
          u: the place. free, learns: as for `approach`. sizes: to begin with, or None.
          required: whether nothing told is an error.

        Raises:
          EvidenceError: nothing can be told, and something is required. TimeUp: before anything was.
        """
        try:
            slopes = self.signatures.look(u, free)
            _, sizes = self.settle(u, free, slopes, sizes, learns)
            value, asked, asked_sizes = self.held(u, free, slopes, sizes, learns)
        except EvidenceError:
            if required:
                raise
            return None
        cost = self.descent.cost(u, free, sizes, self.prior.places.inputs(free, slopes))
        present = self.errors.present
        return _Place(value, u, asked, asked_sizes, present, sizes, slopes, self.design.seen.copy(), cost)

    def held(
        self, u: np.ndarray, free: np.ndarray, slopes: np.ndarray, sizes: Sizes | None, learns: bool
    ) -> tuple[float, Errors, Sizes]:
        """Log density of the measurements where all that a refit moves is held at a place, and of the prior there; the
        errors that the place asks for, and sizes of discrepancy and noise with them.

        What a linear model promises beyond a place may lie nowhere, and the errors that have settled are those of its
        end. Of two places the one that explains more by itself is the better. Errors of the present stay.

        Args:
          u, free, slopes: the place (coordinates,), what moves, and derivatives (n, free). sizes: to begin with.
          learns: whether errors of single readings are learnt.

        Raises:
          EvidenceError: derivatives are too steep to compute with.
        """
        kept = self.errors.present
        columns = self.design.columns(u, free, slopes, self.prior.places.effects(free))
        derivatives, prior = self.design.of_the_model(columns, free)
        derivatives, prior = derivatives[:, len(free) :], prior.select(np.arange(len(free), derivatives.shape[1]))
        fields = self.prior.fields.priors(bounded=True)
        try:
            found = self.errors.learn(derivatives, columns.residual, prior, fields, sizes, single=learns)
            for _ in range(DRIVE_REFIT.most_held if learns else 0):
                self.errors.learn_single(found)
                found = self.errors.learn(derivatives, columns.residual, prior, fields, found.sizes, channels=False)
            asked = self.errors.present
        finally:
            self.errors.present = kept
        return found.log_evidence + self._log_prior(u, free), asked, self.prior.fields.led_by(found.sizes)

    def _log_prior(self, u: np.ndarray, free: np.ndarray) -> float:
        """Log density of the prior of a place (coordinates,), up to a constant.

        That of a discrepancy is of the size that its amounts ask for: a descent may lead beyond what is usual, and
        larger noise would explain readings for less.
        """
        cost = self.descent.cost(u, free, (self.prior.fields.usual, self.errors.stated_noise))
        square, field = ((u[free] - cost.centre) / cost.std) ** 2, self.prior.field_of[free]
        value = -0.5 * float(np.sum(square[field < 0]))
        sizes = np.array(DRIVE_REFIT.asked_sizes)
        for k in np.unique(field[field >= 0]):
            own = square[field == k]
            # half-Cauchy, as wide as usual: what is unlisted is rare, and no miracle
            value += float(np.max(-0.5 * np.sum(own) / sizes**2 - len(own) * np.log(sizes) - np.log1p(sizes**2)))
        return value

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
