"""Evidence of a linear-Gaussian model with unknown sizes of discrepancy and of noise.

Around a refit every model of measurements is

    r = C a + e,        e ~ N(0, s_c^2) in noise group c,        a ~ N(mean, (size std)^2)

    r       measured less predicted at the refit, in units of the stated noise (so that s_c is about 1)
    C       derivatives of the prediction by everything unknown: parameters, calibration, unknown inputs at the ports
    size    1 for amplitudes whose prior is known (parameters, calibration); tau_f for those of discrepancy field f

Sizes have priors of their own: tau_f is half-normal about a usual size (Kennedy & O'Hagan 2001: no model is exact), s_c
is log-normal where the noise is only stated and scaled inverse-chi where replicates tell it. The evidence

    p(r) = integral of p(r | tau, s) p(tau) p(s)

is closed form in the amplitudes and Laplace's in log tau and log s. Everything is computed from Gram matrices of
[C, r] by noise group: the number of measurements enters once, when these are accumulated, and never again.

How to plug in a model (tables and drives alike)::

    gram = Gram.of(columns, residual, group, groups=2)         # (n, k), (n,), (n,) numbers 0..groups-1, whitened
    gram = gram + Gram.of(more_columns, more_residual, ...)    # other logs, windows or chunks of the same columns
    amplitudes = Amplitudes(std=..., field=...)                # (k,) prior; field -1: std alone, else times tau_field
    found = infer(gram, amplitudes, fields=(Field("soil: stiffness", 0.05),),
                  noises=(NoiseSize("speed", 0.3), NoiseSize("pose", 0.3)))
    found.log_evidence, found.tau, found.noise, found.mean, found.covariance

A hypothesis is a choice of columns: `gram.select(places)` with the amplitudes of these places. All hypotheses must be
held against the same rows. `found.log_score(held_out)` judges measurements that chose nothing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import linalg, special

_LOG_2PI = math.log(2.0 * math.pi)


@dataclasses.dataclass(frozen=True)
class SizeDescent:
    """Newton's method on the sizes of discrepancy and noise."""

    most_steps: int = 60
    """Newton steps of the sizes at most; from usual sizes 5 to 12 are needed."""
    longest: float = 2.0
    """Longest Newton step of the logarithm of a size."""
    settled: float = 1e-6
    """nat; gain of log density by a further Newton step below which sizes have settled."""
    bearable: float = 0.01
    """nat; what a further step may still promise after the last one: it changes no probability by more than 1 %. Sizes
    along a valley creep: a foreign campaign of a Husky promised 5e-6 after 60 steps, and ended with an error."""
    rounding: float = 1e-6
    """1; share of the measurements' sum of squares that rounding may take from a chi-square."""
    most_levels: int = 8
    """Steps from level to level of slow errors at most."""


SIZE_DESCENT = SizeDescent()


class EvidenceError(ArithmeticError):
    """Sizes did not settle, or numbers are not finite or too large: the solver failed and says nothing of a model."""


@dataclasses.dataclass(frozen=True, eq=False)
class Gram:
    """Sufficient statistics of whitened measurements, by noise group.

    Attributes:
      count: (groups,) number of measurements.
      matrix: (groups, k + 1, k + 1) sums over measurements of the products of [columns, residual].
    """

    count: np.ndarray
    matrix: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray, residual: np.ndarray, group: np.ndarray | None = None, groups: int = 1) -> Gram:
        """Accumulates measurements.

        Args:
          columns: (n, k) whitened derivatives of the prediction.
          residual: (n,) measured less predicted, whitened.
          group: (n,) noise group of every measurement; all in group 0 if None.
          groups: number of noise groups.

        Raises:
          EvidenceError: something is not finite.
        """
        whole = np.column_stack([columns, residual])
        if not np.isfinite(whole).all():
            raise EvidenceError("derivatives or residuals are not finite")
        # Groups are kept apart, since each has a noise factor of its own that is not known yet.
        number = np.zeros(len(residual), int) if group is None else np.asarray(group)
        count = np.bincount(number, minlength=groups)
        matrix = np.zeros((groups, whole.shape[1], whole.shape[1]))
        for g in range(groups):
            rows = whole[number == g]
            matrix[g] = rows.T @ rows
        return cls(count, matrix)

    def __add__(self, other: Gram) -> Gram:
        return Gram(self.count + other.count, self.matrix + other.matrix)

    def select(self, places: np.ndarray) -> Gram:
        """The statistics of a model with these columns alone."""
        keep = np.append(np.asarray(places, int), self.matrix.shape[1] - 1)
        return Gram(self.count, self.matrix[:, keep[:, None], keep])

    @property
    def width(self) -> int:
        """Number of columns."""
        return self.matrix.shape[1] - 1


