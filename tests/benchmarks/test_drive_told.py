"""How far what is hidden in foreign drives stands out."""

from __future__ import annotations

import dataclasses

import pytest

from benchmarks.foreign import drive_cases, drive_told
from benchmarks.foreign.drive import simulate

SECONDS = 0.4


@pytest.fixture(scope="module")
def case():
    """One drive of a campaign, whose law is off by nothing: waves of a misfit would be most of the rollouts."""
    whole = drive_cases.draw("tune", 5, 0, "single", ("coulomb_friction",), "husky")
    return dataclasses.replace(
        whole, setups=whole.setups[1:2], world=dataclasses.replace(whole.world, fields=None), memory=0.0
    )


@pytest.mark.slow
def test_what_is_known_beside_makes_an_effect_stand_out_more(case):
    truth = simulate(case.rover, case.world, case.setups, SECONDS)
    found = drive_told.separable_blind(case, truth, SECONDS)
    assert 0.0 < found[""] < 0.9 * found["all"]
    known = {k: v for k, v in found.items() if k not in ("", "all")}
    assert set(known) == {"soil", "motor", "build", "ground", "imu"}
    assert all(found[""] <= v <= found["all"] for v in known.values())


def test_nothing_stands_out_of_a_world_with_nothing_hidden(case):
    world, plain = drive_told.without(case)
    truth = simulate(case.rover, world, plain, SECONDS)
    assert drive_told.separable_blind(case, truth, SECONDS)["all"] == pytest.approx(0.0, abs=1e-6)
