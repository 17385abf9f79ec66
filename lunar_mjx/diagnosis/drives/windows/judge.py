"""Which of many explanations do windows of drives support: evidence, hypothesis by hypothesis, in one list.

Every hypothesis is fitted by Gauss-Newton steps and judged by the evidence of the linear-Gaussian model there
(Laplace), with an unknown size of the noise and with what usually differs from one log to the next
(`lunar_mjx.inference.evidence`).
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from lunar_mjx.diagnosis.drives.windows.coordinates import CALIBRATION, Suspect, Unknown, with_prior
from lunar_mjx.diagnosis.drives.windows.cut import CHANNELS, CURRENTS
from lunar_mjx.diagnosis.drives.windows.problem import Noise, WindowProblem
from lunar_mjx.inference.evidence import Amplitudes, Evidence, EvidenceError, Gram, NoiseSize, infer

STEPS = 8
"""Gauss-Newton steps of a hypothesis at most."""
DRIFTED = 3.0
"""Standard deviations by which what other logs taught may have drifted: beyond, it is a change, and has to be named as
one. Without this bound the refit of a hard-floor model on ice takes a friction of 0.15 without a word."""
LONGEST_STEP = 3.0
"""Longest step, in standard deviations of a prior."""
SETTLED = 0.1
"""Gain of chi-square by a step after which a fit has settled."""
EARNED = 5.0
"""Gain of log evidence from which the best explanation is given a second one beside it."""
FORM = "soft_ground"
"""The suspect that takes the place of a form of the ground, for which nothing is linear."""
MOST_PAIRS = 4
"""Pairs of explanations that are tried beside the best one."""
NOISE_LOG_STD = 0.3
"""How well the noise's size is known from the residuals that it was learnt from."""
FIELDS = {
    "resistance of the ground": 0.02,
    "grip of the ground": 0.3,
    "current for a torque": 0.1,
    "left against right current": 0.03,
    "slope by the accelerometer": 1.0,
}
"""Usual differences between drives on one kind of ground with one rover: rolling resistance over load (asphalt 0.01 to
0.02, gravel 0.02, turf to 0.05: Wong 2008, table 1.1); friction (paint, dust and rubber: 30 %); current for the same
torque (oil and magnets by temperature: 10 %); the left side's against the right one's; and the tilt that an
accelerometer shows over a second on rough ground, deg. What an IMU's clock may be off by, the logs say themselves."""
UNKNOWN_SLOPE_DEG = 3.0
"""Slope of ground that a log says nothing of, along the drive: 5 % is the steepest of most paths and yards."""
NAMED = 0.95
"""Probability of a statement."""
MOST_NAMED = 3
"""Explanations that a class names at most."""


@dataclasses.dataclass(frozen=True, eq=False)
class Settled:
    """The most probable unknowns of a hypothesis.

    Attributes:
      suspects, unknowns, u: as in `Fitted`. cost: squares of residuals and priors. calm: whether steps had ended.
    """

    suspects: tuple[Suspect, ...]
    unknowns: tuple[Unknown, ...]
    u: np.ndarray
    cost: float
    calm: bool

    def values(self, problem: WindowProblem) -> dict[str, float]:
        """Values in physical units by key."""
        return {q.key: float(q.value(problem.begin(q), v)) for q, v in zip(self.unknowns, self.u, strict=True)}


@dataclasses.dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis at its best.

    Attributes:
      suspects: what it adds to the model; empty for the model alone.
      unknowns: its coordinates. u: (unknown,) their values. std: (unknown,) posterior standard deviations, both in
        units of the prior's.
      evidence: of the fitted windows. log_evidence: with the bounds of plausibility.
      predicted: (channel, window, sample) by the unknowns alone.
      offsets: (channel, window, sample) what the differences between logs add. differ: root mean square of these over
        the logs, by kind.
      settled: whether the last step was small.
    """

    suspects: tuple[Suspect, ...]
    unknowns: tuple[Unknown, ...]
    u: np.ndarray
    std: np.ndarray
    evidence: Evidence
    log_evidence: float
    predicted: np.ndarray
    offsets: np.ndarray
    differ: dict[str, float]
    settled: bool

    @property
    def name(self) -> str:
        return " + ".join(s.name for s in self.suspects) or "the model"


@dataclasses.dataclass(frozen=True, eq=False)
class Split:
    """Windows that are fitted and windows that are held out, (window,) each."""

    fit: np.ndarray
    held_out: np.ndarray


def unknowns_of(problem: WindowProblem, base: Sequence[Unknown], suspects: Sequence[Suspect]) -> tuple[Unknown, ...]:
    """The baseline's unknowns with those of the suspects, each in the place of its own."""
    out = {u.key: u for u in base}
    for suspect in suspects:
        for u in suspect.unknowns:
            out[u.key] = u if suspect.kind != "effect" else with_prior(u, problem.model.priors)
    return tuple(u for u in out.values() if u.std > 1e-8)


