"""A contact law held against steady-state tables, with all effects that may be missing beside it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.contact_laws import LAWS
from lunar_mjx.diagnosis.tables.noise import scatter
from lunar_mjx.diagnosis.tables.port_gains import ADDED, DRAWN, FIELDS, GAINS, Gain
from lunar_mjx.diagnosis.tables.settings import TableSettings
from lunar_mjx.diagnosis.tables.wheel_program import ABSCISSAE, Imposed, WheelProgram
from lunar_mjx.diagnosis.weighed.form import MeasuredForm
from lunar_mjx.effects.presets import PRESETS
from lunar_mjx.inference.bounded_descent import minimise
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.evidence import Amplitudes, EvidenceError, Field, Gram, NoiseSize
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.weighing.hypotheses import CALIBRATION, EFFECT, UNLISTED, Linear, Refit, Term
from lunar_mjx.inference.weighing.search import Hypothesis
from lunar_mjx.logs import SteadyLog
from lunar_mjx.wheel_bed.bed import EARTH_GRAVITY, WheelBed, WheelTest
from lunar_mjx.wheel_bed.table import QUANTITIES, average

_QUANTITY_OF = {column: i for i, (column, _, _) in enumerate(QUANTITIES.values())}
_NAMES = tuple(QUANTITIES)


@dataclasses.dataclass(frozen=True, eq=False)
class TableData:
    """Tables as one set of points and one vector of observations.

    Attributes:
      observations: values, noise, groups of points and their splits.
      imposed: at every point of all tables.
      point, quantity: (n,) point and place in `QUANTITIES` of every observation.
      modes: (points, modes) of a smooth random function of the points, together of unit variance.
      following: (points, few) the same of load or speed alone, where the table varies them.
      noise_std: by quantity measured, standard deviation of the logarithm of the noise's size.
    """

    observations: Observations
    imposed: Imposed
    point: np.ndarray
    quantity: np.ndarray
    modes: np.ndarray
    following: Mapping[str, np.ndarray]
    noise_std: Mapping[int, float]

    @property
    def measured(self) -> tuple[int, ...]:
        """Places in `QUANTITIES` of what is measured."""
        return tuple(self.noise_std)


def table_data(
    logs: Sequence[SteadyLog], observations: Observations, tests: Sequence[WheelTest], settings: TableSettings
) -> TableData:
    """Puts the points of all tables in one row.

    Args:
      logs: tables. observations: their measurements, log by log, quantity by quantity, points in one order.
      tests: what every table imposes. settings: length scales and sizes.
    """
    point, quantity = np.empty(len(observations), int), np.empty(len(observations), int)
    begin, first = [], 0
    for test in tests:
        begin.append(first)
        first += len(np.atleast_1d(np.asarray(test.slip_angle)))
    for s in observations.series:
        point[s.start : s.stop] = begin[s.log] + np.arange(s.stop - s.start)
        quantity[s.start : s.stop] = _QUANTITY_OF[s.channel]
    assert observations.place is not None
    slip = np.empty(first)
    slip[point] = observations.place[:, 0]
    stacked = jax.tree.map(lambda *a: np.concatenate([np.atleast_1d(np.asarray(x, float)) for x in a]), *tests)
    lever = np.concatenate(
        [
            # Bounded: 1/cos has no end where a wheel is dragged sideways.
            1.0 / np.cos(np.minimum(np.abs(np.asarray(t.slip_angle, float)), settings.steepest_lever))
            if log.table.slip_definition == "wheel_frame"
            else np.ones(len(np.atleast_1d(np.asarray(t.slip_angle))))
            for log, t in zip(logs, tests, strict=True)
        ]
    )
    load = np.asarray(stacked.normal_load)
    gravity = [
        np.full(len(np.atleast_1d(t.slip_angle)), log.gravity_m_s2 or EARTH_GRAVITY)
        for log, t in zip(logs, tests, strict=True)
    ]
    # an error of the load's zero is a share of the mean load, the same for all points of a load cell
    imposed = Imposed(stacked, slip, lever, np.full(first, load.mean()), np.concatenate(gravity))
    speed = np.concatenate([_speed(log) for log in logs])
    # Loads and speeds by their ratios, so that one length scale serves light and heavy wheels.
    features = np.column_stack(
        [
            slip / settings.slip_length,
            np.degrees(stacked.slip_angle) / settings.angle_length,
            np.log(load) / settings.load_length,
            np.log(speed) / settings.speed_length,
        ]
    )
    # A contact law is inexact in what it is a law of: slip, slip angle and load. It knows no speed, so that whatever
    # follows the speed is a phenomenon that it lacks, and no usual discrepancy.
    usual = features[:, :3]
    following = {
        name: _modes(features[:, [k]], settings)
        for name, k in (("load", 2), ("speed", 3))
        if np.ptp(features[:, k]) > settings.least_range
    }
    std: dict[int, float] = {}
    for log in logs:
        for name, own in scatter(log).items():
            noise_spread = np.hypot(settings.replicate_spread, own.level) if own.level else settings.stated_spread
            i = _NAMES.index(name)
            # Tables share a quantity's noise factor: the least known of them says how far it may go.
            std[i] = max(std.get(i, 0.0), float(noise_spread))
    return TableData(
        observations, imposed, point, quantity, _modes(usual, settings), following, dict(sorted(std.items()))
    )


def _speed(log: SteadyLog) -> np.ndarray:
    """(points,) speed at which the bed runs, m/s: of rim and travel the one that differs less; slip sets the other."""
    columns = average(log.table).test
    given = [np.maximum(columns[c], 1e-6) for c in ("rim_speed_m_s", "travel_speed_m_s") if c in columns]
    return min(given, key=lambda v: float(np.ptp(np.log(v)))) if given else np.ones(len(columns["slip_ratio"]))


def _modes(features: np.ndarray, settings: TableSettings) -> np.ndarray:
    """(points, modes): a constant, a plane and a smooth remainder, of given shares of the variance."""
    # once a place: replicates share their discrepancy, and the eigenproblem stays small
    unique, inverse = np.unique(np.round(features, 6), axis=0, return_inverse=True)
    centred = unique - unique.mean(axis=0)
    # To a mean variance of one, as the constant and the smooth part have: shares then are shares.
    plane = centred @ centred.T / max(float(np.mean(np.sum(centred**2, axis=1))), 1e-12)
    distance = np.sum((unique[:, None] - unique[None]) ** 2, axis=-1)
    constant, straight, curved = settings.shape_shares
    values, vectors = np.linalg.eigh(constant + straight * plane + curved * np.exp(-0.5 * distance))
    order = np.argsort(values)[::-1]
    share = np.cumsum(values[order]) / values.sum()
    keep = order[: min(int(np.searchsorted(share, settings.mode_share)) + 1, settings.most_modes)]
    return (vectors[:, keep] * np.sqrt(values[keep]))[inverse.reshape(-1)]


class WheelForm(MeasuredForm):
    """One contact law against tables."""

    def __init__(
        self,
        name: str,
        data: TableData,
        bed: WheelBed,
        coordinates: Sequence[Coordinate],
        baseline: np.ndarray,
        candidates: Mapping[str, np.ndarray],
        settings: TableSettings,
        log_prior: float = 0.0,
    ):
        """Makes the form.

        Args:
          name: of the law. data: measurements.
          bed: the law with all candidates, at their null. coordinates: of the law and of all candidates.
          baseline: places of the law's own coordinates. candidates: places by effect.
          settings: sizes and priors. log_prior: log of the form's prior probability.
        """
        self.name, self.data, self.settings, self.log_prior = name, data, settings, log_prior
        self.coordinates, self.baseline, self.candidates = tuple(coordinates), baseline, dict(candidates)
        self.program = WheelProgram(bed, coordinates)
        self.observations, self.words = data.observations, FIELDS
        self.shares = {f: max(self._share(g) for g in GAINS if g.field == f) for f in FIELDS}
        self._fit = data.observations.in_split("fit")
        self._amounts = _amounts(bed, coordinates)
        names = _instruments(data)
        self.instruments = names
        rare = settings
        self.terms = (
            *(Term(e, EFFECT, rare.effect_log_odds) for e in self.candidates),
            *(Term(f, UNLISTED, rare.unlisted_log_odds) for f in FIELDS),
            *(Term(f"{f} with {q}", UNLISTED, rare.following_log_odds) for f in FIELDS for q in data.following),
            *(Term(c, CALIBRATION, rare.calibration_log_odds) for c in names),
        )

    def predict(self, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) in SI units at a place, and their derivatives (n, width)."""
        values, slopes = self.program(u, self.data.imposed)
        at = (self.data.quantity, self.data.point)
        return values[at], slopes[at]

    def predicted(self, u: np.ndarray) -> np.ndarray:
        """(n,) predictions in SI units at (coordinates,)."""
        return self.predict(u)[0]

    def corrected(self, best: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) in SI units and whitened residuals (n,), both with the learnt discrepancy added."""
        _, columns, residual = self.linearise(best.refit.u)
        learnt = columns[:, best.places] @ best.evidence.mean
        return self.predicted(best.refit.u) + self.observations.sigma() * learnt, residual - learnt

    def signatures(self, refit: Refit) -> dict[str, np.ndarray]:
        """(fitted,) whitened change of the predictions by each candidate at its prior size, by effect."""
        _, columns, _ = self.linearise(refit.u)
        std, fit = refit.linear.amplitudes.std, self._fit
        return {name: columns[fit][:, places] @ std[places] for name, places in self.candidates.items()}

    def linearise(self, u: np.ndarray) -> tuple[Linear, np.ndarray, np.ndarray]:
        """Gram matrices of all that a hypothesis may hold, about a place; whitened columns (n, k), residuals (n,)."""
        data, settings, count = self.data, self.settings, len(self.coordinates)
        value, slope = self.predict(u)
        if not np.isfinite(value).all() or not np.isfinite(slope).all():
            raise EvidenceError("the wheel's predictions or their derivatives are not finite")
        whiten = data.observations.whiten
        residual = whiten(data.observations.value - value)
        own = whiten(slope[:, :count])
        errors, error_std, instruments = self._calibration(value, slope[:, count + len(GAINS) :])
        gains = slope[:, count : count + len(GAINS)]
        fields, field_of = self._fields(gains, False)
        added, added_to = self._fields(gains, True)
        unlisted, followed = self._following(gains)
        rough, inexact = self._inexact(slope, u)
        columns = np.column_stack([own, whiten(errors), fields, added, unlisted, rough])
        calibrated = count + np.arange(errors.shape[1])
        field_columns = count + errors.shape[1] + np.arange(fields.shape[1])
        end = columns.shape[1] - rough.shape[1]
        last = end - unlisted.shape[1]
        more = last - added.shape[1]
        # no field's size is inferred for these (field -1): what follows speed or load is asked for, and never usual
        sizes = np.full(unlisted.shape[1], settings.following_discrepancy)
        std = np.concatenate(
            [
                [c.prior for c in self.coordinates],
                error_std,
                np.ones(last - more + len(field_columns)),
                sizes,
                np.ones(rough.shape[1]),
            ]
        )
        for places in self.candidates.values():
            amplitude = [i for i in places if self.coordinates[i].amplitude]
            std[amplitude] = [self.effect_size(self.coordinates[i]) for i in amplitude]
        none = np.full(count + errors.shape[1], -1)
        field = np.concatenate([none, field_of, added_to, np.full(unlisted.shape[1] + rough.shape[1], -1)])
        mean = np.zeros(len(std))
        centre = np.array([c.centre for c in self.coordinates])
        mean[:count] = centre - u
        low, high = np.full(len(std), -np.inf), np.full(len(std), np.inf)
        for places in self.candidates.values():
            for i in places:
                if self.coordinates[i].amplitude:
                    low[i], high[i] = self.coordinates[i].bounds()
        low[:count] -= u
        high[:count] -= u
        # where each amplitude stands, so that hypotheses without the effect are told at its null
        at = np.zeros(len(std))
        for places in self.candidates.values():
            at[places] = u[places]
        group = self.noise_group()
        kinds = len(data.measured)
        fit = self._fit
        held = {}
        observations = data.observations
        for number, split in enumerate(observations.unit_split):
            if split in ("select", "test"):
                rows = observations.unit == number
                held[observations.unit_names[number]] = Gram.of(columns[rows], residual[rows], group[rows], kinds)
        linear = Linear(
            gram=Gram.of(columns[fit], residual[fit], group[fit], kinds),
            held_out=held,
            amplitudes=Amplitudes(std, field, mean),
            low=low,
            high=high,
            always=np.concatenate([self.baseline, calibrated, field_columns]).astype(int),
            effects=self.candidates,
            at=at,
            calibration={name: calibrated[places] for name, places in instruments.items()},
            following={name: last + places for name, places in followed.items()},
            added={f: more + np.flatnonzero(added_to == k) for k, f in enumerate(FIELDS) if np.any(added_to == k)},
            fields=tuple(Field(f, settings.usual(f)) for f in FIELDS),
            noises=tuple(NoiseSize(_NAMES[q], s) for q, s in data.noise_std.items()),
            wide=settings.unlisted_discrepancy,
            far=settings.bad_calibration,
            amount=self.amounts(len(std)),
            freedom=settings.effect_freedom,
            inexact={name: end + places for name, places in inexact.items()},
            inexactness=settings.effect_discrepancy,
        )
        return linear, columns, residual

    def effect_size(self, c: Coordinate) -> float:
        """Prior standard deviation of an effect's amplitude, in scales: lengths are measured by the wheel's radius."""
        if c.unit != "m":
            return self.settings.effect_size
        return self.settings.length_size * float(np.mean(self.data.imposed.test.radius)) / c.scale

    def noise_group(self) -> np.ndarray:
        """(n,) noise group of every observation."""
        return np.searchsorted(np.array(self.data.measured), self.data.quantity)

    def _share(self, gain: Gain) -> float:
        """Prior size of a port's gain relative to the size of its field of discrepancy."""
        return {ADDED: self.settings.added_force, DRAWN: self.settings.drawn_radius}.get(gain.kind, 1.0)

    def _fields(self, slope: np.ndarray, added: bool) -> tuple[np.ndarray, np.ndarray]:
        """Whitened columns (n, m) of all fields, rotated so that few are left, and the field (m,) of each.

        Args:
          slope: (n, gains). added: forces that are missing, in place of what a discrepancy usually is.
        """
        columns, number = [np.zeros((len(slope), 0))], [np.zeros(0, int)]
        modes = self.data.modes[self.data.point]
        usually = self.settings.added_usually
        for f, field in enumerate(FIELDS):
            parts = [
                (i, (1.0 if added or gain.kind != ADDED else usually) * self._share(gain))
                for i, gain in enumerate(GAINS)
                if gain.field == field and (gain.kind == ADDED if added else gain.kind != ADDED or usually > 0.0)
            ]
            if not parts or (added and usually > 0.0):
                continue
            white = self.data.observations.whiten(np.column_stack([slope[:, [i]] * x * modes for i, x in parts]))
            # turned to principal directions: those that even a large discrepancy keeps below the noise only cost time
            left, size, _ = np.linalg.svd(white, full_matrices=False)
            keep = size * self.settings.unlisted_discrepancy > self.settings.least_length
            columns.append(left[:, keep] * size[keep])
            number.append(np.full(int(keep.sum()), f))
        return np.column_stack(columns), np.concatenate(number)

    def _inexact(self, slope: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Whitened columns (n, m) of what the laws of the effects that act may get wrong, and places by effect.

        The law of an effect is no more exact than that of a contact: what it does is multiplied by a smooth function of
        the table's points. Else a second effect would be named for what the law of the first one gets wrong.
        """
        columns, places, at = [np.zeros((len(slope), 0))], {}, 0
        size = self.settings.effect_discrepancy
        for name, amounts in self._amounts.items() if size > 0.0 else ():
            # in scales of each amplitude, from where the effect vanishes
            acts = {i: u[i] + self.coordinates[i].start / self.coordinates[i].scale - null for i, null in amounts}
            acting = [slope[:, [i]] * amount for i, amount in acts.items() if amount != 0.0]
            if not acting:
                continue
            modes = self.data.modes[self.data.point]
            white = self.data.observations.whiten(np.column_stack([one * modes for one in acting]))
            left, length, _ = np.linalg.svd(white, full_matrices=False)
            keep = length * size > self.settings.least_length
            columns.append(left[:, keep] * length[keep])
            places[name] = at + np.arange(int(keep.sum()))
            at += int(keep.sum())
        return np.column_stack(columns), {n: p for n, p in places.items() if len(p)}

    def _following(self, slope: np.ndarray) -> tuple[np.ndarray, dict[str, np.ndarray]]:
        """Whitened columns (n, m) of unlisted inputs that follow one quantity alone, and places by a term's name."""
        columns, places, at = [np.zeros((len(slope), 0))], {}, 0
        for field in FIELDS:
            for quantity, modes in self.data.following.items():
                mine = [
                    slope[:, [i]] * self._share(gain) * modes[self.data.point]
                    for i, gain in enumerate(GAINS)
                    if gain.field == field
                ]
                white = self.data.observations.whiten(np.column_stack(mine))
                columns.append(white)
                places[f"{field} with {quantity}"] = at + np.arange(white.shape[1])
                at += white.shape[1]
        return np.column_stack(columns), places

    def _calibration(self, value: np.ndarray, abscissae: np.ndarray) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
        """Columns (n, m) of errors of sensors and abscissae (SI), their usual sizes (m,), and places by instrument."""
        data, settings = self.data, self.settings
        columns, std, of = [], [], []
        observations = data.observations
        load = data.imposed.test.normal_load[data.point]
        by_point = np.zeros((len(QUANTITIES), len(data.imposed.slip)))
        by_point[data.quantity, data.point] = value
        for q in data.measured:
            name = QUANTITIES[_NAMES[q]][0]
            mine = data.quantity == q
            # a sensor's zero is stated as a share of its full scale; the table's own range stands for it, without its
            # outliers
            top = float(np.quantile(np.abs(observations.value[mine]), 0.95))
            errors = [(value, settings.sensor_scale), (np.full(len(value), top), settings.sensor_zero)]
            # a balance of several axes reads a share of the load and of the other horizontal force
            if _NAMES[q] in ("drawbar_pull", "side_force"):
                other = 1 - q
                errors.append((load, settings.cross_talk))
                if other in data.measured:
                    errors.append((by_point[other][data.point], settings.cross_talk))
            for column, size in errors:
                columns.append(np.where(mine, column, 0.0))
                std.append(size)
                of.append(name)
        sizes = settings.abscissae()
        for i, name in enumerate(ABSCISSAE):
            columns.append(abscissae[:, i])
            std.append(sizes[name])
            of.append(_instrument(name))
        names = dict.fromkeys(of)
        return (np.column_stack(columns), np.array(std), {n: np.flatnonzero([o == n for o in of]) for n in names})

    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> Refit:
        """The most probable refit with some effects, under the covariance of noise, calibration and discrepancy.

        The sizes of these are inferred anew where a descent has ended, and the next begins there, as long as the
        evidence rises: discrepancies are shares of what is predicted, so that no single function is descended.
        """
        settings = self.settings
        free = self._free(effects)
        u = np.zeros(len(self.coordinates))
        if start is not None:
            u[free] = start[free]
        elif near is not None:
            u[free] = near.u[free]
        # strictly inside: at a bound, a bounded step has no direction to begin with
        u[free] = np.clip(u[free], *(self._bounds(free) + np.array([[1e-9], [-1e-9]])))
        terms = frozenset(t for t in self.terms if t.kind == EFFECT and t.name in effects)
        linear, columns, _ = self.linearise(u)
        value, inferred, places = linear.evidence(terms)
        best = None
        for _ in range(settings.most_rounds):
            prior, shared = inferred.amplitudes, places >= len(u)  # calibration, discrepancy, laws of effects
            scale = prior.std * np.append(inferred.tau, 1.0)[prior.field]
            spread = columns[self._fit][:, places[shared]] * scale[shared], self._noise(inferred.noise)
            u = self._descend(u, free, linear, spread)
            linear, columns, _ = self.linearise(u)
            value, inferred, places = linear.evidence(terms, (inferred.tau, inferred.noise))
            gained = np.inf if best is None else value - best[0]
            if gained > 0.0:
                best = value, Refit(self.name, effects, u, linear)
            # the sizes were inferred at the last place: a round that gains little would change them little, too
            if gained < settings.settled:
                break
        assert best is not None
        return best[1]

    def _noise(self, factors: np.ndarray) -> np.ndarray:
        """(fitted,) factors on the noise of those of its groups."""
        return factors[self.noise_group()[self._fit]]

    def alone(self, refit: Refit) -> np.ndarray:
        """(coordinates,) where the model alone predicts best: least squares under the noise, begun at the refit."""
        free = self._free(refit.effects)
        return self._descend(refit.u, free, refit.linear, None)

    def _bounds(self, free: np.ndarray) -> np.ndarray:
        """(2, free) lower and upper bounds."""
        return np.array([self.coordinates[i].bounds() for i in free], float).reshape(-1, 2).T

    def _free(self, effects: frozenset[str]) -> np.ndarray:
        """(k,) places of the coordinates that a refit with some effects moves: the baseline's and the effects'."""
        return np.concatenate([self.baseline, *(p for e, p in self.candidates.items() if e in effects)]).astype(int)

    def _descend(
        self, u: np.ndarray, free: np.ndarray, linear: Linear, spread: tuple[np.ndarray, np.ndarray] | None
    ) -> np.ndarray:
        """The most probable coordinates under given noise.

        Args:
          u: (coordinates,) where from. free: places of what moves. linear: priors.
          spread: (fitted, k) columns of calibration and discrepancy, each times its size, and (fitted,) factors on the
            noise; the stated noise alone if None.
        """
        fit = self._fit
        columns, noise = spread or (np.zeros((int(fit.sum()), 0)), np.ones(int(fit.sum())))
        # what is shared between points is marginalised in closed form, in place of thousands of further coordinates
        covariance = columns @ columns.T
        covariance[np.diag_indices(len(noise))] += noise**2
        factor = linalg.cholesky(covariance, lower=True, check_finite=False)
        std = self.effect_std(u, linear.amplitudes.std[: len(u)], linear.freedom)[free]
        centre = np.array([self.coordinates[i].centre for i in free])

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            place = u.copy()
            place[free] = x
            value, slope = self.predict(place)
            whole = np.column_stack([self.data.observations.value - value, -slope[:, free]])
            white = self.data.observations.whiten(whole)[fit]
            if not np.isfinite(white).all():
                return np.full(len(white) + len(free), np.nan), np.full((len(white) + len(free), len(free)), np.nan)
            solved = linalg.solve_triangular(factor, white, lower=True, check_finite=False)
            prior = (x - centre) / std
            return np.concatenate([solved[:, 0], prior]), np.vstack([solved[:, 1:], np.diag(1.0 / std)])

        low, high = self._bounds(free)
        out = u.copy()
        # A sum of squares is twice a log density, in which the threshold is given.
        out[free] = minimise(at, u[free], low, high, 2.0 * self.settings.fit_settled, self.settings.most_evaluations)
        return out


def _amounts(bed: WheelBed, coordinates: Sequence[Coordinate]) -> dict[str, list[tuple[int, float]]]:
    """Places of the amplitudes of all effects beyond the contact laws, and their nulls in scales, by effect."""
    own = {*PRESETS["consistent"], *(part for parts in LAWS.values() for part in parts)}
    by_name = {e.name: e for e in bed.effects if e.name not in own}
    found: dict[str, list[tuple[int, float]]] = {}
    for i, c in enumerate(coordinates):
        null = by_name[c.effect].parameters[c.name].null if c.effect in by_name else None
        if null is not None and not c.log:
            found.setdefault(c.effect, []).append((i, null / c.scale))
    return found


def _instrument(abscissa: str) -> str:
    return abscissa.removesuffix(" zero").removesuffix(" scale")


def _instruments(data: TableData) -> tuple[str, ...]:
    names = [QUANTITIES[_NAMES[q]][0] for q in data.measured]
    return tuple(dict.fromkeys([*names, *map(_instrument, ABSCISSAE)]))
