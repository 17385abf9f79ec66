"""How far what is hidden in foreign drives stands out."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.foreign.drives import cases, told
from benchmarks.foreign.drives.rollout import simulate
from benchmarks.foreign.misfit import Field

SECONDS = 0.4


@pytest.fixture(scope="module")
def case():
    """One drive of a campaign, whose law is off by nothing: waves of a misfit would be most of the rollouts."""
    whole = cases.draw("tune", 5, 0, "single", ("coulomb_friction",), "husky")
    return dataclasses.replace(
        whole, setups=whole.setups[1:2], world=dataclasses.replace(whole.world, fields=None), memory=0.0
    )


def test_a_misfit_of_a_row_adds_to_that_of_all():
    rng = np.random.default_rng(3)
    field = Field.draw(rng, 0.05, 4)
    row, place, more = rng.normal(size=(3, 3)), rng.normal(size=5), 0.01 * rng.normal(size=(3, len(field.weights)))
    found = field.by_rows_and_places(row, place, more)
    for k in range(3):
        alone = dataclasses.replace(field, weights=field.weights + more[k]).by_rows_and_places(row[k : k + 1], place)
        np.testing.assert_allclose(found[k], alone[0], atol=1e-12)


@pytest.mark.slow
def test_what_is_known_beside_makes_an_effect_stand_out_more(case):
    truth = simulate(case.rover, case.world, case.setups, SECONDS)
    found = told.separable_blind(case, truth, SECONDS)
    assert 0.0 < found[""] < 0.9 * found["all"]
    assert set(found) == {"", "all", "soil", "motor", "build", "ground", "imu"}
    # a friction at the drives is what motor and soil can imitate, and no IMU
    assert found["soil"] > 1.01 * found[""]
    assert found["imu"] < 1.05 * found[""]


@pytest.mark.slow
def test_nothing_stands_out_of_a_world_with_nothing_hidden(case):
    world, plain = told.without(case)
    truth = simulate(case.rover, world, plain, SECONDS)
    assert told.separable_blind(case, truth, SECONDS)["all"] == pytest.approx(0.0, abs=1e-6)
