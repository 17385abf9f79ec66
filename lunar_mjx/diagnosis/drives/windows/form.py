"""Windows of drives as a form of weighed hypotheses: the model, what may be missing of it, and what usually differs.

Every suspect adds coordinates of its own to those of the model as it is, at null where it is absent; one that is about
a parameter which is fitted anyway (such as friction beyond its prior) moves the same value further. What differs from
one recording to the next is a random amount per recording and port, whose size is unknown about the usual one;
something unlisted is such an amount beyond the usual size. Of one recording alone these amounts are coordinates like
all others, so that large ones are followed where the model is not linear; of several they act to first order.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.windows.coordinates import CALIBRATION, Suspect, Unknown
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, CURRENTS
from lunar_mjx.diagnosis.drives.windows.problem import PROGRAM, SLOPE, Noise, WindowProblem
from lunar_mjx.diagnosis.drives.windows.settings import (
    BETWEEN,
    BY_MOTION,
    DIFFERENCES,
    WINDOW_PRIORS,
    Difference,
    WindowSettings,
    by_motion,
)
from lunar_mjx.diagnosis.weighed.form import MeasuredForm
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.bounded_descent import minimise
from lunar_mjx.inference.coordinates import Coordinate
from lunar_mjx.inference.evidence import Amplitudes, EvidenceError, Field, Gram, NoiseSize
from lunar_mjx.inference.observations import Observations, Series
from lunar_mjx.inference.weighing.hypotheses import EFFECT, UNLISTED, Linear, Refit, Term
from lunar_mjx.inference.weighing.search import Hypothesis

SOFT = "soft_ground"
"""The suspect that takes the place of a hard surface: it has no null, and a program of its own."""
INSTEAD = "instead"
"""Name of the coordinate that tells whether soft ground takes the place of the hard surface: 0 or 1."""


@dataclasses.dataclass(frozen=True)
class WindowRefit:
    """How refits of windows descend."""

    steps: int = 10
    """Gauss-Newton steps of a refit at most."""
    settled: float = 0.1
    """Gain of chi-square by a step after which a fit has settled."""
    longest_step: float = 3.0
    """Longest step, in standard deviations of a prior."""
    fixed: float = 1e-3
    """Prior standard deviation of a coordinate that does not move."""


WINDOW_REFIT = WindowRefit()

DRAG, RISE = Unknown("rolling_resistance", "coefficient", 0.03), Unknown(CALIBRATION, SLOPE, 1.0)
"""What differs from recording to recording and no fit moves: resistance of the ground over its load; its slope, deg."""
DRIVE = "this drive"
"""Effect of the coordinates that belong to the one recording there is."""
OF_THE_GROUND = ("ground", "friction")
"""Families of suspects that another ground brings with it."""


@dataclasses.dataclass(frozen=True, eq=False)
class WindowObservations(Observations):
    """Measurements of windows as one vector.

    Attributes:
      problem: whose windows they are. noise: of each channel.
      at: channel, window and sample of every observation.
    """

    problem: WindowProblem | None = None
    noise: tuple[Noise, ...] = ()
    at: tuple[np.ndarray, ...] = ()

    def whiten(self, columns: np.ndarray) -> np.ndarray:
        """See `Observations`: each window's samples of a channel together."""
        assert self.problem is not None
        flat = columns.reshape(len(self), -1)
        whole = np.zeros((*self.problem.there.shape, flat.shape[1]))
        whole[self.at] = flat
        return self.problem.whitened(whole, self.noise)[self.at].reshape(columns.shape)

    @property
    def window(self) -> np.ndarray:
        """(n,) number of the window of every observation."""
        return self.at[1]