@dataclasses.dataclass(frozen=True, eq=False)
class Levels:
    """Measurements whose slow errors have an unknown size, one of some levels in each group.

    What a model leaves out beyond its ports shows as slow errors of whole groups of measurements.

    Attributes:
      columns, residual: (n, k), (n,) as those of `Gram`, not whitened. group: (n,) number of each.
      whiten: gives columns (n, m), whitened at a level (groups,) of each group.
      log_scale: (levels, groups) sum of the logarithms of what whitening divides by.
      log_prior: (levels,) log prior density of each level.
      starts: (m, groups) levels to begin at, of which the one counts that leads to the most probable end.
    """

    columns: np.ndarray
    residual: np.ndarray
    group: np.ndarray
    whiten: Callable[[np.ndarray, np.ndarray], np.ndarray]
    log_scale: np.ndarray
    log_prior: np.ndarray
    starts: np.ndarray

    def gram(self, levels: np.ndarray) -> Gram:
        """The statistics at a level (groups,) of each group."""
        white = self.whiten(levels, np.column_stack([self.columns, self.residual]))
        return Gram.of(white[:, :-1], white[:, -1], self.group, self.log_scale.shape[1])

    def log_weight(self, levels: np.ndarray) -> float:
        """What is added to the log evidence of measurements whitened at a level (groups,) of each group."""
        # Every size whitens into units of its own; their Jacobian makes evidences at different sizes comparable.
        return float(np.sum(self.log_prior[levels] - self.log_scale[levels, np.arange(len(levels))]))

    def improved(self, found: Evidence, noises: Sequence[NoiseSize]) -> tuple[np.ndarray, np.ndarray]:
        """Most probable levels and factors on the noise, (groups,) each, if the amplitudes are as found (a step of EM).

        The two go together: errors that are too large make the noise seem too small, and would never be left alone.
        """
        groups = self.log_scale.shape[1]
        # The expected square, not the one at the mean: what the amplitudes may still be adds to it (the E step).
        left = found.left(self.columns, self.residual)
        square = np.empty_like(self.log_scale)
        for level in range(len(square)):
            each = expected_square(self.whiten(np.full(groups, level), left))
            square[level] = np.bincount(self.group, each, minlength=groups)
        count = np.bincount(self.group, minlength=groups).astype(float)
        x, log_prior = np.empty_like(square), np.empty_like(square)
        for g, prior in enumerate(noises):
            x[:, g], log_prior[:, g] = _most_probable_noise(square[:, g], count[g], prior)
        value = -0.5 * square * np.exp(-2.0 * x) - count * x + log_prior - self.log_scale + self.log_prior[:, None]
        # Given the amplitudes, groups are independent: each takes its best level without regard to the others.
        at = np.argmax(value, axis=0)
        return at, np.exp(x[at, np.arange(len(at))])


_DRAWS = 24
"""Draws by which what amplitudes may still be is told: of a hundred of them, to 3 %."""


def expected_square(white: np.ndarray) -> np.ndarray:
    """(n,) expected squares of whitened residuals, from what `Evidence.left` gives, whitened."""
    return white[:, 0] ** 2 + np.sum(white[:, 1:] ** 2, axis=1) / max(white.shape[1] - 1, 1)


