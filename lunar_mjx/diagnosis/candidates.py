"""Which effects can be candidates beside those that a model holds."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from lunar_mjx.effects.base import Effect
from lunar_mjx.inference.problem import NotTested


def usable(
    effects: Iterable[Effect], candidates: Mapping[str, Effect], unfit: Callable[[str, Effect], str]
) -> tuple[dict[str, Effect], tuple[NotTested, ...]]:
    """Candidates that can enter, and those that cannot; what the model holds is neither.

    Args:
      effects: of the model. candidates: by name. unfit: why a candidate is none for such measurements, or "".
    """
    present = {e.name for e in effects}
    tested, refused = {}, []
    for name, effect in candidates.items():
        if name in present:
            continue
        replaced = ", ".join(sorted(present & set(effect.replaces)))
        needed = ", ".join(n for n in effect.requires if n not in present and n not in candidates)
        reason = unfit(name, effect) or (f"would replace {replaced}" if replaced else "")
        reason = reason or (f"needs {needed}, which the model lacks" if needed else "")
        # Without a null there is no place in the joint model at which the effect is absent.
        if not reason and all(p.null is None for p in effect.parameters.values()):
            reason = "has no null value"
        if reason:
            refused.append(NotTested(name, reason))
        else:
            tested[name] = effect
    return tested, tuple(refused)