def observe(
    problem: WindowProblem, noise: Sequence[Noise], names: Sequence[str], splits: np.ndarray
) -> WindowObservations:
    """The measurements of windows, log by log and channel by channel in order of time.

    Args:
      problem: of the windows. noise: of each channel. names: of the logs. splits: (window,) of every window.
    """
    cut = problem.cut
    # a log whose windows are partly held out is two units of one name
    units = sorted({(int(k), str(s)) for k, s in zip(cut.log, splits, strict=True)})
    series, parts, unit, stop = [], [], [], 0
    for k in np.unique(cut.log):
        mine = np.flatnonzero(cut.log == k)
        mine = mine[np.argsort(cut.start_s[mine])]
        for c, channel in enumerate(CHANNELS):
            row, sample = np.nonzero(problem.there[c][mine])
            if not len(row):
                continue
            window = mine[row]
            time = cut.start_s[window] + cut.interval_s * sample
            parts.append((np.full(len(row), c), window, sample))
            unit.append(np.array([units.index((int(k), str(s))) for s in splits[window]]))
            series.append(Series(int(k), channel, stop, stop + len(row), time, noise[c].std))
            stop += len(row)
    at = tuple(np.concatenate(p) for p in zip(*parts, strict=True))
    split = dict(units)
    return WindowObservations(
        problem.measured[at],
        tuple(series),
        tuple(names),
        tuple(split.get(k, "fit") for k in range(len(names))),
        np.concatenate(unit),
        tuple(s for _, s in units),
        tuple(names[k] + (" (held out)" if s == "test" and (k, "fit") in units else "") for k, s in units),
        problem=problem,
        noise=tuple(noise),
        at=at,
    )