def _most_probable_noise(square: np.ndarray, count: float, prior: NoiseSize) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of the most probable factor on the noise for (levels,) sums of squares, and its log prior density."""
    if prior.freedom > 0.0:
        # The derivative by x vanishes here: this prior acts like further measurements of that number.
        x = 0.5 * np.log((square + prior.freedom) / (count + prior.freedom))
        return x, -prior.freedom * x - 0.5 * prior.freedom * np.exp(-2.0 * x)
    x = 0.5 * np.log(np.maximum(square, 1e-300) / max(count, 1.0))
    # The slope in x is convex and falls, so that Newton's steps converge from either side without a line search.
    for _ in range(20):
        power = square * np.exp(-2.0 * x)
        x = x + (power - count - x / prior.log_std**2) / (2.0 * power + prior.log_std**-2)
    return x, -0.5 * (x / prior.log_std) ** 2


def moved(matrix: np.ndarray, amounts: np.ndarray) -> np.ndarray:
    """Statistics (..., k + 1, k + 1) after amplitudes have been moved by (k,) amounts: those times columns are gone."""
    out = matrix.copy()
    # The square of (residual - columns amounts), expanded: no measurement is seen again.
    change = matrix[..., :-1, :-1] @ amounts
    out[..., -1, -1] += change @ amounts - 2.0 * (matrix[..., :-1, -1] @ amounts)
    out[..., :-1, -1] -= change
    out[..., -1, :-1] -= change
    return out


@dataclasses.dataclass(frozen=True, eq=False)
class Amplitudes:
    """Prior of the amplitudes of the columns.

    Attributes:
      std: (k,) standard deviation, in units of the field's size where there is a field; finite and positive.
      field: (k,) number of the discrepancy field that an amplitude belongs to, or -1.
      mean: (k,) prior mean relative to the refit.
    """

    std: np.ndarray
    field: np.ndarray
    mean: np.ndarray

    @classmethod
    def of(cls, std: np.ndarray, field: np.ndarray | None = None, mean: np.ndarray | None = None) -> Amplitudes:
        """Amplitudes with defaults: no field, zero mean."""
        std = np.asarray(std, float)
        return cls(
            std,
            np.full(len(std), -1) if field is None else np.asarray(field, int),
            np.zeros(len(std)) if mean is None else np.asarray(mean, float),
        )

    def select(self, places: np.ndarray) -> Amplitudes:
        """The prior of some columns alone."""
        return Amplitudes(self.std[places], self.field[places], self.mean[places])


WALL = 16
"""1; power of what a half-normal prior's exponent holds, of sizes that are usual at most: at 1.2 of the usual size the
density has fallen by 170 nats, below it by nearly nothing."""


@dataclasses.dataclass(frozen=True)
class Field:
    """A discrepancy of unknown size tau.

    Attributes:
      name: for reports.
      usual: scale of tau's half-normal prior, in the unit of the amplitudes (such as 0.05 for 5 % of a stress).
      log_std: standard deviation of log tau where other measurements have told tau; if positive, tau has a log-normal
        distribution about `usual` in place of the half-normal one.
      freedom: if positive, tau has the scaled inverse-chi distribution of that freedom: amplitudes of this field have
        Student's t distribution, of scale `usual`.
      bounded: whether tau is `usual` or little more at most, in place of the half-normal prior; not normalised.
    """

    name: str
    usual: float
    log_std: float = 0.0
    freedom: float = 0.0
    bounded: bool = False


@dataclasses.dataclass(frozen=True)
class NoiseSize:
    """The unknown factor s on the stated noise of a group of measurements.

    Attributes:
      name: for reports.
      log_std: standard deviation of log s where the noise is stated, 0.3 for "30 % off at most times".
      freedom: degrees of freedom of the replicates that the stated noise was computed from; if positive, s has their
        scaled inverse-chi distribution in place of the log-normal one.
    """

    name: str
    log_std: float = 0.3
    freedom: float = 0.0


class _At(NamedTuple):
    """The log density of the sizes at a place: its value, gradient and negative Hessian, and the amplitudes there."""

    value: float
    gradient: np.ndarray
    hessian: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray


@dataclasses.dataclass(frozen=True, eq=False)
class Evidence:
    """What a set of measurements says about one hypothesis.

    Attributes:
      log_evidence: log p(r), sizes integrated by Laplace's method in their logarithms.
      tau: (fields,) most probable sizes of the discrepancies; tau_log_std: standard deviation of their logarithms.
      noise: (groups,) most probable factors on the stated noise.
      mean, covariance: (k,), (k, k) posterior of the amplitudes at these sizes.
      settled: of the sizes: gain of log density that a further Newton step promises.
      levels: (groups,) most probable level of slow errors, where their size is unknown.
    """

    log_evidence: float
    tau: np.ndarray
    tau_log_std: np.ndarray
    noise: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray
    settled: float
    gram: Gram
    amplitudes: Amplitudes
    levels: np.ndarray | None = None

    def log_score(self, held_out: Gram) -> float:
        """Log predictive density of further measurements of the same columns, at the sizes found.

        The same amplitudes act on both: a discrepancy that the fitted measurements show is predicted as far as its
        columns reach.
        """
        # p(new | old) = p(new, old) / p(old): the amplitudes are integrated over what the old ones say of them
        joint = _condition(self.gram + held_out, self.amplitudes, self.tau, self.noise)[0]
        return joint - _condition(self.gram, self.amplitudes, self.tau, self.noise)[0]

    def left(self, columns: np.ndarray, residual: np.ndarray) -> np.ndarray:
        """(n, 1 + draws) what the mean leaves of a residual (n,), and what draws of the amplitudes about it change.

        Their covariance would take as many columns (n, k) as there are amplitudes. The draws are the same each time,
        and at right angles as far as there are so many, which tells a trace better than independent ones.
        """
        k = len(self.mean)
        draws = np.linalg.qr(np.random.default_rng(0).standard_normal((k, min(_DRAWS, k))))[0]
        size, turn = np.linalg.eigh(self.covariance)
        drawn = (turn * np.sqrt(np.maximum(size, 0.0))) @ draws * math.sqrt(k)
        return np.column_stack([residual - columns @ self.mean, columns @ drawn])

    def within(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """(k,) probable amplitudes within (k,) bounds, relative to the refit, at the sizes found.

        The others follow those that a bound holds: cut off alone, these would leave them at a place that fits nothing.
        No bound lets go again: where one binds they are the most probable amplitudes, where several do there may be
        better ones.
        """
        place, edge, held = self.mean.copy(), np.zeros(len(self.mean)), np.zeros(len(self.mean), bool)
        while (outside := ~held & ((place < low) | (place > high))).any():
            edge[outside] = np.clip(place, low, high)[outside]
            held |= outside
            pulled = np.linalg.solve(self.covariance[np.ix_(held, held)], edge[held] - self.mean[held])
            place = self.mean + self.covariance[:, held] @ pulled
            place[held] = edge[held]
        return place

    def log_inside(self, low: np.ndarray, high: np.ndarray) -> float:
        """Log of the posterior over the prior probability that amplitudes lie in (k,) bounds, relative to the refit.

        Added to `log_evidence` it is the evidence under the prior truncated to the bounds.
        """
        bounded = np.flatnonzero(np.isfinite(low) | np.isfinite(high))
        prior, centre = self.amplitudes.std, self.amplitudes.mean
        before = sum(_log_between((low[i] - centre[i]) / prior[i], (high[i] - centre[i]) / prior[i]) for i in bounded)
        # Coordinates without bounds integrate to one: the marginal of the others is all that is needed.
        covariance = self.covariance[np.ix_(bounded, bounded)]
        return log_box(self.mean[bounded], covariance, low[bounded], high[bounded]) - before


def log_box(mean: np.ndarray, covariance: np.ndarray, low: np.ndarray, high: np.ndarray) -> float:
    """Log probability of a box under a normal distribution, by expectation propagation (Cunningham et al. 2011).

    Bounds that bind together have to be taken together. A fit that is held at several edges at once would else pay for
    each by its marginal distribution alone, and an optimum far outside the box would count as if it lay at the corner.

    Args:
      mean: (k,). covariance: (k, k), positive definite.
      low, high: (k,) bounds, low < high; infinite where there is none.

    Returns:
      The log probability; exact for one coordinate and for independent ones.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    below, above = (low - mean) / std, (high - mean) / std
    alone = np.array([_log_between(a, b) for a, b in zip(below, above, strict=True)])
    binding = np.flatnonzero(alone < -_BINDS)
    # A single bound that binds has none to be taken together with: its marginal probability will do.
    if len(binding) < 2:
        return float(alone.sum())
    below, above = below[binding], above[binding]
    whole = covariance[np.ix_(binding, binding)] / np.outer(std[binding], std[binding])
    # each bound's factor is exp(pull x - stiff x^2 / 2), in standardised coordinates about the mean
    stiff, pull = np.zeros(len(binding)), np.zeros(len(binding))
    spread, centre = whole.copy(), np.zeros(len(binding))
    total = before = -np.inf
    for _ in range(_MOST_SWEEPS):
        total = 0.0
        for i in range(len(binding)):
            # The marginal distribution without this bound's own factor, or the bound would be counted twice.
            rest = max(1.0 / spread[i, i] - stiff[i], 1e-12)
            place, width = (centre[i] / spread[i, i] - pull[i]) / rest, 1.0 / math.sqrt(rest)
            log_inside, inner, narrow = _truncated((below[i] - place) / width, (above[i] - place) / width)
            # A truncated normal is never wider than the normal itself, so that a negative stiffness is rounding.
            new = max(1.0 / (narrow * width**2) - rest, 0.0)
            added = new - stiff[i]
            stiff[i], pull[i] = new, (place + width * inner) * (new + rest) - rest * place
            column = spread[:, i]
            # Sherman and Morrison: one stiffness has changed, so no new inverse is needed.
            spread = spread - np.outer(column, column) * (added / (1.0 + added * column[i]))
            centre = spread @ pull
            joint = (rest * place + pull[i]) ** 2 / (rest + stiff[i]) - rest * place**2
            total += log_inside + 0.5 * math.log1p(stiff[i] / rest) - 0.5 * joint
        # Roots of the stiffnesses on both sides, after Rasmussen & Williams 2006: their reciprocals have no end where a
        # bound hardly binds.
        root = np.sqrt(stiff)
        inner_matrix = np.eye(len(binding)) + root[:, None] * whole * root
        total += 0.5 * float(pull @ centre) - 0.5 * float(np.linalg.slogdet(inner_matrix)[1])
        if abs(total - before) < _BINDS:
            break
        before = total
    return total + float(np.delete(alone, binding).sum())


