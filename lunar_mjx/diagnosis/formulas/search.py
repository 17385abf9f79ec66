"""The search for formulas in steady-state tables: all are scored, the best refitted, judged by what was left out.

A score is linear at one fit, and a model that lacks something is fitted in the wrong place. So the best formula's fit
becomes the next place at which all are scored, until none does better; then pairs, where one leaves a rest.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from lunar_mjx.diagnosis.formulas import expression as f
from lunar_mjx.diagnosis.formulas.slots import Choice, Slots, features, library, targets
from lunar_mjx.diagnosis.formulas.targets import known
from lunar_mjx.inference.descent import descend
from lunar_mjx.inference.fitting import Fit, Progress, fit, silent
from lunar_mjx.inference.held_out import HELD_OUT, noise_test, predictive_gain, predictive_residual
from lunar_mjx.inference.objective import Objective
from lunar_mjx.inference.score import leash, project


@dataclasses.dataclass(frozen=True)
class FormulaSearch:
    """How widely formulas are searched, and what counts as better."""

    penalty: float = 5.0
    """Chi-square that every operation and symbol of a formula must earn: choosing one of ten costs 4.6."""
    # Formulas refitted at the model as it is, in each later round, and later rounds.
    first: int = 16
    next: int = 12
    rounds: int = 3
    # Steps of a descent that sorts formulas out, and formulas whose descent is finished.
    steps: int = 10
    finished: int = 6
    # Single formulas beside which a second is sought, and how many of these are refitted.
    seeds: int = 2
    seconds: int = 8
    alike: tuple[float, float] = (0.97, 0.999)
    """|cos| of projected signatures from which only the better scored of two is refitted: in the first round, later."""
    same: float = 1.0
    """Squared difference of two fits' predictions, in sigma, below which they are one."""
    far: float = 30.0
    """Amounts beyond so many visible ones are no linear estimate."""


FORMULA_SEARCH = FormulaSearch()


@dataclasses.dataclass(frozen=True)
class Settings:
    """How formulas are sought.

    Attributes:
      chi2: least drop of chi-square of a formula that is refitted. starts: of the fit of the model as it is. seed: of
        these starts.
    """

    chi2: float = 25.0
    starts: int = 4
    seed: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Trial:
    """One formula, or two together, with their refit and what it gained.

    Attributes:
      choices: the formulas. slots: the problem that holds them. fit: the refit.
      gain, gain_se: on manoeuvres left out. drop: of the squared residual over fitted and select manoeuvres, fitted
        ones left out in turn where there are enough. at_noise: whether the residual is at the noise.
    """

    choices: tuple[Choice, ...]
    slots: Slots
    fit: Fit
    gain: float
    gain_se: float
    drop: float
    at_noise: bool

    @property
    def length(self) -> int:
        """Number of operations and symbols in all its formulas."""
        return sum(long(c) for c in self.choices)

    @property
    def merit(self) -> float:
        """Score that orders trials: how far the squared residual falls, less a penalty by length."""
        return self.drop - FORMULA_SEARCH.penalty * self.length


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """Result of a search: the model without formulas, trials best first, and all scores at it, highest first."""

    empty: Slots
    base: Fit
    trials: tuple[Trial, ...]
    scored: tuple[tuple[Choice, float], ...]


@dataclasses.dataclass(frozen=True, eq=False)
class _Scores:
    """Scores of a library's formulas at a fit: chi-square, amount in visible ones, signature, scale of the factor, and
    the baseline's columns beside it."""

    choices: Sequence[Choice]
    chi2: np.ndarray
    amount: np.ndarray
    signature: np.ndarray
    column: np.ndarray
    scale: np.ndarray

    def order(self) -> np.ndarray:
        """Indices of the formulas, the best first: by chi-square less a penalty by length."""
        return np.argsort(
            -(self.chi2 - FORMULA_SEARCH.penalty * np.array([long(c) for c in self.choices])), kind="stable"
        )


_LENGTHS: dict[tuple[int, int, int], int] = {}


def long(choice: Choice) -> int:
    """Number of operations and symbols of a formula."""
    key = (choice.target, choice.first, choice.second)
    if key not in _LENGTHS:
        of, target = features(choice.port), targets()[choice.target]
        carrier = f.parsed(target.carrier, known(target.port))
        _LENGTHS[key] = f.length(f.without_floors(f.symbol("a") * carrier * of[choice.first] * of[choice.second]))
    return _LENGTHS[key]


