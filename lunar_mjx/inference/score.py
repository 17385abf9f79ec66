"""Which missing effect a refit could not fake: score tests on signatures with the baseline projected out.

Sources: Rao's score test; orthogonal discrepancy (Plumlee 2017); multiplier bootstrap for the maximum over effects
(Chernozhukov, Chetverikov & Kato 2013) with Rademacher weights over blocks.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy import stats
from scipy.special import gammaln

from lunar_mjx.inference.fitting import Fit
from lunar_mjx.inference.observations import Observations
from lunar_mjx.inference.problem import Problem

SEPARABLE = 5.0
"""Smallest length in sigma of an effect's projected signature at nominal size for the effect to be tested."""
_TINY = 1e-9


@dataclasses.dataclass(frozen=True, eq=False)
class Score:
    """What the residual says about one candidate, in linear approximation at the fit.

    Attributes:
      effect: its name.
      signature: (n, m) projected whitened signature of its amplitudes over the fitted observations.
      columns: (n, m) whitened sensitivities of all observations to its amplitudes.
      length: of the projected signature at nominal size, in sigma. share: of the unprojected length.
      amount: (m,) best amount in units of the coordinates. chi2: reduction of chi-square by it.
      z: robust significance in sigma, p: family-wise p value.
    """

    effect: str
    signature: np.ndarray
    length: float
    share: float
    amount: np.ndarray
    chi2: float
    z: float
    p: float = 1.0
    columns: np.ndarray | None = None


