"""When did something begin? Sequential detection of jumps in the amounts that a linear model leaves of a series.

A series comes in steps (such as windows of two seconds). In step t a fitted model leaves

    r_t = C_t (x_t + s_t) + e_t,      x_{t+1} = x_t + w_t,      x_0 ~ N(0, start^2)

    r_t   (n_t,) measured less predicted, in units of the noise;  C_t  (n_t, k) what each amount changes of it
    x_t   (k,) amounts by which this series differs from the model: constant but for a slow walk w_t ~ N(0, walk^2)
    s_t   scatter from step to step, N(0, scatter^2), and in rare outlying steps N(0, outlying^2), noise louder too

A jump of kind p at step j adds N(0, size_p^2) to x_j for good. Each pair (j, p) is a Kalman filter beside that without
a jump (Willsky & Jones 1976), with the probability ratio Lambda_{jp} of all that was measured since j. The alarm is
raised when the statistic of Shiryaev and Roberts

    R_t = sum over j <= t of mean over p of Lambda_{jp}

reaches A. Without a jump R_t - t is a martingale, so that the mean time to a false alarm is at least A steps, whatever
the jumps that are looked for (Pollak 1985): the promised rate is the threshold, and there is nothing to tune. The
promise holds as far as undisturbed series are like those that `learn` has seen.

No such law is exact: what a model leaves of a series comes in stretches that no walk has. Ratios are therefore taken to
a power eta <= 1 (Gruenwald & van Ommen 2017), the largest with which the series that were learnt from raise no alarm
at the threshold A of their own length. With eta < 1 the mean of R_t is below t where the law holds (Jensen).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import optimize


@dataclasses.dataclass(frozen=True)
class ChangeSettings:
    """What is assumed of series that may change, and how it is learnt."""

    memory: int = 20
    """Steps for which a jump that may have begun is kept in mind; forgetting only lowers the statistic."""
    louder: float = 3.0
    """Factor of the noise in outlying steps."""
    powers: tuple[float, ...] = (1.0, 0.7, 0.5, 0.35, 0.25, 0.15, 0.1)
    """Powers of probability ratios that are tried."""
    most_trials: int = 100
    """Trials of `learn` at most."""
    log_std: float = 2.0
    """Prior standard deviation of the logarithms of what `learn` learns: it may be off by a factor of seven."""
    bounds: tuple[tuple[float, float], ...] = ((1e-3, 3.0), (1e-3, 1.0), (0.2, 5.0), (1e-3, 0.3), (1e-2, 3.0))
    """Least and most of each number of a `Restlessness`."""


CHANGE = ChangeSettings()

_LOG_2PI = math.log(2.0 * math.pi)

Step = tuple[np.ndarray, np.ndarray]
"""Columns (n, k) and residuals (n,) of a step, both in units of the noise."""


@dataclasses.dataclass(frozen=True, eq=False)
class Undisturbed:
    """How a series moves in which nothing begins.

    Attributes:
      start: (k,) standard deviation of the amounts at the beginning.
      walk: (k,) of their change from step to step. scatter: (k,) of what each step adds for itself.
      outlying: (k,) of the same in outlying steps. rare: probability of these.
      noise: factor of the stated noise. power: of probability ratios, at most 1.
    """

    start: np.ndarray
    walk: np.ndarray
    scatter: np.ndarray
    outlying: np.ndarray
    rare: float
    noise: float
    power: float = 1.0


@dataclasses.dataclass(frozen=True, eq=False)
class Change:
    """An alarm.

    Attributes:
      onset: most probable step of the jump. first, last: steps between which it lies with 95 %.
      seen: step of the alarm. kinds: probability of each kind of jump, most probable first.
      amount, std: (k,) change of the amounts by the most probable jump, and its standard deviation.
      log_statistic: log R at the alarm.
    """

    onset: int
    first: int
    last: int
    seen: int
    kinds: Mapping[str, float]
    amount: np.ndarray
    std: np.ndarray
    log_statistic: float


class ChangeDetector:
    """Follows one series and raises alarms.

    Attributes:
      log_statistic: log R after the last step. count: steps seen.
    """

    def __init__(self, usual: Undisturbed, jumps: Mapping[str, np.ndarray], between_alarms: float):
        """Makes the detector.

        Args:
          usual: how an undisturbed series moves. jumps: (k,) standard deviation of the jump of each kind.
          between_alarms: steps from one false alarm to the next, at least, in the mean.
        """
        self.usual, self.names = usual, tuple(jumps)
        self._jumps = np.stack([np.diag(np.asarray(size, float) ** 2) for size in jumps.values()])
        # while nothing changes, R less the steps seen is a martingale: it reaches A after A steps in the mean, or more
        self._threshold = math.log(between_alarms)
        self.count = 0
        width = len(usual.start)
        self._mean, self._cov = np.zeros((1, width)), np.diag(usual.start**2)[None]
        self._forget()

    def _forget(self) -> None:
        """Leaves only the filter without a jump."""
        self._mean, self._cov = self._mean[:1], self._cov[:1]
        self._log_ratio = np.zeros(0)
        self._begun = np.zeros(0, int)
        self._kind = np.zeros(0, int)
        self._before: list[tuple[np.ndarray, np.ndarray]] = []
        self.log_statistic = -math.inf

    def see(self, columns: np.ndarray, residual: np.ndarray) -> Change | None:
        """Takes the next step; the alarm if it raises one, after which the series goes on from its new amounts.

        Args:
          columns: (n, k). residual: (n,), both in units of the noise, n >= 1.
        """
        kinds = len(self.names)
        # a jump may begin at any step, so that each step starts a filter for every kind of it
        born = self._cov[:1] + self._jumps
        self._mean = np.concatenate([self._mean, np.repeat(self._mean[:1], kinds, axis=0)])
        self._cov = np.concatenate([self._cov, born])
        self._log_ratio = np.append(self._log_ratio, np.zeros(kinds))
        self._begun = np.append(self._begun, np.full(kinds, self.count))
        self._kind = np.append(self._kind, np.arange(kinds))
        density, self._mean, self._cov = _update(self.usual, self._mean, self._cov, columns, residual)
        self._log_ratio += self.usual.power * (density[1:] - density[0])
        # The filter without a jump (first) always stays; of the others only those that began within memory.
        keep = self._begun > self.count - CHANGE.memory
        kept_columns = np.append(True, keep)
        self._mean, self._cov = self._mean[kept_columns], self._cov[kept_columns]
        self._log_ratio, self._begun, self._kind = self._log_ratio[keep], self._begun[keep], self._kind[keep]
        # Shiryaev and Roberts: the sum over beginnings of likelihood ratios, each against the filter without a jump
        # A mean over the kinds: as a sum, R would grow by their number in every step and not by one.
        self.log_statistic = float(np.logaddexp.reduce(self._log_ratio)) - math.log(kinds)
        self.count += 1
        if self.log_statistic < self._threshold:
            # The walk between this step and the next.
            self._cov = self._cov + np.diag(self.usual.walk**2)
            return None
        alarm = self._alarm()
        best = 1 + int(np.argmax(self._log_ratio))
        # From here on the most probable jump is taken for granted, and the next one is looked for beside it.
        self._mean[0], self._cov[0] = self._mean[best], self._cov[best] + np.diag(self.usual.walk**2)
        self._forget()
        return alarm

    def _alarm(self) -> Change:
        chance = np.exp(self._log_ratio - np.logaddexp.reduce(self._log_ratio))
        best = int(np.argmax(chance))
        kinds = {name: float(chance[self._kind == n].sum()) for n, name in enumerate(self.names)}
        steps = np.arange(self._begun.min(), self._begun.max() + 1)
        by_step = np.array([chance[self._begun == s].sum() for s in steps])
        inside = np.cumsum(by_step)
        return Change(
            onset=int(steps[np.argmax(by_step)]),
            first=int(steps[np.searchsorted(inside, 0.025)]),
            last=int(steps[min(np.searchsorted(inside, 0.975), len(steps) - 1)]),
            seen=self.count - 1,
            kinds=dict(sorted(kinds.items(), key=lambda item: -item[1])),
            amount=self._mean[1 + best] - self._mean[0],
            std=np.sqrt(np.maximum(np.diag(self._cov[1 + best]), 0.0)),
            log_statistic=self.log_statistic,
        )


def _compressed(columns: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, int]:
    """The part of a step that tells of amounts, (m, k) and (m,), and what is noise alone: its squares and number."""
    if len(residual) <= columns.shape[1]:
        return columns, residual, 0.0, 0
    # the rest is orthogonal to all columns: it tells of the noise alone, and goes in as one number
    orthogonal, upper = np.linalg.qr(columns)
    inside = orthogonal.T @ residual
    outside = max(float(residual @ residual - inside @ inside), 0.0)
    return upper, inside, outside, len(residual) - len(inside)


def _update(
    usual: Undisturbed, mean: np.ndarray, cov: np.ndarray, columns: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Log densities (b,) of a step under b filters, and their means (b, k) and covariances (b, k, k) after it.

    A step is usual or outlying; the two are merged by their moments.
    """
    h, y, outside, free = _compressed(columns, residual)
    innovation = y - mean @ h.T
    crossed = cov @ h.T
    logs, means, covs = [], [], []
    cases = ((1.0 - usual.rare, usual.scatter, usual.noise), (usual.rare, usual.outlying, CHANGE.louder * usual.noise))
    for chance, scatter, noise in cases:
        # What a step scatters ends with it: noise along the columns, and no part of the state.
        own = (h * scatter**2) @ h.T + noise**2 * np.eye(len(h))
        whole = h @ crossed + own
        factor = np.linalg.cholesky(whole)
        white = np.linalg.solve(factor, innovation[..., None])[..., 0]
        gain = np.swapaxes(np.linalg.solve(whole, np.swapaxes(crossed, 1, 2)), 1, 2)
        log_size = 2.0 * np.log(np.diagonal(factor, axis1=1, axis2=2)).sum(axis=1)
        quiet = outside / noise**2 + free * 2.0 * math.log(noise) + len(residual) * _LOG_2PI
        logs.append(math.log(chance) - 0.5 * (np.sum(white**2, axis=1) + log_size + quiet))
        means.append(mean + np.einsum("bkm,bm->bk", gain, innovation))
        covs.append(cov - gain @ np.swapaxes(crossed, 1, 2))
    # a mixture of two has twice as many parts after every step; merging by moments keeps it at one
    density = np.logaddexp(*logs)
    weight = np.exp(np.stack(logs) - density)
    middle = np.einsum("cb,cbk->bk", weight, np.stack(means))
    spread = np.stack(means) - middle
    merged = np.einsum("cb,cbkl->bkl", weight, np.stack(covs)) + np.einsum("cb,cbk,cbl->bkl", weight, spread, spread)
    # rounding leaves it a little asymmetric, which would grow from step to step
    return density, middle, 0.5 * (merged + np.swapaxes(merged, 1, 2))


