"""What may be added to each contact law, and how probable rival laws are beforehand."""

from __future__ import annotations

import numpy as np
import pytest

from lunar_mjx.diagnosis.candidates import usable
from lunar_mjx.diagnosis.contact_laws import LAWS, log_shares, no_addition, with_law
from lunar_mjx.diagnosis.drives.baseline import unfit
from lunar_mjx.effects.catalogue import CATALOGUE
from lunar_mjx.model import make_model


@pytest.mark.parametrize("law", sorted(LAWS))
def test_no_candidate_is_another_contact_law(law: str):
    model = with_law(make_model("luvmi_x", terrain="flat", preset="consistent"), law)
    present = model.effect_names
    tested, refused = usable(model.effects, CATALOGUE, lambda name, e: unfit(name, e) or no_addition(present, name))
    assert not {"penalty_contact", "pressure_sinkage", "stress_integral", "granular_resistance"} & set(tested)
    assert ("exit_angle" in tested) is (law != "granular_resistance")
    assert "slip_sinkage" in tested
    assert {n.effect for n in refused} >= {"penalty_contact"}


def test_the_models_own_law_has_half_of_the_probability():
    assert np.exp(log_shares(1)) == pytest.approx([1.0])
    assert np.exp(log_shares(3)) == pytest.approx([0.5, 0.25, 0.25])