def settle(
    problem: WindowProblem,
    base: Sequence[Unknown],
    suspects: Sequence[Suspect],
    noise: Sequence[Noise],
    split: Split,
    start: Mapping[str, float] | None = None,
) -> Settled:
    """The most probable unknowns of a hypothesis, with nothing that differs from log to log: Gauss-Newton steps.

    Args:
      problem, base, suspects, noise, split: model, its unknowns, what is added to them, and the windows.
      start: values to begin from, in physical units by key; the model's own where there is none.
    """
    unknowns = unknowns_of(problem, base, suspects)
    low, high = _bounds(problem, unknowns)
    mean = np.array([q.mean for q in unknowns])
    own = {q.key for s in suspects for q in s.unknowns}
    kept = np.array([q.key in problem.model.priors and q.key not in own for q in unknowns])
    low, high = (
        np.where(kept, np.maximum(low, mean - DRIFTED), low),
        np.where(kept, np.minimum(high, mean + DRIFTED), high),
    )
    u = np.clip(np.array([_u_of(problem, q, start) for q in unknowns]), low, high)
    used = problem.there & split.fit[:, None]

    def rows(values: np.ndarray) -> np.ndarray:
        return problem.whitened(values, noise)[used]

    def cost(u: np.ndarray, predicted: np.ndarray) -> float:
        return float(np.sum(rows(problem.residual(predicted)[..., None]) ** 2) + np.sum((u - mean) ** 2))

    best = math.inf
    calm = False
    for _ in range(STEPS):
        predicted, slopes = problem.linearise(unknowns, u)
        best = cost(u, predicted)
        j, r = rows(slopes), rows(problem.residual(predicted)[..., None])[:, 0]
        step = np.linalg.solve(j.T @ j + np.eye(len(u)), j.T @ r - (u - mean))
        step *= min(1.0, LONGEST_STEP / max(float(np.abs(step).max()), 1e-12))
        for share in (1.0, 0.4, 0.15):
            there = np.clip(u + share * step, low, high)
            value = cost(there, problem.predict(unknowns, there[None])[0])
            if value < best:
                break
        else:
            calm = True
            break
        gained, u, best = best - value, there, value
        if gained < SETTLED:
            calm = True
            break
    return Settled(tuple(suspects), unknowns, u, best, calm)


def _u_of(problem: WindowProblem, q: Unknown, start: Mapping[str, float] | None) -> float:
    """Where an unknown begins, in units of its prior."""
    if start is None or q.key not in start:
        return q.mean
    own = problem.begin(q)
    return math.log(start[q.key] / own) / q.std if q.factor else (start[q.key] - own) / q.std


def judged(problem: WindowProblem, found: Settled, noise: Sequence[Noise], split: Split) -> Fitted:
    """The evidence of a hypothesis at its most probable unknowns, with all that may differ from log to log.

    Raises:
      EvidenceError: the simulation diverged, or sizes did not settle.
    """
    u = found.u
    predicted, slopes = problem.linearise(found.unknowns, u)
    evidence = _infer(problem, found.unknowns, u, predicted, slopes, noise, split)
    low, high = _bounds(problem, found.unknowns)
    count = len(u)
    std = np.sqrt(np.maximum(np.diag(evidence.covariance)[:count], 0.0))
    wide_low, wide_high = np.full(evidence.gram.width, -np.inf), np.full(evidence.gram.width, np.inf)
    wide_low[:count], wide_high[:count] = low - u, high - u
    bounded = evidence.log_evidence + evidence.log_inside(wide_low, wide_high)
    columns, names, _ = fields(problem, found.unknowns, slopes)
    amounts = evidence.mean[count:]
    differ = {
        k: float(np.sqrt(np.mean([a**2 for a, n in zip(amounts, names, strict=True) if n == k])))
        for k in dict.fromkeys(names)
    }
    offsets = columns @ amounts
    return Fitted(found.suspects, found.unknowns, u, std, evidence, bounded, predicted, offsets, differ, found.calm)


