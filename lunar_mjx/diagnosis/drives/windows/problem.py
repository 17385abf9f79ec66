"""Windows of drives as a problem: what every row of unknowns predicts of the measured currents and yaw rates."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from scipy import linalg

from lunar_mjx.diagnosis.drives.windows.coordinates import CALIBRATION, Unknown, start_of
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, Cut
from lunar_mjx.dynamics.imposed import KinematicDrive, Seen, Windows, on_a_plane
from lunar_mjx.dynamics.system import default_params
from lunar_mjx.effects import catalogue
from lunar_mjx.inference.fitting import Progress, silent
from lunar_mjx.model import Model

SIZES = (64, 1024)
"""Windows simulated at once, few and many: a program is compiled for each; the state of 1,024 stays in the cache."""
LONGEST_STEP_S = 0.008
"""Time step: currents of a Husky on its tyres differ from those at 2.5 ms by less than 0.01 A."""
STEP = 0.25
"""Step of difference quotients in units of the prior's standard deviation, and at most `STEP` of it."""
FREEDOM = 4.0
"""Degrees of freedom of Student's noise: heavy tails with a finite variance."""
FLOOR_A = 0.6
"""What an ammeter of magnitudes shows at rest: half of the 1.2 A that both sides of a standing Husky read."""
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

    def factor(self, samples: int, interval_s: float) -> np.ndarray:
        """Lower Cholesky factor (sample, sample) of the covariance of a window."""
        lag = np.abs(np.subtract.outer(np.arange(samples), np.arange(samples))) * interval_s
        whole = (1.0 - self.share) * np.eye(samples) + self.share * np.exp(-lag / self.time_s)
        return self.std * np.linalg.cholesky(whole)


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
        self._resistance: np.ndarray | None = None
        self._size: np.ndarray | None = None
        left = np.array([j.startswith("l") for j in corners(model)])
        self._side = np.stack([left, ~left]).astype(float)

    def predict(self, unknowns: Sequence[Unknown], rows: np.ndarray) -> np.ndarray:
        """Predictions.

        Args:
          unknowns: the coordinates. rows: (k, unknown) values in units of their priors.

        Returns:
          (k, channel, window, sample) currents of the sides, A, and yaw rate, rad/s.
        """
        seen = self._simulate(unknowns, rows)
        current = np.einsum("kwbj,sj->kswb", seen.current, self._side)
        return self._measured(unknowns, rows, current, seen.yaw_rate)

    def _value(self, unknowns: Sequence[Unknown], rows: np.ndarray, name: str) -> np.ndarray:
        """(k,) a calibration's value; the model's own, or zero, where it is not among the unknowns."""
        for i, unknown in enumerate(unknowns):
            if unknown.effect == CALIBRATION and unknown.name == name:
                return np.asarray(unknown.value(start_of(self.model, unknown), rows[:, i]))
        return np.full(len(rows), self.model.priors.get(f"{CALIBRATION}.{name}", (0.0, 0.0))[0])

    def _simulate(self, unknowns: Sequence[Unknown], rows: np.ndarray) -> Seen:
        """Means over half intervals, (k, window, bin, ...); rows that differ in sensors alone are simulated once."""
        moves = [i for i, u in enumerate(unknowns) if u.effect != CALIBRATION or u.name in ("pitch", "roll")]
        names = tuple(unknowns[i].key for i in moves)
        values = [unknowns[i].value(self.begin(unknowns[i]), rows[:, i]) for i in moves]
        # What stands at the model's own value is the same simulation whether it is among the unknowns or not.
        keys = [
            tuple(
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
        pitch, roll = (np.radians(self._value(unknowns, full, n)) for n in ("pitch", "roll"))
        imposed = self.cut.imposed
        out: list[Seen] = []
        jobs = np.stack(np.meshgrid(np.arange(count), np.arange(windows), indexing="ij"), -1).reshape(-1, 2)
        size = next((s for s in SIZES if s >= len(jobs)), SIZES[-1])
        for at in range(0, len(jobs), size):
            part = jobs[at : at + size]
            part = np.concatenate([part, np.repeat(part[-1:], size - len(part), axis=0)])
            row, window = part[:, 0], part[:, 1]
            x, y, z = (np.asarray(a)[window] for a in (imposed.up_x, imposed.up_y, imposed.up_z))
            p, r = pitch[row][:, None], roll[row][:, None]
            given = Windows(
                *(
                    np.asarray(a, np.float32)
                    for a in (
                        np.asarray(imposed.speed)[window],
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
            self.progress("simulating windows", min(1.0, (at + size) / len(jobs)))
        whole = jax.tree.map(lambda *a: np.concatenate(a).reshape(count, windows, *a[0].shape[1:]), *out)
        for k, key in enumerate(keys):
            self._kept[key] = jax.tree.map(lambda a, k=k: a[k], whole)

    def _measured(
        self, unknowns: Sequence[Unknown], rows: np.ndarray, current: np.ndarray, yaw: np.ndarray
    ) -> np.ndarray:
        """What the instruments make of currents (k, side, window, bin) and yaw rates (k, window, bin)."""

        def of(name: str) -> np.ndarray:
            return self._value(unknowns, rows, name)[:, None, None]

        def late(series: np.ndarray, delay: np.ndarray) -> np.ndarray:
            rate = np.gradient(series, 0.5 * self.cut.interval_s, axis=-1)
            return series - delay * rate

        out = []
        both = of("current_scale")
        half = 0.5 * of("current_difference")
        scale = [1.0 + both + half + of("current_left"), 1.0 + both - half + of("current_right")]
        for side in range(2):
            series = scale[side] * late(current[:, side], of("current_clock"))
            series = 0.5 * (series[..., 0::2] + series[..., 1::2])
            if CHANNELS[side] in self.cut.magnitude:
                series = np.sqrt(series**2 + np.maximum(FLOOR_A + of("current_floor"), 0.0) ** 2)
            out.append(series)
        turn = (1.0 + of("gyro_scale")) * late(yaw, of("imu_clock")) + of("gyro_bias")
        out.append(0.5 * (turn[..., 0::2] + turn[..., 1::2]))
        return np.stack(out, axis=1)

    def linearise(self, unknowns: Sequence[Unknown], u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Predictions (channel, window, sample) at (unknown,), and derivatives (channel, window, sample, unknown)."""
        step = np.where(u > 0.0, -STEP, STEP)  # towards the prior's mean, so that bounds are not left
        values = self.predict(unknowns, np.concatenate([u[None], u + np.diag(step)]))
        slopes = np.moveaxis((values[1:] - values[0]) / step[:, None, None, None], 0, -1)
        return values[0], slopes

    def whitened(self, values: np.ndarray, noise: Sequence[Noise]) -> np.ndarray:
        """Residuals or derivatives (channel, window, sample, ...) in units of the noise; zero where unmeasured.

        A window that lacks samples of a channel is left out for that channel.
        """
        out = np.zeros_like(values)
        for c, name in enumerate(CHANNELS):
            whole = np.isfinite(self.cut.measured[name]).all(axis=1)
            factor = noise[c].factor(self.cut.samples, self.cut.interval_s)
            block = np.moveaxis(values[c][whole], 1, 0)
            shape = block.shape
            solved = linalg.solve_triangular(factor, block.reshape(shape[0], -1), lower=True)
            scale = np.sqrt(self.weight[c][whole]).reshape(-1, *[1] * (len(shape) - 1))
            out[c][whole] = np.moveaxis(solved.reshape(shape), 0, 1) * scale
        return out

    def resistance_slope(self) -> np.ndarray:
        """(channel, window, sample) change of the predictions per coefficient of rolling resistance, at the model."""
        if self._resistance is None:
            coefficient = Unknown("rolling_resistance", "coefficient", 0.03)
            given = self.predict((coefficient,), np.array([[0.0], [1.0]]))
            self._resistance = (given[1] - given[0]) / coefficient.std
            self._size = np.abs(given[0])
        assert self._resistance is not None
        return self._resistance

    def current_size(self) -> np.ndarray:
        """(channel, window, sample) sizes of the predictions of the model as given."""
        self.resistance_slope()
        assert self._size is not None
        return self._size

    @property
    def measured(self) -> np.ndarray:
        """(channel, window, sample) measurements, NaN where there are none."""
        return np.stack([self.cut.measured[c] for c in CHANNELS])

    @property
    def present(self) -> np.ndarray:
        """(channel, window) where a channel was measured throughout."""
        return np.asarray(np.isfinite(self.measured).all(axis=2))


_PROGRAMS: dict[Any, KinematicDrive] = {}
"""Programs take every number as an argument, so that models of one rover with the same effects share them."""
_MOST_PROGRAMS = 8


def _program(model: Model, bin_s: float) -> KinematicDrive:
    """The program of a model's effects, compiled once in a process."""
    key = str(model.rover.folder), tuple(id(e) for e in model.effects), round(bin_s, 9), float(model.gravity)
    if key not in _PROGRAMS:
        while len(_PROGRAMS) >= _MOST_PROGRAMS:
            _PROGRAMS.pop(next(iter(_PROGRAMS)))
        _PROGRAMS[key] = KinematicDrive(model, round(bin_s, 9), LONGEST_STEP_S)
    return _PROGRAMS[key]


def _null(name: str) -> dict[str, float]:
    return catalogue.CATALOGUE[name].null()


def corners(model: Model) -> list[str]:
    """Corner and kind of every joint, as in channels."""
    from lunar_mjx.logs.schema import KINDS

    names = {w.drive: f"{w.corner}_{KINDS[0]}" for w in model.rover.wheels}
    return [names[j] for j in model.rover.joints]


def learn_noise(residual: np.ndarray, present: np.ndarray, interval_s: float) -> list[Noise]:
    """Noise of every channel by maximum likelihood from residuals (channel, window, sample), robustly.

    Slow parts of it are what a window differs from another by and no model explains: stones, patches, slopes. A colour
    is tried on a grid; windows with the largest tenth of squares are left out (a kerb, a collision).
    """
    found = []
    for c in range(len(residual)):
        block = residual[c][present[c]]
        if len(block) < 3:
            found.append(Noise(1.0, 0.0, 1.0))
            continue
        size = np.mean(block**2, axis=1)
        block = block[size <= np.quantile(size, 0.9)]
        best = (-np.inf, Noise(1.0, 0.0, 1.0))
        for share in (0.0, 0.3, 0.5, 0.7, 0.9, 0.97):
            for time_s in (0.2, 0.5, 1.0, 3.0, 20.0):
                factor = Noise(1.0, share, time_s).factor(block.shape[1], interval_s)
                white = linalg.solve_triangular(factor, block.T, lower=True)
                std = float(np.sqrt(np.mean(white**2)))
                score = -block.size * np.log(std) - len(block) * float(np.sum(np.log(np.diag(factor))))
                if score > best[0]:
                    best = score, Noise(std, share, time_s)
        found.append(best[1])
    return found


def student_weights(residual: np.ndarray, present: np.ndarray, noise: Sequence[Noise], interval_s: float) -> np.ndarray:
    """(channel, window) weights (nu + n)/(nu + chi^2) of Student's noise, for residuals (channel, window, sample).

    A window as a whole is an outlier or none: a wheel against a kerb, or a clock that is off by a second.
    """
    weight = np.ones(present.shape)
    samples = residual.shape[2]
    for c in range(len(residual)):
        white = linalg.solve_triangular(noise[c].factor(samples, interval_s), residual[c].T, lower=True)
        square = np.sum(white**2, axis=0)
        weight[c] = np.where(present[c], np.minimum((FREEDOM + samples) / (FREEDOM + square), 1.0), 1.0)
    return weight
