"""Windows of drives as a problem: what every row of unknowns predicts of the measured currents and yaw rates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.observations import DISCREPANCY_TIME_S
from lunar_mjx.diagnosis.drives.windows.coordinates import CALIBRATION, Unknown, start_of
from lunar_mjx.diagnosis.drives.windows.cut import AHEAD, CHANNELS, CURRENTS, STANDING_M_S, Cut
from lunar_mjx.dynamics.imposed import KinematicDrive, Seen, Windows, on_a_plane, require_drives_alone
from lunar_mjx.dynamics.system import default_params
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.logs.schema import KINDS
from lunar_mjx.model import Model


@dataclasses.dataclass(frozen=True)
class WindowProgram:
    """How windows are simulated, and how their noise is learnt."""

    sizes: tuple[int, int] = (64, 1024)
    """Windows simulated at once, few and many: a program is compiled for each; the state of 1,024 stays in the
    cache."""
    few: int = 4
    """Batches of few that take less time than one of many: 0.07 s against 0.5 s on one core."""
    longest_step_s: float = 0.008
    """Time step: currents of a Husky on its tyres differ from those at 2.5 ms by less than 0.01 A."""
    step: float = 0.25
    """Step of difference quotients in units of the prior's standard deviation, and at most `step` of it."""
    freedom: float = 4.0
    """Degrees of freedom of Student's noise: heavy tails with a finite variance."""
    most_programs: int = 8
    """Compiled programs that are kept; the oldest goes first."""
    shares: tuple[float, ...] = (0.0, 0.1, 0.2, 0.4, 0.8)
    """Noise in proportion to what is measured, over its root mean square, that is tried: patches differ in friction by
    so many per cent, whatever the current."""


PROGRAM = WindowProgram()

SLOPE = "slope"
"""Calibration by which all windows lean, whether or not their slope was measured, deg."""
TILTS = ("pitch", "roll", SLOPE)
"""Calibrations that turn gravity in the chassis frame."""
AT_NULL = ("rolling_resistance", "viscous_friction", "payload", "wheel_radius_error", "com_offset")
"""Candidates that stand in one program at their null, so that it is compiled once."""


@dataclasses.dataclass(frozen=True)
class Noise:
    """Noise of a channel: white and first-order autoregressive over time.

    Attributes:
      std: of both together. share: of the variance that is coloured. time_s: correlation time of that part.
    """

    std: float
    share: float
    time_s: float

    def factor(self, there: np.ndarray, interval_s: float) -> np.ndarray:
        """Lower Cholesky factor (k, k) of the covariance of the k samples of a window that are `there`, (sample,)."""
        at = np.flatnonzero(there)
        lag = np.abs(np.subtract.outer(at, at)) * interval_s
        whole = (1.0 - self.share) * np.eye(len(at)) + self.share * np.exp(-lag / self.time_s)
        return self.std * np.linalg.cholesky(whole)

    def with_discrepancy(self, size: float) -> Noise:
        """Noise that holds a known unexplained error of the model, of a standard deviation, in its coloured part."""
        if size == 0.0:
            return self
        std, time_s = float(np.hypot(self.std, size)), self.time_s if self.share > 0.0 else DISCREPANCY_TIME_S
        return Noise(std, (self.share * self.std**2 + size**2) / std**2, time_s)