def fit(
    problem: WindowProblem, base: Sequence[Unknown], suspects: Sequence[Suspect], noise: Sequence[Noise], split: Split
) -> Fitted:
    """A hypothesis at its most probable unknowns, with its evidence.

    Raises:
      EvidenceError: the simulation diverged, or sizes did not settle.
    """
    return judged(problem, settle(problem, base, suspects, noise, split), noise, split)


def _bounds(problem: WindowProblem, unknowns: Sequence[Unknown]) -> tuple[np.ndarray, np.ndarray]:
    """Bounds of plausibility in units of the priors."""
    low, high = [], []
    for q in unknowns:
        at = problem.begin(q)
        for bound, into in ((q.low, low), (q.high, high)):
            if not math.isfinite(bound):
                into.append(bound)
            elif q.factor:
                into.append(math.log(max(bound, 1e-300) / at) / q.std)
            else:
                into.append((bound - at) / q.std)
    return np.array(low), np.array(high)


def fields(
    problem: WindowProblem, unknowns: Sequence[Unknown], slopes: np.ndarray
) -> tuple[np.ndarray, tuple[str, ...], np.ndarray]:
    """What differs from recording to recording: columns (channel, window, sample, k), the kind of each, and its size.

    Resistance of the ground acts on both sides with the sense of rolling; grip as friction does; currents by a scale,
    and by one between the sides.
    """
    recordings = problem.cut.recordings
    keys = [q.key for q in unknowns]
    out, names, sizes = [], [], []

    def also(column: np.ndarray, kind: str, size: float | None = None) -> None:
        out.append(column)
        names.append(kind)
        sizes.append(FIELDS[kind] if size is None else size)

    def slope_of(key: str) -> np.ndarray | None:
        at = keys.index(key) if key in keys else None
        return None if at is None else slopes[..., at] / unknowns[at].std

    resistance, size = problem.resistance_slope(), problem.current_size().copy()
    size[len(CURRENTS) :] = 0.0
    apart = size.copy()
    apart[: len(CURRENTS)] *= np.array([0.5, -0.5])[:, None, None]
    grip, pitch = slope_of("hard_ground.mu"), slope_of(f"{CALIBRATION}.pitch")
    for n in np.unique(recordings):
        own = (recordings == n)[None, :, None]
        also(resistance * own, "resistance of the ground")
        if grip is not None:  # per logarithm of the friction
            also(grip * own, "grip of the ground")
        also(size * own, "current for a torque")
        also(apart * own, "left against right current")
        if pitch is not None:
            unknown = problem.cut.unlevelled & set(problem.cut.log[recordings == n].tolist())
            also(pitch * own, "slope by the accelerometer", UNKNOWN_SLOPE_DEG if unknown else None)
    clock = slope_of(f"{CALIBRATION}.imu_clock")
    for n, (_, std) in problem.cut.clocks.items():
        own = (problem.cut.log == n)[None, :, None]
        if clock is not None and own.any():
            also(clock * own, "clock of the IMU", std)
    return np.stack(out, axis=-1), tuple(names), np.array(sizes)


def _infer(
    problem: WindowProblem,
    unknowns: Sequence[Unknown],
    u: np.ndarray,
    predicted: np.ndarray,
    slopes: np.ndarray,
    noise: Sequence[Noise],
    split: Split,
) -> Evidence:
    extra, names, usual = fields(problem, unknowns, slopes)
    columns = np.concatenate([slopes, extra], axis=-1)
    residual = problem.residual(predicted)
    gram = gram_of(problem, columns, residual, noise, split.fit)
    # Of fixed size: a size that could grow would swallow whatever one log lacks for the price of its logarithm.
    mean = np.concatenate([np.array([q.mean for q in unknowns]) - u, np.zeros(len(names))])
    amplitudes = Amplitudes.of(np.concatenate([np.ones(len(u)), usual]), None, mean)
    return infer(gram, amplitudes, (), tuple(NoiseSize(c, NOISE_LOG_STD) for c in CHANNELS))


def gram_of(
    problem: WindowProblem, columns: np.ndarray, residual: np.ndarray, noise: Sequence[Noise], windows: np.ndarray
) -> Gram:
    """Gram matrices of some windows, a noise group for each channel."""
    white = problem.whitened(np.concatenate([columns, residual[..., None]], axis=-1), noise)
    total = None
    for c in range(len(CHANNELS)):
        rows = white[c][problem.there[c] & windows[:, None]]
        part = Gram.of(rows[:, :-1], rows[:, -1], np.full(len(rows), c), len(CHANNELS))
        total = part if total is None else total + part
    assert total is not None
    return total