def log_density(usual: Undisturbed, series: Sequence[Step]) -> float:
    """Log density of an undisturbed series."""
    mean, cov, total = np.zeros((1, len(usual.start))), np.diag(usual.start**2)[None], 0.0
    for columns, residual in series:
        density, mean, cov = _update(usual, mean, cov, columns, residual)
        cov = cov + np.diag(usual.walk**2)
        total += float(density[0])
    return total


@dataclasses.dataclass(frozen=True, eq=False)
class Amounts:
    """What is known of the amounts of a series before it is seen.

    Attributes:
      start: (k,) as of `Undisturbed`. moving: (k,) usual sizes of those that walk and scatter, in proportion to these;
        0: constant. jump: (k,) sizes of jumps, which is how far outlying steps lie.
      bent: (k,) whether `start` holds in proportion to what is learnt: amounts by which a law bends with what is done.
    """

    start: np.ndarray
    moving: np.ndarray
    jump: np.ndarray
    bent: np.ndarray

    def jumps(self, names: Sequence[str] | None = None) -> dict[str, np.ndarray]:
        """(k,) sizes of each kind of jump, one for each amount that may jump, by its name (or number)."""
        words = [str(i) for i in range(len(self.jump))] if names is None else names
        alone = np.diag(self.jump)
        return {word: row for word, row in zip(words, alone, strict=True) if row.any()}