class WindowForm(MeasuredForm):
    """A model of a rover and its ground against windows of drives.

    Attributes:
      unknowns: of every coordinate, as the problem takes them.
    """

    observations: WindowObservations
    writing = 4.0
    """Measured: 3 to 4 refits, most of it in what held-out windows say and in the fits of the model alone."""

    def __init__(
        self,
        problem: Callable[[str | None], WindowProblem],
        base: Sequence[Unknown],
        suspects: Sequence[Suspect],
        observations: WindowObservations,
        settings: WindowSettings,
        other_ground: bool = False,
    ):
        """Makes the form.

        Args:
          problem: of a form of the ground (None: as the model has it).
          base: the model's own unknowns. suspects: what may be missing.
          observations: what was measured. settings: how rare things are.
          other_ground: whether the logs say that they were driven on other ground than those of the model's fit.
        """
        self.name, self.log_prior = "the model's own ground", 0.0
        self.problem, self.settings, self.observations = problem, settings, observations  # pyright: ignore[reportIncompatibleVariableOverride]
        self.model = problem(None).model
        unknowns, coordinates, candidates = [], [], {}
        for q in base:
            unknowns.append(q)
            coordinates.append(self._coordinate(q.effect, q, 1.0))
        self.shares = {name: d.share(settings.unlisted_discrepancy) for name, d in DIFFERENCES.items()}
        cut = problem(None).cut
        self.single = len(np.unique(cut.recordings)) == 1
        self._motions = self._by_motion()
        self._field: dict[int, int] = {}
        for name, q in self._of_the_drive() if self.single else ():
            if name in DIFFERENCES:
                self._field[len(unknowns)] = list(DIFFERENCES).index(name)
            unknowns.append(q)
            coordinates.append(dataclasses.replace(self._coordinate(DRIVE, q, 1.0), name=name))
        self.baseline = np.arange(len(unknowns))
        self._own = frozenset(range(len(unknowns)))
        self.instead = -1
        for s in suspects:
            first = len(unknowns)
            for q in s.unknowns:
                unknowns.append(q)
                coordinates.append(self._coordinate(s.name, q, 1.0))
            if s.name == SOFT:
                self.instead = len(unknowns)
                unknowns.append(Unknown(SOFT, INSTEAD, 1.0))
                coordinates.append(
                    Coordinate(SOFT, INSTEAD, 0.0, 1.0, 0.0, 1.0, prior=WINDOW_REFIT.fixed, amplitude=True)
                )
                self.exchanged = (SOFT,)
            candidates[s.name] = np.arange(first, len(unknowns))
        self.unknowns, self.coordinates, self.candidates = tuple(unknowns), tuple(coordinates), candidates
        self._all = (*self.unknowns, DRAG, RISE)
        self.words = {name: d.words for name, d in DIFFERENCES.items()}
        self._fields = tuple(self._size(name, d) for name, d in DIFFERENCES.items())
        self.terms = (
            *(Term(s.name, EFFECT, self._log_odds(s, suspects, other_ground)) for s in suspects),
            *(Term(name, UNLISTED, settings.unlisted_log_odds) for name, d in DIFFERENCES.items() if d.unlisted),
        )
        self.fit = observations.in_split("fit")
        self._low, self._high = self._bounds()

    def _log_odds(self, suspect: Suspect, suspects: Sequence[Suspect], other_ground: bool) -> float:
        """Log of the prior odds of a suspect: what belongs to the ground shares the odds that other ground differs."""
        if not other_ground or suspect.family not in OF_THE_GROUND:
            return self.settings.effect_log_odds
        return math.log(self.settings.other_ground_odds / sum(s.family in OF_THE_GROUND for s in suspects))

    def _size(self, name: str, d: Difference) -> Field:
        """Size of a difference before these logs: as other logs have told it, else as it usually is."""
        told, std = self.model.priors.get(f"{BETWEEN}.{d.key}", (0.0, 0.0))
        return Field(name, (told or d.size) / self.shares[name], std / told if told else 0.0)

    def _by_motion(self) -> np.ndarray:
        """(window, k) columns of what differs from motion to motion: of all recordings together, and of each."""
        problem = self.problem(None)
        recordings = problem.cut.recordings
        if self.single:
            return by_motion(*problem.rims)
        columns = [math.sqrt(WINDOW_PRIORS.law_share) * by_motion(*problem.rims)]
        for n in np.unique(recordings):
            mine = recordings == n
            own = by_motion(*problem.rims[:, mine])
            columns.append(np.zeros((len(mine), own.shape[1])))
            columns[-1][mine] = math.sqrt(1.0 - WINDOW_PRIORS.law_share) * own
        return np.concatenate(columns, axis=1)

    def usual_differences(self) -> dict[str, float]:
        """Usual size of every difference between drives, in units of its coordinates' priors."""
        return {f.name: f.usual for f in self._fields}

    def _of_the_drive(self) -> list[tuple[str, Unknown]]:
        """What may differ in the one recording there is, by field; the slope belongs to none."""
        ground = SOFT if SOFT in self.model.effect_names else "hard_ground"
        moduli = ("friction_angle", "", "shear_modulus") if ground == SOFT else ("mu", "side", "slip_scale")
        share = iter(self.shares.items())
        out = []
        name, size = next(share)
        out.append((name, dataclasses.replace(DRAG, std=size)))
        for modulus in moduli:
            name, size = next(share)
            if modulus and ground in self.model.effect_names:
                out.append((name, Unknown(ground, modulus, size, True)))
        for instrument in ("current_scale", "current_difference"):
            name, size = next(share)
            out.append((name, Unknown(CALIBRATION, instrument, size)))
        flat = bool(self.problem(None).cut.unlevelled)
        out.append(("lateness of currents", Unknown(CALIBRATION, "current_clock", WINDOW_PRIORS.late_s)))
        out.append(
            (
                "slope",
                dataclasses.replace(RISE, std=WINDOW_PRIORS.unknown_slope_deg if flat else WINDOW_PRIORS.uneven_deg),
            )
        )
        return out

    def _coordinate(self, effect: str, q: Unknown, prior: float) -> Coordinate:
        added = q.effect == SOFT and SOFT not in self.model.effect_names
        start = catalogue.CATALOGUE[SOFT].nominal()[q.name] if added else self.problem(None).begin(q)
        return Coordinate(
            effect, q.name, start, q.std, q.low, q.high, q.factor, prior, unit=q.unit, amplitude=True, centre=q.mean
        )

    def _bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """(coordinates,) bounds: of plausibility, and of how far what other logs taught may have drifted."""
        pairs = np.array([c.bounds() for c in self.coordinates])
        low, high = pairs[:, 0].copy(), pairs[:, 1].copy()
        for i in self.baseline:
            if self.unknowns[i].key in self.model.priors and self.coordinates[i].effect != DRIVE:
                centre = self.coordinates[i].centre
                low[i], high[i] = (
                    max(low[i], centre - WINDOW_PRIORS.drifted),
                    min(high[i], centre + WINDOW_PRIORS.drifted),
                )
        return low, high

    def _soft(self, u: np.ndarray) -> bool:
        return self.instead >= 0 and u[self.instead] > 0.5

    def _rows(self, rows: np.ndarray, soft: bool) -> np.ndarray:
        """(k, n) predictions of rows of coordinates, all with one program; coordinates of one key add up.

        Rows may hold amounts of `DRAG` and `RISE` behind the coordinates.
        """
        keys: dict[str, Unknown] = {}
        values: dict[str, np.ndarray] = {}
        for i, q in enumerate(self._all[: rows.shape[1]]):
            if q.effect == SOFT and (q.name == INSTEAD or (i not in self._own and not soft)):
                continue
            first = keys.setdefault(q.key, q)
            values[q.key] = values.get(q.key, 0.0) + rows[:, i] * (q.std / first.std)
        problem = self.problem(SOFT if soft else None)
        found = problem.predict(tuple(keys.values()), np.stack(list(values.values()), axis=1))
        return found[:, *self.observations.at]

    def predicted(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`."""
        return self._rows(u[None], self._soft(u))[0]

    def told(self, u: np.ndarray) -> np.ndarray:
        """See `MeasuredForm`: every sample by itself and counted once, as `comparison.json` tells errors."""
        return (self.observations.value - self.predicted(u)) / self.observations.sigma()

    def slopes(self, u: np.ndarray, wanted: Iterable[int]) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (n,) at a place and derivatives (n, coordinates + 2) by wanted coordinates, `DRAG` and `RISE`."""
        soft, count = self._soft(u), len(u)
        u = np.concatenate([u, np.zeros(2)])
        out = np.zeros((len(self.observations), len(u)))
        mine: dict[str, int] = {}  # the coordinate by which each key is moved
        same: list[tuple[int, int]] = []
        ground: list[int] = []
        for i in (*wanted, count, count + 1):
            q = self._all[i]
            if i == self.instead or (q.effect == SOFT and i not in self._own and not soft):
                ground.append(i)
            elif mine.setdefault(q.key, i) != i:
                same.append((i, mine[q.key]))
        moved = np.array(list(mine.values()), int)
        # towards the null or the prior's mean, so that bounds are not left
        step = np.where(u[moved] > 0.0, -PROGRAM.step, PROGRAM.step)
        rows = np.repeat(u[None], len(moved) + 1, axis=0)
        rows[1 + np.arange(len(moved)), moved] += step
        values = self._rows(rows, soft)
        out[:, moved] = ((values[1:] - values[0]) / step[:, None]).T
        for i, j in same:
            out[:, i] = out[:, j] * self._all[i].std / self._all[j].std
        if ground:
            out[:, ground] = self._exchange(u[:count], soft, ground, values[0])
        return values[0], out

    def _exchange(self, u: np.ndarray, soft: bool, wanted: Sequence[int], here: np.ndarray) -> np.ndarray:
        """(n, wanted) what the other ground would change, with the derivatives by a soft ground's own coordinates."""
        other = u.copy()
        other[self.instead] = 0.0 if soft else 1.0
        if soft:
            return (here - self._rows(other[None], False)[0])[:, None]
        moduli = [i for i in wanted if i != self.instead]
        rows = np.repeat(other[None], len(moduli) + 1, axis=0)
        rows[1 + np.arange(len(moduli)), moduli] += PROGRAM.step
        there = self._rows(rows, True)
        columns = {i: (there[1 + k] - there[0]) / PROGRAM.step for k, i in enumerate(moduli)}
        columns[self.instead] = there[0] - here
        return np.stack([columns[i] for i in wanted], axis=1)

    def differences(
        self, value: np.ndarray, slopes: np.ndarray, soft: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What differs between recordings and motions: columns (n, k), the field of each or -1, and its size.

        Resistance of the ground acts on both sides with the sense of rolling; grip as friction does; currents by a
        scale, and by one between the sides. The slope and an IMU's clock are of stated size and belong to no field.
        """
        problem, at = self.problem(None), self.observations.at
        cut = problem.cut
        recording, log = cut.recordings[at[1]], cut.log[at[1]]
        currents = at[0] < len(CURRENTS)
        size = np.where(currents, value, 0.0)
        apart = size * np.where(at[0] == 0, 0.5, -0.5)

        def by(key: str) -> np.ndarray | None:
            found = [i for i in self.baseline if self.unknowns[i].key == key]
            found += [i for i, q in enumerate(self.unknowns) if q.key == key]
            return None if not found else slopes[:, found[0]] / self.unknowns[found[0]].std

        ground = ("friction_angle", "", "shear_modulus") if soft else ("mu", "side", "slip_scale")
        grip, side, slip = (by(f"{SOFT if soft else 'hard_ground'}.{name}") for name in ground)
        drag, tilt = (slopes[:, k] / q.std for k, q in ((-2, DRAG), (-1, RISE)))
        shapes = (drag, grip, side, slip, size, apart, drag, grip, side, size)
        columns, field, std = [], [], []
        for number, (name, shape) in enumerate(zip(DIFFERENCES, shapes, strict=True)):
            if shape is None:
                continue
            if name.endswith(BY_MOTION):
                mine = (shape * self.shares[name])[:, None] * self._motions[at[1]]
            elif not self.single:
                mine = np.where(recording[:, None] == np.unique(recording), shape[:, None] * self.shares[name], 0.0)
            else:
                continue
            columns += list(mine.T)
            field += [number] * mine.shape[1]
            std += [1.0] * mine.shape[1]
        clock, late = by(f"{CALIBRATION}.imu_clock"), by(f"{CALIBRATION}.current_clock")
        if late is not None and not self.single:
            for n in np.unique(recording):
                columns.append(np.where(recording == n, late, 0.0))
                field.append(-1)
                std.append(WINDOW_PRIORS.late_s)
        for n in () if self.single else np.unique(recording):
            flat = cut.unlevelled & set(cut.log[cut.recordings == n].tolist())
            columns.append(np.where(recording == n, tilt, 0.0))
            field.append(-1)
            std.append(WINDOW_PRIORS.unknown_slope_deg if flat else WINDOW_PRIORS.uneven_deg)
        if clock is not None:
            for n, (_, spread) in cut.clocks.items():
                columns.append(np.where(log == n, clock, 0.0))
                field.append(-1)
                std.append(spread)
        if not columns:
            return np.zeros((len(log), 0)), np.zeros(0, int), np.zeros(0)
        return np.stack(columns, axis=1), np.array(field), np.array(std)

    def linearise(self, u: np.ndarray, wanted: Iterable[int] | None = None) -> tuple[Linear, np.ndarray, np.ndarray]:
        """Everything that hypotheses need around a place; columns (n, k) and residuals (n,) beside it, not whitened.

        Args:
          u: (coordinates,). wanted: coordinates whose columns are needed; all if None.

        Raises:
          EvidenceError: the simulation diverged.
        """
        settings, observations, count = self.settings, self.observations, len(self.coordinates)
        soft = self._soft(u)
        value, own = self.slopes(u, range(count) if wanted is None else wanted)
        if not (np.isfinite(value).all() and np.isfinite(own).all()):
            raise EvidenceError("the simulation of the windows diverged")
        extra, field, extra_std = self.differences(value, own, soft)
        own = own[:, :count]
        columns, residual = np.column_stack([own, extra]), observations.value - value
        white = observations.whiten(np.column_stack([columns, residual]))
        white, left = white[:, :-1], white[:, -1]
        std = np.concatenate([[c.prior for c in self.coordinates], extra_std])
        mean = np.zeros(len(std))
        mean[:count] = np.array([c.centre for c in self.coordinates]) - u
        at = np.zeros(len(std))
        for places in self.candidates.values():
            at[places] = u[places]
        low, high = np.full(len(std), -np.inf), np.full(len(std), np.inf)
        low[:count], high[:count] = self._low - u, self._high - u
        if self.instead >= 0:
            # Exchanging the ground is a whole step: its amount is held there by a narrow prior, and not fitted.
            mean[self.instead] = 0.0 if soft else 1.0
            low[self.instead], high[self.instead] = -np.inf, np.inf
        own_field = np.array([self._field.get(i, -1) for i in range(count)])
        group = observations.at[0]
        held = {}
        for w in np.unique(observations.window[observations.in_split("select", "test")]):
            rows = observations.window == w
            held[f"window {w}"] = Gram.of(white[rows], left[rows], group[rows], len(CHANNELS))
        fit, whole = self.fit, (len(CHANNELS), len(std) + 1, len(std) + 1)
        linear = Linear(
            gram=Gram.of(white[fit], left[fit], group[fit], len(CHANNELS)),
            held_out=held,
            amplitudes=Amplitudes(std, np.concatenate([own_field, field]), mean),
            low=low,
            high=high,
            always=np.concatenate([self.baseline, count + np.arange(len(field))]).astype(int),
            effects=self.candidates,
            at=at,
            calibration={},
            following={},
            fields=self._fields,
            noises=tuple(NoiseSize(c, WINDOW_PRIORS.noise_log_std) for c in CHANNELS),
            judged=sum(held.values(), start=Gram(np.zeros(len(CHANNELS), int), np.zeros(whole))) if held else None,
            wide=settings.unlisted_discrepancy,
            far=1.0,
        )
        return linear, columns, residual

    def refit(self, effects: frozenset[str], near: Refit | None, start: np.ndarray | None) -> Refit:
        """See `Form`; Gauss-Newton steps with what differs between recordings taken out at its most probable sizes."""
        places = [self.candidates[e] for e in self.candidates if e in effects]
        free = np.concatenate([self.baseline, *places]).astype(int)
        u = np.zeros(len(self.coordinates))
        if start is not None:
            u[free] = start[free]
        elif near is not None:
            u[free] = near.u[free]
        if effects:
            # what usually differs may have taken up what an effect now explains, and would not give it back by steps
            u[list(self._field)] = 0.0
        if SOFT in effects:
            u[self.instead] = 1.0
            free = free[free != self.instead]
        low, high = self._low[free] + 1e-9, self._high[free] - 1e-9
        u[free] = np.clip(u[free], low, high)
        terms, sizes, failed = self.listed(effects), None, "the fit still moves"
        for _ in range(WINDOW_REFIT.steps):
            linear, columns, residual = self.linearise(u, free)
            _, found, chosen = linear.evidence(terms, sizes)
            sizes = found.tau, found.noise
            # The posterior mean of the linear model, relative to where it was taken, is the Gauss-Newton step, in a
            # box: were the whole step shortened until its longest part fits, a parameter that does almost nothing, and
            # so has far to go, would hold back all.
            least, most = np.full(len(linear.low), -np.inf), np.full(len(linear.low), np.inf)
            least[free] = np.maximum(low - u[free], -WINDOW_REFIT.longest_step)
            most[free] = np.minimum(high - u[free], WINDOW_REFIT.longest_step)
            where = {int(p): k for k, p in enumerate(chosen)}
            step = found.within(least[chosen], most[chosen])[[where[int(i)] for i in free]]
            cost = self._cost(linear, columns, sizes, free)
            before = cost(residual, u)
            for share in (1.0, 0.4, 0.15, 0.05):
                trial = u.copy()
                trial[free] = np.clip(u[free] + share * step, low, high)
                after = cost(self.observations.value - self.predicted(trial), trial)
                if after < before:
                    break
            else:
                failed = ""
                break
            u = trial
            if before - after < WINDOW_REFIT.settled:
                failed = ""
                break
        return Refit(self.name, effects, u, self.linearise(u)[0], failed)

    def alone(self, refit: Refit) -> np.ndarray:
        """See `MeasuredForm`: where neither recordings nor motions differ, and each window counts once per channel.

        Samples of one window repeat one motion. Were each to count, parameters would leave their priors for what a law
        is off by at the motions that were driven most.
        """
        observations, fit = self.observations, self.fit
        places = [self.candidates[e] for e in self.candidates if e in refit.effects]
        free = np.concatenate([self.baseline, *places]).astype(int)
        free = free[free != self.instead]
        sizes = np.append(refit.linear.evidence(self.listed(refit.effects))[1].tau, 1.0)
        field = np.array([self._field.get(i, -1) for i in free])
        prior = np.array([self.coordinates[i].prior for i in free]) * sizes[field]
        centre = np.array([self.coordinates[i].centre for i in free])
        channel, window = observations.at[0][fit], observations.window[fit]
        samples = np.zeros((len(CHANNELS), window.max() + 1))
        np.add.at(samples, (channel, window), 1.0)
        square = (observations.value - self.predicted(refit.u))[fit] ** 2
        usual = np.sqrt(
            np.bincount(channel, square, len(CHANNELS)) / np.maximum(np.bincount(channel, minlength=len(CHANNELS)), 1)
        )
        weight = 1.0 / (np.maximum(usual[channel], 1e-9) * np.sqrt(samples[channel, window]))

        def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            place = refit.u.copy()
            place[free] = x
            value, slope = self.slopes(place, free)
            off = weight * (observations.value - value)[fit]
            return (
                np.concatenate([off, (x - centre) / prior]),
                np.vstack([-weight[:, None] * slope[fit][:, free], np.diag(1.0 / prior)]),
            )

        u = refit.u.copy()
        u[free] = minimise(
            at, u[free], self._low[free] + 1e-9, self._high[free] - 1e-9, WINDOW_REFIT.settled, WINDOW_REFIT.steps
        )
        return u

    def _cost(
        self, linear: Linear, columns: np.ndarray, sizes: tuple[np.ndarray, np.ndarray], free: np.ndarray
    ) -> Callable[[np.ndarray, np.ndarray], float]:
        """Chi-square of residuals (n,) and priors of coordinates, with what differs between recordings marginal."""
        tau, noise = sizes
        observations, fit, count = self.observations, self.fit, len(self.coordinates)
        own = np.arange(count, columns.shape[1])
        scale = linear.amplitudes.std[own] * np.append(tau, 1.0)[linear.amplitudes.field[own]]
        group = noise[observations.at[0][fit]]
        random = observations.whiten(columns[:, own] * scale)[fit] / group[:, None]
        factor = linalg.cho_factor(np.eye(len(own)) + random.T @ random)
        centre = np.array([self.coordinates[i].centre for i in free])
        prior = linear.amplitudes.std[free] * np.append(tau, 1.0)[linear.amplitudes.field[free]]

        def of(residual: np.ndarray, u: np.ndarray) -> float:
            white = observations.whiten(residual)[fit] / group
            if not np.isfinite(white).all():
                return math.inf
            seen = random.T @ white
            left = white @ white - seen @ linalg.cho_solve(factor, seen)
            return float(left + np.sum(((u[free] - centre) / prior) ** 2))

        return of

    def corrected(self, best: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
        """See `MeasuredForm`."""
        _, columns, residual = self.linearise(best.refit.u)
        learnt = columns[:, best.places] @ best.evidence.mean
        return self.observations.value - residual + learnt, self.observations.whiten(residual - learnt)

    def signatures(self, refit: Refit) -> dict[str, np.ndarray]:
        """See `MeasuredForm`."""
        _, columns, _ = self.linearise(refit.u)
        std = refit.linear.amplitudes.std
        white = self.observations.whiten(columns)[self.fit]
        return {name: white[:, places] @ std[places] for name, places in self.candidates.items()}

    def explained(self, refit: Refit) -> tuple[float, np.ndarray]:
        """Log evidence of the best single explanation beside a refit, or of none, and what it leaves (n,).

        What usually differs between recordings is taken out: the rest is noise within them.
        """
        own = self.listed(refit.effects)
        _, columns, residual = self.linearise(refit.u)
        best, left = -math.inf, residual
        for more in (None, *(t for t in self.terms if t.name != SOFT and t not in own)):
            terms = own | ({more} if more else frozenset())
            try:
                value, found, places = refit.linear.evidence(terms)
            except (EvidenceError, np.linalg.LinAlgError):
                continue
            value += sum(t.log_prior for t in terms)
            if value > best:
                best, left = value, residual - columns[:, places] @ found.mean
        return best, left


def between(tau: np.ndarray, log_std: np.ndarray, shares: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Sizes of what differs between recordings and their standard deviations, by the key of a model's file.

    Args:
      tau, log_std: (field,) fitted sizes of the fields and how well their logarithms are known. shares: by field.
    """
    return {
        f"{BETWEEN}.{d.key}": (float(t * shares[name]), float(t * s * shares[name]))
        for (name, d), t, s in zip(DIFFERENCES.items(), tau, log_std, strict=True)
    }