def probabilities(found: Sequence[Fitted]) -> dict[str, float]:
    """Posterior probability of every hypothesis; nothing missing is as probable beforehand as anything missing.

    Explanations with k suspects share a half of 2^-k, each alike. All sets of k count, tried or not: those that were
    not tried beside the best are taken to explain nothing.
    """
    many = sum(len(f.suspects) == 1 for f in found)
    scores = {}
    for f in found:
        order = len(f.suspects)
        scores[f.name] = f.log_evidence - math.log(2.0 ** (order + 1) * max(math.comb(many, order), 1))
    top = max(scores.values())
    weight = {k: math.exp(v - top) for k, v in scores.items()}
    return {k: w / sum(weight.values()) for k, w in weight.items()}


def search(
    problems: Callable[[str | None], WindowProblem],
    base: Sequence[Unknown],
    suspects: Sequence[Suspect],
    noise: Callable[[Sequence[Settled]], Sequence[Noise]],
    first_noise: Sequence[Noise],
    split: Split,
    seconds: float,
    progress: Callable[[str, float], None],
    provisional: Callable[[Sequence[Fitted], Sequence[Noise]], None] = lambda *_: None,
) -> tuple[list[Fitted], list[str], Sequence[Noise]]:
    """Weighs every hypothesis of one suspect, then of two beside the best; stops when time is up.

    Args:
      problems: the problem of a form of the ground (None: as the model has it).
      base, suspects, split: as for `fit`.
      noise: learns the noise from the best of the hypotheses that are given; all are judged by it.
      first_noise: to fit with before that.
      seconds: time at most. progress: told of the whole search. provisional: given what is known as it becomes known.

    Returns:
      The hypotheses, what was not tried for want of time or because it failed, and the noise.
    """
    begin = time.monotonic()
    left: list[str] = []
    settled = [settle(problems(None), base, (), first_noise, split)]
    jobs: list[tuple[Suspect, ...]] = [(s,) for s in sorted(suspects, key=lambda s: s.name == FORM)]
    paired = False
    found: list[Fitted] = []
    used: Sequence[Noise] = first_noise
    while True:
        total = len(settled) + len(jobs) + (0 if paired else MOST_PAIRS)
        while jobs:
            job = jobs.pop(0)
            if time.monotonic() - begin > seconds:
                left += [_names(j) + ": no time left" for j in [job, *jobs]]
                jobs = []
                break
            start = None
            if len(job) > 1:
                before = next(s for s in settled if s.suspects == job[:1])
                start = before.values(problems(_form(job)))
            try:
                settled.append(settle(problems(_form(job)), base, job, used, split, start))
            except np.linalg.LinAlgError as error:
                left.append(f"{_names(job)}: {error}")
            progress("weighing explanations", len(settled) / total)
        if not paired:
            used = noise(settled)
            # the same explanations once more where the noise as it is moves them
            settled = [
                settle(
                    problems(_form(s.suspects)), base, s.suspects, used, split, s.values(problems(_form(s.suspects)))
                )
                for s in settled
            ]
        known = {f.suspects for f in found}
        for s in settled:
            if s.suspects in known:
                continue
            try:
                found.append(judged(problems(_form(s.suspects)), s, used, split))
            except (EvidenceError, np.linalg.LinAlgError) as error:
                left.append(f"{_names(s.suspects)}: {error}")
        provisional(found, used)
        if paired:
            return found, left, used
        paired = True
        jobs = _pairs(found)


def _form(suspects: Sequence[Suspect]) -> str | None:
    return FORM if any(s.name == FORM for s in suspects) else None


def _names(suspects: Sequence[Suspect]) -> str:
    return " + ".join(s.name for s in suspects)


def _pairs(found: Sequence[Fitted]) -> list[tuple[Suspect, ...]]:
    """Second suspects beside the best first one, of other families, where that one earned its place."""
    singles = sorted((f for f in found if len(f.suspects) == 1), key=lambda f: -f.log_evidence)
    if not singles or singles[0].log_evidence < found[0].log_evidence + EARNED:
        return []
    first = singles[0].suspects[0]
    own = {u.key for u in first.unknowns}
    second = [f.suspects[0] for f in singles[1:] if f.suspects[0].family != first.family]
    return [(first, s) for s in second if not own & {u.key for u in s.unknowns}][:MOST_PAIRS]
