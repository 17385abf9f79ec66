"""What the benchmark says that a table could tell at best."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from benchmarks.hidden.bed import logs as bed_logs
from benchmarks.hidden.noise import Recipe
from benchmarks.hidden.told import Observed, _correlation, told, true_values


def observed(seed: int, recipe: Recipe, replicates: int = 3) -> tuple[bed_logs.Truth, Observed]:
    """Means of a table's replicates, every other slip angle fitted."""
    rng = np.random.default_rng(seed)
    truth = bed_logs.draw(rng, ("slip_sinkage",), bed_logs.grid(rng, loads=1))
    frame = bed_logs.record(truth, recipe, rng, replicates)
    mean = frame.groupby(frame.index % len(truth.points.slip))[list(truth.channels)].mean()
    number = len(truth.channels)
    points = dataclasses.replace(
        truth.points, **{k: np.tile(getattr(truth.points, k), number) for k in ("slip", "angle", "load")}
    )
    channel = np.repeat(truth.channels, len(truth.points.slip))
    fitted = np.isin(np.round(np.degrees(points.angle)), (0, 20, 45))
    return truth, Observed(channel, points, mean.to_numpy().T.reshape(-1), fitted)


def test_without_noise_nothing_is_missed():
    truth, seen = observed(0, Recipe(dirt=0.0))
    exact = dataclasses.replace(seen, value=true_values(truth, seen))
    found = told(truth, Recipe(), exact)
    assert found["over_floor"] is None
    assert max(p["error"] for p in found["parameters"]) < 1e-9


@pytest.mark.parametrize("kind", ["white", pytest.param("coloured", marks=pytest.mark.slow)])
def test_intervals_cover_where_the_noise_is_as_told(kind):
    covered, over, recipe = [], [], Recipe(kind, dirt=0.0)
    for seed in range(15):
        truth, seen = observed(seed, recipe)
        found = told(truth, recipe, seen)
        covered += [p["covered"] for p in found["parameters"]]
        over.append(found["over_floor"])
    assert np.mean(covered) > 0.85
    assert 1.0 < np.median(over) < 1.05


def test_coloured_noise_is_known_to_correlate_along_a_sweep_alone():
    _, seen = observed(0, Recipe("coloured", dirt=0.0))
    known = _correlation(seen, Recipe("coloured"))
    slip, other = seen.points.slip, np.roll(np.arange(len(seen.value)), len(seen.value) // 4)
    sweep = np.flatnonzero((seen.channel == seen.channel[0]) & (seen.points.angle == seen.points.angle[0]))
    along = sweep[np.argsort(slip[sweep])]
    assert known[along[0], along[1:4]] == pytest.approx(bed_logs.DECAY ** np.arange(1, 4))
    assert not known[np.arange(len(other)), other].any()  # another channel
    assert np.array_equal(_correlation(seen, Recipe("white")), np.eye(len(seen.value)))


def test_what_does_not_show_is_left_out():
    truth, seen = observed(0, Recipe(dirt=0.0))
    capped = dataclasses.replace(truth, effects={"grousers": {"height": 0.02, "count": 90.0}})
    found = told(capped, Recipe(), dataclasses.replace(seen, value=true_values(capped, seen)))
    assert [p["name"] for p in found["parameters"]] == ["height"]