def blocks(observations: Observations, residual: np.ndarray, keep: np.ndarray, most: int = 400) -> np.ndarray:
    """Numbers the blocks over which scores are summed: stretches of at least five correlation times of one log.

    Points of a table form blocks of neighbours of all quantities in one group. Channels of a log share their blocks, so
    that dependence between channels stays inside.

    Returns:
      (n,) block of each observation, counted from 0 among those kept; -1 elsewhere.
    """
    number = np.full(len(observations), -1)
    count = 0
    for log in range(len(observations.logs)):
        mine = [s for s in observations.series if s.log == log]
        if all(s.time is None for s in mine):
            count = _table_blocks(observations, mine, keep, number, count)
            continue
        timed = [s for s in mine if s.time is not None and len(s.time)]
        first = min(float(np.asarray(s.time)[0]) for s in timed)
        last = max(float(np.asarray(s.time)[-1]) for s in timed)
        tau = max([_correlation_time(residual[s.start : s.stop], np.asarray(s.time)) for s in timed], default=0.0)
        length = max(5.0 * tau, (last - first) / max(4, most // max(1, len(observations.logs))), 1e-9)
        pieces = max(1, int((last - first) / length))
        edges = np.linspace(first, last, pieces + 1)[1:-1]
        for s in timed:
            part = np.arange(s.start, s.stop)
            number[part] = count + np.searchsorted(edges, np.asarray(s.time), side="right")
        count += pieces
    number[~keep] = -1
    used = np.unique(number[number >= 0])
    relabel = np.full(count + 1, -1)
    relabel[used] = np.arange(len(used))
    return np.where(number >= 0, relabel[number], -1)


def _table_blocks(observations: Observations, mine: list, keep: np.ndarray, number: np.ndarray, count: int) -> int:
    """Blocks of three neighbouring points along the first covariate, within one group."""
    most = count
    for s in mine:
        part = np.arange(s.start, s.stop)
        if not keep[part].any():
            continue
        first = observations.place[part, 0] if observations.place is not None else np.arange(len(part))
        at = count
        for unit in np.unique(observations.unit[part]):
            here = part[observations.unit[part] == unit]
            order = here[np.argsort(first[observations.unit[part] == unit], kind="stable")]
            number[order] = at + np.arange(len(order)) // 3
            at += (len(order) + 2) // 3
        most = max(most, at)
    return most


def _correlation_time(residual: np.ndarray, time: np.ndarray) -> float:
    """Time over which the residual's autocorrelation falls to 1/e; 0 for white noise, at most an eighth of the log."""
    if len(residual) < 16:
        return 0.0
    r = residual - residual.mean()
    power = float(r @ r)
    if power <= 0.0:
        return 0.0
    step = float(np.median(np.diff(time)))
    size = 1 << (2 * len(r) - 1).bit_length()
    spectrum = np.abs(np.fft.rfft(r, size)) ** 2
    auto = np.fft.irfft(spectrum, size)[: len(r) // 8] / power
    below = np.flatnonzero(auto < np.exp(-1.0))
    lag = int(below[0]) if len(below) else len(auto)
    return 0.0 if lag <= 1 else lag * step


def span(jacobian: np.ndarray, prior_scale: np.ndarray) -> np.ndarray:
    """(n + p, rank) orthonormal basis of what a refit of the baseline moves, the priors counted as observations.

    Args:
      jacobian: (n, p) whitened. prior_scale: (p,) reciprocal prior standard deviations.
    """
    stacked = np.vstack([jacobian, np.diag(prior_scale)])
    size = np.linalg.norm(stacked, axis=0)
    stacked = stacked / np.where(size > 0.0, size, 1.0)
    q, s, _ = np.linalg.svd(stacked, full_matrices=False)
    return q[:, s > 1e-10 * s.max()] if len(s) else q


def outside(columns: np.ndarray, basis: np.ndarray) -> np.ndarray:
    """(n + p, m): what a refit leaves of columns (n, m), given its basis (`span`), the rows of the priors below."""
    extended = np.vstack([columns, np.zeros((len(basis) - len(columns), columns.shape[1]))])
    for _ in range(2):  # once more, against cancellation
        extended = extended - basis @ (basis.T @ extended)
    return extended


def project(columns: np.ndarray, jacobian: np.ndarray, prior_scale: np.ndarray) -> np.ndarray:
    """Columns less what a refit of the baseline takes of them, the priors counted as observations.

    Args:
      columns: (n, m) whitened. jacobian: (n, p) whitened. prior_scale: (p,) reciprocal prior standard deviations.

    Returns:
      (n + p, m): what is left, with the rows of the priors below.
    """
    return outside(columns, span(jacobian, prior_scale))


def leash(problem: Problem, fit: Fit) -> np.ndarray:
    """(free,) reciprocal standard deviations within which a refit may move the coordinates of a fit, by a linear guess.

    Beside the priors, a move over all of a coordinate's range counts as much as all of the misfit: in a model far from
    its data, a prior alone would let a nuisance take in any effect by moving far past its bounds.
    """
    _, prior = problem.prior_rows(fit.u, fit.free)
    low, high = problem.bounds(fit.free)
    residual = fit.residual[fit.fitted]
    excess = max(float(residual @ residual) - len(residual), 0.0)
    return np.sqrt(prior**2 + excess / (high - low) ** 2)


def signatures(problem: Problem, fit: Fit, names: Sequence[str], inputs: Sequence[str] = ()) -> dict[str, np.ndarray]:
    """(n, m) whitened derivative with respect to the amplitudes of every candidate, at the fit; secants where zero.

    Args:
      problem: model and measurements. fit: where derivatives are taken. names: of the candidates.
      inputs: labels of unknown inputs, whose derivatives are taken in the same batch.
    """
    amplitudes = {e: [i for i in problem.candidates[e] if problem.coordinates[i].amplitude] for e in names}
    amplitudes |= {label: list(problem.inputs[label]) for label in inputs}
    which = np.array([i for places in amplitudes.values() for i in places], int)
    if not len(which):
        return {}
    tested = which[: sum(len(amplitudes[e]) for e in names)]
    if problem.eager:
        columns, values = problem.jacobian_and(fit.u, which, _secant_rows(problem, fit, tested))
    else:
        columns, values = problem.jacobian(fit.u, which), None
    columns = np.where(np.isfinite(columns), columns, 0.0)
    dead = [k for k in range(len(tested)) if np.linalg.norm(columns[:, k]) < _TINY]
    if dead:
        rows = _secant_rows(problem, fit, tested[dead])
        values = problem.predict(rows) if values is None else values[[0, *(k + 1 for k in dead)]]
        for n, k in enumerate(dead):
            difference = (values[n + 1] - values[0]) / rows[n + 1, which[k]]
            columns[:, k] = np.where(np.isfinite(difference), difference, 0.0)
    white = problem.observations.whiten(columns)
    out, at = {}, 0
    for e, places in amplitudes.items():
        out[e] = white[:, at : at + len(places)]
        at += len(places)
    return out


def _secant_rows(problem: Problem, fit: Fit, which: np.ndarray) -> np.ndarray:
    """(1 + m, coordinates) the fit, and each of some amplitudes there at its nominal size."""
    rows = np.repeat(fit.u[None], len(which) + 1, axis=0)
    for n, i in enumerate(which):
        low, high = problem.coordinates[i].bounds()
        rows[n + 1, i] = 1.0 if high >= 1.0 else max(-1.0, low)
    return rows


def score(problem: Problem, fit: Fit, found: Mapping[str, np.ndarray], draws: int = 2000, seed: int = 0) -> list[Score]:
    """Scores every candidate on the fitted observations.

    Args:
      problem: model and measurements. fit: the baseline fit. found: whitened signatures by effect (`signatures`).
      draws: of the multiplier bootstrap. seed: of its weights.

    Returns:
      The scores, largest reduction of chi-square first.
    """
    keep = fit.fitted
    block = blocks(problem.observations, fit.residual, keep)[keep]
    basis = span(fit.jacobian[keep], leash(problem, fit))
    residual = fit.residual[keep]
    rows = []
    for name, columns in found.items():
        signature = outside(columns[keep], basis)[: len(residual)]
        raw, left = np.linalg.norm(columns[keep]), np.linalg.norm(signature)
        rows.append((name, signature, float(left), float(left / raw) if raw > 0.0 else 0.0))
    results, boots = [], []
    rng = np.random.default_rng(seed)
    weights = rng.choice([-1.0, 1.0], size=(draws, int(block.max(initial=0)) + 1))
    for name, signature, length, share in rows:
        amount, chi2, z, boot = evidence_of(signature, residual, block, weights)
        if length < SEPARABLE:
            z, boot = 0.0, None
        results.append(Score(name, signature, length, share, amount, chi2, z, columns=found[name]))
        if boot is not None:
            boots.append(boot)
    highest = np.max(boots, axis=0) if boots else np.zeros(draws)
    out = []
    for s in results:
        p = (1.0 + float(np.sum(highest >= s.z))) / (draws + 1.0) if s.length >= SEPARABLE else 1.0
        out.append(dataclasses.replace(s, p=p))
    return sorted(out, key=lambda s: -s.chi2)


def evidence_of(
    signature: np.ndarray, residual: np.ndarray, block: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, float, float, np.ndarray]:
    """Best amount, its chi-square, its robust z, and z of every bootstrap draw."""
    m = signature.shape[1]
    size = np.linalg.norm(signature, axis=0)
    scaled = signature / np.where(size > _TINY, size, 1.0)
    u, s, vt = np.linalg.svd(scaled, full_matrices=False)
    rank = s > 1e-6 * max(float(s.max(initial=0.0)), _TINY)
    u = u[:, rank]
    if not u.shape[1] or size.max(initial=0.0) < _TINY:
        return np.zeros(m), 0.0, 0.0, np.zeros(len(weights))
    along = u.T @ residual
    amount = (vt[rank].T @ (along / s[rank])) / np.where(size > _TINY, size, np.inf)
    chi2 = float(along @ along)
    contributions = np.zeros((weights.shape[1], u.shape[1]))
    # Residuals that are larger than their noise (misfit, understated noise) must not count as evidence: the variance is
    # the larger of the model's and of the blocks' own scatter. The effect itself is taken out before: that it shows in
    # some manoeuvres more than in others is no noise.
    np.add.at(contributions, block, u * (residual - u @ along)[:, None])
    robust = contributions.T @ contributions * len(contributions) / max(len(contributions) - u.shape[1], 1)
    variance = _larger(robust, np.eye(u.shape[1]))
    inverse = np.linalg.inv(variance)
    statistic = float(along @ inverse @ along)
    draws = weights @ contributions
    boot = np.einsum("di,ij,dj->d", draws, inverse, draws)
    z = _to_z(np.append(boot, statistic), u.shape[1])
    return amount, chi2, float(z[-1]), z[:-1]


def _larger(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """A covariance not smaller than either in any direction."""
    values, vectors = np.linalg.eigh(a - b)
    return b + (vectors * np.maximum(values, 0.0)) @ vectors.T


def _to_z(statistic: np.ndarray, degrees: int) -> np.ndarray:
    """One-sided normal quantile of a chi-square, so that candidates of several parameters compare."""
    half = 0.5 * np.maximum(statistic, 1e-30)
    # logsf underflows; the leading term of the incomplete gamma function's expansion does not.
    far = (0.5 * degrees - 1.0) * np.log(half) - half - gammaln(0.5 * degrees)
    tail = np.where(half > 350.0 + degrees, far, stats.chi2.logsf(statistic, degrees))
    # Beyond the reach of isf the asymptote z^2 = -2 log p is close enough to rank by.
    near = stats.norm.isf(np.exp(np.maximum(tail, -700.0)))
    return np.where(tail > -700.0, near, np.sqrt(-2.0 * tail))


def cosines(scores: list[Score]) -> dict[str, dict[str, float]]:
    """Isolability: largest |cos| between the projected signatures of every pair (first principal angle)."""
    bases = {}
    for s in scores:
        size = np.linalg.norm(s.signature, axis=0)
        live = size > _TINY
        if live.any():
            u, w, _ = np.linalg.svd(s.signature[:, live] / size[live], full_matrices=False)
            bases[s.effect] = u[:, w > 1e-6 * w.max()]
    return {a: {b: float(np.linalg.norm(bases[a].T @ bases[b], 2)) if a != b else 1.0 for b in bases} for a in bases}