class WindowProblem:
    """A model against windows.

    Attributes:
      cut: the windows. model: as given. form: effect in the place of a hard surface, or None.
      weight: (channel, window) of every window's measurements, 1 but for what Student's noise takes for an outlier.
    """

    def __init__(self, cut: Cut, model: Model, form: str | None = None, progress: Progress = silent):
        self.cut, self.model, self.form, self.progress = cut, model, form, progress
        whole = model
        if form is not None and form not in whole.effect_names:
            whole = whole.add(form)
        for name in AT_NULL:
            if name not in whole.effect_names:
                whole = whole.add(catalogue.CATALOGUE[name], "candidate", **_null(name))
        self.whole = on_a_plane(whole)
        self.drive = _program(self.whole, 0.5 * cut.interval_s)
        self.params = jax.tree.map(
            lambda a: np.asarray(a, np.float32), dataclasses.replace(default_params(self.whole), terrain=None)
        )
        self.weight = np.ones((len(CHANNELS), len(cut)))
        self._kept: dict[Any, Seen] = {}
        left = np.array([j.startswith("l") for j in corners(model)])
        self._side = np.stack([left, ~left]).astype(float)
        # the sense in which a side's wheels turn, -1 to 1, smooth where they turn round
        self._sense = np.tanh(self._rim() / STANDING_M_S)

    def _rim(self) -> np.ndarray:
        """(side, window, bin) mean speed of a side's rims, m/s."""
        edges = np.asarray(self.cut.imposed.speed)
        middle = 0.5 * (edges[:, :-1] + edges[:, 1:])
        radius = float(np.mean([w.radius for w in self.model.rover.wheels]))
        return radius * np.einsum("wbj,sj->swb", middle, self._side) / self._side.sum(axis=1)[:, None, None]

    @property
    def rims(self) -> np.ndarray:
        """(side, window) mean speed of a side's rims, m/s."""
        return self._rim().mean(axis=2)

    def predict(self, unknowns: Sequence[Unknown], rows: np.ndarray) -> np.ndarray:
        """Predictions.

        Args:
          unknowns: the coordinates. rows: (k, unknown) values in units of their priors.

        Returns:
          (k, channel, window, sample) currents of the sides, A, yaw rate, rad/s, and speed ahead, m/s.
        """
        seen = self._simulate(unknowns, rows)
        current = np.einsum("kwbj,sj->kswb", seen.current, self._side)
        return self._measured(unknowns, rows, current, seen)

    def _value(self, unknowns: Sequence[Unknown], rows: np.ndarray, name: str) -> np.ndarray:
        """(k,) a calibration's value; the model's own, or zero, where it is not among the unknowns."""
        for i, unknown in enumerate(unknowns):
            if unknown.effect == CALIBRATION and unknown.name == name:
                return np.asarray(unknown.value(start_of(self.model, unknown), rows[:, i]))
        return np.full(len(rows), self.model.priors.get(f"{CALIBRATION}.{name}", (0.0, 0.0))[0])

    def _simulate(self, unknowns: Sequence[Unknown], rows: np.ndarray) -> Seen:
        """Means over half intervals, (k, window, bin, ...); rows that differ in sensors alone are simulated once."""
        moves = [i for i, u in enumerate(unknowns) if u.effect != CALIBRATION or u.name in TILTS]
        names = tuple(unknowns[i].key for i in moves)
        values = [unknowns[i].value(self.begin(unknowns[i]), rows[:, i]) for i in moves]
        # What stands at the model's own value is the same simulation whether it is among the unknowns or not.
        keys = [
            tuple(
                # Rounded, so that a value that is reached in two ways is one simulation.
                (n, round(float(v[k]), 9))
                for n, v, i in zip(names, values, moves, strict=True)
                if abs(v[k] - self.begin(unknowns[i])) > 1e-12
            )
            for k in range(len(rows))
        ]
        new = [k for n, k in enumerate(keys) if k not in self._kept and k not in keys[:n]]
        if new:
            self._keep(unknowns, rows[[keys.index(k) for k in new]], moves, new)
        whole = [self._kept[k] for k in keys]
        return jax.tree.map(lambda *a: np.stack(a), *whole)

    def begin(self, unknown: Unknown) -> float:
        """The value from which an unknown moves."""
        has = unknown.effect == CALIBRATION or unknown.effect in self.model.effect_names
        return start_of(self.model if has else self.whole, unknown)

    def _keep(self, unknowns: Sequence[Unknown], full: np.ndarray, moves: Sequence[int], keys: Sequence[Any]) -> None:
        """Simulates rows of unknowns, all different, and keeps them by their keys."""
        count, windows = len(full), len(self.cut)
        params = jax.tree.map(lambda a: np.broadcast_to(a, (count, *a.shape)).copy(), self.params)
        for i in moves:
            u = unknowns[i]
            if u.effect == CALIBRATION:
                continue
            old = params.effects[u.effect][u.name]
            base = self.begin(u)
            new = u.value(base, full[:, i])
            spread = new.reshape(-1, *[1] * (old.ndim - 1))
            params.effects[u.effect][u.name] = np.asarray(
                old * (spread / base) if u.factor else np.broadcast_to(spread, old.shape), np.float32
            )
        pitch, roll, slope = (np.radians(self._value(unknowns, full, n)) for n in TILTS)
        # an IMU that sits askew shows another slope; where none was asked, the ground is level all the same
        asked = ~np.isin(self.cut.log, list(self.cut.unlevelled))
        imposed = self.cut.imposed
        out: list[Seen] = []
        jobs = np.stack(np.meshgrid(np.arange(count), np.arange(windows), indexing="ij"), -1).reshape(-1, 2)
        at = 0
        while at < len(jobs):
            size = PROGRAM.sizes[1] if len(jobs) - at > PROGRAM.few * PROGRAM.sizes[0] else PROGRAM.sizes[0]
            part = jobs[at : at + size]
            # Filled up, since another number of windows would be another program.
            part = np.concatenate([part, np.repeat(part[-1:], size - len(part), axis=0)])
            row, window = part[:, 0], part[:, 1]
            x, y, z = (np.asarray(a)[window] for a in (imposed.up_x, imposed.up_y, imposed.up_z))
            p, r = (asked[window] * pitch[row] + slope[row])[:, None], (asked[window] * roll[row])[:, None]
            given = Windows(
                *(
                    np.asarray(a, np.float32)
                    for a in (
                        np.asarray(imposed.speed)[window],
                        # Small turns about the rover's axes: products of two tilts are left out.
                        x - p * z,
                        y + r * z,
                        z + p * x - r * y,
                        np.asarray(imposed.yaw_rate)[window],
                    )
                )
            )
            found = self.drive.run(jax.tree.map(lambda a, row=row: a[row], params), given)
            wanted = min(size, len(jobs) - at)
            out.append(jax.tree.map(lambda a, wanted=wanted: a[:wanted], found))
            at += size
            self.progress("simulating windows", min(1.0, at / len(jobs)))
        whole = jax.tree.map(lambda *a: np.concatenate(a).reshape(count, windows, *a[0].shape[1:]), *out)
        for k, key in enumerate(keys):
            self._kept[key] = jax.tree.map(lambda a, k=k: a[k], whole)

    def _measured(self, unknowns: Sequence[Unknown], rows: np.ndarray, current: np.ndarray, seen: Seen) -> np.ndarray:
        """What instruments show of currents (k, side, window, bin) and of motion (k, window, bin)."""

        def of(name: str) -> np.ndarray:
            return self._value(unknowns, rows, name)[:, None, None]

        def late(series: np.ndarray, delay: np.ndarray) -> np.ndarray:
            rate = np.gradient(series, 0.5 * self.cut.interval_s, axis=-1)
            # To first order: a clock's usual error is a third of a sample.
            return series - delay * rate

        def whole(series: np.ndarray) -> np.ndarray:
            return 0.5 * (series[..., 0::2] + series[..., 1::2])

        floor = self.cut.magnitude
        out = []
        both = of("current_scale")
        half = 0.5 * of("current_difference")
        # scales are positive: a third of a current is as far from the whole as three times it
        scale = [np.exp(both + half + of("current_left")), np.exp(both - half + of("current_right"))]
        friction = [0.5 * of("friction_difference") * self._sense[0], -0.5 * of("friction_difference") * self._sense[1]]
        for side, channel in enumerate(CURRENTS):
            series = whole(scale[side] * (late(current[:, side], of("current_clock")) + friction[side]))
            if channel in floor:
                # Where magnitudes alone are logged, an ammeter's own floor adds to them by squares.
                series = np.hypot(series, floor[channel] * np.maximum(1.0 + of("current_floor"), 0.0))
            out.append(series)
        yaw = np.asarray(seen.yaw_rate)
        out.append(whole((1.0 + of("gyro_scale")) * late(yaw, of("imu_clock")) + of("gyro_bias")))
        ahead = whole(np.asarray(seen.speed_x) - of("position_aside") * yaw)
        out.append(np.hypot(ahead, whole(np.asarray(seen.speed_y))) if AHEAD in floor else ahead)
        return np.stack(out, axis=1)

    def linearise(self, unknowns: Sequence[Unknown], u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (channel, window, sample) at (unknown,), and derivatives (channel, window, sample, unknown)."""
        step = np.where(u > 0.0, -PROGRAM.step, PROGRAM.step)  # towards the prior's mean, so that bounds are not left
        values = self.predict(unknowns, np.concatenate([u[None], u + np.diag(step)]))
        slopes = np.moveaxis((values[1:] - values[0]) / step[:, None, None, None], 0, -1)
        return values[0], slopes

    def whitened(self, values: np.ndarray, noise: Sequence[Noise]) -> np.ndarray:
        """Residuals or derivatives (channel, window, sample, ...) in units of the noise; zero where unmeasured."""
        out = np.zeros_like(values)
        for c in range(len(CHANNELS)):
            for there, windows in patterns(self.there[c]):
                factor = noise[c].factor(there, self.cut.interval_s)
                block = np.moveaxis(values[c][windows][:, there], 1, 0)
                solved = linalg.solve_triangular(factor, block.reshape(len(block), -1), lower=True)
                scale = np.sqrt(self.weight[c][windows]).reshape(-1, *[1] * (values.ndim - 2))
                out[c][np.ix_(windows, there)] = np.moveaxis(solved.reshape(block.shape), 0, 1) * scale
        return out

    def residual(self, predicted: np.ndarray) -> np.ndarray:
        """(channel, window, sample) measured less predicted; zero where nothing was measured."""
        return np.where(self.there, np.nan_to_num(self.measured) - predicted, 0.0)

    @property
    def measured(self) -> np.ndarray:
        """(channel, window, sample) measurements, NaN where there are none."""
        return np.stack([self.cut.measured[c] for c in CHANNELS])

    @property
    def there(self) -> np.ndarray:
        """(channel, window, sample) where something was measured."""
        return np.asarray(np.isfinite(self.measured))

    @property
    def present(self) -> np.ndarray:
        """(channel, window) where a channel was measured at all."""
        return np.asarray(self.there.any(axis=2))


def patterns(there: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Windows that lack the same samples: (sample,) which there are, and numbers of the windows; none without any.

    Args:
      there: (window, sample) where something was measured.
    """
    kinds, number = np.unique(there, axis=0, return_inverse=True)
    return [(kind, np.flatnonzero(number.ravel() == k)) for k, kind in enumerate(kinds) if kind.any()]


_PROGRAMS: dict[Any, KinematicDrive] = {}
"""Programs take every number as an argument, so that models of one rover with the same effects share them."""


def _program(model: Model, bin_s: float) -> KinematicDrive:
    """The program of a model's effects, compiled once in a process."""
    key = str(model.rover.folder), tuple(id(e) for e in model.effects), round(bin_s, 9), float(model.gravity)
    if key not in _PROGRAMS:
        while len(_PROGRAMS) >= PROGRAM.most_programs:
            _PROGRAMS.pop(next(iter(_PROGRAMS)))
        _PROGRAMS[key] = KinematicDrive(model, round(bin_s, 9), PROGRAM.longest_step_s)
    return _PROGRAMS[key]


def _null(name: str) -> dict[str, float]:
    return catalogue.CATALOGUE[name].null()


def corners(model: Model) -> list[str]:
    """Corner and kind of every joint, as in channels.

    Raises:
      UserError: the rover has joints beside its drives, which imposed wheel speeds do not move.
    """
    require_drives_alone(model)
    names = {w.drive: f"{w.corner}_{KINDS[0]}" for w in model.rover.wheels}
    return [names[j] for j in model.rover.joints]


def proportions(residual: np.ndarray, there: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(channel, window) standard deviation of a window's noise over that of one where nothing acts.

    By maximum likelihood of noise that has a constant part and one in proportion to a size.

    Args:
      residual: (channel, window, sample). there: where something was measured.
      size: (channel, window) root mean square of what is predicted.
    """
    found = (proportion(*channel) for channel in zip(residual, there, size, strict=True))
    return np.stack([p.scale(s) for p, s in zip(found, size, strict=True)])


@dataclasses.dataclass(frozen=True)
class Proportion:
    """How a channel's noise grows with what it measures.

    Attributes:
      share: of noise in proportion to the size, at the usual one. usual: root mean square size, in the channel's unit.
    """

    share: float = 0.0
    usual: float = 1.0

    def scale(self, size: np.ndarray) -> np.ndarray:
        """Standard deviation at root mean square sizes over that where nothing acts, over 1 - share."""
        return np.hypot(1.0 - self.share, self.share * size / self.usual) if self.share else np.ones(np.shape(size))


def proportion(residual: np.ndarray, there: np.ndarray, size: np.ndarray) -> Proportion:
    """How one channel's noise grows with its size, from residuals (window, sample) and sizes (window,).

    Fewer than 3 windows tell nothing of it.
    """
    count = there.sum(axis=1)
    mine = count > 0
    if mine.sum() < 3:
        return Proportion()
    power = np.sum(np.where(there, residual**2, 0.0), axis=1)[mine] / count[mine]
    usual = power <= np.quantile(power, 0.9)
    whole = max(float(np.sqrt(np.mean(size[mine] ** 2))), 1e-12)
    best, found = np.inf, Proportion()
    for share in PROGRAM.shares:
        tried = Proportion(share, whole)
        grown = tried.scale(size[mine]) ** 2
        # Minus twice the log-likelihood by sample, up to a constant, with the overall size at its best.
        score = np.log(np.mean(power[usual] / grown[usual])) + np.mean(np.log(grown[usual]))
        if score < best - 1e-9:
            best, found = score, tried
    return found


def learn_noise(residual: np.ndarray, there: np.ndarray, interval_s: float) -> list[Noise]:
    """Noise of every channel by maximum likelihood from residuals (channel, window, sample), robustly.

    Slow parts of it are what a window differs from another by and no model explains: stones, patches, slopes. A colour
    is tried on a grid; windows with the largest tenth of squares are left out (a kerb, a collision).

    Args:
      residual: (channel, window, sample), finite. there: where something was measured. interval_s: between samples.
    """
    found = []
    for c in range(len(residual)):
        count = there[c].sum(axis=1)
        if (count > 0).sum() < 3:
            found.append(Noise(1.0, 0.0, 1.0))
            continue
        size = np.sum(np.where(there[c], residual[c] ** 2, 0.0), axis=1) / np.maximum(count, 1)
        usual = size <= np.quantile(size[count > 0], 0.9)
        groups = [(kind, rows[usual[rows]]) for kind, rows in patterns(there[c])]
        samples = sum(int(kind.sum()) * len(rows) for kind, rows in groups)
        best = (-np.inf, Noise(1.0, 0.0, 1.0))
        for share in (0.0, 0.3, 0.5, 0.7, 0.9, 0.97):
            for time_s in (0.2, 0.5, 1.0, 3.0, 20.0) if share else (1.0,):
                square = logs = 0.0
                for kind, rows in groups:
                    factor = Noise(1.0, share, time_s).factor(kind, interval_s)
                    block = residual[c][rows][:, kind]
                    square += float(np.sum(linalg.solve_triangular(factor, block.T, lower=True) ** 2))
                    logs += len(rows) * float(np.sum(np.log(np.diag(factor))))
                # For every colour the best size follows in closed form: only share and time are left to try.
                std = float(np.sqrt(max(square / samples, 1e-300)))
                score = -samples * np.log(std) - logs
                if score > best[0]:
                    best = score, Noise(max(std, 1e-9), share, time_s)
        found.append(best[1])
    return found


def student_weights(residual: np.ndarray, there: np.ndarray, noise: Sequence[Noise], interval_s: float) -> np.ndarray:
    """(channel, window) weights (nu + n)/(nu + chi^2) of Student's noise, for residuals (channel, window, sample).

    A window as a whole is an outlier or none: a wheel against a kerb, or a clock that is off by a second.
    """
    weight = np.ones(there.shape[:2])
    for c in range(len(residual)):
        for kind, rows in patterns(there[c]):
            factor = noise[c].factor(kind, interval_s)
            white = linalg.solve_triangular(factor, residual[c][rows][:, kind].T, lower=True)
            share = (PROGRAM.freedom + kind.sum()) / (PROGRAM.freedom + np.sum(white**2, axis=0))
            # Never above one: that a window happens to be quiet makes it no better witness.
            weight[c, rows] = np.minimum(share, 1.0)
    return weight