@dataclasses.dataclass(frozen=True)
class Restlessness:
    """How much undisturbed series move.

    Attributes:
      scatter, walk: shares of the usual sizes. noise: factor of the stated noise. rare: probability of outlying steps.
      bend: share of the usual sizes by which amounts depend on what is done. power: of probability ratios.
    """

    scatter: float = 0.1
    walk: float = 0.03
    noise: float = 1.0
    rare: float = 0.02
    bend: float = 0.3
    power: float = 1.0

    def of(self, amounts: Amounts) -> Undisturbed:
        """An undisturbed series of such amounts."""
        walk, scatter = self.walk * amounts.moving, self.scatter * amounts.moving
        start = np.where(amounts.bent, self.bend, 1.0) * amounts.start
        return Undisturbed(start, walk, scatter, amounts.jump, self.rare, self.noise, self.power)


def learn(series: Sequence[tuple[Amounts, Sequence[Step]]], usual: Restlessness = Restlessness()) -> Restlessness:
    """How much undisturbed series move, most probably, if logarithms are normal about usual ones.

    Args:
      series: undisturbed ones, each with what is known of its amounts. usual: the middle of the prior.
    """
    centre = np.log(dataclasses.astuple(usual)[: len(CHANGE.bounds)])

    def made(place: np.ndarray) -> Restlessness:
        return Restlessness(*(float(np.clip(math.exp(v), *b)) for v, b in zip(place, CHANGE.bounds, strict=True)))

    def cost(place: np.ndarray) -> float:
        law = made(place)
        prior = 0.5 * float(np.sum(((place - centre) / CHANGE.log_std) ** 2))
        return prior - sum(log_density(law.of(amounts), steps) for amounts, steps in series)

    # Clipped numbers have no slope, and there are five of them: a simplex needs none.
    simplex = centre + np.vstack([np.zeros(5), np.diag([1.0, 1.0, 0.3, 0.7, 1.0])])
    optimum = optimize.minimize(
        cost,
        centre,
        method="Nelder-Mead",
        options={"initial_simplex": simplex, "xatol": 0.05, "fatol": 0.1, "maxfev": CHANGE.most_trials},
    )
    return _tempered(made(optimum.x), series)


def _tempered(restless: Restlessness, series: Sequence[tuple[Amounts, Sequence[Step]]]) -> Restlessness:
    """A restlessness with the largest power at which these series raise no alarm at the threshold of their length."""
    length = float(sum(len(steps) for _, steps in series))
    # They fall, so that the first that raises no alarm is the largest.
    for power in CHANGE.powers[:-1]:
        tempered = dataclasses.replace(restless, power=power)
        if not any(_raises(tempered.of(amounts), amounts, steps, length) for amounts, steps in series):
            return tempered
    return dataclasses.replace(restless, power=CHANGE.powers[-1])


def _raises(usual: Undisturbed, amounts: Amounts, steps: Sequence[Step], between_alarms: float) -> bool:
    """Whether a series raises an alarm."""
    detector = ChangeDetector(usual, amounts.jumps(), max(between_alarms, 2.0))
    return any(detector.see(*step) is not None for step in steps)
