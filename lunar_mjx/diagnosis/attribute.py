"""Which effect is missing: noise first, a certified fit, scores, refits, held-out manoeuvres, and then a verdict."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from lunar_mjx.diagnosis.refit import Settings, fit_in_own_step, with_own_step_error
from lunar_mjx.diagnosis.search import Search, excess_explained, search, significant
from lunar_mjx.diagnosis.unknown_inputs.patterns import Unlisted
from lunar_mjx.diagnosis.verdict import Diagnosis, EffectEvidence, Verdict
from lunar_mjx.inference.fit_store import Memory
from lunar_mjx.inference.fitting import Fit, Progress, silent
from lunar_mjx.inference.held_out import errors, noise_test
from lunar_mjx.inference.problem import Problem
from lunar_mjx.inference.score import SEPARABLE, Score


def diagnose(
    problem: Problem, settings: Settings | None = None, progress: Progress = silent, memory: Memory | None = None
) -> tuple[Diagnosis, Search]:
    """The verdict on a model and its measurements, with the evidence.

    Args:
      problem: model, candidates and measurements; the measurements must have passed the gate (`log.check`).
      settings: thresholds and effort; the usual ones if None.
      progress: told what is being done.
      memory: finished fits of an earlier, stopped diagnosis.

    Returns:
      The diagnosis, and everything that it rests on.
    """
    settings = settings or Settings()
    found = search(problem, settings, progress, memory)
    if found.chosen.effects:
        progress("certifying", 0.0)
        found = dataclasses.replace(found, chosen=with_own_step_error(problem, found.chosen))
    base, chosen = found.base, found.chosen
    details: dict[str, Any] = {
        "certificate": _certificate(base.fit),
        "noise_test_before": dataclasses.asdict(base.noise),
        "noise_test_after": dataclasses.asdict(chosen.noise),
        "patterns": {
            "before": base.pattern.to_dict() if base.pattern else None,
            "after": chosen.pattern.to_dict() if chosen.pattern else None,
            "unlisted": dataclasses.asdict(found.unlisted) if found.unlisted else None,
        },
        "seed": settings.seed,
        "alpha": settings.alpha,
        "not_tested": [dataclasses.asdict(n) for n in problem.not_tested],
    }
    if base.fit.problems and not (chosen.effects and chosen.at_noise):
        reason = "; ".join(base.fit.problems)
        sentence = f"The baseline fit has no certificate ({reason}), so nothing is said about physics."
        return Diagnosis(Verdict.BAD_FIT, (), sentence, error_before=errors(problem, base.fit), details=details), found
    unsure = ""
    if chosen.effects:
        named = chosen.at_noise or excess_explained(found, problem) >= settings.explained
        final = certify(problem, found, settings)
        details["certificate_after"] = _certificate(final)
        if not final.problems:
            # values and intervals are those of the fit that has the certificate
            chosen = dataclasses.replace(chosen, fit=final, noise=noise_test(problem, final))
            details["noise_test_after"] = dataclasses.asdict(chosen.noise)
            found = dataclasses.replace(found, chosen=chosen)
        else:
            reason = f"the fit with {', '.join(chosen.effects)} has no certificate ({'; '.join(final.problems)})"
            if named or base.fit.problems or base.at_noise:
                sentence = f"{reason[0].upper()}{reason[1:]}, so nothing is said."
                before = errors(problem, base.fit)
                return Diagnosis(Verdict.BAD_FIT, (), sentence, error_before=before, details=details), found
            # it would have been said to help; that something is missing stands without it
            unsure = f" ({reason[0].upper()}{reason[1:]}.)"
            problem.use_step_error(base.fit.step_error)
            chosen = base
            details["noise_test_after"] = dataclasses.asdict(base.noise)
            found = dataclasses.replace(found, chosen=base, rivals=(), unlisted=None)
    evidence = _evidence(problem, found, settings)
    undecidable = tuple(e.effect for e in evidence if e.status == "not tested")
    explained = excess_explained(found, problem)
    details["excess_explained"] = explained
    verdict, effects, sentence = _verdict(found, explained, settings)
    diagnosis = Diagnosis(
        verdict=verdict,
        effects=effects,
        sentence=sentence + unsure,
        evidence=evidence,
        error_before=errors(problem, base.fit),
        error_after=errors(problem, chosen.fit),
        isolability=found.cosines,
        undecidable=undecidable,
        details=details,
    )
    return diagnosis, found


def certify(problem: Problem, found: Search, settings: Settings) -> Fit:
    """The chosen model fitted once more from several starts, with its own certificate."""
    chosen = found.chosen
    free = problem.free(chosen.effects)
    same = np.array_equal(free, chosen.fit.free) and problem.kept_step_error() is chosen.fit.step_error
    # what held-out logs' own nuisances have moved since is of no account: a step heeds the fitted logs alone
    known = (chosen.fit.residual, chosen.fit.jacobian) if same else None
    with problem.focused(chosen.effects):
        return fit_in_own_step(
            problem,
            free,
            chosen.fit.u,
            starts=settings.starts,
            seed=settings.seed,
            spread=0.5,
            known=None if problem.cheap_jacobian else known,
        )


def _certificate(found: Fit) -> dict[str, Any]:
    return {
        "chi2": found.chi2,
        "gradient": found.gradient,
        "starts": list(found.starts),
        "at_bound": list(found.at_bound),
        "problems": list(found.problems),
        **found.extra,
    }


def _verdict(found: Search, explained: float, settings: Settings) -> tuple[Verdict, tuple[str, ...], str]:
    base, chosen = found.base, found.chosen
    enough = chosen.at_noise or explained >= settings.explained
    left = " What it leaves is small, but it has a pattern that noise has not." if chosen.patterned else ""
    if not chosen.effects:
        if base.patterned:
            return Verdict.UNKNOWN, (), f"No catalogue effect explains the residual.{left}"
        if base.noise.passes:
            return Verdict.NOISE_ONLY, (), "Nothing significant is missing: the residual is at the noise."
        worst = f"{base.noise.worst}, {base.noise.channels[base.noise.worst]:.2f} sigma"
        return (
            Verdict.UNKNOWN,
            (),
            (f"The residual is beyond the noise (worst: {worst}) and no catalogue effect explains it."),
        )
    names = ", ".join(chosen.effects)
    if not enough:
        return (
            Verdict.UNKNOWN,
            chosen.effects,
            (
                f"Something is missing that no catalogue effect brings to the noise; {names} helps, from "
                f"{base.noise.rms:.2f} to {chosen.noise.rms:.2f} sigma.{left}"
            ),
        )
    members = list(dict.fromkeys([*chosen.effects, *(e for c in found.rivals for e in c.effects)]))
    if len(members) > len(chosen.effects):
        common = set(chosen.effects).intersection(*(set(c.effects) for c in found.rivals))
        if len(chosen.effects) == 1 or not common:
            return (
                Verdict.KNOWN_CLASS,
                tuple(members),
                (f"One of {', '.join(members)} is missing; these logs cannot tell which."),
            )
        return (
            Verdict.MULTIPLE,
            tuple(chosen.effects),
            (f"{names} are missing; {', '.join(m for m in members if m not in common)} cannot be told apart here."),
        )
    if len(chosen.effects) == 1:
        return _single(names, found.unlisted)
    return Verdict.MULTIPLE, chosen.effects, f"{names} are missing, each significant given the others."


def _single(name: str, unlisted: Unlisted | None) -> tuple[Verdict, tuple[str, ...], str]:
    """One effect: known, unless an unlisted input of one amount elsewhere explains more than it does."""
    if unlisted is not None and unlisted.ahead > 0.0:
        sentence = f"{name} is missing, or {unlisted}: these logs cannot tell which."
        return Verdict.KNOWN_CLASS, (name,), sentence
    sentence = f"{name} is missing: consistent with these logs, and better than every listed alternative."
    if unlisted is not None:
        sentence += f" But {unlisted} would do nearly the same."
    return Verdict.KNOWN, (name,), sentence


def _evidence(problem: Problem, found: Search, settings: Settings) -> tuple[EffectEvidence, ...]:
    singles = {c.effects[0]: c for c in found.tried if len(c.effects) == 1}
    rivals = {e for c in found.rivals for e in c.effects}
    rows = []
    covariance: dict[int, np.ndarray] = {}
    for s in found.scores:
        own = found.chosen if s.effect in found.chosen.effects else singles.get(s.effect)
        if own and id(own) not in covariance:
            covariance[id(own)] = own.fit.covariance(problem)
        values, std = parameters(problem, own.fit, s.effect, covariance[id(own)]) if own else ({}, {})
        others = {e: v for e, v in found.cosines.get(s.effect, {}).items() if e != s.effect}
        nearest = max(others.items(), key=lambda item: item[1]) if others else ("", 0.0)
        status, reason = _status(s, found, rivals, settings)
        scored = singles.get(s.effect)
        rows.append(
            EffectEvidence(
                effect=s.effect,
                separable_sigma=s.length,
                separable_share=s.share,
                chi2=s.chi2,
                z=s.z,
                p=s.p,
                held_out_gain=scored.gain if scored else float("nan"),
                held_out_se=scored.gain_se if scored else float("nan"),
                values=values,
                std=std,
                nearest=nearest,
                status=status,
                reason=reason,
            )
        )
    order = {name: i for i, name in enumerate(found.chosen.effects)}
    return tuple(sorted(rows, key=lambda e: (order.get(e.effect, len(order)), -e.chi2)))


def _status(s: Score, found: Search, rivals: set[str], settings: Settings) -> tuple[str, str]:
    if s.effect in found.chosen.effects:
        return "accepted", "earns its place on manoeuvres left out"
    if s.effect in rivals:
        return "confounded", "explains these logs as well as an accepted effect"
    if s.length < SEPARABLE:
        return "not tested", f"leaves {s.length:.2g} sigma after a refit of the baseline; at least {SEPARABLE:g} needed"
    if significant(s, settings):
        return "rejected", "explains less than an accepted effect, or nothing beyond it"
    return "not significant", f"z = {s.z:.1f}, family-wise p = {s.p:.2g}"


def parameters(
    problem: Problem, fitted: Fit, effect: str, covariance: np.ndarray | None = None
) -> tuple[dict[str, float], dict[str, float]]:
    """Fitted values and standard deviations of an effect's coordinates, SI units; of a covariance that is known."""
    covariance = fitted.covariance(problem) if covariance is None else covariance
    values, std = {}, {}
    for k, i in enumerate(fitted.free):
        c = problem.coordinates[i]
        if c.effect == effect:
            values[c.name] = float(c.value(fitted.u[i]))
            std[c.name] = c.std(fitted.u[i], float(np.sqrt(max(covariance[k, k], 0.0))))
    return values, std
