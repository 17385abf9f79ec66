"""Every term against numbers worked out by hand."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

from lunar_mjx.envs.navigation import rewards
from lunar_mjx.envs.navigation.rewards import TERMS, Transition


@pytest.fixture
def step() -> Transition:
    """The goal moves from (3, 4) m to (0, 4) m, seen by a rover heading east; the reverse in the second."""
    near, far = [0.0, 4.0], [3.0, 4.0]
    return Transition(
        to_goal_before=jnp.array([far, near]),
        to_goal=jnp.array([near, far]),
        roll=jnp.array([0.1, -0.2]),
        pitch=jnp.array([-0.3, 0.05]),
        yaw=jnp.array([0.0, np.arctan2(4, 3)]),
        vertical_acceleration=jnp.array([-0.7, 0.2]),
        action=jnp.array([[1.0, 0.0], [0.5, 0.5]]),
        last_action=jnp.array([[0.0, 0.0], [0.5, -0.5]]),
        nearer=jnp.array([0.4, -0.1]),
    )


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("progress_paper", [3.0, 3.0]),
        ("progress", [1.0, -1.0]),
        ("way", [0.4, -0.1]),
        ("heading", [0.0, 1.0]),
        ("tilt", [-0.4, -0.25]),
        ("excite", [-0.7, -0.2]),
        ("time", [-1.0, -1.0]),
        ("jerkiness", [-1.0, -1.0]),
    ],
)
def test_terms(step, name, wanted):
    np.testing.assert_allclose(TERMS[name](step), wanted, atol=1e-6)


def test_the_papers_sum_pays_for_driving_away_and_the_mended_one_does_not(step):
    def total(weights):
        return sum(w * TERMS[n](step)[1] for n, w in weights.items() if "progress" in n)

    assert total(rewards.PAPER_WEIGHTS) == pytest.approx(60.0)
    assert total(rewards.CONSISTENT_WEIGHTS) == pytest.approx(-20.0)


def test_heading_at_the_goal_is_finite(step):
    there = dataclasses.replace(step, to_goal=jnp.zeros((2, 2)))
    assert np.isfinite(TERMS["heading"](there)).all()


def test_ends():
    assert rewards.reached(jnp.array([[0.3, 0.3], [0.4, 0.4]]), 0.5).tolist() == [True, False]
    tilted = jnp.cos(jnp.deg2rad(jnp.array([59.0, 61.0, 170.0])))
    assert rewards.rolled_over(tilted, np.deg2rad(60.0)).tolist() == [False, True, True]
    assert rewards.stuck(jnp.array([7.9, 8.0]), 8.0).tolist() == [False, True]