def search_formulas(
    empty: Slots, base: Fit, ports: Sequence[str], settings: Settings, progress: Progress = silent
) -> Found:
    """Looks for what is missing at some ports of a wheel.

    Args:
      empty: the table's problem with slots. base: its fit. ports: where. settings: thresholds.
      progress: told what is being done.
    """
    choices = library(tuple(ports))
    search = _Search(empty, base, settings)
    progress("scoring formulas", 0.0)
    first = search.scores(empty, base, choices)
    at = first.order()
    scored = tuple((first.choices[i], float(first.chi2[i])) for i in at)
    trials = search.refit(empty, base, first, FORMULA_SEARCH.first, FORMULA_SEARCH.alike[0])
    for k in range(FORMULA_SEARCH.rounds):
        best = max(trials, key=lambda t: t.merit, default=None)
        if best is None:
            break
        progress("refitting formulas", (k + 1) / (FORMULA_SEARCH.rounds + 2))
        (held_slot,) = best.slots.held
        # with the held formula taken out: the next one replaces it, and is scored where the better model stands
        again = search.scores(best.slots, best.fit, choices, held_slot)
        new = search.refit(best.slots, best.fit, again, FORMULA_SEARCH.next, FORMULA_SEARCH.alike[1], held_slot)
        trials += new
        if not any(t.merit > best.merit for t in new):
            break
    # 1 + x differs from exp x for large x alone, so that only the best are tried in both ways
    trials += search.linear(trials)
    trials = search.finished(trials)
    progress("refitting pairs of formulas", FORMULA_SEARCH.rounds / (FORMULA_SEARCH.rounds + 2))
    trials += search.pairs(trials, choices)
    trials = search.finished(trials)
    return Found(empty, base, tuple(told_apart(sorted(trials, key=lambda t: -t.merit))), scored)


def told_apart(trials: Sequence[Trial]) -> list[Trial]:
    """Trials without those whose predictions these data cannot tell from an earlier one's, nor 1 + x from exp x."""
    kept: list[Trial] = []
    for t in trials:
        laws = {dataclasses.replace(c, linear=False) for c in t.choices}
        if not any(
            laws == {dataclasses.replace(c, linear=False) for c in k.choices}
            or float(np.sum((t.fit.residual - k.fit.residual)[t.fit.fitted] ** 2)) < FORMULA_SEARCH.same
            for k in kept
        ):
            kept.append(t)
    return kept


