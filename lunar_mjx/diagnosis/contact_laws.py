"""Contact laws that are rivals of each other, and models with one in the place of another."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence

from lunar_mjx.diagnosis.build_problem import FINER_FORMS
from lunar_mjx.diagnosis.weighed.form import SearchSettings
from lunar_mjx.errors import bad_input
from lunar_mjx.model import Model

OWN_LAW = "the model's own contact law"
CLOSED_FORM = "closed form"
LAWS: Mapping[str, tuple[str, ...]] = {
    CLOSED_FORM: ("pressure_sinkage", "closed_form_shear"),
    "stress_integral": ("stress_integral",),
    "granular_resistance": ("granular_resistance",),
}
"""Contact laws that are rivals of each other, and the effects that make them up. (The forms that the seed paper printed
are none: they are kept to reproduce it.)"""
_CONTACT = frozenset(
    {*(part for parts in LAWS.values() for part in parts), "penalty_contact", "printed_shear", "engine_friction"}
)
OF_REECE = frozenset({"exit_angle", "friction_circle"})
"""Effects that change the course of Wong and Reece's stress along the rim: a law without it has nothing to change."""


def contact_laws(model: Model, rivals: Sequence[str]) -> dict[str, Model]:
    """Models by contact law: the model under the name of its own, and a copy with each rival law instead.

    Raises:
      UserError: no such law.
    """
    for name in rivals:
        if name not in LAWS:
            raise bad_input("settings", "laws", name, "is not known", f"use some of {', '.join(LAWS)}")
    present = set(model.effect_names)
    # All parts of a law: pressure and sinkage with another shear are a law of the user's own.
    own = next((name for name, parts in LAWS.items() if set(parts) <= present), OWN_LAW)
    laws = {own: model}
    for name in rivals:
        if name != own:
            laws[name] = with_law(model, name)
    return laws


def with_law(model: Model, law: str) -> Model:
    """A copy of the model with a contact law of `LAWS` in place of its own."""
    # Two contact laws would bear the wheel twice, and what corrects one of them has no place in another.
    foreign = _CONTACT | (OF_REECE | FINER_FORMS if law == "granular_resistance" else frozenset())
    for name in [n for n in model.effect_names if n in foreign]:
        model = model.remove(name)
    for part in LAWS[law]:
        model = model.add(part, "contact law")
    return model


def no_addition(present: Collection[str], name: str) -> str:
    """Why an effect adds nothing to the contact law of a model, or "".

    Args:
      present: names of the model's effects. name: of the effect.
    """
    if name in _CONTACT:
        return "is part of another contact law"
    if "granular_resistance" in present and name in OF_REECE | FINER_FORMS:
        return "changes a stress that granular_resistance does not have"
    return ""


def log_shares(laws: int) -> list[float]:
    """Log prior probability of each of some contact laws: the model's own has half of it, its rivals share the rest."""
    # Half whatever their number: one more rival must not make the model's own law less probable.
    return [0.0] if laws == 1 else [math.log(0.5), *[math.log(0.5 / (laws - 1))] * (laws - 1)]


def better_law(forms: Mapping[str, float], model: Model, sure: float = SearchSettings().sure) -> str | None:
    """Name of the effect of a rival law that surely explains measurements better than the model's own, or None."""
    if not forms:
        return None
    best = max(forms, key=lambda name: forms[name])
    own = next(iter(contact_laws(model, ())))
    return LAWS[best][0] if best != own and best in LAWS and forms[best] >= sure else None