_BINDS, _MOST_SWEEPS = 1e-4, 100
"""nat; a bound that costs less than this by itself binds nothing, and a sweep that changes less is the last one."""


def _truncated(low: float, high: float) -> tuple[float, float, float]:
    """Log probability, mean and variance of a standard normal between two bounds."""
    if low + high > 0.0 and low > 0.0:
        log_inside, mean, variance = _truncated(-high, -low)
        return log_inside, -mean, variance
    log_inside = _log_between(low, high)
    left, right = (
        0.0 if not math.isfinite(x) else math.exp(-0.5 * x * x - 0.5 * _LOG_2PI - log_inside) for x in (low, high)
    )
    mean = left - right
    slope = (low * left if math.isfinite(low) else 0.0) - (high * right if math.isfinite(high) else 0.0)
    # the difference loses its digits where the bound lies far out; there the variance is that of an exponential
    near = min(abs(low), abs(high))
    return log_inside, mean, max(1.0 + slope - mean**2, 0.5 / (1.0 + near**2))


def _log_between(low: float, high: float) -> float:
    """Log of the standard normal probability of an interval."""
    if low > 0.0:
        # the difference of two numbers near 1 has no digits left; in the other tail it has all of them
        low, high = -high, -low
    # An interval that rounding closes keeps a tiny probability: a logarithm of zero would spoil every sum it enters.
    upper, lower = special.log_ndtr(high), special.log_ndtr(low)
    return float(upper + math.log(-math.expm1(min(lower - upper, -1e-300)))) if high > low else -math.inf


