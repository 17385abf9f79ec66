"""Errors of measurements beside their noise, as a refit finds them: slow ones of channels, and of single readings."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.channel_errors import ChannelErrors, error_kind
from lunar_mjx.diagnosis.drives.observations import with_errors
from lunar_mjx.diagnosis.drives.refitting.fields import Sizes
from lunar_mjx.diagnosis.drives.settings import DriveSettings
from lunar_mjx.inference.evidence import (
    Amplitudes,
    Evidence,
    Field,
    Gram,
    NoiseSize,
    expected_square,
    infer,
    infer_levels,
)
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.single_errors import single_errors


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
class Learnt:
    """What the model as it is tells of errors at a place.

    Attributes:
      log_evidence: of the fitted measurements with them, up to a constant. found: sizes, and amplitudes.
      columns, residual: (n, k), (n,) derivatives by these amplitudes, and what the place leaves, SI units.
    """

    log_evidence: float
    found: Evidence
    columns: np.ndarray
    residual: np.ndarray

    @property
    def sizes(self) -> Sizes:
        """Sizes of discrepancy (fields,) and of noise (groups,)."""
        return self.found.tau, self.found.noise


class ErrorModel:
    """Measurements, and the errors with which they are weighed at present.

    Attributes:
      present: those errors. noises: prior of the size of each group's noise. group: (n,) of each reading.
      fit: (n,) which readings are fitted.
      channels_held: whether errors of channels stay as they are: what an earlier run or a rival has found of them
        holds, as all hypotheses were weighed with it.
      floor: least errors of channels that are taken, as a share of what a channel does.
    """

    def __init__(self, observations: Observations, settings: DriveSettings):
        """Makes it without errors.

        Args:
          observations: with their noise. settings: sizes that are tried, and their priors.
        """
        self._noise_alone, self._settings = observations, settings
        self.present, self.channels_held, self.floor = Errors(observations), False, 0.0
        kinds = [error_kind(s.channel) for s in observations.series]
        names = list(dict.fromkeys(kinds))
        self.noises = tuple(NoiseSize(name, settings.stated_spread) for name in names)
        self.group = np.empty(len(observations), int)
        for s, name in zip(observations.series, kinds, strict=True):
            self.group[s.start : s.stop] = names.index(name)
        self.fit = observations.in_split("fit")

    @property
    def observations(self) -> Observations:
        """The measurements with all errors of the present."""
        return self.present.observations

    @property
    def stated_noise(self) -> np.ndarray:
        """(groups,) sizes of noise as it is stated."""
        return np.ones(len(self.noises))

    def forget(self, observations: Observations) -> None:
        """Begins anew with channels' errors of usual size.

        Args:
          observations: with their noise.
        """
        self._noise_alone, self.channels_held = observations, False
        self.present = Errors(observations)
        self._take(self._channel_errors().usual)

    def forget_single(self) -> None:
        """Begins anew with single readings that have no errors of their own."""
        self.present = dataclasses.replace(self.present, single=0.0, log_ratio=0.0)

    def hold(self, observations: Observations, errors: Errors) -> None:
        """Takes errors that another model has found, those of channels for good.

        Args:
          observations: with their noise. errors: of these measurements.
        """
        self._noise_alone, self.present = observations, errors
        self.channels_held = bool(errors.by_channel)

    def hold_channels(self, shares: Mapping[str, float], times_s: Mapping[str, float]) -> bool:
        """Whether such errors of channels are among those that are tried; then they are taken for good.

        Args:
          shares, times_s: as `Errors` tells them.
        """
        levels = self._channel_errors().at_shares(shares, times_s)
        if levels is not None:
            self._take(levels)
        self.channels_held = levels is not None
        return self.channels_held

    def log_scale(self, rows: np.ndarray | None = None) -> float:
        """What turns a log evidence in sigma of normal noise into one of some measurements in their units, under
        Student's noise; of the fitted ones if `rows`, their places, is None."""
        each = self.present.log_ratio - self.observations.log_widths()
        return float(np.sum(each[self.fit if rows is None else rows]))

    def learn(
        self,
        columns: np.ndarray,
        residual: np.ndarray,
        prior: Amplitudes,
        fields: Sequence[Field],
        begun: Sizes | None,
        channels: bool = True,
        single: bool = True,
    ) -> Learnt:
        """What a model tells of its errors at a place; those of channels of the most probable sizes are taken.

        Args:
          columns, residual: (n, k), (n,) derivatives there, and what it leaves, SI units. prior: (k,) of amplitudes.
          fields: of discrepancy. begun: sizes at a place that is a step away; None at a first place, where errors of
            single readings are taken, too. channels: whether errors of channels are learnt, or stay as they are.
          single: whether those of single readings are learnt at a first place.

        Raises:
          EvidenceError: derivatives are too steep to compute with.
        """
        fit = self.fit

        def as_they_are() -> Learnt:
            white = self.observations.whiten(np.column_stack([columns, residual]))[fit]
            gram = Gram.of(white[:, :-1], white[:, -1], self.group[fit], len(self.noises))
            found = infer(gram, prior, fields, self.noises, begun)
            return Learnt(found.log_evidence + self.log_scale(), found, columns, residual)

        if self.channels_held or not channels:
            return as_they_are()
        if begun is None and single:
            # first those of single readings: a few that are far off would else be a slow error of all
            self.learn_single(as_they_are())
        # a place that is a step away has other errors by little
        here = self._channel_errors().at_shares(self.present.by_channel, self.present.times_s)
        start = None if begun is None else here
        errors = self._channel_errors(self.present.single)
        found = infer_levels(errors.levels(columns, residual, start), prior, fields, self.noises, begun)
        assert found.levels is not None
        self._take(found.levels)
        value = found.log_evidence + float(np.sum((self.present.log_ratio * np.ones(len(fit)))[fit]))
        return Learnt(value, found, columns, residual)

    def learn_single(self, learnt: Learnt) -> None:
        """Takes errors of single readings by a step of EM, given what the model has been found to leave.

        Where a wheel sticks or slips, meets an edge or begins to turn, a prediction jumps with every little change, and
        some readings are off by many times what others are. Normal noise would have to be as large as these for all.
        """
        square = expected_square(self.observations.whiten(learnt.found.left(learnt.columns, learnt.residual)))
        square = square / learnt.found.noise[self.group] ** 2
        freedoms = [freedom or math.inf for freedom in self._settings.noise_freedoms]
        single = single_errors(self.present.plain, self.observations, square, self.group, self.fit, freedoms)
        self.present = dataclasses.replace(self.present, single=single.std, log_ratio=single.log_ratio)

    def _channel_errors(self, single: np.ndarray | float = 0.0) -> ChannelErrors:
        """Observations with each size of their channels' errors, and with errors of single readings."""
        seen = with_errors(self._noise_alone, np.broadcast_to(single, len(self._noise_alone)))
        return ChannelErrors(seen, self.group, len(self.noises), self._settings, self.floor)

    def _take(self, levels: np.ndarray) -> None:
        """Holds the measurements with errors of a level (groups,) of each group of channels from now on."""
        errors = self._channel_errors()
        self.present = dataclasses.replace(
            self.present, plain=errors.at(levels), by_channel=errors.shares(levels), times_s=errors.times_s(levels)
        )