class _Search:
    """Scores and refits at any fit."""

    def __init__(self, empty: Slots, base: Fit, settings: Settings):
        self.empty, self.base, self.settings = empty, base, settings
        self.before = predictive_residual(empty.problem, base)
        self.tried: set[frozenset[Choice]] = set()

    def scores(self, slots: Slots, at: Fit, choices: Sequence[Choice], dropped: int | None = None) -> _Scores:
        """Scores formulas at a fit.

        Args:
          slots: what the fit holds. at: the fit. choices: formulas.
          dropped: slot whose formula is taken out, in linear approximation.
        """
        residual, jacobian, prior = self._without(slots, at, dropped)
        keep, observations = at.fitted, slots.problem.observations
        wanted = sorted({c.target for c in choices})
        probes = slots.probes(at.u, wanted)
        out = []
        for k in wanted:
            mine = [c for c in choices if c.target == k]
            seen = slots.factors(at.u, targets()[k].port)
            product = seen[:, [c.first for c in mine]] * seen[:, [c.second for c in mine]]
            # over its own root mean square, so that one amount means the same for formulas in N, m or rad/s
            size = np.sqrt(np.mean(product[keep] ** 2, axis=0))
            scale = 1.0 / np.where(size > 0.0, size, 1.0)
            column = observations.whiten(np.nan_to_num(probes[k])[:, None] * product * scale)
            signature = project(column[keep], jacobian[keep], prior)[: int(keep.sum())]
            out.append((mine, signature, column, scale))
        signature = np.concatenate([o[1] for o in out], axis=1)
        power = np.sum(signature**2, axis=0)
        amount = signature.T @ residual[keep] / np.where(power > 1e-6, power, np.inf)
        # least squares in one unknown beside the refitted baseline, for thousands of formulas in one product
        chi2 = np.where(np.abs(amount) < FORMULA_SEARCH.far, amount**2 * power, 0.0)
        return _Scores(
            [c for o in out for c in o[0]],
            chi2,
            amount,
            signature,
            np.concatenate([o[2] for o in out], axis=1),
            np.concatenate([o[3] for o in out]),
        )

    def _without(self, slots: Slots, at: Fit, dropped: int | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Residual (n,), columns (n, k) and prior weights (k,) of a fit from which one formula is taken away."""
        prior = leash(slots.problem, at)
        if dropped is None:
            return at.residual, at.jacobian, prior
        place = slots.place(dropped)
        stay = np.isin(at.free, self._left(slots, at, dropped))
        column = at.jacobian[:, list(at.free).index(place)]
        return at.residual + column * at.u[place], at.jacobian[:, stay], prior[stay]

    def _left(self, slots: Slots, at: Fit, dropped: int | None) -> list[int]:
        """Coordinates that a fit still moves once one of its formulas is taken away."""
        own = slots.own(dropped) if dropped is not None else []
        return [int(i) for i in at.free if i not in own]

    def refit(
        self, slots: Slots, at: Fit, scores: _Scores, most: int, alike: float, dropped: int | None = None
    ) -> list[Trial]:
        """Trials of the best-scored formulas that were not tried yet, one of each family that these data tell apart."""
        held = {k: v for k, v in slots.held.items() if k != dropped}
        kept = frozenset(c for c, _ in held.values())
        unit = scores.signature / np.maximum(np.linalg.norm(scores.signature, axis=0), 1e-12)
        chosen: list[int] = []
        for i in scores.order():
            if len(chosen) == most:
                break
            new = kept | {scores.choices[i]}
            if scores.chi2[i] < self.settings.chi2 or len(new) == len(kept) or new in self.tried:
                continue
            # the best of each family alone: a hundred spellings of one law would fill all refits
            if not chosen or np.max(np.abs(unit[:, chosen].T @ unit[:, i])) < alike:
                chosen.append(int(i))
        left, number = self._left(slots, at, dropped), slots.spare
        residual, jacobian, prior = self._without(slots, at, dropped)
        rows = np.vstack([jacobian[at.fitted], np.diag(prior)])
        trials = []
        for i in chosen:
            choice, amount = scores.choices[i], scores.amount[i]
            grown = slots.holding({**held, number: (choice, targets()[choice.target].size * scores.scale[i])})
            unexplained = (residual - scores.column[:, i] * amount)[at.fitted]
            # the others give way to the new formula before the descent, which then has less to do
            step = np.linalg.lstsq(rows, np.concatenate([unexplained, np.zeros(len(prior))]), rcond=1e-8)[0]
            start = np.zeros_like(at.u)
            start[left] = at.u[left] + step
            start[grown.place(number)] = amount
            trials.append(self._trial(grown, start))
        return [t for t in trials if t is not None]

    def _trial(self, slots: Slots, start: np.ndarray) -> Trial | None:
        choices = tuple(c for c, _ in slots.held.values())
        self.tried.add(frozenset(choices))
        goal = Objective(slots.problem, slots.free, self.base.fitted)
        down = descend(goal, start, iterations=FORMULA_SEARCH.steps)
        if not np.isfinite(down.chi2):
            return None
        descended = Fit(down.u, slots.free, down.chi2, down.residual, down.jacobian, self.base.fitted)
        return self._judged(choices, slots, descended)

    def _judged(self, choices: tuple[Choice, ...], slots: Slots, found: Fit) -> Trial:
        after = predictive_residual(slots.problem, found)
        gain, se = predictive_gain(slots.problem, self.base, found, self.before, after)
        # Where fitted groups are too few to be left out in turn, they count as they are: how well a formula does on two
        # groups alone decides nothing between neighbours.
        observations, fitted = slots.problem.observations, self.base.fitted
        few = len(np.unique(observations.unit[fitted])) < HELD_OUT.enough
        old = np.where(fitted & few, self.base.residual, self.before)
        new = np.where(fitted & few, found.residual, after)
        change = (old**2 - new**2)[observations.in_split("fit", "select")]
        drop = float(np.sum(change[np.isfinite(change)]))
        return Trial(choices, slots, found, gain, se, drop, noise_test(slots.problem, found).passes)

    def linear(self, trials: Sequence[Trial], most: int = 5) -> list[Trial]:
        """Trials of the best formulas that multiply by exp x, with 1 + x in its place."""
        out = []
        for t in sorted(trials, key=lambda t: -t.merit)[:most]:
            ((k, (choice, scale)),) = t.slots.held.items()
            other = dataclasses.replace(choice, linear=True)
            if targets()[choice.target].multiplies and not choice.linear and frozenset((other,)) not in self.tried:
                out.append(self._trial(t.slots.holding({k: (other, scale)}), t.fit.u))
        return [t for t in out if t is not None]

    def finished(self, trials: Sequence[Trial]) -> list[Trial]:
        """The trials, the best of them refitted until their descent has settled."""
        ordered = sorted(trials, key=lambda t: -t.merit)
        done = []
        for t in ordered[: FORMULA_SEARCH.finished]:
            refitted = fit(t.slots.problem, t.slots.free, t.fit.u, starts=1)
            # A longer descent that ends higher has gone to another minimum: the shorter one's place stays.
            done.append(self._judged(t.choices, t.slots, refitted) if refitted.chi2 <= t.fit.chi2 else t)
        return done + ordered[FORMULA_SEARCH.finished :]

    def pairs(self, trials: Sequence[Trial], choices: Sequence[Choice]) -> list[Trial]:
        """Trials of the best single formulas with a second one, where the single leaves more than noise."""
        out: list[Trial] = []
        for t in sorted(trials, key=lambda t: -t.merit)[: FORMULA_SEARCH.seeds]:
            # where a single formula left noise alone, a second could only explain noise
            if not t.at_noise:
                more = self.scores(t.slots, t.fit, choices)
                out += self.refit(t.slots, t.fit, more, FORMULA_SEARCH.seconds, FORMULA_SEARCH.alike[0])
        return out