def infer(
    gram: Gram,
    amplitudes: Amplitudes,
    fields: Sequence[Field] = (),
    noises: Sequence[NoiseSize] = (),
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> Evidence:
    """Evidence and posterior of one hypothesis.

    Args:
      gram: of its columns. amplitudes: their prior.
      fields: the discrepancies that `amplitudes.field` counts. noises: one per noise group of the Gram matrices.
      start: (tau, noise) to begin from, such as those of a similar hypothesis; the usual sizes if None.

    Raises:
      EvidenceError: sizes have not settled after 60 Newton steps, or derivatives are too steep to compute with.
    """
    usual = np.array([f.usual for f in fields])
    # sizes are positive, and their posterior is nearer to a normal one in the logarithm: Laplace's method is used there
    x = np.log(np.concatenate([usual, np.ones(len(noises))] if start is None else [*start]))
    # from far behind a wall Newton's method would come back by a thirtieth a step
    bounded = np.flatnonzero([f.bounded for f in fields])
    x[bounded] = np.minimum(x[bounded], np.log(usual[bounded]))
    here, exact = _density(x, gram, amplitudes, fields, noises, exact=False), False
    promised = np.inf
    for _ in range(SIZE_DESCENT.most_steps):
        step = _newton_step(here)
        # What the quadratic model gains: gradient times step, less the half of it that the curvature takes back.
        promised = 0.5 * float(here.gradient @ step)
        ends = promised < SIZE_DESCENT.settled
        if not ends:
            # in the logarithms a long step leaves the region in which the density is near its quadratic
            step *= min(1.0, SIZE_DESCENT.longest / max(float(np.abs(step).max()), 1e-300))
            for _ in range(30):
                try:
                    there = _density(x + step, gram, amplitudes, fields, noises, exact)
                except EvidenceError:
                    there = None  # sizes at which rounding spoils the density are no place to go to
                if there is not None and there.value >= here.value:
                    break
                step *= 0.5
            else:
                there = None  # no step gains: rounding is reached
            ends = there is None or there.value - here.value < SIZE_DESCENT.settled
            if there is not None:
                x, here = x + step, there
        if ends and exact:
            break
        if ends:
            # A tenth of the time of exact second derivatives leads to where they are needed.
            here, exact = _density(x, gram, amplitudes, fields, noises), True
    else:
        if promised > SIZE_DESCENT.bearable:
            raise EvidenceError(f"sizes of discrepancy and noise did not settle: a step still promises {promised:.2g}")
        here = _density(x, gram, amplitudes, fields, noises)
    # a size is never taken to be known worse than to a factor of 20: Laplace's volume would have no end there
    hessian = _positive(here.hessian)
    log_evidence = here.value + 0.5 * len(x) * _LOG_2PI - 0.5 * float(np.linalg.slogdet(hessian)[1])
    spread = np.sqrt(np.diag(np.linalg.inv(hessian)))
    many = len(fields)
    return Evidence(
        log_evidence,
        np.exp(x[:many]),
        spread[:many],
        np.exp(x[many:]),
        here.mean,
        here.covariance,
        promised,
        gram,
        amplitudes,
    )


def log_density(gram: Gram, amplitudes: Amplitudes, tau: np.ndarray, noise: np.ndarray) -> float:
    """Log density of measurements at given sizes (fields,) of discrepancy and (groups,) of noise.

    Args:
      gram, amplitudes: as for `infer`. tau, noise: the sizes.

    Raises:
      EvidenceError: rounding spoils it.
    """
    return _condition(gram, amplitudes, tau, noise)[0]


def infer_levels(
    levels: Levels,
    amplitudes: Amplitudes,
    fields: Sequence[Field] = (),
    noises: Sequence[NoiseSize] = (),
    start: tuple[np.ndarray, np.ndarray] | None = None,
) -> Evidence:
    """Evidence and posterior of one hypothesis where slow errors have an unknown size: at the most probable one.

    Args:
      levels: statistics of its columns by size. amplitudes, fields, noises, start: as for `infer`.

    Returns:
      What was found, with the level of each group; the log evidence is that of measurements in their units.

    Raises:
      EvidenceError: see `infer`.
    """
    # Large errors leave amplitudes wide, which speaks for large errors: from there EM need not come down to none.
    ends = [_climb(levels, at, amplitudes, fields, noises, start) for at in levels.starts]
    return max(ends, key=lambda end: end.log_evidence)


def _climb(
    levels: Levels,
    at: np.ndarray,
    amplitudes: Amplitudes,
    fields: Sequence[Field],
    noises: Sequence[NoiseSize],
    start: tuple[np.ndarray, np.ndarray] | None,
) -> Evidence:
    """What is found where EM from some levels (groups,) ends; the rest as for `infer_levels`."""
    best = None
    for _ in range(SIZE_DESCENT.most_levels):
        found = infer(levels.gram(at), amplitudes, fields, noises, start)
        found = dataclasses.replace(found, log_evidence=found.log_evidence + levels.log_weight(at), levels=at)
        # sizes of discrepancy settle anew at each level, which EM knows nothing of: a step may lose a little
        if best is not None and found.log_evidence <= best.log_evidence:
            break
        best = found
        new, noise = levels.improved(found, noises)
        if np.array_equal(new, at):
            break
        at, start = new, (found.tau, noise)
    assert best is not None
    return best


def _newton_step(here: _At) -> np.ndarray:
    return np.linalg.solve(_positive(here.hessian), here.gradient)


def _positive(hessian: np.ndarray) -> np.ndarray:
    """The matrix with eigenvalues of at least 0.1, that of a size known to a factor of 20."""
    values, vectors = np.linalg.eigh(hessian)
    # away from the maximum the density may curve upward; a step along such a direction must still go uphill
    if len(values) == 0 or values[0] >= 0.1:
        return hessian
    return (vectors * np.maximum(np.abs(values), 0.1)) @ vectors.T


def _condition(
    gram: Gram, amplitudes: Amplitudes, tau: np.ndarray, noise: np.ndarray
) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Log density of the measurements at given sizes.

    Returns:
      The log density; (k,) posterior mean relative to the refit, in prior standard deviations; (k, k) standardised
      posterior covariance; (k,) prior standard deviations that standardise.

    Raises:
      EvidenceError: rounding spoils it.
    """
    k = gram.width
    scale = amplitudes.std * np.append(tau, 1.0)[amplitudes.field]  # field -1 picks the 1 at the end
    # Noise factors enter here, after the measurements have been summed: trying other sizes costs nothing in their
    # number.
    whole = (noise**-2.0 @ gram.matrix.reshape(len(noise), -1)).reshape(k + 1, k + 1)
    inner, across = whole[:k, :k], whole[:k, k]
    # Counted from the refit, where residuals are small. From the prior's mean, steep slopes would make the residual a
    # million sigma long, and rounding would leave its chi-square uncertain by hundreds.
    centre = amplitudes.mean / scale
    square, downhill = float(whole[k, k] + centre @ centre), scale * across + centre
    # standardised by the prior, the matrix is 1 or more in every direction: an amplitude that the data do not see, or a
    # discrepancy of size zero, cannot make it singular
    try:
        factor = linalg.cholesky(np.eye(k) + scale[:, None] * inner * scale, lower=True, check_finite=False)
    except linalg.LinAlgError:
        raise EvidenceError("derivatives are too steep to compute with") from None
    covariance = linalg.cho_solve((factor, True), np.eye(k), check_finite=False)
    half = linalg.solve_triangular(factor, downhill, lower=True, check_finite=False)
    mean = linalg.solve_triangular(factor, half, lower=True, trans=1, check_finite=False)
    # log |V| by Sylvester's identity: the determinant of the small matrix in place of one as large as the data.
    log_det = 2.0 * float(np.sum(np.log(np.diag(factor))))
    size = float(np.sum(gram.count * (_LOG_2PI + 2.0 * np.log(noise))))
    chi_square = square - float(half @ half)
    # No chi-square is negative. Slopes taken across a jump can be so steep that rounding makes it so, and the
    # hypothesis would win by any number.
    if chi_square < -SIZE_DESCENT.rounding * (1.0 + abs(square)):
        raise EvidenceError(f"derivatives are too steep to compute with: chi-square comes out as {chi_square:.2g}")
    return -0.5 * (size + chi_square + log_det), mean, covariance, scale


def _density(
    x: np.ndarray,
    gram: Gram,
    amplitudes: Amplitudes,
    fields: Sequence[Field],
    noises: Sequence[NoiseSize],
    exact: bool = True,
) -> _At:
    """Log density of measurements and log sizes together, with exact first derivatives.

    Second derivatives are exact, or nearly so where they need not be: traces of products of two filters, which take
    most of the time, are then those of filters that let through or hold back and have nothing in common.

    With V the covariance of the measurements, V_i its derivative by a log size (V_ii = 2 V_i) and q = V^-1 r:
    gradient_i = (q V_i q - tr V^-1 V_i)/2; -Hessian_ij = q V_i V^-1 V_j q - tr(V^-1 V_i V^-1 V_j)/2, and on the
    diagonal tr V^-1 V_i - q V_i q beside it. Woodbury's identity brings all of them into the space of the amplitudes.
    """
    many, groups, k = len(fields), len(noises), gram.width
    tau, noise = np.exp(x[:many]), np.exp(x[many:])
    value, found, inverse, scale = _condition(gram, amplitudes, tau, noise)
    mean, place = found - amplitudes.mean / scale, scale * found
    member = np.array([amplitudes.field == f for f in range(many)], float).reshape(many, k)
    # share of each amplitude's prior that the measurements have taken away
    # Identity less posterior covariance in prior units: 0 where the data are silent, 1 where they know all.
    absorbed = np.eye(k) - inverse
    # traces and quadratic forms, each over two: fields first, then noise groups
    trace = np.empty(many + groups)
    power = np.empty(many + groups)
    trace[:many], power[:many] = member @ np.diag(absorbed), member @ mean**2
    weight = mean[:, None] * member.T  # (k, fields): V^-1/2 of each field's share, in standardised amplitudes
    # (groups, k + 1): of each group what the amplitudes leave, seen along its columns; its own square comes last
    left = gram.matrix @ np.append(-place, 1.0)
    own = scale[:, None] * left[:, :k].T / noise**2
    power[many:] = (left[:, k] - left[:, :k] @ place) / noise**2
    # Traces of the filters: sums of products with the posterior covariance.
    covariance = np.zeros((k + 1, k + 1))
    covariance[:k, :k] = scale[:, None] * inverse * scale
    passed = gram.matrix.reshape(groups, -1) @ covariance.ravel() / noise**2
    trace[many:] = gram.count - passed
    quadratic = np.empty((many + groups, many + groups))
    traces = np.empty_like(quadratic)
    back = inverse @ own
    quadratic[:many, :many] = weight.T @ absorbed @ weight
    quadratic[:many, many:] = weight.T @ back
    quadratic[many:, many:] = np.diag(power[many:]) - own.T @ back
    # The trace of a product of two blocks of a symmetric matrix is the sum of its squared entries between them.
    traces[:many, :many] = member @ absorbed**2 @ member.T
    if exact:
        # Traces of products of two filters: one product of matrices whose rows are the filters' entries.
        seen = scale[:, None] * gram.matrix[:, :k, :k] * scale / noise[:, None, None] ** 2
        filtered = inverse @ seen
        traces[many:, many:] = filtered.reshape(groups, k * k) @ filtered.transpose(0, 2, 1).reshape(groups, k * k).T
        traces[:many, many:] = member @ np.einsum("gij,ij->gi", filtered, inverse).T
    else:
        traces[many:, many:], traces[:many, many:] = np.diag(passed), 0.0
    for c in range(groups):
        # V^-1 V_c is the identity less the filter; squared, it leaves the count less twice the filter's trace, beside
        # the above.
        traces[many + c, many + c] += gram.count[c] - 2.0 * passed[c]
    quadratic[many:, :many], traces[many:, :many] = quadratic[:many, many:].T, traces[:many, many:].T
    gradient = power - trace
    hessian = 4.0 * quadratic - 2.0 * traces + np.diag(2.0 * (trace - power))
    for i, field in enumerate(fields):
        if field.log_std > 0.0:
            off = (x[i] - math.log(field.usual)) / field.log_std
            value -= 0.5 * off**2 + math.log(field.log_std) + 0.5 * _LOG_2PI
            gradient[i] -= off / field.log_std
            hessian[i, i] += 1.0 / field.log_std**2
            continue
        if field.freedom > 0.0:
            added = _log_inverse_chi(x[i] - math.log(field.usual), field.freedom)
            value, gradient[i], hessian[i, i] = value + added[0], gradient[i] + added[1], hessian[i, i] + added[2]
            continue
        # Half-normal prior of tau, or a wall at its scale, with the Jacobian of its logarithm.
        power = WALL if field.bounded else 1
        share = (tau[i] / field.usual) ** (2 * power)
        value += 0.5 * math.log(2.0 / math.pi) + x[i] - math.log(field.usual) - 0.5 * share
        gradient[i] += 1.0 - power * share
        hessian[i, i] += 2.0 * power**2 * share
    for c, prior in enumerate(noises):
        i = many + c
        if prior.freedom > 0.0:
            added = _log_inverse_chi(x[i], prior.freedom)
            value, gradient[i], hessian[i, i] = value + added[0], gradient[i] + added[1], hessian[i, i] + added[2]
        else:
            value -= 0.5 * (x[i] / prior.log_std) ** 2 + math.log(prior.log_std) + 0.5 * _LOG_2PI
            gradient[i] -= x[i] / prior.log_std**2
            hessian[i, i] += 1.0 / prior.log_std**2
    return _At(value, gradient, hessian, place, covariance[:k, :k])


def _log_inverse_chi(x: float, freedom: float) -> tuple[float, float, float]:
    """Log density of the logarithm x of a size s, gradient and negative Hessian: freedom / s^2 is chi-square."""
    half, square = 0.5 * freedom, math.exp(-2.0 * x)
    value = math.log(2.0) + half * math.log(half) - math.lgamma(half) - 2.0 * half * x - half * square
    return value, 2.0 * half * (square - 1.0), 4.0 * half * square
